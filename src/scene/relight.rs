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

/// A photograph at a smaller size, or its own, without the shadow that its map has, if it has one. The shadow is taken out before
/// the photograph is reduced: at the edge of a mask, where the map ends, a reduced one would leave a dark line.
///
/// # Errors
/// A map that cannot be read or has other proportions than the photograph.
pub(crate) fn reduced(map: Option<&Path>, photograph: &RgbImage, to: [u32; 2]) -> Result<RgbImage, Error> {
    let Some(path) = map else { return Ok(resample::photograph(photograph, to)) };
    let map = decode(path)?.into_rgb8();
    let [w, h] = [photograph.width(), photograph.height()].map(f64::from);
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
    let within = map.width().min(photograph.width()) > to[0];
    let at = if within { [map.width().min(photograph.width()), map.height().min(photograph.height())] } else { to };
    let mut picture = resample::photograph(photograph, at);
    lighten(&mut picture, &resample::photograph(&map, at));
    Ok(resample::photograph(&picture, to))
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
        let mut photograph = RgbImage::from_fn(8, 4, |x, _| if x < 4 { Rgb([50, 60, 200]) } else { Rgb([99, 98, 97]) });
        let picture = reduced(Some(&path), &photograph, [8, 4]).unwrap();
        // 50 * 255 / 128 = 99.6, 60 * 255 / 128 = 119.5; what would be brighter than white is white.
        assert_eq!(picture.get_pixel(0, 0).0, [100, 120, 255]);
        assert_eq!(picture.get_pixel(7, 3).0, [99, 98, 97]);
        // A shadow of a half up to the middle of a reduced pixel is taken out whole.
        let path = dir.path().join("b.png");
        RgbImage::from_fn(8, 4, |x, _| Rgb([if x < 3 { 128 } else { 255 }; 3])).save(&path).unwrap();
        photograph = RgbImage::from_fn(8, 4, |x, _| Rgb([if x < 3 { 50 } else { 100 }; 3]));
        let picture = reduced(Some(&path), &photograph, [4, 2]).unwrap();
        assert!(picture.as_raw().iter().all(|v| v.abs_diff(100) <= 1), "{picture:?}");
        let error = reduced(Some(&path), &RgbImage::new(8, 8), [8, 8]).unwrap_err().to_string();
        assert!(error.contains("not the proportions"), "{error}");
    }
}
