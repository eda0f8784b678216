//! Captures as users have them: photographs beside what the program made of them, several marks in one view, any unit.

use std::fs;
use std::path::{Path, PathBuf};

use gscream_vk::prepare::{Evidence, Object, Request, Step, poses};
use gscream_vk::scene;
use image::{GrayImage, RgbImage};

use crate::common::skip::{Lack, skip};
use crate::nerfstudio::{of_nerfstudio, transforms};
use crate::prepare::{VIEWS, capture, ious, mask, name, prepared, truth};

fn files(folder: &Path) -> Vec<PathBuf> {
    fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("a file").path()).collect()
}

/// Photographs lie flat beside their masks, and the scene is made among them: neither is taken for photographs, however often.
#[test]
fn what_lies_among_the_photographs_is_none() {
    let folder = capture();
    let photos = folder.path().join("photos");
    for picture in files(&photos.join("images")) {
        fs::rename(&picture, photos.join(picture.file_name().expect("a name"))).expect("writable");
    }
    fs::remove_dir(photos.join("images")).expect("empty");
    fs::create_dir(photos.join("masks")).expect("writable");
    let one = photos.join("masks").join(name(3) + ".png");
    fs::copy(truth(&folder, 3), &one).expect("writable");
    let mut request = Request::new(&photos, photos.join("removed/scene"));
    request.only = vec![Step::Poses];
    for round in 0..2 {
        let found = poses::find(&photos).expect("a capture");
        assert_eq!(found.photographs.len(), VIEWS as usize, "{round}");
        assert!(found.masks.keys().eq([&name(3)]), "{:?}", found.masks);
        let said = prepared(&request);
        assert_eq!(files(&request.out.join("images")).len(), VIEWS as usize);
        assert_eq!(said.iter().any(|line| line.contains("nothing has changed")), round == 1, "{said:?}");
    }
}

/// A scene that is made in the capture's own folder is made once: the model that came of it is not taken for one that was there.
#[test]
fn in_its_own_folder_a_scene_stays() {
    let (folder, views) = of_nerfstudio();
    let photos = folder.path().join("photos");
    fs::write(photos.join("transforms.json"), transforms(&views).to_string()).expect("writable");
    let mut request = Request::new(&photos, &photos);
    request.only = vec![Step::Poses];
    for round in 0..3 {
        let said = prepared(&request);
        assert!(files(&photos.join("sparse/0")).len() > 2, "{round}: {said:?}");
        assert_eq!(said.iter().any(|line| line.contains("nothing has changed")), round > 0, "{round}: {said:?}");
    }
}

/// The masks that are made of this evidence in a view.
fn marked(evidence: &dyn Fn(&Path) -> Vec<Evidence>) -> GrayImage {
    let folder = capture();
    let mut request = Request::new(folder.path().join("photos"), folder.path().join("scene"));
    (request.fit_steps, request.fit_side) = (30, 64);
    request.only = vec![Step::Poses, Step::Fit, Step::Masks];
    request.objects[0].evidence =
        evidence(&truth(&folder, 4)).into_iter().map(|evidence| (name(4), evidence)).collect();
    prepared(&request);
    mask(&request.out.join("masks").join(name(4) + ".png"))
}

/// Two masks of one view are one object: what any of them covers.
#[test]
fn several_masks_of_a_view_count_together() {
    let halves = |whole: &Path| -> Vec<Evidence> {
        let full = mask(whole);
        let part = |first: bool| {
            let mut half = full.clone();
            half.enumerate_pixels_mut().filter(|(x, ..)| (x % 7 < 3) == first).for_each(|(.., v)| v.0[0] = 0);
            let path = whole.with_file_name(format!("half-{first}.png"));
            half.save(&path).expect("writable");
            Evidence::Mask(path)
        };
        [true, false].map(part).to_vec()
    };
    let whole = |whole: &Path| vec![Evidence::Mask(whole.to_owned())];
    assert_eq!(marked(&halves), marked(&whole));
}

