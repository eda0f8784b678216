//! Exported files as other programs read them, and as a browser draws them.
//!
//! The other programs are npm packages (`npm ci` in tests/viewer) and Chromium. Where they are not installed, the tests
//! that need them say so and pass.

use std::fs;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::common::skip::{Lack, skip};
use assert_cmd::cargo::cargo_bin_cmd;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use gscream_vk::evaluate::psnr;
use gscream_vk::export::draw::Drawer;
use gscream_vk::export::{self, Cloud, low_pass, sigmoid};
use gscream_vk::formats::{gltf, ply, sog, splat, spz};
use gscream_vk::gpu::testing;
use gscream_vk::math::harmonics::{HALF_TURN_ABOUT_X, coefficients};
use gscream_vk::model::gaussians::Static;
use gscream_vk::render::Config;
use gscream_vk::render::view::to_rgb8;
use gscream_vk::scene::{self, Camera, synthetic};
use gscream_vk::view;
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64;
use serde_json::Value;
use tempfile::TempDir;

const VIEWER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/viewer");

/// Whether `npm ci` was run in tests/viewer; says so if not.
fn installed(package: &str) -> bool {
    let there = Path::new(VIEWER).join("node_modules").join(package).is_dir();
    if !there {
        skip(Lack::Node, &format!("{package} is not installed: run `npm ci --ignore-scripts` in tests/viewer"));
    }
    there
}

fn node(arguments: &[&str]) -> Vec<u8> {
    let output = Command::new("node").args(arguments).current_dir(VIEWER).output().expect("node starts");
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    output.stdout
}

fn cloud(n: usize, degree: u32) -> Cloud {
    let mut rng = Pcg64::seed_from_u64(u64::from(degree) + 5);
    let mut cloud = Cloud { degree, ..Cloud::default() };
    for _ in 0..n {
        let mut vec3 = |low: f32, high: f32| -> [f32; 3] { std::array::from_fn(|_| rng.random_range(low..high)) };
        cloud.position.push(vec3(-6.0, 6.0));
        cloud.log_scale.push(vec3(-9.0, 1.0));
        cloud.harmonics.extend((0..coefficients(degree)).map(|_| vec3(-0.9, 0.9)));
        let q: [f64; 4] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-6);
        cloud.rotation.push(q.map(|v| (v / norm) as f32));
        cloud.logit.push(rng.random_range(-5.0..6.0));
    }
    cloud
}

/// Angle between two rotations, radians.
fn angle(a: [f32; 4], b: [f32; 4]) -> f64 {
    let dot: f64 = a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(b)).sum();
    2.0 * (1.0 - dot * dot).max(0.0).sqrt().asin()
}

/// The Gaussians as splat-transform reads a file: its table, with the columns of a PLY.
fn by_splat_transform(file: &Path, degree: u32) -> Cloud {
    let table = file.with_extension("csv");
    let program = "node_modules/@playcanvas/splat-transform/bin/cli.mjs";
    node(&[program, "-w", &file.to_string_lossy(), &table.to_string_lossy()]);
    let mut reader = csv::Reader::from_path(&table).expect("a table");
    let heads: Vec<String> = reader.headers().expect("a first line").iter().map(str::to_owned).collect();
    let mut cloud = Cloud { degree, ..Cloud::default() };
    // The file's own number of coefficients: a PLY is padded to fifteen.
    let rest = heads.iter().filter(|name| name.starts_with("f_rest_")).count() / 3;
    for row in reader.records() {
        let row = row.expect("a line");
        let value = |name: String| -> f32 {
            let at = heads.iter().position(|head| *head == name).unwrap_or_else(|| panic!("no column {name}"));
            row[at].parse().expect("a number")
        };
        cloud.position.push(["x", "y", "z"].map(|name| value(name.to_owned())));
        cloud.log_scale.push([0, 1, 2].map(|i| value(format!("scale_{i}"))));
        cloud.rotation.push([0, 1, 2, 3].map(|i| value(format!("rot_{i}"))));
        cloud.logit.push(value("opacity".to_owned()));
        cloud.harmonics.push([0, 1, 2].map(|c| value(format!("f_dc_{c}"))));
        for k in 0..coefficients(degree) - 1 {
            cloud.harmonics.push([0, 1, 2].map(|c| value(format!("f_rest_{}", c * rest + k))));
        }
    }
    cloud
}

