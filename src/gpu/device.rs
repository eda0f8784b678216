//! Choosing and opening a device; pipelines; what a device lacks.

use std::any::TypeId;
use std::collections::HashMap;
use std::ffi::{CStr, c_void};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ash::vk;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, Allocator, AllocatorCreateDesc};

use super::error::{Error, Named};
use super::form::Form;
use super::kernel::Kernel;
use super::ledger::{Ledger, Rehearsal};
use super::recorder::Context;
use super::statistics::{self, Compiled, Statistic};

/// Bytes that are taken from the device at once for small buffers; larger buffers get memory of their own.
const DEVICE_BLOCK: u64 = 32 << 20;
const HOST_BLOCK: u64 = 16 << 20;
/// What the device gives beyond the buffers in use: the last block's rest, and as much in gaps.
pub const SPARE_BYTES: u64 = 2 * DEVICE_BLOCK + HOST_BLOCK;

/// How to open a device.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Index in `devices`' list, or a part of the name; the first usable device otherwise.
    pub device: Option<String>,
    /// Switch on the Khronos validation layer with synchronisation validation.
    pub validate: bool,
    /// A barrier after every pass.
    pub serialize: bool,
    /// Leave out every barrier between passes although the schedule still lists it. For tests alone: such a recording
    /// shows that synchronisation validation would notice a lost barrier, and must never be submitted.
    #[doc(hidden)]
    pub omit_barriers: bool,
    /// Timestamp queries around every pass.
    pub timestamps: bool,
    /// File of the pipeline cache; none is kept without it.
    pub cache: Option<PathBuf>,
    /// Keep what the driver's compiler says of each kernel ([`Gpu::compiled`]), and make kernels in rehearsals too.
    pub statistics: bool,
    /// Threads of a subgroup in place of the driver's own choice, where the device can.
    pub subgroup_size: Option<u32>,
    /// Form of the work in place of the one made for the device's kind.
    pub form: Option<Form>,
}

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
    /// Threads of a subgroup.
    pub subgroup_size: u32,
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

/// An open device, or a rehearsal of one. Cheap to clone.
#[derive(Clone)]
pub struct Gpu {
    inner: Arc<Inner>,
    rehearsal: Option<Arc<Rehearsal>>,
}

pub(super) struct Pipeline {
    name: &'static str,
    pub raw: vk::Pipeline,
    pub layout: vk::PipelineLayout,
    set: vk::DescriptorSetLayout,
    compiled: Option<Compiled>,
}

type PipelineKey = (TypeId, Vec<u8>);