/// The largest of the parts that COLMAP could not join is used, whichever number it has, and the others are named.
#[test]
fn of_several_models_the_largest_is_used() {
    let folder = capture();
    let sparse = folder.path().join("photos/sparse");
    fs::rename(sparse.join("0"), sparse.join("10")).expect("writable");
    fs::create_dir(sparse.join("2")).expect("writable");
    fs::write(sparse.join("2/cameras.txt"), "1 PINHOLE 100 100 90 90 50 50\n").expect("writable");
    let stray = format!("1 1 0 0 0 0 0 0 1 {}.png\n\n", name(0));
    fs::write(sparse.join("2/images.txt"), stray).expect("writable");
    let mut request = Request::new(folder.path().join("photos"), folder.path().join("scene"));
    request.only = vec![Step::Poses];
    let said = prepared(&request);
    // Two of its photographs are for tests.
    let named = format!("sparse/10 is used, with {} photographs, and not sparse/2 (1)", VIEWS + 2);
    assert!(said.iter().any(|line| line.contains(&named)), "{said:?}");
    let scene = scene::load(&request.out, &scene::Config::default()).expect("a scene");
    assert_eq!(scene.train.len(), VIEWS as usize);
}

/// Multiplies the lengths of a COLMAP model.
fn scale(model: &Path, by: f64) {
    let word = |bytes: &[u8], at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"));
    let lengths = |bytes: &mut [u8], at: usize| {
        for at in (at..at + 24).step_by(8) {
            let scaled = by * f64::from_bits(word(bytes, at));
            bytes[at..at + 8].copy_from_slice(&scaled.to_le_bytes());
        }
    };
    let change = |file: &str, one: &dyn Fn(&mut [u8], usize) -> usize| {
        let path = model.join(file);
        let mut bytes = fs::read(&path).expect("a model");
        (0..word(&bytes, 0)).fold(8, |at, _| one(&mut bytes, at));
        fs::write(path, bytes).expect("writable");
    };
    // Id, quaternion, translation, camera, name, points of 24 bytes.
    change("images.bin", &|bytes, at| {
        lengths(bytes, at + 36);
        let end = (at + 64..).find(|i| bytes[*i] == 0).expect("the name's end");
        end + 9 + 24 * word(bytes, end + 1) as usize
    });
    // Id, position, colour, error, tracks of 8 bytes.
    change("points3D.bin", &|bytes, at| {
        lengths(bytes, at + 8);
        at + 51 + 8 * word(bytes, at + 43) as usize
    });
}

/// Millimetres or kilometres: masks are the same to the byte and as good as in metres, and depths are in the model's unit.
#[test]
fn the_models_unit_changes_nothing() {
    let made = |by: f64| {
        let folder = capture();
        let photos = folder.path().join("photos");
        scale(&photos.join("sparse/0"), by);
        let mut request = Request::new(&photos, folder.path().join("scene"));
        (request.fit_steps, request.fit_side) = (60, 84);
        request.only = vec![Step::Poses, Step::Fit, Step::Masks, Step::Depth];
        request.objects[0].evidence = vec![(name(4), Evidence::Mask(truth(&folder, 4)))];
        prepared(&request);
        let masks: Vec<GrayImage> =
            (0..VIEWS).map(|view| mask(&request.out.join("masks").join(name(view) + ".png"))).collect();
        let config = scene::Config { seed_hole: false, ..scene::Config::default() };
        let scene = scene::load(&request.out, &config).expect("a scene");
        let depths = scene.train.iter().flat_map(|view| view.prior.as_ref().expect("a prior").values.clone());
        let ious = ious(&folder, &request.out, &[4]);
        (masks, depths.map(|z| z / by as f32).collect::<Vec<f32>>(), ious.iter().sum::<f64>() / ious.len() as f64)
    };
    let (.., usual) = made(1.0);
    let (masks, depths, iou) = made(1024.0);
    let known = depths.iter().filter(|z| z.is_finite()).count();
    println!("masks' mean IoU {iou:.3}, {usual:.3} in metres");
    assert!(known > 1000 && iou > usual - 0.1, "{known}, {iou}, {usual}");
    // Powers of two: but for the logarithms of sizes, which are kept to 1e-6, nothing is rounded, and the two come to one
    // another but where a depth is just known or just not.
    let (scaled_masks, scaled_depths, _) = made(1.0 / 1024.0);
    assert!(scaled_masks == masks);
    let apart = |(a, b): &(&f32, &f32)| !((**a / **b - 1.0).abs() < 1e-3 || a.is_nan() && b.is_nan());
    let differ = depths.iter().zip(&scaled_depths).filter(apart).count();
    assert!(differ * 100 < known, "{differ} of {known} depths");
}

