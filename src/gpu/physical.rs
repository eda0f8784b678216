//! The devices of a machine: what each is and lacks, and which one is meant.

use std::ffi::CStr;

use ash::vk;

use super::error::{Error, Named};
use super::instance::has;
use super::kernel::Interface;
use super::kernels::{MOST_BUFFERS, MOST_FULL_THREADS, MOST_PUSH_BYTES, MOST_SUBGROUP_THREADS, MOST_THREADS};

/// Fewest threads of a subgroup that the kernels are made for.
const LEAST_SUBGROUP: u32 = 4;
/// Bytes of shared memory that kernels may take.
const SHARED_BYTES: u32 = 32 << 10;

// Every device has 128 bytes of push constants, and whoever pushes descriptors takes 32.
const _: () = assert!(MOST_BUFFERS <= 32 && MOST_PUSH_BYTES <= 128 && MOST_SUBGROUP_THREADS == 64);

/// What a device is and can.
#[derive(Clone, Debug, serde::Serialize)]
pub struct DeviceInfo {
    /// Position in the list.
    pub index: usize,
    /// Name as the driver gives it.
    pub name: String,
    /// `discrete`, `integrated`, `virtual`, `cpu` or `other`.
    pub kind: &'static str,
    /// Driver name and version in its own words.
    pub driver: String,
    /// Vulkan version.
    pub api: String,
    /// Threads of a subgroup, as kernels run.
    pub subgroup_size: u32,
    /// Threads of a subgroup of kernels that ask for the least: 32 on RDNA, 8 or 16 on Xe, elsewhere mostly the same.
    pub narrow_subgroup_size: u32,
    /// The buffers of a pass can be pushed. Otherwise they are bound as descriptor sets.
    pub push_descriptors: bool,
    /// Bytes one storage binding holds: the range of a binding, the size of a buffer or of an allocation, the least.
    pub max_binding_bytes: u64,
    /// Bytes of the largest device-local heap.
    pub heap_bytes: u64,
    /// Bytes of shared memory of a workgroup.
    pub shared_bytes: u32,
    /// Workgroups of a dispatch in x.
    pub max_groups: u32,
    /// Nanoseconds of one timestamp tick; 0 without timestamps.
    pub timestamp_period: f32,
    /// Features that every kernel needs and this device lacks.
    pub lacks: Vec<String>,
}

/// A device that could be opened.
pub(super) struct Found {
    pub raw: vk::PhysicalDevice,
    pub info: DeviceInfo,
    pub subgroups: Subgroups,
    /// Kernels can declare that they tell what is not a number from a number.
    pub keeps_nan: bool,
    /// The family whose queue is taken; a device that lacks nothing has one.
    pub family: Option<u32>,
    pub identity: Identity,
    pub extensions: Vec<vk::ExtensionProperties>,
}

/// Whose pipelines a cache holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Identity {
    pub vendor: u32,
    pub device: u32,
    pub uuid: [u8; vk::UUID_SIZE],
}

/// The sizes that a device's subgroups have.
#[derive(Clone, Copy, Debug)]
pub(super) struct Subgroups {
    /// The driver's own choice.
    own: u32,
    least: u32,
    most: u32,
    /// A compute kernel can ask for one of them.
    chosen: bool,
    /// Most of them in the workgroup of a kernel that asks for their size.
    room: u32,
}

impl Subgroups {
    /// The driver's choice if the kernels can have it, else the nearest size that they can, if there is one.
    ///
    /// Where no size can be asked for, the driver's own is what kernels get, however many others it lists: pipelines do not
    /// allow a varying size, their modules are older than SPIR-V 1.6, and their subgroups are asked to be full. MoltenVK on
    /// Apple's GPUs is such a driver, with 32 of 4 to 32.
    fn usual(self) -> Option<u32> {
        self.sizes().min_by_key(|size| (size.abs_diff(self.own), *size != self.own))
    }

