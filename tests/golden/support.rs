//! Reading golden cases and comparing with them.
#![allow(dead_code, reason = "each kind uses its part")]

use std::path::PathBuf;

use gscream_vk::gpu::{Check, Difference};
use safetensors::{Dtype, SafeTensors};

use super::skip::{Lack, skip};

/// One golden file.
pub struct Case {
    /// The file's stem.
    pub name: String,
    bytes: Vec<u8>,
}

/// All cases of a kind.
///
/// # Panics
/// When the folder holds no golden file at all.
pub fn cases(kind: &str) -> Vec<Case> {
    let folder = std::env::var_os("GSCREAM_GOLDEN")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden"), PathBuf::from);
    let entries = std::fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    let mut files: Vec<_> = entries.map(|e| e.expect("a readable folder").path()).collect();
    files.retain(|p| p.extension().is_some_and(|e| e == "safetensors"));
    files.sort();
    assert!(!files.is_empty(), "{}: no golden case here", folder.display());
    let of_kind = |p: &PathBuf| p.file_stem().is_some_and(|s| s.to_string_lossy().starts_with(kind));
    let found: Vec<_> = files
        .into_iter()
        .filter(of_kind)
        .map(|path| Case {
            name: path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default(),
            bytes: std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display())),
        })
        .collect();
    if found.is_empty() {
        // Another folder may hold some kinds only; our own holds all.
        assert!(std::env::var_os("GSCREAM_GOLDEN").is_some(), "{}: no {kind} case here", folder.display());
        skip(Lack::GoldenCase, &format!("no {kind} case in {}", folder.display()));
    }
    found
}

impl Case {
    fn tensors(&self) -> SafeTensors<'_> {
        SafeTensors::deserialize(&self.bytes).unwrap_or_else(|e| panic!("{}: {e}", self.name))
    }

    /// Names of all tensors.
    pub fn names(&self) -> Vec<String> {
        self.tensors().names().into_iter().map(str::to_owned).collect()
    }

    /// Whether the case has this tensor.
    pub fn has(&self, tensor: &str) -> bool {
        self.tensors().tensor(tensor).is_ok()
    }

    /// A tensor's shape.
    pub fn shape(&self, tensor: &str) -> Vec<usize> {
        let tensors = self.tensors();
        let view = tensors.tensor(tensor).unwrap_or_else(|e| panic!("{}: {tensor}: {e}", self.name));
        view.shape().to_vec()
    }

    /// A tensor of any number type as float64.
    pub fn f64(&self, tensor: &str) -> Vec<f64> {
        let tensors = self.tensors();
        let view = tensors.tensor(tensor).unwrap_or_else(|e| panic!("{}: {tensor}: {e}", self.name));
        let data = view.data();
        match view.dtype() {
            Dtype::F64 => bytemuck::pod_collect_to_vec::<u8, f64>(data),
            Dtype::F32 => bytemuck::pod_collect_to_vec::<u8, f32>(data).into_iter().map(f64::from).collect(),
            Dtype::I32 => bytemuck::pod_collect_to_vec::<u8, i32>(data).into_iter().map(f64::from).collect(),
            other => panic!("{}: {tensor}: unexpected type {other:?}", self.name),
        }
    }

    /// A text, stored as its bytes.
    pub fn text(&self, tensor: &str) -> String {
        let tensors = self.tensors();
        let view = tensors.tensor(tensor).unwrap_or_else(|e| panic!("{}: {tensor}: {e}", self.name));
        String::from_utf8(view.data().to_vec()).unwrap_or_else(|e| panic!("{}: {tensor}: {e}", self.name))
    }

    /// A tensor as float32 (inputs are float32 in the file, so nothing is lost).
    pub fn f32(&self, tensor: &str) -> Vec<f32> {
        self.f64(tensor).into_iter().map(|v| v as f32).collect()
    }

    /// A tensor of small vectors.
    pub fn vectors<const C: usize>(&self, tensor: &str) -> Vec<[f32; C]> {
        let flat = self.f32(tensor);
        assert_eq!(flat.len() % C, 0, "{}: {tensor} is no array of {C}-vectors", self.name);
        flat.chunks_exact(C).map(|c| std::array::from_fn(|i| c[i])).collect()
    }

    /// `size` or `camera.size`: width, height.
    pub fn size(&self, tensor: &str) -> [u32; 2] {
        let s = self.f64(tensor);
        [s[0] as u32, s[1] as u32]
    }

    /// Fails unless `got` equals the case's tensor within `check`; gradients also by cosine and norm.
    pub fn compare(&self, tensor: &str, got: &[f32], check: Check) {
        self.compare_with(tensor, got, &self.f64(tensor), check);
    }

    /// As [`Case::compare`], with the wanted values given.
    pub fn compare_with(&self, tensor: &str, got: &[f32], want: &[f64], check: Check) {
        let got: Vec<f64> = got.iter().map(|&v| f64::from(v)).collect();
        let difference = Difference::of(&self.name, tensor, &got, want, check);
        println!("{difference}");
        assert!(difference.ok(), "{difference}");
        assert!(difference.cosine > 1.0 - 1e-6, "{difference}");
        assert!((difference.norm_ratio - 1.0).abs() < 1e-3, "{difference}");
    }
}
