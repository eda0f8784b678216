//! Dispatches as they were met, for tests that run kernels on something stricter than a device.

use super::check::{Check, Difference};
use super::device::{Gpu, lock};
use super::kernel::{Binding, Interface, Twin};

/// One dispatch: the kernel, all that it was given, and what its twin makes of that.
pub struct Case {
    /// The kernel's name.
    pub name: &'static str,
    /// Its module.
    pub spirv: &'static [u8],
    /// Its bindings.
    pub bindings: &'static [Binding],
    /// Specialisation constants: their ids and words.
    pub constants: Vec<(u32, u32)>,
    /// Push constants.
    pub push: Vec<u32>,
    /// Workgroups in x, y and z.
    pub workgroups: [u32; 3],
    /// Threads of a subgroup where it was met.
    pub subgroup_size: u32,
    /// The words of each binding before.
    pub before: Vec<Vec<u32>>,
    /// The words of each binding behind the twin.
    pub wanted: Vec<Vec<u32>>,
    check: fn(&'static str) -> Check,
    cancels: fn(&'static str) -> bool,
}

impl Case {
    /// How these words of a binding differ from the twin's, within the kernel's own allowance.
    pub fn difference(&self, binding: usize, got: &[u32]) -> Difference {
        let twin = Twin { reference: &|_| {}, check: self.check, cancels: self.cancels };
        Difference::of_words(self.name, twin, &self.bindings[binding], got, &self.wanted[binding])
    }

    pub(super) fn new(
        kernel: &Interface,
        (constants, push): (&[u8], &[u8]),
        workgroups: [u32; 3],
        subgroup_size: u32,
        before: Vec<Vec<u32>>,
        twin: Twin<'_>,
    ) -> Self {
        let mut wanted = before.clone();
        (twin.reference)(&mut wanted);
        let constants = bytemuck::pod_collect_to_vec::<u8, u32>(constants);
        Self {
            name: kernel.name,
            spirv: kernel.spirv,
            bindings: kernel.bindings,
            constants: kernel.constants.iter().map(|&(id, _)| id).zip(constants).collect(),
            push: bytemuck::pod_collect_to_vec(push),
            workgroups,
            subgroup_size,
            before,
            wanted,
            check: twin.check,
            cancels: twin.cancels,
        }
    }
}

impl Gpu {
    /// The dispatches that were kept since the last call: of a device opened with
    /// [`Options::witness`](super::Options::witness).
    pub fn take_cases(&self) -> Vec<Case> {
        std::mem::take(&mut *lock(&self.inner().cases))
    }

    /// Whether another dispatch of this kernel with these constants is to be kept.
    pub(super) fn wants_case(&self, kernel: &Interface, constants: &[u8]) -> bool {
        let most = self.options().witness;
        let same = |case: &&Case| {
            let words = case.constants.iter().flat_map(|(_, word)| word.to_ne_bytes());
            case.name == kernel.name && words.eq(constants.iter().copied())
        };
        most > 0 && lock(&self.inner().cases).iter().filter(same).count() < most
    }
}
