//! What a kernel is: its interface, generated from GLSL, and its CPU twin.

use std::fmt::Debug;

use super::memory::Slot as MemorySlot;

pub use super::memory::Slot;

/// How a pass touches a binding; declared by `readonly`, `writeonly` or neither in GLSL.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Access {
    /// Only read.
    Read,
    /// Only written.
    Write,
    /// Read and written.
    ReadWrite,
}

impl Access {
    /// True unless the binding is only written.
    pub fn reads(self) -> bool {
        self != Access::Write
    }
    /// True unless the binding is only read.
    pub fn writes(self) -> bool {
        self != Access::Read
    }
}

/// Component type of a binding's elements.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Scalar {
    /// 32-bit float.
    F32,
    /// Unsigned 32-bit integer.
    U32,
    /// Signed 32-bit integer.
    I32,
}

/// One storage buffer of a kernel.
#[derive(Clone, Copy, Debug)]
pub struct Binding {
    /// Binding number in set 0.
    pub number: u32,
    /// Place among the bindings of all of the kernel's variants.
    pub at: usize,
    /// Name of the array in GLSL.
    pub name: &'static str,
    /// Declared access.
    pub access: Access,
    /// Component type.
    pub scalar: Scalar,
}

/// A compiled variant of a kernel, without the types: what the device needs.
#[derive(Debug)]
pub struct Interface {
    /// `folder/stem_variant`, also the name of the pass and of its timing.
    pub name: &'static str,
    /// [`Kernel::choice`] of the kernel that this is.
    pub choice: u32,
    /// A bit for each of the kernel's bindings that it has.
    pub bound: u32,
    /// Threads per workgroup.
    pub group: [u32; 3],
    /// True when it uses subgroup operations: the subgroup size is then pinned and subgroups are full.
    pub subgroups: bool,
    /// True when its subgroups are the least that the device has ([`DeviceInfo::narrow_subgroup_size`](super::DeviceInfo)): what
    /// they pass over together, or the registers that they hold, is worth more than fewer of them.
    pub narrow: bool,
    /// Its storage buffers, by binding number.
    pub bindings: &'static [Binding],
    /// Its specialisation constants: id, and place in the kernel's `Constants`.
    pub constants: &'static [(u32, usize)],
    /// Bytes of the push constants: those with which the kernel's begin.
    pub push_bytes: u32,
    /// Optimised SPIR-V.
    pub spirv: &'static [u8],
}

impl Interface {
    /// Its specialisation constants, of those of all variants.
    pub(super) fn own_constants(&self, all: &[u8]) -> Vec<u8> {
        self.constants.iter().flat_map(|&(_, at)| &all[4 * at..4 * at + 4]).copied().collect()
    }

    /// Moves the words of its buffers, in their order, to their places among all of the kernel's bindings.
    pub(super) fn spread(&self, words: &mut [Vec<u32>], all: usize) -> Vec<Option<Vec<u32>>> {
        let mut spread = vec![None; all];
        for (binding, words) in self.bindings.iter().zip(words) {
            spread[binding.at] = Some(std::mem::take(words));
        }
        spread
    }

    /// The reverse of [`Self::spread`].
    pub(super) fn collect<T>(&self, mut all: Vec<Option<T>>) -> Vec<T> {
        self.bindings.iter().map(|b| bound(all[b.at].take(), b.name)).collect()
    }
}

