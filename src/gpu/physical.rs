//! The devices of a machine: what each is and lacks, and which one is meant.

use std::ffi::CStr;

use ash::vk;

use super::error::{Error, Named};
use super::instance::has;
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
    pub chosen: bool,
}

impl Subgroups {
    /// The driver's choice if the kernels can have it, else the nearest size that they can, if there is one. A size that
    /// nobody can ask for must be the only one: kernels would not know which they have.
    fn usual(self) -> Option<u32> {
        let fits = |size: &u32| (LEAST_SUBGROUP..=MOST_SUBGROUP_THREADS).contains(size) && size.is_power_of_two();
        if !self.chosen {
            return Some(self.own).filter(|size| self.least == self.most && fits(size));
        }
        let sizes = (0..32).map(|bit| 1 << bit).filter(|size| (self.least..=self.most).contains(size));
        Some(self.own).into_iter().chain(sizes).filter(fits).min_by_key(|size| size.abs_diff(self.own))
    }

    /// This size, in the place of the usual one.
    ///
    /// # Errors
    /// What the device lacks.
    pub fn wanted(self, size: u32) -> Result<u32, String> {
        let Self { least, most, chosen, .. } = self;
        if !(least..=most).contains(&size) || !size.is_power_of_two() {
            return Err(format!("subgroups of {size} threads (it has {least} to {most})"));
        }
        let usual = Self { own: size, ..self }.usual();
        let only = if chosen { "kernels have 4 to" } else { "its size cannot be chosen, and kernels have 4 to" };
        usual
            .filter(|&found| found == size)
            .ok_or_else(|| format!("subgroups of {size} threads that kernels can use ({only} {MOST_SUBGROUP_THREADS})"))
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
    compute: bool,
    heap_bytes: u64,
}

/// The devices of the instance: discrete first, CPUs last, in the loader's order within a kind.
///
/// # Errors
/// When the loader cannot list them.
pub(super) fn list(instance: &ash::Instance) -> Result<Vec<Found>, Error> {
    // SAFETY: plain queries of a live instance.
    let mut physical = unsafe { instance.enumerate_physical_devices() }.named("listing devices")?;
    let rank = |p: &vk::PhysicalDevice| {
        // SAFETY: as above.
        match unsafe { instance.get_physical_device_properties(*p) }.device_type {
            vk::PhysicalDeviceType::DISCRETE_GPU => 0,
            vk::PhysicalDeviceType::INTEGRATED_GPU => 1,
            vk::PhysicalDeviceType::VIRTUAL_GPU => 2,
            _ => 3,
        }
    };
    physical.sort_by_key(rank);
    physical.into_iter().enumerate().map(|(index, raw)| find(instance, raw, index)).collect()
}

fn find(instance: &ash::Instance, raw: vk::PhysicalDevice, index: usize) -> Result<Found, Error> {
    // SAFETY: plain queries of a live instance.
    let extensions = unsafe { instance.enumerate_device_extension_properties(raw) };
    let extensions = extensions.named("listing device extensions")?;
    let facts = Facts::ask(instance, raw, has(&extensions, ash::khr::push_descriptor::NAME));
    Ok(Found {
        raw,
        info: facts.describe(index),
        subgroups: facts.subgroups(),
        identity: Identity {
            vendor: facts.core.vendor_id,
            device: facts.core.device_id,
            uuid: facts.core.pipeline_cache_uuid,
        },
        extensions,
    })
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
        let heaps = &memory.memory_heaps[..memory.memory_heap_count as usize];
        let local = heaps.iter().filter(|h| h.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL)).map(|h| h.size).max();
        let alone = std::ptr::null_mut(); // what the chains above pointed to goes out of scope
        Self {
            core,
            v11: vk::PhysicalDeviceVulkan11Properties { p_next: alone, ..v11 },
            v12: vk::PhysicalDeviceVulkan12Properties { p_next: alone, ..v12 },
            v13: vk::PhysicalDeviceVulkan13Properties { p_next: alone, ..v13 },
            f12: vk::PhysicalDeviceVulkan12Features { p_next: alone, ..f12 },
            f13: vk::PhysicalDeviceVulkan13Features { p_next: alone, ..f13 },
            pushed: push.max_push_descriptors,
            compute: families.iter().any(|f| f.queue_flags.contains(vk::QueueFlags::COMPUTE)),
            heap_bytes: local.unwrap_or(0),
        }
    }

    fn subgroups(&self) -> Subgroups {
        Subgroups {
            own: self.v11.subgroup_size,
            least: self.v13.min_subgroup_size,
            most: self.v13.max_subgroup_size,
            chosen: self.v13.required_subgroup_size_stages.contains(vk::ShaderStageFlags::COMPUTE),
        }
    }

    fn lacks(&self) -> Vec<String> {
        let Self { core, v11, v13, f12, f13, .. } = self;
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
        // A limit for sizes that are asked for.
        let most = if subgroups.chosen { v13.max_compute_workgroup_subgroups } else { u32::MAX };
        let full = size.map_or(0, |size| MOST_FULL_THREADS.div_ceil(size));
        need(most >= full, &format!("workgroups of {full} subgroups"));
        let buffers = limits.max_per_stage_descriptor_storage_buffers.min(limits.max_descriptor_set_storage_buffers);
        need(
            buffers.min(limits.max_per_stage_resources) >= MOST_BUFFERS,
            &format!("{MOST_BUFFERS} storage buffers in a kernel"),
        );
        need(limits.max_compute_shared_memory_size >= SHARED_BYTES, "32 KiB of shared memory");
        need(limits.max_push_constants_size >= MOST_PUSH_BYTES, &format!("{MOST_PUSH_BYTES} bytes of push constants"));
        let threads = limits.max_compute_work_group_invocations.min(limits.max_compute_work_group_size[0]);
        need(threads >= MOST_THREADS, &format!("workgroups of {MOST_THREADS} threads"));
        need(self.compute, "a compute queue");
        lacks
    }

    fn describe(&self, index: usize) -> DeviceInfo {
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
        let timestamps = core.limits.timestamp_compute_and_graphics != 0;
        DeviceInfo {
            index,
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
            push_descriptors: self.pushed >= MOST_BUFFERS,
            max_binding_bytes: limits.into_iter().filter(|&bytes| bytes > 0).min().unwrap_or(0),
            heap_bytes: self.heap_bytes,
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
mod tests {
    use super::*;

    /// A device that has just what kernels need.
    fn plain() -> Facts {
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
            compute: true,
            heap_bytes: 1 << 30,
        }
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
        assert_eq!(lacks(&|f| f.compute = false), "a compute queue");
        let pushes = |pushed| Facts { pushed, ..plain() }.describe(0).push_descriptors;
        assert!(pushes(MOST_BUFFERS) && !pushes(MOST_BUFFERS - 1) && !pushes(0));
    }

    #[test]
    fn the_size_of_subgroups_is_one_that_kernels_can_have() {
        let sizes = |own, least, most, chosen| Subgroups { own, least, most, chosen };
        assert_eq!(sizes(32, 32, 32, true).usual(), Some(32));
        assert_eq!(sizes(64, 32, 64, true).usual(), Some(64));
        assert_eq!(sizes(128, 64, 128, true).usual(), Some(64), "a workgroup of 64 has no full subgroup of 128");
        assert_eq!(sizes(128, 128, 128, true).usual(), None);
        assert_eq!(sizes(1, 1, 8, true).usual(), Some(4));
        assert_eq!(sizes(2, 1, 2, true).usual(), None);
        assert_eq!(sizes(32, 32, 32, false).usual(), Some(32), "the only size needs no asking");
        assert_eq!(sizes(16, 8, 32, false).usual(), None, "nobody knows which a kernel gets");

        assert_eq!(sizes(64, 32, 64, true).wanted(32), Ok(32));
        assert_eq!(sizes(64, 32, 64, true).wanted(16), Err("subgroups of 16 threads (it has 32 to 64)".into()));
        let wide = sizes(64, 64, 128, true).wanted(128);
        assert_eq!(wide, Err("subgroups of 128 threads that kernels can use (kernels have 4 to 64)".into()));
        assert_eq!(sizes(32, 32, 32, false).wanted(32), Ok(32));
        assert!(sizes(16, 8, 32, false).wanted(16).is_err());
    }
}