/// Allowed distances: position, log-scale, radians, opacity, first coefficient, the others.
struct Within(f32, f32, f64, f64, f32, f32);

fn assert_alike(got: &Cloud, want: &Cloud, within: &Within) {
    assert_eq!(got.len(), want.len());
    let Within(position, log_scale, radians, opacity, first, others) = *within;
    let close = |a: [f32; 3], b: [f32; 3], most: f32, what: &str| {
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() <= most), "{what}: {a:?} instead of {b:?}");
    };
    for i in 0..want.len() {
        close(got.position[i], want.position[i], position, "position");
        close(got.log_scale[i], want.log_scale[i], log_scale, "log-scale");
        assert!(angle(got.rotation[i], want.rotation[i]) <= radians, "{:?}, {:?}", got.rotation[i], want.rotation[i]);
        assert!((sigmoid(got.logit[i]) - sigmoid(want.logit[i])).abs() <= opacity, "opacity {i}");
        for (k, (a, b)) in got.harmonics_of(i).iter().zip(want.harmonics_of(i)).enumerate() {
            close(*a, *b, if k == 0 { first } else { others }, &format!("coefficient {k}"));
        }
    }
}

/// A table has ten digits and more; the angle's own rounding is the root of float32's.
const EXACT: Within = Within(1e-6, 1e-6, 1e-3, 1e-6, 1e-6, 1e-6);
/// Half a step of each, as in the format's own tests.
const PACKED: Within = Within(5e-7, 0.0313, 6e-3, 2.1e-3, 0.0132, 0.004);

#[test]
fn splat_transform_reads_the_ply_and_the_spz() {
    if !installed("@playcanvas/splat-transform") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    for degree in [0, 1, 2, 3] {
        let cloud = cloud(60, degree);
        let file = |extension: &str| folder.path().join(format!("degree{degree}.{extension}"));
        fs::write(file("ply"), ply::encode(&cloud)).expect("writable");
        assert_alike(&by_splat_transform(&file("ply"), degree), &cloud, &EXACT);
        for version in [spz::Version::Two, spz::Version::Three] {
            fs::write(file("spz"), spz::encode(&cloud, version).expect("it fits")).expect("writable");
            let got = by_splat_transform(&file("spz"), degree);
            if version == spz::Version::Three {
                assert_alike(&got, &cloud, &PACKED);
            }
            // And what it reads is what we read.
            assert_alike(
                &got,
                &spz::decode(&fs::read(file("spz")).expect("readable")).expect("ours"),
                &Within(1e-6, 1e-6, 2e-3, 1.1e-4, 1e-4, 1e-4),
            );
        }
    }
}

/// It writes no `.splat` and orders a SOG itself, so that ours are compared with what we read of them.
#[test]
fn splat_transform_reads_the_sog_and_the_splat() {
    if !installed("@playcanvas/splat-transform") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let same = Within(2e-6, 1e-5, 2e-3, 1.1e-4, 1e-5, 1e-5);
    for degree in [0, 1, 2, 3] {
        let path = folder.path().join(format!("degree{degree}.sog"));
        let bytes = sog::encode(&cloud(60, degree)).expect("it fits");
        fs::write(&path, &bytes).expect("writable");
        assert_alike(&by_splat_transform(&path, degree), &sog::decode(&bytes).expect("ours"), &same);
    }
    let path = folder.path().join("scene.splat");
    let bytes = splat::encode(&cloud(60, 0));
    fs::write(&path, &bytes).expect("writable");
    // It takes 255 steps of a rotation for 256: up to a step in each of four components, and twice that.
    let turned = Within(2e-6, 1e-5, 2.0 * 2.0 / 128.0, 1.1e-4, 1e-4, 0.0);
    assert_alike(&by_splat_transform(&path, 0), &splat::decode(&bytes).expect("ours"), &turned);
}

