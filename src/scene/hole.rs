//! Pictures of the place without the object, for the views that are not the reference: what `prepare` has filled.

use std::path::{Path, PathBuf};

use image::{GrayImage, RgbImage};
use rayon::prelude::*;

use super::npy::{self, Map};
use super::{Config, Error, Notes, Reference, View, decode, resample};

/// Folder of the filled holes within a scene, `hole/NAME.png`: in proportion as large as the photographs; alpha is 255 in the
/// hole, [`DOUBTFUL`] where what is there is not to be trained on, and around it colours go on for a few pixels.
pub const HOLE: &str = "hole";
/// Alpha of a pixel of the hole that shows what may not be there.
pub const DOUBTFUL: u8 = 128;
/// Folder of maps of what no photograph shows within a scene that `prepare` made: `NAME.png` of each view with a hole, as large as its
/// filled picture, white where that is guessed, or painted by the user.
pub const GUESSED: &str = "prepare/guessed";
/// Where the depth of what views show without the object is within a scene that `prepare` made: `NAME.npy` of each view whose hole was
/// filled, depth z in the model's unit, NaN where it is not known.
pub const BEHIND: &str = "prepare/behind/";
/// File in [`HOLE`] that names the reference pictures which the holes were filled with: of each in a line the BLAKE3 hash of
/// its bytes and its path below the scene.
pub const MADE_WITH: &str = "made_with";

/// A train view whose hole is filled.
#[derive(Clone, Debug)]
pub struct Hole {
    /// Index into [`Scene::train`](super::Scene::train).
    pub view: usize,
    /// The photograph with its hole filled, as large as the view's own.
    pub image: RgbImage,
    /// 255 where `image` is not the photograph's, as large as it.
    pub covered: GrayImage,
    /// 255 where `image` is to be trained on though it is not the photograph's, as large as it.
    pub filled: GrayImage,
    /// `[pixel]` depth z of what is filled, scene units; NaN where it is not known. Nothing where `prepare` has told none.
    pub depth: Option<Vec<f32>>,
}

/// Whether the holes were filled with the reference picture that is there: an exchanged one shows something else in them.
fn are_current(scene: &Path) -> bool {
    let Ok(text) = std::fs::read_to_string(scene.join(HOLE).join(MADE_WITH)) else { return true };
    text.lines().all(|line| {
        let Some((hash, file)) = line.split_once(' ') else { return false };
        std::fs::read(scene.join(file)).is_ok_and(|bytes| blake3::hash(&bytes).to_hex().as_str() == hash)
    })
}

/// The depth of what a view shows without the object, at its size; nothing where there is no such file.
///
/// # Errors
/// A file that is no map.
fn behind(dir: &Path, view: &View) -> Result<Option<Vec<f32>>, Error> {
    let path = dir.join(format!("{BEHIND}{}.npy", view.name));
    if !path.is_file() {
        return Ok(None);
    }
    let Map { values, size: [w, h] } = npy::read(&path)?;
    let [across, down] = view.camera.size;
    let at = |i: u32| (i / across * h / down) * w + i % across * w / across;
    Ok(Some((0..across * down).map(|i| values[at(i) as usize]).collect()))
}

/// The hole of view `at`, filled by a file, of the scene at `dir`.
///
/// # Errors
/// A file that is no picture, or is in other proportions than the photograph.
fn read(dir: &Path, path: &Path, at: usize, view: &View) -> Result<Hole, Error> {
    let picture = decode(path)?.into_rgba8();
    let size @ [w, h] = view.camera.size;
    let (from, expected) = (f64::from(picture.width()), f64::from(picture.width()) * f64::from(h) / f64::from(w));
    // Sides are rounded to whole pixels, here and at the training size.
    if (expected - f64::from(picture.height())).abs() > 1.0 + from / f64::from(w) {
        let what = format!(
            "it is {}x{}, which are not the proportions of its photograph; make it again with prepare, or take the folder \
             {HOLE} away",
            picture.width(),
            picture.height()
        );
        return Err(Error::File { path: path.to_path_buf(), what });
    }
    let own = [picture.width(), picture.height()];
    let of = |channels: &dyn Fn([u8; 4]) -> [u8; 3]| {
        let bytes = picture.pixels().flat_map(|p| channels(p.0)).collect();
        resample::photograph(&RgbImage::from_raw(own[0], own[1], bytes).expect("three bytes per pixel"), size)
    };
    let colors = of(&|[r, g, b, _]| [r, g, b]);
    let hole = of(&|[.., alpha]| [if alpha == DOUBTFUL { 255 } else { alpha }; 3]);
    let doubtful = of(&|[.., alpha]| [if alpha == DOUBTFUL { 255 } else { 0 }; 3]);
    let mut image = view.image.clone();
    let [mut covered, mut filled] = [(); 2].map(|()| vec![0; image.pixels().len()]);
    for (i, pixel) in image.pixels_mut().enumerate() {
        let [hole, doubtful] = [&hole, &doubtful].map(|of| of.as_raw()[3 * i]);
        let share = f64::from(hole) / 255.0;
        let from = &colors.as_raw()[3 * i..3 * i + 3];
        for (to, from) in pixel.0.iter_mut().zip(from) {
            *to = (share * f64::from(*from) + (1.0 - share) * f64::from(*to)).round() as u8;
        }
        covered[i] = if hole > 0 { 255 } else { 0 };
        filled[i] = if hole > 0 && 2 * u32::from(doubtful) <= u32::from(hole) { 255 } else { 0 };
    }
    let [covered, filled] =
        [covered, filled].map(|bytes| GrayImage::from_raw(size[0], size[1], bytes).expect("a byte per pixel"));
    Ok(Hole { view: at, image, covered, filled, depth: behind(dir, view)? })
}

