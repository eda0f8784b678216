//! Marks on photographs with true masks: what one to five of them come to, in their view and in the others, and what they
//! keep to.

use std::path::{Path, PathBuf};
use std::time::Instant;

use image::{GrayImage, Luma, RgbImage};
use rand::RngExt as _;

use super::{Cues, Mark, mask, next};
use crate::gpu::testing;
use crate::prepare::depth::DepthMap;
use crate::prepare::masks::{self, Votes};
use crate::prepare::splats::Splats;
use crate::prepare::{self, Fitted, Request, Silent};
use crate::scene::doctor::iou;
use crate::scene::{self, resample, synthetic};

/// The middle of the largest part of a mask: the pixel that is farthest from its rim.
fn middle(mask: &GrayImage) -> Option<([f64; 2], u32)> {
    let (w, h) = mask.dimensions();
    // Beyond the picture nothing is the mask's.
    let beside = GrayImage::from_fn(w + 2, h + 2, |x, y| {
        let inside = (1..=w).contains(&x) && (1..=h).contains(&y);
        Luma([if inside && mask.get_pixel(x - 1, y - 1).0[0] != 0 { 0 } else { 255 }])
    });
    let distances = resample::distances(&beside, w.max(h));
    let (i, far) = distances.iter().enumerate().max_by_key(|(_, d)| **d)?;
    let (x, y) = (i as u32 % (w + 2), i as u32 / (w + 2));
    let at = [(f64::from(x) - 0.5) / f64::from(w), (f64::from(y) - 0.5) / f64::from(h)];
    (*far > 0).then_some((at, *far))
}

fn object(at: [f64; 2]) -> Mark {
    Mark::Object { at, scale: 0 }
}

/// The next click of a user who knows the truth: in the middle of what is most wrong.
fn wanted(found: &GrayImage, truth: &GrayImage) -> Option<Mark> {
    let wrong = |missing: bool| {
        GrayImage::from_fn(truth.width(), truth.height(), |x, y| {
            let [found, truth] = [found, truth].map(|mask| mask.get_pixel(x, y).0[0] != 0);
            Luma([if found != truth && truth == missing { 255 } else { 0 }])
        })
    };
    let (missing, extra) = (middle(&wrong(true)), middle(&wrong(false)));
    match (missing, extra) {
        (Some((_, a)), Some((at, b))) if b > a => Some(Mark::Background { at }),
        (Some((at, _)), _) => Some(object(at)),
        (None, Some((at, _))) => Some(Mark::Background { at }),
        (None, None) => None,
    }
}

/// The masks after each of so many clicks, each in the middle of what is most wrong, beginning with these marks; and the
/// seconds of each.
fn masks_of(
    picture: &RgbImage,
    truth: &GrayImage,
    cues: &Cues<'_>,
    begin: Option<Mark>,
    count: usize,
) -> Vec<(GrayImage, f64)> {
    let mut marks = vec![];
    let mut found = GrayImage::new(truth.width(), truth.height());
    let mut all = vec![];
    let mut begin = begin;
    for _ in 0..count {
        let began = Instant::now();
        if let Some(mark) = begin.take().or_else(|| wanted(&found, truth)) {
            marks.push(mark);
            found = next(picture, &marks, &found, cues);
        }
        all.push((found.clone(), began.elapsed().as_secs_f64()));
    }
    all
}

/// Marks that a user may begin with.
const TOOLS: [&str; 5] = ["clicks", "box", "lasso", "a tight lasso", "a box of the command line"];

/// IoU after 1, 2, 3 and 5 marks that begin with a click, a box or a lasso.
type Row = [[f64; 4]; 5];