pub(super) struct Inner {
    pub device: ash::Device,
    pub queue: vk::Queue,
    pub push_descriptor: ash::khr::push_descriptor::Device,
    executables: Option<ash::khr::pipeline_executable_properties::Device>,
    pub command_pool: vk::CommandPool,
    pub info: DeviceInfo,
    pub options: Options,
    pub contexts: Mutex<Vec<Context>>,
    pub debug: Option<ash::ext::debug_utils::Device>,
    pub ledger: Ledger,
    in_flight: Mutex<u32>,
    trash: Mutex<Vec<(vk::Buffer, Allocation)>>,
    pipelines: Mutex<HashMap<PipelineKey, Arc<Pipeline>>>,
    cache: vk::PipelineCache,
    allocator: Mutex<Option<Allocator>>,
    messages: Arc<Mutex<Vec<String>>>,
    physical: vk::PhysicalDevice,
    memory_budget: bool,
    messenger: Option<(ash::ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    instance: ash::Instance,
    _entry: ash::Entry,
}

/// Locks even when another thread panicked while holding it: the data are plain lists.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

const VALIDATION_LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";

unsafe extern "system" fn on_message(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    user: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the layer passes valid strings, and `user` is the list that the instance keeps alive.
    unsafe {
        let log = &*user.cast::<Mutex<Vec<String>>>();
        let text = (*data).message_as_c_str().map_or_else(String::new, |m| m.to_string_lossy().into_owned());
        lock(log).push(text);
    }
    vk::FALSE
}

struct Instance {
    entry: ash::Entry,
    raw: ash::Instance,
    messages: Arc<Mutex<Vec<String>>>,
    debug_utils: bool,
}

fn open_instance(validate: bool) -> Result<Instance, Error> {
    // SAFETY: loading the system's Vulkan loader, which runs its initialisers.
    let entry = unsafe { ash::Entry::load() }.map_err(|e| Error::NoLoader(e.to_string()))?;
    let named = |names: &[vk::LayerProperties]| {
        names.iter().any(|l| l.layer_name_as_c_str().is_ok_and(|name| name == VALIDATION_LAYER))
    };
    // SAFETY: plain queries of a loaded loader.
    let (layers, extensions) = unsafe {
        (
            entry.enumerate_instance_layer_properties().named("listing layers")?,
            entry.enumerate_instance_extension_properties(None).named("listing instance extensions")?,
        )
    };
    if validate && !named(&layers) {
        return Err(Error::NoValidationLayer);
    }
    let debug_utils = validate
        || extensions.iter().any(|e| e.extension_name_as_c_str().is_ok_and(|n| n == ash::ext::debug_utils::NAME));
    let application =
        vk::ApplicationInfo::default().application_name(c"gscream-vk").api_version(vk::make_api_version(0, 1, 3, 0));
    let enable = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
    let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&enable);
    let layer_names: Vec<_> = if validate { vec![VALIDATION_LAYER.as_ptr()] } else { vec![] };
    let extension_names: Vec<_> = if debug_utils { vec![ash::ext::debug_utils::NAME.as_ptr()] } else { vec![] };
    let mut info = vk::InstanceCreateInfo::default()
        .application_info(&application)
        .enabled_layer_names(&layer_names)
        .enabled_extension_names(&extension_names);
    if validate {
        info = info.push_next(&mut features);
    }
    // SAFETY: every name passed was listed by the loader or is checked by it.
    let raw = unsafe { entry.create_instance(&info, None) };
    // The loader's answer where no driver is installed, or none that can be loaded.
    if raw.as_ref().err() == Some(&vk::Result::ERROR_INCOMPATIBLE_DRIVER) {
        return Err(Error::NoDevice);
    }
    let raw = raw.named("creating a Vulkan instance")?;
    Ok(Instance { entry, raw, messages: Arc::default(), debug_utils })
}

fn text(chars: Result<&CStr, std::ffi::FromBytesUntilNulError>) -> String {
    chars.map_or_else(|_| String::new(), |s| s.to_string_lossy().into_owned())
}

/// The devices of the instance: discrete first, CPUs last, in the loader's order within a kind.
fn list(instance: &ash::Instance) -> Result<Vec<(vk::PhysicalDevice, DeviceInfo)>, Error> {
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
    physical.into_iter().enumerate().map(|(index, p)| Ok((p, describe(instance, p, index)?))).collect()
}