#[test]
fn three_reads_the_glb() {
    if !installed("three") {
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    for degree in [0, 3] {
        let cloud = cloud(60, degree);
        let file = folder.path().join("scene.glb");
        fs::write(&file, gltf::encode(&cloud).expect("it is small")).expect("writable");
        let read: Value = serde_json::from_slice(&node(&["read.mjs", &file.to_string_lossy()])).expect("JSON");
        let splats = &read["extensions"][gltf::EXTENSION];
        assert_eq!(
            (&read["mode"], &splats["kernel"], &splats["colorSpace"]),
            (&0.into(), &"ellipse".into(), &"srgb_rec709_display".into())
        );
        let values = |name: &str| -> Vec<f32> {
            let array = read["attributes"][name]["array"].as_array().unwrap_or_else(|| panic!("no {name}: {read}"));
            array.iter().map(|v| v.as_f64().expect("a number") as f32).collect()
        };
        let of = |name: &str| values(&format!("{}:{name}", gltf::EXTENSION).to_lowercase());
        // +Y up: half a turn about x.
        let position: Vec<[f32; 3]> = values("position").as_chunks().0.iter().map(|[x, y, z]| [*x, -y, -z]).collect();
        let rotation = of("ROTATION").as_chunks().0.iter().map(|[x, y, z, w]| [*w, *x, *y, *z]).collect::<Vec<_>>();
        // The half turn is the quaternion (0, 1, 0, 0), and its own inverse up to sign.
        let rotation: Vec<[f32; 4]> = rotation.iter().map(|[w, x, y, z]| [-x, *w, -z, *y]).collect();
        let mut harmonics = vec![];
        for i in 0..cloud.len() {
            let mut k = 0;
            for l in 0..=degree {
                for m in 0..2 * l + 1 {
                    let all = of(&format!("SH_DEGREE_{l}_COEF_{m}"));
                    harmonics.push(std::array::from_fn(|c| HALF_TURN_ABOUT_X[k] * all[3 * i + c]));
                    k += 1;
                }
            }
        }
        let logit = of("OPACITY").iter().map(|o| export::logit(f64::from(*o))).collect();
        let scale = of("SCALE");
        let log_scale = scale.as_chunks().0.iter().map(|s: &[f32; 3]| s.map(f32::ln)).collect();
        let got = Cloud { position, log_scale, rotation, logit, degree, harmonics, antialiased: false };
        assert_alike(&got, &cloud, &Within(0.0, 1e-5, 1e-3, 1e-5, 0.0, 0.0));
        let color = values("color");
        assert!(color.len() == 4 * cloud.len() && color.iter().all(|v| (0.0..=1.0).contains(v)));
    }
}

/// The program, run inside `folder` with a cache of its own.
fn program(folder: &Path) -> assert_cmd::Command {
    let mut command = cargo_bin_cmd!("gscream-vk");
    command
        .current_dir(folder)
        .env("XDG_CACHE_HOME", folder.join("cache"))
        .env("MESA_SHADER_CACHE_DIR", env!("CARGO_TARGET_TMPDIR"))
        .env_remove("RUST_LOG");
    command
}

fn succeeds(folder: &Path, arguments: &str) -> String {
    let output = program(folder).args(arguments.split_whitespace()).output().expect("the program starts");
    assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("UTF-8")
}

fn fails(folder: &Path, arguments: &str) -> String {
    let output = program(folder).args(arguments.split_whitespace()).output().expect("the program starts");
    assert_eq!(output.status.code(), Some(1), "{arguments}");
    let text = String::from_utf8(output.stderr).expect("UTF-8");
    text.lines().find(|line| line.starts_with("error: ")).unwrap_or_else(|| panic!("{text}")).to_owned()
}

/// A folder with a run on the built-in scene, trained for some steps at a quarter of its size.
fn with_run(width: u32, steps: u32) -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options =
        synthetic::Options { width, height: width * 3 / 4, train_views: 12, test_views: 3, points: 1500, seed: 1 };
    synthetic::write(&folder.path().join("scene"), &options).expect("a writable folder");
    let train = format!("train scene --out run --preset demo --iterations {steps} --set train.eval_interval=0");
    succeeds(folder.path(), &train);
    folder
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).expect("a file")).expect("JSON")
}

