//! For tests: a validated device, and a kernel against its twin.

use std::ops::Deref;
use std::sync::{Condvar, Mutex};
use std::thread::ThreadId;

use clap::ValueEnum as _;

use super::check::Difference;
use super::descriptors::Descriptors;
use super::device::{Gpu, Options, lock};
use super::form::Form;
use super::kernel::{Interface, Reference, with_twin};
use super::recorder::Threads;

/// A device under the validation layer. Dropping it fails the test if the layer said anything.
///
/// One thread at a time has such devices: the layer keeps what belongs to a device in a table without a lock
/// (Vulkan-ValidationLayers issue 4391), and a program that opens one while another works may crash.
pub struct TestGpu {
    // Before the turn: what is destroyed is destroyed while no other thread calls the layer.
    gpu: Gpu,
    _turn: Turn,
}

/// Opens the device that `GSCREAM_DEVICE` names (the first usable one otherwise) under the Khronos validation layer
/// with synchronisation validation. `GSCREAM_DESCRIPTORS` is as `--descriptors`.
///
/// The device stays open for the process's next tests, with its compiled kernels and its account of memory:
/// [`fresh_gpu`] has neither.
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
    static KEPT: Mutex<Vec<Gpu>> = Mutex::new(vec![]);
    let _turn = Turn::wait();
    let options = validated(options);
    let mut kept = lock(&KEPT);
    let gpu = kept.iter().find(|gpu| *gpu.options() == options).cloned().unwrap_or_else(|| {
        let gpu = open(&options);
        kept.push(gpu.clone());
        gpu
    });
    TestGpu { gpu, _turn }
}

/// As [`gpu_with`], on a device that nothing ran on.
///
/// # Panics
/// As [`gpu`].
pub fn fresh_gpu(options: Options) -> TestGpu {
    let _turn = Turn::wait();
    TestGpu { gpu: open(&validated(options)), _turn }
}

fn validated(options: Options) -> Options {
    Options { validate: true, ..from_environment(options) }
}

fn open(options: &Options) -> Gpu {
    Gpu::open(options).unwrap_or_else(|error| panic!("tests need a Vulkan device and the validation layer: {error}"))
}

/// A thread's turn to have validated devices, as many as it likes.
struct Turn;

/// Whose turn it is, and how many devices it has.
static TURN: (Mutex<Option<(ThreadId, usize)>>, Condvar) = (Mutex::new(None), Condvar::new());

impl Turn {
    fn wait() -> Self {
        let own = std::thread::current().id();
        let (turn, freed) = &TURN;
        let mut turn = freed
            .wait_while(lock(turn), |turn| turn.is_some_and(|(thread, _)| thread != own))
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        *turn = Some((own, turn.map_or(0, |(_, devices)| devices) + 1));
        Self
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        let (turn, freed) = &TURN;
        let mut turn = lock(turn);
        *turn = turn.filter(|&(_, devices)| devices > 1).map(|(thread, devices)| (thread, devices - 1));
        freed.notify_one();
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
        &self.gpu
    }
}

impl Drop for TestGpu {
    fn drop(&mut self) {
        let messages = self.gpu.take_messages();
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
    kernel: K,
    gpu: &Gpu,
    case: &K::Arrays,
    push: K::Push,
    threads: impl Into<Threads<'t>>,
) -> K::Arrays {
    run_once_with(kernel, gpu, K::Constants::default(), case, push, threads)
}

/// As [`run_once`], with specialisation constants.
///
/// # Panics
/// As [`run_once`].
pub fn run_once_with<'t, K: Reference>(
    kernel: K,
    gpu: &Gpu,
    constants: K::Constants,
    case: &K::Arrays,
    push: K::Push,
    threads: impl Into<Threads<'t>>,
) -> K::Arrays {
    let (variant, words) = words_of(kernel, case.clone());
    let mut words = run_words::<K>(gpu, variant, &words, push, constants, threads.into());
    K::arrays(&variant.spread(&mut words, K::BINDINGS))
}

/// Runs the twin on a case and returns all bindings afterwards.
pub fn run_twin<K: Reference>(kernel: K, constants: K::Constants, case: K::Arrays, push: K::Push) -> K::Arrays {
    let mut words = K::words(case);
    K::reference(kernel.host(&mut words), push, constants);
    K::arrays(&words)
}

/// The variant that a case is of, and the words of its buffers.
fn words_of<K: Reference>(kernel: K, case: K::Arrays) -> (&'static Interface, Vec<Vec<u32>>) {
    let words = K::words(case);
    let variant = kernel.variant(&words);
    (variant, variant.collect(words))
}

fn run_words<K: Reference>(
    gpu: &Gpu,
    variant: &'static Interface,
    words: &[Vec<u32>],
    push: K::Push,
    constants: K::Constants,
    threads: Threads<'_>,
) -> Vec<Vec<u32>> {
    let constants = variant.own_constants(bytemuck::bytes_of(&constants));
    let push = &bytemuck::bytes_of(&push)[..variant.push_bytes as usize];
    super::check::run_words(gpu, variant, words, push, &constants, threads)
        .unwrap_or_else(|e| panic!("{}: {e}", variant.name))
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
    kernel: K,
    gpu: &Gpu,
    constants: K::Constants,
    case: K::Arrays,
    push: K::Push,
    threads: impl Into<Threads<'t>>,
) {
    let (variant, mut want) = words_of(kernel, case);
    let got = run_words::<K>(gpu, variant, &want, push, constants, threads.into());
    with_twin(kernel, variant, push, constants, |twin| {
        (twin.reference)(&mut want);
        for ((binding, got), want) in variant.bindings.iter().zip(&got).zip(&want) {
            if binding.access.writes() {
                let difference = Difference::of_words(variant.name, twin, binding, got, want);
                assert!(difference.ok(), "{difference}\npush {push:?}");
            }
        }
    });
}
