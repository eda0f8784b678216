//! Kernels on something stricter than any device: their modules run in an interpreter that deals lanes and orders at random and
//! watches every access.
//!
//! A small training is recorded on a device, pass by pass, in both forms. Each kernel's dispatch is then run by the interpreter
//! with what it was given, and what it writes is held against its twin. Faults planted into the modules are found.

mod code;
#[allow(dead_code)]
#[path = "../common/mod.rs"]
mod common;
mod faults;
mod machine;
mod program;
mod shape;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;
use std::time::Instant;

use gscream_vk::gpu::kernel::Scalar;
use gscream_vk::gpu::{Case, Form, Options, testing};
use gscream_vk::train::run::Run;
use machine::{Launch, Manner};
use program::{Choices, Program};
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;
use rayon::iter::{IntoParallelRefIterator as _, ParallelIterator as _};
use rspirv::dr::Module;

/// One dispatch of every kernel and set of constants that a small training with growth, pruning, attention and all losses runs.
static CASES: LazyLock<Vec<Case>> = LazyLock::new(|| {
    let mut cases: Vec<Case> = vec![];
    for form in Form::ALL {
        let gpu = testing::fresh_gpu(Options { form: Some(form), witness: 1, ..Options::default() });
        let mut scene = common::tiny();
        scene.test.clear();
        // Growth and pruning come after steps 4, 6 and 8.
        let settings = common::settings(9);
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
        run.train(folder.path(), &mut common::Watch::default()).expect("a run");
        for case in gpu.take_cases() {
            if !cases.iter().any(|known| known.name == case.name && known.constants == case.constants) {
                cases.push(case);
            }
        }
    }
    cases
});

/// As the devices at hand: eight lanes in order.
const PLAIN: Manner = Manner { seed: 1, subgroup: 8, shuffled: false, contracted: false, noisy: false, flushed: false };

/// Devices that no test meets otherwise.
const MANNERS: [Manner; 5] = [
    Manner { shuffled: true, ..PLAIN },
    Manner { seed: 2, subgroup: 4, shuffled: true, ..PLAIN },
    Manner { seed: 3, subgroup: 32, shuffled: true, contracted: true, ..PLAIN },
    Manner { seed: 4, subgroup: 64, shuffled: true, flushed: true, ..PLAIN },
    Manner { seed: 5, subgroup: 16, shuffled: true, contracted: true, noisy: true, flushed: true },
];

/// What of a dispatch follows from the size of subgroups: words of a constant, workgroups in x.
fn sized(case: &Case, subgroup: u32) -> (Vec<(u32, u32)>, [u32; 3]) {
    let (mut constants, mut workgroups) = (case.constants.clone(), case.workgroups);
    let recorded = case.subgroup_size;
    // Its shared memory has room for the sums of each subgroup.
    if case.name.starts_with("render/rasterize_backward") {
        let subgroups = constants.iter_mut().find(|(number, _)| *number == 2).expect("as the source says");
        subgroups.1 = subgroups.1 * recorded / subgroup;
    }
    // It has a subgroup for each digit.
    if case.name == "primitives/sort_scan" {
        workgroups[0] = workgroups[0] * subgroup / recorded;
    }
    (constants, workgroups)
}

/// Kernels for lanes of a CPU's vectors run where subgroups have eight threads.
fn takes(case: &Case, program: &Program, subgroup: u32) -> bool {
    !program.uses_subgroups || !case.name.contains("/cpu/") || subgroup == 8
}

fn module(case: &Case) -> Module {
    rspirv::dr::load_bytes(case.spirv).expect("build.rs wrote it")
}

fn program(case: &Case, module: &Module, manner: Manner) -> Program {
    let numbers: Vec<u32> = case.bindings.iter().map(|b| b.number).collect();
    let mut random = Pcg64Mcg::seed_from_u64(manner.seed);
    let mut coin = || random.random::<bool>();
    let contract: Option<&mut dyn FnMut() -> bool> = if manner.contracted { Some(&mut coin) } else { None };
    Program::new(module, &numbers, &sized(case, manner.subgroup).0, Choices { contract })
}

/// Runs a dispatch and compares what it wrote; the number of instructions.
fn outcome(case: &Case, module: &Module, manner: Manner) -> Result<u64, String> {
    let program = program(case, module, manner);
    if !takes(case, &program, manner.subgroup) {
        return Ok(0);
    }
    let launch = Launch {
        workgroups: sized(case, manner.subgroup).1,
        push: &case.push,
        buffers: case.before.clone(),
        written: case.bindings.iter().map(|b| b.access.writes()).collect(),
    };
    let (got, instructions) = machine::run(&program, launch, manner)?;
    for (at, binding) in case.bindings.iter().enumerate().filter(|(_, b)| b.access.writes()) {
        let difference = case.difference(at, &got[at]);
        // What errs as far as Vulkan lets it may turn a decision or exceed what float32 alone explains: how far is seen where
        // nothing errs.
        if manner.noisy || manner.contracted {
            let broken = binding.scalar == Scalar::F32 && difference.broken > 0;
            if broken || !near(&difference, binding.scalar) {
                return Err(format!("{difference}"));
            }
        } else if !difference.ok() {
            return Err(format!("{difference}"));
        }
    }
    Ok(instructions)
}

