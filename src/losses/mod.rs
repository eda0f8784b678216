//! What a render is compared with: the photograph, and the view's depth prior.
//!
//! To add a loss: one `.comp`, one `.rs` beside it, and here its module, its [`Term`] and its call in
//! [`Losses::forward_backward`].

pub mod align;
pub mod config;
pub mod depth_gradient;
pub mod depth_l1;
pub mod frame;
pub mod photometric;

pub use config::Config;
mod sum;

use crate::gpu::{Buffer, Error, Gpu, Recorder};

pub use align::Quantity;
pub use frame::{Rectangle, Weights, pack};

/// The terms of the loss, by their place in [`Losses::terms`]. Their sum is what a step minimises: each carries its weight.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Term {
    /// L1 and SSIM of the picture.
    Photometric,
    /// L1 of the aligned depth.
    DepthL1,
    /// Multi-scale gradient of the depth difference.
    DepthGradient,
}

impl Term {
    /// All, in their order.
    pub const ALL: [Self; 3] = [Self::Photometric, Self::DepthL1, Self::DepthGradient];

    /// As reports spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Photometric => "photometric",
            Self::DepthL1 => "depth_l1",
            Self::DepthGradient => "depth_gradient",
        }
    }
}

/// Which losses a run has: what is not planned has no pass and no buffer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plan {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Share of 1 - SSIM in the photometric loss, the rest is L1.
    pub ssim_weight: f32,
    /// Whether any view has a mask.
    pub masks: bool,
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
    /// Where the L1 loss weighs more; with masks only.
    pub rectangle: Option<Rectangle>,
    /// Factor of the depth gradient; 0 leaves it out.
    pub gradient: f32,
    /// Whether the depth gradient looks inside the mask too.
    pub gradient_inside: bool,
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
        let gradient = || depth_gradient::DepthGradient::new(gpu, size, scales, masks);
        let depth = || -> Result<Depth, Error> {
            Ok(Depth {
                align: align::Align::new(gpu, size)?,
                l1: depth_l1::DepthL1::new(gpu, size)?,
                gradient: if scales > 0 { Some(gradient()?) } else { None },
            })
        };
        Ok(Self {
            frame: frame::Frame::new(gpu, size, masks, plan.depth)?,
            photometric: photometric::Photometric::new(gpu, size, plan.ssim_weight)?,
            depth: if plan.depth { Some(depth()?) } else { None },
            terms: gpu.buffer("losses", Term::ALL.len())?,
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
        self.frame.forward(rec, view.picture, view.weights, view.depth.map(|d| (d.weights, d.rectangle)));
        self.compare(rec, view.depth, rgb, depth)
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
        rec.zero(terms);
        let slot = Term::Photometric as u32;
        let grad_rgb = photometric.forward_backward(rec, rgb, frame.target(), frame.weight(), terms, slot);
        let planned = stages.as_ref().zip(depth).zip(view);
        let grad_depth = planned.map(|((Depth { align, l1, gradient }, depth), view)| {
            let prior = align::Prior { values: view.prior, quantity: view.quantity, valid: frame.valid() };
            let fit = align.forward(rec, depth, prior);
            let weight =
                frame.depth_weight().map_or(depth_l1::Weight::All(view.weights.outside), depth_l1::Weight::Each);
            let slot = Term::DepthL1 as u32;
            let (difference, grad_aligned) = l1.forward_backward(rec, depth, prior, fit, weight, terms, slot);
            if let Some(gradient) = gradient.as_ref().filter(|_| view.gradient != 0.0) {
                let valid = frame.valid().filter(|_| !view.gradient_inside);
                let slot = Term::DepthGradient as u32;
                gradient.forward_backward(rec, difference, grad_aligned, valid, view.gradient, terms, slot);
            }
            align.backward(rec, grad_aligned, depth, prior)
        });
        Gradients { rgb: grad_rgb, depth: grad_depth }
    }

    /// The last step's loss terms, each with its weight, by [`Term`]; 0 for those that the view has not.
    pub fn terms(&self) -> &Buffer<f32> {
        &self.terms
    }
}