/// A photograph that EXIF turns is read as it is stored, and that is said where it has a mark.
#[test]
fn turned_photographs_are_named() {
    let folder = capture();
    let images = folder.path().join("photos/images");
    let png = images.join(name(2) + ".png");
    let picture = image::open(&png).expect("a picture").into_rgb8();
    let mut bytes = vec![];
    let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95);
    // TIFF with one entry: orientation, a short, 6.
    let exif = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0".to_vec();
    image::ImageEncoder::set_exif_metadata(&mut encoder, exif).expect("JPEG has EXIF");
    picture.write_with_encoder(encoder).expect("a picture");
    fs::remove_file(png).and_then(|()| fs::write(images.join(name(2) + ".jpg"), bytes)).expect("writable");
    let mut request = Request::new(folder.path().join("photos"), folder.path().join("scene"));
    request.only = vec![Step::Poses];
    for (view, turned) in [(2, true), (3, false)] {
        request.objects[0].evidence = vec![(name(view), Evidence::Box([4, 4, 30, 30]))];
        let said = prepared(&request);
        assert_eq!(said.iter().any(|line| line.contains("EXIF")), turned, "{said:?}");
    }
}

/// The built-in scene's ball, which is blue, and below it its stand: the two parts of a photograph's true mask.
pub(crate) fn parts(mask: &GrayImage, picture: &RgbImage) -> [GrayImage; 2] {
    let blue = mask.enumerate_pixels().filter(|(x, y, on)| {
        let [r, _, b] = picture.get_pixel(*x, *y).0;
        on.0[0] != 0 && b > r.saturating_add(20)
    });
    let lowest = blue.map(|(_, y, _)| y).max().expect("the ball is in the picture");
    [true, false].map(|ball| {
        let mut part = mask.clone();
        part.enumerate_pixels_mut().filter(|(_, y, _)| (*y <= lowest) != ball).for_each(|(.., v)| v.0[0] = 0);
        part
    })
}

/// The ball is marked in one photograph and its stand in another: both are in the masks of all views. As one object the two
/// masks contradict each other. An object by itself has the same masks with a name as without.
#[test]
fn objects_are_marked_in_different_photographs() {
    let folder = capture();
    let root = folder.path();
    let parts = |view: u32| {
        let picture = image::open(root.join("full/images").join(name(view) + ".png")).expect("a picture");
        parts(&mask(&truth(&folder, view)), &picture.into_rgb8())
    };
    let evidence = |view: u32, part: usize| {
        let path = root.join(format!("part-{part}.png"));
        parts(view)[part].save(&path).expect("writable");
        (name(view), Evidence::Mask(path))
    };
    let [ball, stand] = [evidence(2, 0), evidence(7, 1)];
    let object =
        |name: &str, evidence: Vec<(String, Evidence)>| Object { name: name.into(), evidence, ..Object::default() };
    let mut request = Request::new(root.join("photos"), root.join("scene"));
    (request.fit_steps, request.fit_side) = (150, 112);
    request.only = vec![Step::Poses, Step::Fit, Step::Masks];
    let mut made = |objects: Vec<Object>| {
        request.objects = objects;
        let said = prepared(&request);
        let ious = ious(&folder, &request.out, &[]);
        let masks: Vec<Vec<u8>> = (0..VIEWS)
            .map(|view| fs::read(request.out.join("masks").join(name(view) + ".png")).expect("a mask"))
            .collect();
        (said, ious.iter().sum::<f64>() / ious.len() as f64, ious.into_iter().fold(1.0, f64::min), masks)
    };
    let (_, as_one, ..) = made(vec![object("", vec![ball.clone(), stand.clone()])]);
    let (said, mean, least, masks) = made(vec![object("ball", vec![ball.clone()]), object("stand", vec![stand])]);
    println!("masks' mean IoU {mean:.3}, least {least:.3}; as one object {as_one:.3}; {said:?}");
    assert!(mean > 0.8 && least > 0.7 && as_one < mean - 0.1, "{mean}, {least}, as one object {as_one}");
    // What is given counts, and what the other object has there is beside it.
    for (view, part) in [(2, 0), (7, 1)] {
        let union = image::load_from_memory(&masks[view as usize]).expect("a mask").into_luma8();
        let own = parts(view);
        assert!(own[part].pixels().zip(union.pixels()).all(|(own, union)| own.0[0] <= union.0[0]), "{view}");
        let on = |mask: &GrayImage| mask.pixels().filter(|v| v.0[0] != 0).count() as f64;
        assert!(on(&union) > on(&own[part]) + 0.6 * on(&own[1 - part]), "{view}");
    }
    let (.., alone) = made(vec![object("ball", vec![ball.clone()])]);
    let (said, .., unnamed) = made(vec![object("", vec![ball])]);
    assert!(
        alone == unnamed && alone != masks && said.iter().any(|line| line == "masks: nothing has changed"),
        "{said:?}"
    );
}

