//! Opening a device; pipelines.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use ash::vk;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, Allocator, AllocatorCreateDesc};
use rayon::iter::{IntoParallelIterator as _, ParallelIterator as _};

use super::cache;
use super::context::Context;
use super::descriptors::Descriptors;
use super::error::{Error, Named};
use super::form::Form;
use super::instance::{Instance, has};
use super::kernel::{self, Interface};
use super::ledger::{Ledger, Rehearsal};
use super::physical::{self, DeviceInfo, Found, Subgroups};
use super::spares::{self, Spares};
use super::statistics::{self, Compiled, Statistic};
use super::witness::Case;

/// Bytes that are taken from the device at once for small buffers; larger buffers get memory of their own.
const DEVICE_BLOCK: u64 = 32 << 20;
const HOST_BLOCK: u64 = 16 << 20;
/// What the device gives beyond the buffers in use: the last block's rest, and as much in gaps.
pub const SPARE_BYTES: u64 = 2 * DEVICE_BLOCK + HOST_BLOCK;

/// How to open a device.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Options {
    /// Index in `devices`' list, or a part of the name; the first usable device otherwise.
    pub device: Option<String>,
    /// Switch on the Khronos validation layer with synchronisation validation.
    pub validate: bool,
    /// A barrier after every pass.
    pub serialize: bool,
    /// A barrier after every pass, and a marker that it ended: a lost device is said to be lost in a pass.
    pub trace_faults: bool,
    /// Leave out every barrier between passes although the schedule still lists it. For tests alone: such a recording
    /// shows that synchronisation validation would notice a lost barrier, and must never be submitted.
    #[doc(hidden)]
    pub omit_barriers: bool,
    /// Fill every new buffer with the words of a NaN that no arithmetic makes. For tests alone: a training that reads what
    /// nobody wrote then comes to something else.
    #[doc(hidden)]
    pub poison: bool,
    /// Keep so many dispatches of every kernel and set of constants, with all that they are given: [`Gpu::take_cases`].
    /// Passes then run one at a time. For tests alone.
    #[doc(hidden)]
    pub witness: usize,
    /// Timestamp queries around every pass.
    pub timestamps: bool,
    /// File of the pipeline cache; none is kept without it.
    pub cache: Option<PathBuf>,
    /// Keep what the driver's compiler says of each kernel ([`Gpu::compiled`]), and make kernels in rehearsals too.
    pub statistics: bool,
    /// How passes bind their buffers.
    pub descriptors: Descriptors,
    /// Threads of a subgroup in place of the driver's own choice, where the device can.
    pub subgroup_size: Option<u32>,
    /// Form of the work in place of the one made for the device's kind.
    pub form: Option<Form>,
    /// Bytes that one binding holds at most, where the device's own limit is higher. For tests alone.
    #[doc(hidden)]
    pub max_binding_bytes: Option<u64>,
}

impl Options {
    /// Whether no pass begins before the last has ended.
    pub(super) fn one_by_one(&self) -> bool {
        self.serialize || self.trace_faults || self.witness > 0
    }
}

/// An open device, or a rehearsal of one. Cheap to clone.
#[derive(Clone)]
pub struct Gpu {
    inner: Arc<Inner>,
    rehearsal: Option<Arc<Rehearsal>>,
}

/// A kernel with its constants: layouts at once, the pipeline when it is compiled.
pub(super) struct Pipeline {
    kernel: &'static Interface,
    constants: Vec<u8>,
    pub layout: vk::PipelineLayout,
    pub set: vk::DescriptorSetLayout,
    made: OnceLock<Made>,
    /// Held while the driver compiles: another thread that wants the same kernel waits for it.
    making: Mutex<()>,
}

struct Made {
    raw: vk::Pipeline,
    compiled: Option<Compiled>,
}

impl Pipeline {
    /// What was compiled.
    pub fn raw(&self) -> vk::Pipeline {
        self.made.get().expect("a pipeline is compiled before it is used").raw
    }
}

