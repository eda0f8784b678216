//! Made objects in scenes whose depth is known, and in a capture of which only photographs and a model are.

use std::fs;
use std::path::{Path, PathBuf};

use glam::{DVec3, dvec3};
use gscream_vk::compose::{self, Drawn, Kind, Object, Placed, Request, Stand};
use gscream_vk::gpu::testing;
use gscream_vk::multiview::DepthGrid;
use gscream_vk::scene::doctor;
use gscream_vk::scene::{self, Scene, View, synthetic};
use tempfile::TempDir;

fn built_in(folder: &TempDir, options: &synthetic::Options) -> Scene {
    let dir = folder.path().join("full");
    synthetic::write(&dir, options).expect("a writable folder");
    scene::load(&dir, &scene::Config::default()).expect("it loads")
}

/// The true depth of a test view, at every pixel of the view without its lens.
fn true_grid(view: &View) -> DepthGrid {
    let [columns, rows] = view.camera.size;
    let camera = scene::Camera { distortion: [0.0; 4], ..view.camera };
    let truth = view.depth.as_ref().expect("a test view");
    let sites = (columns * rows) as usize;
    let (depth, colors) = (vec![f64::NAN; sites], vec![[0; 3]; sites]);
    let mut grid =
        DepthGrid { camera, stride: 1, columns, rows, depth, confirmed: vec![true; sites], colors, trusted: true };
    for (x, y) in (0..rows).flat_map(|y| (0..columns).map(move |x| (x, y))) {
        let site = (y * columns + x) as usize;
        let [u, v] = view.camera.project(view.camera.along(grid.ray([x, y]), 1.0)).expect("ahead");
        if u >= 0.0 && v >= 0.0 && u < f64::from(columns) && v < f64::from(rows) {
            let at = v as u32 * columns + u as u32;
            grid.depth[site] = f64::from(truth[at as usize]);
            grid.colors[site] = view.image.get_pixel(u as u32, v as u32).0;
        }
    }
    grid
}

/// Stands on the built-in room's floor, where the bench hides it from the left.
fn behind_the_bench(kind: Kind) -> Placed {
    let stand = Stand { foot: dvec3(0.62, 2.45, 0.0), up: DVec3::Z, height: 0.5, roughness: 0.0, steep: false };
    Placed::new(Object::new(kind, 3), stand, 0.4)
}

fn drawn(placed: &Placed, view: &View, shadow: bool) -> Drawn {
    compose::draw(placed, &view.camera, &true_grid(view), &view.image, 1.0, shadow)
}

#[test]
fn the_object_is_hidden_where_something_stands_before_it() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = built_in(&folder, &synthetic::Options { train_views: 1, test_views: 8, ..Default::default() });
    let placed = behind_the_bench(Kind::Sphere);
    let (mut shown, mut hidden, mut wrong, mut views) = (0, 0, 0, 0);
    for view in &scene.test {
        let [w, h] = view.camera.size;
        let truth = view.depth.as_ref().expect("a test view");
        let drawn = drawn(&placed, view, false);
        // The first surface at a pixel's centre: 0 the scene, 1 the object, 2 the scene before the object.
        let first = |x: u32, y: u32| {
            let pixel = [f64::from(x) + 0.5, f64::from(y) + 0.5];
            let Some((_, z)) = placed.meet(&view.camera, pixel) else { return 0 };
            if z < f64::from(truth[(y * w + x) as usize]) { 1 } else { 2 }
        };
        let firsts: Vec<u8> = (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).map(|(x, y)| first(x, y)).collect();
        let of = |what| firsts.iter().filter(|f| **f == what).count();
        (shown, hidden) = (shown + of(1), hidden + of(2));
        views += usize::from(of(1) > 0 && of(2) > 0);
        for (x, y) in (2..h - 2).flat_map(|y| (2..w - 2).map(move |x| (x, y))) {
            let own = firsts[(y * w + x) as usize];
            // A border is known to within the sites that a pixel asks.
            let around = (y - 2..=y + 2).flat_map(|y| (x - 2..=x + 2).map(move |x| (x, y)));
            let border = around.clone().any(|(x, y)| firsts[(y * w + x) as usize] != own);
            let mask = drawn.mask.get_pixel(x, y).0[0] != 0;
            wrong += usize::from(!border && mask != (own == 1));
        }
    }
    println!("{shown} pixels show it, {hidden} hide it, {wrong} wrong, {views} views with both");
    assert!(shown > 500 && hidden > 300 && views >= 2, "{shown} {hidden} {views}");
    assert_eq!(wrong, 0, "of {} pixels", shown + hidden);
}

