//! Devices that exist, by their limits: what each becomes in the choice of device, subgroup, queue and memory.
//!
//! Sources: Mesa's drivers and MoltenVK as published, where the row says so; rows marked `unsure` are in part from memory of
//! vendors' tables, and hold what this program would do with such numbers rather than what the device has.

use super::tests::{heaps, plain};
use super::*;

const DRAW: vk::QueueFlags = vk::QueueFlags::GRAPHICS;
const COMPUTE: vk::QueueFlags = vk::QueueFlags::COMPUTE;
const COPY: vk::QueueFlags = vk::QueueFlags::TRANSFER;

const LOCAL: vk::MemoryPropertyFlags = vk::MemoryPropertyFlags::DEVICE_LOCAL;
/// Visible to the host and coherent.
const HOST: vk::MemoryPropertyFlags = vk::MemoryPropertyFlags::from_raw(
    vk::MemoryPropertyFlags::HOST_VISIBLE.as_raw() | vk::MemoryPropertyFlags::HOST_COHERENT.as_raw(),
);
const CACHED: vk::MemoryPropertyFlags = vk::MemoryPropertyFlags::HOST_CACHED;
const GIB: u64 = 1 << 30;

/// What of a device decides.
struct Row {
    name: &'static str,
    kind: vk::PhysicalDeviceType,
    /// The driver's own size, the least and the most, and whether kernels can ask for one.
    subgroup: (u32, u32, u32, bool),
    /// Most subgroups of a workgroup.
    subgroups: u32,
    /// Storage buffers of a stage, bytes of shared memory, threads of a workgroup.
    limits: (u32, u32, u32),
    families: Vec<vk::QueueFlags>,
    /// Bytes, and whether they are the device's own.
    heaps: Vec<(u64, bool)>,
    /// Properties and heap.
    types: Vec<(vk::MemoryPropertyFlags, u32)>,
    /// Threads of a subgroup and of a narrow one, queue family; or the end of the first thing it lacks.
    becomes: Result<(u32, u32, u32), &'static str>,
}

impl Row {
    fn facts(&self) -> Facts {
        let mut facts = plain();
        let (buffers, shared, threads) = self.limits;
        facts.core.device_type = self.kind;
        let limits = &mut facts.core.limits;
        limits.max_per_stage_descriptor_storage_buffers = buffers;
        limits.max_descriptor_set_storage_buffers = buffers;
        limits.max_per_stage_resources = buffers.saturating_mul(2);
        limits.max_compute_shared_memory_size = shared;
        limits.max_compute_work_group_invocations = threads;
        limits.max_compute_work_group_size = [threads, threads, 64];
        let (own, least, most, chosen) = self.subgroup;
        facts.v11.subgroup_size = own;
        facts.v13.min_subgroup_size = least;
        facts.v13.max_subgroup_size = most;
        facts.v13.max_compute_workgroup_subgroups = self.subgroups;
        facts.v13.required_subgroup_size_stages =
            if chosen { vk::ShaderStageFlags::COMPUTE } else { vk::ShaderStageFlags::empty() };
        let family = |&flags: &vk::QueueFlags| vk::QueueFamilyProperties::default().queue_flags(flags).queue_count(1);
        facts.families = self.families.iter().map(family).collect();
        facts.memory = heaps(&self.heaps);
        facts.memory.memory_type_count = self.types.len() as u32;
        for (slot, &(flags, heap)) in facts.memory.memory_types.iter_mut().zip(&self.types) {
            *slot = vk::MemoryType::default().property_flags(flags).heap_index(heap);
        }
        facts
    }

    /// The type that the allocator takes: the first that has all that is preferred, else all that is required.
    fn memory_type(
        &self,
        preferred: vk::MemoryPropertyFlags,
        required: vk::MemoryPropertyFlags,
    ) -> (vk::MemoryPropertyFlags, u64) {
        let first = |flags| self.types.iter().find(|(has, _)| has.contains(flags));
        let &(flags, heap) = first(preferred).or_else(|| first(required)).expect("every device has such memory");
        (flags, self.heaps[heap as usize].0)
    }
}

/// NVIDIA's own driver with a window of 256 MiB into the card's memory.
fn nvidia(name: &'static str, gib: u64) -> Row {
    Row {
        name,
        kind: vk::PhysicalDeviceType::DISCRETE_GPU,
        subgroup: (32, 32, 32, true),
        subgroups: 32,
        limits: (1 << 20, 48 << 10, 1024),
        families: vec![DRAW | COMPUTE | COPY, COPY, COMPUTE | COPY, COPY],
        heaps: vec![(gib * GIB, true), (48 * GIB, false), (GIB / 4, true)],
        types: vec![
            (vk::MemoryPropertyFlags::empty(), 1),
            (LOCAL, 0),
            (HOST, 1),
            (HOST | CACHED, 1),
            (LOCAL | HOST, 2),
        ],
        becomes: Ok((32, 32, 2)),
    }
}