#[test]
fn a_run_becomes_files_of_the_same_scene() {
    let folder = with_run(80, 60);
    let folder = folder.path();
    // Left by a killed one.
    let left = folder.join("run/export/.scene.spz.a1B2c3");
    fs::create_dir_all(folder.join("run/export")).expect("writable");
    fs::write(&left, "half").expect("writable");
    let text = succeeds(folder, "export run --views 12 --steps 200 --validate");
    assert!(!left.exists(), "what a killed export was writing is swept");
    assert!(text.ends_with("wrote scene.ply, scene.spz, scene.glb, export.json in run/export\n"), "{text}");
    let out = folder.join("run/export");
    let read = |name: &str| fs::read(out.join(name)).expect(name);
    let cloud = ply::decode(&read("scene.ply")).expect("our own file");
    let figures = json(&out.join("export.json"));
    assert_eq!(figures["gaussians"], cloud.len());
    assert_eq!(gltf::decode(&read("scene.glb")).expect("our own file").position, cloud.position);
    assert_eq!(spz::decode(&read("scene.spz")).expect("our own file").len(), cloud.len());
    let loss = |stage: &str| figures["loss"][stage]["anchors"]["full"]["psnr"].as_f64().expect(stage);
    assert!(loss("baked") > 30.0 && loss("refined") > loss("baked"), "{} dB, then {}", loss("baked"), loss("refined"));
    for file in figures["files"].as_array().expect("files") {
        assert!(file["photographs"]["mask"]["ssim"].is_f64(), "masked figures are there: {file}");
        let psnr = file["anchors"]["full"]["psnr"].as_f64().expect("a figure");
        // On larger pixels' means what was trained with points between them.
        assert!(psnr > 30.0, "{file}");
    }
    // Of pictures no larger than the training's: pruning and packing cost little beside the refinement itself.
    succeeds(folder, "export run --views 12 --steps 200 --screen 80 --formats ply,spz,glb,splat --sog --out narrow");
    for file in json(&folder.join("narrow/export.json"))["files"].as_array().expect("files") {
        let psnr = file["anchors"]["full"]["psnr"].as_f64().expect("a figure");
        assert!(psnr > loss("refined") - 0.5, "{file}");
    }
    four_times_as_large(folder);
    // The built-in scene's up is -y in the file: the cameras stand upright.
    for camera in figures["cameras"].as_array().expect("cameras") {
        let down = camera["rotation"][1].as_array().expect("an axis")[1].as_f64().expect("a number");
        assert!(down > 0.5, "{camera}");
    }
    // The scene's own axes on request, and the same Gaussians: the same bytes for the same seed.
    succeeds(folder, "export run --views 12 --steps 200 --formats ply --out again");
    assert!(fs::read(folder.join("again/scene.ply")).expect("a file") == read("scene.ply"), "not the same bytes");
    let kept = "export run --views 2 --steps 0 --up keep --degree 1 --formats ply,spz --sog --spz-version 2 --out kept";
    assert!(succeeds(folder, kept).ends_with("wrote scene.ply, scene.spz, scene.sog, export.json in kept\n"));
    let packed = spz::decode(&fs::read(folder.join("kept/scene.spz")).expect("a file")).expect("our own file");
    let bundled = sog::decode(&fs::read(folder.join("kept/scene.sog")).expect("a file")).expect("our own file");
    assert_eq!((packed.len(), packed.degree), (bundled.len(), bundled.degree));
    assert_eq!(json(&folder.join("kept/export.json"))["rotation"][0], serde_json::json!([1.0, 0.0, 0.0]));
}

