//! A driver that fails, as a Vulkan layer between the program and whatever follows: one call of a name is answered with an
//! error. `tests/driver.rs` compiles it; it needs no rights.
//!
//! - `FAULT_CALL`: name of the call that fails; none without it.
//! - `FAULT_AT`: which of the calls of that name, counted from 1.
//! - `FAULT_RESULT`: the answer, a `VkResult`. A device that is lost stays lost; whatever else is the matter passes, unless
//!   `FAULT_EVER` is set.
//! - `FAULT_TRACE`: a file that gets a line for each call that can fail, and for each label of a pass.
//! - `FAULT_ALONE`: set where every buffer is to get memory of its own.

use std::ffi::{CStr, c_char, c_void};
use std::fs::File;
use std::io::Write as _;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

type Function = *const c_void;
type Find = extern "C" fn(usize, *const c_char) -> Function;
/// Of every call: handles, pointers and sizes, at most eight. What a call has not is passed on unread.
type Call = extern "C" fn(usize, usize, usize, usize, usize, usize, usize, usize) -> i32;

const LOST: i32 = -4;
/// `VkStructureType` of what the loader puts behind a `VkInstanceCreateInfo` and a `VkDeviceCreateInfo`.
const LOADER_INSTANCE: i32 = 47;
const LOADER_DEVICE: i32 = 48;
/// More than the program takes at once for buffers that share memory.
const ALONE_BYTES: u64 = 33 << 20;

/// `VkLayerInstanceCreateInfo` and `VkLayerDeviceCreateInfo`.
#[repr(C)]
struct Chained {
    kind: i32,
    next: *mut Chained,
    function: i32,
    link: *mut Link,
}

/// `VkLayerInstanceLink` and `VkLayerDeviceLink`.
#[repr(C)]
struct Link {
    next: *mut Link,
    of_instance: Find,
    of_device: Find,
}

struct Fault {
    call: String,
    at: usize,
    result: i32,
    ever: bool,
    alone: bool,
    trace: Option<File>,
}

static FAULT: OnceLock<Fault> = OnceLock::new();
static CALLS: AtomicUsize = AtomicUsize::new(0);
static IS_LOST: AtomicBool = AtomicBool::new(false);
static OF_INSTANCE: AtomicUsize = AtomicUsize::new(0);
static OF_DEVICE: AtomicUsize = AtomicUsize::new(0);

fn fault() -> &'static Fault {
    FAULT.get_or_init(|| {
        let text = |name| std::env::var(name).unwrap_or_default();
        let append = |path: std::ffi::OsString| File::options().append(true).create(true).open(path).expect("writable");
        Fault {
            call: text("FAULT_CALL"),
            at: text("FAULT_AT").parse().unwrap_or(1),
            result: text("FAULT_RESULT").parse().unwrap_or(-1),
            ever: !text("FAULT_EVER").is_empty(),
            alone: !text("FAULT_ALONE").is_empty(),
            trace: std::env::var_os("FAULT_TRACE").map(append),
        }
    })
}

fn trace(name: &str) {
    if let Some(mut file) = fault().trace.as_ref() {
        file.write_all(format!("{name}\n").as_bytes()).expect("writable");
    }
}

/// The error with which this call is answered, if it fails.
fn refused(name: &str) -> Option<i32> {
    trace(name);
    let fault = fault();
    if IS_LOST.load(Ordering::SeqCst) && matches!(name, "vkQueueSubmit2" | "vkWaitForFences" | "vkDeviceWaitIdle") {
        return Some(LOST);
    }
    if fault.call != name {
        return None;
    }
    let call = CALLS.fetch_add(1, Ordering::SeqCst) + 1;
    let fails = call == fault.at || fault.ever && call > fault.at;
    if fails && fault.result == LOST {
        IS_LOST.store(true, Ordering::SeqCst);
    }
    fails.then_some(fault.result)
}

/// Whether a call that fails is one after which nothing is in flight, or a recording is over, all the same.
fn is_over(name: &str, result: i32) -> bool {
    name == "vkEndCommandBuffer" || result == LOST && matches!(name, "vkWaitForFences" | "vkDeviceWaitIdle")
}

fn function(find: &AtomicUsize, of: usize, name: &CStr) -> Function {
    let find = find.load(Ordering::SeqCst);
    unsafe { std::mem::transmute::<usize, Find>(find)(of, name.as_ptr()) }
}

fn call(function: usize) -> Call {
    unsafe { std::mem::transmute::<usize, Call>(function) }
}

/// Calls that can fail: each asks [`refused`] before the next layer.
macro_rules! calls {
    ($($name:ident)*) => {
        $(#[allow(non_snake_case)]
        mod $name {
            pub static NEXT: super::AtomicUsize = super::AtomicUsize::new(0);
            pub extern "C" fn call(
                a: usize, b: usize, c: usize, d: usize, e: usize, f: usize, g: usize, h: usize,
            ) -> i32 {
                let next = || super::call(NEXT.load(super::Ordering::SeqCst))(a, b, c, d, e, f, g, h);
                let Some(result) = super::refused(stringify!($name)) else { return next() };
                if super::is_over(stringify!($name), result) {
                    next();
                }
                result
            }
        })*

        /// The next layer's function, or ours before it.
        fn before(name: &CStr, next: Function) -> Function {
            if next.is_null() {
                return next;
            }
            match name.to_str().unwrap_or_default() {
                $(stringify!($name) => {
                    $name::NEXT.store(next as usize, Ordering::SeqCst);
                    $name::call as *const () as Function
                })*
                "vkCmdBeginDebugUtilsLabelEXT" => {
                    LABEL.store(next as usize, Ordering::SeqCst);
                    label as *const () as Function
                }
                "vkGetBufferMemoryRequirements" => {
                    REQUIREMENTS.store(next as usize, Ordering::SeqCst);
                    requirements as *const () as Function
                }
                _ => next,
            }
        }
    };
}