/// A place on the object that one view shows at a pixel is at the same place for every other view, through both lenses.
#[test]
fn views_agree_on_where_the_object_is() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = built_in(&folder, &synthetic::Options { train_views: 4, test_views: 0, ..Default::default() });
    let mut turned = 0;
    for kind in [Kind::Box, Kind::Sphere, Kind::Branch] {
        let placed = behind_the_bench(kind);
        let mut agree = 0;
        let [a, b] = [&scene.train[0].camera, &scene.train[3].camera];
        for (x, y) in (0..120).flat_map(|y| (0..160).map(move |x| (f64::from(x) + 0.5, f64::from(y) + 0.5))) {
            let Some((point, z)) = placed.meet(a, [x, y]) else { continue };
            let seen = a.to_camera(point.to_array());
            let back = a.project(point.to_array()).expect("ahead");
            assert!((seen[2] - z).abs() < 1e-5 && (back[0] - x).hypot(back[1] - y) < 1e-3, "{kind:?}: {back:?}");
            let there = b.project(point.to_array()).expect("ahead");
            let far = b.to_camera(point.to_array())[2];
            // At a silhouette the pixel may miss by rounding.
            let Some((other, nearest)) = placed.meet(b, there) else { continue };
            if far - nearest < 1e-3 {
                agree += 1;
                assert!((other - point).length() < 5e-3, "{kind:?}: {other} and {point}");
            } else {
                turned += 1;
            }
        }
        assert!(agree > 15, "{kind:?}: {agree}");
    }
    assert!(turned > 10, "{turned} places are on the far side of the other view");
}

#[test]
fn nothing_else_of_a_photograph_changes_but_a_shadow_of_one_ratio() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = built_in(&folder, &synthetic::Options { train_views: 1, test_views: 3, ..Default::default() });
    // In the open, before the bench.
    let stand = Stand { foot: dvec3(0.2, 0.7, 0.0), up: DVec3::Z, height: 0.6, roughness: 0.0, steep: false };
    for kind in [Kind::Box, Kind::Sphere, Kind::Branch] {
        let placed = Placed::new(Object::new(kind, 1), stand, 1.0);
        for view in &scene.test {
            let (bare, shaded) = (drawn(&placed, view, false), drawn(&placed, view, true));
            let shadow = shaded.shadow.expect("asked for");
            assert!(bare.shadow.is_none() && bare.mask == shaded.mask);
            let (mut object, mut changed, mut dark) = (0, 0, 0);
            for (x, y, was) in view.image.enumerate_pixels() {
                let (left, pixel) = (shadow.get_pixel(x, y).0[0], shaded.picture.get_pixel(x, y));
                dark += usize::from(left < 250);
                if bare.mask.get_pixel(x, y).0[0] == 0 {
                    assert_eq!(bare.picture.get_pixel(x, y), was);
                    let same = was.0.map(|v| (f64::from(v) * f64::from(left) / 255.0).round() as u8);
                    assert_eq!(pixel.0, same, "{x}, {y}: one ratio, {left} of 255");
                } else {
                    object += 1;
                    changed += usize::from(bare.picture.get_pixel(x, y) != was);
                }
            }
            assert!(object > 150 && changed * 100 >= object * 97, "{kind:?}: {changed} of {object}");
            let darkest = shadow.as_raw().iter().min().copied().expect("pixels");
            let most = (255.0 * (1.0 - placed.object.light.share)).round() as u8;
            assert!(dark > 60 && darkest >= most, "{kind:?}: {dark} pixels, {darkest}");
            assert_eq!(drawn(&placed, view, true).picture, shaded.picture);
        }
    }
}