    /// The sizes that kernels can have.
    fn sizes(self) -> impl Iterator<Item = u32> {
        let (least, most) = if self.chosen { (self.least, self.most) } else { (self.own, self.own) };
        let sizes = (0..32).map(|bit| 1 << bit).filter(move |size| (least..=most).contains(size));
        let own = Some(self.own).filter(|size| size.is_power_of_two());
        let fits = |size: &u32| (LEAST_SUBGROUP..=MOST_SUBGROUP_THREADS).contains(size);
        own.into_iter().chain(sizes).filter(fits)
    }

    /// The least size that kernels can have, which is as wide as the device's units are.
    fn narrow(self) -> Option<u32> {
        let usual = self.usual();
        self.sizes().filter(|size| Some(*size) == usual || self.holds(MOST_FULL_THREADS, *size)).min()
    }

    /// A workgroup of so many threads can ask for subgroups of this size.
    fn holds(self, threads: u32, size: u32) -> bool {
        self.chosen && threads.div_ceil(size) <= self.room
    }

    /// A kernel asks for subgroups of this size: where it counts on it, and where it would be faster and its workgroup may
    /// have so many.
    pub fn asks(self, kernel: &Interface, size: u32) -> bool {
        (kernel.subgroups || kernel.narrow) && self.holds(kernel.group.iter().product(), size)
    }

    /// This size, in the place of the usual one.
    ///
    /// # Errors
    /// What the device lacks.
    pub fn wanted(self, size: u32) -> Result<u32, String> {
        let Self { own, least, most, chosen, .. } = self;
        if !(least..=most).contains(&size) || !size.is_power_of_two() {
            return Err(format!("subgroups of {size} threads (it has {least} to {most})"));
        }
        if !chosen && size != own {
            return Err(format!("a choice of its subgroups' size (they have {own} threads)"));
        }
        if chosen && !self.holds(MOST_FULL_THREADS, size) {
            return Err(format!("workgroups of {} subgroups of {size} threads", MOST_FULL_THREADS.div_ceil(size)));
        }
        let usual = Self { own: size, ..self }.usual();
        usual.filter(|&found| found == size).ok_or_else(|| {
            let kernels = format!("kernels have {LEAST_SUBGROUP} to {MOST_SUBGROUP_THREADS}");
            format!("subgroups of {size} threads that kernels can use ({kernels})")
        })
    }
}

/// What a driver tells of a device.
struct Facts {
    core: vk::PhysicalDeviceProperties,
    v11: vk::PhysicalDeviceVulkan11Properties<'static>,
    v12: vk::PhysicalDeviceVulkan12Properties<'static>,
    v13: vk::PhysicalDeviceVulkan13Properties<'static>,
    f12: vk::PhysicalDeviceVulkan12Features<'static>,
    f13: vk::PhysicalDeviceVulkan13Features<'static>,
    /// Buffers that can be pushed; 0 without the extension.
    pushed: u32,
    families: Vec<vk::QueueFamilyProperties>,
    memory: vk::PhysicalDeviceMemoryProperties,
}

/// The devices of the instance: discrete first, CPUs last, within a kind those with more memory of their own first, then in
/// the loader's order. A device whose driver does not answer is listed with what it said.
///
/// # Errors
/// When the loader cannot list them.
pub(super) fn list(instance: &ash::Instance) -> Result<Vec<Found>, Error> {
    // SAFETY: plain queries of a live instance.
    let physical = unsafe { instance.enumerate_physical_devices() }.named("listing devices")?;
    let mut found: Vec<(Rank, Found)> = physical.into_iter().map(|raw| find(instance, raw)).collect();
    found.sort_by_key(|(rank, _)| *rank);
    let numbered = found.into_iter().enumerate();
    Ok(numbered.map(|(index, (_, found))| Found { info: DeviceInfo { index, ..found.info }, ..found }).collect())
}

/// A device's place among others, the first the least: its kind's, then by memory.
type Rank = (u8, std::cmp::Reverse<u64>);

fn find(instance: &ash::Instance, raw: vk::PhysicalDevice) -> (Rank, Found) {
    // SAFETY: plain queries of a live instance.
    let extensions = unsafe { instance.enumerate_device_extension_properties(raw) };
    let pushes = extensions.as_ref().is_ok_and(|listed| has(listed, ash::khr::push_descriptor::NAME));
    let facts = Facts::ask(instance, raw, pushes);
    (facts.rank(), facts.found(raw, extensions))
}

