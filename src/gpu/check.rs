//! Comparing a kernel's outputs with its twin's.

use super::device::Gpu;
use super::error::Error;
use super::kernel::{Access, Binding, Interface, Scalar, Slot, Twin};
use super::recorder::{Call, Threads};

/// The allowed distance of a kernel's output from its twin's: `|got - want| <= relative |want| + absolute max |want|`,
/// element by element. Integers must be equal.
///
/// The defaults allow about a hundred float32 roundings relative to the element (`1e-5`) and sixteen relative to the
/// largest element of the tensor (`1e-6`), for sums in which terms cancel. A kernel that sums more says so.
///
/// Small elements may hide below the largest one's rounding, and a boundary band takes any error. So a tensor as a whole
/// must also be as long as its twin's and point the same way, and elements must not be zero where the twin's are not.
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

/// How far a tensor may be from its twin, as a share of its length, whatever single elements may: a thousandth, where the
/// largest ever seen is 3e-5. See [`whole`].
const WHOLE: f64 = 1e-3;
/// Below, the twin's value may be zero on a device: it flushes to zero what is less than 1.2e-38, and factors may be.
const TINY: f64 = 1e-30;

/// [`WHOLE`], or the elements' own allowance where that is more, and for every element of the boundary band the change
/// of a usual element's sign, as at the kink of an absolute value. Two vectors whose difference is s times their length
/// have a cosine of at least 1 - s^2.
fn whole(check: Check, allowed: usize, components: usize) -> f64 {
    WHOLE.max(check.relative + check.absolute) + 2.0 * (allowed as f64 / components.max(1) as f64).sqrt()
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
    /// Components that are zero where the reference is not. One, or one in a thousand, may be: a difference that cancels.
    pub vanished: usize,
    /// How far `norm_ratio` may be from 1, and the square of that the cosine; none for integers.
    pub whole: Option<f64>,
    /// Where the worst of them is, and the two values.
    pub worst: Option<(usize, f64, f64)>,
}

impl Difference {
    /// True when no more components disagree than the boundary band allows, and the whole agrees too.
    pub fn ok(&self) -> bool {
        let whole = self.whole.is_none_or(|s| (self.norm_ratio - 1.0).abs() <= s && self.cosine >= 1.0 - s * s);
        let vanished = self.vanished <= 1 + self.components / 1000;
        self.exceeded <= self.allowed && self.broken == 0 && whole && vanished
    }

    /// Compares float64 values.
    pub fn of(pass: &str, tensor: &str, got: &[f64], want: &[f64], check: Check) -> Self {
        assert_eq!(got.len(), want.len(), "{pass}: {tensor} has another length than its reference");
        let scale = want.iter().filter(|w| w.is_finite()).fold(0.0, |m: f64, w| m.max(w.abs()));
        let (mut error, mut exceeded, mut worst, mut worst_excess): (f64, _, _, f64) = (0.0, 0, None, 0.0);
        let (mut broken, mut vanished) = (0, 0);
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
            vanished += usize::from(g == 0.0 && w.abs() >= TINY);
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
        let allowed = (check.band * got.len() as f64).ceil() as usize;
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
            allowed,
            vanished,
            whole: Some(whole(check, allowed, got.len())),
            worst,
        }
    }

    /// Compares the words of one of the kernel's bindings with its twin's.
    pub(super) fn of_words(kernel: &str, twin: Twin<'_>, binding: &Binding, got: &[u32], want: &[u32]) -> Self {
        let check = (twin.check)(binding.name);
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
        let found = Self::of(kernel, binding.name, &values(got), &values(want), check);
        // An integer is right or wrong by itself.
        let vanished = if discrete || (twin.cancels)(binding.name) { 0 } else { found.vanished };
        Self { discrete, vanished, whole: found.whole.filter(|_| !discrete), ..found }
    }
}