fn describe(instance: &ash::Instance, p: vk::PhysicalDevice, index: usize) -> Result<DeviceInfo, Error> {
    let mut v11 = vk::PhysicalDeviceVulkan11Properties::default();
    let mut v12 = vk::PhysicalDeviceVulkan12Properties::default();
    let mut v13 = vk::PhysicalDeviceVulkan13Properties::default();
    let mut properties =
        vk::PhysicalDeviceProperties2::default().push_next(&mut v11).push_next(&mut v12).push_next(&mut v13);
    let mut f12 = vk::PhysicalDeviceVulkan12Features::default();
    let mut f13 = vk::PhysicalDeviceVulkan13Features::default();
    let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut f12).push_next(&mut f13);
    // SAFETY: plain queries of a live instance; structures for 1.2 and 1.3 are ignored by older drivers.
    let (memory, extensions, families) = unsafe {
        instance.get_physical_device_properties2(p, &mut properties);
        instance.get_physical_device_features2(p, &mut features);
        (
            instance.get_physical_device_memory_properties(p),
            instance.enumerate_device_extension_properties(p).named("listing device extensions")?,
            instance.get_physical_device_queue_family_properties(p),
        )
    };
    let core = properties.properties;
    let has = |name: &CStr| extensions.iter().any(|e| e.extension_name_as_c_str().is_ok_and(|n| n == name));
    let mut lacks = vec![];
    let mut need = |ok: bool, what: &str| {
        if !ok {
            lacks.push(what.to_owned());
        }
    };
    need(core.api_version >= vk::API_VERSION_1_3, "Vulkan 1.3");
    need(has(ash::khr::push_descriptor::NAME), "push descriptors (VK_KHR_push_descriptor)");
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
    need((4..=128).contains(&v11.subgroup_size), "a subgroup size between 4 and 128");
    need(core.limits.max_compute_shared_memory_size >= 32 << 10, "32 KiB of shared memory");
    need(core.limits.max_push_constants_size >= 128, "128 bytes of push constants");
    need(core.limits.max_compute_work_group_invocations >= 256, "workgroups of 256 threads");
    need(families.iter().any(|f| f.queue_flags.contains(vk::QueueFlags::COMPUTE)), "a compute queue");
    let kind = match core.device_type {
        vk::PhysicalDeviceType::DISCRETE_GPU => "discrete",
        vk::PhysicalDeviceType::INTEGRATED_GPU => "integrated",
        vk::PhysicalDeviceType::VIRTUAL_GPU => "virtual",
        vk::PhysicalDeviceType::CPU => "cpu",
        _ => "other",
    };
    let heaps = &memory.memory_heaps[..memory.memory_heap_count as usize];
    let local = heaps.iter().filter(|h| h.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL)).map(|h| h.size).max();
    let version = core.api_version;
    // One binding is a whole buffer, and a buffer one allocation at most. A driver before 1.3 leaves the last limit at 0.
    let limits = [u64::from(core.limits.max_storage_buffer_range), v11.max_memory_allocation_size, v13.max_buffer_size];
    Ok(DeviceInfo {
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
        subgroup_size: v11.subgroup_size,
        max_binding_bytes: limits.into_iter().filter(|&bytes| bytes > 0).min().unwrap_or(0),
        heap_bytes: local.unwrap_or(0),
        shared_bytes: core.limits.max_compute_shared_memory_size,
        max_groups: core.limits.max_compute_work_group_count[0],
        timestamp_period: if core.limits.timestamp_compute_and_graphics != 0 {
            core.limits.timestamp_period
        } else {
            0.0
        },
        lacks,
    })
}

fn choose(
    devices: Vec<(vk::PhysicalDevice, DeviceInfo)>,
    wanted: Option<&str>,
) -> Result<(vk::PhysicalDevice, DeviceInfo), Error> {
    if devices.is_empty() {
        return Err(Error::NoDevice);
    }
    let listed = devices.iter().map(|(_, d)| format!("{}: {}", d.index, d.name)).collect::<Vec<_>>().join(", ");
    let matches = |d: &DeviceInfo| match wanted {
        None => d.lacks.is_empty(),
        Some(text) => match text.parse::<usize>() {
            Ok(index) => d.index == index,
            Err(_) => d.name.to_lowercase().contains(&text.to_lowercase()),
        },
    };
    let all = devices.len();
    let mut devices = devices.into_iter();
    match (devices.find(|(_, d)| matches(d)), wanted) {
        (Some(found), _) => match found.1.lacks.first() {
            None => Ok(found),
            Some(feature) => Err(Error::Missing { device: found.1.name.clone(), feature: feature.clone() }),
        },
        (None, Some(text)) => Err(Error::UnknownDevice { wanted: text.to_owned(), listed }),
        (None, None) => Err(Error::Missing {
            device: format!("each of the {all} devices here ({listed})"),
            feature: "a needed feature (`gscream-vk devices` names it)".into(),
        }),
    }
}

/// All devices of this machine and what each lacks.
///
/// # Errors
/// Without a loader, or when it cannot list devices.
pub fn devices() -> Result<Vec<DeviceInfo>, Error> {
    let instance = open_instance(false)?;
    let found = list(&instance.raw);
    // SAFETY: nothing made from the instance is alive.
    unsafe { instance.raw.destroy_instance(None) };
    Ok(found?.into_iter().map(|(_, info)| info).collect())
}

/// The device that [`Gpu::open`] opens for this `wanted`, without opening it.
///
/// # Errors
/// As [`Gpu::open`].
pub fn chosen(wanted: Option<&str>) -> Result<DeviceInfo, Error> {
    let instance = open_instance(false)?;
    let found = list(&instance.raw).and_then(|devices| choose(devices, wanted));
    // SAFETY: nothing made from the instance is alive.
    unsafe { instance.raw.destroy_instance(None) };
    Ok(found?.1)
}

