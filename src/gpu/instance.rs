//! The Vulkan instance, its devices, and what the validation layer says.

use std::ffi::{CStr, c_void};
use std::sync::{Arc, Mutex};

use ash::vk;

use super::device::lock;
use super::error::{Error, Named};

const VALIDATION_LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";

/// An instance. Dropping it takes its messenger along.
pub(super) struct Instance {
    pub raw: ash::Instance,
    /// What the validation layer said.
    pub messages: Arc<Mutex<Vec<String>>>,
    pub debug_utils: bool,
    messenger: Option<(ash::ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    entry: ash::Entry,
}

impl Instance {
    /// Loads the loader and makes an instance, with the validation layer and its messages if wanted.
    ///
    /// # Errors
    /// Without a loader, a driver, or the layer that is wanted.
    pub fn open(validate: bool) -> Result<Self, Error> {
        // SAFETY: runs the initialisers of the system's Vulkan loader; `Entry` keeps the library loaded as long as the instance.
        let entry = unsafe { ash::Entry::load() }.map_err(|e| Error::NoLoader(e.to_string()))?;
        // SAFETY: plain queries of a loaded loader.
        let (layers, extensions) = unsafe {
            (
                entry.enumerate_instance_layer_properties().named("listing layers")?,
                entry.enumerate_instance_extension_properties(None).named("listing instance extensions")?,
            )
        };
        if validate && !layers.iter().any(|l| l.layer_name_as_c_str() == Ok(VALIDATION_LAYER)) {
            return Err(Error::NoValidationLayer);
        }
        let debug_utils = validate || has(&extensions, ash::ext::debug_utils::NAME);
        // Drivers that implement Vulkan on something else, as MoltenVK, are listed only when asked for.
        let portability = has(&extensions, ash::khr::portability_enumeration::NAME);
        let application = vk::ApplicationInfo::default()
            .application_name(c"gscream-vk")
            .api_version(vk::make_api_version(0, 1, 3, 0));
        let enable = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
        let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&enable);
        let layer_names: Vec<_> = validate.then_some(VALIDATION_LAYER.as_ptr()).into_iter().collect();
        let mut extension_names = vec![];
        let mut flags = vk::InstanceCreateFlags::empty();
        if debug_utils {
            extension_names.push(ash::ext::debug_utils::NAME.as_ptr());
        }
        if portability {
            extension_names.push(ash::khr::portability_enumeration::NAME.as_ptr());
            flags |= vk::InstanceCreateFlags::ENUMERATE_PORTABILITY_KHR;
        }
        let mut info = vk::InstanceCreateInfo::default()
            .flags(flags)
            .application_info(&application)
            .enabled_layer_names(&layer_names)
            .enabled_extension_names(&extension_names);
        if validate {
            info = info.push_next(&mut features);
        }
        // SAFETY: every layer's and extension's name was listed by the loader or is checked by it; the strings outlive the call.
        let raw = unsafe { entry.create_instance(&info, None) };
        // The loader's answer where no driver is installed, or none that can be loaded.
        if raw.as_ref().err() == Some(&vk::Result::ERROR_INCOMPATIBLE_DRIVER) {
            return Err(Error::NoDevice);
        }
        let raw = raw.named("creating a Vulkan instance")?;
        let mut instance = Self { raw, messages: Arc::default(), debug_utils, messenger: None, entry };
        if validate {
            instance.listen()?;
        }
        Ok(instance)
    }

    fn listen(&mut self) -> Result<(), Error> {
        let utils = ash::ext::debug_utils::Instance::new(&self.entry, &self.raw);
        let severity = vk::DebugUtilsMessageSeverityFlagsEXT::ERROR | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING;
        let create = vk::DebugUtilsMessengerCreateInfoEXT::default()
            .message_severity(severity)
            .message_type(vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION)
            .pfn_user_callback(Some(on_message))
            .user_data(Arc::as_ptr(&self.messages).cast_mut().cast());
        // SAFETY: the callback's pointer is to the contents of an Arc that the instance owns: their address stays when the instance
        // moves, and `drop` destroys the messenger before the Arc goes.
        let raw = unsafe { utils.create_debug_utils_messenger(&create, None) }.named("creating a messenger")?;
        self.messenger = Some((utils, raw));
        Ok(())
    }
}

impl Drop for Instance {
    fn drop(&mut self) {
        // SAFETY: whatever was made from the instance is gone: its owners hold the instance, or are dropped before it.
        unsafe {
            if let Some((utils, messenger)) = &self.messenger {
                utils.destroy_debug_utils_messenger(*messenger, None);
            }
            self.raw.destroy_instance(None);
        }
    }
}

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

/// True if this extension is listed.
pub(super) fn has(extensions: &[vk::ExtensionProperties], name: &CStr) -> bool {
    extensions.iter().any(|e| e.extension_name_as_c_str() == Ok(name))
}
