//! Photographs without the object's shadow: divided by what is left of the light at each pixel, where `prepare` has found
//! it.

use std::path::Path;

use image::RgbImage;

use super::{Error, decode, resample};

/// Folder of the maps within a scene: one for each photograph that shows the shadow, in proportion as large as it; what is
/// left of the light, of 255.
pub const RELIGHT: &str = "relight";

/// Sides of a map may be off by so many of its pixels against the photograph's proportions.
const ROUNDING: f64 = 1.0;

/// Takes the shadow that a map has out of a picture of a photograph of the size `photograph`.
///
/// # Errors
/// A map that cannot be read or has other proportions than the photograph.
pub(super) fn apply(path: &Path, photograph: [u32; 2], picture: &mut RgbImage) -> Result<(), Error> {
    let map = decode(path)?.into_rgb8();
    let [w, h] = photograph.map(f64::from);
    let expected = f64::from(map.width()) * h / w;
    if (expected - f64::from(map.height())).abs() > ROUNDING {
        let what = format!(
            "it is {}x{}, which are not the proportions of its photograph of {w}x{h}; make it again with prepare, or take \
             the folder {RELIGHT} away",
            map.width(),
            map.height()
        );
        return Err(Error::File { path: path.to_path_buf(), what });
    }
    let map = resample::photograph(&map, [picture.width(), picture.height()]);
    lighten(picture, &map);
    Ok(())
}

/// Divides a picture by what is left of its light, of 255: a map as large as it.
pub fn lighten(picture: &mut RgbImage, map: &RgbImage) {
    for (pixel, left) in picture.pixels_mut().zip(map.pixels()) {
        for (value, left) in pixel.0.iter_mut().zip(left.0) {
            *value = (f64::from(*value) * 255.0 / f64::from(left.max(1))).round().min(255.0) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;

    #[test]
    fn a_shadow_goes_and_nothing_else_changes() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        // The left half is in a shadow of one half, in a map half as large.
        RgbImage::from_fn(4, 2, |x, _| Rgb([if x < 2 { 128 } else { 255 }; 3])).save(&path).unwrap();
        let mut picture = RgbImage::from_fn(8, 4, |x, _| if x < 4 { Rgb([50, 60, 200]) } else { Rgb([99, 98, 97]) });
        apply(&path, [80, 40], &mut picture).unwrap();
        // 50 * 255 / 128 = 99.6, 60 * 255 / 128 = 119.5; what would be brighter than white is white.
        assert_eq!(picture.get_pixel(0, 0).0, [100, 120, 255]);
        assert_eq!(picture.get_pixel(7, 3).0, [99, 98, 97]);
        let error = apply(&path, [80, 80], &mut picture).unwrap_err().to_string();
        assert!(error.contains("not the proportions"), "{error}");
    }
}
