//! Every test that needs no program of its own: one module for each part of the program. `cargo test --test suite NAME` runs
//! those of a module.
//!
//! Others stand alone: `golden` and `extreme` have their own lists of cases, `fuzz` counts what is allocated, and
//! `interpreter` takes every core.

mod bench;
mod cli;
mod common;
mod compose;
mod config;
mod device;
mod driver;
mod evaluate;
mod export;
mod faults;
mod gaussians;
mod kernels;
mod live;
mod loaders;
mod model_files;
mod nerfstudio;
mod photographs;
mod plan;
mod prepare;
mod remove;
mod report;
mod resume;
mod scene;
mod schedule;
mod sentinel;
mod signals;
mod splat;
mod stages;
mod training;
mod workflow;
