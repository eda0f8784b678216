//! Who holds how much device memory, and a device that only keeps the books.
//!
//! [`Gpu::rehearsal`] gives a device on which buffers are counted but not made, passes are noted but not run, and reading
//! yields words set beforehand. The same code that trains then tells what training takes: nothing has to be written down
//! a second time.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::{Arc, Mutex};

use super::device::{Gpu, lock};
use super::hazards::Id;

/// What belongs to no stage.
pub const NO_STAGE: &str = "run";

#[derive(Clone, Copy)]
struct Held {
    name: &'static str,
    stage: &'static str,
    bytes: u64,
}

/// What a stage used during a rehearsal.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Used {
    /// Names of its passes.
    pub passes: BTreeSet<&'static str>,
    /// Buffers by name: most at once, and most bytes of all of that name at once.
    pub buffers: BTreeMap<&'static str, (usize, u64)>,
}

#[derive(Default)]
struct Books {
    stage: Option<&'static str>,
    held: HashMap<Id, Held>,
    now: u64,
    peak: u64,
}

/// Bytes of buffers alive now, the most there were, and of what they are.
#[derive(Default)]
pub(super) struct Ledger(Mutex<Books>);

impl Ledger {
    pub(super) fn stage(&self) -> &'static str {
        lock(&self.0).stage.unwrap_or(NO_STAGE)
    }

    fn set_stage(&self, stage: Option<&'static str>) -> Option<&'static str> {
        std::mem::replace(&mut lock(&self.0).stage, stage)
    }

    /// Memory was taken.
    pub(super) fn take(&self, bytes: u64) {
        let mut books = lock(&self.0);
        books.now += bytes;
        books.peak = books.peak.max(books.now);
    }

    /// Memory was given back.
    pub(super) fn give(&self, bytes: u64) {
        lock(&self.0).now -= bytes;
    }

    pub(super) fn open(&self, id: Id, name: &'static str, bytes: u64) {
        let mut books = lock(&self.0);
        let stage = books.stage.unwrap_or(NO_STAGE);
        books.held.insert(id, Held { name, stage, bytes });
    }

    pub(super) fn close(&self, id: Id) {
        lock(&self.0).held.remove(&id);
    }

    pub(super) fn memory(&self) -> (u64, u64) {
        let books = lock(&self.0);
        (books.now, books.peak)
    }

    /// (stage, name) with number and bytes.
    pub(super) fn sums(&self) -> BTreeMap<(&'static str, &'static str), (usize, u64)> {
        let mut sums = BTreeMap::new();
        for held in lock(&self.0).held.values() {
            let sum: &mut (usize, u64) = sums.entry((held.stage, held.name)).or_default();
            *sum = (sum.0 + 1, sum.1 + held.bytes);
        }
        sums
    }
}

#[derive(Default)]
struct Notes {
    next: Id,
    in_flight: u32,
    trash: Vec<u64>,
    held: BTreeMap<(&'static str, &'static str), (usize, u64)>,
    of: HashMap<Id, (&'static str, &'static str, u64)>,
    used: BTreeMap<&'static str, Used>,
    pipelines: BTreeSet<&'static str>,
    answers: HashMap<&'static str, u32>,
}

/// The books of a rehearsal.
#[derive(Default)]
pub(super) struct Rehearsal {
    pub(super) ledger: Ledger,
    notes: Mutex<Notes>,
}

impl Rehearsal {
    /// A buffer that is not made: its number.
    pub(super) fn open(&self, name: &'static str, bytes: u64, taken: u64) -> Id {
        self.ledger.take(taken);
        let stage = self.ledger.stage();
        let mut notes = lock(&self.notes);
        notes.next += 1;
        let id = notes.next;
        notes.of.insert(id, (stage, name, bytes));
        let held = notes.held.entry((stage, name)).or_default();
        *held = (held.0 + 1, held.1 + bytes);
        let (number, sum) = *held;
        let most = notes.used.entry(stage).or_default().buffers.entry(name).or_default();
        *most = (most.0.max(number), most.1.max(sum));
        drop(notes);
        self.ledger.open(id, name, bytes);
        id
    }