/// Places on the floor are as dark in one view as in another.
#[test]
fn views_agree_on_where_the_shadow_is() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = built_in(&folder, &synthetic::Options { train_views: 1, test_views: 4, ..Default::default() });
    let stand = Stand { foot: dvec3(0.2, 0.7, 0.0), up: DVec3::Z, height: 0.6, roughness: 0.0, steep: false };
    let placed = Placed::new(Object::new(Kind::Sphere, 2), stand, 0.0);
    let shadows: Vec<_> = scene.test.iter().map(|view| drawn(&placed, view, true).shadow.expect("asked for")).collect();
    let (mut places, mut dark, mut alike) = (0, 0, 0);
    for (i, j) in (0..60).flat_map(|i| (0..60).map(move |j| (f64::from(i), f64::from(j)))) {
        let place = stand.foot + dvec3(i / 30.0 - 1.0, j / 30.0 - 1.0, 0.0);
        let truth = 1.0 - placed.object.light.share * placed.object.hides(placed.local(place));
        let seen = scene.test.iter().zip(&shadows).filter_map(|(view, shadow)| {
            let [x, y] = view.camera.project(place.to_array())?;
            let [w, h] = view.camera.size;
            if !(x >= 0.0 && y >= 0.0 && x < f64::from(w) && y < f64::from(h)) {
                return None;
            }
            let (x, y) = (x as u32, y as u32);
            let z = view.camera.to_camera(place.to_array())[2];
            let surface = f64::from(view.depth.as_ref()?[(y * w + x) as usize]);
            ((surface / z - 1.0).abs() < 0.01).then(|| f64::from(shadow.get_pixel(x, y).0[0]) / 255.0)
        });
        let seen: Vec<f64> = seen.collect();
        let (least, most) = seen.iter().fold((1.0_f64, 0.0_f64), |(a, b), v| (a.min(*v), b.max(*v)));
        if seen.len() < 2 {
            continue;
        }
        places += 1;
        dark += usize::from(truth < 0.7);
        // A pixel is 0.02 across on the floor, and the border of the shadow falls by half over 0.07: half a pixel off is
        // 0.1. It is sharper only where the sphere touches the floor.
        alike += usize::from(most - least < 0.1 && (most - truth).abs() < 0.1);
    }
    println!("{alike} of {places} places are alike in all views");
    assert!(alike * 100 >= places * 96, "{alike} of {places}");
    assert!(places > 300 && dark > 30, "{places} places, {dark} of them dark");
}

/// With depth that was measured between the photographs, what is shown of the object is what the true depth shows.
#[test]
fn measured_depth_hides_what_true_depth_hides() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut scene = built_in(&folder, &synthetic::Options { train_views: 16, test_views: 6, ..Default::default() });
    // The test views, whose depth is known, take part.
    let first = scene.train.len();
    scene.train.append(&mut scene.test);
    scene.train.iter_mut().for_each(|view| view.mask = None);
    let grids = gscream_vk::multiview::depths(&testing::gpu(), &scene).expect("a device");
    for kind in [Kind::Box, Kind::Sphere, Kind::Branch] {
        let placed = behind_the_bench(kind);
        let (mut both, mut either, mut whole) = (0, 0, 0);
        for (view, grid) in scene.train.iter().zip(&grids).skip(first) {
            let truth = drawn(&placed, view, false).mask;
            let found = compose::draw(&placed, &view.camera, grid, &view.image, 1.0, false).mask;
            both += truth.as_raw().iter().zip(found.as_raw()).filter(|(a, b)| **a != 0 && **b != 0).count();
            either += truth.as_raw().iter().zip(found.as_raw()).filter(|(a, b)| **a != 0 || **b != 0).count();
            let far = view.depth.as_ref().expect("a test view").iter().map(|z| f64::from(*z) + 100.0).collect();
            let open = DepthGrid { depth: far, ..true_grid(view) };
            let open = compose::draw(&placed, &view.camera, &open, &view.image, 1.0, false).mask;
            whole += open.as_raw().iter().filter(|v| **v != 0).count();
        }
        let iou = both as f64 / either as f64;
        println!("{kind:?}: IoU {iou:.3} over {either} pixels, of {whole} without what is before it");
        // A border of three quarters of a pixel on either side of about a fifth of the outline.
        assert!(iou > 0.9, "{kind:?}: {iou}");
        assert!(either * 20 < whole * 19, "{kind:?}: something stands before it, {either} of {whole}");
    }
}