/// The device that is meant, or the first that lacks nothing.
///
/// # Errors
/// When none is meant, or the one that is lacks something.
pub(super) fn choose(devices: Vec<Found>, wanted: Option<&str>) -> Result<Found, Error> {
    if devices.is_empty() {
        return Err(Error::NoDevice);
    }
    let name = |d: &Found| format!("{}: {}", d.info.index, d.info.name);
    let listed = devices.iter().map(name).collect::<Vec<_>>().join(", ");
    let matches = |d: &DeviceInfo| match wanted {
        None => d.lacks.is_empty(),
        Some(text) => match text.parse::<usize>() {
            Ok(index) => d.index == index,
            Err(_) => d.name.to_lowercase().contains(&text.to_lowercase()),
        },
    };
    let all = devices.len();
    match (devices.into_iter().find(|d| matches(&d.info)), wanted) {
        (Some(found), _) => match found.info.lacks.first() {
            None => Ok(found),
            Some(feature) => Err(Error::Missing { device: found.info.name.clone(), feature: feature.clone() }),
        },
        (None, Some(text)) => Err(Error::UnknownDevice { wanted: text.to_owned(), listed }),
        (None, None) => Err(Error::Missing {
            device: format!("each of the {all} devices here ({listed})"),
            feature: "a needed feature (`gscream-vk devices` names it)".into(),
        }),
    }
}