/// One row of the table, and the slowest cut in seconds.
fn row(picture: &RgbImage, truth: &GrayImage, cues: &Cues<'_>) -> (Row, f64) {
    let mut slowest = 0.0;
    let of = |begin: Option<Mark>| {
        let masks = masks_of(picture, truth, cues, begin, 5);
        slowest = masks.iter().map(|(_, seconds)| *seconds).fold(slowest, f64::max);
        [0, 1, 2, 4].map(|n| iou(&masks[n].0, truth))
    };
    let [clicks, boxes, lassos, tight] =
        [None, Some(boxed(truth)), Some(lasso(truth, 0.125)), Some(lasso(truth, 0.02))].map(of);
    let Mark::Box { bounds } = boxed(truth) else { unreachable!("a box") };
    let size = [truth.width(), truth.height()];
    let corners = std::array::from_fn(|k| (bounds[k] * f64::from(size[k % 2])).round() as u32);
    let cut = super::from_box(picture, corners, cues);
    let alone = cut.map_or(0.0, |mask| iou(&mask, truth));
    ([clicks, boxes, lassos, tight, [alone; 4]], slowest)
}

fn print(what: &str, row: &Row) {
    for (tool, ious) in TOOLS.iter().zip(row) {
        println!("{what}: {tool} {ious:.3?}");
    }
}

/// A rough line around an object, of sixteen corners, wider than it by a part of its size.
fn lasso(truth: &GrayImage, wider: f64) -> Mark {
    let on = || truth.enumerate_pixels().filter(|p| p.2.0[0] != 0).map(|p| [f64::from(p.0), f64::from(p.1)]);
    let count = on().count() as f64;
    let center: [f64; 2] = std::array::from_fn(|k| on().map(|p| p[k]).sum::<f64>() / count);
    let sides = [truth.width(), truth.height()].map(f64::from);
    let corner = |i: u32| {
        let (sin, cos) = (f64::from(i) * std::f64::consts::TAU / 16.0).sin_cos();
        let along = |p: [f64; 2]| {
            let [x, y] = [p[0] - center[0], p[1] - center[1]];
            let far = x * cos + y * sin;
            (far > 0.92 * x.hypot(y)).then_some(far)
        };
        let far = on().filter_map(along).fold(0.0, f64::max) + wider * count.sqrt();
        let at = [center[0] + far * cos, center[1] + far * sin];
        std::array::from_fn(|k| (at[k] / sides[k]).clamp(0.0, 1.0))
    };
    Mark::Lasso { points: (0..16).map(corner).collect() }
}

/// A loose box: wider than the object by a tenth of its sides.
fn boxed(truth: &GrayImage) -> Mark {
    let on = || truth.enumerate_pixels().filter(|(_, _, v)| v.0[0] != 0);
    let [w, h] = [truth.width(), truth.height()].map(f64::from);
    let x = [on().map(|p| p.0).min(), on().map(|p| p.0).max()].map(|x| f64::from(x.unwrap_or(0)) / w);
    let y = [on().map(|p| p.1).min(), on().map(|p| p.1).max()].map(|y| f64::from(y.unwrap_or(0)) / h);
    let [mx, my] = [(x[1] - x[0]) * 0.1, (y[1] - y[0]) * 0.1];
    Mark::Box { bounds: [x[0] - mx, y[0] - my, x[1] + mx, y[1] + my].map(|v| v.clamp(0.0, 1.0)) }
}

fn small(path: &Path) -> RgbImage {
    let picture = scene::photograph(path, 1).expect("a photograph");
    let longest = picture.width().max(picture.height());
    let size = [picture.width(), picture.height()].map(|n| n * longest.min(1024) / longest);
    resample::photograph(&picture, size)
}

/// Figures of a capture, means over the views: without the fit and with it; and carried to the other views after 1, 2 and 3
/// clicks.
#[derive(Default)]
struct Found {
    alone: Row,
    fitted: Row,
    measured: Row,
    carried: [f64; 3],
    slowest: f64,
}

