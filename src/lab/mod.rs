//! The instruments: how fast a step is, how near its arithmetic is to float64, and what its parts are worth.
//!
//! [`mod@bench`] times and predicts passes and steps. [`report`] holds error against run time.
//! `ablation` compares variants over seeds, `hole` judges removals by scenes whose truth is known. A training needs none of
//! them.

pub(crate) mod ablation;
pub mod bench;
pub(crate) mod hole;
pub mod pace;
pub mod pareto;
pub mod plots;
pub mod report;
pub mod statistics;
pub mod variants;
