//! What a driver's compiler says of the kernels it made: registers, spills, shared memory, occupancy.
//!
//! `VK_KHR_pipeline_executable_properties` gives each driver's own figures under its own names. [`Compiled`] keeps them all,
//! and gives those that drivers have in common one name. A driver without the extension (lavapipe) leaves the time alone.

use ash::vk;

/// A figure in the driver's words.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Statistic {
    /// Name.
    pub name: String,
    /// Value; a truth is 0 or 1.
    pub value: f64,
    /// What it means.
    pub description: String,
}

/// What became of one kernel with one set of constants.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Compiled {
    /// Kernel.
    pub kernel: &'static str,
    /// Specialisation constants, as 32-bit words.
    pub constants: Vec<u32>,
    /// Milliseconds that the driver took; little where it has the kernel in a cache.
    pub milliseconds: f64,
    /// Vector registers of a thread.
    pub registers: Option<u64>,
    /// Registers, vector and scalar, that did not fit and live in memory.
    pub spilled: Option<u64>,
    /// Bytes of shared memory of a workgroup.
    pub shared_bytes: Option<u64>,
    /// Subgroups that one SIMD unit holds at once.
    pub occupancy: Option<u64>,
    /// All the driver's figures.
    pub statistics: Vec<Statistic>,
}

/// Names under which drivers give one figure, most exact first: RADV, NVIDIA, Intel (ANV), V3DV and Turnip.
const REGISTERS: &[&str] = &["VGPRs", "Register Count", "Registers", "Max live registers", "Full precision registers"];
const SPILLED: &[&[&str]] = &[&["Spilled VGPRs", "Spilled SGPRs"], &["Spill count", "Spill Count", "Spills"]];
const SHARED: &[&str] = &["LDS Size", "LDS size", "Shared Memory Size", "Shared memory"];
const OCCUPANCY: &[&str] = &["Subgroups per SIMD", "Waves per SIMD", "Max Waves Per Core", "Occupancy"];

impl Compiled {
    pub(super) fn new(
        kernel: &'static str,
        constants: Vec<u32>,
        milliseconds: f64,
        statistics: Vec<Statistic>,
    ) -> Self {
        let find = |name: &str| statistics.iter().find(|s| s.name == name).map(|s| s.value as u64);
        let first = |names: &[&str]| names.iter().find_map(|name| find(name));
        let spilled = SPILLED.iter().find_map(|names| {
            let found: Vec<u64> = names.iter().filter_map(|name| find(name)).collect();
            (!found.is_empty()).then(|| found.iter().sum())
        });
        Self {
            kernel,
            constants,
            milliseconds,
            registers: first(REGISTERS),
            spilled,
            shared_bytes: first(SHARED),
            occupancy: first(OCCUPANCY),
            statistics,
        }
    }
}

/// The driver's figures for a pipeline made with statistics; none where it has none.
pub(super) fn of(
    extension: &ash::khr::pipeline_executable_properties::Device,
    pipeline: vk::Pipeline,
) -> Vec<Statistic> {
    let info = vk::PipelineInfoKHR::default().pipeline(pipeline);
    // SAFETY: the pipeline is live and was made to keep its statistics.
    let count = unsafe { extension.get_pipeline_executable_properties(&info) }.map_or(0, |all| all.len() as u32);
    let of_executable = |index: u32| {
        let info = vk::PipelineExecutableInfoKHR::default().pipeline(pipeline).executable_index(index);
        // SAFETY: as above; the index is one of those just counted.
        unsafe { extension.get_pipeline_executable_statistics(&info) }.unwrap_or_default()
    };
    let statistic = |s: vk::PipelineExecutableStatisticKHR<'_>| Statistic {
        name: s.name_as_c_str().map_or_else(|_| String::new(), |n| n.to_string_lossy().into_owned()),
        // SAFETY: the format says which member the driver wrote.
        value: unsafe {
            match s.format {
                vk::PipelineExecutableStatisticFormatKHR::BOOL32 => f64::from(s.value.b32),
                vk::PipelineExecutableStatisticFormatKHR::INT64 => s.value.i64 as f64,
                vk::PipelineExecutableStatisticFormatKHR::FLOAT64 => s.value.f64,
                _ => s.value.u64 as f64,
            }
        },
        description: s.description_as_c_str().map_or_else(|_| String::new(), |d| d.to_string_lossy().into_owned()),
    };
    (0..count).flat_map(of_executable).map(statistic).collect()
}

impl super::Gpu {
    /// Of all pipelines made so far, by kernel and constants, what the driver says. Empty unless the device was opened
    /// with [`Options::statistics`](super::Options::statistics).
    pub fn compiled(&self) -> Vec<Compiled> {
        let mut all = self.inner().compiled();
        all.sort_by(|a, b| (a.kernel, &a.constants).cmp(&(b.kernel, &b.constants)));
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drivers_name_one_figure_in_many_ways() {
        let of = |pairs: &[(&str, f64)]| {
            let statistic = |(name, value): &(&str, f64)| Statistic {
                name: (*name).to_owned(),
                value: *value,
                description: String::new(),
            };
            let made = Compiled::new("k", vec![], 1.0, pairs.iter().map(statistic).collect());
            (made.registers, made.spilled, made.shared_bytes, made.occupancy)
        };
        let radv = [
            ("SGPRs", 32.0),
            ("VGPRs", 96.0),
            ("Spilled SGPRs", 2.0),
            ("Spilled VGPRs", 5.0),
            ("LDS size", 512.0),
            ("Subgroups per SIMD", 10.0),
        ];
        assert_eq!(of(&radv), (Some(96), Some(7), Some(512), Some(10)));
        assert_eq!(of(&[("Register Count", 40.0), ("Binary Size", 1e4)]), (Some(40), None, None, None));
        assert_eq!(of(&[("Spill Count", 0.0), ("Instruction Count", 9.0)]), (None, Some(0), None, None));
        assert_eq!(of(&[]), (None, None, None, None));
    }
}