/// Declares that a module's arithmetic keeps zeros' signs, infinities and what is not a number: without it a compiler may
/// assume that there are none, and drop every comparison that looks for them. (SPV_KHR_float_controls; for devices with
/// `shaderSignedZeroInfNanPreserveFloat32`.)
pub(super) fn keep_nan(module: &mut Vec<u32>) {
    const HEADER: usize = 5;
    const EXTENSION: u32 = 10;
    const ENTRY_POINT: u32 = 15;
    const EXECUTION_MODE: u32 = 16;
    const CAPABILITY: u32 = 17;
    const SIGNED_ZERO_INF_NAN_PRESERVE: [u32; 2] = [4466, 4461]; // the capability and the mode
    let mut kept = module[..HEADER].to_vec();
    let mut extension = Some(&b"SPV_KHR_float_controls\0\0"[..]);
    let mut rest = &module[HEADER..];
    let mut entry = None;
    while let [first, ..] = *rest {
        let (instruction, behind) = rest.split_at((first >> 16) as usize);
        let op = first & 0xffff;
        // Capabilities come first, then extensions; modes follow the entry points.
        if op != CAPABILITY
            && let Some(name) = extension.take()
        {
            kept.extend([
                2 << 16 | CAPABILITY,
                SIGNED_ZERO_INF_NAN_PRESERVE[0],
                (1 + name.len() as u32 / 4) << 16 | EXTENSION,
            ]);
            kept.extend(name.as_chunks().0.iter().map(|&four| u32::from_le_bytes(four)));
        }
        if op != ENTRY_POINT
            && let Some(id) = entry.take()
        {
            kept.extend([4 << 16 | EXECUTION_MODE, id, SIGNED_ZERO_INF_NAN_PRESERVE[1], 32]);
        }
        if op == ENTRY_POINT {
            entry = Some(instruction[2]);
        }
        kept.extend(instruction);
        rest = behind;
    }
    *module = kept;
}

