//! stub
pub mod ceilings;