impl Gpu {
    /// Opens a device.
    ///
    /// # Errors
    /// One sentence naming what is missing: the loader, a device, a feature, the validation layer.
    pub fn open(options: &Options) -> Result<Self, Error> {
        let Instance { entry, raw: instance, messages, debug_utils } = open_instance(options.validate)?;
        let (physical, mut info) = choose(list(&instance)?, options.device.as_deref())?;
        if let Some(size) = options.subgroup_size {
            let [least, most] = subgroup_sizes(&instance, physical);
            if !(least..=most).contains(&size) || !size.is_power_of_two() {
                let feature = format!("subgroups of {size} threads (it has {least} to {most})");
                return Err(Error::Missing { device: info.name, feature });
            }
            info.subgroup_size = size;
        }
        let messenger = if options.validate {
            let utils = ash::ext::debug_utils::Instance::new(&entry, &instance);
            let severity =
                vk::DebugUtilsMessageSeverityFlagsEXT::ERROR | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING;
            let create = vk::DebugUtilsMessengerCreateInfoEXT::default()
                .message_severity(severity)
                .message_type(vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION)
                .pfn_user_callback(Some(on_message))
                .user_data(Arc::as_ptr(&messages).cast_mut().cast());
            // SAFETY: the list lives as long as the instance: both are fields of `Inner`.
            let raw = unsafe { utils.create_debug_utils_messenger(&create, None) }.named("creating a messenger")?;
            Some((utils, raw))
        } else {
            None
        };
        // SAFETY: a plain query of a live instance.
        let extensions = unsafe { instance.enumerate_device_extension_properties(physical) };
        let extensions = extensions.named("listing device extensions")?;
        let has = |name: &CStr| extensions.iter().any(|e| e.extension_name_as_c_str().is_ok_and(|n| n == name));
        let memory_budget = has(ash::ext::memory_budget::NAME);
        let executables = options.statistics && has(ash::khr::pipeline_executable_properties::NAME);
        // SAFETY: the instance and physical device are live; names and features were checked by `describe`.
        let (device, queue, command_pool) = unsafe {
            let families = instance.get_physical_device_queue_family_properties(physical);
            let family = families
                .iter()
                .position(|f| f.queue_flags.contains(vk::QueueFlags::COMPUTE))
                .expect("describe() refuses devices without a compute queue") as u32;
            let priorities = [1.0];
            let queues =
                [vk::DeviceQueueCreateInfo::default().queue_family_index(family).queue_priorities(&priorities)];
            let mut extensions = vec![ash::khr::push_descriptor::NAME.as_ptr()];
            let mut statistics =
                vk::PhysicalDevicePipelineExecutablePropertiesFeaturesKHR::default().pipeline_executable_info(true);
            let mut f12 = vk::PhysicalDeviceVulkan12Features::default().scalar_block_layout(true);
            let mut f13 = vk::PhysicalDeviceVulkan13Features::default()
                .synchronization2(true)
                .maintenance4(true)
                .subgroup_size_control(true)
                .compute_full_subgroups(true);
            if executables {
                extensions.push(ash::khr::pipeline_executable_properties::NAME.as_ptr());
            }
            let mut create = vk::DeviceCreateInfo::default()
                .queue_create_infos(&queues)
                .enabled_extension_names(&extensions)
                .push_next(&mut f12)
                .push_next(&mut f13);
            if executables {
                create = create.push_next(&mut statistics);
            }
            let device = instance.create_device(physical, &create, None).named("opening the device")?;
            let pool = vk::CommandPoolCreateInfo::default()
                .queue_family_index(family)
                .flags(vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER);
            let command_pool = device.create_command_pool(&pool, None).named("creating a command pool")?;
            let queue = device.get_device_queue(family, 0);
            (device, queue, command_pool)
        };
        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: instance.clone(),
            device: device.clone(),
            physical_device: physical,
            debug_settings: gpu_allocator::AllocatorDebugSettings::default(),
            buffer_device_address: false,
            allocation_sizes: gpu_allocator::AllocationSizes::new(DEVICE_BLOCK, HOST_BLOCK),
        })
        .map_err(|source| Error::OutOfMemory {
            name: "allocator",
            bytes: 0,
            device: info.name.clone(),
            source,
        })?;
        let stored = options.cache.as_deref().and_then(|path| std::fs::read(path).ok()).unwrap_or_default();
        let cache_info = vk::PipelineCacheCreateInfo::default().initial_data(&stored);
        // SAFETY: the driver checks the header of stored data and ignores another device's.
        let cache = unsafe { device.create_pipeline_cache(&cache_info, None) }.named("creating a pipeline cache")?;
        let inner = Inner {
            push_descriptor: ash::khr::push_descriptor::Device::new(&instance, &device),
            executables: executables.then(|| ash::khr::pipeline_executable_properties::Device::new(&instance, &device)),
            debug: debug_utils.then(|| ash::ext::debug_utils::Device::new(&instance, &device)),
            queue,
            command_pool,
            info,
            options: options.clone(),
            contexts: Mutex::default(),
            ledger: Ledger::default(),
            in_flight: Mutex::new(0),
            trash: Mutex::default(),
            pipelines: Mutex::default(),
            cache,
            allocator: Mutex::new(Some(allocator)),
            messages,
            physical,
            memory_budget,
            messenger,
            device,
            instance,
            _entry: entry,
        };
        Ok(Self { inner: Arc::new(inner), rehearsal: None })
    }

    /// What the device is and can.
    pub fn info(&self) -> &DeviceInfo {
        &self.inner.info
    }

    /// How it was opened.
    pub fn options(&self) -> &Options {
        &self.inner.options
    }

    /// Messages of the validation layer since the last call.
    pub fn take_messages(&self) -> Vec<String> {
        std::mem::take(&mut *lock(&self.inner.messages))
    }

    /// Bytes that buffers of this process can still take on the device: what its driver says is free (memory budget), or
    /// the size of its largest heap where the driver does not say.
    pub fn available_bytes(&self) -> u64 {
        let Inner { instance, physical, info, memory_budget, .. } = &*self.inner;
        if !memory_budget {
            return info.heap_bytes;
        }
        let mut budget = vk::PhysicalDeviceMemoryBudgetPropertiesEXT::default();
        let mut memory = vk::PhysicalDeviceMemoryProperties2::default().push_next(&mut budget);
        // SAFETY: a plain query of a live instance; the extension was listed by the device.
        unsafe { instance.get_physical_device_memory_properties2(*physical, &mut memory) };
        let heaps = memory.memory_properties;
        let local = heaps.memory_heaps[..heaps.memory_heap_count as usize].iter().enumerate();
        let local = local.filter(|(_, h)| h.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL));
        let largest = local.max_by_key(|(_, h)| h.size).map(|(i, _)| i);
        largest.map_or(0, |i| budget.heap_budget[i].saturating_sub(budget.heap_usage[i]))
    }

    /// Names of the kernels of all pipelines made so far, each once; in a rehearsal, of those that a device would make.
    pub fn pipelines(&self) -> Vec<&'static str> {
        if let Some(rehearsal) = &self.rehearsal {
            return rehearsal.pipelines();
        }
        let mut names: Vec<_> = lock(&self.inner.pipelines).values().map(|p| p.name).collect();
        names.sort_unstable();
        names.dedup();
        names
    }

    pub(super) fn with_rehearsal(&self, rehearsal: Arc<Rehearsal>) -> Self {
        Self { inner: self.inner.clone(), rehearsal: Some(rehearsal) }
    }

    pub(super) fn rehearsing(&self) -> Option<&Arc<Rehearsal>> {
        self.rehearsal.as_ref()
    }

    pub(super) fn ledger(&self) -> &Ledger {
        self.rehearsal.as_ref().map_or(&self.inner.ledger, |r| &r.ledger)
    }

    /// Waits until the device has nothing left to do.
    ///
    /// # Errors
    /// When the device is lost.
    pub fn wait_idle(&self) -> Result<(), Error> {
        // SAFETY: the only queue is used from the recorder under the same lock discipline.
        unsafe { self.inner.device.device_wait_idle() }.named("waiting for the device")
    }

    /// Writes the pipeline cache to the file named at opening.
    pub fn save_cache(&self) {
        self.inner.save_cache();
    }

    pub(super) fn inner(&self) -> &Arc<Inner> {
        &self.inner
    }
}

