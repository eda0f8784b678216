//! Captures that come with nerfstudio's `transforms.json` in place of a model.

use std::fs;

use gscream_vk::gpu::testing;
use gscream_vk::prepare::{self, Request, Step};
use gscream_vk::scene::{self, Camera, View};
use tempfile::TempDir;

use crate::prepare::{Lines, capture, prepared};

/// nerfstudio's file of these cameras.
pub(crate) fn transforms(views: &[View]) -> serde_json::Value {
    let frames: Vec<_> = views
        .iter()
        .map(|View { name, camera, .. }| {
            let r = camera.rotation.map(|row| row.map(f64::from));
            let center = camera.center();
            // Columns: right, up and backward.
            let row = |i: usize| serde_json::json!([r[0][i], -r[1][i], -r[2][i], center[i]]);
            serde_json::json!({
                "file_path": format!("./images/{name}.png"),
                "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            })
        })
        .collect();
    let Camera { focal, principal, distortion: d, size, .. } = views[0].camera;
    serde_json::json!({
        "camera_model": "OPENCV", "w": size[0], "h": size[1], "fl_x": focal[0], "fl_y": focal[1],
        "cx": principal[0], "cy": principal[1], "k1": d[0], "k2": d[1], "p1": d[2], "p2": d[3], "frames": frames,
    })
}

/// A capture without a model, and its views.
pub(crate) fn of_nerfstudio() -> (TempDir, Vec<View>) {
    let folder = capture();
    let full = scene::load(&folder.path().join("full"), &scene::Config::default()).expect("a scene");
    fs::remove_dir_all(folder.path().join("photos/sparse")).expect("a folder");
    (folder, full.train)
}

#[test]
fn cameras_of_nerfstudio_are_the_same() {
    let (folder, views) = of_nerfstudio();
    let photos = folder.path().join("photos");
    fs::write(photos.join("transforms.json"), transforms(&views).to_string()).expect("a writable folder");
    let mut request = Request::new(&photos, folder.path().join("scene"));
    request.only = vec![Step::Poses];
    let said = prepared(&request);
    assert!(said.iter().any(|line| line.contains("random points")), "{said:?}");
    let scene = scene::load(&request.out, &scene::Config::default()).expect("a scene");
    assert_eq!(scene.train.len(), views.len());
    for (view, View { name, camera, .. }) in scene.train.iter().zip(&views) {
        assert_eq!(view.name, *name);
        // Through a quaternion and back: float32 rotations are orthogonal to 1e-7.
        for point in [[0.3, 0.2, 0.9], [-0.5, 1.4, 0.1]] {
            let [a, b] = [&view.camera, camera].map(|camera| camera.project(point).expect("in front"));
            assert!((a[0] - b[0]).abs() < 1e-3 && (a[1] - b[1]).abs() < 1e-3, "{name}: {a:?} {b:?}");
        }
    }
}

/// nerfstudio's fisheyes are resampled like COLMAP's; what is neither is refused by name.
#[test]
fn fisheyes_of_nerfstudio_become_pinholes() {
    let (folder, views) = of_nerfstudio();
    let photos = folder.path().join("photos");
    let mut json = transforms(&views);
    json["camera_model"] = "OPENCV_FISHEYE".into();
    for (key, value) in [("k1", 0.02), ("k2", -0.004), ("k3", 0.001), ("k4", 0.0)] {
        json[key] = value.into();
    }
    fs::write(photos.join("transforms.json"), json.to_string()).expect("a writable folder");
    let mut request = Request::new(&photos, folder.path().join("scene"));
    request.only = vec![Step::Poses];
    let said = prepared(&request);
    let resampled = "poses: 10 photographs were resampled from OPENCV_FISHEYE to pinholes";
    assert!(said.iter().any(|line| line == resampled), "{said:?}");
    let scene = scene::load(&request.out, &scene::Config { unit: 1.0, ..Default::default() }).expect("a scene");
    let camera = views[0].camera;
    let lens = prepare::lens::Pinhole::of(scene::colmap::Lens {
        model: "OPENCV_FISHEYE",
        focal: camera.focal.map(f64::from),
        principal: camera.principal.map(f64::from),
        coefficients: std::array::from_fn(|i| [0.02, -0.004, 0.001].get(i).copied().unwrap_or(0.0)),
        size: camera.size,
    })
    .expect("a pinhole");
    for (view, before) in scene.train.iter().zip(&views) {
        assert_eq!(view.camera.distortion, [0.0; 4]);
        assert!((f64::from(view.camera.focal[0]) - lens.focal[0]).abs() < 1e-4);
        assert!(view.image == lens.photograph(&before.image) && view.image != before.image, "{}", view.name);
    }
    json["camera_model"] = "EQUIRECTANGULAR".into();
    fs::write(photos.join("transforms.json"), json.to_string()).expect("a writable folder");
    let refused = prepare::prepare(&testing::gpu(), &request, &mut Lines::default()).expect_err("no lens").to_string();
    assert!(refused.contains("camera_model is EQUIRECTANGULAR; undistort the photographs"), "{refused}");
}
