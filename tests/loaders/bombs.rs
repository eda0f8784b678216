//! Small files that claim to be large are refused in one sentence, and before anything is allocated for them.
//!
//! Each is read by the program itself, which may have 3 GiB of address space: what would be allocated ends it otherwise.

use std::fs;
use std::io::Write as _;
use std::path::Path;
use std::process::Command;

use assert_cmd::cargo::cargo_bin;
use image::{GrayImage, ImageEncoder as _, Luma};

use super::support::scene;

/// Exit code and error of the doctor or any other command, within 3 GiB.
fn outcome(folder: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -v 3145728; exec \"$@\"", "sh"]).arg(cargo_bin!("gscream-vk")).args(arguments);
    command.current_dir(folder).env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR")).env_remove("RUST_LOG");
    let output = command.output().expect("the program starts");
    let text = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8_lossy(&text).into_owned())
}

/// What the doctor says of the scene with one file changed.
fn doctor(change: impl Fn(&Path)) -> String {
    let folder = scene();
    change(&folder.path().join("scene"));
    let (code, text) = outcome(folder.path(), &["doctor", "scene"]);
    assert_eq!(code, Some(1), "{text}");
    text
}

fn npy(shape: &str) -> Vec<u8> {
    let text = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({shape}), }}");
    let header = format!("{text:118}");
    let mut bytes = b"\x93NUMPY\x01\x00v\x00".to_vec();
    bytes.extend(header.bytes());
    bytes
}

/// A picture with a PNG's header alone and its true checksums.
fn png(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = b"\x89PNG\r\n\x1a\n".to_vec();
    let mut chunk = |kind: &[u8], data: &[u8]| {
        bytes.extend((data.len() as u32).to_be_bytes());
        let all = [kind, data].concat();
        bytes.extend(&all);
        let mut crc = flate2::Crc::new();
        crc.update(&all);
        bytes.extend(crc.sum().to_be_bytes());
    };
    chunk(b"IHDR", &[&width.to_be_bytes()[..], &height.to_be_bytes(), &[8, 2, 0, 0, 0]].concat());
    let mut packed = flate2::write::ZlibEncoder::new(vec![], flate2::Compression::best());
    packed.write_all(&[0; 1000]).expect("memory");
    chunk(b"IDAT", &packed.finish().expect("memory"));
    chunk(b"IEND", &[]);
    bytes
}

/// OpenEXR's header of one layer of one float channel, uncompressed or in ZIP blocks, and no pixels.
fn exr(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = vec![0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0];
    let mut attribute = |name: &str, kind: &str, value: &[u8]| {
        bytes.extend([name.as_bytes(), &[0], kind.as_bytes(), &[0]].concat());
        bytes.extend((value.len() as u32).to_le_bytes());
        bytes.extend(value);
    };
    let window = [0, 0, width as i32 - 1, height as i32 - 1].map(i32::to_le_bytes).concat();
    let channel = [&b"Z\0"[..], &2u32.to_le_bytes(), &[0; 4], &1u32.to_le_bytes(), &1u32.to_le_bytes(), &[0]].concat();
    attribute("channels", "chlist", &channel);
    attribute("compression", "compression", &[3]);
    attribute("dataWindow", "box2i", &window);
    attribute("displayWindow", "box2i", &window);
    attribute("lineOrder", "lineOrder", &[0]);
    attribute("pixelAspectRatio", "float", &1f32.to_le_bytes());
    attribute("screenWindowCenter", "v2f", &[0; 8]);
    attribute("screenWindowWidth", "float", &1f32.to_le_bytes());
    bytes.extend([0; 64]);
    bytes
}

fn replace(scene: &Path, old: &str, new: &str, bytes: &[u8]) {
    fs::remove_file(scene.join(old)).expect("it is there");
    fs::write(scene.join(new), bytes).expect("a writable folder");
}

#[test]
fn priors_are_not_believed() {
    let prior = "depth/train_000.npy";
    let text = doctor(|scene| replace(scene, prior, prior, &npy("1048576, 1048576")));
    assert!(text.contains("train_000.npy: the array's shape is [1048576, 1048576]; a map has 1 to"), "{text}");
    let text = doctor(|scene| replace(scene, prior, prior, &npy("10922, 16383")));
    assert!(text.contains("bytes together, and 0 follow; copy or save it again"), "{text}");
    for (size, says) in [
        ([150_000, 100_000], "the OpenEXR picture is 150000x100000; a map has 1 to"),
        ([15_000, 10_000], "the OpenEXR picture is said to be 15000x10000, which"),
        ([15_000, 15_000], "the OpenEXR picture is said to be 15000x15000, which"),
    ] {
        let text = doctor(|scene| replace(scene, prior, "depth/train_000.exr", &exr(size[0], size[1])));
        assert!(text.contains("train_000.exr: ") && text.contains(says), "{text}");
    }
    let text = doctor(|scene| replace(scene, prior, "depth/train_000.png", &png(15_000, 10_000)));
    assert!(text.contains("train_000.png: the picture is said to be 15000x10000, which"), "{text}");
}

