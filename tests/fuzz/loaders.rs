//! One test for each loader.

use std::fs;
use std::path::{Path, PathBuf};

use gscream_vk::config::{Settings, Source};
use gscream_vk::evaluate::network::Weights;
use gscream_vk::formats::{self, gltf, ply, sog, spz};
use gscream_vk::gpu::testing;
use gscream_vk::model::{files, init};
use gscream_vk::prepare::graph_cut::Strokes;
use gscream_vk::prepare::lens::Pinhole;
use gscream_vk::prepare::{Silent, poses, record};
use gscream_vk::remove::objects::{self, Entry};
use gscream_vk::scene::{self, PriorKind, colmap};
use gscream_vk::splat;
use gscream_vk::train::begin::Beginning;
use gscream_vk::train::checkpoint::{self, History, Model, Owner, State};
use gscream_vk::train::plan::Plan;
use gscream_vk::train::step::Step;
use image::ImageFormat;
use tempfile::TempDir;

use crate::Loader;
use crate::seeds::{self, SIZE};

/// What was refused, as it is told.
fn told<T>(outcome: Result<T, impl std::fmt::Display>) -> Result<(), String> {
    outcome.map(drop).map_err(|error| error.to_string())
}

/// A loader of one file of this name in a folder of its own.
fn of_file<T, E: std::fmt::Display>(
    name: &str,
    load: impl Fn(&Path) -> Result<T, E>,
) -> impl Fn(&[u8]) -> Result<(), String> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join(name);
    move |bytes| {
        let _kept = &folder;
        fs::write(&path, bytes).expect("a writable folder");
        told(load(&path))
    }
}

/// A loader of a scene, or of its model, of which one file is changed.
fn of_scene<'a, T, E: std::fmt::Display>(
    folder: &'a TempDir,
    file: &'a str,
    load: impl Fn(&Path) -> Result<T, E> + 'a,
) -> impl Fn(&[u8]) -> Result<(), String> + 'a {
    move |bytes| {
        fs::write(folder.path().join(file), bytes).expect("a writable folder");
        told(load(folder.path()))
    }
}

#[test]
fn colmap_binary() {
    for (name, through, file) in [
        ("cameras.bin", "cameras.bin (scene)", "sparse/0/cameras.bin"),
        ("images.bin", "images.bin (scene)", "sparse/0/images.bin"),
        ("points3D.bin", "points3D.bin (scene)", "sparse/0/points3D.bin"),
    ] {
        let folder = seeds::scene();
        let seed = vec![seeds::read(folder.path().join(file))];
        Loader::of_bytes(name, seed.clone()).run(of_scene(&folder, file, colmap::read));
        // Numbers that the model takes go on through the whole scene, and through the doctor.
        Loader::of_bytes(through, seed).rarely(20).run(of_scene(&folder, file, whole));
    }
}

fn whole(folder: &Path) -> Result<(), scene::Error> {
    let config = scene::Config { test_every: 2, ..scene::Config::default() };
    scene::load(folder, &config).map(|scene| drop(scene::doctor::look(&scene)))
}

#[test]
fn colmap_text() {
    let folder = seeds::scene();
    for (name, text) in seeds::text_model() {
        fs::write(folder.path().join("sparse/0").join(name), text).expect("a writable folder");
    }
    for stem in ["cameras", "images", "points3D"] {
        fs::remove_file(folder.path().join(format!("sparse/0/{stem}.bin"))).expect("a model");
    }
    for (name, text) in seeds::text_model() {
        let file = format!("sparse/0/{name}");
        Loader::of_text(name, vec![text.clone().into_bytes()]).run(of_scene(&folder, &file, colmap::read));
        fs::write(folder.path().join(file), text).expect("a writable folder");
    }
}

