//! What can go wrong on a device.

use ash::vk;

/// An error of the machine room; each names the device, buffer or pass it concerns.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No Vulkan loader on this machine.
    #[error(
        "no Vulkan loader was found ({0}): install one (Debian: libvulkan1) and a driver (mesa-vulkan-drivers has lavapipe, which needs no GPU)"
    )]
    NoLoader(String),
    /// The loader lists no device at all.
    #[error(
        "no Vulkan device was found: install a driver (Debian: mesa-vulkan-drivers has lavapipe, which needs no GPU; in a container NVIDIA's also needs libgl1 and libegl1), and look whether VK_DRIVER_FILES or VK_ICD_FILENAMES names one that is not there"
    )]
    NoDevice,
    /// `--device` names none of the devices.
    #[error("no device matches {wanted:?}: `gscream-vk devices` lists them ({listed})")]
    UnknownDevice {
        /// What was asked for.
        wanted: String,
        /// What there is.
        listed: String,
    },
    /// The device lacks a feature that every kernel needs.
    #[error(
        "{device} cannot be used: it lacks {feature}; update its driver, or take another device with --device (`gscream-vk devices` lists them)"
    )]
    Missing {
        /// Device name.
        device: String,
        /// The first missing feature.
        feature: String,
    },
    /// `--validate` without the layer.
    #[error(
        "validation was asked for but VK_LAYER_KHRONOS_validation is not installed (Debian: vulkan-validationlayers)"
    )]
    NoValidationLayer,
    /// A buffer exceeds what one storage binding may hold.
    #[error(
        "buffer {name} needs {bytes} bytes, and one binding of {device} holds at most {limit}: use fewer anchors (a larger `model.voxel`) or a smaller picture (`--downscale`)"
    )]
    TooLarge {
        /// Buffer name.
        name: &'static str,
        /// Bytes wanted.
        bytes: u64,
        /// Bytes one binding holds.
        limit: u64,
        /// Device name.
        device: String,
    },
    /// The device's memory is used up.
    #[error("{device} has no memory left for buffer {name} ({bytes} bytes): {source}")]
    OutOfMemory {
        /// Buffer name.
        name: &'static str,
        /// Bytes wanted.
        bytes: u64,
        /// Device name.
        device: String,
        /// The allocator's words.
        source: gpu_allocator::AllocationError,
    },
    /// A driver refused a kernel.
    #[error("kernel {kernel} was refused by {device}: {result}")]
    Pipeline {
        /// Kernel name.
        kernel: &'static str,
        /// Device name.
        device: String,
        /// Vulkan's answer.
        result: vk::Result,
    },
    /// The device stopped answering.
    #[error("the device was lost {place}")]
    DeviceLost {
        /// The pass, or what would tell it.
        place: String,
    },
    /// A message of the validation layer.
    #[error("validation: {0}")]
    Validation(String),
    /// Any other Vulkan failure.
    #[error("{what} failed: {result}")]
    Vulkan {
        /// The call.
        what: &'static str,
        /// Vulkan's answer.
        result: vk::Result,
    },
}

/// Names a Vulkan call's failure.
pub(super) trait Named<T> {
    /// `what` is the call in words.
    fn named(self, what: &'static str) -> Result<T, Error>;
}

impl<T> Named<T> for Result<T, vk::Result> {
    fn named(self, what: &'static str) -> Result<T, Error> {
        self.map_err(|result| match result {
            vk::Result::ERROR_DEVICE_LOST => Error::DeviceLost { place: format!("while {what}") },
            result => Error::Vulkan { what, result },
        })
    }
}