/// RADV with the whole of the card's memory in the host's sight: `radv_physical_device.c`.
fn radv(name: &'static str, gib: u64, wave32: bool) -> Row {
    Row {
        name,
        kind: vk::PhysicalDeviceType::DISCRETE_GPU,
        subgroup: (64, if wave32 { 32 } else { 64 }, 64, wave32),
        subgroups: u32::MAX,
        limits: (1 << 23, 64 << 10, 1024),
        families: vec![DRAW | COMPUTE | COPY, COMPUTE | COPY, COPY],
        heaps: vec![(32 * GIB, false), (gib * GIB, true)],
        types: vec![(LOCAL, 1), (HOST, 0), (LOCAL | HOST, 1), (HOST | CACHED, 0)],
        becomes: Ok((64, if wave32 { 32 } else { 64 }, 1)),
    }
}

/// ANV: integrated GPUs see the host's memory alone.
fn anv(name: &'static str, least: u32, own_gib: Option<u64>) -> Row {
    let shared = vec![(LOCAL | HOST | CACHED, 0)];
    let split = vec![(LOCAL, 0), (HOST | CACHED, 1), (LOCAL | HOST, 2)];
    Row {
        name,
        kind: own_gib.map_or(vk::PhysicalDeviceType::INTEGRATED_GPU, |_| vk::PhysicalDeviceType::DISCRETE_GPU),
        subgroup: (32, least, 32, true),
        subgroups: 64,
        limits: (64, 64 << 10, 1024),
        families: if own_gib.is_some() {
            vec![DRAW | COMPUTE | COPY, COMPUTE | COPY]
        } else {
            vec![DRAW | COMPUTE | COPY]
        },
        heaps: own_gib
            .map_or(vec![(12 * GIB, true)], |gib| vec![(gib * GIB, true), (16 * GIB, false), (GIB / 4, true)]),
        types: if own_gib.is_some() { split } else { shared },
        becomes: Ok((32, least, u32::from(own_gib.is_some()))),
    }
}

/// A GPU of a phone, a tablet or a single board: one heap, one family.
fn small(name: &'static str, subgroup: (u32, u32, u32, bool), subgroups: u32, limits: (u32, u32, u32)) -> Row {
    Row {
        name,
        kind: vk::PhysicalDeviceType::INTEGRATED_GPU,
        subgroup,
        subgroups,
        limits,
        families: vec![DRAW | COMPUTE | COPY],
        heaps: vec![(6 * GIB, true)],
        types: vec![(LOCAL, 0), (LOCAL | HOST, 0), (LOCAL | HOST | CACHED, 0)],
        becomes: Ok((subgroup.0, if subgroup.3 { subgroup.1 } else { subgroup.0 }, 0)),
    }
}