/// Measures on every so many-th view. `photographs` is what `prepare` takes, `out` where its fit is or goes.
fn measure(request: &Request, truth: &Path, every: usize) -> Found {
    let gpu = testing::gpu();
    let Fitted { scene, fit, grids } = prepare::fitted(&gpu, request, &mut Silent).expect("a fit");
    let mut splats = Splats::new(&gpu, &fit.model, &fit.settings.render).expect("room");
    let files = scene::pictures(&request.out.join("images")).expect("photographs");
    let truths = scene::pictures(truth).expect("masks");
    let truth =
        |name: &str, picture: [u32; 2]| resample::nearest(&scene::mask(&truths[name], 1).expect("a mask"), picture);
    let colors = masks::colors(&mut splats, &scene.train).expect("colours");
    let mut found = Found::default();
    // Masks may be of some views only.
    let masked: Vec<usize> = (0..scene.train.len()).filter(|i| truths.contains_key(&scene.train[*i].name)).collect();
    let looked: Vec<usize> = masked.into_iter().skip(every / 2).step_by(every).collect();
    let share = 1.0 / looked.len() as f64;
    for &i in &looked {
        let view = &scene.train[i];
        let picture = small(&files[&view.name]);
        let own = truth(&view.name, [picture.width(), picture.height()]);
        let depth = DepthMap::of(&mut splats, &view.camera).expect("a depth");
        let measured = DepthMap::confirmed(&grids[i], &view.camera);
        let with = Cues { depth: Some(&depth), ..Cues::default() };
        let by_measure = Cues { measured: Some(&measured), ..with };
        for (sums, cues, what) in [
            (&mut found.alone, Cues::default(), ""),
            (&mut found.fitted, with, " with the fit"),
            (&mut found.measured, by_measure, " with both"),
        ] {
            let (ious, slowest) = row(&picture, &own, &cues);
            print(&format!("{}{what}", view.name), &ious);
            let all = sums.iter_mut().flatten().zip(ious.iter().flatten());
            all.for_each(|(sum, iou)| *sum += share * iou);
            found.slowest = found.slowest.max(slowest);
        }
        for (n, (given, _)) in masks_of(&picture, &own, &with, None, 3).iter().enumerate() {
            let mut votes = Votes::new(&splats);
            votes.add(&mut splats, &view.camera, &masks::parts(given, view.camera.size)).expect("votes");
            let shares = votes.count(fit.positions(), &colors);
            let others: Vec<usize> = looked.iter().copied().filter(|other| *other != i).collect();
            for &other in &others {
                let other = &scene.train[other];
                let size = scene::dimensions(&files[&other.name]).expect("a photograph");
                let carried = shares.carry(&mut splats, &other.camera).expect("a mask");
                let made = masks::threshold(&carried.object, other.camera.size, size, masks::OBJECT);
                let made = masks::without_specks(&made, 0.02);
                found.carried[n] += share * iou(&made, &truth(&other.name, size)) / others.len() as f64;
            }
        }
    }
    println!("mean IoU of {} views after 1, 2, 3 and 5 marks", looked.len());
    print("colours alone", &found.alone);
    print("with the fit", &found.fitted);
    print("with the fit and measured depth", &found.measured);
    println!("carried to the others after 1, 2, 3 clicks {:.3?}; slowest cut {:.2} s", found.carried, found.slowest);
    found
}

#[test]
fn clicks_on_the_built_in_scene_find_the_object() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let options = synthetic::Options { width: 160, height: 120, train_views: 12, test_views: 0, points: 2000, seed: 3 };
    let source = folder.path().join("source");
    synthetic::write(&source, &options).expect("a writable folder");
    let photographs = folder.path().join("photographs");
    std::fs::create_dir(&photographs).expect("writable");
    for name in ["images", "sparse"] {
        std::fs::rename(source.join(name), photographs.join(name)).expect("a scene");
    }
    let out = folder.path().join("scene");
    let request = Request { fit_steps: 250, fit_side: 112, ..Request::new(&photographs, &out) };
    let found = measure(&request, &source.join("masks"), 3);
    // After any one number of marks it is 0.05 more or less with the fit; the mean of two, three and five stays.
    let fitted = found.fitted[0][1..].iter().sum::<f64>() / 3.0;
    assert!(found.alone[0][2] > 0.8 && fitted > 0.86 && found.carried[2] > 0.75, "{fitted}");
}