/// A picture four times as large shows what was trained, where Gaussians as narrow as trained show needles and holes.
fn four_times_as_large(folder: &Path) {
    let gpu = testing::gpu();
    let scene = scene::load(&folder.join("scene"), &scene::Config::default()).expect("a scene");
    let camera = scene.train[0].camera;
    let large = camera.scaled(camera.size.map(|n| 4 * n));
    let draw = |out: &str, cameras: &[&Camera]| -> Vec<Vec<[f32; 3]>> {
        let cloud = ply::decode(&fs::read(folder.join(out)).expect("a file")).expect("our own file");
        let gaussians = Static::upload(&gpu, &cloud).expect("room");
        let mut drawer = Drawer::new(&gpu, gaussians, &Config::default(), [0.0; 3]).expect("room");
        cameras.iter().map(|camera| drawer.draw(camera).expect("a picture")).collect()
    };
    for (out, screen) in [("as_trained", 80), ("wide", 320)] {
        let options = format!("--views 2 --steps 50 --up keep --formats ply --screen {screen}");
        succeeds(folder, &format!("export run {options} --out {out}"));
    }
    let trained = draw("as_trained/scene.ply", &[&camera, &large]);
    let off = |large_picture: &[[f32; 3]]| {
        let small = low_pass::reduced(large_picture, large.size, 4);
        let values = small.as_flattened().iter().zip(trained[0].as_flattened());
        psnr(values.map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / (3 * small.len()) as f64)
    };
    let (narrow, wide) = (off(&trained[1]), off(&draw("wide/scene.ply", &[&large])[0]));
    println!("drawn four times as large: {narrow:.2} dB as trained, {wide:.2} dB widened");
    assert!(wide > narrow + 3.0, "{narrow:.2} dB, {wide:.2} dB");
}

/// A file system that takes no more looks like a limit on the size of files.
#[cfg(unix)]
#[test]
#[ignore = "long; .ci/run has it"]
fn a_disk_that_fills_up_leaves_nothing() {
    let folder = with_run(32, 4);
    let folder = folder.path();
    succeeds(folder, "export run --views 2 --steps 1 --out first");
    let before = fs::read(folder.join("first/scene.ply")).expect("a file");
    let binary = assert_cmd::cargo::cargo_bin!("gscream-vk");
    let script =
        format!("trap '' XFSZ; ulimit -f 8; exec {} export run --views 2 --steps 2 --out first", binary.display());
    let output = Command::new("bash").args(["-c", &script]).current_dir(folder).output().expect("a shell");
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("error: first/export.json: cannot be written: ") && text.contains("nothing"), "{text}");
    assert!(fs::read(folder.join("first/scene.ply")).expect("still there") == before, "the old file is untouched");
    let names: Vec<PathBuf> =
        fs::read_dir(folder.join("first")).expect("a folder").map(|e| e.expect("readable").path()).collect();
    assert_eq!(names.len(), 4, "{names:?}");
}