/// Fewest and most threads that a subgroup may be asked to have.
fn subgroup_sizes(instance: &ash::Instance, physical: vk::PhysicalDevice) -> [u32; 2] {
    let mut v13 = vk::PhysicalDeviceVulkan13Properties::default();
    let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut v13);
    // SAFETY: a plain query of a live instance.
    unsafe { instance.get_physical_device_properties2(physical, &mut properties) };
    [v13.min_subgroup_size, v13.max_subgroup_size]
}

impl Inner {
    /// What is known of the pipelines made with statistics, in no order.
    pub(super) fn compiled(&self) -> Vec<Compiled> {
        lock(&self.pipelines).values().filter_map(|p| p.compiled.clone()).collect()
    }

    pub(super) fn allocate(
        &self,
        description: &AllocationCreateDesc<'_>,
    ) -> Result<Allocation, gpu_allocator::AllocationError> {
        let mut allocator = lock(&self.allocator);
        let allocator = allocator.as_mut().expect("the allocator lives until the device is dropped");
        let allocation = match allocator.allocate(description) {
            Err(gpu_allocator::AllocationError::OutOfMemory) => {
                return Err(gpu_allocator::AllocationError::OutOfMemory);
            }
            other => other?,
        };
        self.ledger.take(allocation.size());
        Ok(allocation)
    }

