//! Comparing a kernel's outputs with its twin's.

use super::device::Gpu;
use super::error::Error;
use super::kernel::{Access, Binding, Reference, Scalar, Slot};
use super::recorder::Threads;

/// The allowed distance of a kernel's output from its twin's: `|got - want| <= relative |want| + absolute max |want|`,
/// element by element. Integers must be equal.
///
/// The defaults allow about a hundred float32 roundings relative to the element (`1e-5`) and sixteen relative to the
/// largest element of the tensor (`1e-6`), for sums in which terms cancel. A kernel that sums more says so.
#[derive(Clone, Copy, Debug)]
pub struct Check {
    /// Times the element's magnitude.
    pub relative: f64,
    /// Times the tensor's largest magnitude.
    pub absolute: f64,
    /// Share of elements that may disagree because a discrete decision (a threshold, a rounding) fell within float32
    /// rounding of its boundary. Zero unless the kernel says why.
    pub band: f64,
}

impl Default for Check {
    fn default() -> Self {
        Self { relative: 1e-5, absolute: 1e-6, band: 0.0 }
    }
}

/// How one output tensor of one pass differs from the twin's.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Difference {
    /// The pass.
    pub pass: String,
    /// The binding.
    pub tensor: String,
    /// Components compared.
    pub components: usize,
    /// Largest |got - want|.
    pub error: f64,
    /// Largest |want|.
    pub scale: f64,
    /// Cosine between the two tensors; 1 for two zero tensors.
    pub cosine: f64,
    /// |got| / |want|; 1 for two zero tensors.
    pub norm_ratio: f64,
    /// |got - want| / |want| in the Euclidean norm; 0 for two zero tensors.
    pub relative: f64,
    /// Integers, which must be equal.
    pub discrete: bool,
    /// Components beyond the allowed distance.
    pub exceeded: usize,
    /// Components that may be: the boundary band.
    pub allowed: usize,
    /// Components that are a number on one side only: no boundary explains one.
    pub broken: usize,
    /// Where the worst of them is, and the two values.
    pub worst: Option<(usize, f64, f64)>,
}

impl Difference {
    /// True when no more components disagree than the boundary band allows.
    pub fn ok(&self) -> bool {
        self.exceeded <= self.allowed && self.broken == 0
    }

    /// Compares float64 values.
    pub fn of(pass: &str, tensor: &str, got: &[f64], want: &[f64], check: Check) -> Self {
        assert_eq!(got.len(), want.len(), "{pass}: {tensor} has another length than its reference");
        let scale = want.iter().filter(|w| w.is_finite()).fold(0.0, |m: f64, w| m.max(w.abs()));
        let (mut error, mut exceeded, mut worst, mut worst_excess): (f64, _, _, f64) = (0.0, 0, None, 0.0);
        let mut broken = 0;
        let (mut dot, mut gg, mut ww, mut dd) = (0.0, 0.0, 0.0, 0.0);
        for (i, (&g, &w)) in got.iter().zip(want).enumerate() {
            if g == w || (g.is_nan() && w.is_nan()) {
                if g.is_finite() {
                    dot += g * w;
                    gg += g * g;
                    ww += w * w;
                }
                continue;
            }
            let distance = (g - w).abs();
            let limit = check.relative * w.abs() + check.absolute * scale;
            dot += g * w;
            gg += g * g;
            ww += w * w;
            dd += distance * distance;
            broken += usize::from(g.is_nan() != w.is_nan());
            error = if distance.is_nan() { f64::INFINITY } else { error.max(distance) };
            if distance.is_nan() || distance > limit {
                exceeded += 1;
                let excess = if distance.is_nan() { f64::INFINITY } else { distance - limit };
                if worst.is_none() || excess > worst_excess {
                    worst_excess = excess;
                    worst = Some((i, g, w));
                }
            }
        }
        let both_zero = gg == 0.0 && ww == 0.0;
        Self {
            pass: pass.into(),
            tensor: tensor.into(),
            components: got.len(),
            error,
            scale,
            cosine: if both_zero { 1.0 } else { dot / (gg * ww).sqrt() },
            norm_ratio: if both_zero { 1.0 } else { (gg / ww).sqrt() },
            relative: if both_zero { 0.0 } else { (dd / ww).sqrt() },
            discrete: false,
            exceeded,
            broken,
            allowed: (check.band * got.len() as f64).ceil() as usize,
            worst,
        }
    }

    /// Compares the words of one binding.
    pub(super) fn of_words(pass: &str, binding: &Binding, got: &[u32], want: &[u32], check: Check) -> Self {
        debug_assert!(binding.access != Access::Read);
        let values = |words: &[u32]| -> Vec<f64> {
            match binding.scalar {
                Scalar::F32 => words.iter().map(|&w| f64::from(f32::from_bits(w))).collect(),
                Scalar::U32 => words.iter().map(|&w| f64::from(w)).collect(),
                Scalar::I32 => words.iter().map(|&w| f64::from(w as i32)).collect(),
            }
        };
        let discrete = binding.scalar != Scalar::F32;
        let check = if discrete { Check { relative: 0.0, absolute: 0.0, ..check } } else { check };
        Self { discrete, ..Self::of(pass, binding.name, &values(got), &values(want), check) }
    }
}

/// Uploads one buffer per binding, runs the kernel once and returns the buffers.
pub(super) fn run_words<K: Reference>(
    gpu: &Gpu,
    words: &[Vec<u32>],
    push: K::Push,
    constants: K::Constants,
    threads: Threads<'_>,
) -> Result<Vec<Vec<u32>>, Error> {
    let buffers: Vec<_> =
        K::BINDINGS.iter().zip(words).map(|(b, w)| gpu.upload(b.name, w)).collect::<Result<_, Error>>()?;
    let slots: Vec<Slot> = buffers.iter().map(super::Buffer::slot).collect();
    let mut recorder = gpu.recorder()?;
    recorder.dispatch::<K>(&constants, &slots, &push, threads)?;
    recorder.submit()?.wait()?;
    buffers.iter().map(|b| gpu.read(b)).collect()
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { pass, tensor, components, error, scale, cosine, norm_ratio, exceeded, allowed, worst, .. } = self;
        write!(
            f,
            "{pass:<36} {tensor:<24} {components:>10}  error {error:9.2e} of {scale:9.2e}  1-cos {:8.1e}  norm {norm_ratio:.6}",
            1.0 - cosine
        )?;
        if let Some((at, got, want)) = worst {
            write!(f, "  {exceeded} beyond (allowed {allowed}), worst [{at}] {got:e} instead of {want:e}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_found() {
        let check = Check::default();
        let want = [1.0, -2.0, 0.0];
        assert!(Difference::of("p", "t", &want, &want, check).ok());
        assert!(!Difference::of("p", "t", &[1.0, -2.0, 1e-4], &want, check).ok());
        assert!(!Difference::of("p", "t", &[1.0, f64::NAN, 0.0], &want, check).ok());
        assert!(Difference::of("p", "t", &[1.0, f64::NAN], &[1.0, f64::NAN], check).ok());
        assert!(!Difference::of("p", "t", &[0.0, 0.0, 0.0], &want, check).ok(), "a gradient that is wrongly zero");
        let band = Check { band: 0.3, ..check };
        assert!(Difference::of("p", "t", &[5.0, -2.0, 0.0], &want, band).ok());
        assert!(!Difference::of("p", "t", &[1.0, f64::NAN, 0.0], &want, band).ok(), "no band explains a NaN");
        assert!(!Difference::of("p", "t", &[1.0, 2.0, 0.0], &[1.0, f64::NAN, 0.0], band).ok());
    }
}