#[test]
#[ignore = "long; .ci/run has it"]
fn mistakes_are_one_sentence() {
    let folder = with_run(32, 4);
    let folder = folder.path();
    assert_eq!(fails(folder, "export nowhere"), "error: nowhere: there is no such folder");
    assert!(fails(folder, "export run/model").contains("name the scene with --scene"));
    let unexported = fails(folder, "view run");
    assert!(
        unexported.starts_with("error: run/export/scene.ply: cannot be read; `gscream-vk export run` writes it"),
        "{unexported}"
    );
    assert_eq!(fails(folder, "view nowhere"), "error: nowhere: there is no such folder");
    let told = succeeds(folder, "export run --views 2 --steps 1 --formats ply --provenance");
    assert!(told.contains("Gaussians are guessed, ") && told.contains("\n25 degrees off the cameras' path "), "{told}");
    let camera = fails(folder, "view run --camera nobody");
    assert!(camera.contains("they are called like train_000"), "{camera}");
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
    let port = taken.local_addr().expect("bound").port();
    let busy = fails(folder, &format!("view run --port {port}"));
    assert_eq!(busy, format!("error: 127.0.0.1:{port}: another program serves there; --port 0 takes a free one"));
    // The page holds the export's own bytes, and begins at the camera that is rolled least.
    let path = folder.join("run/export/export.json");
    let mut figures = json(&path);
    let poses = figures["cameras"].as_array_mut().expect("cameras");
    for (i, pose) in poses.iter_mut().enumerate() {
        pose["roll"] = if i == 3 { 0.5 } else { 5.0 + i as f64 }.into();
    }
    let center: [f64; 3] = serde_json::from_value(poses[3]["center"].clone()).expect("a point");
    fs::write(&path, figures.to_string()).expect("writable");
    let text = succeeds(folder, "view run --html page.html");
    assert!(text.starts_with("page.html: "), "{text}");
    let page = fs::read_to_string(folder.join("page.html")).expect("a page");
    let between =
        |start: &str| page.split_once(start).and_then(|(_, rest)| rest.split_once("</script>")).expect(start).0;
    let packed = BASE64_STANDARD.decode(between("id=\"asset-scene.ply\">")).expect("base64");
    let mut ply = vec![];
    flate2::read::GzDecoder::new(&packed[..]).read_to_end(&mut ply).expect("gzip");
    assert!(ply == fs::read(folder.join("run/export/scene.ply")).expect("a file"), "the scene is the exported one");
    let guessed = BASE64_STANDARD.decode(between("id=\"asset-guessed.bin\">")).expect("base64");
    let mut bytes = vec![];
    flate2::read::GzDecoder::new(&guessed[..]).read_to_end(&mut bytes).expect("gzip");
    assert_eq!(Some(bytes.len() as u64), json(&path)["gaussians"].as_u64(), "a byte for each Gaussian");
    let config: Value = serde_json::from_str(between("id=\"config\">")).expect("JSON");
    let initial = &config["settings"]["cameras"][0]["initial"]["position"];
    let position: [f64; 3] = serde_json::from_value(initial.clone()).expect("a point");
    // The viewer's axes are ours after half a turn about z.
    let expected = [-center[0], -center[1], center[2]];
    // Numbers read from JSON may differ in their last bit.
    let alike = |(a, b): (&f64, &f64)| (a - b).abs() < 1e-9 * (1.0 + b.abs());
    assert!(position.iter().zip(&expected).all(alike), "the camera that is rolled least: {position:?}, {expected:?}");
}

fn chromium() -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let found =
        std::env::split_paths(&path).flat_map(|folder| names.map(|name| folder.join(name))).find(|p| p.is_file());
    if found.is_none() {
        skip(Lack::Browser, "no Chromium: install Debian's package `chromium`");
    }
    found
}