    /// Frees a buffer once nothing in flight can use it.
    pub(super) fn discard(&self, raw: vk::Buffer, allocation: Allocation) {
        lock(&self.trash).push((raw, allocation));
        if *lock(&self.in_flight) == 0 {
            self.empty_trash();
        }
    }

    pub(super) fn began(&self) {
        *lock(&self.in_flight) += 1;
    }

    pub(super) fn ended(&self) {
        let mut in_flight = lock(&self.in_flight);
        *in_flight -= 1;
        if *in_flight == 0 {
            self.empty_trash();
        }
    }

    fn empty_trash(&self) {
        let mut allocator = lock(&self.allocator);
        let Some(allocator) = allocator.as_mut() else { return };
        for (raw, allocation) in lock(&self.trash).drain(..) {
            self.ledger.give(allocation.size());
            // SAFETY: nothing in flight uses the buffer, and its owner is gone.
            unsafe { self.device.destroy_buffer(raw, None) };
            if let Err(error) = allocator.free(allocation) {
                log::error!("freeing device memory: {error}");
            }
        }
    }

    pub(super) fn name_object<T: vk::Handle>(&self, object: T, name: &str) {
        if let (Some(debug), Ok(name)) = (&self.debug, std::ffi::CString::new(name)) {
            let info = vk::DebugUtilsObjectNameInfoEXT::default().object_handle(object).object_name(&name);
            // SAFETY: a live object of this device. A name that cannot be set is no loss.
            let _ = unsafe { debug.set_debug_utils_object_name(&info) };
        }
    }