// All of Vulkan 1.3 but for pictures and windows; that the last two were called is of interest alone.
calls! {
    vkEnumeratePhysicalDevices vkEnumerateDeviceExtensionProperties vkEnumerateDeviceLayerProperties
    vkQueueSubmit vkQueueSubmit2 vkQueueWaitIdle vkQueueBindSparse vkDeviceWaitIdle
    vkAllocateMemory vkMapMemory vkFlushMappedMemoryRanges vkInvalidateMappedMemoryRanges
    vkCreateBuffer vkCreateBufferView vkBindBufferMemory vkBindBufferMemory2
    vkCreateFence vkResetFences vkGetFenceStatus vkWaitForFences
    vkCreateSemaphore vkGetSemaphoreCounterValue vkWaitSemaphores vkSignalSemaphore
    vkCreateEvent vkGetEventStatus vkSetEvent vkResetEvent vkCreateQueryPool vkGetQueryPoolResults
    vkCreateShaderModule vkCreatePipelineCache vkGetPipelineCacheData vkMergePipelineCaches
    vkCreateComputePipelines vkCreatePipelineLayout
    vkCreateDescriptorSetLayout vkCreateDescriptorPool vkResetDescriptorPool vkAllocateDescriptorSets
    vkFreeDescriptorSets vkCreateDescriptorUpdateTemplate
    vkCreateCommandPool vkResetCommandPool vkAllocateCommandBuffers
    vkBeginCommandBuffer vkEndCommandBuffer vkResetCommandBuffer
    vkGetPhysicalDeviceToolProperties vkCreatePrivateDataSlot vkSetPrivateData
    vkCreateDebugUtilsMessengerEXT vkSetDebugUtilsObjectNameEXT vkSetDebugUtilsObjectTagEXT
    vkGetPipelineExecutablePropertiesKHR vkGetPipelineExecutableStatisticsKHR
    vkGetPhysicalDeviceCalibrateableTimeDomainsEXT vkGetCalibratedTimestampsEXT
    vkDestroyDevice vkDestroyInstance
}

static LABEL: AtomicUsize = AtomicUsize::new(0);

/// `vkCmdBeginDebugUtilsLabelEXT`: the name stands behind type and chain.
extern "C" fn label(commands: usize, label: *const [*const c_char; 3]) {
    trace(&unsafe { CStr::from_ptr((*label)[2]) }.to_string_lossy());
    call(LABEL.load(Ordering::SeqCst))(commands, label as usize, 0, 0, 0, 0, 0, 0);
}

static REQUIREMENTS: AtomicUsize = AtomicUsize::new(0);

/// `vkGetBufferMemoryRequirements`: the size comes first.
extern "C" fn requirements(device: usize, buffer: usize, out: *mut u64) {
    call(REQUIREMENTS.load(Ordering::SeqCst))(device, buffer, out as usize, 0, 0, 0, 0, 0);
    if fault().alone {
        unsafe { *out = (*out).max(ALONE_BYTES) };
    }
}

/// What the loader has put behind a creation's arguments, with the next layer's functions; the layer after it finds its own.
fn link(info: *const Chained, kind: i32) -> &'static Link {
    let mut chained = unsafe { (*info).next };
    loop {
        let of = unsafe { &mut *chained };
        if of.kind == kind && of.function == 0 {
            let link = unsafe { &*of.link };
            of.link = link.next;
            return link;
        }
        chained = of.next;
    }
}

extern "C" fn create_instance(info: *const Chained, memory: usize, out: usize) -> i32 {
    let link = link(info, LOADER_INSTANCE);
    OF_INSTANCE.store(link.of_instance as usize, Ordering::SeqCst);
    let next = (link.of_instance)(0, c"vkCreateInstance".as_ptr()) as usize;
    refused("vkCreateInstance").unwrap_or_else(|| call(next)(info as usize, memory, out, 0, 0, 0, 0, 0))
}

extern "C" fn create_device(physical: usize, info: *const Chained, memory: usize, out: usize) -> i32 {
    let link = link(info, LOADER_DEVICE);
    OF_DEVICE.store(link.of_device as usize, Ordering::SeqCst);
    let next = (link.of_instance)(0, c"vkCreateDevice".as_ptr()) as usize;
    refused("vkCreateDevice").unwrap_or_else(|| call(next)(physical, info as usize, memory, out, 0, 0, 0, 0))
}

/// The layer's `vkGetInstanceProcAddr`.
#[unsafe(no_mangle)]
pub extern "C" fn failing_instance_function(instance: usize, name: *const c_char) -> Function {
    let name = unsafe { CStr::from_ptr(name) };
    match name.to_bytes() {
        b"vkGetInstanceProcAddr" => failing_instance_function as *const () as Function,
        b"vkGetDeviceProcAddr" => failing_device_function as *const () as Function,
        b"vkCreateInstance" => create_instance as *const () as Function,
        b"vkCreateDevice" => create_device as *const () as Function,
        _ if instance == 0 => std::ptr::null(),
        _ => before(name, function(&OF_INSTANCE, instance, name)),
    }
}

/// The layer's `vkGetDeviceProcAddr`.
#[unsafe(no_mangle)]
pub extern "C" fn failing_device_function(device: usize, name: *const c_char) -> Function {
    let name = unsafe { CStr::from_ptr(name) };
    match name.to_bytes() {
        b"vkGetDeviceProcAddr" => failing_device_function as *const () as Function,
        _ => before(name, function(&OF_DEVICE, device, name)),
    }
}
