//! Numbers that are none in every kind of file and in every setting.

use std::path::{Path, PathBuf};

use gscream_vk::config::Settings;
use gscream_vk::gpu::Gpu;
use gscream_vk::model::{files, init};
use gscream_vk::scene::{self, synthetic};
use tempfile::TempDir;

use super::Case;

pub const CASES: &[Case] = &[
    Case {
        stage: "scene",
        case: "a prior (.npy float32 and float64, .exr) with a NaN, an infinity, or beyond float32",
        guarantee: "a NaN is where there is no prior; the others are refused in one sentence with the file, row and column",
        run: priors,
    },
    Case {
        stage: "scene",
        case: "COLMAP cameras, poses and points, binary and text, with a NaN, an infinity, or beyond float32",
        guarantee: "refused in one sentence with the file and the camera, image, point or line",
        run: colmap,
    },
    Case {
        stage: "model",
        case: "a NaN or an infinity in every kind of attribute of the PLY, in every tensor of the safetensors",
        guarantee: "refused in one sentence with the file and the attribute or tensor",
        run: model_files,
    },
    Case {
        stage: "settings",
        case: "every number that is a float set to NaN, infinity, minus infinity and -1; losses, rates and thresholds also 1e300; rates and epsilon also 1e-40",
        guarantee: "refused in one sentence with the key, but for what is documented to mean something: voxel <= 0 derives it, an infinite cap is none",
        run: settings,
    },
];

fn synthetic_scene() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("scene");
    let options = synthetic::Options { seed: 1, width: 32, height: 24, train_views: 3, test_views: 0, points: 60 };
    synthetic::write(&path, &options).expect("a writable folder");
    (folder, path)
}

/// The one sentence with which the scene is refused; it names the file.
fn refused(scene: &Path, file: &Path) {
    let text = match scene::load(scene, &scene::Config::default()) {
        Ok(_) => panic!("{} was read", file.display()),
        Err(error) => error.to_string(),
    };
    assert!(text.starts_with(&file.display().to_string()), "{text} does not name {}", file.display());
    assert!(!text.contains('\n') && text.len() > file.display().to_string().len() + 10, "{text}");
}

fn priors(_: &Gpu) {
    let (_keep, scene) = synthetic_scene();
    let depth = scene.join("depth");
    let file = std::fs::read_dir(&depth).expect("depth").map(|f| f.expect("a file").path()).min().expect("a prior");
    let good: ndarray::Array2<f32> = ndarray_npy::read_npy(&file).expect("a prior");
    assert!(scene::load(&scene, &scene::Config::default()).is_ok());
    let mut gap = good.clone();
    gap[[3, 5]] = f32::NAN;
    ndarray_npy::write_npy(&file, &gap).expect("writable");
    let read = scene::load(&scene, &scene::Config::default()).expect("NaN is no prior");
    let gaps = |view: &scene::View| view.prior.as_ref().map_or(0, |p| p.values.iter().filter(|v| v.is_nan()).count());
    assert_eq!(read.train.iter().map(gaps).sum::<usize>(), 1);
    for poison in [f32::INFINITY, f32::NEG_INFINITY] {
        let mut bad = good.clone();
        bad[[3, 5]] = poison;
        ndarray_npy::write_npy(&file, &bad).expect("writable");
        refused(&scene, &file);
    }
    for poison in [f64::NEG_INFINITY, 1e300] {
        let mut bad = good.mapv(f64::from);
        bad[[20, 0]] = poison;
        ndarray_npy::write_npy(&file, &bad).expect("writable");
        refused(&scene, &file);
    }
    std::fs::remove_file(&file).expect("removable");
    let file = file.with_extension("exr");
    for poison in [f32::NEG_INFINITY, f32::INFINITY] {
        let pixels = |x: usize, y: usize| {
            let v = if (x, y) == (7, 9) { poison } else { 1.0 };
            (v, v, v)
        };
        exr::prelude::write_rgb_file(&file, good.ncols(), good.nrows(), pixels).expect("writable");
        refused(&scene, &file);
    }
}