/// Captures that `prepare --only poses --only fit` has been run on: `GSCREAM_CLICKS=PHOTOS:OUT:MASKS`.
#[test]
#[ignore = "needs a capture"]
fn clicks_on_a_capture() {
    let Ok(named) = std::env::var("GSCREAM_CLICKS") else { return };
    let paths: Vec<PathBuf> = named.split(':').map(PathBuf::from).collect();
    let [photographs, out, truth] = &paths[..] else { panic!("PHOTOS:OUT:MASKS") };
    let every = std::env::var("GSCREAM_EVERY").ok().and_then(|n| n.parse().ok()).unwrap_or(12);
    measure(&Request::new(photographs, out), truth, every);
}

/// Marks by colours alone on every so many-th photograph of a capture with true masks: `GSCREAM_MARKS=IMAGES:MASKS`.
#[test]
#[ignore = "needs a capture"]
fn marks_on_true_masks() {
    let Ok(named) = std::env::var("GSCREAM_MARKS") else { return };
    let (images, truth) = named.split_once(':').expect("IMAGES:MASKS");
    let [images, truths] = [images, truth].map(|folder| scene::pictures(Path::new(folder)).expect("pictures"));
    let every = std::env::var("GSCREAM_EVERY").ok().and_then(|n| n.parse().ok()).unwrap_or(7);
    let views: Vec<&String> = truths.keys().skip(every / 2).step_by(every).collect();
    let mut all = vec![];
    for name in views {
        let picture = small(&images[name]);
        let own =
            resample::nearest(&scene::mask(&truths[name], 1).expect("a mask"), [picture.width(), picture.height()]);
        let (ious, seconds) = row(&picture, &own, &Cues::default());
        print(&format!("{name}, {seconds:.2} s"), &ious);
        all.push(ious);
    }
    let mean = |tool: usize, n: usize| all.iter().map(|ious| ious[tool][n]).sum::<f64>() / all.len() as f64;
    print(&format!("mean of {} views", all.len()), &std::array::from_fn(|t| std::array::from_fn(|n| mean(t, n))));
}

// ---------------------------------------------------------------- a figure of several colours

/// The colour of the figure at a place, in heights of the picture from its middle; nothing beside it.
fn figure_at(x: f64, y: f64) -> Option<[f64; 3]> {
    let [black, white, gray, yellow] =
        [[34.0, 34.0, 38.0], [228.0, 226.0, 220.0], [128.0, 130.0, 134.0], [226.0, 178.0, 52.0]];
    // From the front to the back: middle, half width and half height.
    let parts = [
        (-0.035, -0.235, 0.012, 0.012, black),
        (0.035, -0.235, 0.012, 0.012, black),
        (0.0, -0.19, 0.03, 0.017, yellow),
        (-0.04, -0.225, 0.045, 0.05, white),
        (0.04, -0.225, 0.045, 0.05, white),
        (0.0, -0.11, 0.12, 0.025, yellow),
        (0.0, 0.07, 0.11, 0.17, white),
        (0.0, -0.22, 0.12, 0.12, black),
        (0.0, 0.05, 0.17, 0.23, black),
        (-0.2, 0.02, 0.06, 0.14, gray),
        (0.2, 0.02, 0.06, 0.14, gray),
        (-0.09, 0.29, 0.08, 0.04, yellow),
        (0.09, 0.29, 0.08, 0.04, yellow),
    ];
    let inside =
        |(cx, cy, rx, ry, _): &(f64, f64, f64, f64, [f64; 3])| ((x - cx) / rx).powi(2) + ((y - cy) / ry).powi(2) < 1.0;
    parts.iter().find(|part| inside(part)).map(|part| part.4)
}

/// Where the figure of [`figure`] is in its picture: the place of [`figure_at`] in parts of the picture.
fn in_figure(at: [f64; 2], size: [u32; 2], shift: f64) -> [f64; 2] {
    let [w, h] = size.map(f64::from);
    [0.5 + shift + at[0] * h / w, 0.5 + at[1]]
}

