//! Photographs that are there once are trained on once, and nothing is written beside the scene.

use std::fs;
use std::path::Path;

use gscream_vk::gpu::testing;
use gscream_vk::prepare::{self, Request, Silent, Step, Watch};
use gscream_vk::scene::doctor;
use serde_json::json;

use super::support::{VIEWS, copy, load, scene};

/// `ln -s PHOTOS images` typed twice puts the second link into the photographs.
#[cfg(unix)]
#[test]
fn a_link_that_points_up_multiplies_nothing() {
    use std::os::unix::fs::symlink;

    let folder = scene();
    let at = folder.path().join("scene");
    symlink(at.join("images"), at.join("images/images")).expect("a writable folder");
    // Two such links would never end.
    symlink("../images", at.join("images/again")).expect("a writable folder");
    // Neither would one to a folder that holds the photographs' own, which has more pictures than photographs.
    symlink(&at, at.join("images/scene")).expect("a writable folder");
    let scene = load(&at).expect("a scene");
    assert_eq!(scene.train.len(), VIEWS as usize, "{:?}", scene.notes);
    assert!(scene.train.iter().all(|view| view.mask.is_some()));
    for link in ["images/images", "images/again", "images/scene"] {
        let says = format!("{} is not looked into: it leads to ", at.join(link).display());
        assert!(scene.notes.iter().any(|note| note.starts_with(&says)), "{:?}", scene.notes);
    }
    let (report, _) = doctor::examine(&at, None).expect("a folder");
    let named = report.findings.iter().filter(|finding| finding.message.contains("is not looked into"));
    assert!(named.clone().count() == 3 && named.clone().all(|finding| finding.severity == doctor::Severity::Problem));
}

/// A link to photographs elsewhere is read, once: of two to one folder the first by name counts, and a real folder
/// before any link.
#[cfg(unix)]
#[test]
fn links_to_other_folders_are_followed_once() {
    use std::os::unix::fs::symlink;

    let folder = scene();
    let at = folder.path().join("scene");
    let (elsewhere, kinds) = (folder.path().join("elsewhere"), ["images", "masks", "depth"]);
    for kind in kinds {
        let inner = elsewhere.join(kind).join("inner");
        fs::create_dir_all(&inner).expect("a writable folder");
        fs::create_dir_all(at.join(kind).join("real")).expect("a writable folder");
        for entry in fs::read_dir(at.join(kind)).expect("a folder").flatten().filter(|e| e.path().is_file()) {
            let first = entry.file_name().to_string_lossy().contains("000");
            let to = if first { at.join(kind).join("real") } else { inner.clone() };
            fs::rename(entry.path(), to.join(entry.file_name())).expect("a writable folder");
        }
        for link in ["a", "b"] {
            symlink(&inner, at.join(kind).join(link)).expect("a writable folder");
        }
        symlink("real", at.join(kind).join("a real one")).expect("a writable folder");
        // The folder that holds what `a` leads to, behind which that is a real folder.
        symlink(elsewhere.join(kind), at.join(kind).join("c")).expect("a writable folder");
    }
    fs::remove_dir_all(at.join("reference")).expect("a folder");
    let scene = load(&at).expect("a scene");
    let names: Vec<&str> = scene.train.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(names, ["a/train_001", "a/train_002", "a/train_003", "real/train_000"], "{:?}", scene.notes);
    assert!(scene.train.iter().all(|view| view.mask.is_some() && view.prior.is_some()));
}

/// All files below a folder.
fn files(folder: &Path) -> Vec<String> {
    let all = walkdir::WalkDir::new(folder).sort_by_file_name().into_iter().flatten();
    let below = |path: &Path| path.strip_prefix(folder).expect("below it").display().to_string();
    all.filter(|entry| entry.path().is_file()).map(|entry| below(entry.path())).collect()
}

#[derive(Default)]
struct Lines(Vec<String>);