#[test]
fn colmap_lenses() {
    let folder = seeds::scene();
    let mut cameras = 11u64.to_le_bytes().to_vec();
    for (model, parameters) in [3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12].into_iter().enumerate() {
        [model as u32 + 1, model as u32].iter().for_each(|v| cameras.extend(v.to_le_bytes()));
        SIZE.iter().for_each(|v| cameras.extend(u64::from(*v).to_le_bytes()));
        (0..parameters).for_each(|i| cameras.extend(if i < 4 { 10.0f64 } else { 0.01 }.to_le_bytes()));
    }
    let load = |folder: &Path| {
        let (lenses, _) = colmap::lenses(folder)?;
        // The search for a pinhole must end, whatever the coefficients are.
        for lens in lenses.into_values() {
            std::hint::black_box(Pinhole::of(lens));
        }
        Ok::<_, scene::Error>(())
    };
    let file = "sparse/0/cameras.bin";
    Loader::of_bytes("cameras.bin (lenses)", vec![cameras]).rarely(40).run(of_scene(&folder, file, load));
}

#[test]
fn point_clouds() {
    let folder = seeds::scene();
    fs::remove_file(folder.path().join("sparse/0/points3D.bin")).expect("a model");
    let file = "sparse/0/points3D.ply";
    Loader::of_bytes("points3D.ply", seeds::point_clouds()).run(of_scene(&folder, file, colmap::read));
    let text = seeds::point_clouds().into_iter().take(1).collect();
    Loader::of_text("points3D.ply (text)", text).run(of_scene(&folder, file, colmap::read));
}

#[test]
fn priors() {
    let prior = |path: &Path| scene::read_prior(path, PriorKind::Depth, SIZE, SIZE);
    Loader::of_bytes("prior.npy", seeds::npys()).run(of_file("a.npy", prior));
    Loader::of_text("prior.npy (header)", seeds::npys()).run(of_file("a.npy", prior));
    Loader::of_bytes("prior.exr", seeds::exrs()).rarely(4).run(of_file("a.exr", prior));
    let grey = seeds::pictures(ImageFormat::Png).split_off(1);
    let grey = grey.into_iter().filter(|bytes| of_file("a.png", prior)(bytes).is_ok()).collect();
    Loader::of_bytes("prior.png", grey).finished(&seeds::with_checksums).run(of_file("a.png", prior));
}

#[test]
fn photographs_and_masks() {
    let (png, jpeg) = (seeds::pictures(ImageFormat::Png), seeds::pictures(ImageFormat::Jpeg));
    let both = |path: &Path| scene::dimensions(path).and_then(|_| scene::decode(path));
    Loader::of_bytes("photograph.png", png.clone()).finished(&seeds::with_checksums).run(of_file("a.png", both));
    Loader::of_bytes("photograph.png (crc)", png.clone()).run(of_file("a.png", both));
    Loader::of_bytes("photograph.jpg", jpeg.clone()).run(of_file("a.jpg", both));
    let mask = |path: &Path| scene::object_mask(path, false);
    Loader::of_bytes("mask.png", png).finished(&seeds::with_checksums).run(of_file("a.png", mask));
    Loader::of_bytes("mask.jpg", jpeg).run(of_file("a.jpg", mask));
    let white = image::RgbaImage::from_pixel(SIZE[0], SIZE[1], image::Rgba([255; 4]));
    let mut strokes = std::io::Cursor::new(vec![]);
    white.write_to(&mut strokes, ImageFormat::Png).expect("memory");
    let read = |path: &Path| Strokes::read(path, SIZE);
    Loader::of_bytes("strokes.png", vec![strokes.into_inner()])
        .finished(&seeds::with_checksums)
        .run(of_file("a.png", read));
}

#[test]
fn models() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (points, offsets) = ([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [-1.0, 0.5, 2.0]], 2);
    let anchors = init::anchors(&points, 0.1, offsets).expect("three points").anchors;
    let weights = init::weights(1, offsets, false, 0.1);
    files::save(folder.path(), &anchors, &weights).expect("a writable folder");
    let cloud = seeds::read(folder.path().join(files::POINT_CLOUD));
    Loader::of_bytes("point_cloud.ply", vec![cloud]).run(of_file("a.ply", files::load_anchors));
    let networks = vec![seeds::read(folder.path().join(files::WEIGHTS))];
    let load = |path: &Path| files::load_weights(path, offsets);
    Loader::of_bytes("weights.safetensors", networks.clone()).run(of_file("a.safetensors", load));
    let all = |path: &Path| Weights::read(path);
    Loader::of_bytes("networks.safetensors", networks).run(of_file("a.safetensors", all));
}

