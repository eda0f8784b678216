//! The two kinds of device that kernels are shaped for.

use super::{DeviceInfo, Gpu};

/// For which kind of device work is shaped, where it comes in two forms.
///
/// On a GPU many threads hide what a load takes, registers are few, and threads of a workgroup share memory. On a CPU driver
/// a thread is a lane of a vector, a load costs as much as some forty additions, and shared memory is memory like any other.
/// The results agree within rounding, not in their last bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Form {
    /// For GPUs: runs on every device.
    Gpu,
    /// For CPU drivers. Kernels of lanes need subgroups of 8; where a device has others, the GPU's take their place.
    Cpu,
}

impl Form {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Gpu, Self::Cpu];

    /// The form made for this device: by its kind alone, as there are GPUs with subgroups of 8.
    pub fn of(device: &DeviceInfo) -> Self {
        if device.kind == "cpu" { Self::Cpu } else { Self::Gpu }
    }
}

/// A pass's name whatever its form: kernels for CPU drivers lie in the folder `cpu` of their room.
pub fn without_form(pass: &str) -> String {
    pass.replacen("/cpu/", "/", 1)
}

impl Gpu {
    /// The form that work takes here: the device's own unless it was opened with another.
    pub fn form(&self) -> Form {
        self.options().form.unwrap_or_else(|| Form::of(self.info()))
    }

    /// Whether kernels of lanes are taken: for CPU drivers, and where they run.
    pub(crate) fn lanes(&self) -> bool {
        self.form() == Form::Cpu && self.runs_lanes()
    }

    /// Whether kernels of lanes run here, good or not: they are written for subgroups of 8.
    pub(crate) fn runs_lanes(&self) -> bool {
        self.info().subgroup_size == 8
    }
}
