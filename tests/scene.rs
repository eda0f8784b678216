//! Reading scenes: COLMAP's files, layouts, masks, priors, and what is said when they are wrong.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::common::skip::{Lack, skip};
use gscream_vk::scene::{self, Camera, Config, Error, Note, PriorKind, Scene, synthetic};
use image::{GrayImage, Luma, Rgb, RgbImage};
use ndarray::Array2;
use tempfile::TempDir;

// ---------------------------------------------------------------- writing captures

/// (model id, name, parameters, the camera they describe for a 64 x 36 picture): fx, fy, cx, cy, k1, k2, p1, p2.
type CameraCase = (u32, &'static str, &'static [f64], [f32; 8]);

const CAMERAS: [CameraCase; 5] = [
    (0, "SIMPLE_PINHOLE", &[60.0, 31.5, 17.25], [60.0, 60.0, 31.5, 17.25, 0.0, 0.0, 0.0, 0.0]),
    (1, "PINHOLE", &[60.0, 61.0, 31.5, 17.25], [60.0, 61.0, 31.5, 17.25, 0.0, 0.0, 0.0, 0.0]),
    (2, "SIMPLE_RADIAL", &[60.0, 31.5, 17.25, 0.5], [60.0, 60.0, 31.5, 17.25, 0.5, 0.0, 0.0, 0.0]),
    (3, "RADIAL", &[60.0, 31.5, 17.25, 0.5, -0.25], [60.0, 60.0, 31.5, 17.25, 0.5, -0.25, 0.0, 0.0]),
    (
        4,
        "OPENCV",
        &[60.0, 61.0, 31.5, 17.25, 0.5, -0.25, 0.125, 0.0625],
        [60.0, 61.0, 31.5, 17.25, 0.5, -0.25, 0.125, 0.0625],
    ),
];

/// A model to write: cameras are (id, model id, width, height, parameters), images (name, camera id).
struct Colmap {
    cameras: Vec<(u32, u32, [u32; 2], Vec<f64>)>,
    images: Vec<(String, u32)>,
    points: Vec<([f64; 3], [u8; 3])>,
}

/// Rotation by 90 degrees about z, and a shift that differs per image.
fn pose(i: usize) -> ([f64; 4], [f64; 3]) {
    ([0.5f64.sqrt(), 0.0, 0.0, 0.5f64.sqrt()], [0.5 * i as f64, -0.25, 2.0])
}

impl Colmap {
    fn new(names: &[&str], size: [u32; 2]) -> Colmap {
        let [w, h] = size.map(f64::from);
        Colmap {
            cameras: vec![(1, 0, size, vec![w, w / 2.0, h / 2.0])],
            images: names.iter().map(|n| (n.to_string(), 1)).collect(),
            points: vec![([0.5, -1.5, 2.0], [1, 2, 3]), ([4.0, 5.0, 6.0], [255, 128, 0])],
        }
    }

    /// Observations and tracks of varying length are there to be skipped.
    fn binary(&self, folder: &Path) {
        fs::create_dir_all(folder).unwrap();
        let mut b = (self.cameras.len() as u64).to_le_bytes().to_vec();
        for (id, model, size, parameters) in &self.cameras {
            b.extend(id.to_le_bytes());
            b.extend(model.to_le_bytes());
            size.iter().for_each(|n| b.extend(u64::from(*n).to_le_bytes()));
            parameters.iter().for_each(|p| b.extend(p.to_le_bytes()));
        }
        fs::write(folder.join("cameras.bin"), b).unwrap();
        let mut b = (self.images.len() as u64).to_le_bytes().to_vec();
        for (i, (name, camera)) in self.images.iter().enumerate() {
            let (q, t) = pose(i);
            b.extend((i as u32 + 1).to_le_bytes());
            q.iter().chain(&t).for_each(|v| b.extend(v.to_le_bytes()));
            b.extend(camera.to_le_bytes());
            b.extend(name.as_bytes());
            b.push(0);
            b.extend((i as u64).to_le_bytes());
            (0..i).for_each(|_| b.extend([7; 24]));
        }
        fs::write(folder.join("images.bin"), b).unwrap();
        let mut b = (self.points.len() as u64).to_le_bytes().to_vec();
        for (i, (position, color)) in self.points.iter().enumerate() {
            b.extend((i as u64 + 1).to_le_bytes());
            position.iter().for_each(|v| b.extend(v.to_le_bytes()));
            b.extend(color);
            b.extend(0.5f64.to_le_bytes());
            b.extend((i as u64).to_le_bytes());
            (0..i).for_each(|_| b.extend([9; 8]));
        }
        fs::write(folder.join("points3D.bin"), b).unwrap();
    }

    fn text(&self, folder: &Path) {
        fs::create_dir_all(folder).unwrap();
        let words = |v: &[f64]| v.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        let mut s = String::from("# Camera list with one line of data per camera:\n");
        for (id, model, [w, h], parameters) in &self.cameras {
            s += &format!("{id} {} {w} {h} {}\n", CAMERAS[*model as usize].1, words(parameters));
        }
        fs::write(folder.join("cameras.txt"), s).unwrap();
        let mut s = String::from("# Image list with two lines of data per image:\n\n");
        for (i, (name, camera)) in self.images.iter().enumerate() {
            let (q, t) = pose(i);
            s += &format!("{} {} {} {camera} {name}\n{}\n", i + 1, words(&q), words(&t), "1.5 2.5 -1 ".repeat(i));
        }
        fs::write(folder.join("images.txt"), s).unwrap();
        let mut s = String::from("# 3D point list with one line of data per point:\n");
        for (i, (position, [r, g, b])) in self.points.iter().enumerate() {
            s += &format!("{} {} {r} {g} {b} 0.5{}\n", i + 1, words(position), " 1 2".repeat(i));
        }
        fs::write(folder.join("points3D.txt"), s).unwrap();
    }
}

/// A picture with a different colour everywhere.
fn picture([w, h]: [u32; 2]) -> RgbImage {
    RgbImage::from_fn(w, h, |x, y| Rgb([(3 * x) as u8, (5 * y) as u8, (x + y) as u8]))
}

/// A mask whose object, of this value, is the rectangle from a third to two thirds of each side.
fn mask([w, h]: [u32; 2], value: u8) -> GrayImage {
    GrayImage::from_fn(w, h, |x, y| Luma([if x / (w / 3) == 1 && y / (h / 3) == 1 { value } else { 0 }]))
}

/// Depth that falls from top to bottom, and a step.
fn depth([w, h]: [u32; 2]) -> Array2<f32> {
    Array2::from_shape_fn((h as usize, w as usize), |(y, x)| 9.0 - y as f32 / h as f32 - f32::from(u8::from(x > 20)))
}

fn save<P: image::PixelWithColorType>(path: PathBuf, image: &image::ImageBuffer<P, Vec<P::Subpixel>>)
where
    [P::Subpixel]: image::EncodableLayout,
{
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    image.save(path).unwrap();
}

fn save_npy<T: ndarray_npy::WritableElement>(path: PathBuf, values: &Array2<T>) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    ndarray_npy::write_npy(path, values).unwrap();
}

const SIZE: [u32; 2] = [64, 36];

/// A complete scene in the plain layout: views a, b, c; b is the reference; t is a test view.
fn plain() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    for name in ["a", "b", "c"] {
        save(at(&format!("images/{name}.png")), &picture(SIZE));
        save(at(&format!("masks/{name}.png")), &mask(SIZE, 255));
        save_npy(at(&format!("depth/{name}.npy")), &depth(SIZE));
    }
    save(at("reference/b.png"), &picture(SIZE));
    save_npy(at("reference/b.npy"), &depth(SIZE));
    save(at("test_images/t.png"), &picture(SIZE));
    save(at("test_masks/t.png"), &mask(SIZE, 255));
    Colmap::new(&["a.jpg", "b.JPG", "c.png", "t.jpeg"], SIZE).binary(&at("sparse/0"));
    dir
}

fn load(dir: &TempDir) -> Scene {
    scene::load(dir.path(), &Config::default()).unwrap()
}

/// The error of loading, as one line without the temporary folder.
fn refusal_with(dir: &TempDir, config: &Config) -> String {
    let error: Error = scene::load(dir.path(), config).expect_err("the scene should be refused");
    let text = error
        .to_string()
        .replace(&format!("{}/", dir.path().display()), "")
        .replace(&dir.path().display().to_string(), "SCENE");
    assert!(!text.contains('\n'), "one sentence: {text}");
    text
}

fn refusal(dir: &TempDir) -> String {
    refusal_with(dir, &Config::default())
}

fn has_note(scene: &Scene, part: &str) -> bool {
    scene.notes.iter().any(|n| n.contains(part))
}

macro_rules! assert_note {
    ($scene:expr, $part:expr) => {
        assert!(has_note(&$scene, $part), "no note has {:?}: {:#?}", $part, $scene.notes)
    };
}

// ---------------------------------------------------------------- COLMAP