fn colmap(_: &Gpu) {
    let bad64 = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300];
    // Binary: the first record of each file, patched in place.
    let places = [
        // id, model, width, height, then the parameters
        ("cameras.bin", 8 + 4 + 4 + 8 + 8, 3),
        // id, then the quaternion and the shift
        ("images.bin", 8 + 4, 7),
        // id, then the position
        ("points3D.bin", 8 + 8, 3),
    ];
    let (_keep, scene) = synthetic_scene();
    let sparse = scene.join("sparse/0");
    for (name, first, numbers) in places {
        let file = sparse.join(name);
        let good = std::fs::read(&file).expect("readable");
        for number in 0..numbers {
            for poison in bad64 {
                let mut bytes = good.clone();
                bytes[first + 8 * number..][..8].copy_from_slice(&poison.to_le_bytes());
                std::fs::write(&file, bytes).expect("writable");
                refused(&scene, &file);
            }
        }
        std::fs::write(&file, good).expect("writable");
    }
    assert!(scene::load(&scene, &scene::Config::default()).is_ok());
    // Text, of the same model.
    let model = scene::colmap::read(&scene).expect("a model");
    let mut cameras = String::new();
    for (id, c) in &model.cameras {
        let [w, h] = c.size;
        let d = c.distortion.map(|v| v.to_string()).join(" ");
        let [fx, fy, cx, cy] = [c.focal[0], c.focal[1], c.principal[0], c.principal[1]];
        cameras += &format!("{id} OPENCV {w} {h} {fx} {fy} {cx} {cy} {d}\n");
    }
    let mut images = String::new();
    for (i, image) in model.images.iter().enumerate() {
        let [x, y, z] = image.translation;
        images += &format!("{} 1 0 0 0 {x} {y} {z} {} {}\n\n", i + 1, image.camera, image.name);
    }
    let mut points = String::new();
    for (i, p) in model.points.iter().enumerate() {
        let [x, y, z] = p.position;
        points += &format!("{} {x} {y} {z} 1 2 3 0.5\n", i + 1);
    }
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::remove_file(sparse.join(name)).expect("removable");
    }
    let files = [("cameras.txt", cameras, 4..12), ("images.txt", images, 1..8), ("points3D.txt", points, 1..4)];
    for (name, text, _) in &files {
        std::fs::write(sparse.join(name), text).expect("writable");
    }
    assert!(scene::load(&scene, &scene::Config::default()).is_ok());
    for (name, text, words) in files {
        let file = sparse.join(name);
        for word in words {
            for poison in ["nan", "inf", "-inf", "1e300", "1e999"] {
                let (line, rest) = text.split_once('\n').expect("lines");
                let mut fields: Vec<&str> = line.split(' ').collect();
                fields[word] = poison;
                std::fs::write(&file, format!("{}\n{rest}", fields.join(" "))).expect("writable");
                refused(&scene, &file);
            }
        }
        std::fs::write(&file, text).expect("writable");
    }
}

fn model_files(_: &Gpu) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let good =
        files::Anchors::new(2, vec![[0.5, 1.0, 2.0]; 3], vec![[0.1; 32]; 3], vec![0.2; 3 * 2 * 3], vec![[-1.0; 6]; 3]);
    let weights = init::weights(1, 2, true, 0.0);
    let refused = |file: &str, what: &str| {
        let text = match files::load(folder.path()) {
            Ok(_) => panic!("{what} was read"),
            Err(error) => error.to_string(),
        };
        let file = folder.path().join(file).display().to_string();
        assert!(text.starts_with(&file) && text.contains(what) && !text.contains('\n'), "{what}: {text}");
    };
    for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for attribute in ["y", "f_anchor_feat_7", "f_offset_3", "scale_5"] {
            let mut bad = good.clone();
            match attribute {
                "y" => bad.position[1][1] = poison,
                "f_anchor_feat_7" => bad.feature[1][7] = poison,
                // Component 1 of offset 1.
                "f_offset_3" => bad.offset[6 + 3 + 1] = poison,
                _ => bad.log_scaling[1][5] = poison,
            }
            files::save(folder.path(), &bad, &weights).expect("writable");
            refused(files::POINT_CLOUD, attribute);
        }
        for name in weights.tensors.keys() {
            let mut bad = weights.clone();
            let data = &mut bad.tensors.get_mut(name).expect("a tensor").data;
            let last = data.len() - 1;
            data[last] = poison;
            files::save(folder.path(), &good, &bad).expect("writable");
            refused(files::WEIGHTS, name);
        }
    }
    files::save(folder.path(), &good, &weights).expect("writable");
    assert!(files::load(folder.path()).is_ok());
}

/// Paths of all floats in the settings.
fn floats(value: &toml::Value, path: &mut Vec<String>, found: &mut Vec<Vec<String>>) {
    match value {
        toml::Value::Float(_) => found.push(path.clone()),
        toml::Value::Table(table) => {
            for (key, value) in table {
                path.push(key.clone());
                floats(value, path, found);
                path.pop();
            }
        }
        toml::Value::Array(array) => {
            for (i, value) in array.iter().enumerate() {
                path.push(i.to_string());
                floats(value, path, found);
                path.pop();
            }
        }
        _ => {}
    }
}

fn settings(_: &Gpu) {
    let default: toml::Value = toml::from_str(&Settings::default().to_toml()).expect("settings are TOML");
    let mut all = vec![];
    floats(&default, &mut vec![], &mut all);
    assert!(all.len() > 30, "{} floats", all.len());
    for path in all {
        for poison in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1.0, 1e300, 1e-40] {
            let rate = path[0] == "optimizer";
            if poison == 1e-40 && !rate {
                continue;
            }
            if poison == 1e300 && !["losses", "optimizer", "densify"].contains(&path[0].as_str()) {
                continue;
            }
            let mut changed = default.clone();
            let mut at = &mut changed;
            for key in &path {
                at = match at {
                    toml::Value::Array(array) => &mut array[key.parse::<usize>().expect("an index")],
                    other => other.get_mut(key).expect("a key"),
                };
            }
            *at = toml::Value::Float(poison);
            let settings: Settings = changed.try_into().expect("the same keys");
            let keys: Vec<&str> = path.iter().map(String::as_str).filter(|k| k.parse::<usize>().is_err()).collect();
            let key = keys.join(".");
            let means = match key.as_str() {
                "model.voxel" => poison == -1.0,
                "densify.max_log_scaling" => poison == f64::INFINITY || poison == 1e300 || poison == -1.0,
                _ => false,
            };
            match settings.validate() {
                Ok(()) => assert!(means, "{key} = {poison} was taken"),
                Err(error) => {
                    let text = error.to_string();
                    assert!(!means && text.starts_with(&format!("`{key}` is ")) && !text.contains('\n'), "{text}");
                }
            }
        }
    }
}