/// From the viewer's own camera: that of a training view, upright and without its lens.
#[test]
fn the_browser_draws_what_we_draw() {
    let Some(chromium) = chromium().filter(|_| installed("puppeteer-core")) else { return };
    let chromium = chromium.to_string_lossy();
    let folder = with_run(160, 120);
    let folder = folder.path();
    succeeds(folder, "export run --views 12 --steps 60 --formats ply");
    let size = [640, 480];
    let mut server = Command::new(assert_cmd::cargo::cargo_bin!("gscream-vk"))
        .args(["view", "run", "--port", "0", "--camera", "train_006"])
        .current_dir(folder)
        .stdout(Stdio::piped())
        .spawn()
        .expect("the program starts");
    let mut line = String::new();
    BufReader::new(server.stdout.take().expect("piped")).read_line(&mut line).expect("its first line");
    let url = line.split_whitespace().next().expect("an address").to_owned();
    succeeds(folder, "view run --camera train_006 --html page.html");
    let shot = |url: &str, out: &[&str]| {
        let [width, height] = size.map(|v| v.to_string());
        let out: Vec<String> = out
            .iter()
            .map(|o| if o.ends_with("png") { folder.join(o).display().to_string() } else { (*o).to_owned() })
            .collect();
        let arguments =
            [&["shot.mjs", &chromium, url, &width, &height][..], &out.iter().map(String::as_str).collect::<Vec<_>>()]
                .concat();
        node(&arguments);
    };
    shot(&format!("{url}?webgl&noui"), &["served.png", "100", "photograph.png"]);
    let page = format!("file://{}?webgl&noui", folder.join("page.html").display());
    shot(&page, &["single.png"]);
    server.kill().expect("it serves until it is stopped");
    server.wait().expect("it is gone");

    let picture = |name: &str| image::open(folder.join(name)).expect(name).to_rgb8();
    let served = picture("served.png");
    assert_eq!(served.dimensions(), (640, 480));
    let figures = json(&folder.join("run/export/export.json"));
    let pose = &figures["cameras"][6];
    assert_eq!(pose["name"], "train_006");
    let numbers = |value: &Value| -> Vec<f64> {
        value.as_array().expect("numbers").iter().map(|v| v.as_f64().expect("a number")).collect()
    };
    let rotation: [[f32; 3]; 3] = std::array::from_fn(|i| {
        let row = numbers(&pose["rotation"][i]);
        std::array::from_fn(|k| row[k] as f32)
    });
    let center: [f64; 3] = numbers(&pose["center"]).try_into().expect("three");
    let scene = scene::load(&folder.join("scene"), &scene::Config::default()).expect("a scene");
    let translation = Camera::translation_to(&rotation, center);
    let taken = Camera { rotation, translation, ..scene.train[6].camera };
    let camera = view::upright(&taken).scaled(size);
    let gpu = testing::gpu();
    let cloud = ply::decode(&fs::read(folder.join("run/export/scene.ply")).expect("a file")).expect("our own file");
    let gaussians = Static::upload(&gpu, &cloud).expect("room");
    let mut drawer = Drawer::new(&gpu, gaussians, &Config::default(), [0.0; 3]).expect("room");
    let ours = to_rgb8(size, &drawer.draw(&camera).expect("a picture"));
    let compared = |a: &image::RgbImage, b: &image::RgbImage| {
        let square: f64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
        psnr(square / a.as_raw().len() as f64 / 255.0 / 255.0)
    };
    let (drawn, single) = (compared(&served, &ours), compared(&picture("single.png"), &ours));
    println!("the browser's picture against ours: {drawn:.2} dB; of the single page: {single:.2} dB");
    if let Some(keep) = std::env::var_os("GSCREAM_KEEP") {
        let keep = Path::new(&keep);
        ours.save(keep.join("ours.png")).expect("writable");
        for name in ["served.png", "single.png", "photograph.png"] {
            fs::copy(folder.join(name), keep.join(name)).expect("writable");
        }
    }
    assert!(drawn > MOST_ALIKE && single > MOST_ALIKE, "{drawn:.2} dB, {single:.2} dB");
    // Another camera's picture is far from it, so that the comparison means something.
    let away =
        Camera { translation: Camera::translation_to(&rotation, [center[0] + 0.2, center[1], center[2]]), ..camera };
    let other = compared(&served, &to_rgb8(size, &drawer.draw(&away).expect("a picture")));
    assert!(other < MOST_ALIKE - 3.0, "{other:.2} dB from another place");
    // The slider's far end is the photograph.
    let photograph = view::resampled(&scene.train[6].image, &taken, &view::upright(&taken));
    let photograph = image::imageops::resize(&photograph, 640, 480, image::imageops::FilterType::Triangle);
    let seen = compared(&picture("photograph.png"), &photograph);
    assert!(seen > 28.0, "{seen:.2} dB from the photograph");
}

/// dB: viewers blend in 8 or 16 bits and cut Gaussians off where we do not.
const MOST_ALIKE: f64 = 28.0;