fn rows() -> Vec<Row> {
    vec![
        nvidia("NVIDIA RTX 4090", 24),
        nvidia("NVIDIA GTX 1060", 6),
        radv("AMD RX 9070 XT (RDNA 4, RADV)", 16, true),
        radv("AMD RX 7900 XTX (RDNA 3, RADV)", 24, true),
        radv("AMD RX 6700 XT (RDNA 2, RADV)", 12, true),
        radv("AMD RX Vega 64 (GCN, RADV)", 8, false),
        // Without a large window, memory in the host's sight is a heap of its own.
        Row {
            heaps: vec![(8 * GIB - GIB / 4, true), (32 * GIB, false), (GIB / 4, true)],
            types: vec![(LOCAL, 0), (HOST, 1), (LOCAL | HOST, 2), (HOST | CACHED, 1)],
            ..radv("AMD RX 580 (GCN, RADV)", 8, false)
        },
        anv("Intel Iris Xe (Xe-LP, ANV)", 8, None),
        // Unsure: whether the kernel offers a compute engine; without one there is a family the fewer.
        anv("Intel Arc A770 (Xe-HPG, ANV)", 8, Some(16)),
        anv("Intel Arc B580 (Xe2, ANV)", 16, Some(12)),
        // `MVKDevice.mm`: no stage in requiredSubgroupSizeStages, 31 buffers, families alike. The size is 32 of 4 to 32.
        Row {
            families: vec![DRAW | COMPUTE | COPY; 4],
            ..small("Apple M1 (MoltenVK)", (32, 4, 32, false), 256, (31, 32 << 10, 1024))
        },
        Row {
            families: vec![DRAW | COMPUTE | COPY; 4],
            ..small("Apple M3 Max (MoltenVK)", (32, 4, 32, false), 256, (31, 32 << 10, 1024))
        },
        // Unsure: which of its sizes MoltenVK calls its own.
        small("Intel Iris in a Mac (MoltenVK)", (32, 8, 32, false), 128, (31, 64 << 10, 1024)),
        small("Apple M2 (Honeykrisp)", (32, 32, 32, true), 32, (1 << 20, 32 << 10, 1024)),
        // `tu_device.cc`: threadsize_base 64 and its double, at most 16 waves; the double is its own.
        Row {
            becomes: Ok((64, 64, 0)),
            ..small("Adreno 740 (Turnip)", (128, 64, 128, true), 16, (1 << 20, 32 << 10, 1024))
        },
        // Unsure: threads of a workgroup, of which older Malis have 512 or 384.
        small("Mali-G715 (Arm)", (16, 16, 16, true), 64, (500_000, 32 << 10, 1024)),
        small("Mali-G610 (PanVK)", (16, 16, 16, true), 64, (1 << 16, 32 << 10, 1024)),
        // `v3dv_device.c`: 16 channels. Unsure: buffers and shared memory, both from `v3dv_limits.h` as known.
        Row {
            becomes: Err("storage buffers in a kernel"),
            ..small("Raspberry Pi 5 (V3DV)", (16, 16, 16, true), 16, (8, 16 << 10, 256))
        },
        Row {
            kind: vk::PhysicalDeviceType::CPU,
            ..small("llvmpipe (lavapipe)", (8, 8, 8, true), 128, (1 << 16, 32 << 10, 1024))
        },
        Row {
            kind: vk::PhysicalDeviceType::CPU,
            ..small("SwiftShader", (4, 4, 4, false), 64, (1 << 16, 32 << 10, 256))
        },
        // A size that no kernel is made for, and no other can be asked for.
        Row {
            becomes: Err("subgroups of one known size of 4 to 64 threads"),
            ..small("a GPU with subgroups of 128 alone", (128, 64, 128, false), 16, (1 << 20, 32 << 10, 1024))
        },
    ]
}

#[test]
fn known_devices_become_what_they_are_worth() {
    for row in rows() {
        let name = row.name;
        let found = row.facts().found(vk::PhysicalDevice::null(), Ok(vec![]));
        let info = &found.info;
        match row.becomes {
            Ok((subgroup, narrow, family)) => {
                assert_eq!(info.lacks, [""; 0], "{name}");
                let sizes = (info.subgroup_size, info.narrow_subgroup_size);
                assert_eq!((sizes, found.family), ((subgroup, narrow), Some(family)), "{name}");
                assert_eq!(found.subgroups.wanted(subgroup), Ok(subgroup), "{name}: its own size can be named");
            }
            Err(lack) => {
                assert!(info.lacks.first().is_some_and(|first| first.ends_with(lack)), "{name}: {:?}", info.lacks);
                let refused = choose(vec![found], Some("0")).err().expect("it is refused").to_string();
                assert!(refused.contains(&format!("{lack}; ")) && !refused.contains('\n'), "{refused}");
            }
        }
    }
}

/// Device buffers lie in the heap whose size is told, and what the host reads is cached, on all that are usable.
#[test]
fn memory_of_known_devices_is_what_is_told() {
    for row in rows().iter().filter(|row| row.becomes.is_ok()) {
        let (_, bytes) = row.memory_type(LOCAL, LOCAL);
        assert_eq!(bytes, row.facts().heap_bytes(), "{}: the heap of device buffers", row.name);
        let (read, _) = row.memory_type(HOST | CACHED, HOST);
        assert!(read.contains(CACHED), "{}: reading uncached memory is slow", row.name);
        let (written, _) = row.memory_type(HOST | LOCAL, HOST);
        assert!(written.contains(HOST), "{}", row.name);
    }
}

#[test]
fn among_known_devices_the_largest_card_is_taken() {
    let mut found: Vec<(Rank, &str)> = vec![];
    let rows = rows();
    found.extend(rows.iter().map(|row| (row.facts().rank(), row.name)));
    found.sort_by_key(|(rank, _)| *rank);
    assert_eq!(found[0].1, "NVIDIA RTX 4090");
    let place = |name: &str| found.iter().position(|(_, other)| *other == name).expect("a row");
    assert!(
        place("AMD RX 580 (GCN, RADV)") < place("Apple M3 Max (MoltenVK)"),
        "cards before what shares the host's memory"
    );
    assert!(place("SwiftShader") > place("Raspberry Pi 5 (V3DV)"), "CPUs last");
}
