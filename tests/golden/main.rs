//! Golden cases: every `*.safetensors` in the folder named by `GSCREAM_GOLDEN` (default `tests/golden`), by the prefix
//! of the file's name, sizes from the file. `tests/golden/golden.py OUT SEED` writes more.

#[allow(dead_code)]
#[path = "../common/skip.rs"]
mod skip;
mod support;

mod adam;
mod attention;
mod decode;
mod depth;
mod photometric;
mod project;
mod rasterize;
mod step;