#[test]
fn exports() {
    let clouds: Vec<_> = [0, 1, 3].map(seeds::cloud).into();
    Loader::of_bytes("scene.ply", clouds.iter().map(ply::encode).collect()).run(|bytes| told(ply::decode(bytes)));
    let glb = clouds.iter().map(|cloud| gltf::encode(cloud).expect("it fits")).collect();
    Loader::of_bytes("scene.glb", glb).run(|bytes| told(gltf::decode(bytes)));
    let other = vec![seeds::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/splats/mip.glb"))];
    Loader::of_text("splat.glb", other).run(|bytes| told(gltf::decode(bytes)));
    // Of other programs: what they wrote is spliced, too.
    let whole = |bytes: &[u8]| {
        told(splat::read::decode(bytes.to_vec()).map(|splat| splat.spliced(&vec![true; splat.len()], &clouds[0])))
    };
    Loader::of_bytes("splat.ply", clouds.iter().map(ply::encode).collect()).run(whole);
    Loader::of_text("splat.ply (header)", clouds.iter().take(1).map(ply::encode).collect()).run(whole);
    Loader::of_bytes("splat.ply (compressed)", vec![seeds::compressed_splat()]).run(whole);
    Loader::of_text("splat.ply (compressed, header)", vec![seeds::compressed_splat()]).run(whole);
    for (name, seed) in [("cameras.json", seeds::cameras_json()), ("export.json", seeds::export_json())] {
        Loader::of_text(name, vec![seed]).run(of_file(name, splat::cameras::read));
    }
    let versions = [spz::Version::Two, spz::Version::Three];
    let encode = |cloud| versions.map(|version| spz::encode(cloud, version).expect("it fits"));
    let packed: Vec<_> = clouds.iter().flat_map(encode).collect();
    let frames = vec![seeds::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/splats/mip-4.spz"))];
    Loader::of_bytes("splat.spz (version 4)", frames).run(whole);
    // Checksums of the archive's files stop most changes, so that texts and pictures are packed again as they are.
    let bundled: Vec<_> = clouds.iter().map(|cloud| sog::encode(cloud).expect("it fits")).collect();
    Loader::of_bytes("scene.sog", bundled.clone()).run(whole);
    let crc = |bytes| seeds::with_zip_checksums(bytes);
    Loader::of_bytes("scene.sog (checked)", bundled).finished(&crc).run(whole);
    let rows = clouds.iter().map(formats::splat::encode).collect();
    Loader::of_bytes("scene.splat", rows).run(|bytes| told(formats::splat::decode(bytes)));
    Loader::of_bytes("scene.spz", packed.clone()).run(|bytes| told(spz::decode(bytes)));
    let raw: Vec<_> = packed.iter().map(|bytes| seeds::gunzip(bytes)).collect();
    // Seeds are given as they are, so that what is read is packed here.
    Loader::of_bytes("scene.spz (unpacked)", raw).run(|bytes| told(spz::decode(&seeds::gzip(bytes.to_vec()))));
}

#[test]
fn captures() {
    let folder = seeds::scene();
    fs::remove_dir_all(folder.path().join("sparse")).expect("a model");
    let frame = |view: u32, more: &str| {
        format!(
            "{{\"file_path\": \"./images/train_{view:03}\", \"transform_matrix\": [[1, 0, 0, {view}], [0, 1, 0, 0], \
             [0, 0, 1, 2.5], [0, 0, 0, 1]]{more}}}"
        )
    };
    let text = |model: &str, more: &str| {
        format!(
            "{{\"camera_model\": \"{model}\", \"w\": 24, \"h\": 16, \"fl_x\": 20.0, \"cx\": 12, \"k1\": 0.01, \"k3\": 0.001,\n\
             \"frames\": [\n{},\n{},\n{}]{more}}}",
            frame(0, ", \"mask_path\": \"masks/train_000.png\""),
            frame(1, ", \"fl_y\": 19.5, \"k2\": -0.01"),
            frame(2, ", \"depth_file_path\": \"depth/train_002.npy\"")
        )
    };
    let seeds =
        [text("OPENCV", ""), text("OPENCV_FISHEYE", ", \"ply_file_path\": null"), text("PINHOLE", ", \"a\": {}")];
    let seeds: Vec<Vec<u8>> = seeds.map(String::into_bytes).into();
    let out = folder.path().join("out");
    let load = |folder: &Path| poses::find(folder)?.collect(&out, &mut Silent);
    Loader::of_text("transforms.json", seeds).rarely(20).run(of_scene(&folder, "transforms.json", load));
}

#[test]
fn records() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut scene = record::Folder::open(folder.path()).expect("a writable folder");
    let mut batch = record::Batch::default();
    batch.bytes("masks/a.png", vec![1], "a test");
    batch.bytes("depth/b/c.npy", vec![2, 3], "a test");
    batch.figures.insert("known".into(), 0.5);
    batch.notes.push("a note".into());
    scene.write("masks", "0123".into(), batch).expect("a writable folder");
    let text = seeds::read(folder.path().join(record::RECORD));
    let inner = folder.path().join("scene");
    fs::create_dir(&inner).expect("a writable folder");
    let load = |bytes: &[u8]| {
        fs::write(inner.join(record::RECORD), bytes).expect("a writable folder");
        told(record::Folder::open(&inner))
    };
    Loader::of_text(record::RECORD, vec![text]).run(load);
}

#[test]
fn lists_of_objects() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let first = folder.path().join("objects");
    let lists: [Vec<Entry>; 2] = [vec![Entry::new(1), Entry::new(2)], vec![Entry::new(3)]];
    let of = |list: &Vec<Entry>| {
        objects::keep(&first, list).expect("a writable folder");
        seeds::read(first.with_extension("json"))
    };
    let load = |path: &Path| {
        objects::list(&path.with_extension("")).map(|list| list.iter().map(|e| e.folder(path)).collect::<Vec<_>>())
    };
    Loader::of_text("objects.json", lists.iter().map(of).collect()).run(of_file("objects.json", load));
}