// ---------------------------------------------------------------- whole scenes

/// `photos/`: the photographs and the model of a small built-in scene.
fn capture() -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = synthetic::Options { seed: 2, width: 128, height: 96, train_views: 8, test_views: 0, points: 1500 };
    built_in(&folder, &options);
    for part in ["images", "sparse/0"] {
        let to = folder.path().join("photos").join(part);
        fs::create_dir_all(&to).expect("a writable folder");
        for file in fs::read_dir(folder.path().join("full").join(part)).expect("a folder").flatten() {
            fs::copy(file.path(), to.join(file.file_name())).expect("a writable folder");
        }
    }
    folder
}

/// Where the fifth view shows a place on the bench.
fn on_the_bench(folder: &TempDir) -> [f64; 2] {
    let scene = scene::load(&folder.path().join("photos"), &scene::Config::default()).expect("it loads");
    scene.train[4].camera.project([-0.6, 2.0, 0.6]).expect("ahead")
}

fn request(folder: &TempDir, out: &str) -> Request {
    Request {
        into: folder.path().join("photos"),
        out: folder.path().join(out),
        view: "train_004".into(),
        pixel: on_the_bench(folder),
        size: 0.2,
        kind: Kind::Box,
        seed: 1,
        shadow: false,
        reference: None,
        test_every: 0,
    }
}

fn listed(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut out = vec![];
    let mut folders = vec![folder.to_path_buf()];
    while let Some(at) = folders.pop() {
        for entry in fs::read_dir(at).expect("a folder").flatten() {
            if entry.path().is_dir() {
                folders.push(entry.path());
            } else {
                let name = entry.path().strip_prefix(folder).expect("below").to_path_buf();
                out.push((name, fs::read(entry.path()).expect("a file")));
            }
        }
    }
    out.sort();
    out
}

#[test]
fn a_composed_scene_is_whole_and_the_same_twice() {
    let (folder, gpu) = (capture(), testing::gpu());
    let first = request(&folder, "one");
    let outcome = compose::compose(&gpu, &first, &|| true).expect("composed");
    assert_eq!((outcome.train, outcome.test), (8, 8));
    assert!(outcome.seen >= 6 && outcome.covered > 0.005, "{} views, {}", outcome.seen, outcome.covered);
    assert!(outcome.standing[0] >= 2 && outcome.standing[1] == 0, "{:?}", outcome.standing);
    // On the bench, whose top is level.
    let Stand { foot, up, .. } = outcome.stand;
    println!("foot {foot}, up {up}, {:?}", outcome.seconds);
    assert!((foot.z - 0.6).abs() < 0.03 && up.z > 0.99, "{foot} {up}");

    let loaded = scene::load(&first.out, &scene::Config::default()).expect("it loads");
    assert_eq!((loaded.train.len(), loaded.test.len(), loaded.references.len()), (8, 8, 0));
    let (report, _) = doctor::examine(&first.out, None).expect("it can be read");
    assert_eq!(report.problems(), 0, "{:?}", report.findings);
    for (view, test) in loaded.train.iter().zip(&loaded.test) {
        let (mask, hole) = (view.mask.as_ref().expect("written"), test.mask.as_ref().expect("written"));
        assert_eq!((mask, &view.name), (hole, &test.name));
        let mut object = 0;
        for ((a, b), m) in view.image.pixels().zip(test.image.pixels()).zip(mask.pixels()) {
            assert!(a == b || m.0[0] != 0, "{}: a pixel outside the mask differs", view.name);
            object += i32::from(m.0[0] != 0) - i32::from(a != b);
        }
        assert!(object <= 3, "{}: {object} pixels of the mask are as they were", view.name);
    }
    let bytes = |path: PathBuf| fs::read(path).expect("a file");
    let [was, is] = ["photos/images", "one/test_images"].map(|at| folder.path().join(at).join("train_003.png"));
    assert!(bytes(was) == bytes(is), "the photographs are copied as they are");

    compose::compose(&gpu, &request(&folder, "two"), &|| true).expect("composed");
    assert!(listed(&folder.path().join("one")) == listed(&folder.path().join("two")), "a function of the request");

    // Test views of their own, a reference, a shadow.
    let more = Request {
        seed: 2,
        kind: Kind::Sphere,
        shadow: true,
        reference: Some("train_005.png".into()),
        test_every: 3,
        ..request(&folder, "three")
    };
    let outcome = compose::compose(&gpu, &more, &|| true).expect("composed");
    // Of the six that are neither the standing view nor the reference every third from the first.
    assert_eq!((outcome.train, outcome.test), (6, 2));
    let loaded = scene::load(&more.out, &scene::Config::default()).expect("it loads");
    let names = |views: &[View]| views.iter().map(|view| view.name.clone()).collect::<Vec<_>>();
    assert_eq!(names(&loaded.test), ["train_000", "train_003"]);
    assert_eq!(loaded.references.len(), 1);
    assert_eq!(loaded.train[loaded.references[0].view].name, "train_005");
    let [was, is] = ["photos/images", "three/reference"]
        .map(|at| image::open(folder.path().join(at).join("train_005.png")).expect("a picture").into_rgb8());
    assert_eq!(was, is, "the reference is the photograph as it was");
    assert_eq!(fs::read_dir(more.out.join("shadows")).expect("written").count(), 6);
    let (report, _) = doctor::examine(&more.out, None).expect("it can be read");
    assert_eq!(report.problems(), 0, "{:?}", report.findings);
}