/// A tensor as a whole within a hundredth of its length of its twin's; of integers, all but a hundredth.
fn near(difference: &gscream_vk::gpu::Difference, scalar: Scalar) -> bool {
    const SHARE: f64 = 0.01;
    match scalar {
        Scalar::F32 => difference.relative <= SHARE,
        _ => difference.exceeded as f64 <= SHARE * difference.components as f64,
    }
}

#[test]
fn kernels_do_on_any_device_what_their_twins_do() {
    let began = Instant::now();
    let runs: Vec<(&Case, Manner)> = CASES.iter().flat_map(|case| MANNERS.map(|manner| (case, manner))).collect();
    let found: Vec<(u64, Option<String>)> = runs
        .par_iter()
        .map(|(case, manner)| match outcome(case, &module(case), *manner) {
            Ok(instructions) => (instructions, None),
            Err(fault) => (0, Some(format!("{} {:?}, {manner:?}: {fault}", case.name, case.constants))),
        })
        .collect();
    let faults: Vec<&String> = found.iter().filter_map(|(_, fault)| fault.as_ref()).collect();
    assert!(
        faults.is_empty(),
        "{} faults:\n{}",
        faults.len(),
        faults.iter().map(|f| format!("{f}\n")).collect::<String>()
    );
    let instructions: u64 = found.iter().map(|(n, _)| n).sum();
    println!("{} dispatches, {} million instructions, {:?}", CASES.len(), instructions / 1_000_000, began.elapsed());
}

/// Kernels that no such training runs. Their own tests hold them against their twins on a device.
const ELSEWHERE: [&str; 17] = [
    // They measure a device, and nothing reads what they write.
    "lab/bench/ceilings_copy",
    "lab/bench/ceilings_empty",
    "lab/bench/ceilings_exp",
    "lab/bench/ceilings_fma",
    // `export` and pictures larger than the training's.
    "render/activate",
    "render/activate_backward",
    "render/widen",
    // Gaussians that were trained for antialiasing.
    "render/compensate",
    "render/compensate_backward",
    // Depths of several views, before a training.
    "multiview/choose",
    "multiview/propose",
    "multiview/score",
    // More candidates than a round may take, and anchors that are pruned.
    "densify/grow_lots",
    "densify/grow_words",
    "densify/prune_gather",
    // Plain Gaussians that are split.
    "densify/split_scatter",
    // Devices whose form for CPUs has no lanes.
    "model/cpu/attention_backward",
];

/// A kernel that is added is run here too.
#[test]
fn every_kernel_is_run() {
    let run: BTreeSet<&str> = CASES.iter().map(|case| case.name).collect();
    let missing = kernels().into_iter().filter(|kernel| {
        let variant = |name: &&&str| {
            name.strip_prefix(kernel.as_str()).is_some_and(|rest| rest.is_empty() || rest.starts_with('_'))
        };
        !run.iter().any(|name| variant(&name)) && !ELSEWHERE.contains(&kernel.as_str())
    });
    let missing: Vec<String> = missing.collect();
    assert!(missing.is_empty(), "no dispatch of {missing:?} is run");
}

/// `folder/stem` of every kernel's source.
fn kernels() -> Vec<String> {
    let sources = walkdir::WalkDir::new("glsl").into_iter().filter_map(Result::ok);
    let kernel = |entry: walkdir::DirEntry| {
        let path = entry.path().strip_prefix("glsl").ok()?.with_extension("");
        (entry.path().extension()? == "comp").then(|| path.to_string_lossy().replace('\\', "/"))
    };
    sources.filter_map(kernel).collect()
}

/// Each planted fault is found in one of the manners, and the module as it is passes in all of them.
#[test]
fn planted_faults_are_found() {
    let mut missed: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for fault in faults::ALL {
        let cases: Vec<&Case> = CASES.iter().filter(|case| fault.kernels.contains(&case.name)).collect();
        assert!(!cases.is_empty(), "{}: none of {:?} is run", fault.name, fault.kernels);
        let mut planted = 0;
        for case in cases {
            let mut broken = module(case);
            if !(fault.plant)(&mut broken) {
                continue;
            }
            planted += 1;
            // The first manner that finds it is enough.
            let mut found = MANNERS.iter().filter_map(|manner| outcome(case, &broken, *manner).err());
            match found.find(|said| said.contains(fault.said)) {
                Some(said) => println!("{}, {}: {said}", fault.name, case.name),
                None => missed.entry(fault.name).or_default().push(case.name),
            }
        }
        assert!(planted > 0, "{}: no place for it in {:?}", fault.name, fault.kernels);
    }
    assert!(missed.is_empty(), "not found: {missed:?}");
}
