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
    /// Name of the array in GLSL.
    pub name: &'static str,
    /// Declared access.
    pub access: Access,
    /// Component type.
    pub scalar: Scalar,
    /// Components per element.
    pub components: u32,
}

/// All of a kernel that does not depend on its types: what the device needs, compiled once for all kernels.
#[derive(Debug)]
pub struct Interface {
    /// As [`Kernel::NAME`].
    pub name: &'static str,
    /// As [`Kernel::GROUP`].
    pub group: [u32; 3],
    /// As [`Kernel::SUBGROUPS`].
    pub subgroups: bool,
    /// As [`Kernel::BINDINGS`].
    pub bindings: &'static [Binding],
    /// As [`Kernel::CONSTANTS`].
    pub constants: &'static [u32],
    /// Bytes of the push constants.
    pub push_bytes: u32,
    /// As [`Kernel::SPIRV`].
    pub spirv: &'static [u8],
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

/// Calls `then` with the kernel's twin for these constants.
pub(super) fn with_twin<K: Reference, R>(
    push: K::Push,
    constants: K::Constants,
    then: impl FnOnce(Twin<'_>) -> R,
) -> R {
    let reference = |words: &mut [Vec<u32>]| K::reference(K::host(words), push, constants);
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
pub fn wrong_bindings(kernel: &str, bindings: usize) -> ! {
    panic!("{kernel} binds {bindings} buffers")
}

/// A compute kernel's interface. Implemented by `build.rs` from the GLSL source, never by hand.
pub trait Kernel: 'static {
    /// Named, typed bindings.
    type Buffers<'a>: Copy;
    /// The same as host slices.
    type Host<'a>;
    /// The same as owned arrays.
    type Arrays: Clone + Default;
    /// Push constants.
    type Push: bytemuck::Pod + Debug + Default;
    /// Specialisation constants.
    type Constants: bytemuck::Pod + Debug + Default;
    /// `folder/stem`, also the name of the pass and of its timing.
    const NAME: &'static str;
    /// Threads per workgroup.
    const GROUP: [u32; 3];
    /// True when it uses subgroup operations: the subgroup size is then pinned and subgroups are full.
    const SUBGROUPS: bool;
    /// The storage buffers, by binding number.
    const BINDINGS: &'static [Binding];
    /// Ids of the specialisation constants, in `Constants`' order.
    const CONSTANTS: &'static [u32];
    /// Optimised SPIR-V.
    const SPIRV: &'static [u8];
    /// The above without the types.
    const INTERFACE: &'static Interface = &Interface {
        name: Self::NAME,
        group: Self::GROUP,
        subgroups: Self::SUBGROUPS,
        bindings: Self::BINDINGS,
        constants: Self::CONSTANTS,
        push_bytes: size_of::<Self::Push>() as u32,
        spirv: Self::SPIRV,
    };
    /// The bound buffers in the order of `BINDINGS`.
    fn slots(buffers: &Self::Buffers<'_>) -> Vec<MemorySlot>;
    /// Host slices over one vector of words per binding.
    fn host(words: &mut [Vec<u32>]) -> Self::Host<'_>;
    /// A test case as words.
    fn words(arrays: Self::Arrays) -> Vec<Vec<u32>>;
    /// Words as a test case.
    fn arrays(words: &[Vec<u32>]) -> Self::Arrays;
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