#[test]
fn mistakes_are_one_sentence_and_write_nothing() {
    let (folder, gpu) = (capture(), testing::gpu());
    let says = |request: &Request| {
        let said = compose::compose(&gpu, request, &|| true).expect_err("a mistake").to_string();
        said.replace(&folder.path().display().to_string(), "")
    };
    let of = || request(&folder, "out");
    assert_eq!(
        says(&Request { view: "train_04".into(), ..of() }),
        "--stand train_04: no photograph of /photos has this name (did you mean train_004?)"
    );
    assert_eq!(
        says(&Request { reference: Some("nothing".into()), ..of() }).split(" (").next(),
        Some("--truth-reference nothing: no photograph of /photos has this name")
    );
    assert_eq!(
        says(&Request { pixel: [128.0, 5.0], ..of() }),
        "--stand train_004=128,5: the photograph is 128x96; name a pixel within it"
    );
    assert_eq!(
        says(&Request { into: folder.path().join("nowhere"), ..of() }),
        "/nowhere: no pictures in images/; put the photographs (.jpg or .png) there, or make a scene of them: gscream-vk prepare /nowhere --out SCENE"
    );
    assert_eq!(
        says(&Request { out: folder.path().join("full"), ..of() }),
        "/full: it is there already; name a new folder"
    );
    let stopped = compose::compose(&gpu, &of(), &|| false).expect_err("it was to end");
    assert!(matches!(stopped, compose::Error::Stopped));

    // Two photographs alone, of blank paper: nothing agrees on a depth.
    let blank = folder.path().join("blank/images");
    fs::create_dir_all(&blank).expect("a writable folder");
    for view in ["train_003", "train_004"] {
        let paper = image::RgbImage::from_pixel(128, 96, image::Rgb([180; 3]));
        paper.save(blank.join(format!("{view}.png"))).expect("a writable folder");
    }
    let model = folder.path().join("blank/sparse/0");
    fs::create_dir_all(&model).expect("a writable folder");
    for file in fs::read_dir(folder.path().join("photos/sparse/0")).expect("a folder").flatten() {
        fs::copy(file.path(), model.join(file.file_name())).expect("a writable folder");
    }
    let unknown = says(&Request { into: folder.path().join("blank"), ..of() });
    assert!(
        unknown.starts_with("--stand train_004=") && unknown.contains(": no surface is known there, because"),
        "{unknown}"
    );
    assert!(!folder.path().join("out").exists());
    let left = fs::read_dir(folder.path()).expect("a folder").flatten();
    let left: Vec<_> = left.filter(|e| e.file_name().to_string_lossy().starts_with(".compose")).collect();
    assert!(left.is_empty(), "{left:?}");
}
