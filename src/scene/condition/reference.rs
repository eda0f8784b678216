//! The inpainted picture: how deep its hole is, and how far it is believed.

use image::{GrayImage, Luma};
use rayon::prelude::*;

use super::points::{lift, pixel_of};
use super::sparse::{Sample, fit, samples};
use crate::scene::{Prior, PriorKind, Scene, resample};

/// Depth z of the hole of the reference view \[pixel\], NaN outside it: its prior brought to the scene's depth by the points
/// outside the mask. `None` without a reference, a prior, or enough points.
pub(super) fn hole_depth(scene: &Scene) -> Option<Vec<f32>> {
    let reference = scene.reference.as_ref()?;
    let prior = reference.prior.as_ref()?;
    let view = &scene.train[reference.view];
    let mask = view.mask.as_ref()?;
    let samples = samples(&view.camera, &scene.points, Some(mask));
    let [slope, shift] = fit(prior, &samples).filter(|line| line[0] > 0.0)?;
    let (near, far) = samples.iter().fold((f64::INFINITY, 0.0_f64), |(a, b), s| (a.min(s.depth), b.max(s.depth)));
    let depth = |(m, p): (&u8, &f32)| {
        let value = slope * f64::from(*p) + shift;
        let z = if prior.kind == PriorKind::Disparity { 1.0 / value } else { value };
        // Beyond what the points span the line tells nothing.
        if *m != 0 && z > 0.5 * near && z < 2.0 * far { z as f32 } else { f32::NAN }
    };
    Some(mask.as_raw().iter().zip(&prior.values).map(depth).collect())
}

/// Nearest samples that a pixel's depth is guessed from.
const NEIGHBORS: usize = 48;
/// Colours this far apart (8-bit, root mean square over channels) are taken to be of different surfaces.
const COLOR: f64 = 24.0;

/// A prior for a reference picture that has none, from the points: at each pixel a plane of inverse depth through the
/// nearest points, weighted by their distance and by how alike the colours are. It is smooth where the picture is, and
/// breaks where colours break, like a surface's border.
pub(super) fn guess_prior(scene: &mut Scene) {
    let Some(reference) = &scene.reference else { return };
    let view = &scene.train[reference.view];
    if reference.prior.is_some() {
        return;
    }
    // Points in the hole as well: those on the object have been left out, the others were seen past it.
    let samples = samples(&view.camera, &scene.points, None);
    if samples.len() < NEIGHBORS {
        return;
    }
    let [w, h] = view.camera.size.map(|n| n as usize);
    let picture = reference.image.as_raw();
    // Noise of single pixels tells no surfaces apart.
    let blurred = image::imageops::blur(&reference.image, 1.0 + w as f32 / 250.0);
    let color = |pixel: usize| -> [f64; 3] { std::array::from_fn(|c| f64::from(blurred.as_raw()[3 * pixel + c])) };
    debug_assert_eq!(picture.len(), 3 * w * h);
    let at = |pixel: usize| [(pixel % w) as f64, (pixel / w) as f64];
    let guess = |pixel: usize| {
        let (here, tint) = (at(pixel), color(pixel));
        let mut near: Vec<(f64, &Sample)> = samples
            .iter()
            .map(|s| {
                let there = at(s.pixel);
                ((there[0] - here[0]).powi(2) + (there[1] - here[1]).powi(2), s)
            })
            .collect();
        near.select_nth_unstable_by(NEIGHBORS - 1, |a, b| a.0.total_cmp(&b.0));
        near.truncate(NEIGHBORS);
        let reach = near.iter().fold(1.0_f64, |m, (d, _)| m.max(*d));
        let weighted: Vec<Weighted> = near
            .iter()
            .map(|(d, s)| {
                let other = color(s.pixel);
                let apart: f64 = (0..3).map(|c| (tint[c] - other[c]).powi(2)).sum::<f64>() / 3.0;
                let weight = (-0.5 * apart / COLOR.powi(2)).exp().max(1e-4) / (d + 0.05 * reach);
                let there = at(s.pixel);
                (weight, [there[0] - here[0], there[1] - here[1]], 1.0 / s.depth)
            })
            .collect();
        (1.0 / plane(&weighted, reach)) as f32
    };
    let values: Vec<f32> = (0..w * h).into_par_iter().map(guess).collect();
    let name = view.name.clone();
    scene.reference.as_mut().expect("it was there").prior = Some(Prior { kind: PriorKind::Depth, values });
    scene.notes.push(format!("reference {name}: it has no prior; its depth is guessed from the points around it"));
}

/// A weight, a place, and the value there.
type Weighted = (f64, [f64; 2], f64);

