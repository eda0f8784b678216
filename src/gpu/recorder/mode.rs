//! Modes of a recorder: the work that a pass causes beside its being recorded.

use std::collections::BTreeMap;

use super::{Call, Recorder, Threads};
use crate::gpu::check::Difference;
use crate::gpu::device::Gpu;
use crate::gpu::error::Error;
use crate::gpu::kernel::{Access, Interface, Scalar, Twin};
use crate::gpu::memory::Slot;

/// A recorder does more at a pass than to record it. In all modes but the first each pass runs at once.
#[derive(Default)]
pub(super) enum Mode {
    /// The device runs all passes when they are submitted.
    #[default]
    Together,
    /// The CPU twin runs on the same inputs. The differences so far.
    Checked(Vec<Difference>),
    /// Values that are not finite are searched for in the arrays that the pass wrote. The first one so far.
    Inspected(Option<NotFinite>),
    /// Buffers of some names are kept as the pass left them.
    Traced(Trace),
}

/// The first value that is not finite, of an inspected recording.
#[derive(Clone, Debug, PartialEq)]
pub struct NotFinite {
    /// The pass that wrote it.
    pub pass: &'static str,
    /// The pass's name for the array.
    pub tensor: &'static str,
    /// The number of the float in the array.
    pub index: usize,
    /// NaN or an infinity.
    pub value: f32,
}

/// What a traced recording keeps.
pub(super) struct Trace {
    /// Names of buffers.
    pub wanted: &'static [&'static str],
    /// Words by name, as the last pass that wrote them left them.
    pub found: BTreeMap<&'static str, Vec<u32>>,
    /// The twins run in the kernels' place.
    pub twins: bool,
}

impl Trace {
    fn keeps(&self, access: Access, slot: &Slot) -> bool {
        access.writes() && self.wanted.contains(&slot.name)
    }
}

impl Gpu {
    /// A recording in which every pass runs at once, and its CPU twin on the same inputs beside it.
    ///
    /// # Errors
    /// As [`Gpu::recorder`].
    ///
    /// # Panics
    /// In a rehearsal, which has no numbers to compare.
    pub fn checked(&self) -> Result<Recorder<'_>, Error> {
        assert!(self.rehearsing().is_none(), "a rehearsal has no numbers to compare");
        self.recorder_in(Mode::Checked(vec![]))
    }

    /// A recording in which every pass runs at once, and what it wrote is searched for values that are not finite. With
    /// the first one found the device's work ends: [`Recorder::not_finite`] names it.
    ///
    /// # Errors
    /// As [`Gpu::recorder`].
    pub fn inspected(&self) -> Result<Recorder<'_>, Error> {
        self.recorder_in(Mode::Inspected(None))
    }

    /// A recording in which every pass runs at once, and which keeps the words of the buffers of these names. Elements
    /// that no pass writes are zero: a kernel that only writes such a buffer finds it zeroed the first time.
    ///
    /// # Errors
    /// As [`Gpu::recorder`].
    pub fn traced(&self, wanted: &'static [&'static str]) -> Result<Recorder<'_>, Error> {
        self.recorder_in(Mode::Traced(Trace { wanted, found: BTreeMap::new(), twins: false }))
    }

    /// As [`Gpu::traced`], but the CPU twins run in the kernels' place: the reference path, float64 within a pass and
    /// float32 in the buffers between passes. Fills and copies remain the device's.
    ///
    /// # Errors
    /// As [`Gpu::recorder`].
    pub fn reference(&self, wanted: &'static [&'static str]) -> Result<Recorder<'_>, Error> {
        self.recorder_in(Mode::Traced(Trace { wanted, found: BTreeMap::new(), twins: true }))
    }
}