/// Every supported camera model, binary and text, in `sparse/0` and `sparse`, with one camera per image.
#[test]
fn camera_models_round_trip() {
    for (folder, binary) in [("sparse/0", true), ("sparse/0", false), ("sparse", true), ("sparse", false)] {
        let dir = tempfile::tempdir().unwrap();
        let mut model = Colmap::new(&[], SIZE);
        model.cameras.clear();
        for (id, name, parameters, _) in CAMERAS {
            model.cameras.push((10 + id, id, SIZE, parameters.to_vec()));
            model.images.push((format!("{name}.jpg"), 10 + id));
            save(dir.path().join(format!("images/{name}.png")), &picture(SIZE));
        }
        if binary {
            model.binary(&dir.path().join(folder));
        } else {
            model.text(&dir.path().join(folder));
        }
        let scene = load(&dir);
        assert_eq!(scene.train.len(), 5);
        for (i, (_, name, _, [fx, fy, cx, cy, k1, k2, p1, p2])) in CAMERAS.iter().enumerate() {
            let view = scene.train.iter().find(|v| v.name == *name).unwrap();
            let (_, t) = pose(i);
            let wanted = Camera {
                rotation: [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
                translation: view.camera.translation,
                focal: [*fx, *fy],
                principal: [*cx, *cy],
                distortion: [*k1, *k2, *p1, *p2],
                size: SIZE,
            };
            let close = |a: f32, b: f32| (a - b).abs() < 1e-6;
            assert!((0..3).all(|k| (view.camera.translation[k] - t[k]).abs() < 1e-6), "{:?}", view.camera.translation);
            for (a, b) in view.camera.rotation.iter().flatten().zip(wanted.rotation.iter().flatten()) {
                assert!(close(*a, *b), "{:?}", view.camera.rotation);
            }
            assert_eq!(Camera { rotation: wanted.rotation, ..view.camera }, wanted);
            // By hand: R^T t for a quarter turn about z is (ty, -tx, tz).
            let center = view.camera.center().map(|v| v as f32);
            assert!(close(center[0], 0.25) && close(center[1], 0.5 * i as f32) && close(center[2], -2.0), "{center:?}");
        }
        let points: Vec<_> = scene.points.iter().map(|p| (p.position, p.color)).collect();
        assert_eq!(points, [([0.5, -1.5, 2.0], [1, 2, 3]), ([4.0, 5.0, 6.0], [255, 128, 0])]);
        // Centres lie at 0.5 i along y: the outermost is 1 from the mean.
        assert!((scene.radius - 1.1).abs() < 1e-6);
    }
}

#[test]
fn a_truncated_model_is_reported_by_byte_and_record() {
    let lengths = |file: &str| fs::metadata(plain().path().join("sparse/0").join(file)).unwrap().len();
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        for keep in 0..lengths(file) {
            let dir = plain();
            let path = dir.path().join("sparse/0").join(file);
            let bytes = fs::read(&path).unwrap();
            fs::write(&path, &bytes[..keep as usize]).unwrap();
            let text = refusal(&dir);
            assert!(text.starts_with(&format!("sparse/0/{file}: the file ends at byte {keep}, within ")), "{text}");
        }
    }
    let dir = plain();
    let path = dir.path().join("sparse/0/images.bin");
    let bytes = fs::read(&path).unwrap();
    // The second image begins at 8 + (64 + 6 + 8) = 86; its name ends at 86 + 64 + 6; it has one observation.
    fs::write(&path, &bytes[..170]).unwrap();
    insta::assert_snapshot!(refusal(&dir), @"sparse/0/images.bin: the file ends at byte 170, within image 2 of 4 (b.JPG) (the value at byte 170 is cut off); copy or export the model again");
    fs::write(&path, &bytes[..100]).unwrap();
    insta::assert_snapshot!(refusal(&dir), @"sparse/0/images.bin: the file ends at byte 100, within image 2 of 4 (the value at byte 98 is cut off); copy or export the model again");
    fs::write(&path, [&bytes[..], &[0, 0]].concat()).unwrap();
    insta::assert_snapshot!(refusal(&dir), @"sparse/0/images.bin: 2 bytes follow the last record (at byte 465); export the model again");
}

#[test]
fn other_camera_models_are_refused_by_name() {
    let dir = plain();
    let mut model = Colmap::new(&["a.jpg", "b.jpg"], SIZE);
    model.cameras[0] = (1, 5, SIZE, vec![60.0; 8]);
    model.binary(&dir.path().join("sparse/0"));
    insta::assert_snapshot!(refusal(&dir), @"sparse/0/cameras.bin: camera 1 uses OPENCV_FISHEYE; SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL and OPENCV are supported; `gscream-vk prepare` resamples the photographs of other lenses");
    model.cameras[0].1 = 77;
    model.binary(&dir.path().join("sparse/0"));
    assert!(refusal(&dir).contains("camera 1 uses model number 77"));
    let dir = plain();
    fs::remove_dir_all(dir.path().join("sparse")).unwrap();
    Colmap::new(&["a.jpg", "b.jpg"], SIZE).text(&dir.path().join("sparse"));
    fs::write(dir.path().join("sparse/cameras.txt"), "1 FOV 64 36 60 60 32 18 0.9\n").unwrap();
    assert!(refusal(&dir).starts_with("sparse/cameras.txt: camera 1 uses FOV;"));
}

#[test]
fn bad_cameras_and_poses_are_refused() {
    let with = |parameters: [f64; 3]| {
        let dir = plain();
        let mut model = Colmap::new(&["a.jpg", "b.jpg"], SIZE);
        model.cameras[0].3 = parameters.to_vec();
        model.binary(&dir.path().join("sparse/0"));
        refusal(&dir)
    };
    insta::assert_snapshot!(with([0.0, 32.0, 18.0]), @"sparse/0/cameras.bin: camera 1: the focal length is 0 x 0 pixels, it must be positive");
    assert!(with([f64::NAN, 32.0, 18.0]).contains("not a finite number"));
    let edited = |file: &str, text: &str| {
        let dir = plain();
        fs::remove_dir_all(dir.path().join("sparse")).unwrap();
        Colmap::new(&["a.jpg", "b.jpg"], SIZE).text(&dir.path().join("sparse"));
        fs::write(dir.path().join("sparse").join(file), text).unwrap();
        refusal(&dir)
    };
    insta::assert_snapshot!(edited("cameras.txt", "# comment\n1 PINHOLE 64 36 60 x 32 18\n"), @"sparse/cameras.txt:2: parameter 2 of 4 cannot be 'x'");
    insta::assert_snapshot!(edited("cameras.txt", "1 PINHOLE 64 36 60 60 32\n"), @"sparse/cameras.txt:1: the line ends before parameter 4 of 4");
    insta::assert_snapshot!(edited("cameras.txt", "1 PINHOLE 64 36 60 60 32 18 1\n"), @"sparse/cameras.txt:1: PINHOLE has 4 parameters, '1' is left over");
    insta::assert_snapshot!(edited("cameras.txt", "2 PINHOLE 64 36 60 60 32 18\n"), @"sparse/images.txt: image a.jpg uses camera 1, which sparse/cameras.txt lacks");
    insta::assert_snapshot!(edited("images.txt", "1 0 0 0 0 1 2 3 1 a.jpg\n\n"), @"sparse/images.txt:1: the pose is not a rotation and a shift");
    insta::assert_snapshot!(edited("images.txt", "1 1 0 0 0 1 2 3 1 a.jpg\n2 1 0 0 0 1 2 3 1 b.jpg\n"), @"sparse/images.txt:2: this should be the 2D points of the image above, three numbers each, or an empty line");
    insta::assert_snapshot!(edited("points3D.txt", "1 0 inf 0 0 0 0 1\n"), @"sparse/points3D.txt:1: the point is not at a finite position");
    insta::assert_snapshot!(edited("points3D.txt", "1 0 0 0 300 0 0 1\n"), @"sparse/points3D.txt:1: R cannot be '300'");
}

#[test]
fn points_come_from_a_ply_file_where_the_model_has_none() {
    let dir = plain();
    let sparse = dir.path().join("sparse/0");
    fs::remove_file(sparse.join("points3D.bin")).unwrap();
    insta::assert_snapshot!(refusal(&dir), @"sparse/0: the model has no points, and the Gaussians are built around them; export points3D.bin, .txt or .ply");
    let header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty double y\nproperty float z\n\
                  property float nx\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    fs::write(sparse.join("points3D.ply"), format!("{header}1 2 3 0 10 20 30\n4 5 6.5 0 40 50 60\n")).unwrap();
    let points: Vec<_> = load(&dir).points.iter().map(|p| (p.position, p.color)).collect();
    assert_eq!(points, [([1.0, 2.0, 3.0], [10, 20, 30]), ([4.0, 5.0, 6.5], [40, 50, 60])]);
    fs::write(sparse.join("points3D.ply"), format!("{header}1 2 3 0 10 20 30\n4 5\n")).unwrap();
    assert!(refusal(&dir).starts_with("sparse/0/points3D.ply: not a readable PLY file"));
    fs::write(sparse.join("points3D.ply"), format!("{header}1 2 3 0 10 20 30\n4 1e300 6 0 10 20 30\n")).unwrap();
    assert!(refusal(&dir).contains("vertex 1 is not at a finite position"));
}

// ---------------------------------------------------------------- the plain layout

