use super::next;
use crate::gpu;
use crate::gpu::DeviceInfo;

/// List the Vulkan devices and what each lacks
///
/// Every command that computes takes --device with an index or a part of a name from this list; without it the first
/// device that lacks nothing is used.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk devices
  gscream-vk devices --json | jq '.[0].driver'")]
pub(super) struct Args {
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let devices = gpu::device::devices()?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&devices)?);
        return Ok(());
    }
    if devices.is_empty() {
        return Err(gpu::Error::NoDevice.into());
    }
    print!("{}", list(&devices));
    next::say(&[if devices.iter().any(|device| device.lacks.is_empty()) {
        ("gscream-vk train synthetic".to_owned(), "trains the built-in scene; --device picks one of these")
    } else {
        ("a newer driver".to_owned(), "is needed, or Mesa's lavapipe, which needs no GPU (Debian: mesa-vulkan-drivers)")
    }]);
    Ok(())
}

fn list(devices: &[DeviceInfo]) -> String {
    let mut text = String::new();
    for d in devices {
        let timestamps = if d.timestamp_period > 0.0 { "" } else { "; no timestamps: --profile measures nothing" };
        let sets = if d.push_descriptors { "" } else { "; no push descriptors: descriptor sets in their place" };
        let usable = if d.lacks.is_empty() {
            format!("usable{sets}{timestamps}")
        } else {
            format!("cannot be used: lacks {}", d.lacks.join(", "))
        };
        let narrow = d.narrow_subgroup_size;
        let narrow = if narrow == d.subgroup_size { String::new() } else { format!(" and {narrow}") };
        text += &format!(
            "{}  {}\n   {}, Vulkan {}, driver {}\n   memory {}, one binding {}, subgroups of {}{narrow}, shared memory {}\n   {usable}\n",
            d.index,
            d.name,
            d.kind,
            d.api,
            d.driver,
            indicatif::BinaryBytes(d.heap_bytes),
            indicatif::BinaryBytes(d.max_binding_bytes),
            d.subgroup_size,
            indicatif::BinaryBytes(d.shared_bytes.into()),
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_says_what_it_lacks() {
        let device = DeviceInfo {
            index: 1,
            name: "Old Card".into(),
            kind: "discrete",
            driver: "vendor 1.2".into(),
            api: "1.2.170".into(),
            subgroup_size: 64,
            narrow_subgroup_size: 32,
            push_descriptors: true,
            max_binding_bytes: 128 << 20,
            heap_bytes: 8 << 30,
            shared_bytes: 48 << 10,
            max_groups: 65535,
            timestamp_period: 1.0,
            lacks: vec!["Vulkan 1.3".into(), "synchronization2".into()],
        };
        let modern = DeviceInfo { index: 0, lacks: vec![], timestamp_period: 0.0, ..device.clone() };
        let plain = DeviceInfo { lacks: vec![], push_descriptors: false, ..device.clone() };
        assert_eq!(
            list(&[plain]).lines().last(),
            Some("   usable; no push descriptors: descriptor sets in their place")
        );
        assert_eq!(
            list(&[modern, device]),
            "\
0  Old Card
   discrete, Vulkan 1.2.170, driver vendor 1.2
   memory 8.00 GiB, one binding 128.00 MiB, subgroups of 64 and 32, shared memory 48.00 KiB
   usable; no timestamps: --profile measures nothing
1  Old Card
   discrete, Vulkan 1.2.170, driver vendor 1.2
   memory 8.00 GiB, one binding 128.00 MiB, subgroups of 64 and 32, shared memory 48.00 KiB
   cannot be used: lacks Vulkan 1.3, synchronization2
"
        );
    }
}
