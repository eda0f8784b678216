//! shaderc as the system has it, or built from source where the system has none. Its build script completes Debian 12's.

pub use shaderc::*;