impl Facts {
    fn ask(instance: &ash::Instance, raw: vk::PhysicalDevice, can_push: bool) -> Self {
        let mut v11 = vk::PhysicalDeviceVulkan11Properties::default();
        let mut v12 = vk::PhysicalDeviceVulkan12Properties::default();
        let mut v13 = vk::PhysicalDeviceVulkan13Properties::default();
        let mut push = vk::PhysicalDevicePushDescriptorPropertiesKHR::default();
        let mut properties =
            vk::PhysicalDeviceProperties2::default().push_next(&mut v11).push_next(&mut v12).push_next(&mut v13);
        if can_push {
            properties = properties.push_next(&mut push);
        }
        let mut f12 = vk::PhysicalDeviceVulkan12Features::default();
        let mut f13 = vk::PhysicalDeviceVulkan13Features::default();
        let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut f12).push_next(&mut f13);
        // SAFETY: plain queries of a live instance; structures for 1.2 and 1.3 are ignored by older drivers.
        let (memory, families) = unsafe {
            instance.get_physical_device_properties2(raw, &mut properties);
            instance.get_physical_device_features2(raw, &mut features);
            (
                instance.get_physical_device_memory_properties(raw),
                instance.get_physical_device_queue_family_properties(raw),
            )
        };
        let core = properties.properties;
        let alone = std::ptr::null_mut(); // what the chains above pointed to goes out of scope
        Self {
            core,
            v11: vk::PhysicalDeviceVulkan11Properties { p_next: alone, ..v11 },
            v12: vk::PhysicalDeviceVulkan12Properties { p_next: alone, ..v12 },
            v13: vk::PhysicalDeviceVulkan13Properties { p_next: alone, ..v13 },
            f12: vk::PhysicalDeviceVulkan12Features { p_next: alone, ..f12 },
            f13: vk::PhysicalDeviceVulkan13Features { p_next: alone, ..f13 },
            pushed: push.max_push_descriptors,
            families,
            memory,
        }
    }

    fn found(
        &self,
        raw: vk::PhysicalDevice,
        extensions: ash::prelude::VkResult<Vec<vk::ExtensionProperties>>,
    ) -> Found {
        let mut info = self.describe();
        if let Err(result) = extensions {
            info.lacks.insert(0, format!("a driver that answers (listing its extensions: {result})"));
        }
        Found {
            raw,
            info,
            subgroups: self.subgroups(),
            keeps_nan: self.v12.shader_signed_zero_inf_nan_preserve_float32 != 0,
            family: self.family(),
            identity: Identity {
                vendor: self.core.vendor_id,
                device: self.core.device_id,
                uuid: self.core.pipeline_cache_uuid,
            },
            extensions: extensions.unwrap_or_default(),
        }
    }

    fn rank(&self) -> Rank {
        let kind = match self.core.device_type {
            vk::PhysicalDeviceType::DISCRETE_GPU => 0,
            vk::PhysicalDeviceType::INTEGRATED_GPU => 1,
            vk::PhysicalDeviceType::VIRTUAL_GPU => 2,
            vk::PhysicalDeviceType::CPU => 4,
            _ => 3,
        };
        (kind, std::cmp::Reverse(self.heap_bytes()))
    }

    /// The family whose queue takes the work: one that computes and does not draw, where there is one. Its work keeps no
    /// desktop waiting, and a switch between passes and fills has no state of drawing to save.
    fn family(&self) -> Option<u32> {
        let first = |without: vk::QueueFlags| {
            let fits = |f: &vk::QueueFamilyProperties| {
                let flags = f.queue_flags;
                f.queue_count > 0 && flags.contains(vk::QueueFlags::COMPUTE) && !flags.intersects(without)
            };
            self.families.iter().position(fits)
        };
        let found = first(vk::QueueFlags::GRAPHICS).or_else(|| first(vk::QueueFlags::empty()));
        found.map(|at| at as u32)
    }

    /// Bytes of the largest heap of its own.
    fn heap_bytes(&self) -> u64 {
        let heaps = &self.memory.memory_heaps[..self.memory.memory_heap_count as usize];
        let local = heaps.iter().filter(|h| h.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL)).map(|h| h.size);
        local.max().unwrap_or(0)
    }

    fn subgroups(&self) -> Subgroups {
        Subgroups {
            own: self.v11.subgroup_size,
            least: self.v13.min_subgroup_size,
            most: self.v13.max_subgroup_size,
            chosen: self.v13.required_subgroup_size_stages.contains(vk::ShaderStageFlags::COMPUTE),
            room: self.v13.max_compute_workgroup_subgroups,
        }
    }

    fn lacks(&self) -> Vec<String> {
        let Self { core, v11, f12, f13, .. } = self;
        let limits = &core.limits;
        let mut lacks = vec![];
        let mut need = |ok: bool, what: &str| {
            if !ok {
                lacks.push(what.to_owned());
            }
        };
        need(core.api_version >= vk::API_VERSION_1_3, "Vulkan 1.3");
        need(f12.scalar_block_layout != 0, "scalar block layout");
        need(f13.synchronization2 != 0, "synchronization2");
        need(f13.maintenance4 != 0, "maintenance4");
        need(
            f13.subgroup_size_control != 0 && f13.compute_full_subgroups != 0,
            "subgroup size control with full subgroups",
        );
        let operations = vk::SubgroupFeatureFlags::BASIC
            | vk::SubgroupFeatureFlags::VOTE
            | vk::SubgroupFeatureFlags::BALLOT
            | vk::SubgroupFeatureFlags::SHUFFLE
            | vk::SubgroupFeatureFlags::ARITHMETIC;
        let wanted = "subgroup vote, ballot, shuffle and arithmetic operations";
        need(v11.subgroup_supported_operations.contains(operations), wanted);
        need(
            v11.subgroup_supported_stages.contains(vk::ShaderStageFlags::COMPUTE),
            "subgroup operations in compute kernels",
        );
        let subgroups = self.subgroups();
        let size = subgroups.usual();
        let wanted = format!("subgroups of one known size of {LEAST_SUBGROUP} to {MOST_SUBGROUP_THREADS} threads");
        need(size.is_some(), &wanted);
        if let Some(size) = size.filter(|_| subgroups.chosen) {
            let full = MOST_FULL_THREADS.div_ceil(size);
            need(subgroups.holds(MOST_FULL_THREADS, size), &format!("workgroups of {full} subgroups"));
        }
        let buffers = limits.max_per_stage_descriptor_storage_buffers.min(limits.max_descriptor_set_storage_buffers);
        need(
            buffers.min(limits.max_per_stage_resources) >= MOST_BUFFERS,
            &format!("{MOST_BUFFERS} storage buffers in a kernel"),
        );
        need(limits.max_compute_shared_memory_size >= SHARED_BYTES, "32 KiB of shared memory");
        need(limits.max_push_constants_size >= MOST_PUSH_BYTES, &format!("{MOST_PUSH_BYTES} bytes of push constants"));
        let threads = limits.max_compute_work_group_invocations.min(limits.max_compute_work_group_size[0]);
        need(threads >= MOST_THREADS, &format!("workgroups of {MOST_THREADS} threads"));
        need(self.family().is_some(), "a compute queue");
        lacks
    }

    /// At position 0.
    fn describe(&self) -> DeviceInfo {
        let Self { core, v11, v12, v13, .. } = self;
        let kind = match core.device_type {
            vk::PhysicalDeviceType::DISCRETE_GPU => "discrete",
            vk::PhysicalDeviceType::INTEGRATED_GPU => "integrated",
            vk::PhysicalDeviceType::VIRTUAL_GPU => "virtual",
            vk::PhysicalDeviceType::CPU => "cpu",
            _ => "other",
        };
        let version = core.api_version;
        // One binding is a whole buffer, and a buffer one allocation at most. A driver before 1.3 leaves the last limit
        // at 0.
        let limits =
            [u64::from(core.limits.max_storage_buffer_range), v11.max_memory_allocation_size, v13.max_buffer_size];
        let timestamps = self.family().is_some_and(|at| self.families[at as usize].timestamp_valid_bits > 0);
        DeviceInfo {
            index: 0,
            name: text(core.device_name_as_c_str()),
            kind,
            driver: format!("{} {}", text(v12.driver_name_as_c_str()), text(v12.driver_info_as_c_str())),
            api: format!(
                "{}.{}.{}",
                vk::api_version_major(version),
                vk::api_version_minor(version),
                vk::api_version_patch(version)
            ),
            subgroup_size: self.subgroups().usual().unwrap_or(v11.subgroup_size),
            narrow_subgroup_size: self.subgroups().narrow().unwrap_or(v11.subgroup_size),
            push_descriptors: self.pushed >= MOST_BUFFERS,
            max_binding_bytes: limits.into_iter().filter(|&bytes| bytes > 0).min().unwrap_or(0),
            heap_bytes: self.heap_bytes(),
            shared_bytes: core.limits.max_compute_shared_memory_size,
            max_groups: core.limits.max_compute_work_group_count[0],
            timestamp_period: if timestamps { core.limits.timestamp_period } else { 0.0 },
            lacks: self.lacks(),
        }
    }
}