    /// The pipeline of a kernel with these constants, made at first use.
    pub(super) fn pipeline<K: Kernel>(&self, constants: &K::Constants) -> Result<Arc<Pipeline>, Error> {
        let key = (TypeId::of::<K>(), bytemuck::bytes_of(constants).to_vec());
        if let Some(found) = lock(&self.pipelines).get(&key) {
            return Ok(found.clone());
        }
        let refused = |result| Error::Pipeline { kernel: K::NAME, device: self.info.name.clone(), result };
        let bindings: Vec<_> = K::BINDINGS
            .iter()
            .map(|b| {
                vk::DescriptorSetLayoutBinding::default()
                    .binding(b.number)
                    .descriptor_count(1)
                    .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                    .stage_flags(vk::ShaderStageFlags::COMPUTE)
            })
            .collect();
        let push_size = size_of::<K::Push>() as u32;
        let ranges = [vk::PushConstantRange::default().stage_flags(vk::ShaderStageFlags::COMPUTE).size(push_size)];
        let entries: Vec<_> = K::CONSTANTS
            .iter()
            .enumerate()
            .map(|(i, &id)| vk::SpecializationMapEntry { constant_id: id, offset: 4 * i as u32, size: 4 })
            .collect();
        let specialization =
            vk::SpecializationInfo::default().map_entries(&entries).data(bytemuck::bytes_of(constants));
        let words = ash::util::read_spv(&mut std::io::Cursor::new(K::SPIRV)).expect("build.rs wrote whole words");
        // SAFETY: the SPIR-V comes from shaderc, the layout from its reflection; all handles are live.
        let pipeline = unsafe {
            let set_info = vk::DescriptorSetLayoutCreateInfo::default()
                .flags(vk::DescriptorSetLayoutCreateFlags::PUSH_DESCRIPTOR_KHR)
                .bindings(&bindings);
            let set = self.device.create_descriptor_set_layout(&set_info, None).map_err(refused)?;
            let sets = [set];
            let mut layout_info = vk::PipelineLayoutCreateInfo::default().set_layouts(&sets);
            if push_size > 0 {
                layout_info = layout_info.push_constant_ranges(&ranges);
            }
            let layout = self.device.create_pipeline_layout(&layout_info, None).map_err(refused)?;
            let module_info = vk::ShaderModuleCreateInfo::default().code(&words);
            let module = self.device.create_shader_module(&module_info, None).map_err(refused)?;
            let mut size = vk::PipelineShaderStageRequiredSubgroupSizeCreateInfo::default()
                .required_subgroup_size(self.info.subgroup_size);
            let mut stage = vk::PipelineShaderStageCreateInfo::default()
                .stage(vk::ShaderStageFlags::COMPUTE)
                .module(module)
                .name(c"main")
                .specialization_info(&specialization);
            if K::SUBGROUPS {
                stage = stage.flags(vk::PipelineShaderStageCreateFlags::REQUIRE_FULL_SUBGROUPS).push_next(&mut size);
            }
            let mut create = vk::ComputePipelineCreateInfo::default().layout(layout).stage(stage);
            if self.executables.is_some() {
                create = create.flags(vk::PipelineCreateFlags::CAPTURE_STATISTICS_KHR);
            }
            let began = std::time::Instant::now();
            let made = self.device.create_compute_pipelines(self.cache, &[create], None);
            let milliseconds = 1e3 * began.elapsed().as_secs_f64();
            self.device.destroy_shader_module(module, None);
            let raw = made.map_err(|(_, result)| refused(result))?[0];
            if raw == vk::Pipeline::null() {
                return Err(refused(vk::Result::ERROR_UNKNOWN));
            }
            let mut pipeline = Pipeline { name: K::NAME, raw, layout, set, compiled: None };
            if self.options.statistics {
                let said: Vec<Statistic> =
                    self.executables.as_ref().map_or_else(Vec::new, |e| statistics::of(e, &pipeline));
                let words = bytemuck::pod_collect_to_vec(bytemuck::bytes_of(constants));
                pipeline.compiled = Some(Compiled::new(K::NAME, words, milliseconds, said));
            }
            Arc::new(pipeline)
        };
        self.name_object(pipeline.raw, K::NAME);
        lock(&self.pipelines).insert(key, pipeline.clone());
        Ok(pipeline)
    }

    fn save_cache(&self) {
        let Some(path) = &self.options.cache else { return };
        // SAFETY: the cache is live.
        let Ok(data) = (unsafe { self.device.get_pipeline_cache_data(self.cache) }) else { return };
        let write = |path: &Path| -> std::io::Result<()> {
            use std::io::Write as _;
            if let Some(folder) = path.parent() {
                std::fs::create_dir_all(folder)?;
            }
            let mut file = atomic_write_file::AtomicWriteFile::open(path)?;
            file.write_all(&data)?;
            file.commit()
        };
        if let Err(error) = write(path) {
            log::warn!("{}: the pipeline cache could not be written: {error}", path.display());
        }
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        // SAFETY: the last owner is going; buffers and recorders hold an Arc, so none is left.
        unsafe {
            // Mesa's null device has no queue to wait for.
            if self.info.heap_bytes > 0 {
                let _ = self.device.device_wait_idle();
            }
            self.save_cache();
            self.empty_trash();
            for context in lock(&self.contexts).drain(..) {
                context.destroy(self);
            }
            self.empty_trash();
            for pipeline in lock(&self.pipelines).values() {
                self.device.destroy_pipeline(pipeline.raw, None);
                self.device.destroy_pipeline_layout(pipeline.layout, None);
                self.device.destroy_descriptor_set_layout(pipeline.set, None);
            }
            self.device.destroy_pipeline_cache(self.cache, None);
            self.device.destroy_command_pool(self.command_pool, None);
            drop(lock(&self.allocator).take());
            self.device.destroy_device(None);
            if let Some((utils, messenger)) = &self.messenger {
                utils.destroy_debug_utils_messenger(*messenger, None);
            }
            self.instance.destroy_instance(None);
        }
    }
}
