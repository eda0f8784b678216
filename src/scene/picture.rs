//! Photographs and masks from files, whose sizes are looked at before anything is allocated for them.

use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::metadata::Orientation;
use image::{ColorType, DynamicImage, GrayImage, ImageDecoder, ImageReader, Limits, RgbImage};

use super::Error;

/// Pixels of the largest picture that is read: 16,384 x 16,384.
pub const MAX_PIXELS: u64 = 1 << 28;
/// Bytes of the largest picture once decoded: four channels of 16 bits.
const MAX_BYTES: u64 = 8 * MAX_PIXELS;
/// Bytes that one of a file can become, at most: DEFLATE makes 1,032 of one, and each bit of those may be a pixel of PNG;
/// JPEG needs a bit for a block of 8 x 8 pixels in 3 colours, which may stand for 4 x 2 such blocks; OpenEXR's methods stay
/// below DEFLATE.
pub const MOST_GROWTH: u64 = 8 * 8 * 8 * 3 * 8;

/// A picture as JPEG of a quality of 1 to 100.
///
/// # Errors
/// A picture that is larger than JPEG's 65,535 pixels a side.
pub fn jpeg(picture: &RgbImage, quality: u8) -> image::ImageResult<Vec<u8>> {
    let mut bytes = vec![];
    picture.write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, quality))?;
    Ok(bytes)
}

/// A decoder that has read the file's header, by its content, whatever its extension says.
fn open(path: &Path) -> Result<impl ImageDecoder, Error> {
    let io = |source| Error::Io { path: path.to_path_buf(), source };
    let picture = |source| Error::Picture { path: path.to_path_buf(), source };
    let invalid = |what: String| Error::File { path: path.to_path_buf(), what };
    let length = std::fs::metadata(path).map_err(io)?.len();
    let mut reader = ImageReader::open(path).map_err(io)?.with_guessed_format().map_err(io)?;
    let mut limits = Limits::default();
    limits.max_alloc = Some(MAX_BYTES);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(picture)?;
    let (w, h) = decoder.dimensions();
    let pixels = u64::from(w) * u64::from(h);
    if pixels == 0 || pixels > MAX_PIXELS {
        return Err(invalid(format!("the picture is {w}x{h}; at most {MAX_PIXELS} pixels are read, make it smaller")));
    }
    if decoder.total_bytes() > length.saturating_mul(MOST_GROWTH) {
        return Err(invalid(format!(
            "the picture is said to be {w}x{h}, which {length} bytes cannot hold; copy it again"
        )));
    }
    Ok(decoder)
}

/// Width and height of a picture, from the beginning of its file.
///
/// # Errors
/// No picture, or one that is too large to be read.
pub fn dimensions(path: &Path) -> Result<[u32; 2], Error> {
    open(path).map(|decoder| decoder.dimensions().into())
}

/// Whether the picture's EXIF data says that it is to be turned or mirrored when it is shown. It is read as it is stored.
///
/// # Errors
/// As [`dimensions`].
pub fn is_turned(path: &Path) -> Result<bool, Error> {
    let mut decoder = open(path)?;
    let orientation = decoder.orientation();
    Ok(orientation.is_ok_and(|orientation| orientation != Orientation::NoTransforms))
}

/// Decodes a picture by its content, whatever its extension says.
///
/// # Errors
/// As [`dimensions`]; a file that is cut off or damaged.
pub fn decode(path: &Path) -> Result<DynamicImage, Error> {
    DynamicImage::from_decoder(open(path)?).map_err(|source| Error::Picture { path: path.to_path_buf(), source })
}

/// A mask as 0 and 255. Object is whatever is not 0 in some colour channel; JPEG, which does not keep zeros, from 128 on.
///
/// # Errors
/// As [`decode`].
pub fn object_mask(path: &Path, invert: bool) -> Result<GrayImage, Error> {
    let image = decode(path)?;
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let lossy = extension.eq_ignore_ascii_case("jpg") || extension.eq_ignore_ascii_case("jpeg");
    let (w, h) = (image.width(), image.height());
    let (least, least_of_16) = if lossy { (128, 128 * 257) } else { (1, 1) };
    let on = |any: bool| if any != invert { 255 } else { 0 };
    let raw = by_pixel(
        &image,
        |colors| on(colors.iter().any(|v| *v >= least)),
        |colors| on(colors.iter().any(|v| *v >= least_of_16)),
    );
    Ok(GrayImage::from_raw(w, h, raw).expect("one value per pixel"))
}

/// What a picture's pixels become, by their colour channels without alpha: as they are stored, so that nothing is widened.
pub fn by_pixel<T>(image: &DynamicImage, of_8: impl Fn(&[u8]) -> T, of_16: impl Fn(&[u16]) -> T) -> Vec<T> {
    let kind = image.color();
    let channels = usize::from(kind.channel_count());
    let colors = channels - usize::from(kind.has_alpha());
    match kind {
        ColorType::L8 | ColorType::La8 | ColorType::Rgb8 | ColorType::Rgba8 => {
            image.as_bytes().chunks_exact(channels).map(|pixel| of_8(&pixel[..colors])).collect()
        }
        ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16 => {
            let samples: &[u16] = bytemuck::cast_slice(image.as_bytes());
            samples.chunks_exact(channels).map(|pixel| of_16(&pixel[..colors])).collect()
        }
        // No format that is read here has floats.
        _ => image.to_rgb16().pixels().map(|pixel| of_16(&pixel.0)).collect(),
    }
}