fn text(chars: Result<&CStr, std::ffi::FromBytesUntilNulError>) -> String {
    chars.map_or_else(|_| String::new(), |s| s.to_string_lossy().into_owned())
}

#[cfg(test)]
mod known;

#[cfg(test)]
mod tests {
    use super::*;

    /// A device that has just what kernels need.
    pub(super) fn plain() -> Facts {
        let mut core = vk::PhysicalDeviceProperties {
            api_version: vk::API_VERSION_1_3,
            ..vk::PhysicalDeviceProperties::default()
        };
        core.limits.max_per_stage_descriptor_storage_buffers = MOST_BUFFERS;
        core.limits.max_descriptor_set_storage_buffers = MOST_BUFFERS;
        core.limits.max_per_stage_resources = MOST_BUFFERS;
        core.limits.max_compute_shared_memory_size = SHARED_BYTES;
        core.limits.max_push_constants_size = MOST_PUSH_BYTES;
        core.limits.max_compute_work_group_invocations = MOST_THREADS;
        core.limits.max_compute_work_group_size = [MOST_THREADS, 1, 1];
        let v11 = vk::PhysicalDeviceVulkan11Properties::default()
            .subgroup_size(32)
            .subgroup_supported_stages(vk::ShaderStageFlags::COMPUTE)
            .subgroup_supported_operations(vk::SubgroupFeatureFlags::from_raw(0xff));
        let v13 = vk::PhysicalDeviceVulkan13Properties::default()
            .min_subgroup_size(32)
            .max_subgroup_size(32)
            .max_compute_workgroup_subgroups(MOST_FULL_THREADS.div_ceil(32))
            .required_subgroup_size_stages(vk::ShaderStageFlags::COMPUTE);
        Facts {
            core,
            v11,
            v12: vk::PhysicalDeviceVulkan12Properties::default(),
            v13,
            f12: vk::PhysicalDeviceVulkan12Features::default().scalar_block_layout(true),
            f13: vk::PhysicalDeviceVulkan13Features::default()
                .synchronization2(true)
                .maintenance4(true)
                .subgroup_size_control(true)
                .compute_full_subgroups(true),
            pushed: 0,
            families: vec![vk::QueueFamilyProperties::default().queue_flags(vk::QueueFlags::COMPUTE).queue_count(1)],
            memory: heaps(&[(1 << 30, true)]),
        }
    }

