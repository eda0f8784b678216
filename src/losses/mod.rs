//! What a render is compared with: the photograph, and the view's depth prior.
//!
//! To add a loss: one `.comp`, one `.rs` beside it with its [`Term`] (name, stage, when a run has it, what its passes have to
//! do), and here its module, its line in [`Term::ALL`] and its call in [`Losses::compare`].

pub mod align;
pub mod config;
pub mod depth_gradient;
pub mod depth_l1;
pub mod frame;
pub mod photometric;

pub use config::Config;
mod sum;

use crate::cost::Formula;
use crate::gpu::{Buffer, Error, Gpu, Recorder};

pub use align::Quantity;
pub use frame::{NO_PRIOR, Weights, pack};

/// A term of the loss, as its own file declares it. Their sum is what a step minimises: each carries its weight.
#[derive(Clone, Copy, Debug)]
pub struct Term {
    /// As reports spell it.
    pub name: &'static str,
    /// Its stage of a step; terms may share one.
    pub stage: &'static str,
    /// Whether a run has it.
    pub planned: fn(&Plan) -> bool,
    /// What a plan that leaves it out calls it, the nearest first.
    pub left_out: &'static [&'static str],
    /// What its passes have to do.
    costs: &'static [Formula],
}

impl Term {
    /// All, by their place in [`Losses::terms`].
    pub const ALL: [Self; 3] = [photometric::TERM, depth_l1::TERM, depth_gradient::TERM];

    /// The one with this stage, the last of several.
    pub fn of_stage(stage: &str) -> Option<Self> {
        Self::ALL.into_iter().rfind(|term| term.stage == stage)
    }

    /// Its place in [`Losses::terms`].
    pub(crate) fn slot(self) -> u32 {
        Self::ALL.iter().position(|term| term.name == self.name).expect("all are listed") as u32
    }
}

/// What the passes of all losses have to do.
pub fn costs() -> impl Iterator<Item = &'static Formula> {
    let shared = [frame::COSTS, align::COSTS, sum::COSTS];
    shared.into_iter().chain(Term::ALL.map(|term| term.costs)).flatten()
}

/// Which losses a run has: what is not planned has no pass and no buffer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plan {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Share of 1 - SSIM in the photometric loss, the rest is L1.
    pub ssim_weight: f32,
    /// Whether pixels have weights: a view has a mask, or a prior that is not everywhere.
    pub masks: bool,
    /// Whether SSIM's windows compare what lies inside the masks of views whose weight there is 0.
    pub ssim_across_masks: bool,
    /// Whether any view has a depth prior.
    pub depth: bool,
    /// Scales of the depth gradient, 1 to 8; 0 without that loss.
    pub gradient_scales: u32,
}

/// What the step's view is compared with.
#[derive(Clone, Copy)]
pub struct View<'a> {
    /// The photograph \[pixel\], see [`pack`].
    pub picture: &'a Buffer<u32>,
    /// Photometric weights; without masks every pixel weighs one.
    pub weights: Weights,
    /// Its depth prior.
    pub depth: Option<DepthView<'a>>,
}

/// A view's depth prior and how it counts.
#[derive(Clone, Copy)]
pub struct DepthView<'a> {
    /// The prior \[pixel\].
    pub prior: &'a Buffer<f32>,
    /// What the prior means.
    pub quantity: Quantity,
    /// Weights of the L1 loss; without masks every pixel weighs `outside`.
    pub weights: Weights,
    /// Factor of the depth gradient; 0 leaves it out.
    pub gradient: f32,
    /// Whether the depth gradient looks inside the mask too.
    pub gradient_inside: bool,
    /// Whether the prior lacks pixels ([`NO_PRIOR`]); with masks only.
    pub gaps: bool,
    /// What brings the rendered depth (or disparity) to the prior's values, [`align::fixed`]; without it that is fitted in
    /// each step (GScream, equation 4).
    pub fit: Option<&'a Buffer<f32>>,
}