/// A figure of black, white, gray and yellow on a desk before a white wall, and its true mask.
fn figure(size: [u32; 2], shift: f64) -> (RgbImage, GrayImage) {
    let [w, h] = size.map(f64::from);
    let place = |x: f64, y: f64| [(x - (0.5 + shift) * w) / h, (y - 0.5 * h) / h];
    let color = |x: f64, y: f64| {
        let [u, v] = place(x, y);
        let behind = if v > 0.27 {
            [150.0 - 20.0 * u, 118.0, 88.0]
        } else {
            [236.0 - 14.0 * u - 8.0 * v, 234.0 - 14.0 * u, 230.0 - 12.0 * u]
        };
        figure_at(u, v).map_or(behind, |own| own.map(|c| c * (1.0 - 0.12 * u)))
    };
    let mut rng = rand_pcg::Pcg64::new(7, 7);
    let picture = RgbImage::from_fn(size[0], size[1], |x, y| {
        // Nine samples a pixel, and noise of six levels either way.
        let samples =
            (0..9).map(|i| color(f64::from(x) + f64::from(i % 3) / 3.0, f64::from(y) + f64::from(i / 3) / 3.0));
        let sum = samples.fold([0.0; 3], |sum, c| std::array::from_fn(|k| sum[k] + c[k]));
        image::Rgb(sum.map(|sum| (sum / 9.0 + rng.random_range(-6.0..6.0)).clamp(0.0, 255.0) as u8))
    });
    let truth = GrayImage::from_fn(size[0], size[1], |x, y| {
        let [u, v] = place(f64::from(x) + 0.5, f64::from(y) + 0.5);
        Luma([if figure_at(u, v).is_some() { 255 } else { 0 }])
    });
    (picture, truth)
}

/// Sizes of the figure's picture, and how far it stands from the middle.
const FIGURES: [([u32; 2], f64); 3] = [([640, 480], -0.08), ([480, 640], 0.0), ([960, 540], 0.08)];
/// Its face, an eye, its beak, scarf, belly, body, an arm and a foot.
const PARTS: [[f64; 2]; 8] =
    [[0.06, -0.21], [0.035, -0.235], [0.0, -0.19], [0.05, -0.11], [0.0, 0.07], [0.14, 0.05], [-0.23, 0.02], [0.1, 0.3]];

fn is_on(mask: &GrayImage, at: [f64; 2]) -> bool {
    let [x, y] = [at[0] * f64::from(mask.width()), at[1] * f64::from(mask.height())];
    mask.get_pixel(x as u32, y as u32).0[0] != 0
}

/// Whatever was clicked before, what is clicked is in the mask, or out of it.
#[test]
fn what_is_clicked_is_in_or_out() {
    for (size, shift) in FIGURES.into_iter().take(2) {
        let (picture, _) = figure(size, shift);
        let mut marks = vec![];
        let mut mask = GrayImage::new(size[0], size[1]);
        // From the body on, as a user did whose click in the face changed nothing.
        for part in PARTS.iter().rev() {
            marks.push(object(in_figure(*part, size, shift)));
            mask = next(&picture, &marks, &mask, &Cues::default());
            for mark in &marks {
                assert!(is_on(&mask, mark.click().unwrap().0), "{mark:?} after {} marks", marks.len());
            }
        }
        for beside in [[0.3, -0.3], [0.0, -0.39], [0.0, 0.45]] {
            let at = in_figure(beside, size, shift);
            marks.push(Mark::Background { at });
            mask = next(&picture, &marks, &mask, &Cues::default());
            assert!(!is_on(&mask, at), "{beside:?}");
        }
        // Also what is of the object for certain, and of one colour with it.
        let at = in_figure(PARTS[4], size, shift);
        marks.push(Mark::Background { at });
        let mask = next(&picture, &marks, &mask, &Cues::default());
        let contrary = in_figure([PARTS[4][0] + 0.03, PARTS[4][1]], size, shift);
        marks.push(object(contrary));
        let mask = next(&picture, &marks, &mask, &Cues::default());
        assert!(!is_on(&mask, at) && is_on(&mask, contrary));
    }
}

