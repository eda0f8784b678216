//! Cull, decode, project, bin, rasterize: forward and backward of a stage in one room.

pub mod activate;
pub mod bin;
pub mod compensate;
pub mod config;
pub mod cull;
pub mod decode;
pub mod forward;
pub mod method;
pub mod project;
pub mod rasterize;
pub mod session;
pub mod slots;
pub mod tiling;
pub mod view;
pub mod visible;
pub mod widen;

pub use config::Config;
pub use method::Method;
pub use session::Session;