impl Watch for Lines {
    fn say(&mut self, line: &str) {
        self.0.push(line.to_owned());
    }
}

/// Frames of nerfstudio may lie anywhere: each becomes a view of the scene, under a name within it.
#[test]
fn frames_from_elsewhere_become_views_of_the_scene() {
    let folder = scene();
    let (at, out) = (folder.path(), folder.path().join("out/scene"));
    copy(&at.join("scene/images"), &at.join("photos"));
    fs::create_dir_all(at.join("nerf/photos")).expect("a writable folder");
    fs::create_dir_all(at.join("nerf/.hidden")).expect("a writable folder");
    let picture = |view: u32| at.join(format!("photos/train_{view:03}.png"));
    // One beside the folder, one of the same name in it, a hidden one, an absolute path; no extension that says what it is.
    fs::copy(picture(1), at.join("nerf/photos/train_000.png")).expect("a writable folder");
    fs::copy(picture(2), at.join("nerf/.hidden/two.picture")).expect("a writable folder");
    let paths = [
        "../photos/train_000.png".to_owned(),
        "photos/train_000.png".to_owned(),
        ".hidden/two.picture".to_owned(),
        picture(3).display().to_string(),
    ];
    let frame = |(i, path): (usize, &String)| {
        let pose = [[1.0, 0.0, 0.0, i as f64], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        json!({ "file_path": path, "transform_matrix": pose })
    };
    let frames: Vec<_> = paths.iter().enumerate().map(frame).collect();
    let text = json!({ "fl_x": 40.0, "frames": frames }).to_string();
    fs::write(at.join("nerf/transforms.json"), text).expect("a writable folder");
    let before = files(at);
    let mut request = Request::new(at.join("nerf"), &out);
    request.only = vec![Step::Poses];
    let mut lines = Lines::default();
    prepare::prepare(&testing::gpu(), &request, &mut lines).expect("poses");
    let new: Vec<String> = files(at).into_iter().filter(|file| !before.contains(file)).collect();
    assert!(new.iter().all(|file| file.starts_with("out/scene/")), "{new:?}");
    let scene = load(&out).expect("a scene");
    let names: Vec<&str> = scene.train.iter().map(|view| view.name.as_str()).collect();
    let absolute = at.strip_prefix("/").unwrap_or(at).join("photos/train_003").display().to_string();
    let absolute = absolute.split('/').map(|part| part.trim_start_matches('.')).collect::<Vec<_>>().join("/");
    let mut wanted = ["hidden/two.picture", "photos/train_000", "photos/train_000_2", absolute.as_str()];
    wanted.sort_unstable();
    assert_eq!(names, wanted);
    assert!(lines.0.iter().any(|line| line.contains("3 photographs lie elsewhere")), "{:?}", lines.0);
    // The names are those of last time.
    let mut lines = Lines::default();
    prepare::prepare(&testing::gpu(), &request, &mut lines).expect("poses");
    assert_eq!(lines.0, ["poses: nothing has changed"]);
}

/// A file that is no point cloud is not copied into a scene because somebody says that it is one.
#[test]
fn points_must_be_points() {
    let folder = scene();
    let at = folder.path();
    fs::write(at.join("secret"), "of mine").expect("a writable folder");
    let pose = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let frames = [json!({ "file_path": "images/train_000.png", "transform_matrix": pose })];
    let text = json!({ "fl_x": 40.0, "frames": frames, "ply_file_path": "../secret" }).to_string();
    fs::remove_dir_all(at.join("scene/sparse")).expect("a folder");
    fs::write(at.join("scene/transforms.json"), text).expect("a writable folder");
    let mut request = Request::new(at.join("scene"), at.join("out"));
    request.only = vec![Step::Poses];
    let error = prepare::prepare(&testing::gpu(), &request, &mut Silent).expect_err("no points").to_string();
    assert!(error.contains("ply_file_path is \"../secret\", which is no PLY file"), "{error}");
}