    /// Heaps of so many bytes, the device's own or not.
    pub(super) fn heaps(heaps: &[(u64, bool)]) -> vk::PhysicalDeviceMemoryProperties {
        let memory_heap_count = heaps.len() as u32;
        let mut memory = vk::PhysicalDeviceMemoryProperties { memory_heap_count, ..Default::default() };
        for (heap, &(size, local)) in memory.memory_heaps.iter_mut().zip(heaps) {
            let local = if local { vk::MemoryHeapFlags::DEVICE_LOCAL } else { vk::MemoryHeapFlags::empty() };
            *heap = vk::MemoryHeap::default().size(size).flags(local);
        }
        memory
    }

    #[test]
    fn limits_are_those_of_the_largest_kernel() {
        assert_eq!(plain().lacks(), [""; 0]);
        let lacks = |change: &dyn Fn(&mut Facts)| {
            let mut facts = plain();
            change(&mut facts);
            facts.lacks().join("; ")
        };
        let buffers = format!("{MOST_BUFFERS} storage buffers in a kernel");
        assert_eq!(lacks(&|f| f.core.limits.max_per_stage_descriptor_storage_buffers -= 1), buffers);
        assert_eq!(lacks(&|f| f.core.limits.max_descriptor_set_storage_buffers -= 1), buffers);
        assert_eq!(lacks(&|f| f.core.limits.max_per_stage_resources -= 1), buffers);
        let threads = format!("workgroups of {MOST_THREADS} threads");
        assert_eq!(lacks(&|f| f.core.limits.max_compute_work_group_size[0] -= 1), threads);
        let full = format!("workgroups of {} subgroups", MOST_FULL_THREADS.div_ceil(32));
        assert_eq!(lacks(&|f| f.v13.max_compute_workgroup_subgroups -= 1), full);
        assert_eq!(lacks(&|f| f.families.clear()), "a compute queue");
        let pushes = |pushed| Facts { pushed, ..plain() }.describe().push_descriptors;
        assert!(pushes(MOST_BUFFERS) && !pushes(MOST_BUFFERS - 1) && !pushes(0));
    }

    #[test]
    fn the_size_of_subgroups_is_one_that_kernels_can_have() {
        let sizes = |own, least, most, chosen| Subgroups { own, least, most, chosen, room: 64 };
        assert_eq!(sizes(32, 32, 32, true).usual(), Some(32));
        assert_eq!(sizes(64, 32, 64, true).usual(), Some(64));
        assert_eq!(sizes(128, 64, 128, true).usual(), Some(64), "a workgroup of 64 has no full subgroup of 128");
        assert_eq!(sizes(128, 128, 128, true).usual(), None);
        assert_eq!(sizes(1, 1, 8, true).usual(), Some(4));
        assert_eq!(sizes(2, 1, 2, true).usual(), None);
        assert_eq!(sizes(32, 32, 32, false).usual(), Some(32), "the only size needs no asking");
        assert_eq!(sizes(32, 4, 32, false).usual(), Some(32), "the driver's own is what kernels get");
        assert_eq!(sizes(128, 64, 128, false).usual(), None);

        assert_eq!(sizes(64, 32, 64, true).wanted(32), Ok(32));
        assert_eq!(sizes(64, 32, 64, true).wanted(16), Err("subgroups of 16 threads (it has 32 to 64)".into()));
        let wide = sizes(64, 64, 128, true).wanted(128);
        assert_eq!(wide, Err("subgroups of 128 threads that kernels can use (kernels have 4 to 64)".into()));
        assert_eq!(sizes(32, 32, 32, false).wanted(32), Ok(32));
        assert_eq!(sizes(16, 8, 32, false).wanted(16), Ok(16));
        let other = sizes(32, 4, 32, false).wanted(16);
        assert_eq!(other, Err("a choice of its subgroups' size (they have 32 threads)".into()));
        let crowded = Subgroups { room: 16, ..sizes(32, 4, 32, true) }.wanted(4);
        assert_eq!(crowded, Err(format!("workgroups of {} subgroups of 4 threads", MOST_FULL_THREADS / 4)));
    }

