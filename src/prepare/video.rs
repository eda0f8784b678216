//! Photographs out of a video, through the `ffmpeg` program: the sharpest frame of every equally long piece.
//!
//! All frames, at 15 a second, are looked at, reduced. Pieces are as long as gives the frames that are asked for, and no
//! shorter than four frames. The sharpest frame of a piece is the one whose Laplacian varies most; it alone is written at its
//! full size.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use image::GrayImage;
use rayon::prelude::*;

use super::program;
use super::record::{self, Inputs};
use super::{Error, Watch};
use crate::{atomic, scene};

/// Frames of a second that are looked at.
const RATE: u32 = 15;
/// Frames of a piece at least: neighbours show the same from the same place.
const CANDIDATES: usize = 4;
/// Width of what is looked at, pixels.
const WIDTH: u32 = 640;
/// Photographs that can agree on anything.
const FEWEST: usize = 3;
/// The folder of the frames within what is made.
const FRAMES: &str = "frames";
/// The file that says what they were made of.
const RECORD: &str = "frames.json";

/// Whether photographs are to be taken out of a file: whatever is no folder, as `ffmpeg` knows what a video is.
pub fn is_video(path: &Path) -> bool {
    path.is_file()
}

/// The folder below `out` with at most so many frames of a video: `frame_0001.jpg` and so on. They are taken once, and frames
/// that were deleted since stay away. The caller holds the lock of what is made there.
///
/// # Errors
/// Without `ffmpeg`; a file that has no video, or too few frames; an end that somebody wished.
pub fn frames(video: &Path, most: u32, out: &Path, watch: &mut dyn Watch) -> Result<PathBuf, Error> {
    let folder = out.join(FRAMES);
    let made_of = Inputs::default().with(record::hash(video)?).with(most.to_le_bytes()).finish();
    let path = out.join(RECORD);
    let known = std::fs::read(&path).ok().and_then(|text| serde_json::from_slice(&text).ok());
    if known.as_ref() == Some(&made_of) && scene::pictures(&folder).is_ok_and(|frames| frames.len() >= FEWEST) {
        return Ok(folder);
    }
    let work = tempfile::tempdir().map_err(|source| Error::Io { path: std::env::temp_dir(), source })?;
    let clip = Clip { video, work: work.path() };
    watch.say("frames: the video is looked through for its sharpest frames (ffmpeg)");
    let look = work.path().join("look");
    clip.extract(&format!("fps={RATE},scale='min({WIDTH},iw)':-2"), &look, watch)?;
    let chosen = choose(&candidates(&look)?, most as usize);
    if chosen.len() < FEWEST {
        let what = format!("its {} frames are too few; three are the least that can agree on anything", chosen.len());
        return Err(Error::File { path: video.to_owned(), what });
    }
    watch.say(&format!("frames: {} of them are taken (ffmpeg)", chosen.len()));
    let terms = chosen.iter().fold(String::new(), |mut terms, number| {
        let plus = if terms.is_empty() { "" } else { "+" };
        let _ = write!(terms, "{plus}eq(n,{number})");
        terms
    });
    let taken = work.path().join("taken");
    clip.extract(&format!("fps={RATE},select='{terms}',setpts=N/{RATE}/TB"), &taken, watch)?;
    keep(&taken, &folder)?;
    atomic::write_json(&path, &made_of).map_err(|source| Error::Io { path, source })?;
    Ok(folder)
}

/// Puts the frames in the place of those that were there.
fn keep(taken: &Path, folder: &Path) -> Result<(), Error> {
    let at = |path: &Path| {
        let path = path.to_owned();
        move |source| Error::Io { path, source }
    };
    if folder.exists() {
        for path in scene::pictures(folder)?.values() {
            std::fs::remove_file(path).map_err(at(path))?;
        }
    }
    std::fs::create_dir_all(folder).map_err(at(folder))?;
    for path in scene::pictures(taken)?.values() {
        let target = folder.join(path.file_name().unwrap_or_default());
        std::fs::copy(path, &target).map_err(at(&target))?;
    }
    Ok(())
}

/// A video, and a folder to work in.
struct Clip<'a> {
    video: &'a Path,
    work: &'a Path,
}