/// Uploads one buffer per binding, runs the kernel once and returns the buffers.
pub(super) fn run_words(
    gpu: &Gpu,
    kernel: &'static Interface,
    words: &[Vec<u32>],
    push: &[u8],
    constants: &[u8],
    threads: Threads<'_>,
) -> Result<Vec<Vec<u32>>, Error> {
    let buffers: Vec<_> =
        kernel.bindings.iter().zip(words).map(|(b, w)| gpu.upload(b.name, w)).collect::<Result<_, Error>>()?;
    let slots: Vec<Slot> = buffers.iter().map(super::Buffer::slot).collect();
    let mut recorder = gpu.recorder()?;
    recorder.dispatch(Call { kernel, constants, push, slots: &slots }, threads)?;
    recorder.submit()?.wait()?;
    buffers.iter().map(|b| gpu.read(b)).collect()
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self {
            pass, tensor, components, error, scale, cosine, norm_ratio, exceeded, allowed, worst, vanished, ..
        } = self;
        write!(
            f,
            "{pass:<36} {tensor:<24} {components:>10}  error {error:9.2e} of {scale:9.2e}  1-cos {:8.1e}  norm {norm_ratio:.6}",
            1.0 - cosine
        )?;
        if let Some((at, got, want)) = worst {
            write!(f, "  {exceeded} beyond (allowed {allowed}), worst [{at}] {got:e} instead of {want:e}")?;
        }
        if *vanished > 0 && !self.ok() {
            write!(f, "  {vanished} are zero and should not be")?;
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
        assert!(Difference::of("p", "t", &[-1.0, -2.0, 0.0], &want, band).ok());
        assert!(!Difference::of("p", "t", &[1.0, f64::NAN, 0.0], &want, band).ok(), "no band explains a NaN");
        assert!(!Difference::of("p", "t", &[1.0, 2.0, 0.0], &[1.0, f64::NAN, 0.0], band).ok());
    }

    #[test]
    fn the_whole_counts_too() {
        // A component of its own scale, as of a gradient by a length in another unit.
        let want: Vec<f64> = (1..=3000).map(|i| f64::from(i) * if i % 3 == 0 { 1e-9 } else { 1.0 }).collect();
        let check = Check::default();
        let without = |every: usize| -> Vec<f64> {
            want.iter().enumerate().map(|(i, &w)| if i % every == 2 { 0.0 } else { w }).collect()
        };
        let lost = Difference::of("p", "t", &without(3), &want, check);
        assert_eq!((lost.exceeded, lost.vanished, lost.ok()), (0, 1000, false), "no element is off by itself");
        assert!(Difference::of("p", "t", &without(1500), &want, check).ok(), "a few differences cancel");
        let flushed: Vec<f64> = want.iter().map(|w| w * 1e-34).collect();
        assert!(Difference::of("p", "t", &[1.0, 0.0, 0.0, 0.0], &[&[1.0], &flushed[..3]].concat(), check).ok());

        // What a boundary band would take.
        let want: Vec<f64> = (0..1000).map(|i| 1.0 + f64::from(i % 7)).collect();
        let band = Check { band: 0.01, ..check };
        let off = |factor: f64| -> Vec<f64> {
            want.iter().enumerate().map(|(i, &w)| if i % 125 == 0 { factor * w } else { w }).collect()
        };
        let few = Difference::of("p", "t", &off(-1.0), &want, band);
        assert!(few.exceeded == 8 && few.ok(), "{few}");
        let longer = Difference::of("p", "t", &off(10.0), &want, band);
        assert!(longer.exceeded == 8 && !longer.ok(), "another length: {longer}");
        let turned = Difference::of("p", "t", &off(-8.0), &want, band);
        assert!(turned.exceeded == 8 && !turned.ok(), "another direction: {turned}");
        let longer: Vec<f64> = want.iter().map(|w| 1.002 * w).collect();
        let loose = Check { relative: 1e-5, absolute: 3e-3, band: 0.0 };
        assert!(Difference::of("p", "t", &longer, &want, loose).ok(), "the elements' own allowance");
    }
}
