//! Clicks on photographs with true masks: what one, two and three of them come to, in their view and in the others.

use std::path::{Path, PathBuf};
use std::time::Instant;

use image::{GrayImage, Luma, RgbImage};

use super::{Cues, Mark, mask, next};
use crate::gpu::testing;
use crate::prepare::depth::DepthMap;
use crate::prepare::masks::{self, Votes};
use crate::prepare::splats::Splats;
use crate::prepare::{self, Request, Silent};
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
        (Some((at, _)), _) => Some(Mark::Object { at }),
        (None, Some((at, _))) => Some(Mark::Background { at }),
        (None, None) => None,
    }
}

/// Marks of so many clicks, and the masks after each.
fn clicks(picture: &RgbImage, truth: &GrayImage, cues: &Cues<'_>, count: usize) -> Vec<(GrayImage, f64)> {
    let mut marks = vec![];
    let mut found = GrayImage::new(truth.width(), truth.height());
    let mut all = vec![];
    for _ in 0..count {
        let began = Instant::now();
        if let Some(mark) = wanted(&found, truth) {
            marks.push(mark);
            found = next(picture, &marks, &found, cues);
        }
        all.push((found.clone(), began.elapsed().as_secs_f64()));
    }
    all
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

/// Figures of a capture, means over the views: after 1, 2 and 3 clicks and in a box, without the fit and with it; and carried to
/// the other views after 1, 2 and 3 clicks.
struct Found {
    alone: [f64; 3],
    alone_box: f64,
    fitted: [f64; 3],
    fitted_box: f64,
    carried: [f64; 3],
    slowest: f64,
}

/// Measures on every so many-th view. `photographs` is what `prepare` takes, `out` where its fit is or goes.
fn measure(request: &Request, truth: &Path, every: usize) -> Found {
    let gpu = testing::gpu();
    let (scene, fit) = prepare::fitted(&gpu, request, &mut Silent).expect("a fit");
    let mut splats = Splats::new(&gpu, &fit.model, &fit.settings.render).expect("room");
    let files = scene::pictures(&request.out.join("images")).expect("photographs");
    let truths = scene::pictures(truth).expect("masks");
    let truth =
        |name: &str, picture: [u32; 2]| resample::nearest(&scene::mask(&truths[name], 1).expect("a mask"), picture);
    let colors = masks::colors(&mut splats, &scene.train).expect("colours");
    let mut found =
        Found { alone: [0.0; 3], alone_box: 0.0, fitted: [0.0; 3], fitted_box: 0.0, carried: [0.0; 3], slowest: 0.0 };
    let looked: Vec<usize> = (0..scene.train.len()).filter(|i| i % every == every / 2).collect();
    for &i in &looked {
        let view = &scene.train[i];
        let picture = small(&files[&view.name]);
        let own = truth(&view.name, [picture.width(), picture.height()]);
        let depth = DepthMap::of(&mut splats, &view.camera).expect("a depth");
        let with = Cues { depth: Some(&depth), carried: None };
        let share = 1.0 / looked.len() as f64;
        let mut line = view.name.clone();
        for (fitted, cues) in [(false, Cues::default()), (true, with)] {
            let after = clicks(&picture, &own, &cues, 3);
            let ious: [f64; 3] = std::array::from_fn(|n| iou(&after[n].0, &own));
            let of_box = iou(&mask(&picture, &[boxed(&own)], &cues), &own);
            line += &format!("  {ious:.3?} box {of_box:.3}");
            let (sums, sum) = if fitted {
                (&mut found.fitted, &mut found.fitted_box)
            } else {
                (&mut found.alone, &mut found.alone_box)
            };
            sums.iter_mut().zip(ious).for_each(|(sum, iou)| *sum += share * iou);
            *sum += share * of_box;
            found.slowest = after.iter().map(|(_, seconds)| *seconds).fold(found.slowest, f64::max);
            if !fitted {
                continue;
            }
            for (n, (given, _)) in after.iter().enumerate() {
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
        println!("{line}");
    }
    let Found { alone, alone_box, fitted, fitted_box, carried, slowest } = &found;
    println!(
        "mean IoU after 1, 2, 3 clicks: colours alone {alone:.3?}, in a box {alone_box:.3}; with the fit {fitted:.3?}, in a \
         box {fitted_box:.3}; carried to the others {carried:.3?}; slowest cut {slowest:.2} s, {} views",
        looked.len()
    );
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
    assert!(found.alone[2] > 0.8 && found.fitted[2] > 0.85 && found.carried[2] > 0.75);
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