#[test]
fn the_plain_layout_is_read() {
    let scene = load(&plain());
    assert_eq!(scene.train.iter().map(|v| v.name.as_str()).collect::<Vec<_>>(), ["a", "b", "c"]);
    assert_eq!(scene.test.iter().map(|v| v.name.as_str()).collect::<Vec<_>>(), ["t"]);
    for view in scene.train.iter().chain(&scene.test) {
        assert_eq!(view.image.as_raw(), picture(SIZE).as_raw());
        assert_eq!(view.mask.as_ref().unwrap().as_raw(), mask(SIZE, 255).as_raw());
    }
    for view in &scene.train {
        let prior = view.prior.as_ref().unwrap();
        assert_eq!((prior.kind, &prior.values), (PriorKind::Depth, &depth(SIZE).into_raw_vec_and_offset().0));
    }
    assert!(scene.test[0].prior.is_none());
    let reference = scene.references.first().unwrap();
    assert_eq!((reference.view, reference.prior.as_ref().unwrap().kind), (1, PriorKind::Depth));
    insta::assert_debug_snapshot!(scene.notes, @r#"
    [
        "plain layout: pictures in images/",
        "3 train views at 64x36, 3 masks, 3 depth priors; reference view b with depth prior; 1 test views; 2 points",
    ]
    "#);
}

#[test]
fn a_scene_may_have_several_references() {
    let dir = plain();
    save(dir.path().join("reference/a.png"), &picture(SIZE));
    let scene = load(&dir);
    let found: Vec<_> = scene.references.iter().map(|r| (r.view, r.prior.is_some())).collect();
    assert_eq!(found, [(0, false), (1, true)]);
    assert_note!(scene, "reference view a with no prior; reference view b with depth prior");
    assert_eq!(scene.reference_of(1).unwrap().view, 1);
    assert!(scene.reference_of(2).is_none());
    // Another picture is one in place of all.
    let config = Config { reference_file: "reference/a.png".into(), ..Config::default() };
    let one = scene::load(dir.path(), &config).unwrap();
    assert_eq!(one.references.iter().map(|r| r.view).collect::<Vec<_>>(), [0]);
}

#[test]
fn what_is_absent_is_said() {
    let without = |folders: &[&str]| {
        let dir = plain();
        folders.iter().for_each(|f| fs::remove_dir_all(dir.path().join(f)).unwrap());
        load(&dir)
    };
    let scene = without(&["reference"]);
    assert!(scene.references.is_empty());
    assert_note!(scene, "the hole is left unsupervised");
    let scene = without(&["masks"]);
    assert!(scene.references.is_empty() && scene.train.iter().all(|v| v.mask.is_none()));
    assert_note!(scene, "reference/b.png is not used: without masks there is no hole");
    assert_note!(scene, "no masks: every pixel is trained on");
    let scene = without(&["depth"]);
    assert!(scene.train.iter().all(|v| v.prior.is_none()) && scene.references.first().unwrap().prior.is_some());
    assert_note!(scene, "reference/b.npy is taken as depth (there is no prior of that view to compare with)");
    assert_note!(scene, "3 of 3 train views have no depth prior");
    let scene = without(&["test_images", "test_masks"]);
    assert!(scene.test.is_empty());
    assert_note!(scene, "no test views");
    let scene = without(&["masks", "depth", "reference", "test_images", "test_masks"]);
    insta::assert_debug_snapshot!(scene.notes, @r#"
    [
        "plain layout: pictures in images/",
        "1 of 4 images of the model have no picture here",
        "3 train views at 64x36; 0 test views; 2 points",
        "no masks: every pixel is trained on, as in plain Scaffold-GS",
        "no depth priors: the depth losses are off",
        "no test views: there is nothing to evaluate on (test_every holds some out)",
    ]
    "#);

    let dir = plain();
    fs::remove_file(dir.path().join("masks/a.png")).unwrap();
    fs::remove_file(dir.path().join("depth/c.npy")).unwrap();
    fs::remove_file(dir.path().join("images/c.png")).unwrap();
    fs::remove_file(dir.path().join("reference/b.npy")).unwrap();
    save(dir.path().join("images/z.png"), &picture(SIZE));
    let scene = load(&dir);
    assert_note!(scene, "1 of 2 train views have no mask and are trained on everywhere");
    assert_note!(scene, "1 of 3 train pictures are not in the model and are left out (first: z)");
    assert_note!(scene, "1 of 4 images of the model have no picture here");
    assert_note!(scene, "1 of 2 files in masks/ belong to no picture and are left out (first: c)");
    assert_note!(scene, "0 of 2 train views have no depth prior, nor has the inpainted picture");
}

#[test]
fn switches_leave_things_out() {
    let dir = plain();
    let with = |config: Config| scene::load(dir.path(), &config).unwrap();
    let scene = with(Config { masks: false, ..Config::default() });
    assert!(scene.references.is_empty() && scene.train.iter().all(|v| v.mask.is_none() && v.prior.is_some()));
    assert!(scene.test[0].mask.is_some(), "test masks are for the figures, not for training");
    assert_note!(scene, "the train masks are ignored, as configured");
    let scene = with(Config { prior_folder: "none".into(), ..Config::default() });
    assert!(scene.train.iter().all(|v| v.mask.is_some() && v.prior.is_none()));
    assert!(scene.references.first().unwrap().prior.is_none());
    let scene = with(Config { reference_file: "none".into(), ..Config::default() });
    assert!(scene.references.is_empty());
    assert_note!(scene, "the reference view is ignored, as configured");
    assert!(refusal_with(&dir, &Config { downscale: 0, ..Config::default() }).contains("downscale is 0"));
}

#[test]
fn views_are_held_out_only_where_the_layout_has_no_test_views() {
    let dir = plain();
    let names = |views: &[scene::View]| views.iter().map(|v| v.name.clone()).collect::<Vec<_>>().concat();
    let every = |n| scene::load(dir.path(), &Config { test_every: n, ..Config::default() });
    assert_eq!(names(&every(2).unwrap().test), "t");
    fs::remove_dir_all(dir.path().join("test_images")).unwrap();
    fs::remove_dir_all(dir.path().join("test_masks")).unwrap();
    let scene = every(2).unwrap();
    assert_eq!((names(&scene.train), names(&scene.test)), ("bc".into(), "a".into()));
    assert_note!(scene, "1 of 3 views are held out for testing; they show the object");
    assert_eq!(scene.train[scene.references[0].view].name, "b");
    // All but the reference, which always trains.
    let scene = every(1).unwrap();
    assert_eq!((names(&scene.train), names(&scene.test)), ("b".into(), "ac".into()));
    assert_eq!(scene.radius, 1.0);
    fs::remove_dir_all(dir.path().join("reference")).unwrap();
    let refused = every(1).expect_err("nothing is left").to_string();
    assert!(refused.contains("no view is left to train on"), "{refused}");
}

/// A second test view u, and t as the reference: its photograph, its test mask, the prior under its name.
#[test]
fn a_clean_test_view_can_be_the_reference() {
    let dir = plain();
    let at = |name: &str| dir.path().join(name);
    Colmap::new(&["a.jpg", "b.JPG", "c.png", "t.jpeg", "u.png"], SIZE).binary(&at("sparse/0"));
    let clean = RgbImage::from_pixel(SIZE[0], SIZE[1], Rgb([9, 8, 7]));
    save(at("test_images/t.png"), &clean);
    save(at("test_images/u.png"), &picture(SIZE));
    save(at("test_masks/u.png"), &mask(SIZE, 255));
    let with = |name: &str, prior: &str| Config {
        truth_reference: name.into(),
        truth_prior: prior.into(),
        ..Config::default()
    };
    let names = |views: &[scene::View]| views.iter().map(|v| v.name.clone()).collect::<Vec<_>>().concat();
    for name in ["t", "t.png"] {
        let scene = scene::load(dir.path(), &with(name, "")).unwrap();
        assert_eq!((names(&scene.train), names(&scene.test)), ("abct".into(), "u".into()));
        let reference = scene.references.first().unwrap();
        assert_eq!((reference.view, reference.prior.is_none()), (3, true));
        assert_eq!(reference.image.as_raw(), clean.as_raw());
        assert_eq!(scene.train[3].image.as_raw(), clean.as_raw());
        assert_eq!(scene.train[3].mask.as_ref().unwrap().as_raw(), mask(SIZE, 255).as_raw());
        assert!(scene.train[1].mask.is_some() && scene.train[1].prior.is_some(), "b trains as any other view");
        assert_note!(scene, "test view t is trained on as the reference: its photograph shows the truth");
        assert_note!(scene, "reference/b.png is set aside; its view trains as any other with a mask");
    }

    // Its prior: under its name, a given file, or none.
    let kind = |config: &Config| {
        scene::load(dir.path(), config).unwrap().references.remove(0).prior.map(|p| (p.kind, p.values[0]))
    };
    save_npy(at("depth/t.npy"), &Array2::from_elem((SIZE[1] as usize, SIZE[0] as usize), 3.0f32));
    save_npy(at("other_disparity.npy"), &Array2::from_elem((SIZE[1] as usize, SIZE[0] as usize), 4.0f32));
    assert_eq!(kind(&with("t", "")), Some((PriorKind::Depth, 3.0)));
    assert_eq!(kind(&with("t", "other_disparity.npy")), Some((PriorKind::Disparity, 4.0)));
    assert_eq!(kind(&with("t", at("other_disparity.npy").to_str().unwrap())), Some((PriorKind::Disparity, 4.0)));
    assert_eq!(kind(&with("t", "none")), None);
    assert!(load(&dir).test.iter().all(|v| v.prior.is_none()), "no prior is asked of a test view");
    assert!(!has_note(&load(&dir), "belong to no picture"));

    // Its mask is the train masks' equal in all that is done to them.
    let dilated = scene::load(dir.path(), &Config { dilate_masks: 2, ..with("t", "") }).unwrap();
    assert_eq!(dilated.train[3].mask, dilated.train[0].mask);
    // Without a reference the same views are tested.
    for config in [Config { reference_file: "none".into(), ..with("t", "") }, Config { masks: false, ..with("t", "") }]
    {
        let scene = scene::load(dir.path(), &config).unwrap();
        assert_eq!((names(&scene.train), names(&scene.test)), ("abc".into(), "u".into()));
        assert!(scene.references.is_empty());
        assert_note!(scene, "t is neither trained on nor tested");
    }
    // Views are not held out in the place of test views that are gone.
    fs::remove_file(at("test_images/u.png")).unwrap();
    let alone = scene::load(dir.path(), &Config { test_every: 2, ..with("t", "") }).unwrap();
    assert_eq!((names(&alone.train), names(&alone.test)), ("abct".into(), String::new()));

    let refused = |config: &Config| refusal_with(&dir, config);
    let mut all = vec![refused(&with("a", "")), refused(&with("", "other_disparity.npy"))];
    all.push(refused(&with("t", "gone.npy")));
    save(at("test_masks/t.png"), &mask(SIZE, 0));
    all.push(refused(&with("t", "")));
    fs::remove_file(at("test_masks/t.png")).unwrap();
    all.push(refused(&with("t", "")));
    fs::remove_dir_all(at("test_images")).unwrap();
    all.push(refused(&Config { test_every: 2, ..with("a", "") }));
    insta::assert_snapshot!(all.join("\n"), @"
    scene.truth_reference is a, but SCENE has only the test view t; name a test view, which shows the place without the object
    scene.truth_prior is set without scene.truth_reference; name the test view that it belongs to
    gone.npy: No such file or directory (os error 2)
    test_masks/t.png: the mask of the reference view is empty, so nothing was inpainted there; is it inverted?
    test_images/t.png: scene.truth_reference names this test view, and it has no test mask to say where the object stood
    scene.truth_reference is a, but SCENE has no test views; name a test view, which shows the place without the object
    ");
}

/// Another depth model's priors and another inpainted picture, beside the delivered ones.
#[test]
fn other_priors_and_another_reference_take_the_place_of_the_delivered() {
    let dir = plain();
    let at = |name: &str| dir.path().join(name);
    let flat = |value: f32| Array2::from_elem((SIZE[1] as usize, SIZE[0] as usize), value);
    save_npy(at("other-disparity/a.npy"), &flat(2.0));
    save_npy(at("other-disparity/reference/b.npy"), &flat(3.0));
    save_npy(at("metric/b.npy"), &flat(4.0));
    let grey = RgbImage::from_pixel(SIZE[0], SIZE[1], Rgb([5; 3]));
    save(at("lama.png"), &grey);
    save(at("lama/c.png"), &grey);
    let priors = |folder: &str| Config { prior_folder: folder.into(), ..Config::default() };
    let scene = scene::load(dir.path(), &priors("other-disparity")).unwrap();
    let prior = scene.train[0].prior.as_ref().unwrap();
    assert_eq!((prior.kind, prior.values[0]), (PriorKind::Disparity, 2.0));
    assert!(scene.train[1].prior.is_none() && scene.train[2].prior.is_none(), "no mixture of two models");
    let prior = scene.references.first().unwrap().prior.as_ref().unwrap();
    assert_eq!((prior.kind, prior.values[0]), (PriorKind::Disparity, 3.0));
    let scene = scene::load(dir.path(), &priors(at("metric").to_str().unwrap())).unwrap();
    assert_eq!(scene.train[1].prior.as_ref().unwrap().kind, PriorKind::Depth);
    assert_note!(scene, "the inpainted picture keeps its delivered prior");

    let reference = |file: &str| Config { reference_file: file.into(), ..Config::default() };
    let view = |file: &str| {
        let scene = scene::load(dir.path(), &reference(file)).unwrap();
        let reference = &scene.references[0];
        assert_eq!(reference.image.as_raw(), grey.as_raw());
        (scene.train[reference.view].name.clone(), reference.prior.is_some())
    };
    assert_eq!(view("lama.png"), ("b".into(), true), "that of the delivered reference's view");
    assert_eq!(view("lama/c.png"), ("c".into(), false), "that of the view of its name");

    let mut all = vec![refusal_with(&dir, &priors("gone"))];
    fs::create_dir(at("empty")).unwrap();
    all.push(refusal_with(&dir, &priors("empty")));
    all.push(refusal_with(&dir, &reference("gone.png")));
    all.push(refusal_with(&dir, &Config { truth_reference: "t".into(), ..reference("lama.png") }));
    fs::remove_dir_all(at("reference")).unwrap();
    all.push(refusal_with(&dir, &reference("lama.png")));
    insta::assert_snapshot!(all.join("\n"), @"
    gone: there is no such folder
    empty: no prior has the name of a train view; name them after the photographs
    gone.png: No such file or directory (os error 2)
    scene.reference_file and scene.truth_reference are both set; name one of the two
    lama.png: no train view has this name; name the inpainted picture after the view it replaces
    ");
}

/// True depth of test views: nearest of its pixels, unknown where it is not positive.
#[test]
fn true_depth_of_test_views_is_read() {
    let dir = plain();
    assert!(load(&dir).test[0].depth.is_none());
    let values = Array2::from_shape_fn((SIZE[1] as usize, SIZE[0] as usize), |(y, x)| match (x, y) {
        (0, 0) => f32::NAN,
        (1, 0) => -1.0,
        _ => (x + 100 * y) as f32,
    });
    save_npy(dir.path().join("test_depth/t.npy"), &values);
    let depth = load(&dir).test[0].depth.clone().unwrap();
    assert_eq!((depth[0], depth[1], depth[2], depth[64 + 5]), (0.0, 0.0, 2.0, 105.0));
    let half = scene::load(dir.path(), &Config { downscale: 2, ..Config::default() }).unwrap();
    assert_eq!(half.test[0].depth.as_ref().unwrap()[32 + 3], 307.0, "no mean of what lies before and behind");
    // Without a prior of its own, it is that of a clean reference.
    let config = Config { truth_reference: "t".into(), ..Config::default() };
    save_npy(dir.path().join("test_depth/t.npy"), &depth_of_one());
    let truth = scene::load(dir.path(), &config).unwrap().references.remove(0).prior.unwrap();
    assert_eq!((truth.kind, truth.values[9]), (PriorKind::Depth, 1.0));
}

fn depth_of_one() -> Array2<f32> {
    Array2::from_elem((SIZE[1] as usize, SIZE[0] as usize), 1.0)
}

#[test]
fn contradictions_are_refused() {
    let with = |change: &dyn Fn(&Path)| {
        let dir = plain();
        change(dir.path());
        refusal(&dir)
    };
    let remove = |d: &Path, f: &str| fs::remove_file(d.join(f)).unwrap();
    let mut all = Vec::new();
    all.push(with(&|d| save(d.join("masks/a.png"), &mask([64, 35], 255))));
    all.push(with(&|d| save(d.join("test_masks/t.png"), &mask([64, 37], 255))));
    all.push(with(&|d| save(d.join("masks/b.png"), &mask(SIZE, 0))));
    all.push(with(&|d| remove(d, "masks/b.png")));
    all.push(with(&|d| fs::rename(d.join("reference/b.png"), d.join("reference/x.png")).unwrap()));
    all.push(with(&|d| fs::rename(d.join("reference/b.png"), d.join("reference/t.png")).unwrap()));
    all.push(with(&|d| save(d.join("reference/b.png"), &picture([32, 18]))));
    all.push(with(&|d| save_npy(d.join("reference/b_depth.npy"), &depth(SIZE))));
    all.push(with(&|d| save(d.join("images/a.png"), &picture([36, 64]))));
    all.push(with(&|d| save(d.join("images/a.jpg"), &picture(SIZE))));
    all.push(with(&|d| fs::write(d.join("images/a.png"), b"\x89PNG\r\n\x1a\n").unwrap()));
    all.push(with(&|d| fs::write(d.join("masks/a.png"), "no picture").unwrap()));
    all.push(with(&|d| fs::create_dir(d.join("disparity")).unwrap()));
    all.push(with(&|d| fs::remove_dir_all(d.join("images")).unwrap()));
    all.push(with(&|d| fs::remove_dir_all(d.join("sparse")).unwrap()));
    all.push(with(&|d| Colmap::new(&["p.jpg", "q.jpg"], SIZE).binary(&d.join("sparse/0"))));
    all.push(with(&|d| Colmap::new(&["a.jpg", "c.jpg"], SIZE).binary(&d.join("sparse/0"))));
    all.push(with(&|d| {
        let mut model = Colmap::new(&["a.jpg", "b.jpg"], SIZE);
        model.points.clear();
        model.binary(&d.join("sparse/0"));
    }));
    insta::assert_snapshot!(all.join("\n"), @r"
    masks/a.png: the mask is 64x35 but its picture is 64x36; masks must have the size of their pictures
    test_masks/t.png: the mask is 64x37 but its picture is 64x36; masks must have the size of their pictures
    masks/b.png: the mask of the reference view is empty, so nothing was inpainted there; is it inverted?
    reference/b.png: the inpainted view has no mask; add the mask of b, or remove the picture
    reference/x.png: no train view has this name; name the inpainted picture after the view it replaces
    reference/t.png: no train view has this name; name the inpainted picture after the view it replaces
    reference/b.png: the inpainted picture is 32x18 but its view is 64x36; both must have the same size
    reference/b_depth.npy: the reference has a second prior, reference/b.npy; keep one
    images/a.png: the picture is 36x64 but its camera is 64x36, and no one scale explains both sides; was it cropped or rotated?
    images/a.jpg: images/a.png has the same name; keep one
    images/a.png: not a readable picture: unexpected end of file
    masks/a.png: not a readable picture: Format error decoding Png: Invalid PNG signature.
    SCENE: depth/ and disparity/ are both there; keep the one to train with
    SCENE: no pictures in images/; put the photographs (.jpg or .png) there, or make a scene of them: gscream-vk prepare SCENE --out SCENE
    SCENE: no COLMAP model; sparse/0/ (or sparse/) must hold cameras and images, both .bin or both .txt; gscream-vk prepare images --out SCENE makes one, where colmap is installed
    SCENE: none of the 4 pictures is in the model (pictures like a, model images like p.jpg); the names must agree up to the extension
    reference/b.png: the model has no pose for the view of this inpainted picture, or none that is near the others'
    sparse/0: the model has no points, and the Gaussians are built around them; export points3D.bin, .txt or .ply
    ");
    let gone = scene::load(Path::new("no/such/scene"), &Config::default()).expect_err("there is none").to_string();
    assert_eq!(gone, "no/such/scene: there is no such folder");
}

#[test]
fn bad_priors_are_refused() {
    let with = |change: &dyn Fn(&Path)| {
        let dir = plain();
        change(dir.path());
        refusal(&dir)
    };
    let mut bad = depth(SIZE);
    bad[[3, 5]] = f32::NEG_INFINITY;
    let mut all = vec![with(&|d| save_npy(d.join("depth/a.npy"), &bad))];
    bad[[3, 5]] = f32::INFINITY;
    all.push(with(&|d| save_npy(d.join("reference/b.npy"), &bad)));
    all.push(with(&|d| save_npy(d.join("depth/a.npy"), &depth([64, 40]))));
    all.push(with(&|d| save_npy(d.join("depth/a.npy"), &Array2::<i32>::zeros((36, 64)))));
    all.push(with(&|d| {
        ndarray_npy::write_npy(d.join("depth/a.npy"), &ndarray::Array1::<f32>::zeros(36 * 64)).unwrap()
    }));
    all.push(with(&|d| fs::write(d.join("depth/a.npy"), &fs::read(d.join("depth/b.npy")).unwrap()[..5000]).unwrap()));
    all.push(with(&|d| {
        fs::remove_file(d.join("depth/a.npy")).unwrap();
        save(d.join("depth/a.png"), &picture(SIZE));
    }));
    all.push(with(&|d| fs::write(d.join("depth/a.exr"), "x").unwrap()));
    all.push(with(&|d| {
        fs::remove_file(d.join("depth/a.npy")).unwrap();
        fs::write(d.join("depth/a.exr"), "no picture").unwrap();
    }));
    insta::assert_snapshot!(all.join("\n"), @r"
    depth/a.npy: the value at row 3, column 5 is -inf; write NaN where there is no prior
    reference/b.npy: the value at row 3, column 5 is inf; write NaN where there is no prior
    depth/a.npy: the prior is 64x40 but its picture is 64x36; their proportions must agree within 1 %
    depth/a.npy: the array's type must be float32, float64, uint8 or uint16; save it with `.astype('float32')`
    depth/a.npy: the array's shape is [2304], it must be rows x columns
    depth/a.npy: not a readable NumPy array: its header says 36 x 64 values of 4 bytes, 9216 bytes together, and 4872 follow; copy or save it again
    depth/a.png: a prior is one grey channel, this is a colour picture; save the values, not a colour map
    depth/a.exr: depth/a.npy has the same name; keep one
    depth/a.exr: not a readable OpenEXR picture: invalid: file identifier missing
    ");
}

/// NaN is where there is no prior: it stays, and counts for nothing where the map is reduced.
#[test]
fn priors_may_have_gaps() {
    let dir = plain();
    let mut map = depth(SIZE);
    for y in 0..4 {
        (0..6).for_each(|x| map[[y, x]] = f32::NAN);
    }
    map[[9, 9]] = f32::NAN;
    save_npy(dir.path().join("depth/a.npy"), &map);
    let read = |downscale| {
        let config = Config { downscale, ..Default::default() };
        scene::load(dir.path(), &config).expect("it loads").train[0].prior.clone().expect("a prior").values
    };
    let [w, _] = SIZE.map(|n| n as usize);
    let (whole, half) = (read(1), read(2));
    assert_eq!(whole.iter().filter(|v| v.is_nan()).count(), 25);
    // Of four pixels one is missing: the mean of the other three.
    let (x, y) = (4, 4);
    let others: f64 = [(8, 8), (9, 8), (8, 9)].iter().map(|(x, y)| f64::from(whole[y * w + x])).sum();
    assert!((f64::from(half[y * (w / 2) + x]) - others / 3.0).abs() < 1e-6 * others);
    assert_eq!(half.iter().filter(|v| v.is_nan()).count(), 6);
}

#[test]
fn priors_are_read_from_every_format() {
    let dir = plain();
    fs::remove_dir_all(dir.path().join("depth")).unwrap();
    let folder = dir.path().join("disparity");
    fs::create_dir(&folder).unwrap();
    let [w, h] = SIZE;
    let ramp = |x: u32, y: u32| x + 2 * y;
    let check = |dir: &TempDir, what: &str, value: &dyn Fn(u32) -> f32| {
        let scene = scene::load(dir.path(), &Config { reference_file: "none".into(), ..Config::default() }).unwrap();
        let prior = scene.train[0].prior.as_ref().unwrap();
        assert_eq!(prior.kind, PriorKind::Disparity);
        for (i, v) in prior.values.iter().enumerate() {
            let wanted = value(ramp(i as u32 % w, i as u32 / w));
            assert_eq!(*v, wanted, "{what}, pixel {i}");
        }
    };
    let npy = folder.join("a.npy");
    let array = |y: usize, x: usize| ramp(x as u32, y as u32);
    save_npy(npy.clone(), &Array2::from_shape_fn((36, 64), |(y, x)| f64::from(array(y, x)) / 3.0));
    check(&dir, "float64", &|v| (f64::from(v) / 3.0) as f32);
    save_npy(npy.clone(), &Array2::from_shape_fn((36, 64), |(y, x)| array(y, x) as u8));
    check(&dir, "uint8", &|v| v as f32);
    save_npy(npy.clone(), &Array2::from_shape_fn((36, 64), |(y, x)| 300 * array(y, x) as u16));
    check(&dir, "uint16", &|v| 300.0 * v as f32);
    // Column-major, as NumPy writes a transposed array.
    save_npy(npy.clone(), &Array2::from_shape_fn((64, 36), |(x, y)| array(y, x) as f32).reversed_axes());
    check(&dir, "Fortran order", &|v| v as f32);
    ndarray_npy::write_npy(&npy, &ndarray::Array4::from_shape_fn((1, 1, 36, 64), |(_, _, y, x)| array(y, x) as f32))
        .unwrap();
    check(&dir, "batch and channel axes", &|v| v as f32);
    fs::remove_file(&npy).unwrap();

    let png = folder.join("a.png");
    save(png.clone(), &GrayImage::from_fn(w, h, |x, y| Luma([ramp(x, y) as u8])));
    check(&dir, "8-bit PNG", &|v| v as f32 / 255.0);
    save(png.clone(), &image::ImageBuffer::from_fn(w, h, |x, y| Luma([400 * ramp(x, y) as u16])));
    check(&dir, "16-bit PNG", &|v| 400.0 * v as f32 / 65535.0);
    save(png.clone(), &RgbImage::from_fn(w, h, |x, y| Rgb([ramp(x, y) as u8; 3])));
    check(&dir, "grey RGB PNG", &|v| v as f32 / 255.0);
    fs::remove_file(&png).unwrap();

    let path = folder.join("a.exr");
    exr::prelude::write_rgb_file(&path, 64, 36, |x, y| (array(y, x) as f32 / 3.0, -1.0f32, -2.0f32)).unwrap();
    check(&dir, "EXR, R of RGB", &|v| v as f32 / 3.0);
    use exr::prelude::*;
    let channel = |name: &str, f: &dyn Fn(usize, usize) -> f32| {
        let values = (0..36).flat_map(|y| (0..64).map(move |x| (y, x))).map(|(y, x)| f(y, x)).collect();
        AnyChannel::new(Text::from(name), FlatSamples::F32(values))
    };
    let channels = [channel("A", &|_, _| 1.0), channel("Z", &|y, x| array(y, x) as f32)];
    let layer = Layer::new(
        (64, 36),
        LayerAttributes::default(),
        Encoding::FAST_LOSSLESS,
        AnyChannels::sort(channels.into_iter().collect()),
    );
    Image::from_layer(layer).write().to_file(&path).unwrap();
    check(&dir, "EXR, Z", &|v| v as f32);
}

/// Priors at a network's own resolution are brought to the picture's.
#[test]
fn priors_of_another_size_are_resampled() {
    let dir = plain();
    // 128 x 72 values of a ramp, 32 x 18 of the same.
    for (name, [w, h]) in [("a", [128, 72]), ("c", [32, 18])] {
        let ramp =
            Array2::from_shape_fn((h, w), |(y, x)| (x as f32 + 0.5) / w as f32 + 3.0 * (y as f32 + 0.5) / h as f32);
        save_npy(dir.path().join(format!("depth/{name}.npy")), &ramp);
    }
    let scene = load(&dir);
    for view in [&scene.train[0], &scene.train[2]] {
        let values = &view.prior.as_ref().unwrap().values;
        for y in 1..35 {
            for x in 1..63 {
                let exact = (x as f32 + 0.5) / 64.0 + 3.0 * (y as f32 + 0.5) / 36.0;
                // Ramps are kept by area averages and by linear interpolation; float32 values up to 4.
                assert!((values[y * 64 + x] - exact).abs() < 2e-6, "{} at {x},{y}", view.name);
            }
        }
    }
}

#[test]
fn the_kind_of_the_reference_prior_is_found() {
    let kind = |scene: &Scene| scene.references.first().unwrap().prior.as_ref().unwrap().kind;
    let with = |file: &str, values: Array2<f32>| {
        let dir = plain();
        fs::remove_file(dir.path().join("reference/b.npy")).unwrap();
        save_npy(dir.path().join("reference").join(file), &values);
        load(&dir)
    };
    // The hole differs on purpose: only pixels outside it count.
    let hole = |mut values: Array2<f32>| {
        values.indexed_iter_mut().for_each(|((y, x), v)| {
            if mask(SIZE, 1).get_pixel(x as u32, y as u32).0[0] != 0 {
                *v = -100.0 * y as f32;
            }
        });
        values
    };
    assert_eq!(kind(&with("b.npy", hole(depth(SIZE)))), PriorKind::Depth);
    let scene = with("b.npy", hole(depth(SIZE).mapv(|z| 1.0 / z)));
    assert_eq!(kind(&scene), PriorKind::Disparity);
    assert_note!(
        scene,
        "reference/b.npy is read as disparity: outside the mask it runs against the view's depth (rank correlation -1.00)"
    );
    // Said by name, whatever it looks like.
    assert_eq!(kind(&with("b_depth.npy", depth(SIZE).mapv(|z| 1.0 / z))), PriorKind::Depth);
    assert_eq!(kind(&with("b_disparity.npy", depth(SIZE))), PriorKind::Disparity);
    // Unrelated.
    let scene = with("b.npy", Array2::from_shape_fn((36, 64), |(y, x)| ((x * 37 + y * 101) % 64) as f32));
    assert_eq!(kind(&scene), PriorKind::Depth);
    assert_note!(scene, "reference/b.npy is taken as depth (it hardly resembles the view's own prior");
}

// ---------------------------------------------------------------- sizes

/// A world point projects to the same place of the picture at every size, whatever the rounding of the sides.
#[test]
fn downscaled_cameras_see_the_same() {
    for size in [[64, 36], [63, 37], [37, 63], [101, 67]] {
        let dir = tempfile::tempdir().unwrap();
        save(dir.path().join("images/a.png"), &picture(size));
        let mut model = Colmap::new(&["a.png"], size);
        model.cameras[0] = (1, 4, size, vec![70.0, 71.0, 30.25, 20.5, 0.1, -0.05, 0.01, 0.02]);
        model.binary(&dir.path().join("sparse/0"));
        let full = load(&dir).train.remove(0);
        for downscale in [2, 3, 4, 7] {
            let small = scene::load(dir.path(), &Config { downscale, ..Config::default() }).unwrap().train.remove(0);
            let to = size.map(|n| (f64::from(n) / f64::from(downscale)).round() as u32);
            assert_eq!((small.camera.size, [small.image.width(), small.image.height()]), (to, to));
            let by_hand = full.camera.scaled(to);
            for point in [[0.1, 0.2, 1.0], [-0.5, 0.3, 2.0], [0.9, -0.4, 0.5]] {
                let (a, b) = (full.camera.project(point).unwrap(), small.camera.project(point).unwrap());
                let c = by_hand.project(point).unwrap();
                for i in 0..2 {
                    let wanted = a[i] * f64::from(to[i]) / f64::from(size[i]);
                    // Float32 focal lengths and centres: 6e-8 of some 100 pixels, twice.
                    assert!((b[i] - wanted).abs() < 2e-5 && (c[i] - wanted).abs() < 2e-5, "{b:?} {c:?} {wanted}");
                }
            }
            // The picture is a ramp while nothing wraps: its area average is the ramp at the cell's centre, rounded to 8 bits,
            // but for partly covered pixels, at most a step / (8 x ratio).
            for (x, y, pixel) in small.image.enumerate_pixels() {
                for (c, (n, slope)) in [(x, 3.0), (y, 5.0)].into_iter().enumerate() {
                    let ratio = f64::from(size[c]) / f64::from(to[c]);
                    let wanted = slope * ((f64::from(n) + 0.5) * ratio - 0.5);
                    let off = (f64::from(pixel.0[c]) - wanted).abs();
                    assert!(
                        wanted > 220.0 || off < 0.5001 + slope / (8.0 * ratio),
                        "{size:?} to {to:?} at {x},{y}: {off}"
                    );
                }
            }
        }
    }
}

#[test]
fn pictures_smaller_than_the_camera_scale_it() {
    for (picture_size, camera_size, wanted) in [
        ([64, 36], [256, 144], Some("by 0.250000")),
        // 2267 / 4 rounded down, and up.
        ([100, 56], [400, 227], Some("by 0.250000")),
        ([100, 57], [400, 227], Some("by 0.250000")),
        ([256, 144], [64, 36], Some("by 4.000000")),
        ([100, 59], [400, 227], None),
        ([36, 64], [64, 36], None),
    ] {
        let dir = tempfile::tempdir().unwrap();
        save(dir.path().join("images/a.png"), &picture(picture_size));
        Colmap::new(&["a.png"], camera_size).binary(&dir.path().join("sparse/0"));
        match wanted {
            Some(note) => {
                let scene = load(&dir);
                assert_note!(scene, note);
                let camera = scene.train[0].camera;
                assert_eq!(camera.principal, picture_size.map(|n| n as f32 / 2.0));
                assert_eq!(camera.focal[0], picture_size[0] as f32);
            }
            None => assert!(refusal(&dir).contains("no one scale explains both sides")),
        }
    }
}

#[test]
fn masks_are_inverted_reduced_and_dilated() {
    let dir = plain();
    let count = |config: Config| {
        let scene = scene::load(dir.path(), &config).unwrap();
        let object = |v: &scene::View| v.mask.as_ref().unwrap().as_raw().iter().filter(|v| **v == 255).count();
        (object(&scene.train[0]), object(&scene.test[0]))
    };
    // The rectangle is columns 21..42 and rows 12..24.
    assert_eq!(count(Config::default()), (21 * 12, 21 * 12));
    assert_eq!(count(Config { invert_masks: true, ..Config::default() }), (64 * 36 - 21 * 12, 64 * 36 - 21 * 12));
    // At a quarter: columns 5..=10 touch it, rows 3..=5.
    assert_eq!(count(Config { downscale: 4, ..Config::default() }), (6 * 3, 6 * 3));
    // A disc of radius 1 adds the four sides; test masks stay.
    assert_eq!(count(Config { dilate_masks: 1, ..Config::default() }), (21 * 12 + 2 * 21 + 2 * 12, 21 * 12));
    assert_eq!(count(Config { downscale: 4, dilate_masks: 1, ..Config::default() }), (18 + 2 * 6 + 2 * 3, 18));
    let scene = scene::load(dir.path(), &Config { invert_masks: true, ..Config::default() }).unwrap();
    assert_note!(scene, "the masks cover 89 % of the pictures");

    // Object is what is not 0: value 1 in 8 and 16 bits, any channel; JPEG from the middle on.
    save(dir.path().join("masks/a.png"), &mask(SIZE, 1));
    assert_eq!(count(Config::default()).0, 21 * 12);
    let sixteen = image::ImageBuffer::from_fn(64, 36, |x, y| Luma([u16::from(mask(SIZE, 1).get_pixel(x, y).0[0])]));
    save(dir.path().join("masks/a.png"), &sixteen);
    assert_eq!(count(Config::default()).0, 21 * 12);
    save(
        dir.path().join("masks/a.png"),
        &RgbImage::from_fn(64, 36, |x, y| Rgb([0, 0, mask(SIZE, 9).get_pixel(x, y).0[0]])),
    );
    assert_eq!(count(Config::default()).0, 21 * 12);
    fs::remove_file(dir.path().join("masks/a.png")).unwrap();
    let blocks =
        GrayImage::from_fn(64, 36, |x, y| Luma([if (16..32).contains(&x) && (8..16).contains(&y) { 240 } else { 4 }]));
    save(dir.path().join("masks/a.jpg"), &blocks);
    assert_eq!(count(Config::default()).0, 16 * 8);
}

/// Pictures in folders, as rigs have them; COLMAP's own mask names; pictures whose model names carry another folder.
#[test]
fn names_match_across_folders_and_extensions() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    for name in ["left/0", "right/0"] {
        save(at(&format!("images/{name}.png")), &picture(SIZE));
        save(at(&format!("masks/{name}.jpg.png")), &mask(SIZE, 255));
    }
    save(at("images/single.png"), &picture(SIZE));
    Colmap::new(&["left/0.jpg", "right/0.jpg", "elsewhere/single.JPEG"], SIZE).binary(&at("sparse"));
    let scene = load(&dir);
    assert_eq!(scene.train.iter().map(|v| v.name.as_str()).collect::<Vec<_>>(), ["left/0", "right/0", "single"]);
    for (view, along) in scene.train.iter().zip([0.0, 0.5, 1.0]) {
        assert!((view.camera.translation[0] - along).abs() < 1e-6, "{:?}", view.camera.translation);
    }
    assert_eq!(scene.train.iter().map(|v| v.mask.is_some()).collect::<Vec<_>>(), [true, true, false]);
}

/// Two cameras of a rig number their pictures alike.
#[test]
fn a_picture_takes_no_pose_of_another_folder() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["cam0/0006", "cam0/0007", "cam1/0006", "cam1/0007"] {
        save(dir.path().join(format!("images/{name}.png")), &picture(SIZE));
    }
    Colmap::new(&["cam0/0006.jpg", "cam0/0007.jpg", "cam1/0006.jpg"], SIZE).binary(&dir.path().join("sparse"));
    let names: Vec<String> = load(&dir).train.into_iter().map(|view| view.name).collect();
    assert_eq!(names, ["cam0/0006", "cam0/0007", "cam1/0006"], "cam1/0007 has no pose of its own");
}

#[test]
fn smaller_pictures_stand_in_for_missing_ones() {
    let dir = plain();
    fs::rename(dir.path().join("images"), dir.path().join("images_4")).unwrap();
    let scene = load(&dir);
    assert_eq!(scene.train.len(), 3);
    assert_note!(scene, "plain layout: pictures in images_4/");
}

// ---------------------------------------------------------------- SPIn-NeRF and GScream

fn spin_names() -> Vec<String> {
    (0..100).map(|i| format!("2022_{:03}", 2 * i)).collect()
}

/// SPIn-NeRF's layout with small pictures and neither reference nor priors.
fn spin() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let names = spin_names();
    let at = |name: String| dir.path().join(name);
    let small = [48, 27];
    for (i, name) in names.iter().enumerate() {
        save(at(format!("images_4/{name}.png")), &picture(small));
        if i >= 40 {
            save(at(format!("images_4/label/{name}.png")), &mask(small, 1));
        } else {
            save(at(format!("images_4/test_label/out_{:05}.png", i + 1)), &mask(small, 1));
        }
    }
    let model: Vec<String> = names.iter().map(|n| format!("{n}.jpg")).collect();
    Colmap::new(&model.iter().map(String::as_str).collect::<Vec<_>>(), [192, 108]).binary(&at("sparse/0".into()));
    dir
}

#[test]
fn spin_nerfs_layout_is_found() {
    let dir = spin();
    // One test mask tells the numbering.
    save(dir.path().join("images_4/test_label/out_00003.png"), &GrayImage::from_pixel(48, 27, Luma([1])));
    let scene = load(&dir);
    let names = spin_names();
    assert_eq!(scene.test.iter().map(|v| &v.name).collect::<Vec<_>>(), names[..40].iter().collect::<Vec<_>>());
    assert_eq!(scene.train.iter().map(|v| &v.name).collect::<Vec<_>>(), names[40..].iter().collect::<Vec<_>>());
    for (i, view) in scene.train.iter().chain(&scene.test).enumerate() {
        let covered = view.mask.as_ref().unwrap().as_raw().iter().filter(|v| **v == 255).count();
        assert_eq!(covered, if i == 62 { 48 * 27 } else { 16 * 9 }, "{}", view.name);
    }
    assert!(scene.references.is_empty());
    insta::assert_debug_snapshot!(scene.notes, @r#"
    [
        "SPIn-NeRF's layout: pictures in images_4/, train masks in images_4/label/",
        "the first 40 of 100 sorted names are test views",
        "no inpainted picture of the benchmark's reference view was found (looked for reference/2022_138.png and lama_images/2022_138.png)",
        "pictures are 48x27 but the model's camera is 192x108: the camera is scaled by 0.250000",
        "60 train views at 48x27, 60 masks; 40 test views; 2 points",
        "masks but no reference view: the hole is left unsupervised",
        "no depth priors: the depth losses are off",
    ]
    "#);

    let reference = |file: &str| {
        save(dir.path().join(file), &picture([48, 27]));
        let scene = load(&dir);
        fs::remove_file(dir.path().join(file)).unwrap();
        scene.train[scene.references.first().expect(file).view].name.clone()
    };
    let wanted = &names[69];
    for file in ["images_4/reference.png", "reference.jpg"] {
        assert_eq!(&reference(file), wanted);
    }
    for folder in ["reference", "images_4/reference", "lama_images", "images_4/lama_images", "lama_output"] {
        assert_eq!(&reference(&format!("{folder}/{wanted}.png")), wanted);
    }
    assert_eq!(&reference(&format!("lama_output/{wanted}_mask.png")), wanted);
    // Another view may be inpainted, if its name says so.
    assert_eq!(&reference(&format!("reference/{}.png", names[50])), &names[50]);
}

/// Some of SPIn-NeRF's test masks have 576 rows for pictures of 567.
#[test]
fn spin_nerfs_tall_test_masks_are_resampled() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    for name in ["a", "t"] {
        save(at(&format!("images_4/{name}.png")), &picture([1008, 567]));
    }
    save(at("images_4/label/a.png"), &mask([1008, 567], 1));
    save(at("images_4/test_label/out_00001.png"), &mask([1008, 576], 1));
    Colmap::new(&["a.jpg", "t.jpg"], [4032, 2268]).binary(&at("sparse/0"));
    let scene = load(&dir);
    assert_eq!((scene.train.len(), scene.test.len()), (1, 1));
    let found = scene.test[0].mask.as_ref().unwrap();
    assert_eq!(found.as_raw(), mask([1008, 567], 255).as_raw());
    assert_note!(scene, "1 test masks are not as tall as their pictures");
    assert_note!(scene, "2 pictures instead of 100: the 1 with a train mask are train views");
    // A train mask may not, and no other size may.
    save(at("images_4/label/a.png"), &mask([1008, 576], 1));
    assert!(refusal(&dir).starts_with("images_4/label/a.png: the mask is 1008x576 but its picture is 1008x567"));
    save(at("images_4/label/a.png"), &mask([1008, 567], 1));
    save(at("images_4/test_label/out_00001.png"), &mask([1008, 570], 1));
    assert!(refusal(&dir).contains("the mask is 1008x570"));
}

#[test]
fn gscreams_copy_is_found() {
    let dir = spin();
    let names = spin_names();
    let at = |name: String| dir.path().join(name);
    fs::remove_dir_all(at("images_4/label".into())).unwrap();
    fs::remove_dir_all(at("images_4/test_label".into())).unwrap();
    fs::remove_file(at("sparse/0/points3D.bin".into())).unwrap();
    let header =
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    fs::write(at("sparse/0/points3D.ply".into()), format!("{header}1 2 3\n")).unwrap();
    for (i, name) in names.iter().enumerate() {
        if i < 40 {
            save(at(format!("images_4/mask_test/{name}.png")), &mask([48, 27], 255));
        } else {
            save(at(format!("lama_input/{name}.png")), &picture([48, 27]));
            save(at(format!("lama_input/{name}_mask.png")), &mask([48, 27], 255));
            save_npy(at(format!("marigold_output/depth_npy/{name}_pred.npy")), &depth([48, 27]));
        }
    }
    let scene = load(&dir);
    assert_eq!((scene.train.len(), scene.test.len(), scene.points.len()), (60, 40, 1));
    assert!(scene.train.iter().all(|v| v.mask.is_some() && v.prior.as_ref().unwrap().kind == PriorKind::Depth));
    assert!(scene.test.iter().all(|v| v.mask.is_some() && v.prior.is_none()));
    assert!(scene.references.is_empty());
    assert_note!(scene, "GScream's copy of SPIn-NeRF: pictures in images_4/, recognised by lama_input/");
    save(at(format!("images_4/lama_images/{}.png", names[69])), &picture([48, 27]));
    let scene = load(&dir);
    let reference = scene.references.first().unwrap();
    assert_eq!((reference.view, reference.prior.as_ref().unwrap().kind), (29, PriorKind::Depth));
    assert_note!(scene, "the reference's depth is marigold_output/depth_npy/2022_138_pred.npy");
}

// ---------------------------------------------------------------- strays

/// Adds a record to a file of the model that begins with their number.
fn add_record(path: &Path, record: &[u8]) {
    let mut bytes = fs::read(path).unwrap();
    let count = u64::from_le_bytes(bytes[..8].try_into().unwrap()) + 1;
    bytes[..8].copy_from_slice(&count.to_le_bytes());
    bytes.extend(record);
    fs::write(path, bytes).unwrap();
}

/// Registers a photograph `name` whose camera has this translation, and adds points at these places.
fn add_strays(scene: &Path, name: &str, translation: [f64; 3], points: &[[f64; 3]]) {
    let pose = [1.0, 0.0, 0.0, 0.0].into_iter().chain(translation).flat_map(f64::to_le_bytes);
    let record: Vec<u8> = 1000u32
        .to_le_bytes()
        .into_iter()
        .chain(pose)
        .chain(1u32.to_le_bytes())
        .chain(name.bytes())
        .chain([0; 9])
        .collect();
    add_record(&scene.join("sparse/0/images.bin"), &record);
    for (i, position) in points.iter().enumerate() {
        let position = position.iter().flat_map(|x| x.to_le_bytes());
        let id = (10_000 + i as u64).to_le_bytes();
        let record: Vec<u8> = id.into_iter().chain(position).chain([9; 3]).chain([0; 16]).collect();
        add_record(&scene.join("sparse/0/points3D.bin"), &record);
    }
}

/// Gives the points of a binary model without tracks those photographs, by id.
fn add_tracks(scene: &Path, of: impl Fn(usize) -> Vec<u32>) {
    let path = scene.join("sparse/0/points3D.bin");
    let old = fs::read(&path).unwrap();
    let mut new = old[..8].to_vec();
    for (i, record) in old[8..].chunks(51).enumerate() {
        let track = of(i);
        new.extend(&record[..43]);
        new.extend((track.len() as u64).to_le_bytes());
        track.iter().for_each(|id| new.extend([id.to_le_bytes(), [0; 4]].concat()));
    }
    fs::write(path, new).unwrap();
}

/// A tail of two photographs that hang on the others by five points: they and the points that only they show are left out.
#[test]
fn photographs_that_hang_on_a_few_points_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let options = synthetic::Options { seed: 3, width: 48, height: 36, train_views: 8, test_views: 0, points: 200 };
    let dir = folder.path().join("scene");
    synthetic::write(&dir, &options).unwrap();
    fs::remove_dir_all(dir.join("reference")).unwrap();
    let plain = scene::load(&dir, &Config::default()).unwrap();
    add_tracks(&dir, |i| match i {
        0..5 => (1..=8).collect(),
        5..25 => vec![7, 8],
        _ => (1..=6).collect(),
    });
    let with = scene::load(&dir, &Config::default()).unwrap();
    assert_eq!(with.train.len(), 6);
    assert_eq!(with.points.len(), 180);
    let lost = &plain.train[6].name;
    assert_note!(with, "and 1 more of 8 views: the model holds the camera to the others by a handful of points");
    assert_note!(with, "20 of 200 points are seen by such views alone, and are left out");
    assert!(!with.train.iter().any(|view| view.name == *lost), "{lost}");
    // All of them by all: nothing is said.
    add_tracks_again(&dir);
    assert_eq!(scene::load(&dir, &Config::default()).unwrap().train.len(), 8);
}

/// A model in which every photograph shows every point.
fn add_tracks_again(dir: &Path) {
    let options = synthetic::Options { seed: 3, width: 48, height: 36, train_views: 8, test_views: 0, points: 200 };
    let other = dir.with_file_name("other");
    synthetic::write(&other, &options).unwrap();
    add_tracks(&other, |_| (1..=8).collect());
    fs::copy(other.join("sparse/0/points3D.bin"), dir.join("sparse/0/points3D.bin")).unwrap();
}

#[test]
fn views_are_left_out_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let options = synthetic::Options { seed: 3, width: 48, height: 36, train_views: 6, test_views: 2, points: 200 };
    let dir = folder.path().join("scene");
    synthetic::write(&dir, &options).unwrap();
    let all = scene::load(&dir, &Config::default()).unwrap();
    let other =
        all.train.iter().position(|v| !all.references.iter().any(|r| all.train[r.view].name == v.name)).unwrap();
    let names = vec![all.train[other].name.clone(), all.test[1].name.clone()];
    let without = scene::load(&dir, &Config { leave_out: names.clone(), ..Config::default() }).unwrap();
    assert_eq!((without.train.len(), without.test.len()), (5, 1));
    assert!(!without.train.iter().chain(&without.test).any(|v| names.contains(&v.name)));
    assert_note!(without, "2 of 8 views are left out, as configured");
    let refused = |name: &str| {
        let config = Config { leave_out: vec![name.into()], ..Config::default() };
        scene::load(&dir, &config).expect_err("it must stay").to_string()
    };
    assert!(refused("nobody").contains("scene.leave_out names nobody: no view of this scene"));
    assert!(refused(&all.train[all.references[0].view].name).contains("the view of the inpainted picture"));
}

/// One camera 9e9 away and points as far, as COLMAP leaves them in one capture of two: the scene is what it is without.
#[test]
fn strays_change_nothing_but_a_line() {
    let folder = tempfile::tempdir().unwrap();
    let options = synthetic::Options { seed: 3, width: 48, height: 36, train_views: 8, test_views: 2, points: 200 };
    let dir = folder.path().join("scene");
    synthetic::write(&dir, &options).unwrap();
    let read = |config: &Config| {
        let mut scene = scene::load(&dir, config).unwrap();
        scene::condition(&mut scene, config);
        scene
    };
    let holding = Config { test_every: 3, ..Config::default() };
    let (plain, plain_held) = (read(&Config::default()), read(&holding));
    assert_eq!(plain.notes.iter().filter(|n| matches!(n, Note::Lost(_) | Note::Stray(_))).count(), 0);
    let far = [[1.5e11, -3e10, 2e9], [-2e10, 1e9, 4e11], [0.0, 0.0, -7e8]];
    add_strays(&dir, "stray.png", [9e9, 1e9, -3e9], &far);
    save(dir.join("images/stray.png"), &picture([48, 36]));
    save(dir.join("masks/stray.png"), &mask([48, 36], 255));
    for (with, without) in [(read(&Config::default()), plain), (read(&holding), plain_held)] {
        assert_eq!((with.radius, with.unit, &with.points), (without.radius, without.unit, &without.points));
        assert_eq!(scene::footprint(&with), scene::footprint(&without));
        for (a, b) in [(&with.train, &without.train), (&with.test, &without.test)] {
            let of = |views: &[scene::View]| views.iter().map(|v| (v.name.clone(), v.camera)).collect::<Vec<_>>();
            assert_eq!(of(a), of(b));
        }
        assert_note!(with, "stray of 11 views: the model has the camera where no capture has any");
        assert_note!(with, "3 of 203 points lie far beyond what the cameras can measure");
        assert_eq!(with.notes.iter().filter(|n| matches!(n, Note::Stray(_))).count(), 1);
    }
    // As a test view it judges nothing.
    fs::rename(dir.join("images/stray.png"), dir.join("test_images/stray.png")).unwrap();
    fs::rename(dir.join("masks/stray.png"), dir.join("test_masks/stray.png")).unwrap();
    assert_eq!(scene::load(&dir, &Config::default()).unwrap().test.len(), 2);
    // The inpainted picture of a stray has no place.
    fs::rename(dir.join("test_images/stray.png"), dir.join("images/stray.png")).unwrap();
    fs::rename(dir.join("test_masks/stray.png"), dir.join("masks/stray.png")).unwrap();
    fs::remove_dir_all(dir.join("reference")).unwrap();
    save(dir.join("reference/stray.png"), &picture([48, 36]));
    let refused = scene::load(&dir, &Config::default()).expect_err("a reference nowhere").to_string();
    assert!(refused.contains("has no pose for the view of this inpainted picture, or none that is near"), "{refused}");
}

// ---------------------------------------------------------------- synthetic

#[test]
fn the_synthetic_scene_is_read_by_the_same_loader() {
    let (one, two) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let options = synthetic::Options { seed: 3, width: 48, height: 37, train_views: 4, test_views: 2, points: 50 };
    for dir in [&one, &two] {
        synthetic::write(&dir.path().join("scene"), &options).unwrap();
    }
    let scene = scene::load(&one.path().join("scene"), &Config::default()).unwrap();
    assert_eq!((scene.train.len(), scene.test.len(), scene.points.len()), (4, 2, 50));
    let reference = scene.references.first().unwrap();
    assert_eq!((reference.view, reference.prior.is_some()), (2, true));
    for view in scene.train.iter().chain(&scene.test) {
        assert_eq!(view.camera.size, [48, 37]);
        assert_eq!(view.camera.distortion, [0.03, 0.0, 0.0, 0.0]);
        assert_ne!(view.camera.principal, [24.0, 18.5]);
        assert!(view.mask.as_ref().unwrap().as_raw().contains(&255));
    }
    insta::assert_debug_snapshot!(scene.notes, @r#"
    [
        "plain layout: pictures in images/",
        "4 train views at 48x37, 4 masks, 4 depth priors; reference view train_002 with depth prior; 2 test views; 50 points",
    ]
    "#);
    // The same seed gives the same bytes, another seed another scene.
    let files = |dir: &TempDir| -> Vec<(PathBuf, Vec<u8>)> {
        let (mut out, mut pending) = (Vec::new(), vec![dir.path().join("scene")]);
        while let Some(at) = pending.pop() {
            for path in fs::read_dir(at).unwrap().map(|e| e.unwrap().path()) {
                if path.is_dir() {
                    pending.push(path);
                } else {
                    out.push((path.strip_prefix(dir.path()).unwrap().to_path_buf(), fs::read(&path).unwrap()));
                }
            }
        }
        out.sort();
        out
    };
    assert!(files(&one) == files(&two), "one seed, one scene");
    let three = tempfile::tempdir().unwrap();
    synthetic::write(&three.path().join("scene"), &synthetic::Options { seed: 4, ..options.clone() }).unwrap();
    let differing = files(&one).iter().zip(&files(&three)).filter(|(a, b)| a.0 == b.0 && a.1 != b.1).count();
    // All but cameras.bin: the lens is the same.
    assert_eq!(differing, files(&one).len() - 1);

    let again = synthetic::write(&one.path().join("scene"), &options).expect_err("it is there already").to_string();
    assert!(again.ends_with("the folder is not empty; name a new one"), "{again}");
    let tiny = synthetic::write(&two.path().join("x"), &synthetic::Options { width: 8, ..options.clone() })
        .expect_err("too small");
    assert!(tiny.to_string().contains("8x37"));
    let none = synthetic::write(&two.path().join("x"), &synthetic::Options { train_views: 0, ..options })
        .expect_err("no views");
    assert!(none.to_string().contains("at least one train view"));
}

#[test]
fn settings_are_refused_if_unknown() {
    let config: Config = toml::from_str("downscale = 4\nmasks = false").unwrap();
    assert_eq!(config, Config { downscale: 4, masks: false, ..Config::default() });
    assert!(toml::from_str::<Config>("downscal = 4").unwrap_err().to_string().contains("unknown field"));
}

// ---------------------------------------------------------------- real captures

/// A real capture, or `None` with the reason said.
fn capture(name: &str) -> Option<PathBuf> {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let dir = std::env::var_os("GSCREAM_DATA").map_or(default, PathBuf::from).join(name);
    if dir.is_dir() {
        return Some(dir);
    }
    skip(Lack::Captures, &format!("no {} (GSCREAM_DATA names the folder of the captures)", dir.display()));
    None
}

/// Set for the process that does nothing else.
const ALONE: &str = "GSCREAM_TEST_ALONE";

/// Whether this test has a process of its own, whose memory is nobody else's. Where it has none it is run again in one.
fn is_alone(test: &str) -> bool {
    if std::env::var_os(ALONE).is_some() {
        return true;
    }
    let program = std::env::current_exe().expect("this program");
    let output = Command::new(program).args(["--exact", test]).env(ALONE, "1").output().expect("it starts again");
    let [out, err] = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    assert!(output.status.success() && out.contains("1 passed"), "{out}{err}");
    false
}

/// The process's largest resident size so far, in bytes, where the system tells.
fn peak_memory() -> Option<usize> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    Some(1024 * line.trim().strip_suffix(" kB")?.parse::<usize>().ok()?)
}

#[test]
fn spin_1_is_read() {
    let Some(dir) = capture("spin-1") else { return };
    if !is_alone("scene::spin_1_is_read") {
        return;
    }
    let scene = scene::load(&dir, &Config::default()).unwrap();
    assert_eq!((scene.train.len(), scene.test.len(), scene.points.len()), (60, 10, 73437));
    let reference = scene.references.first().unwrap();
    assert_eq!(scene.train[reference.view].name, "20220819_104425");
    for view in scene.train.iter().chain(&scene.test) {
        assert_eq!((view.camera.size, view.image.dimensions()), ([1008, 567], (1008, 567)));
        // 3069.17 / 4.
        assert!((view.camera.focal[0] - 767.293_5).abs() < 1e-3 && view.camera.principal == [504.0, 283.5]);
        assert!((view.camera.distortion[0] - 0.032_86).abs() < 1e-5);
        assert!(view.mask.as_ref().unwrap().as_raw().contains(&255));
    }
    assert!(scene.train.iter().all(|v| v.prior.as_ref().unwrap().kind == PriorKind::Disparity));
    // The one of the inpainted picture is depth although the views' are disparities.
    assert_eq!(reference.prior.as_ref().unwrap().kind, PriorKind::Depth);
    insta::assert_debug_snapshot!(scene.notes, @r#"
    [
        "plain layout: pictures in images/",
        "30 of 100 images of the model have no picture here",
        "pictures are 1008x567 but the model's camera is 4032x2268: the camera is scaled by 0.250000",
        "reference/20220819_104425.npy is read as depth: outside the mask it runs against the view's disparity (rank correlation -0.99)",
        "60 train views at 1008x567, 60 masks, 60 disparity priors; reference view 20220819_104425 with depth prior; 10 test views; 73437 points",
    ]
    "#);

    // The pictures as decoded: 8-bit colour and masks, float32 priors.
    let pixels = 1008 * 567;
    let held = 70 * pixels * 4 + 61 * pixels * 4;
    if let Some(peak) = peak_memory() {
        // Eight decoders at most, each with a few full-size copies of what it reads.
        assert!(peak < held + 400_000_000, "{peak} bytes at peak for a scene of {held}");
    }

    let quarter = scene::load(&dir, &Config { downscale: 4, ..Config::default() }).unwrap();
    let view = &quarter.train[quarter.references.first().unwrap().view];
    assert_eq!((view.camera.size, view.image.dimensions()), ([252, 142], (252, 142)));
    assert_eq!(view.prior.as_ref().unwrap().values.len(), 252 * 142);
    assert_eq!(quarter.radius, scene.radius);
    // Sparse points seen by a view fall into its picture: the poses, the lens and the pictures belong together.
    let inside = scene
        .points
        .iter()
        .filter_map(|p| view.camera.project(p.position.map(f64::from)))
        .filter(|[x, y]| (0.0..252.0).contains(x) && (0.0..142.0).contains(y));
    assert!(inside.count() > 73437 / 4);
}

#[test]
fn fern_is_read() {
    let Some(dir) = capture("fern") else { return };
    let scene = scene::load(&dir, &Config { test_every: 8, ..Config::default() }).unwrap();
    assert_eq!((scene.train.len(), scene.test.len(), scene.points.len()), (17, 3, 10091));
    assert!(scene.references.is_empty() && scene.train.iter().all(|v| v.mask.is_none() && v.prior.is_none()));
    insta::assert_debug_snapshot!(scene.notes, @r#"
    [
        "plain layout: pictures in images/",
        "3 of 20 views are held out for testing",
        "pictures are 504x378 but the model's camera is 4032x3024: the camera is scaled by 0.125000",
        "17 train views at 504x378; 3 test views; 10091 points",
        "no masks: every pixel is trained on, as in plain Scaffold-GS",
        "no depth priors: the depth losses are off",
    ]
    "#);
}

/// A capture as COLMAP leaves it, where it is at hand.
#[test]
fn the_bonsai_loads_as_it_comes() {
    let Some(dir) = capture("bonsai") else { return };
    let scene = scene::load(&dir, &Config { downscale: 16, ..Config::default() }).unwrap();
    assert_eq!((scene.train.len(), scene.points.len()), (62, 9_756));
    assert_note!(scene, "DSCF5698 of 83 views");
    assert_note!(scene, "DSCF5608 and 19 more of 83 views");
    assert_note!(scene, "235 of 9991 points");
    // Without the tail of wrong cameras, which reaches to 10.
    assert!((2.0..5.0).contains(&scene.radius), "{}", scene.radius);
}