/// Reads the filled holes, `files` by view, where they go with the reference that is there. The masks become those of what was filled, the
/// references' too: a hole is a little larger than the object. Returns those of the views that are no references.
pub(super) fn read_all(
    dir: &Path,
    config: &Config,
    (train, files): (&mut [View], &[Option<PathBuf>]),
    references: &[Reference],
    notes: &mut Notes,
) -> Result<Vec<Hole>, Error> {
    let filled = train
        .iter()
        .zip(files)
        .enumerate()
        .filter_map(|(at, (view, file))| Some((at, view, file.as_ref().filter(|_| view.mask.is_some())?)));
    let filled: Vec<(usize, &View, &PathBuf)> = filled.collect();
    if filled.is_empty() {
        return Ok(vec![]);
    }
    if !(config.has_reference() && config.fill_holes) {
        notes.push(format!("{HOLE}/ is ignored, as configured: the other views' holes are not trained on"));
        return Ok(vec![]);
    }
    if !config.truth_reference.is_empty() || !config.reference_file.is_empty() || !are_current(dir) {
        notes.push(format!(
            "{HOLE}/ is not used: it was filled with another reference picture; prepare --only reference fills it anew"
        ));
        return Ok(vec![]);
    }
    let one = |(at, view, path): &(usize, &View, &PathBuf)| read(dir, path, *at, view);
    let holes: Vec<Result<Hole, Error>> = filled.par_iter().map(one).collect();
    let mut holes = holes.into_iter().collect::<Result<Vec<_>, Error>>()?;
    for hole in &holes {
        let mask = train[hole.view].mask.as_mut().expect("views without a mask were left out");
        mask.iter_mut().zip(hole.covered.as_raw()).for_each(|(mask, covered)| *mask = (*mask).max(*covered));
    }
    holes.retain(|hole| !references.iter().any(|r| r.view == hole.view));
    notes.push(format!("the holes of {} more views are filled ({HOLE}/)", holes.len()));
    Ok(holes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Camera;

    /// Half of a hole is told and half is doubtful: all of it is covered, and trained on is the half that is told.
    #[test]
    fn what_is_doubtful_is_covered_and_not_trained_on() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("view.png");
        let alpha = |x: u32| [0, 255, DOUBTFUL, 0][x as usize / 2];
        image::RgbaImage::from_fn(8, 4, |x, _| image::Rgba([200, 100, 50, alpha(x)])).save(&path).expect("a picture");
        let camera = Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [8.0; 2],
            principal: [4.0, 2.0],
            distortion: [0.0; 4],
            size: [8, 4],
        };
        let image = RgbImage::from_pixel(8, 4, image::Rgb([10; 3]));
        let view = View { name: "view".into(), camera, image, mask: None, weight: None, prior: None, depth: None };
        let hole = read(folder.path(), &path, 0, &view).expect("a hole");
        for x in 0..8 {
            let is = [&hole.covered, &hole.filled].map(|of| of.get_pixel(x, 2).0[0] > 0);
            assert_eq!(is, [alpha(x) > 0, alpha(x) == 255], "{x}");
            assert_eq!(hole.image.get_pixel(x, 2).0[0], if is[0] { 200 } else { 10 }, "{x}");
        }
    }
}
