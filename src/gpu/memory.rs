//! Buffers: named, typed device memory from `gpu-allocator`.

use std::marker::PhantomData;
use std::sync::Arc;

use ash::vk::{self, Handle as _};
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use gpu_allocator::{AllocationError, MemoryLocation};

use super::device::{Gpu, Inner};
use super::error::Error;
use super::hazards::Id;
use super::ledger::Rehearsal;

/// What new buffers hold where memory is poisoned: a NaN that no arithmetic makes, and as an integer a large one.
const POISON: u32 = 0x7fa5_a5a5;

/// A typed array on the device. Freed when it and its views are dropped, after the work in flight has ended.
pub struct Buffer<T> {
    memory: Arc<Memory>,
    bytes: u64,
    len: usize,
    element: PhantomData<fn() -> T>,
}

struct Memory {
    raw: vk::Buffer,
    bytes: u64,
    name: &'static str,
    stage: &'static str,
    backing: Backing,
}

/// What stands behind a buffer.
enum Backing {
    /// Memory of the device, until the buffer is taken apart.
    Real { allocation: Option<Allocation>, location: MemoryLocation, gpu: Arc<Inner> },
    /// Nothing but an entry in the books; `host` as if the host saw it.
    Counted { taken: u64, host: bool, rehearsal: Arc<Rehearsal> },
}

/// A bound buffer without its type.
#[derive(Clone, Copy, Debug)]
pub struct Slot {
    pub(super) raw: vk::Buffer,
    pub(super) bytes: u64,
    /// The buffer's name.
    pub name: &'static str,
}

impl Slot {
    pub(super) fn id(&self) -> Id {
        self.raw.as_raw()
    }
}

impl<T: bytemuck::Pod> Buffer<T> {
    /// Number of elements.
    pub fn len(&self) -> usize {
        self.len
    }
    /// True without elements.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }
    /// Bytes of device memory.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }
    /// The same memory as an array of `U`, for instance vectors as their components. Elements of up to 16 bytes may end
    /// in the padding behind the last element of `T`.
    pub fn view<U: bytemuck::Pod>(&self) -> Buffer<U> {
        let len = (self.len * size_of::<T>()).div_ceil(size_of::<U>());
        let bytes = (len.max(1) * size_of::<U>()) as u64;
        assert!(bytes <= self.memory.bytes, "{}: no {len} elements of {} bytes", self.name(), size_of::<U>());
        Buffer { memory: self.memory.clone(), bytes, len, element: PhantomData }
    }
    /// The name given at creation.
    pub fn name(&self) -> &'static str {
        self.memory.name
    }
    /// The stage it was made for.
    pub fn stage(&self) -> &'static str {
        self.memory.stage
    }
    /// The buffer without its type.
    pub fn slot(&self) -> Slot {
        Slot { raw: self.memory.raw, bytes: self.bytes, name: self.memory.name }
    }
    /// Host view of memory the host can see: of [`Gpu::readback`] buffers only.
    pub(super) fn mapped(&self) -> Option<&[u8]> {
        match &self.memory.backing {
            Backing::Real { allocation, .. } => allocation.as_ref().and_then(Allocation::mapped_slice),
            Backing::Counted { .. } => None,
        }
    }
    /// True if [`Gpu::read`] of it copies nothing on the device.
    fn on_host(&self) -> bool {
        matches!(self.memory.backing, Backing::Counted { host: true, .. }) || self.mapped().is_some()
    }
    /// The parts, without the Arc of the device; the caller frees them with [`Inner::discard`].
    pub(super) fn into_parts(self) -> (vk::Buffer, Allocation) {
        let mut memory = Arc::into_inner(self.memory).expect("a buffer without views");
        let Backing::Real { allocation, .. } = &mut memory.backing else {
            panic!("{}: taken apart in a rehearsal", memory.name);
        };
        let allocation = allocation.take().expect("a buffer owns its memory until it is dropped");
        (memory.raw, allocation)
    }
    fn mapped_mut(&mut self) -> Option<&mut [u8]> {
        let memory = Arc::get_mut(&mut self.memory)?;
        match &mut memory.backing {
            Backing::Real { allocation, .. } => allocation.as_mut().and_then(Allocation::mapped_slice_mut),
            Backing::Counted { .. } => None,
        }
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        match &mut self.backing {
            Backing::Real { allocation, location, gpu } => {
                if let Some(allocation) = allocation.take() {
                    gpu.ledger.close(self.raw.as_raw());
                    gpu.discard(self.raw, allocation, *location);
                }
            }
            Backing::Counted { taken, rehearsal, .. } => rehearsal.close(self.raw.as_raw(), *taken),
        }
    }
}