/// Gradients of all losses by what was rendered.
#[derive(Clone, Copy, Debug)]
pub struct Gradients<'a> {
    /// By the colour \[pixel\].
    pub rgb: &'a Buffer<[f32; 3]>,
    /// By the depth \[pixel\], if the view has a prior.
    pub depth: Option<&'a Buffer<f32>>,
}

/// The losses of a step and their gradients by the render.
#[derive(Debug)]
pub struct Losses {
    frame: frame::Frame,
    photometric: photometric::Photometric,
    depth: Option<Depth>,
    terms: Buffer<f32>,
}

#[derive(Debug)]
struct Depth {
    align: align::Align,
    l1: depth_l1::DepthL1,
    gradient: Option<depth_gradient::DepthGradient>,
}

impl Losses {
    /// Buffers of what is planned.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, plan: &Plan) -> Result<Self, Error> {
        let Plan { size, masks, gradient_scales: scales, .. } = *plan;
        let gradient =
            || gpu.stage(depth_gradient::TERM.stage, || depth_gradient::DepthGradient::new(gpu, size, scales, masks));
        let depth = || -> Result<Depth, Error> {
            Ok(Depth {
                align: align::Align::new(gpu, size)?,
                l1: depth_l1::DepthL1::new(gpu, size)?,
                gradient: if scales > 0 { Some(gradient()?) } else { None },
            })
        };
        gpu.stage(photometric::TERM.stage, || {
            Ok(Self {
                frame: frame::Frame::new(gpu, size, masks, plan.depth)?,
                photometric: photometric::Photometric::new(gpu, size, plan.ssim_weight, plan.ssim_across_masks)?,
                depth: if plan.depth { Some(gpu.stage(depth_l1::TERM.stage, depth)?) } else { None },
                terms: gpu.buffer("losses", Term::ALL.len())?,
            })
        })
    }

    /// Records all losses of the render (`rgb` and `depth` \[pixel\]) against the view, and their gradients.
    ///
    /// A view whose prior was not planned for is compared in colour only.
    pub fn forward_backward(
        &self,
        rec: &mut Recorder<'_>,
        view: &View<'_>,
        rgb: &Buffer<[f32; 3]>,
        depth: Option<&Buffer<f32>>,
    ) -> Gradients<'_> {
        self.expand(rec, view);
        self.compare(rec, view.depth, rgb, depth)
    }

    /// Records the expansion of a view into the frame's arrays, which [`Losses::compare`] reads.
    pub fn expand(&self, rec: &mut Recorder<'_>, view: &View<'_>) {
        rec.stage(photometric::TERM.stage);
        self.frame.forward(rec, view.picture, view.weights, view.depth.map(|d| (d.weights, d.prior)));
    }

    /// The arrays of the current view, which [`Losses::compare`] reads.
    pub fn frame(&self) -> &frame::Frame {
        &self.frame
    }

    /// As [`Losses::forward_backward`], with the frame's arrays as they are.
    pub fn compare(
        &self,
        rec: &mut Recorder<'_>,
        view: Option<DepthView<'_>>,
        rgb: &Buffer<[f32; 3]>,
        depth: Option<&Buffer<f32>>,
    ) -> Gradients<'_> {
        let Self { frame, photometric, depth: stages, terms } = self;
        rec.stage(photometric::TERM.stage);
        rec.zero(terms);
        let planned = stages.as_ref().zip(depth).zip(view);
        let grad_depth = planned.map(|((Depth { align, l1, gradient }, depth), view)| {
            rec.stage(depth_l1::TERM.stage);
            let prior = align::Prior { values: view.prior, quantity: view.quantity, valid: frame.valid() };
            let fit = view.fit.unwrap_or_else(|| align.forward(rec, depth, prior));
            let weight =
                frame.depth_weight().map_or(depth_l1::Weight::All(view.weights.outside), depth_l1::Weight::Each);
            let slot = depth_l1::TERM.slot();
            let (difference, grad_aligned) = l1.forward_backward(rec, depth, prior, fit, weight, terms, slot);
            if let Some(gradient) = gradient.as_ref().filter(|_| view.gradient != 0.0) {
                let valid = if view.gradient_inside { frame.given().filter(|_| view.gaps) } else { frame.valid() };
                let slot = depth_gradient::TERM.slot();
                rec.stage(depth_gradient::TERM.stage);
                gradient.forward_backward(rec, difference, grad_aligned, valid, view.gradient, terms, slot);
                rec.stage(depth_l1::TERM.stage);
            }
            align.backward(rec, grad_aligned, depth, prior, fit)
        });
        // Last: its sum is the last to be written, and the others' need not wait for it.
        rec.stage(photometric::TERM.stage);
        let slot = photometric::TERM.slot();
        let grad_rgb = photometric.forward_backward(rec, rgb, frame.target(), frame.weight(), terms, slot);
        Gradients { rgb: grad_rgb, depth: grad_depth }
    }

    /// The last step's loss terms, each with its weight, by [`Term`]; 0 for those that the view has not.
    pub fn terms(&self) -> &Buffer<f32> {
        &self.terms
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::{self, UNWRITTEN};
    use crate::math::align::{Fit, alignable, sums};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    const SIZES: [[u32; 2]; 6] = [[2, 2], [1, 17], [63, 2], [5, 300], [53, 37], [252, 142]];

    /// A depth map and a prior for it.
    struct Maps {
        size: [u32; 2],
        rendered: Vec<f32>,
        prior: Vec<f32>,
        valid: Vec<f32>,
        weight: Vec<f32>,
    }

    impl Maps {
        /// `prior = slope x + 0.05 + noise` of x = the rendered depth between 0 and 6 or its disparity.
        fn new(size: [u32; 2], seed: u64, slope: f64, quantity: Quantity) -> Self {
            let mut rng = Pcg32::seed_from_u64(seed);
            let pixels = size[0] * size[1];
            let rendered: Vec<f32> = (0..pixels).map(|_| 6.0 * rng.random::<f32>()).collect();
            let prior = rendered.iter().map(|&d| {
                let x = alignable(d.into(), quantity.near().into());
                (slope * x + 0.05 + 0.1 * slope.abs() * rng.random::<f64>()) as f32
            });
            let prior = prior.collect();
            let inside = |p: u32| {
                let (x, y) = (p % size[0] * 8 / size[0], p / size[0] * 8 / size[1]);
                (2..5).contains(&x) && (2..6).contains(&y)
            };
            let of = |inside_value, outside_value| {
                (0..pixels).map(|p| if inside(p) { inside_value } else { outside_value }).collect()
            };
            Self { size, rendered, prior, valid: of(0.0, 1.0), weight: of(100.0, 1.0) }
        }

        /// Fit, terms and gradient by the rendered depth. `checked` compares every pass with its twin.
        fn run(
            &self,
            gpu: &Gpu,
            quantity: Quantity,
            gradient_valid: bool,
            checked: bool,
        ) -> ([f64; 11], [f32; 2], Vec<f32>) {
            let Self { size, rendered, prior, valid, weight } = self;
            let upload = |name, data: &[f32]| gpu.upload(name, data).expect("upload");
            let (rendered, prior) = (upload("rendered", rendered), upload("prior", prior));
            let (valid, weight) = (upload("valid", valid), upload("weight", weight));
            let terms = upload("terms", &[UNWRITTEN; 2]);
            let align = align::Align::new(gpu, *size).expect("buffers");
            let l1 = depth_l1::DepthL1::new(gpu, *size).expect("buffers");
            let gradient = depth_gradient::DepthGradient::new(gpu, *size, 4, gradient_valid).expect("buffers");
            let prior = align::Prior { values: &prior, quantity, valid: Some(&valid) };
            let mut rec = if checked { gpu.checked() } else { gpu.recorder() }.expect("recorder");
            let fit = align.forward(&mut rec, &rendered, prior);
            let weight = depth_l1::Weight::Each(&weight);
            let (difference, grad_aligned) = l1.forward_backward(&mut rec, &rendered, prior, fit, weight, &terms, 0);
            let mask = gradient_valid.then_some(&valid);
            gradient.forward_backward(&mut rec, difference, grad_aligned, mask, 0.5, &terms, 1);
            let grad = align.backward(&mut rec, grad_aligned, &rendered, prior, fit);
            finish(rec);
            let fit = gpu.read(fit).expect("read");
            let terms = gpu.read(&terms).expect("read");
            (std::array::from_fn(|i| fit[i].into()), [terms[0], terms[1]], gpu.read(grad).expect("read"))
        }

        /// The whole loss in float64 for these rendered depths.
        fn loss(&self, rendered: &[f64], quantity: Quantity, gradient_valid: bool) -> f64 {
            let double = |v: &[f32]| -> Vec<f64> { v.iter().map(|&v| f64::from(v)).collect() };
            let (prior, valid, weight) = (double(&self.prior), double(&self.valid), double(&self.weight));
            let x: Vec<f64> = rendered.iter().map(|&d| alignable(d, quantity.near().into())).collect();
            let fit = Fit::of(sums(&x, &prior, &valid));
            let d: Vec<f64> = x.iter().zip(&prior).map(|(x, p)| fit.scale * x + fit.shift - p).collect();
            let mask = if gradient_valid { valid } else { vec![1.0; d.len()] };
            let mut loss: f64 = d.iter().zip(&weight).map(|(d, w)| w * d.abs()).sum::<f64>() / d.len() as f64;
            let [width, height] = self.size.map(|v| v as usize);
            for step in [1, 2, 4, 8] {
                let (mut variation, mut count) = (0.0, 0.0);
                for y in (0..height).step_by(step) {
                    for x in (0..width).step_by(step) {
                        let i = y * width + x;
                        count += mask[i];
                        for (there, j) in [(x + step < width, i + step), (y + step < height, i + step * width)] {
                            if there {
                                variation += mask[i] * mask[j] * (mask[j] * d[j] - mask[i] * d[i]).abs();
                            }
                        }
                    }
                }
                if count > 0.0 {
                    loss += 0.5 * variation / count;
                }
            }
            loss
        }
    }

    fn finish(rec: Recorder<'_>) {
        let submission = rec.submit().expect("submit");
        for difference in &submission.differences {
            assert!(difference.ok(), "{difference}");
        }
        submission.wait().expect("wait");
    }

    const DISPARITY: Quantity = Quantity::Disparity { near: 0.2 };

    /// What is drawn elsewhere, right or wrong, changes nothing at a pixel where the alignment is given.
    #[test]
    fn a_given_fit_has_no_gradient_of_its_own() {
        let gpu = testing::gpu();
        let size = [53, 37];
        let maps = Maps::new(size, 3, 0.12, Quantity::Depth);
        let [rendered, values, weight] =
            [&maps.rendered, &maps.prior, &maps.weight].map(|data| gpu.upload("map", data).expect("upload"));
        let terms = gpu.upload("terms", &[UNWRITTEN; 1]).expect("upload");
        let align = align::Align::new(&gpu, size).expect("buffers");
        let l1 = depth_l1::DepthL1::new(&gpu, size).expect("buffers");
        let [scale, shift] = [0.125_f32, -0.5];
        let fit = gpu.upload("fit", &align::fixed([scale.into(), shift.into()])).expect("upload");
        let prior = align::Prior { values: &values, quantity: Quantity::Depth, valid: None };
        let mut rec = gpu.checked().expect("recorder");
        let weight = depth_l1::Weight::Each(&weight);
        let (_, grad_aligned) = l1.forward_backward(&mut rec, &rendered, prior, &fit, weight, &terms, 0);
        let grad = align.backward(&mut rec, grad_aligned, &rendered, prior, &fit);
        finish(rec);
        let grad = gpu.read(grad).expect("read");
        let pixels = f64::from(size[0] * size[1]);
        let mut loss = 0.0;
        for (i, grad) in grad.iter().enumerate() {
            let d = f64::from(scale) * f64::from(maps.rendered[i]) + f64::from(shift) - f64::from(maps.prior[i]);
            loss += f64::from(maps.weight[i]) * d.abs() / pixels;
            let want = f64::from(scale * maps.weight[i]) * d.signum() / pixels;
            // Two roundings; a sign is not asked for within the rounding of the difference.
            assert!(d.abs() < 1e-6 || (f64::from(*grad) - want).abs() <= 3e-7 * want.abs(), "{i}: {grad} {want}");
        }
        // 2,000 terms of one sign in a tree.
        let got = f64::from(gpu.read(&terms).expect("read")[0]);
        assert!((got - loss).abs() < 3e-6 * loss, "{got} {loss}");
    }

    #[test]
    fn every_pass_of_the_depth_losses_matches_its_twin() {
        let gpu = testing::gpu();
        for size in SIZES {
            for (seed, slope) in [(1, 0.12), (2, -0.3)] {
                for quantity in [Quantity::Depth, DISPARITY] {
                    for gradient_valid in [false, true] {
                        Maps::new(size, seed, slope, quantity).run(&gpu, quantity, gradient_valid, true);
                    }
                }
            }
        }
    }

    #[test]
    fn gradient_through_the_fit_is_the_slope_of_the_definition() {
        let gpu = testing::gpu();
        for size in [[2, 2], [19, 13], [3, 30], [30, 3]] {
            for (seed, slope) in [(3, 0.12), (4, -0.3)] {
                for quantity in [Quantity::Depth, DISPARITY] {
                    for gradient_valid in [false, true] {
                        let maps = Maps::new(size, seed, slope, quantity);
                        let (fit, terms, grad) = maps.run(&gpu, quantity, gradient_valid, false);
                        assert!(fit[4] * slope > 0.0, "{fit:?}");
                        let mut rendered: Vec<f64> = maps.rendered.iter().map(|&v| v.into()).collect();
                        let want = maps.loss(&rendered, quantity, gradient_valid);
                        // The differences cancel to a tenth or so of the values.
                        assert!((f64::from(terms[0] + terms[1]) - want).abs() < 3e-5 * want, "{terms:?}, {want}");
                        let largest = grad.iter().fold(0.0_f64, |m, g| m.max(f64::from(g.abs())));
                        let (mut at_kink, step) = (0, 1e-6);
                        for (i, &got) in grad.iter().enumerate() {
                            let old = rendered[i];
                            let mut at = |d: f64| {
                                rendered[i] = old + d;
                                let loss = maps.loss(&rendered, quantity, gradient_valid);
                                rendered[i] = old;
                                loss
                            };
                            let (above, below) = ((at(step) - want) / step, (want - at(-step)) / step);
                            // Both sides differ by the curvature (of 1 / depth: up to 2 / near^3 = 250 times the step)
                            // unless a kink lies between them.
                            if (above - below).abs() > 1e-3 * largest {
                                at_kink += 1;
                                continue;
                            }
                            let slope = 0.5 * (above + below);
                            // 1e-5 of rounding on the device; 1e-16 / 1e-6 in the quotient; the curvature's own change.
                            let limit = 1e-4 * largest + 1e-8;
                            assert!(
                                (slope - f64::from(got)).abs() < limit,
                                "{size:?} {quantity:?} [{i}] {got}, slope {slope}"
                            );
                        }
                        assert!(at_kink <= grad.len() / 50, "{at_kink} of {}", grad.len());
                    }
                }
            }
        }
    }

    #[test]
    fn a_fit_to_nothing_has_no_gradient() {
        let gpu = testing::gpu();
        for quantity in [Quantity::Depth, DISPARITY] {
            let good = || Maps::new([53, 37], 7, 0.2, quantity);
            let n = 53 * 37;
            let mut one = vec![0.0; n];
            one[1000] = 1.0;
            for (case, maps) in [
                ("one pixel", Maps::new([1, 1], 7, 0.2, quantity)),
                ("one valid pixel", Maps { valid: one, ..good() }),
                ("no valid pixel", Maps { valid: vec![0.0; n], ..good() }),
                ("one depth", Maps { rendered: vec![3.3; n], ..good() }),
                ("nothing rendered", Maps { rendered: vec![0.0; n], ..good() }),
            ] {
                // Distances from the mean are nothing but rounding, which the twins do not share.
                let (fit, terms, grad) = maps.run(&gpu, quantity, false, false);
                assert_eq!([fit[0], fit[1]], [0.0, 0.0], "{case}");
                assert!(grad.iter().all(|&g| g == 0.0), "{case}");
                let rendered: Vec<f64> = maps.rendered.iter().map(|&v| v.into()).collect();
                let want = maps.loss(&rendered, quantity, false);
                assert!((f64::from(terms[0] + terms[1]) - want).abs() < 1e-5 * want, "{case}: {terms:?}, {want}");
            }
        }
    }

    #[test]
    fn no_weight_and_no_variation_no_gradient() {
        let gpu = testing::gpu();
        let size = [53, 37];
        let nothing = vec![0.0; 53 * 37];
        let maps = Maps { weight: nothing.clone(), ..Maps::new(size, 8, 0.2, Quantity::Depth) };
        let (_, terms, _) = maps.run(&gpu, Quantity::Depth, true, true);
        assert_eq!(terms[0], 0.0);
        let maps = Maps { valid: nothing, ..maps };
        let (_, terms, grad) = maps.run(&gpu, Quantity::Depth, true, true);
        assert!(terms == [0.0, 0.0] && grad.iter().all(|&g| g == 0.0), "{terms:?}");
    }

    #[test]
    fn a_prior_of_one_value_flattens_nothing_else() {
        let gpu = testing::gpu();
        let maps = Maps { prior: vec![0.7; 53 * 37], ..Maps::new([53, 37], 9, 0.2, Quantity::Depth) };
        // Every difference is at its kink, so that signs are the rounding's: not compared with the twins.
        let (fit, terms, grad) = maps.run(&gpu, Quantity::Depth, false, false);
        assert!(fit[0] < 1e-6 && (fit[1] - 0.7).abs() < 1e-6, "{fit:?}");
        assert!(terms[0] < 1e-4 && terms[1] < 1e-5, "{terms:?}");
        // |w| of rounding, and a slope's gradient times the prior's distance from its mean: rounding as well.
        assert!(grad.iter().all(|g| g.abs() < 1e-6), "{:?}", grad.iter().fold(0.0_f32, |m, g| m.max(g.abs())));
    }

    /// Far from zero and nearly flat: the plain determinant would have no digit left in float32.
    #[test]
    fn the_fit_keeps_its_digits() {
        let gpu = testing::gpu();
        let mut rng = Pcg32::seed_from_u64(11);
        let size = [1008, 567];
        let pixels = size[0] * size[1];
        let rendered: Vec<f32> = (0..pixels).map(|_| 1000.0 + rng.random::<f32>()).collect();
        let prior: Vec<f32> = rendered.iter().map(|r| ((f64::from(*r) - 1000.0) * 0.25 + 3.0) as f32).collect();
        let ones = vec![1.0; pixels as usize];
        let maps = Maps { size, rendered, prior, valid: ones.clone(), weight: ones };
        let (fit, ..) = maps.run(&gpu, Quantity::Depth, false, false);
        // The depths are exact; their distances from the mean are good to 6e-8 * 1000 of 0.3, at random.
        assert!((fit[0] - 0.25).abs() < 1e-5 * 0.25, "{fit:?}");
        assert!((fit[0] * fit[2] + fit[1] - fit[6]).abs() < 1e-4, "{fit:?}");
    }

    fn random_view(size: [u32; 2], masks: bool) -> (Vec<u32>, Vec<[f32; 3]>) {
        let mut rng = Pcg32::seed_from_u64(12);
        (0..size[0] * size[1])
            .map(|p| {
                let inside = masks && (3..9).contains(&(p % size[0])) && (2..30).contains(&(p / size[0]));
                (
                    pack(std::array::from_fn(|_| rng.random()), if inside { 255 } else { 0 }),
                    std::array::from_fn(|_| rng.random()),
                )
            })
            .unzip()
    }

    #[test]
    fn all_losses_of_a_step_match_their_twins() {
        let gpu = testing::gpu();
        for size in SIZES {
            for (masks, ssim_across_masks, gaps) in [(false, true, false), (true, true, false), (true, false, true)] {
                let plan = Plan { size, ssim_weight: 0.2, masks, ssim_across_masks, depth: true, gradient_scales: 4 };
                let losses = Losses::new(&gpu, &plan).expect("buffers");
                let (picture, rgb) = random_view(size, masks);
                let picture = gpu.upload("picture", &picture).expect("upload");
                let rgb = gpu.upload("rgb", &rgb).expect("upload");
                let mut maps = Maps::new(size, 13, 0.2, DISPARITY);
                if gaps {
                    maps.prior.iter_mut().skip(1).step_by(3).for_each(|p| *p = NO_PRIOR);
                }
                let depth = gpu.upload("depth", &maps.rendered).expect("upload");
                let prior = gpu.upload("prior", &maps.prior).expect("upload");
                let of_depth = DepthView {
                    fit: None,
                    prior: &prior,
                    quantity: DISPARITY,
                    weights: Weights { outside: 1.0, inside: 100.0 },
                    gradient: 0.5,
                    gradient_inside: true,
                    gaps,
                };
                let reference =
                    View { picture: &picture, weights: Weights { outside: 1.0, inside: 20.0 }, depth: Some(of_depth) };
                let other_depth = DepthView {
                    fit: None,
                    weights: Weights { outside: 0.1, inside: 0.0 },
                    gradient: 0.05,
                    gradient_inside: false,
                    ..of_depth
                };
                let weights = Weights { outside: 1.0, inside: 0.0 };
                let other = View { weights, depth: Some(other_depth), ..reference };
                let plain = View { depth: None, ..other };
                for (view, with_depth) in [(reference, true), (other, true), (plain, false)] {
                    let mut rec = gpu.checked().expect("recorder");
                    let gradients = losses.forward_backward(&mut rec, &view, &rgb, Some(&depth));
                    assert_eq!(gradients.depth.is_some(), with_depth);
                    finish(rec);
                    let terms = gpu.read(losses.terms()).expect("read");
                    assert!(terms[0] > 0.0, "{terms:?}");
                    let expected = with_depth && size[0] * size[1] > 17;
                    assert!(!expected || terms[1..3].iter().all(|&t| t > 0.0), "{terms:?}");
                    assert!(with_depth || terms[1..3] == [0.0, 0.0], "{terms:?}");
                }
            }
        }
    }

    /// A prior's values where there is none are as good as any: nothing changes with them.
    #[test]
    fn what_a_prior_lacks_has_no_part() {
        let gpu = testing::gpu();
        let size = [53, 37];
        let plan =
            Plan { size, ssim_weight: 0.2, masks: true, ssim_across_masks: false, depth: true, gradient_scales: 4 };
        let (picture, rgb) = random_view(size, true);
        let picture = gpu.upload("picture", &picture).expect("upload");
        let rgb = gpu.upload("rgb", &rgb).expect("upload");
        let maps = Maps::new(size, 21, 0.2, Quantity::Depth);
        let depth = gpu.upload("depth", &maps.rendered).expect("upload");
        let mut results = vec![];
        for filler in [NO_PRIOR, 3.0 * NO_PRIOR] {
            let with_gaps = |(i, p): (usize, &f32)| if i % 5 == 2 { filler } else { *p };
            let values: Vec<f32> = maps.prior.iter().enumerate().map(with_gaps).collect();
            let prior = gpu.upload("prior", &values).expect("upload");
            let view = View {
                picture: &picture,
                weights: Weights { outside: 1.0, inside: 20.0 },
                depth: Some(DepthView {
                    fit: None,
                    prior: &prior,
                    quantity: Quantity::Depth,
                    weights: Weights { outside: 1.0, inside: 100.0 },
                    gradient: 0.5,
                    gradient_inside: true,
                    gaps: true,
                }),
            };
            let losses = Losses::new(&gpu, &plan).expect("buffers");
            let mut rec = gpu.recorder().expect("recorder");
            let gradients = losses.forward_backward(&mut rec, &view, &rgb, Some(&depth));
            finish(rec);
            let grad = gpu.read(gradients.depth.expect("there is a prior")).expect("read");
            assert!(grad.iter().skip(2).step_by(5).all(|g| *g == 0.0), "no gradient where there is no prior");
            assert!(grad.iter().any(|g| *g != 0.0));
            results.push((gpu.read(losses.terms()).expect("read"), grad));
        }
        assert_eq!(results[0], results[1]);
    }

    /// A prior in any unit: its values count in their own range.
    #[test]
    fn depth_losses_do_not_know_a_priors_unit() {
        let gpu = testing::gpu();
        let size = [53, 37];
        let maps = Maps::new(size, 22, 0.2, Quantity::Depth);
        let of = |scale: f64, shift: f64| {
            let values = maps.prior.iter().map(|p| (scale * (f64::from(*p) + shift)) as f32).collect();
            let prior = crate::scene::Prior { kind: crate::scene::PriorKind::Depth, values };
            let maps = Maps {
                prior: crate::scene::in_own_range(&prior.values),
                rendered: maps.rendered.clone(),
                size,
                valid: maps.valid.clone(),
                weight: maps.weight.clone(),
            };
            maps.run(&gpu, Quantity::Depth, true, false)
        };
        let (_, terms, grad) = of(1.0, 0.0);
        let largest = grad.iter().fold(0.0_f32, |m, g| m.max(g.abs()));
        for (scale, shift) in [(1e-6, 0.0), (1e-3, 0.3), (7.0, -2.0), (1e3, 0.0), (1e6, 0.5)] {
            let (_, other, other_grad) = of(scale, shift);
            // The prior is rounded once more, to 6e-8 of at most three times its range, before it is compared at a
            // fiftieth of that range.
            for (a, b) in terms.iter().zip(other) {
                assert!((a - b).abs() < 2e-5 * a, "{scale} {shift}: {terms:?} {other:?}");
            }
            // Single signs flip where the difference is within that rounding of zero.
            let off = grad.iter().zip(&other_grad).filter(|(a, b)| (*a - *b).abs() > 1e-4 * largest).count();
            assert!(off * 100 < grad.len(), "{scale} {shift}: {off} of {} gradients differ", grad.len());
        }
    }

    #[test]
    fn what_is_not_planned_has_no_buffer() {
        let gpu = testing::gpu();
        let plan = Plan {
            size: [8, 8],
            ssim_weight: 0.2,
            masks: false,
            ssim_across_masks: false,
            depth: false,
            gradient_scales: 4,
        };
        let losses = Losses::new(&gpu, &plan).expect("buffers");
        assert!(losses.depth.is_none() && losses.frame.weight().is_none() && losses.frame.valid().is_none());
        let masks = Plan { masks: true, ..plan };
        let losses = Losses::new(&gpu, &masks).expect("buffers");
        assert!(losses.frame.weight().is_some() && losses.frame.valid().is_none());
        let names: Vec<_> = Term::ALL.iter().map(|t| t.name).collect();
        assert_eq!(names[..3], ["photometric", "depth_l1", "depth_gradient"]);
        assert!(Term::ALL.iter().enumerate().all(|(i, t)| t.slot() as usize == i));
    }
}
