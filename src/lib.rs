//! `gscream-vk`: 3D Gaussian scenes without the object, trained on Vulkan compute.
//!
//! A run reads a [`config`] and a [`scene`] (photographs, COLMAP cameras, masks, depth priors), asks [`train`] what
//! this scene needs, and then repeats one straight line of compute passes: [`render`] the anchors of the [`model`],
//! compare with the photograph in [`losses`], walk back, and let the [`optimizer`] and [`densify`] change the model.
//! [`multiview`] finds points where the capture has none, [`evaluate`] measures the result, [`export`] bakes it into
//! static Gaussians for any viewer ([`formats`] are its files), [`view`] shows them in the browser, [`compose`] makes
//! scenes whose truth is known, [`prepare`] makes a scene of photographs and one mask, [`remove`] is the page to point
//! at an object in, and [`lab`] holds the instruments: speed, error against run time.
//! Kernels live in `glsl/`, mirrored by path and stem in `src/`; each has a CPU twin in float64 beside the code that
//! dispatches it. [`gpu`] is the only place that knows Vulkan; [`primitives`] are sorts, scans and sums that know nothing of
//! splats. [`cli`] has one file per command, [`work`] the parts of a job that several commands begin with.
//!
//! # Words
//!
//! | word | means |
//! | --- | --- |
//! | anchor | a point of the scene with a feature, from which the decoders make its Gaussians |
//! | plain Gaussian | one that is learnt by itself, in a model without anchors (`model.form`) |
//! | representation | what a model is made of, anchors or plain Gaussians: a file of [`representation`] for each |
//! | slot | the place of one Gaussian of one anchor: anchor x offsets + offset |
//! | form | which kernels run where two exist: those for GPUs or those for CPU drivers ([`gpu::Form`]) |
//! | tile | a square of pixels that one workgroup draws |
//! | pair | a Gaussian and a tile that it touches |
//! | twin | the CPU reference of a kernel, in float64, with the same bindings |
//! | mask | the pixels of a photograph that show the object to be removed |
//! | hole | the pixels of a picture, or the place in the scene, that the object covered |
//! | reference | the view whose hole was inpainted, or which never had one |
//! | prior | a depth or disparity of a picture from outside this program, known up to scale and shift |
//! | seen | a place that another photograph shows past the object |
//! | guessed | a place that no photograph shows |
//! | unit | the length that counts as one in the settings, in lengths of the capture's files |

// First: the macros of this crate are known from here on.
#[cfg(not(test))]
#[macro_use]
mod print;

pub mod atomic;
pub mod cli;
pub mod compose;
pub mod config;
pub mod cost;
pub mod densify;
pub mod evaluate;
pub mod export;
pub mod folder;
pub mod formats;
pub mod gpu;
pub mod lab;
pub mod losses;
pub mod math;
pub mod model;
pub mod multiview;
pub mod optimizer;
pub mod prepare;
pub mod primitives;
pub mod remove;
pub mod render;
pub mod representation;
pub mod scene;
pub mod segments;
mod sentence;
pub mod signal;
#[cfg(test)]
#[path = "../tests/common/skip.rs"]
mod skip;
pub mod splat;
pub mod stage;
pub mod statistics;
pub mod train;
pub mod view;
pub mod work;
