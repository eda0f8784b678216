//! Every loader against damaged files: no panic, no memory that the file's length does not explain, and one sentence for
//! each refusal.
//!
//! The inputs are files of the program's own making with a few bytes, numbers or lines changed, by a seeded generator, so
//! that a failure comes again; checksums are made right where they would stop everything else. `GSCREAM_FUZZ` is the number
//! of inputs of each loader, `GSCREAM_FUZZ_SEED` another sequence. The input that a loader died of is in the folder that
//! the failure names.

mod loaders;
mod mutate;
mod seeds;

use std::alloc::{GlobalAlloc, Layout, System};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, Instant};

use mutate::Mutator;

/// Inputs of each loader where the environment says nothing: a minute in all on two cores. `GSCREAM_FUZZ=100000` is for whoever
/// changes a loader.
const INPUTS: u64 = 1000;
/// What a loader may allocate for any file: threads, tables, buffers of a fixed size.
const FIXED: usize = 48 << 20;
/// Bytes for each byte of a file: what a picture can unpack to (12,288), decoded and as float32 beside it.
const EACH: usize = 5 * 12_288;
/// No input takes longer.
const LONGEST: Duration = Duration::from_secs(10);

/// The system's allocator, counting what is there.
struct Counting;

static LIVE: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call goes to the system's allocator as it is; counting does not touch the memory.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        PEAK.fetch_max(LIVE.fetch_add(layout.size(), Relaxed) + layout.size(), Relaxed);
        // SAFETY: the caller's promise about `layout` is the one that is needed.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        PEAK.fetch_max(LIVE.fetch_add(layout.size(), Relaxed) + layout.size(), Relaxed);
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // The old block stays until the new one is filled.
        PEAK.fetch_max(LIVE.fetch_add(size, Relaxed) + size, Relaxed);
        LIVE.fetch_sub(layout.size(), Relaxed);
        // SAFETY: as above.
        unsafe { System.realloc(at, layout, size) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        LIVE.fetch_sub(layout.size(), Relaxed);
        // SAFETY: as above.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// One loader at a time: what is allocated is counted over all threads.
static ALONE: Mutex<()> = Mutex::new(());

fn number(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).map_or(otherwise, |text| text.parse().expect("a number"))
}

/// A loader under test.
struct Loader<'a> {
    name: &'static str,
    /// Whole files, which it takes.
    seeds: Vec<Vec<u8>>,
    /// Whether files are text.
    text: bool,
    /// What is done to a changed file before it is read.
    finish: &'a dyn Fn(Vec<u8>) -> Vec<u8>,
    /// One input in so many of the usual number, for slow ones.
    share: u64,
}

impl<'a> Loader<'a> {
    fn of_bytes(name: &'static str, seeds: Vec<Vec<u8>>) -> Self {
        Self { name, seeds, text: false, finish: &|bytes| bytes, share: 1 }
    }

    fn of_text(name: &'static str, seeds: Vec<Vec<u8>>) -> Self {
        Self { text: true, ..Self::of_bytes(name, seeds) }
    }

    fn finished(self, finish: &'a dyn Fn(Vec<u8>) -> Vec<u8>) -> Self {
        Self { finish, ..self }
    }

    fn rarely(self, share: u64) -> Self {
        Self { share, ..self }
    }

    /// Gives every input to `load`, which says what was refused.
    fn run(self, load: impl Fn(&[u8]) -> Result<(), String>) {
        let _alone = ALONE.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        for seed in &self.seeds {
            load(seed).unwrap_or_else(|error| panic!("{}: the seed is refused: {error}", self.name));
        }
        let count = number("GSCREAM_FUZZ", INPUTS).div_ceil(self.share);
        let mut mutator = Mutator::new(self.name, number("GSCREAM_FUZZ_SEED", 0), &self.seeds, self.text);
        let keep = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("fuzz-{}", self.name));
        let (begun, mut accepted, mut most) = (Instant::now(), 0, 0);
        for input in 0..count {
            let bytes = (self.finish)(mutator.input());
            let before = LIVE.load(Relaxed);
            PEAK.store(before, Relaxed);
            let start = Instant::now();
            let outcome = catch_unwind(AssertUnwindSafe(|| load(&bytes)));
            let (took, used) = (start.elapsed(), PEAK.load(Relaxed).saturating_sub(before));
            let fault = match &outcome {
                Err(_) => Some("panics".to_owned()),
                Ok(Err(error)) if error.lines().count() != 1 || error.len() > 4000 => {
                    Some(format!("does not say one sentence: {error:?}"))
                }
                _ if used > FIXED + EACH * bytes.len() => Some(format!("takes {used} bytes for {}", bytes.len())),
                _ if took > LONGEST => Some(format!("takes {took:?}")),
                _ => None,
            };
            if let Some(fault) = fault {
                std::fs::write(&keep, &bytes).expect("a writable folder");
                panic!("{}: input {input} {fault}; it is {}", self.name, keep.display());
            }
            accepted += u64::from(matches!(outcome, Ok(Ok(()))));
            most = most.max(used);
        }
        let seconds = begun.elapsed().as_secs_f64();
        println!(
            "{:<22} {count:>8} inputs, {accepted:>8} taken, {seconds:>6.1} s, {:>7.0} a second, at most {:>6.2} MiB",
            self.name,
            count as f64 / seconds,
            most as f64 / f64::from(1 << 20)
        );
        // A loader that takes everything, or nothing, was not asked.
        assert!(count < 500 || accepted > 0 && accepted < count, "{}: {accepted} of {count}", self.name);
    }
}