type PipelineKey = (&'static str, Vec<u8>);

pub(super) struct Inner {
    /// The only queue, which one thread at a time may use.
    pub queue: Mutex<vk::Queue>,
    /// Buffers are pushed; without it they are bound as sets.
    pub push_descriptor: Option<ash::khr::push_descriptor::Device>,
    executables: Option<ash::khr::pipeline_executable_properties::Device>,
    pub info: DeviceInfo,
    pub options: Options,
    pub contexts: Mutex<Vec<Context>>,
    /// Contexts of submissions that could not be waited for, and may run still.
    pub stuck: Mutex<Vec<Context>>,
    pub debug: Option<ash::ext::debug_utils::Device>,
    pub ledger: Ledger,
    /// Dispatches that were kept.
    pub cases: Mutex<Vec<Case>>,
    in_flight: Mutex<u32>,
    trash: Mutex<Vec<(vk::Buffer, Allocation, MemoryLocation)>>,
    spares: Mutex<Spares>,
    pipelines: Mutex<HashMap<PipelineKey, Arc<Pipeline>>>,
    allocator: Mutex<Option<Allocator>>,
    physical: vk::PhysicalDevice,
    memory_budget: bool,
    subgroups: Subgroups,
    keeps_nan: bool,
    // Fields are dropped in this order: the device before its instance.
    pub device: Device,
    instance: Instance,
}

/// Locks even when another thread panicked while holding it: the data are plain lists.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// All devices of this machine and what each lacks.
///
/// # Errors
/// Without a loader, or when it cannot list devices.
pub fn devices() -> Result<Vec<DeviceInfo>, Error> {
    let instance = Instance::open(false)?;
    Ok(physical::list(&instance.raw)?.into_iter().map(|found| found.info).collect())
}

/// The device that [`Gpu::open`] opens for this `wanted`, without opening it.
///
/// # Errors
/// As [`Gpu::open`].
pub fn chosen(wanted: Option<&str>) -> Result<DeviceInfo, Error> {
    let instance = Instance::open(false)?;
    Ok(physical::choose(physical::list(&instance.raw)?, wanted)?.info)
}

impl Gpu {
    /// Opens a device.
    ///
    /// # Errors
    /// One sentence naming what is missing: the loader, a device, a feature, the validation layer.
    pub fn open(options: &Options) -> Result<Self, Error> {
        let instance = Instance::open(options.validate)?;
        let found = physical::choose(physical::list(&instance.raw)?, options.device.as_deref())?;
        let mut info = found.info.clone();
        let missing = |feature| Error::Missing { device: found.info.name.clone(), feature };
        if let Some(size) = options.subgroup_size {
            info.subgroup_size = found.subgroups.wanted(size).map_err(missing)?;
            info.narrow_subgroup_size = info.subgroup_size;
        }
        if let Some(limit) = options.max_binding_bytes {
            info.max_binding_bytes = info.max_binding_bytes.min(limit);
        }
        let push = match options.descriptors {
            Descriptors::Auto => info.push_descriptors,
            Descriptors::Sets => false,
            Descriptors::Push if info.push_descriptors => true,
            Descriptors::Push => {
                return Err(missing("push descriptors, which --descriptors sets does without".into()));
            }
        };
        let wanted = Wanted {
            push,
            executables: options.statistics && has(&found.extensions, ash::khr::pipeline_executable_properties::NAME),
        };
        // Whatever fails from here on, what was made before it is taken down in the opposite order.
        let mut device = Device::open(&instance, &found, wanted)?;
        let stored = options.cache.as_deref().map(|path| cache::read(path, found.identity)).unwrap_or_default();
        let create = vk::PipelineCacheCreateInfo::default().initial_data(&stored);
        let empty = vk::PipelineCacheCreateInfo::default();
        // SAFETY: a live device. `cache::read` has compared the data's hash and the device, driver and version in their header:
        // they are what this driver wrote, unless somebody who can write the user's cache folder forged them with their hash.
        let made = unsafe { device.create_pipeline_cache(&create, None) };
        // SAFETY: a live device, no data.
        let made = made.or_else(|_| unsafe { device.create_pipeline_cache(&empty, None) });
        device.cache = made.named("creating a pipeline cache")?;
        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: instance.raw.clone(),
            device: device.raw.clone(),
            physical_device: found.raw,
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
        // SAFETY: `Device::open` asked for one queue of this family, so that index 0 is there.
        let queue = unsafe { device.get_device_queue(device.family, 0) };
        let inner = Inner {
            push_descriptor: push.then(|| ash::khr::push_descriptor::Device::new(&instance.raw, &device)),
            executables: wanted
                .executables
                .then(|| ash::khr::pipeline_executable_properties::Device::new(&instance.raw, &device)),
            debug: instance.debug_utils.then(|| ash::ext::debug_utils::Device::new(&instance.raw, &device)),
            queue: Mutex::new(queue),
            subgroups: found.subgroups,
            keeps_nan: found.keeps_nan,
            memory_budget: has(&found.extensions, ash::ext::memory_budget::NAME),
            physical: found.raw,
            info,
            options: options.clone(),
            contexts: Mutex::default(),
            stuck: Mutex::default(),
            ledger: Ledger::default(),
            cases: Mutex::default(),
            in_flight: Mutex::new(0),
            trash: Mutex::default(),
            spares: Mutex::default(),
            pipelines: Mutex::default(),
            allocator: Mutex::new(Some(allocator)),
            device,
            instance,
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
        std::mem::take(&mut *lock(&self.inner.instance.messages))
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
        // SAFETY: a plain query of a live instance; `memory_budget` says that the device lists the extension of the chained structure.
        unsafe { instance.raw.get_physical_device_memory_properties2(*physical, &mut memory) };
        free_bytes(&memory.memory_properties, &budget) + lock(&self.inner.spares).bytes()
    }

    /// Names of the kernels of all pipelines made so far, each once; in a rehearsal, of those that a device would make.
    pub fn pipelines(&self) -> Vec<&'static str> {
        if let Some(rehearsal) = &self.rehearsal {
            return rehearsal.pipelines();
        }
        let mut names: Vec<_> = lock(&self.inner.pipelines).values().map(|p| p.kernel.name).collect();
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
        let _queue = lock(&self.inner.queue);
        // SAFETY: the guard of the only queue is held, so that nobody else uses it meanwhile.
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

/// Whether another buffer can have the memory of one that goes: it belongs to no block.
fn is_spare(bytes: u64, location: MemoryLocation) -> bool {
    location == MemoryLocation::GpuOnly && bytes > DEVICE_BLOCK
}

fn free(allocator: &mut Allocator, allocation: Allocation) {
    if let Err(error) = allocator.free(allocation) {
        log::error!("freeing device memory: {error}");
    }
}

/// What is left of the largest heap on the device: its budget less what is in use already.
fn free_bytes(
    heaps: &vk::PhysicalDeviceMemoryProperties,
    budget: &vk::PhysicalDeviceMemoryBudgetPropertiesEXT<'_>,
) -> u64 {
    let local = heaps.memory_heaps[..heaps.memory_heap_count as usize].iter().enumerate();
    let local = local.filter(|(_, h)| h.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL));
    let largest = local.max_by_key(|(_, h)| h.size).map(|(i, _)| i);
    largest.map_or(0, |i| budget.heap_budget[i].saturating_sub(budget.heap_usage[i]))
}

/// What a device is opened with beyond what every device has.
#[derive(Clone, Copy)]
struct Wanted {
    push: bool,
    executables: bool,
}

/// A device of an instance, and its pipeline cache. Dropping it destroys both; whatever else was made from it is gone by
/// then.
pub(super) struct Device {
    raw: ash::Device,
    /// The family of its only queue.
    pub family: u32,
    cache: vk::PipelineCache,
}

impl Device {
    fn open(instance: &Instance, found: &Found, wanted: Wanted) -> Result<Self, Error> {
        let family = found.family.expect("a device without a compute queue is refused");
        let priorities = [1.0];
        let queues = [vk::DeviceQueueCreateInfo::default().queue_family_index(family).queue_priorities(&priorities)];
        let mut extensions = vec![];
        if wanted.push {
            extensions.push(ash::khr::push_descriptor::NAME.as_ptr());
        }
        // A device that lists this one must be asked for it.
        if has(&found.extensions, ash::khr::portability_subset::NAME) {
            extensions.push(ash::khr::portability_subset::NAME.as_ptr());
        }
        if wanted.executables {
            extensions.push(ash::khr::pipeline_executable_properties::NAME.as_ptr());
        }
        let mut statistics =
            vk::PhysicalDevicePipelineExecutablePropertiesFeaturesKHR::default().pipeline_executable_info(true);
        let mut f12 = vk::PhysicalDeviceVulkan12Features::default().scalar_block_layout(true);
        let mut f13 = vk::PhysicalDeviceVulkan13Features::default()
            .synchronization2(true)
            .maintenance4(true)
            .subgroup_size_control(true)
            .compute_full_subgroups(true);
        let mut create = vk::DeviceCreateInfo::default()
            .queue_create_infos(&queues)
            .enabled_extension_names(&extensions)
            .push_next(&mut f12)
            .push_next(&mut f13);
        if wanted.executables {
            create = create.push_next(&mut statistics);
        }
        // SAFETY: the instance and physical device are live. Every extension's name is one that the device lists, and
        // `physical::choose` refuses a device that lacks one of the features; all arrays outlive the call.
        let raw = unsafe { instance.raw.create_device(found.raw, &create, None) }.named("opening the device")?;
        Ok(Self { raw, family, cache: vk::PipelineCache::null() })
    }
}

impl std::ops::Deref for Device {
    type Target = ash::Device;
    fn deref(&self) -> &ash::Device {
        &self.raw
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        // SAFETY: whatever else was made from the device is destroyed in `Inner::drop`, which runs before its fields drop.
        unsafe {
            self.raw.destroy_pipeline_cache(self.cache, None);
            self.raw.destroy_device(None);
        }
    }
}

impl Inner {
    /// What is known of the pipelines made with statistics, in no order.
    pub(super) fn compiled(&self) -> Vec<Compiled> {
        lock(&self.pipelines).values().filter_map(|p| p.made.get()?.compiled.clone()).collect()
    }

    pub(super) fn allocate(
        &self,
        description: &AllocationCreateDesc<'_>,
    ) -> Result<Allocation, gpu_allocator::AllocationError> {
        let mut allocator = lock(&self.allocator);
        let allocator = allocator.as_mut().expect("the allocator lives until the device is dropped");
        let mut spares = lock(&self.spares);
        let bytes = description.requirements.size;
        let spare = if is_spare(bytes, description.location) { spares.take(bytes) } else { None };
        let allocation = match spare {
            Some(spare) => spare,
            None => {
                // What nobody uses is no reason for more memory than there ever was.
                let (now, peak) = self.ledger.memory();
                spares.beyond(peak.saturating_sub(now + bytes)).into_iter().for_each(|spare| free(allocator, spare));
                match allocator.allocate(description) {
                    Err(_) if spares.bytes() > 0 => {
                        spares.beyond(0).into_iter().for_each(|spare| free(allocator, spare));
                        allocator.allocate(description)
                    }
                    other => other,
                }?
            }
        };
        self.ledger.take(allocation.size());
        Ok(allocation)
    }

    /// Bytes that the memory of a buffer has that needs so many.
    pub(super) fn memory_size(&self, bytes: u64, location: MemoryLocation) -> u64 {
        match location {
            MemoryLocation::GpuOnly => spares::size(bytes, DEVICE_BLOCK, self.info.max_binding_bytes),
            _ => bytes,
        }
    }

    /// Frees a buffer once nothing in flight can use it.
    pub(super) fn discard(&self, raw: vk::Buffer, allocation: Allocation, location: MemoryLocation) {
        lock(&self.trash).push((raw, allocation, location));
        // Held until the trash is empty: a recording that began meanwhile could use a buffer and discard it, and that one
        // would be freed with the others.
        let in_flight = lock(&self.in_flight);
        if *in_flight == 0 {
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

    /// Frees what was discarded. The caller holds `in_flight` at zero, or is the device's last owner.
    fn empty_trash(&self) {
        let mut allocator = lock(&self.allocator);
        let Some(allocator) = allocator.as_mut() else { return };
        for (raw, allocation, location) in lock(&self.trash).drain(..) {
            self.ledger.give(allocation.size());
            // SAFETY: its owner discarded the buffer, nothing is in flight, and nothing begins while the caller holds the count.
            unsafe { self.device.destroy_buffer(raw, None) };
            if is_spare(allocation.size(), location) {
                lock(&self.spares).keep(allocation);
            } else {
                free(allocator, allocation);
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

    /// The pipeline of a kernel with these constants, its layouts made at first use. It is compiled by
    /// [`Inner::compile`].
    pub(super) fn pipeline(&self, kernel: &'static Interface, constants: &[u8]) -> Result<Arc<Pipeline>, Error> {
        let key = (kernel.name, constants.to_vec());
        let mut pipelines = lock(&self.pipelines);
        if let Some(found) = pipelines.get(&key) {
            return Ok(found.clone());
        }
        let mut pipeline = Pipeline {
            kernel,
            constants: constants.to_vec(),
            layout: vk::PipelineLayout::null(),
            set: vk::DescriptorSetLayout::null(),
            made: OnceLock::new(),
            making: Mutex::new(()),
        };
        if let Err(result) = self.lay_out(&mut pipeline) {
            self.destroy(&pipeline);
            return Err(self.refused(kernel, result));
        }
        let pipeline = Arc::new(pipeline);
        pipelines.insert(key, pipeline.clone());
        Ok(pipeline)
    }

    fn refused(&self, kernel: &Interface, result: vk::Result) -> Error {
        Error::Pipeline { kernel: kernel.name, device: self.info.name.clone(), result }
    }

    fn lay_out(&self, pipeline: &mut Pipeline) -> Result<(), vk::Result> {
        let kernel = pipeline.kernel;
        let bindings: Vec<_> = kernel
            .bindings
            .iter()
            .map(|b| {
                vk::DescriptorSetLayoutBinding::default()
                    .binding(b.number)
                    .descriptor_count(1)
                    .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                    .stage_flags(vk::ShaderStageFlags::COMPUTE)
            })
            .collect();
        let set_flags = match self.push_descriptor {
            Some(_) => vk::DescriptorSetLayoutCreateFlags::PUSH_DESCRIPTOR_KHR,
            None => vk::DescriptorSetLayoutCreateFlags::empty(),
        };
        let size = kernel.push_bytes;
        let ranges = [vk::PushConstantRange::default().stage_flags(vk::ShaderStageFlags::COMPUTE).size(size)];
        // SAFETY: the bindings are those of the kernel's reflection; the device is live.
        unsafe {
            let set_info = vk::DescriptorSetLayoutCreateInfo::default().flags(set_flags).bindings(&bindings);
            pipeline.set = self.device.create_descriptor_set_layout(&set_info, None)?;
            let sets = [pipeline.set];
            let mut layout_info = vk::PipelineLayoutCreateInfo::default().set_layouts(&sets);
            if size > 0 {
                layout_info = layout_info.push_constant_ranges(&ranges);
            }
            pipeline.layout = self.device.create_pipeline_layout(&layout_info, None)?;
        }
        Ok(())
    }

    /// Compiles these pipelines as far as they are not, on several threads.
    pub(super) fn compile_all<'p>(&self, pipelines: impl Iterator<Item = &'p Arc<Pipeline>>) -> Result<(), Error> {
        let mut missing: Vec<&Arc<Pipeline>> = pipelines.filter(|p| p.made.get().is_none()).collect();
        missing.sort_by_key(|p| Arc::as_ptr(p));
        missing.dedup_by_key(|p| Arc::as_ptr(p));
        missing.into_par_iter().try_for_each(|pipeline| self.compile(pipeline))
    }

    /// Compiles a pipeline, once.
    pub(super) fn compile(&self, pipeline: &Pipeline) -> Result<(), Error> {
        if pipeline.made.get().is_some() {
            return Ok(());
        }
        let _making = lock(&pipeline.making);
        if pipeline.made.get().is_some() {
            return Ok(());
        }
        let made = self.make(pipeline).map_err(|result| self.refused(pipeline.kernel, result))?;
        self.name_object(made.raw, pipeline.kernel.name);
        let first = pipeline.made.set(made).is_ok();
        assert!(first, "one thread at a time makes a pipeline");
        Ok(())
    }

    /// Threads of this kernel's subgroups.
    pub fn subgroup_size(&self, kernel: &Interface) -> u32 {
        if kernel.narrow { self.info.narrow_subgroup_size } else { self.info.subgroup_size }
    }

    fn make(&self, pipeline: &Pipeline) -> Result<Made, vk::Result> {
        let Pipeline { kernel, constants, layout, .. } = pipeline;
        let entries: Vec<_> = kernel
            .constants
            .iter()
            .enumerate()
            .map(|(i, &(id, _))| vk::SpecializationMapEntry { constant_id: id, offset: 4 * i as u32, size: 4 })
            .collect();
        let specialization = vk::SpecializationInfo::default().map_entries(&entries).data(constants);
        let mut words =
            ash::util::read_spv(&mut std::io::Cursor::new(kernel.spirv)).expect("build.rs wrote whole words");
        // From SPIR-V 1.6 on a subgroup's size may vary from the driver's own without being allowed to.
        assert!(words[1] < 0x1_0600, "{}: a kernel knows its subgroups' size", kernel.name);
        if self.keeps_nan {
            kernel::keep_nan(&mut words);
        }
        // SAFETY: the SPIR-V comes from shaderc and the layout, the push constants' size and the constants' ids from its
        // reflection, so that they agree; `constants` has 4 bytes for each id. The module goes after the pipeline is made, and
        // what was made before a failure the caller destroys.
        unsafe {
            let module_info = vk::ShaderModuleCreateInfo::default().code(&words);
            let module = self.device.create_shader_module(&module_info, None)?;
            let threads = self.subgroup_size(kernel);
            let mut size =
                vk::PipelineShaderStageRequiredSubgroupSizeCreateInfo::default().required_subgroup_size(threads);
            let mut stage = vk::PipelineShaderStageCreateInfo::default()
                .stage(vk::ShaderStageFlags::COMPUTE)
                .module(module)
                .name(c"main")
                .specialization_info(&specialization);
            if kernel.subgroups {
                stage = stage.flags(vk::PipelineShaderStageCreateFlags::REQUIRE_FULL_SUBGROUPS);
            }
            if self.subgroups.asks(kernel, threads) {
                stage = stage.push_next(&mut size);
            }
            let mut create = vk::ComputePipelineCreateInfo::default().layout(*layout).stage(stage);
            if self.executables.is_some() {
                create = create.flags(vk::PipelineCreateFlags::CAPTURE_STATISTICS_KHR);
            }
            let began = std::time::Instant::now();
            let made = self.device.create_compute_pipelines(self.device.cache, &[create], None);
            let milliseconds = 1e3 * began.elapsed().as_secs_f64();
            self.device.destroy_shader_module(module, None);
            let raw = made.map_err(|(_, result)| result)?[0];
            if raw == vk::Pipeline::null() {
                return Err(vk::Result::ERROR_UNKNOWN);
            }
            let compiled = self.options.statistics.then(|| {
                let said: Vec<Statistic> = self.executables.as_ref().map_or_else(Vec::new, |e| statistics::of(e, raw));
                Compiled::new(kernel.name, bytemuck::pod_collect_to_vec(constants), milliseconds, said)
            });
            Ok(Made { raw, compiled })
        }
    }

    fn destroy(&self, pipeline: &Pipeline) {
        // SAFETY: the caller has either just failed to make it or is the device's last owner after a wait for the device. What was
        // never made is null, which is nothing to destroy.
        unsafe {
            self.device.destroy_pipeline(pipeline.made.get().map_or(vk::Pipeline::null(), |made| made.raw), None);
            self.device.destroy_pipeline_layout(pipeline.layout, None);
            self.device.destroy_descriptor_set_layout(pipeline.set, None);
        }
    }

    fn save_cache(&self) {
        let Some(path) = &self.options.cache else { return };
        // SAFETY: the cache lives as long as the device, and the driver synchronises its own reads of it.
        let Ok(data) = (unsafe { self.device.get_pipeline_cache_data(self.device.cache) }) else { return };
        if let Err(error) = cache::write(path, &data) {
            log::warn!("{}: the pipeline cache could not be written: {error}", path.display());
        }
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        // SAFETY: the last owner is going: buffers, recorders and submissions hold an Arc, so none is left, and nothing runs after
        // the wait. The device and then the instance follow as fields.
        unsafe {
            // Mesa's null device has no queue to wait for.
            if self.info.heap_bytes > 0 {
                let _ = self.device.device_wait_idle();
            }
            self.save_cache();
            self.empty_trash();
            for context in lock(&self.contexts).drain(..).chain(lock(&self.stuck).drain(..)) {
                context.destroy(self);
            }
        }
        self.empty_trash();
        for pipeline in lock(&self.pipelines).values() {
            self.destroy(pipeline);
        }
        if let Some(mut allocator) = lock(&self.allocator).take() {
            lock(&self.spares).beyond(0).into_iter().for_each(|spare| free(&mut allocator, spare));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{TryLockError, mpsc};
    use std::time::{Duration, Instant};

    use super::*;
    use crate::gpu::kernels::primitives::{dispatch, limit};
    use crate::gpu::{Kernel as _, testing};

    /// While the driver compiles one kernel, another can be compiled, and whatever is compiled can be had.
    #[test]
    fn compiling_keeps_nobody_waiting_who_wants_another_kernel() {
        let gpu = testing::fresh_gpu(Options::default());
        let slow = gpu.inner().pipeline(&limit::Kernel::VARIANTS[0], &[]).expect("layouts");
        let making = lock(&slow.making);
        let (done, is_done) = mpsc::channel();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let inner = gpu.inner();
                let other = inner.pipeline(&dispatch::Kernel::VARIANTS[0], &[]).expect("layouts");
                let again = inner.pipeline(&limit::Kernel::VARIANTS[0], &[]).expect("layouts");
                inner.compile_all([&other, &other].into_iter()).expect("it compiles");
                done.send((other.made.get().is_some(), Arc::ptr_eq(&again, &slow))).expect("somebody waits");
            });
            let others = is_done.recv_timeout(Duration::from_secs(60));
            drop(making);
            assert_eq!(others, Ok((true, true)));
        });
        assert!(slow.made.get().is_none());
        gpu.inner().compile(&slow).expect("it compiles");
        assert_eq!(gpu.pipelines(), [dispatch::Kernel::NAME, limit::Kernel::NAME]);
    }

    /// Of the device's own heaps the largest counts, and what others have taken of it is gone.
    #[test]
    fn what_is_in_use_is_not_free() {
        let mut heaps = vk::PhysicalDeviceMemoryProperties { memory_heap_count: 3, ..Default::default() };
        let local = vk::MemoryHeapFlags::DEVICE_LOCAL;
        heaps.memory_heaps[0] = vk::MemoryHeap { size: 64 << 30, flags: vk::MemoryHeapFlags::empty() };
        heaps.memory_heaps[1] = vk::MemoryHeap { size: 1 << 28, flags: local };
        heaps.memory_heaps[2] = vk::MemoryHeap { size: 8 << 30, flags: local };
        let mut budget = vk::PhysicalDeviceMemoryBudgetPropertiesEXT::default();
        budget.heap_budget[..3].copy_from_slice(&[60 << 30, 1 << 28, 7 << 30]);
        budget.heap_usage[..3].copy_from_slice(&[1 << 30, 1 << 20, 5 << 30]);
        assert_eq!(free_bytes(&heaps, &budget), 2 << 30);
        budget.heap_usage[2] = 9 << 30;
        assert_eq!(free_bytes(&heaps, &budget), 0, "taken beyond the budget");
    }

    /// A recording that begins between the look at the count and the freeing could use a buffer and discard it, and it
    /// would be freed in flight. Freeing waits for the allocator, which is taken here.
    #[test]
    fn no_recording_begins_while_buffers_are_freed() {
        let gpu = testing::gpu();
        let buffer = gpu.upload("words", &[1u32, 2, 3]).expect("room");
        let inner = gpu.inner();
        let allocator = lock(&inner.allocator);
        std::thread::scope(|scope| {
            scope.spawn(|| drop(buffer));
            let began = Instant::now();
            // Many looks in a row: a look at the count alone holds it for an instant.
            let mut held = 0;
            while held < 20 && began.elapsed() < Duration::from_secs(20) {
                held = match inner.in_flight.try_lock() {
                    Err(TryLockError::WouldBlock) => held + 1,
                    _ => 0,
                };
                std::thread::sleep(Duration::from_millis(1));
            }
            drop(allocator);
            assert_eq!(held, 20, "a recording could begin while a buffer was being freed");
        });
        assert_eq!(gpu.read(&gpu.upload("words", &[4u32]).expect("room")).expect("readable"), [4]);
    }
}