#[test]
fn settings() {
    let written = Settings::default().to_toml().into_bytes();
    let commented = seeds::read(PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("configs/gscream.toml"));
    let load = |path: &Path| Settings::resolve(&[Source::File(path.to_owned())]);
    Loader::of_text("settings.toml", vec![written, commented]).rarely(4).run(of_file("a.toml", load));
}

/// The checkpoint of a run that is about to begin, whose hash is made right after every change.
#[test]
fn checkpoints() {
    let folder = seeds::scene();
    let scene = scene::load(folder.path(), &scene::Config::default()).expect("a scene");
    let mut settings = Settings::default();
    settings.model.attention.enabled = false;
    settings.model.offsets = 2;
    settings.model.voxel = 0.0;
    let settings = settings.fitted(&scene);
    let gpu = testing::gpu();
    let plan = Plan::new(&scene, &settings);
    let from = Beginning::of(&scene, &settings).expect("points");
    let step = Step::new(&gpu, plan, &settings, &from).expect("room");
    let state = State { history: History::default(), model: Model::of(&gpu, &step).expect("a device") };
    let owner = Owner::new(&scene, &settings);
    let path = checkpoint::write(folder.path(), &owner, &state).expect("a writable folder");
    let seeds = vec![seeds::read(path)];
    let load = |path: &Path| checkpoint::read(path, &owner);
    Loader::of_bytes("checkpoint", seeds.clone())
        .rarely(10)
        .finished(&seeds::with_digest)
        .run(of_file("step-00000000.safetensors", load));
    Loader::of_bytes("checkpoint (hash)", seeds).rarely(10).run(of_file("step-00000000.safetensors", load));
}