/// A click on the object takes nothing away, one beside it adds nothing, and both leave alone what is far away.
#[test]
fn a_further_click_keeps_what_others_hold() {
    for (size, shift) in FIGURES.into_iter().take(1) {
        let (picture, truth) = figure(size, shift);
        let body = object(in_figure(PARTS[5], size, shift));
        for part in PARTS {
            let at = in_figure(part, size, shift);
            // The figure without what is about the part: a mask that a click there completes.
            let near = |x: u32, y: u32, radius: f64| {
                let [u, v] = [f64::from(x) / f64::from(size[0]), f64::from(y) / f64::from(size[1])];
                let [w, h] = size.map(f64::from);
                f64::hypot((u - at[0]) * w, (v - at[1]) * h) < radius * h
            };
            let region = 0.05;
            for (adds, mark) in [(true, object(at)), (false, Mark::Background { at })] {
                let before = GrayImage::from_fn(size[0], size[1], |x, y| {
                    let on = truth.get_pixel(x, y).0[0] != 0;
                    Luma([if on && !(adds && near(x, y, region)) { 255 } else { 0 }])
                });
                let after = next(&picture, &[body.clone(), mark], &before, &Cues::default());
                for (x, y, is) in after.enumerate_pixels() {
                    let was = before.get_pixel(x, y);
                    assert!(is == was || (is.0[0] != 0) == adds, "{part:?} {adds}: {x} {y}");
                    assert!(!adds || is == was || near(x, y, 2.0 * region), "{part:?}: {x} {y} is far away");
                }
            }
        }
    }
}

/// The third click, on a small spot of the background's colour at the object's outline, changes what is near and no more.
#[test]
fn a_third_click_at_the_outline_leaves_the_rest() {
    let mut rng = rand_pcg::Pcg64::new(3, 3);
    let spot = |x: u32, y: u32| (84..90).contains(&x) && (40..46).contains(&y);
    let square = |x: u32, y: u32| (50..90).contains(&x) && (40..80).contains(&y);
    let picture = RgbImage::from_fn(160, 120, |x, y| {
        let color = match (square(x, y) && !spot(x, y), spot(x, y) || (90..150).contains(&x) && (20..80).contains(&y)) {
            (true, _) => [130, 130, 135],
            (_, true) => [90, 140, 60],
            _ => [60, 80, 150],
        };
        image::Rgb(color.map(|v| v + rng.random_range(0..12)))
    });
    let mark = |x: f64, y: f64| [x / 160.0, y / 120.0];
    let marks = [object(mark(70.0, 60.0)), Mark::Background { at: mark(20.0, 20.0) }, object(mark(87.0, 43.0))];
    let before = GrayImage::from_fn(160, 120, |x, y| Luma([if square(x, y) && !spot(x, y) { 255 } else { 0 }]));
    let far = |x: u32, y: u32| f64::hypot(f64::from(x) - 87.0, f64::from(y) - 43.0) > 40.0;
    let changed = |after: &GrayImage| {
        after.enumerate_pixels().filter(|(x, y, is)| *is != before.get_pixel(*x, *y) && far(*x, *y)).count()
    };
    let after = next(&picture, &marks, &before, &Cues::default());
    assert!(is_on(&after, mark(87.0, 43.0)) && changed(&after) == 0, "{}", changed(&after));
    // All three from the beginning flood the background of that colour.
    let anew = super::found(&picture, &marks, &Cues::default());
    assert!(changed(&anew) > 500, "{}", changed(&anew));
}

/// Steps go from a colour to the whole and back, never past the ends.
#[test]
fn steps_go_to_larger_and_smaller_segments() {
    for (size, shift) in FIGURES {
        let (picture, truth) = figure(size, shift);
        let at = in_figure(PARTS[4], size, shift);
        let of = |scale| mask(&picture, &[Mark::Object { at, scale }], &Cues::default());
        let masks: Vec<GrayImage> = [-30, -2, -1, 1, 2, 3, 4, 5, 6, 29, 30].map(of).to_vec();
        let area = |mask: &GrayImage| mask.as_raw().iter().filter(|v| **v != 0).count();
        let areas: Vec<usize> = masks.iter().map(area).collect();
        let best = masks.iter().map(|mask| iou(mask, &truth)).fold(0.0, f64::max);
        println!("{size:?}: areas {areas:?}, best {best:.3}");
        assert!(areas.is_sorted() && areas[0] > 0 && areas[9] == areas[10] && best > 0.95, "{areas:?} {best}");
    }
}