/// The can's photographs from two sides stand on one, for its label is on both: they are turned about it, once, and `--poses given` takes
/// that back.
#[test]
fn a_folded_capture_is_unfolded() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let can = std::env::var_os("GSCREAM_DATA").map_or(data, PathBuf::from).join("can");
    if !can.is_dir() {
        skip(Lack::Captures, &format!("no {} (GSCREAM_DATA names the folder of the captures)", can.display()));
        return;
    }
    let folder = tempfile::tempdir().expect("a folder");
    let mut request = Request::new(&can, folder.path().join("scene"));
    (request.fit_steps, request.fit_side) = (50, 128);
    request.only = vec![Step::Poses, Step::Fit, Step::Masks];
    request.objects[0].evidence = vec![("0000".into(), Evidence::Box([266, 316, 464, 788]))];
    let out = request.out.clone();
    let eyes = || -> Vec<[f64; 3]> {
        let model = scene::colmap::read(&out).expect("a model");
        model.images.iter().map(scene::colmap::Image::center).collect()
    };
    let given = scene::colmap::read(&can).expect("a model");
    let said = prepared(&request);
    assert!(said.iter().any(|line| line.starts_with("poses: the model is folded: 32 photographs")), "{said:?}");
    let turned = eyes();
    assert_eq!(turned.len(), given.images.len());
    let stayed = turned
        .iter()
        .zip(&given.images)
        .filter(|(eye, image)| (0..3).all(|a| (eye[a] - image.center()[a]).abs() < 1e-9));
    assert_eq!(stayed.count(), 39);
    let said = prepared(&request);
    assert!(said.iter().filter(|line| line.contains("nothing has changed")).count() == 3, "{said:?}");
    assert_eq!(eyes(), turned);
    request.again = false;
    let said = prepared(&request);
    assert!(!said.iter().any(|line| line.contains("folded")), "{said:?}");
    let back = scene::colmap::read(&request.out).expect("a model");
    assert_eq!(back, given);
}

/// Where `relight/` has a shadow the reference picture is without it beside the hole, too: reduced, what is left of it would be a dark
/// line around the hole.
#[test]
fn the_reference_has_no_shadow() {
    let folder = capture();
    let mut request = Request::new(folder.path().join("photos"), folder.path().join("scene"));
    (request.fit_steps, request.fit_side) = (30, 64);
    request.only = vec![Step::Poses, Step::Fit, Step::Masks];
    request.objects[0].evidence = vec![(name(4), Evidence::Mask(truth(&folder, 4)))];
    prepared(&request);
    fs::create_dir(request.out.join("relight")).expect("writable");
    let photographs = scene_pictures(&request.out.join("images"));
    for (name, picture) in &photographs {
        let light = RgbImage::from_pixel(picture.width(), picture.height(), image::Rgb([204; 3]));
        light.save(request.out.join("relight").join(format!("{name}.png"))).expect("writable");
    }
    request.only = vec![Step::Reference];
    prepared(&request);
    let references = scene_pictures(&request.out.join("reference"));
    let (name, reference) = references.iter().next().expect("a reference");
    let provenance = image::open(request.out.join("prepare/provenance.png")).expect("a picture").into_rgb8();
    let lit = |v: u8| (f64::from(v) / 0.8).round().min(255.0) as u8;
    let mut beside = 0;
    for ((x, y, from), own) in provenance.enumerate_pixels().zip(reference.pixels()) {
        if from.0 == [0; 3] {
            assert_eq!(own.0, photographs[name].get_pixel(x, y).0.map(lit), "{x}, {y}");
            beside += 1;
        }
    }
    assert!(beside > 100, "{beside}");
    // What the reference's map has red is noted in its view, and so are the guesses of all other views.
    let guessed = scene_pictures(&request.out.join("prepare/guessed"));
    let red = provenance.pixels().map(|from| if from.0[0] > 128 { 255 } else { 0 });
    assert!(guessed[name].pixels().map(|pixel| pixel.0[0]).eq(red));
    assert!(scene_pictures(&request.out.join("hole")).keys().all(|name| guessed.contains_key(name)));
}

/// Pictures of a folder by name.
fn scene_pictures(folder: &Path) -> std::collections::BTreeMap<String, RgbImage> {
    let pictures = files(folder).into_iter().filter(|path| path.extension().is_some_and(|e| e == "png" || e == "jpg"));
    let open = |path: PathBuf| {
        let name = path.file_stem().expect("a name").to_string_lossy().into_owned();
        (name, image::open(path).expect("a picture").into_rgb8())
    };
    pictures.map(open).collect()
}
