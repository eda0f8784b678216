//! Rendered views on disk: PNG for colour, OpenEXR for depth and transmittance.

use std::io::{self, Cursor};
use std::path::{Path, PathBuf};

use crate::{atomic, scene};
use exr::prelude::{
    AnyChannel, AnyChannels, Encoding, FlatSamples, Layer, LayerAttributes, SmallVec, WritableImage as _,
};
use image::ImageFormat;

pub use crate::render::view::to_rgb8;

/// A picture that cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("{}: the picture cannot be written: {source}", path.display())]
pub struct Error {
    /// The file.
    pub path: PathBuf,
    /// What the system or the encoder said.
    pub source: io::Error,
}

/// Where a view's file goes: `FOLDER/NAME.EXTENSION`, names with `/` into folders of their own.
pub fn path(folder: &Path, name: &str, extension: &str) -> PathBuf {
    folder.join(format!("{name}.{extension}"))
}

/// Writes [`to_rgb8`] as PNG, making the folder if it is missing. The file appears complete or not at all.
///
/// # Errors
/// A path that cannot be written.
///
/// # Panics
/// Unless there is one colour per pixel of `size` (width, height).
pub fn write_png(path: &Path, size: [u32; 2], rgb: &[[f32; 3]]) -> Result<(), Error> {
    write_rgb8(path, &to_rgb8(size, rgb))
}

/// Writes a picture as PNG, making the folder if it is missing. The file appears complete or not at all.
///
/// # Errors
/// A path that cannot be written.
pub fn write_rgb8(path: &Path, picture: &image::RgbImage) -> Result<(), Error> {
    let mut bytes = Cursor::new(Vec::new());
    let encoded = picture.write_to(&mut bytes, ImageFormat::Png).map_err(io::Error::other);
    encoded
        .and_then(|()| atomic::write_below(path, bytes.get_ref()))
        .map_err(|source| Error { path: path.to_owned(), source })
}

/// Writes a picture as JPEG, for pages, making the folder if it is missing. The file appears complete or not at all.
///
/// # Errors
/// A path that cannot be written.
pub fn write_jpeg(path: &Path, picture: &image::RgbImage) -> Result<(), Error> {
    let encoded = scene::jpeg(picture, 92).map_err(io::Error::other);
    encoded
        .and_then(|bytes| atomic::write_below(path, &bytes))
        .map_err(|source| Error { path: path.to_owned(), source })
}

/// Writes a grey picture as PNG, making the folder if it is missing. The file appears complete or not at all.
///
/// # Errors
/// A path that cannot be written.
pub fn write_mask(path: &Path, mask: &image::GrayImage) -> Result<(), Error> {
    let mut bytes = Cursor::new(Vec::new());
    let encoded = mask.write_to(&mut bytes, ImageFormat::Png).map_err(io::Error::other);
    encoded
        .and_then(|()| atomic::write_below(path, bytes.get_ref()))
        .map_err(|source| Error { path: path.to_owned(), source })
}

/// Writes an OpenEXR file with two float32 channels, making the folder if it is missing. The file appears complete or not
/// at all.
/// - `Z`: the rendered depth, the sum of z alpha T along the pixel's ray in scene units. It is not divided by the
///   coverage: Z / (1 - T) is the mean depth of what was hit.
/// - `T`: the transmittance left behind the last Gaussian, 1 where nothing was drawn.
///
/// # Errors
/// A path that cannot be written.
///
/// # Panics
/// Unless there is one depth and one transmittance per pixel of `size` (width, height).
pub fn write_exr(path: &Path, size: [u32; 2], depth: &[f32], transmittance: &[f32]) -> Result<(), Error> {
    let size = size.map(|side| side as usize);
    assert!(depth.len() == size[0] * size[1] && depth.len() == transmittance.len(), "one value of each per pixel");
    let channel = |name, values: &[f32]| AnyChannel::new(name, FlatSamples::F32(values.to_vec()));
    let channels: SmallVec<[_; 4]> = [channel("T", transmittance), channel("Z", depth)].into_iter().collect();
    let layer = Layer::new(
        (size[0], size[1]),
        LayerAttributes::default(),
        Encoding::SMALL_LOSSLESS,
        AnyChannels::sort(channels),
    );
    let mut bytes = Cursor::new(Vec::new());
    let encoded = exr::prelude::Image::from_layer(layer).write().to_buffered(&mut bytes).map_err(io::Error::other);
    encoded
        .and_then(|()| atomic::write_below(path, bytes.get_ref()))
        .map_err(|source| Error { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_clamped_and_rounded() {
        let image = to_rgb8([2, 1], &[[-1.0, 0.5, 2.0], [f32::NAN, 1.0 / 255.0, 0.998]]);
        assert_eq!(image.as_raw(), &[0, 128, 255, 0, 1, 254]);
    }

    #[test]
    fn exr_keeps_every_bit_under_its_channels_name() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = path(folder.path(), "left/view 1", "exr");
        let depth: Vec<f32> = (0..35).map(|i| (i as f32 * 0.37).exp()).collect();
        let transmittance: Vec<f32> = (0..35).map(|i| 1.0 / (1.0 + i as f32)).collect();
        write_exr(&path, [7, 5], &depth, &transmittance).expect("a writable folder");
        let image = exr::prelude::read_all_flat_layers_from_file(&path).expect("a readable file");
        let layer = &image.layer_data[0];
        assert_eq!((layer.size.0, layer.size.1), (7, 5));
        let channels: Vec<(String, Vec<f32>)> = layer
            .channel_data
            .list
            .iter()
            .map(|c| (c.name.to_string(), c.sample_data.values_as_f32().collect()))
            .collect();
        assert_eq!(channels, [("T".to_owned(), transmittance), ("Z".to_owned(), depth)]);
    }
}
