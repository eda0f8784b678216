//! Whole files to begin with: small ones of the program's own making.

use std::fs;
use std::io::{Cursor, Read as _, Write as _};
use std::path::PathBuf;

use exr::prelude::WritableImage as _;
use gscream_vk::export::Cloud;
use gscream_vk::math::harmonics::coefficients;
use gscream_vk::scene::synthetic;
use image::{DynamicImage, ImageFormat};
use tempfile::TempDir;

/// Width and height of all pictures.
pub const SIZE: [u32; 2] = [24, 16];

/// A synthetic scene of its own for each caller.
pub fn scene() -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let [width, height] = SIZE;
    let options = synthetic::Options { seed: 1, width, height, train_views: 3, test_views: 1, points: 12 };
    synthetic::write(folder.path(), &options).expect("a writable folder");
    folder
}

pub fn read(path: PathBuf) -> Vec<u8> {
    fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The model as lines of text: cameras of all models that are projected with, images and points.
pub fn text_model() -> [(&'static str, String); 3] {
    let cameras = "# id model width height\n1 OPENCV 24 16 20 20 12 8 0.1 0.01 0 0\n2 PINHOLE 24 16 20 20 12 8\n\
                   3 SIMPLE_RADIAL 24 16 20 12 8 0.01\n";
    let images = "# two lines each\n1 1 0 0 0 0 0 0 1 train_000.png\n1.5 2 -1 3 4 1\n2 0.9 0.1 0 0 1 0 0.5 2 train_001.png\n\n\
                  3 1 0 0.1 0 -1 0 0 3 train 002.png\n\n";
    let points = "# points\n1 0 0 4 255 0 9 0.5 1 0\n2 1 -0.5 5 1 2 3 0.1\n3 -1e-3 2 6.25 0 0 0 1 2 3 4 5\n";
    [("cameras.txt", cameras.into()), ("images.txt", images.into()), ("points3D.txt", points.into())]
}

/// Point clouds as text and in both byte orders, one with elements and properties that are passed over.
pub fn point_clouds() -> Vec<Vec<u8>> {
    let properties =
        "property float x\nproperty float y\nproperty double z\nproperty uchar red\nproperty list uchar int more\n";
    let header =
        |format: &str| format!("ply\nformat {format} 1.0\ncomment a\nelement vertex 2\n{properties}end_header\n");
    let mut all = vec![(header("ascii") + "1 2 3 255 2 7 8\n4 5 6.5 0 0\n").into_bytes()];
    for little in [true, false] {
        let mut bytes = header(if little { "binary_little_endian" } else { "binary_big_endian" }).into_bytes();
        for i in 0..2u8 {
            let floats = [f32::from(i), 2.0].map(|v| if little { v.to_le_bytes() } else { v.to_be_bytes() });
            bytes.extend(floats.concat());
            bytes.extend(if little { 3f64.to_le_bytes() } else { 3f64.to_be_bytes() });
            bytes.extend([9, 1]);
            bytes.extend(if little { 5i32.to_le_bytes() } else { 5i32.to_be_bytes() });
        }
        all.push(bytes);
    }
    all
}

/// Maps of every type and layout that is read.
pub fn npys() -> Vec<Vec<u8>> {
    let [w, h] = SIZE.map(|n| n as usize);
    let value = |at: usize| 1.0 + (at % 7) as f32;
    let write = |descr: &str, fortran: &str, shape: String, bytes: Vec<u8>| {
        let text = format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': ({shape}), }}\n");
        let mut out = b"\x93NUMPY\x01\x00".to_vec();
        out.extend((text.len() as u16).to_le_bytes());
        out.extend(text.bytes());
        out.extend(bytes);
        out
    };
    let of = |bytes: &dyn Fn(f32) -> Vec<u8>| (0..w * h).flat_map(|at| bytes(value(at))).collect::<Vec<u8>>();
    vec![
        write("<f4", "False", format!("{h}, {w}"), of(&|v| v.to_le_bytes().to_vec())),
        write(">f8", "True", format!("1, {h}, {w}"), of(&|v| f64::from(v).to_be_bytes().to_vec())),
        write("<u2", "False", format!("{h}, {w}, 1"), of(&|v| (v as u16).to_le_bytes().to_vec())),
        write("|u1", "False", format!("{h}, {w}"), of(&|v| vec![v as u8])),
    ]
}

/// A channel or several, in each method of compression that is made without loss.
pub fn exrs() -> Vec<Vec<u8>> {
    use exr::prelude::{AnyChannel, AnyChannels, Compression, Encoding, FlatSamples, Image, Layer, LayerAttributes};
    let [w, h] = SIZE.map(|n| n as usize);
    let samples: Vec<f32> = (0..w * h).map(|at| 1.0 + (at % 5) as f32).collect();
    let methods =
        [Compression::Uncompressed, Compression::RLE, Compression::ZIP1, Compression::ZIP16, Compression::PIZ];
    let of = |method: Compression| {
        let channel = |name: &str| AnyChannel::new(name, FlatSamples::F32(samples.clone()));
        let half = samples.iter().map(|v| exr::prelude::f16::from_f32(*v)).collect();
        let list = [channel("Z"), AnyChannel::new("R", FlatSamples::F16(half))].into_iter().collect();
        let encoding = Encoding { compression: method, ..Encoding::FAST_LOSSLESS };
        let layer = Layer::new((w, h), LayerAttributes::default(), encoding, AnyChannels::sort(list));
        let mut bytes = Cursor::new(vec![]);
        Image::from_layer(layer).write().to_buffered(&mut bytes).expect("memory");
        bytes.into_inner()
    };
    methods.into_iter().map(of).collect()
}

/// A picture of every kind of pixel that PNG has, and of JPEG's two.
pub fn pictures(format: ImageFormat) -> Vec<Vec<u8>> {
    let rgb = image::RgbImage::from_fn(SIZE[0], SIZE[1], |x, y| image::Rgb([(x * 9) as u8, (y * 5) as u8, 200]));
    let rgb = DynamicImage::ImageRgb8(rgb);
    let grey = DynamicImage::ImageLuma8(rgb.to_luma8());
    let mut kinds = vec![rgb.clone(), grey.clone()];
    if format == ImageFormat::Png {
        let sixteen = DynamicImage::ImageLuma16(rgb.to_luma16());
        kinds.extend([
            DynamicImage::ImageRgba16(rgb.to_rgba16()),
            DynamicImage::ImageLumaA8(rgb.to_luma_alpha8()),
            sixteen,
        ]);
    }
    let encode = |picture: DynamicImage| {
        let mut bytes = Cursor::new(vec![]);
        picture.write_to(&mut bytes, format).expect("memory");
        bytes.into_inner()
    };
    kinds.into_iter().map(encode).collect()
}

/// A PNG whose checksums are those of its chunks again, as far as it has chunks.
pub fn with_checksums(mut bytes: Vec<u8>) -> Vec<u8> {
    let mut at = 8;
    while let Some(length) = bytes.get(at..at + 4).and_then(|b| <[u8; 4]>::try_from(b).ok()) {
        let end = at + 8 + u32::from_be_bytes(length) as usize;
        if end + 4 > bytes.len() {
            break;
        }
        let mut crc = flate2::Crc::new();
        crc.update(&bytes[at + 4..end]);
        bytes[end..end + 4].copy_from_slice(&crc.sum().to_be_bytes());
        at = end + 4;
    }
    bytes
}

/// A zip of stored files whose checksums are those of what they hold, as far as its records reach.
pub fn with_zip_checksums(mut bytes: Vec<u8>) -> Vec<u8> {
    let number = |bytes: &[u8], at: usize| -> Option<usize> {
        let four = <[u8; 4]>::try_from(bytes.get(at..at + 4)?).ok()?;
        Some(u32::from_le_bytes(four) as usize)
    };
    let length = |bytes: &[u8], at: usize| Some(usize::from(*bytes.get(at)?) + 256 * usize::from(*bytes.get(at + 1)?));
    let mut at = 0;
    while bytes.get(at..at + 4) == Some(b"PK\x03\x04".as_slice()) {
        let (Some(size), Some(name), Some(extra)) =
            (number(&bytes, at + 18), length(&bytes, at + 26), length(&bytes, at + 28))
        else {
            break;
        };
        let first = at + 30 + name + extra;
        let Some(held) = bytes.get(first..first + size) else { break };
        let mut crc = flate2::Crc::new();
        crc.update(held);
        let sum = crc.sum().to_le_bytes();
        bytes[at + 14..at + 18].copy_from_slice(&sum);
        // The directory at the end has it again, where it says that the file begins here.
        let own = (first..bytes.len().saturating_sub(46))
            .find(|entry| bytes[*entry..].starts_with(b"PK\x01\x02") && number(&bytes, entry + 42) == Some(at));
        if let Some(entry) = own {
            bytes[entry + 16..entry + 20].copy_from_slice(&sum);
        }
        at = first + size;
    }
    bytes
}

pub fn cloud(degree: u32) -> Cloud {
    let n = 3;
    Cloud {
        position: (0..n).map(|i| [i as f32, -1.0, 2.5]).collect(),
        log_scale: vec![[-2.0, -3.0, -1.5]; n],
        rotation: vec![[1.0, 0.0, 0.0, 0.0]; n],
        logit: vec![0.5; n],
        degree,
        harmonics: vec![[0.25, -0.5, 0.125]; n * coefficients(degree)],
        antialiased: false,
    }
}

pub fn gunzip(bytes: &[u8]) -> Vec<u8> {
    let mut raw = vec![];
    flate2::read::GzDecoder::new(bytes).read_to_end(&mut raw).expect("gzip");
    raw
}

pub fn gzip(raw: Vec<u8>) -> Vec<u8> {
    let mut packed = flate2::write::GzEncoder::new(vec![], flate2::Compression::fast());
    packed.write_all(&raw).expect("memory");
    packed.finish().expect("memory")
}

/// A checkpoint with the hash of what it holds now, if it is a safetensors file still: blake3 over the metadata but for the
/// hash and over each tensor, every part behind its length.
pub fn with_digest(mut bytes: Vec<u8>) -> Vec<u8> {
    use safetensors::SafeTensors;
    let Ok((_, header)) = SafeTensors::read_metadata(&bytes) else { return bytes };
    let Ok(tensors) = SafeTensors::deserialize(&bytes) else { return bytes };
    let metadata = header.metadata().clone().unwrap_or_default();
    let Some(old) = metadata.get("digest").cloned() else { return bytes };
    let mut hasher = blake3::Hasher::new();
    let mut update = |part: &[u8]| {
        hasher.update(&(part.len() as u64).to_le_bytes());
        hasher.update(part);
    };
    let mut entries: Vec<_> = metadata.iter().filter(|(key, _)| *key != "digest").collect();
    entries.sort();
    for (key, value) in entries {
        update(key.as_bytes());
        update(value.as_bytes());
    }
    let mut named = tensors.tensors();
    named.sort_unstable_by(|a, b| a.0.cmp(&b.0));
    for (name, view) in named {
        update(format!("{name} {:?} {:?}", view.dtype(), view.shape()).as_bytes());
        update(view.data());
    }
    let new = hasher.finalize().to_hex().to_string();
    let place = bytes.windows(old.len()).position(|part| part == old.as_bytes());
    if let Some(at) = place.filter(|_| old.len() == new.len()) {
        bytes[at..at + new.len()].copy_from_slice(new.as_bytes());
    }
    bytes
}

/// SuperSplat's compressed PLY of three Gaussians of degree 1.
pub fn compressed_splat() -> Vec<u8> {
    let mut head = String::from("ply\nformat binary_little_endian 1.0\nelement chunk 1\n");
    for stem in ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"] {
        head += &format!("property float min_{stem}\nproperty float max_{stem}\n");
    }
    head += "element vertex 3\n";
    ["position", "rotation", "scale", "color"].iter().for_each(|n| head += &format!("property uint packed_{n}\n"));
    head += "element sh 3\n";
    (0..9).for_each(|i| head += &format!("property uchar f_rest_{i}\n"));
    let mut bytes = (head + "end_header\n").into_bytes();
    (0..9).for_each(|_| [0f32, 1.0].iter().for_each(|v| bytes.extend(v.to_le_bytes())));
    (0..12u32).for_each(|i| bytes.extend(i.wrapping_mul(0x9e37_79b9).to_le_bytes()));
    bytes.extend([128; 27]);
    bytes
}

/// The cameras that 3DGS writes.
pub fn cameras_json() -> Vec<u8> {
    let entry = |id: usize| {
        format!(
            r#"{{"id": {id}, "img_name": "a{id}", "width": 64, "height": 48, "position": [{id}.5, 0.0, -2.0], "rotation":
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "fy": 60.0, "fx": 60.0}}"#
        )
    };
    format!("[{}]", (0..3).map(entry).collect::<Vec<_>>().join(",")).into_bytes()
}

/// What `export` writes of its cameras, which a splat comes with as well.
pub fn export_json() -> Vec<u8> {
    let camera = |id: usize| {
        format!(
            r#"{{"name": "a{id}.png", "center": [{id}.5, 0.0, -2.0], "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0],
            [0.0, 0.0, 1.0]], "fov": 60.0, "size": [64, 48], "principal": [0.5, 0.5]}}"#
        )
    };
    format!("{{\"cameras\": [{}]}}", (0..3).map(camera).collect::<Vec<_>>().join(",")).into_bytes()
}