/// The value at the origin of a plane through weighted values, its slope held small by a ridge of a tenth of the spread's
/// weight, within the values' range.
fn plane(weighted: &[Weighted], reach: f64) -> f64 {
    let total: f64 = weighted.iter().map(|(w, ..)| w).sum();
    let mean = |value: &dyn Fn(&Weighted) -> f64| weighted.iter().map(|s| s.0 * value(s)).sum::<f64>() / total;
    let (mx, my, mv) = (mean(&|s| s.1[0]), mean(&|s| s.1[1]), mean(&|s| s.2));
    let ridge = 0.1 * reach;
    let xx = mean(&|s| (s.1[0] - mx).powi(2)) + ridge;
    let yy = mean(&|s| (s.1[1] - my).powi(2)) + ridge;
    let xy = mean(&|s| (s.1[0] - mx) * (s.1[1] - my));
    let xv = mean(&|s| (s.1[0] - mx) * (s.2 - mv));
    let yv = mean(&|s| (s.1[1] - my) * (s.2 - mv));
    let determinant = xx * yy - xy * xy;
    let slope = [(xv * yy - yv * xy) / determinant, (yv * xx - xv * xy) / determinant];
    let (low, high) = weighted.iter().fold((f64::INFINITY, 0.0_f64), |(a, b), s| (a.min(s.2), b.max(s.2)));
    (mv - slope[0] * mx - slope[1] * my).clamp(low, high)
}

/// Lets the train masks fall off to 0 over so many pixels around the object, whose antialiased edge, shadow and glow reach
/// beyond the mask: what is drawn there counts less the nearer it is.
pub(super) fn soften_masks(scene: &mut Scene, rim: u32) {
    for mask in scene.train.iter_mut().filter_map(|v| v.mask.as_mut()) {
        let hard = mask.clone();
        for radius in (1..=rim).rev() {
            let value = (255.0 * (1.0 - f64::from(radius) / f64::from(rim + 1))).round() as u8;
            let grown = resample::dilate(&hard, radius);
            // From the outermost ring inwards: nearer rings overwrite.
            mask.iter_mut().zip(grown.as_raw()).filter(|(_, g)| **g != 0).for_each(|(m, _)| *m = value);
        }
        mask.iter_mut().zip(hard.as_raw()).filter(|(_, h)| **h != 0).for_each(|(m, h)| *m = *h);
    }
}

/// Takes the inpainted picture in its hole and the photograph outside, mixed as the mask falls off: networks that inpaint
/// repaint the surroundings as well, and those were photographed.
pub(super) fn composite(scene: &mut Scene) {
    let Some(reference) = &mut scene.reference else { return };
    let view = &scene.train[reference.view];
    let Some(mask) = &view.mask else { return };
    let pixels = reference.image.pixels_mut().zip(view.image.pixels()).zip(mask.as_raw());
    for ((painted, photographed), m) in pixels {
        let share = f64::from(*m) / 255.0;
        for (p, q) in painted.0.iter_mut().zip(photographed.0) {
            *p = (share * f64::from(*p) + (1.0 - share) * f64::from(q)).round() as u8;
        }
    }
}

/// Lowers the reference's weight where other views see past the object: with n of `enough` views by n / `enough`, so that
/// what was photographed outranks what was painted. Its mask says how much the picture counts; inside it stays above 0.
pub(super) fn outrank(scene: &mut Scene, depth: Option<&[f32]>, enough: u32) {
    let (Some(reference), Some(depth)) = (&scene.reference, depth) else { return };
    let at = reference.view;
    let camera = &scene.train[at].camera;
    let others: Vec<_> = scene.train.iter().enumerate().filter(|(i, _)| *i != at).map(|(_, v)| v).collect();
    let views = |pixel: usize| -> usize {
        let z = depth[pixel];
        let Some(position) = z.is_finite().then(|| lift(camera, pixel, f64::from(z))).flatten() else { return 0 };
        let sees = |view: &&&crate::scene::View| {
            pixel_of(&view.camera, position).is_some_and(|p| view.mask.as_ref().is_none_or(|m| m.as_raw()[p] == 0))
        };
        others.iter().filter(sees).count()
    };
    let Some(mask) = scene.train[at].mask.as_ref() else { return };
    let counted: Vec<usize> = (0..depth.len()).into_par_iter().map(views).collect();
    let lowered = |m: u8, n: usize| {
        let left = 1.0 - (n as f64 / f64::from(enough)).min(1.0);
        if m == 0 { 0 } else { (f64::from(m) * left).round().max(1.0) as u8 }
    };
    let hole = mask.as_raw().iter().filter(|m| **m == 255).count();
    let seen = mask.as_raw().iter().zip(&counted).filter(|(m, n)| **m == 255 && **n >= enough as usize).count();
    let mut new = GrayImage::new(mask.width(), mask.height());
    for ((to, m), n) in new.pixels_mut().zip(mask.as_raw()).zip(&counted) {
        *to = Luma([lowered(*m, *n)]);
    }
    scene.train[at].mask = Some(new);
    if seen > 0 {
        let percent = 100.0 * seen as f64 / hole as f64;
        scene.notes.push(format!(
            "{percent:.0} % of the reference's hole is seen past the object by {enough} views or more, which outrank the \
             painted picture there (scene.outrank_guess)"
        ));
    }
}