impl Clip<'_> {
    /// Writes what a filter leaves of the frames into a folder, as JPEG numbered from 1.
    fn extract(&self, filter: &str, into: &Path, watch: &mut dyn Watch) -> Result<(), Error> {
        std::fs::create_dir_all(into).map_err(|source| Error::Io { path: into.to_owned(), source })?;
        let words = self.work.join("words.txt");
        // An absolute path is none of the addresses that ffmpeg knows, and a list of others reads files alone.
        let video = std::path::absolute(self.video).map_err(|source| Error::Io { path: self.video.into(), source })?;
        let mut command = Command::new("ffmpeg");
        command.args(["-v", "error", "-nostdin", "-protocol_whitelist", "file", "-i"]).arg(video);
        command
            .args(["-an", "-sn", "-dn", "-vf", filter, "-q:v", "2", "-f", "image2"])
            .arg(into.join("frame_%04d.jpg"));
        let Some(status) = program::ask(&mut command, &words, watch)? else {
            return Err(Error::NoFrames { video: self.video.to_owned() });
        };
        // A video that is cut off has frames all the same.
        if status.success() || !scene::pictures(into)?.is_empty() {
            return Ok(());
        }
        let what = format!(
            "ffmpeg finds no video in it ({}); give a video, a folder of photographs, or a splat",
            program::last_said(&words)?
        );
        Err(Error::File { path: self.video.to_owned(), what })
    }
}

/// The sharpness of every frame; nothing for one that is the same as the one before it.
fn candidates(look: &Path) -> Result<Vec<Option<f64>>, Error> {
    let numbered: BTreeMap<usize, PathBuf> = scene::pictures(look)?
        .into_iter()
        .filter_map(|(name, path)| Some((name.strip_prefix("frame_")?.parse().ok()?, path)))
        .collect();
    let looked: Vec<_> = numbered
        .into_par_iter()
        .map(|(_, path)| {
            let hash = record::hash(&path)?;
            Ok((hash, sharpness(&scene::decode(&path)?.into_luma8())))
        })
        .collect::<Result<_, Error>>()?;
    let before = std::iter::once(None).chain(looked.iter().map(|(hash, _)| Some(hash)));
    Ok(looked.iter().zip(before).map(|((hash, sharp), before)| (before != Some(hash)).then_some(*sharp)).collect())
}

/// Variance of the Laplacian.
fn sharpness(picture: &GrayImage) -> f64 {
    let (width, height) = picture.dimensions();
    let at = |x: u32, y: u32| f64::from(picture.get_pixel(x, y).0[0]);
    let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let laplacian = at(x - 1, y) + at(x + 1, y) + at(x, y - 1) + at(x, y + 1) - 4.0 * at(x, y);
            (count, sum, squares) = (count + 1.0, sum + laplacian, squares + laplacian * laplacian);
        }
    }
    if count > 0.0 { squares / count - (sum / count).powi(2) } else { 0.0 }
}

/// Numbers of the sharpest frames of pieces of one length, `most` of them at most.
fn choose(sharp: &[Option<f64>], most: usize) -> Vec<usize> {
    let count = sharp.len();
    let pieces = most.min((count / CANDIDATES).max(FEWEST)).min(count);
    let piece = |i: usize| i * count / pieces..(i + 1) * count / pieces;
    let sharpest = |i: usize| {
        let known = piece(i).filter_map(|n| Some((n, sharp[n]?)));
        known.max_by(|a, b| a.1.total_cmp(&b.1)).map(|(n, _)| n)
    };
    (0..pieces).filter_map(sharpest).collect()
}

#[cfg(test)]
mod tests {
    use image::Luma;

    use super::*;

    fn noise(blurred: bool) -> GrayImage {
        let picture = GrayImage::from_fn(64, 48, |x, y| Luma([((x * 7 + y * 13) * 37 % 251) as u8]));
        if blurred { image::imageops::blur(&picture, 2.0) } else { picture }
    }

    #[test]
    fn what_is_blurred_is_less_sharp() {
        assert!(sharpness(&noise(false)) > 4.0 * sharpness(&noise(true)));
        assert_eq!(sharpness(&GrayImage::new(40, 30)), 0.0);
        assert_eq!(sharpness(&GrayImage::new(1, 1)), 0.0);
    }

    #[test]
    fn the_sharpest_of_each_piece_is_taken() {
        let sharp: Vec<Option<f64>> = (0..40).map(|i| Some(if i % 10 == 3 { 9.0 } else { 1.0 })).collect();
        assert_eq!(choose(&sharp, 4), [3, 13, 23, 33]);
        // No piece is shorter than a few frames, and none is empty.
        let many = choose(&sharp, 120);
        assert!(many.len() == 10 && many.windows(2).all(|pair| pair[0] < pair[1]), "{many:?}");
        assert_eq!(choose(&sharp[..2], 120), [0, 1]);
        assert_eq!(choose(&[], 120), [0; 0]);
        // What is shown twice is taken once.
        let still: Vec<Option<f64>> = (0..40).map(|i| (i < 10).then_some(1.0)).collect();
        assert!(choose(&still, 4).len() == 1);
    }
}