/// A white mask of 16,000 x 16,000 pixels has 32 KB, and one that fits takes no more than a byte a pixel.
#[test]
fn masks_are_not_widened() {
    let large = GrayImage::from_pixel(16_000, 16_000, Luma([255]));
    let mut bytes = vec![];
    let encoder = image::codecs::png::PngEncoder::new(&mut bytes);
    encoder.write_image(large.as_raw(), 16_000, 16_000, image::ExtendedColorType::L8).expect("memory");
    drop(large);
    for mask in ["masks/train_000.png", "test_masks/test_000.png", "reference/train_002.png"] {
        let change = |scene: &Path| {
            let path = if mask.starts_with("reference") { reference(scene) } else { mask.to_owned() };
            replace(scene, &path, &path, &bytes);
        };
        let text = doctor(change);
        assert!(text.contains("16000x16000") && text.contains("must have the"), "{text}");
    }
    let folder = scene();
    fs::write(folder.path().join("mask.png"), &bytes).expect("a writable folder");
    let photos = folder.path().join("scene");
    fs::remove_dir_all(photos.join("masks")).expect("a folder");
    let given = ["prepare", "scene", "--out", "out", "--mask", "train_000=mask.png"];
    let (code, text) = outcome(folder.path(), &given);
    assert!(code == Some(1) && text.contains("the mask is 16000x16000 but its picture is 48x32"), "{text}");
    let given = ["prepare", "scene", "--out", "out", "--strokes", "train_000=mask.png"];
    let (code, text) = outcome(folder.path(), &given);
    assert!(code == Some(1) && text.contains("16000x16000"), "{text}");
}

/// The reference picture's path below the scene.
fn reference(scene: &Path) -> String {
    let pictures = fs::read_dir(scene.join("reference")).expect("a folder").flatten();
    let mut names = pictures.map(|e| e.file_name().into_string().expect("UTF-8")).filter(|n| n.ends_with(".png"));
    format!("reference/{}", names.next().expect("a picture"))
}

#[test]
fn photographs_are_not_believed() {
    let photograph = "images/train_000.png";
    for (size, says) in [
        ([60_000, 40_000], "the picture is 60000x40000; at most 268435456 pixels are read"),
        ([15_000, 10_000], "the picture is said to be 15000x10000, which"),
    ] {
        let text = doctor(|scene| replace(scene, photograph, photograph, &png(size[0], size[1])));
        assert!(text.contains("train_000.png: ") && text.contains(says), "{text}");
    }
}

/// Vertices without properties need no bytes, so that any number of them fits into any file.
#[test]
fn points_need_properties() {
    for (properties, says) in [
        ("", "the vertices lack x, y or z as float or double"),
        ("property uchar x\nproperty uchar y\nproperty uchar z\n", "the vertices lack x, y or z as float or double"),
        ("property float x\nproperty float y\nproperty float z\n", "not a readable PLY file"),
    ] {
        let header = "ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\n";
        let text = doctor(|scene| {
            let ply = format!("{header}{properties}end_header\n");
            replace(scene, "sparse/0/points3D.bin", "sparse/0/points3D.ply", ply.as_bytes());
        });
        assert!(text.contains("points3D.ply: ") && text.contains(says), "{text}");
    }
    let folder = scene();
    let path = folder.path().join("point_cloud.ply");
    for element in ["vertex", "other"] {
        let text = format!("ply\nformat ascii 1.0\nelement {element} 99999999999\nelement vertex 0\nend_header\n");
        fs::write(&path, text).expect("a writable folder");
        let error = gscream_vk::model::files::load_anchors(&path).expect_err("no anchors").to_string();
        let says = ["without a property", "no vertex attribute"];
        assert!(says.iter().any(|part| error.contains(part)), "{error}");
    }
}

#[test]
fn settings_have_limits() {
    let folder = scene();
    let given = ["plan", "scene", "--set", "scene.dilate_masks=4000000000"];
    let (code, text) = outcome(folder.path(), &given);
    assert!(
        code != Some(0) && text.contains("`scene.dilate_masks` is 4000000000, but must be at most 1024 pixels"),
        "{text}"
    );
}