    /// lavapipe with vectors of 128 bits has subgroups of 4, and 32 of them in a workgroup.
    #[test]
    fn a_kernel_asks_for_no_more_subgroups_than_a_workgroup_may_have() {
        let of_4 = Subgroups { own: 4, least: 4, most: 4, chosen: true, room: 32 };
        let kernel = |threads, subgroups, narrow| Interface {
            name: "made",
            choice: 0,
            bound: 0,
            group: [threads, 1, 1],
            subgroups,
            narrow,
            bindings: &[],
            constants: &[],
            push_bytes: 0,
            spirv: &[],
        };
        assert!(of_4.asks(&kernel(128, true, false), 4) && of_4.asks(&kernel(128, false, true), 4));
        assert!(!of_4.asks(&kernel(256, false, true), 4), "it is as right without");
        assert!(!of_4.asks(&kernel(128, false, false), 4));
        assert!(!Subgroups { chosen: false, ..of_4 }.asks(&kernel(128, true, true), 4));
    }

    #[test]
    fn a_driver_that_does_not_answer_is_listed() {
        let failing = plain().found(vk::PhysicalDevice::null(), Err(vk::Result::ERROR_OUT_OF_HOST_MEMORY));
        let lacks = failing.info.lacks.join("; ");
        assert!(lacks.starts_with("a driver that answers (listing its extensions: "), "{lacks}");
        let whole = || plain().found(vk::PhysicalDevice::null(), Ok(vec![]));
        let at = |index, found: Found| Found { info: DeviceInfo { index, ..found.info }, ..found };
        let chosen = choose(vec![at(0, failing), at(1, whole())], None).expect("the other one");
        assert_eq!(chosen.info.index, 1);
    }

    #[test]
    fn discrete_gpus_with_the_most_memory_come_first() {
        let of = |kind, gib: u64| {
            let core = vk::PhysicalDeviceProperties { device_type: kind, ..plain().core };
            Facts { core, memory: heaps(&[(64 << 30, false), (gib << 30, true)]), ..plain() }.rank()
        };
        use vk::PhysicalDeviceType as Kind;
        let ordered = [
            of(Kind::DISCRETE_GPU, 24),
            of(Kind::DISCRETE_GPU, 8),
            of(Kind::INTEGRATED_GPU, 32),
            of(Kind::VIRTUAL_GPU, 8),
            of(Kind::OTHER, 8),
            of(Kind::CPU, 256),
        ];
        assert!(ordered.is_sorted_by(|a, b| a < b), "{ordered:?}");
    }

    #[test]
    fn a_queue_that_only_computes_comes_first() {
        let family = |flags: &[vk::QueueFlags]| {
            let family = |&flags| vk::QueueFamilyProperties::default().queue_flags(flags).queue_count(1);
            Facts { families: flags.iter().map(family).collect(), ..plain() }.family()
        };
        let [draws, computes] = [vk::QueueFlags::GRAPHICS, vk::QueueFlags::COMPUTE];
        assert_eq!(family(&[draws | computes, vk::QueueFlags::TRANSFER, computes]), Some(2));
        assert_eq!(family(&[vk::QueueFlags::TRANSFER, draws | computes]), Some(1));
        assert_eq!(family(&[draws, vk::QueueFlags::TRANSFER]), None);
    }
}
