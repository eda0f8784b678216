//! For tests: a validated device, and a kernel against its twin.

use std::ops::Deref;

use clap::ValueEnum as _;

use super::check::Difference;
use super::descriptors::Descriptors;
use super::device::{Gpu, Options};
use super::form::Form;
use super::kernel::Reference;
use super::recorder::Threads;

/// A device under the validation layer. Dropping it fails the test if the layer said anything.
pub struct TestGpu(Gpu);

/// Opens the device that `GSCREAM_DEVICE` names (the first usable one otherwise) under the Khronos validation layer
/// with synchronisation validation. `GSCREAM_DESCRIPTORS` is as `--descriptors`.
///
/// # Panics
/// Without a device or without the layer: a test that skips the layer would look passed.
pub fn gpu() -> TestGpu {
    gpu_with(Options::default())
}

/// As [`gpu`], with more options.
///
/// # Panics
/// As [`gpu`].
pub fn gpu_with(options: Options) -> TestGpu {
    match Gpu::open(&Options { validate: true, ..from_environment(options) }) {
        Ok(gpu) => TestGpu(gpu),
        Err(error) => panic!("tests need a Vulkan device and the validation layer: {error}"),
    }
}

/// As [`gpu`], opened once for each form of the work, one after the other.
pub fn gpu_in_both_forms() -> impl Iterator<Item = TestGpu> {
    Form::ALL.into_iter().map(|form| gpu_with(Options { form: Some(form), ..Options::default() }))
}

/// These options with the device and, where they say `auto`, the descriptors that the environment names.
///
/// # Panics
/// When `GSCREAM_DESCRIPTORS` is none of `auto`, `push` and `sets`.
pub fn from_environment(options: Options) -> Options {
    let device = std::env::var("GSCREAM_DEVICE").ok().or(options.device);
    let descriptors = match std::env::var("GSCREAM_DESCRIPTORS") {
        Ok(word) if options.descriptors == Descriptors::Auto => {
            Descriptors::from_str(&word, false).unwrap_or_else(|e| panic!("GSCREAM_DESCRIPTORS: {e}"))
        }
        _ => options.descriptors,
    };
    Options { device, descriptors, ..options }
}

impl Deref for TestGpu {
    type Target = Gpu;
    fn deref(&self) -> &Gpu {
        &self.0
    }
}

impl Drop for TestGpu {
    fn drop(&mut self) {
        let messages = self.0.take_messages();
        if !messages.is_empty() && !std::thread::panicking() {
            panic!("{} validation messages, the first: {}", messages.len(), messages[0]);
        }
    }
}

/// Float32 not-a-number that no kernel writes: fill outputs with it to see what was left out.
pub const UNWRITTEN: f32 = f32::from_bits(0x7fc01234);

/// Runs the kernel once on a case and returns all bindings afterwards.
///
/// # Panics
/// When the device refuses.
pub fn run_once<'t, K: Reference>(
    gpu: &Gpu,
    case: &K::Arrays,
    push: K::Push,
    threads: impl Into<Threads<'t>>,
) -> K::Arrays {
    run_once_with::<K>(gpu, case, push, K::Constants::default(), threads)
}

/// As [`run_once`], with specialisation constants.
///
/// # Panics
/// As [`run_once`].
pub fn run_once_with<'t, K: Reference>(
    gpu: &Gpu,
    case: &K::Arrays,
    push: K::Push,
    constants: K::Constants,
    threads: impl Into<Threads<'t>>,
) -> K::Arrays {
    K::arrays(&run_words::<K>(gpu, K::words(case.clone()), push, constants, threads.into()))
}

fn run_words<K: Reference>(
    gpu: &Gpu,
    words: Vec<Vec<u32>>,
    push: K::Push,
    constants: K::Constants,
    threads: Threads<'_>,
) -> Vec<Vec<u32>> {
    super::check::run_words::<K>(gpu, &words, push, constants, threads).unwrap_or_else(|e| panic!("{}: {e}", K::NAME))
}

/// Runs kernel and twin on the same case and compares every output within [`Reference::check`].
///
/// # Panics
/// When they differ, naming the tensor and element.
pub fn assert_twin<'t, K: Reference>(
    kernel: K,
    gpu: &Gpu,
    case: K::Arrays,
    push: K::Push,
    threads: impl Into<Threads<'t>>,
) {
    assert_twin_with(kernel, gpu, K::Constants::default(), case, push, threads);
}

/// As [`assert_twin`], with specialisation constants.
///
/// # Panics
/// As [`assert_twin`].
pub fn assert_twin_with<'t, K: Reference>(
    _kernel: K,
    gpu: &Gpu,
    constants: K::Constants,
    case: K::Arrays,
    push: K::Push,
    threads: impl Into<Threads<'t>>,
) {
    let mut want = K::words(case);
    let got = run_words::<K>(gpu, want.clone(), push, constants, threads.into());
    K::reference(K::host(&mut want), push, constants);
    for ((binding, got), want) in K::BINDINGS.iter().zip(&got).zip(&want) {
        if binding.access.writes() {
            let difference = Difference::of_words::<K>(binding, got, want);
            assert!(difference.ok(), "{difference}\npush {push:?}");
        }
    }
}
