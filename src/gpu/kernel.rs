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

/// A compute kernel's interface. Implemented by `build.rs` from the GLSL source, never by hand.
pub trait Kernel: 'static {
    /// Named, typed bindings.
    type Buffers<'a>: Copy;
    /// The same as host slices.
    type Host<'a>;
    /// The same as owned arrays.
    type Arrays: Clone + Debug + Default;
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