impl Recorder<'_> {
    /// The first value that is not finite that a pass of this inspected recording wrote.
    pub fn not_finite(&self) -> Option<&NotFinite> {
        match &self.mode {
            Mode::Inspected(found) => found.as_ref(),
            _ => None,
        }
    }

    /// Runs a pass by the recorder's mode.
    pub(super) fn run_by_mode(&mut self, call: Call<'_>, twin: Twin<'_>, threads: Threads<'_>) -> Result<(), Error> {
        let mut mode = std::mem::take(&mut self.mode);
        let result = match &mut mode {
            Mode::Together => self.witness(call, twin, threads).and_then(|()| self.dispatch(call, threads)),
            Mode::Checked(differences) => self.check(call, twin, threads).map(|found| differences.extend(found)),
            Mode::Inspected(found @ None) => self.inspect(call, threads).map(|first| *found = first),
            // Nothing behind it is worth running.
            Mode::Inspected(Some(_)) => Ok(()),
            Mode::Traced(trace) => self.trace(trace, call, twin, threads),
        };
        self.mode = mode;
        result
    }

    /// Runs one pass, and its twin on what it found.
    fn check(&mut self, call: Call<'_>, twin: Twin<'_>, threads: Threads<'_>) -> Result<Vec<Difference>, Error> {
        let Call { kernel: Interface { name, bindings, .. }, slots, .. } = call;
        self.flush()?;
        let mut words = self.download(slots)?;
        self.dispatch(call, threads)?;
        self.flush()?;
        (twin.reference)(&mut words);
        let written = bindings.iter().zip(slots).zip(&words).filter(|((binding, _), _)| binding.access.writes());
        written
            .map(|((binding, slot), want)| Ok(Difference::of_words(name, twin, binding, &self.words(*slot)?, want)))
            .collect()
    }

    /// Runs one pass or its twin, and keeps what it wrote of what is wanted.
    fn trace(&mut self, trace: &mut Trace, call: Call<'_>, twin: Twin<'_>, threads: Threads<'_>) -> Result<(), Error> {
        let Call { kernel: Interface { bindings, .. }, slots, .. } = call;
        let each = || slots.iter().zip(bindings.iter().map(|binding| binding.access));
        self.flush()?;
        for (slot, _) in each().filter(|(slot, access)| {
            *access == Access::Write && trace.keeps(*access, slot) && !trace.found.contains_key(slot.name)
        }) {
            self.fill_slot(*slot, 0);
        }
        self.flush()?;
        if trace.twins {
            let mut words = self.download(slots)?;
            (twin.reference)(&mut words);
            for ((slot, _), words) in each().zip(&words).filter(|((_, access), _)| access.writes()) {
                self.gpu.write_words(*slot, words)?;
            }
        } else {
            self.dispatch(call, threads)?;
            self.flush()?;
        }
        let wanted: Vec<&Slot> =
            each().filter(|(slot, access)| trace.keeps(*access, slot)).map(|(slot, _)| slot).collect();
        for slot in wanted {
            trace.found.insert(slot.name, self.words(*slot)?);
        }
        Ok(())
    }

    /// Runs one pass and searches what it wrote. Arrays that it only writes hold a pattern meanwhile, so that what it left
    /// alone is told from what it wrote; in the others that is what has changed.
    fn inspect(&mut self, call: Call<'_>, threads: Threads<'_>) -> Result<Option<NotFinite>, Error> {
        const PATTERN: u32 = 0x7fa5_a5a5; // a NaN that no arithmetic makes
        let Call { kernel: Interface { name, bindings, .. }, slots, .. } = call;
        let written: Vec<(usize, &'static str, Access)> = (0..slots.len())
            .filter(|&i| bindings[i].access.writes() && bindings[i].scalar == Scalar::F32)
            .map(|i| (i, bindings[i].name, bindings[i].access))
            .collect();
        self.flush()?;
        let before = written.iter().map(|(i, ..)| self.words(slots[*i])).collect::<Result<Vec<_>, _>>()?;
        for ((i, ..), before) in written.iter().zip(&before).filter(|((.., access), _)| *access == Access::Write) {
            self.gpu.write_words(slots[*i], &vec![PATTERN; before.len()])?;
        }
        self.dispatch(call, threads)?;
        self.flush()?;
        let mut first = None;
        for ((i, tensor, access), before) in written.into_iter().zip(before) {
            let mut after = self.words(slots[i])?;
            let left_alone = |after: u32, before: u32| after == if access == Access::Write { PATTERN } else { before };
            let broken =
                |(after, before): (&u32, &u32)| !f32::from_bits(*after).is_finite() && !left_alone(*after, *before);
            if let Some(index) = after.iter().zip(&before).position(broken) {
                let value = f32::from_bits(after[index]);
                let found = NotFinite { pass: name, tensor, index, value };
                first.get_or_insert(found);
            }
            if access == Access::Write {
                after.iter_mut().zip(before).filter(|(a, _)| **a == PATTERN).for_each(|(a, before)| *a = before);
                self.gpu.write_words(slots[i], &after)?;
            }
        }
        Ok(first)
    }
}