impl Gpu {
    /// An uninitialised device buffer of `len` elements.
    ///
    /// # Errors
    /// [`Error::TooLarge`] when one binding cannot hold it, [`Error::OutOfMemory`] when the device cannot.
    pub fn buffer<T: bytemuck::Pod>(&self, name: &'static str, len: usize) -> Result<Buffer<T>, Error> {
        self.allocate(name, len, MemoryLocation::GpuOnly)
    }

    /// A buffer in host memory that the device writes and [`Gpu::read`] reads without a copy.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn readback<T: bytemuck::Pod>(&self, name: &'static str, len: usize) -> Result<Buffer<T>, Error> {
        self.allocate(name, len, MemoryLocation::GpuToCpu)
    }

    /// A device buffer with these contents.
    ///
    /// # Errors
    /// As [`Gpu::buffer`], and whatever the copy meets.
    pub fn upload<T: bytemuck::Pod>(&self, name: &'static str, data: &[T]) -> Result<Buffer<T>, Error> {
        let buffer = self.buffer(name, data.len())?;
        self.write(&buffer, data)?;
        Ok(buffer)
    }

    /// A few elements that stay as they are, written by the host: nothing is submitted for them. They lie in the device's
    /// memory where the host can write there.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn constant<T: bytemuck::Pod>(&self, name: &'static str, data: &[T]) -> Result<Buffer<T>, Error> {
        let mut buffer = self.allocate(name, data.len(), MemoryLocation::CpuToGpu)?;
        if self.rehearsing().is_none() {
            let data = bytemuck::cast_slice(data);
            buffer.mapped_mut().expect("the host sees this memory")[..data.len()].copy_from_slice(data);
        }
        Ok(buffer)
    }

    /// Overwrites the first `data.len()` elements and waits.
    ///
    /// # Errors
    /// Whatever the copy meets.
    pub fn write<T: bytemuck::Pod>(&self, buffer: &Buffer<T>, data: &[T]) -> Result<(), Error> {
        assert!(data.len() <= buffer.len(), "{}: {} elements into {}", buffer.name(), data.len(), buffer.len());
        self.overwrite(buffer.slot(), bytemuck::cast_slice(data))
    }

    /// Overwrites the first words of a bound buffer and waits.
    pub(super) fn write_words(&self, slot: Slot, words: &[u32]) -> Result<(), Error> {
        self.overwrite(slot, bytemuck::cast_slice(words))
    }

    fn overwrite(&self, slot: Slot, bytes: &[u8]) -> Result<(), Error> {
        if bytes.is_empty() {
            return Ok(());
        }
        let mut staging: Buffer<u32> = self.allocate("staging", bytes.len() / 4, MemoryLocation::CpuToGpu)?;
        if self.rehearsing().is_none() {
            let mapped = staging.mapped_mut().expect("staging memory is host visible");
            mapped[..bytes.len()].copy_from_slice(bytes);
        }
        let mut recorder = self.recorder()?;
        recorder.copy_bytes(staging.slot(), slot, bytes.len() as u64);
        recorder.submit()?.wait()?;
        Ok(())
    }

    /// The contents of a buffer, after all submitted work that writes it was waited for.
    ///
    /// # Errors
    /// Whatever the copy meets.
    pub fn read<T: bytemuck::Pod>(&self, buffer: &Buffer<T>) -> Result<Vec<T>, Error> {
        self.read_range(buffer, buffer.len())
    }

    /// The first `len` elements of a buffer.
    ///
    /// # Errors
    /// As [`Gpu::read`].
    pub fn read_range<T: bytemuck::Pod>(&self, buffer: &Buffer<T>, len: usize) -> Result<Vec<T>, Error> {
        if let Some(rehearsal) = self.rehearsing() {
            if !buffer.on_host() {
                self.read_words(buffer.slot(), (len * size_of::<T>()) as u64)?;
            }
            let words = vec![rehearsal.answer(buffer.name()); len * size_of::<T>() / 4];
            return Ok(bytemuck::pod_collect_to_vec(&words));
        }
        if let Some(bytes) = buffer.mapped() {
            return Ok(bytemuck::pod_collect_to_vec(&bytes[..len * size_of::<T>()]));
        }
        let words = self.read_words(buffer.slot(), (len * size_of::<T>()) as u64)?;
        Ok(bytemuck::pod_collect_to_vec(&words[..len * size_of::<T>() / 4]))
    }

    /// Raw words of a bound buffer.
    pub(super) fn read_words(&self, slot: Slot, bytes: u64) -> Result<Vec<u32>, Error> {
        if bytes == 0 {
            return Ok(vec![]);
        }
        let staging: Buffer<u32> = self.readback("readback", (bytes / 4) as usize)?;
        let mut recorder = self.recorder()?;
        recorder.copy_bytes(slot, staging.slot(), bytes);
        recorder.submit()?.wait()?;
        if self.rehearsing().is_some() {
            return Ok(vec![]);
        }
        let mapped = staging.mapped().expect("readback memory is host visible");
        Ok(bytemuck::pod_collect_to_vec(&mapped[..bytes as usize]))
    }

    fn allocate<T: bytemuck::Pod>(
        &self,
        name: &'static str,
        len: usize,
        location: MemoryLocation,
    ) -> Result<Buffer<T>, Error> {
        const { assert!(size_of::<T>().is_multiple_of(4), "elements are made of 4-byte components") };
        let bytes = (len.max(1) * size_of::<T>()) as u64; // never empty: a whole element, so that its words can be cast
        let limit = self.info().max_binding_bytes;
        if location == MemoryLocation::GpuOnly && bytes > limit {
            return Err(Error::TooLarge { name, bytes, limit, device: self.info().name.clone() });
        }
        let inner = self.inner();
        let usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST
            | vk::BufferUsageFlags::INDIRECT_BUFFER;
        // Padded, so that a view as 16-byte vectors reaches the last element.
        let padded = bytes.next_multiple_of(16);
        let info = vk::BufferCreateInfo::default().size(padded).usage(usage);
        if let Some(rehearsal) = self.rehearsing() {
            let create = vk::DeviceBufferMemoryRequirements::default().create_info(&info);
            let mut requirements = vk::MemoryRequirements2::default();
            // SAFETY: a plain query of a live device.
            unsafe { inner.device.get_device_buffer_memory_requirements(&create, &mut requirements) };
            let taken = inner.memory_size(requirements.memory_requirements.size, location);
            let raw = vk::Buffer::from_raw(rehearsal.open(name, padded, taken));
            let host = location != MemoryLocation::GpuOnly;
            let backing = Backing::Counted { taken, host, rehearsal: rehearsal.clone() };
            let memory = Memory { raw, bytes: padded, name, stage: self.ledger().stage(), backing };
            return Ok(Buffer { memory: Arc::new(memory), bytes, len, element: PhantomData });
        }
        if self.info().heap_bytes == 0 {
            let feature = "memory (a driver without hardware compiles kernels and runs none)".to_owned();
            return Err(Error::Missing { device: self.info().name.clone(), feature });
        }
        let full = |source| Error::OutOfMemory { name, bytes, device: self.info().name.clone(), source };
        let refused = |result| match result {
            vk::Result::ERROR_OUT_OF_DEVICE_MEMORY | vk::Result::ERROR_OUT_OF_HOST_MEMORY => {
                full(AllocationError::OutOfMemory)
            }
            result => Error::Vulkan { what: "making a buffer", result },
        };
        // SAFETY: the device outlives the buffer, which holds an Arc of it; the size is positive and below the limit of a binding
        // where kernels use it; memory is bound before anybody else sees it.
        let (raw, mut requirements) = unsafe {
            let raw = inner.device.create_buffer(&info, None).map_err(refused)?;
            (raw, inner.device.get_buffer_memory_requirements(raw))
        };
        requirements.size = inner.memory_size(requirements.size, location);
        let description = AllocationCreateDesc {
            name,
            requirements,
            location,
            linear: true,
            allocation_scheme: AllocationScheme::GpuAllocatorManaged,
        };
        let allocation = match inner.allocate(&description) {
            Ok(allocation) => allocation,
            Err(source) => {
                // SAFETY: never bound, never used.
                unsafe { inner.device.destroy_buffer(raw, None) };
                return Err(full(source));
            }
        };
        // SAFETY: a fresh buffer; the allocator was given its size, alignment and memory types.
        let bound = unsafe { inner.device.bind_buffer_memory(raw, allocation.memory(), allocation.offset()) };
        if let Err(result) = bound {
            inner.discard(raw, allocation, location);
            return Err(refused(result));
        }
        inner.name_object(raw, name);
        inner.ledger.open(raw.as_raw(), name, padded);
        let backing = Backing::Real { allocation: Some(allocation), location, gpu: inner.clone() };
        let memory = Memory { raw, bytes: padded, name, stage: self.ledger().stage(), backing };
        let mut buffer = Buffer { memory: Arc::new(memory), bytes, len, element: PhantomData };
        if inner.options.poison {
            self.poison(&mut buffer)?;
        }
        Ok(buffer)
    }

    fn poison<T: bytemuck::Pod>(&self, buffer: &mut Buffer<T>) -> Result<(), Error> {
        if let Some(bytes) = buffer.mapped_mut() {
            bytes.chunks_exact_mut(4).for_each(|word| word.copy_from_slice(&POISON.to_ne_bytes()));
            return Ok(());
        }
        let mut recorder = self.recorder()?;
        recorder.fill_slot(buffer.slot(), POISON);
        recorder.submit()?.wait()?;
        Ok(())
    }
}

impl<T> std::fmt::Debug for Buffer<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}[{}]", self.memory.name, self.len)
    }
}