#[test]
fn a_lasso_is_as_good_as_a_box() {
    for (size, shift) in FIGURES {
        let (picture, truth) = figure(size, shift);
        let (row, _) = row(&picture, &truth, &Cues::default());
        print(&format!("{size:?}"), &row);
        let [[.., clicks], [boxed, ..], [lasso, ..], ..] = row;
        assert!(boxed.min(lasso) > 0.95 && clicks > 0.8, "{row:?}");
    }
}

/// In a box around a figure and what stands beside it, a click on the latter takes that out and leaves the figure.
/// A statue of the stone of its plinth, which stands on stone, before a dark wood; its lasso cuts into it here and there, as a hand does.
#[test]
fn what_is_deep_in_an_outline_is_the_object() {
    let speck = |x: u32, y: u32| ((x * 7919 + y * 104_729 + x * y * 31) % 41) as u8;
    let statue = |x: u32, y: u32| (50..110).contains(&x) && (30..90).contains(&y) || plinth(x, y);
    fn plinth(x: u32, y: u32) -> bool {
        (40..120).contains(&x) && (90..112).contains(&y)
    }
    let picture = RgbImage::from_fn(160, 150, |x, y| {
        let s = speck(x, y);
        image::Rgb(match (plinth(x, y), statue(x, y), y > 80) {
            (true, ..) => [150 + s, 150 + s, 146 + s],
            (_, true, _) => [110 + s, 110 + s, 108 + s],
            (_, _, true) => [152 + s, 148 + s, 138 + s],
            _ => [20 + s, 45 + s, 20 + s],
        })
    });
    let truth = GrayImage::from_fn(160, 150, |x, y| Luma([if statue(x, y) { 255 } else { 0 }]));
    let line =
        [[48, 28], [112, 27], [111, 60], [108, 88], [123, 92], [118, 114], [80, 111], [38, 113], [41, 92], [52, 86]];
    let points = line.map(|[x, y]| [f64::from(x) / 160.0, f64::from(y) / 150.0]).to_vec();
    let found = mask(&picture, &[Mark::Lasso { points }], &Cues::default());
    assert!(iou(&found, &truth) > 0.9, "{}", iou(&found, &truth));
}

/// A click beside an object whose models run out of pixels takes away what it is on, and no more.
#[test]
fn a_click_that_finds_nothing_leaves_the_rest() {
    let picture =
        RgbImage::from_fn(120, 90, |x, y| image::Rgb([if x < 90 { 120 } else { 60 }, 90 + (y % 2) as u8, 80]));
    let bounds = [0.0, 0.0, 1.0, 1.0];
    let marks = [Mark::Box { bounds }, Mark::Background { at: [0.9, 0.5] }];
    let whole = GrayImage::from_pixel(120, 90, Luma([255]));
    let found = next(&picture, &marks, &whole, &Cues::default());
    assert!(is_on(&found, [0.3, 0.5]) && !is_on(&found, [0.9, 0.5]));
}

#[test]
fn a_click_takes_out_of_a_box_what_it_is_on() {
    let (size, shift) = FIGURES[2];
    let (mut picture, truth) = figure(size, shift);
    for (x, y, pixel) in
        picture.enumerate_pixels_mut().filter(|(x, y, _)| (280..360).contains(x) && (250..330).contains(y))
    {
        *pixel = image::Rgb([40, 90 + (x * 7 % 13) as u8, 150 + (y * 5 % 11) as u8]);
    }
    let bounds = [270.0 / 960.0, 0.1, 0.78, 0.9];
    let marks = [Mark::Box { bounds }, Mark::Background { at: [320.0 / 960.0, 290.0 / 540.0] }];
    let boxed = next(&picture, &marks[..1], &GrayImage::new(size[0], size[1]), &Cues::default());
    assert!(is_on(&boxed, [320.0 / 960.0, 290.0 / 540.0]), "the case is too easy");
    let clicked = next(&picture, &marks, &boxed, &Cues::default());
    assert!(iou(&clicked, &truth) > 0.95, "{} of {}", iou(&clicked, &truth), iou(&boxed, &truth));
}