    /// Its memory is free once nothing is in flight, as on a device.
    pub(super) fn close(&self, id: Id, taken: u64) {
        self.ledger.close(id);
        let mut notes = lock(&self.notes);
        if let Some((stage, name, bytes)) = notes.of.remove(&id)
            && let Some(held) = notes.held.get_mut(&(stage, name))
        {
            *held = (held.0 - 1, held.1 - bytes);
        }
        notes.trash.push(taken);
        self.empty_trash(&mut notes);
    }

    fn empty_trash(&self, notes: &mut Notes) {
        if notes.in_flight == 0 {
            notes.trash.drain(..).for_each(|taken| self.ledger.give(taken));
        }
    }

    pub(super) fn began(&self) {
        lock(&self.notes).in_flight += 1;
    }

    pub(super) fn ended(&self) {
        let mut notes = lock(&self.notes);
        notes.in_flight -= 1;
        self.empty_trash(&mut notes);
    }

    pub(super) fn pass(&self, stage: &'static str, name: &'static str) {
        lock(&self.notes).used.entry(stage).or_default().passes.insert(name);
    }

    pub(super) fn pipeline(&self, name: &'static str) {
        lock(&self.notes).pipelines.insert(name);
    }

    pub(super) fn pipelines(&self) -> Vec<&'static str> {
        lock(&self.notes).pipelines.iter().copied().collect()
    }

    pub(super) fn answer(&self, buffer: &'static str) -> u32 {
        lock(&self.notes).answers.get(buffer).copied().unwrap_or(0)
    }
}

impl Gpu {
    /// The same device as a rehearsal: it has the same limits, but buffers are only counted, passes only noted, and
    /// nothing runs. What is read is zero unless [`Gpu::answer`] says otherwise.
    pub fn rehearsal(&self) -> Gpu {
        self.with_rehearsal(Arc::default())
    }

    /// In a rehearsal: every word read from buffers of this name from now on.
    ///
    /// # Panics
    /// On a device that runs.
    pub fn answer(&self, buffer: &'static str, word: u32) {
        let rehearsal = self.rehearsing().expect("answers are for rehearsals");
        lock(&rehearsal.notes).answers.insert(buffer, word);
    }

    /// In a rehearsal: what every stage used so far. Empty on a device that runs.
    pub fn used(&self) -> BTreeMap<&'static str, Used> {
        self.rehearsing().map(|r| lock(&r.notes).used.clone()).unwrap_or_default()
    }

    /// Buffers that are made and, without a word of their own, passes that are recorded meanwhile belong to `stage`.
    pub fn stage<T>(&self, stage: &'static str, work: impl FnOnce() -> T) -> T {
        let before = self.ledger().set_stage(Some(stage));
        let result = work();
        self.ledger().set_stage(before);
        result
    }

    /// Bytes of buffers alive now, and the most there ever were.
    pub fn memory(&self) -> (u64, u64) {
        self.ledger().memory()
    }

    /// Name, number and bytes of the buffers alive now, the largest first.
    pub fn buffers(&self) -> Vec<(&'static str, usize, u64)> {
        let mut sums: BTreeMap<&'static str, (usize, u64)> = BTreeMap::new();
        for ((_, name), (number, bytes)) in self.ledger().sums() {
            let sum = sums.entry(name).or_default();
            *sum = (sum.0 + number, sum.1 + bytes);
        }
        let mut all: Vec<_> = sums.into_iter().map(|(name, (number, bytes))| (name, number, bytes)).collect();
        all.sort_by(|a, b| b.2.cmp(&a.2).then(a.0.cmp(b.0)));
        all
    }

    /// Stage, number and bytes of the buffers alive now.
    pub fn stages(&self) -> BTreeMap<&'static str, (usize, u64)> {
        let mut sums: BTreeMap<&'static str, (usize, u64)> = BTreeMap::new();
        for ((stage, _), (number, bytes)) in self.ledger().sums() {
            let sum = sums.entry(stage).or_default();
            *sum = (sum.0 + number, sum.1 + bytes);
        }
        sums
    }
}