/// A kernel's twin without its types.
#[derive(Clone, Copy)]
pub(super) struct Twin<'c> {
    /// [`Reference::reference`] on one vector of words per binding, with the call's constants.
    pub reference: &'c dyn Fn(&mut [Vec<u32>]),
    /// [`Reference::check`].
    pub check: fn(&'static str) -> super::Check,
    /// [`Reference::cancels`].
    pub cancels: fn(&'static str) -> bool,
}

/// Calls `then` with the variant's twin for these constants.
pub(super) fn with_twin<K: Reference, R>(
    kernel: K,
    variant: &'static Interface,
    push: K::Push,
    constants: K::Constants,
    then: impl FnOnce(Twin<'_>) -> R,
) -> R {
    let reference = |words: &mut [Vec<u32>]| {
        let mut all = variant.spread(words, K::BINDINGS);
        K::reference(kernel.host(&mut all), push, constants);
        words.iter_mut().zip(variant.collect(all)).for_each(|(words, after)| *words = after);
    };
    then(Twin { reference: &reference, check: K::check, cancels: K::cancels })
}

/// A binding's words as its elements.
#[inline(never)]
pub fn elements<T: bytemuck::Pod>(words: &[u32]) -> &[T] {
    bytemuck::cast_slice(words)
}

/// As [`elements`], to write.
#[inline(never)]
pub fn elements_mut<T: bytemuck::Pod>(words: &mut [u32]) -> &mut [T] {
    bytemuck::cast_slice_mut(words)
}

/// Elements as words, copied.
#[inline(never)]
pub fn words_of<T: bytemuck::Pod>(elements: &[T]) -> Vec<u32> {
    bytemuck::cast_slice(elements).to_vec()
}

/// Words as elements, copied.
#[inline(never)]
pub fn elements_of<T: bytemuck::Pod>(words: &[u32]) -> Vec<T> {
    elements(words).to_vec()
}

/// Stops where a kernel is given another number of arrays than it binds.
#[cold]
#[inline(never)]
pub fn wrong_bindings(variants: &[Interface], bindings: usize) -> ! {
    panic!("{} binds {bindings} buffers", variants[0].name)
}

/// What is bound in every variant.
pub fn bound<T>(value: Option<T>, binding: &str) -> T {
    value.unwrap_or_else(|| panic!("{binding} is bound in every variant"))
}

/// A compute kernel's interface. Implemented by `build.rs` from the GLSL source, never by hand.
pub trait Kernel: Copy + Debug + 'static {
    /// Named, typed bindings; those that only some variants have are `Option`s.
    type Buffers<'a>: Copy;
    /// The same as host slices.
    type Host<'a>;
    /// The same as owned arrays.
    type Arrays: Clone + Default;
    /// Push constants.
    type Push: bytemuck::Pod + Debug + Default;
    /// Specialisation constants.
    type Constants: bytemuck::Pod + Debug + Default;
    /// Bindings of all variants together.
    const BINDINGS: usize;
    /// What the kernel is compiled to, the base first.
    const VARIANTS: &'static [Interface];
    /// The base's name.
    const NAME: &'static str = Self::VARIANTS[0].name;
    /// Threads per workgroup, of the base.
    const GROUP: [u32; 3] = Self::VARIANTS[0].group;
    /// What the bindings do not tell of the variant: its number.
    fn choice(self) -> u32;
    /// The buffers that are given, each at its place among all bindings.
    fn slots(buffers: &Self::Buffers<'_>) -> Vec<Option<MemorySlot>>;
    /// Host slices over the words of the buffers that are given.
    fn host(self, words: &mut [Option<Vec<u32>>]) -> Self::Host<'_>;
    /// A test case as words.
    fn words(arrays: Self::Arrays) -> Vec<Option<Vec<u32>>>;
    /// Words as a test case.
    fn arrays(words: &[Option<Vec<u32>>]) -> Self::Arrays;

    /// The variant that has exactly the bindings that are given.
    ///
    /// # Panics
    /// When no variant has them.
    fn variant<T>(self, given: &[Option<T>]) -> &'static Interface {
        let bound: u32 = given.iter().enumerate().map(|(i, of)| u32::from(of.is_some()) << i).sum();
        let found = Self::VARIANTS.iter().find(|v| (v.choice, v.bound) == (self.choice(), bound));
        found.unwrap_or_else(|| panic!("{}: no variant {self:?} has bindings {bound:#b}", Self::NAME))
    }
}

/// The CPU twin: plain loops, float64 inside. [`super::Recorder::run`] asks for it, so a kernel without a twin does
/// not compile.
pub trait Reference: Kernel {
    /// Does on the host what the kernel does on the device, given the same bindings and constants.
    fn reference(host: Self::Host<'_>, push: Self::Push, constants: Self::Constants);

    /// How far the kernel may be from its twin, for every binding it writes: see [`super::Check`].
    fn check(_binding: &'static str) -> super::Check {
        super::Check::default()
    }

    /// Whether many of a binding's elements are differences of which float32 may leave nothing where the twin has a
    /// remainder. Elsewhere zeros are compared with the twin's.
    fn cancels(_binding: &'static str) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::{Kernel as _, keep_nan};
    use crate::gpu::kernels;

    /// Nothing else of a module changes.
    #[test]
    fn a_module_declares_that_it_keeps_what_is_not_a_number() {
        let spirv = kernels::primitives::finite::Kernel::VARIANTS[0].spirv;
        let mut words: Vec<u32> = bytemuck::pod_collect_to_vec(spirv);
        keep_nan(&mut words);
        let before = rspirv::dr::load_bytes(spirv).expect("build.rs wrote it");
        let mut after = rspirv::dr::load_words(words).expect("whole instructions in their order");
        let entry = &before.entry_points[0].operands[1];
        let mode = after.execution_modes.iter().position(|mode| {
            format!("{:?}", mode.operands[1]).contains("SignedZeroInfNanPreserve") && mode.operands[0] == *entry
        });
        let mode = after.execution_modes.remove(mode.expect("the mode"));
        assert_eq!(mode.operands[2], rspirv::dr::Operand::LiteralBit32(32));
        assert_eq!(
            (after.capabilities.len(), after.extensions.len()),
            (before.capabilities.len() + 1, before.extensions.len() + 1)
        );
        after.capabilities.clone_from(&before.capabilities);
        after.extensions.clone_from(&before.extensions);
        assert_eq!(format!("{after:?}"), format!("{before:?}"));
    }
}
