//! `gscream-vk`: 3D Gaussian scenes without the object, trained on Vulkan compute.
//!
//! A run reads a [`config`] and a [`scene`] (photographs, COLMAP cameras, masks, depth priors), asks [`train`] what
//! this scene needs, and then repeats one straight line of compute passes: [`render`] the anchors of the [`model`],
//! compare with the photograph in [`losses`], walk back, and let the [`optimizer`] and [`densify`] change the model.
//! [`evaluate`] measures the result, [`export`] bakes it into static Gaussians for any viewer, [`view`] shows them in the
//! browser. Kernels live in `glsl/`, mirrored by path and stem in `src/`; each has a CPU twin in float64 beside the code
//! that dispatches it. [`gpu`] is the only place that knows Vulkan; [`primitives`] are sorts, scans and sums that know
//! nothing of splats. [`cli`] has one file per command.

pub mod bench;
pub mod capture;
pub mod cli;
pub mod config;
pub mod cost;
pub mod densify;
pub mod evaluate;
pub mod export;
pub mod gpu;
pub mod losses;
pub mod math;
pub mod model;
pub mod optimizer;
pub mod primitives;
pub mod render;
pub mod report;
pub mod scene;
pub mod stage;
pub mod train;
pub mod view;
