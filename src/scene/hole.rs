//! Pictures of the place without the object, for the views that are not the reference: what `prepare` has filled.

use std::path::Path;

use image::{GrayImage, RgbImage};

use super::{Error, View, decode, resample};

/// Folder of the filled holes within a scene, `hole/NAME.png`: in proportion as large as the photographs; alpha is 255 in the
/// hole, and around it colours go on for a few pixels.
pub const HOLE: &str = "hole";
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
    pub filled: GrayImage,
}

/// Whether the holes were filled with the reference picture that is there: an exchanged one shows something else in them.
pub(super) fn are_current(scene: &Path) -> bool {
    let Ok(text) = std::fs::read_to_string(scene.join(HOLE).join(MADE_WITH)) else { return true };
    text.lines().all(|line| {
        let Some((hash, file)) = line.split_once(' ') else { return false };
        std::fs::read(scene.join(file)).is_ok_and(|bytes| blake3::hash(&bytes).to_hex().as_str() == hash)
    })
}

/// The hole of view `at`, filled by a file.
///
/// # Errors
/// A file that is no picture, or is in other proportions than the photograph.
pub(super) fn read(path: &Path, at: usize, view: &View) -> Result<Hole, Error> {
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
    let split = |channels: [usize; 3]| {
        let bytes = picture.pixels().flat_map(|p| channels.map(|c| p.0[c])).collect();
        let image = RgbImage::from_raw(own[0], own[1], bytes).expect("three bytes per pixel");
        resample::photograph(&image, size)
    };
    let (colors, alpha) = (split([0, 1, 2]), split([3, 3, 3]));
    let mut image = view.image.clone();
    let mut filled = GrayImage::new(size[0], size[1]);
    let pixels = image.pixels_mut().zip(filled.pixels_mut());
    for ((pixel, filled), (color, alpha)) in pixels.zip(colors.pixels().zip(alpha.pixels())) {
        filled.0 = [if alpha.0[0] > 0 { 255 } else { 0 }];
        let share = f64::from(alpha.0[0]) / 255.0;
        for (to, from) in pixel.0.iter_mut().zip(color.0) {
            *to = (share * f64::from(from) + (1.0 - share) * f64::from(*to)).round() as u8;
        }
    }
    Ok(Hole { view: at, image, filled })
}