/// A second line adds what is in it; what lies beyond lines is in none of them.
#[test]
fn lines_enclose_what_they_mean() {
    let around = |x: f64| {
        let corner = |i: u32| {
            let (sin, cos) = (f64::from(i) * std::f64::consts::TAU / 9.0).sin_cos();
            [x + 0.14 * cos, 0.5 + 0.22 * sin]
        };
        Mark::Lasso { points: (0..9).map(corner).collect() }
    };
    let disc = |x: u32, y: u32, at: f64| f64::hypot(f64::from(x) - at, f64::from(y) - 60.0) < 16.0;
    let picture = RgbImage::from_fn(160, 120, |x, y| {
        let noise = ((x * 7 + y * 13) % 17) as u8;
        image::Rgb(match (disc(x, y, 45.0), disc(x, y, 115.0)) {
            (true, _) => [170 + noise, 60 + noise, 40],
            (_, true) => [60, 150 + noise, 60 + noise],
            _ => [60 + noise, 90 + noise, 120],
        })
    });
    let of = |at: f64| GrayImage::from_fn(160, 120, |x, y| Luma([if disc(x, y, at) { 255 } else { 0 }]));
    let marks = [around(45.0 / 160.0), around(115.0 / 160.0)];
    let first = next(&picture, &marks[..1], &GrayImage::new(160, 120), &Cues::default());
    assert!(iou(&first, &of(45.0)) > 0.9, "{}", iou(&first, &of(45.0)));
    let both = next(&picture, &marks, &first, &Cues::default());
    let second = GrayImage::from_fn(160, 120, |x, y| Luma([both.get_pixel(x, y).0[0] - first.get_pixel(x, y).0[0]]));
    assert!(iou(&second, &of(115.0)) > 0.9, "{}", iou(&second, &of(115.0)));
    // A brush means what it covers, whatever that looks like, and takes nothing else along.
    let brush = |object| Mark::Brush { object, radius: 0.02, points: vec![[0.1, 0.9], [0.9, 0.9]] };
    let painted = next(&picture, &[marks[0].clone(), brush(true)], &first, &Cues::default());
    for (x, y, v) in painted.enumerate_pixels() {
        let on = (f64::from(y) + 0.5 - 108.0).abs() <= 3.2 && (16..144).contains(&x);
        let beyond = (f64::from(y) + 0.5 - 108.0).abs() > 3.2 || !(12..148).contains(&x);
        let was = first.get_pixel(x, y).0[0];
        assert!(!on || v.0[0] == 255);
        assert!(!beyond || v.0[0] == was, "{x} {y}");
    }
    let marks = [marks[0].clone(), brush(true), brush(false)];
    assert!(next(&picture, &marks, &painted, &Cues::default()) == first);
}

#[test]
fn marks_that_make_no_sense_are_known() {
    let sound = |text: &str| serde_json::from_str::<Mark>(text).is_ok_and(|mark| mark.is_sound());
    assert!(sound(r#"{"kind":"object","at":[0.5,0.5]}"#) && sound(r#"{"kind":"object","at":[0.5,0.5],"scale":-2}"#));
    assert!(sound(r#"{"kind":"lasso","points":[[0.1,0.1],[0.9,0.1],[0.5,0.9]]}"#));
    assert!(sound(r#"{"kind":"brush","object":false,"radius":0.02,"points":[[0.1,0.1]]}"#));
    for text in [
        r#"{"kind":"object","at":[0.5,0.5],"scale":1000}"#,
        r#"{"kind":"lasso","points":[[0.1,0.1],[0.9,0.1]]}"#,
        r#"{"kind":"lasso","points":[[0.1,0.1],[0.9,0.1],[0.5,0.1]]}"#,
        r#"{"kind":"lasso","points":[[0.1,0.1],[0.9,0.1],[0.5,1.9]]}"#,
        r#"{"kind":"brush","object":false,"radius":0.02,"points":[]}"#,
        r#"{"kind":"brush","object":false,"radius":0,"points":[[0.1,0.1]]}"#,
        r#"{"kind":"brush","object":true,"radius":2,"points":[[0.1,0.1]]}"#,
    ] {
        assert!(!sound(text), "{text}");
    }
}
