//! A driver that fails: of every call that can fail some fail, one in each start of the program, and it ends with one
//! sentence, with nothing left on the device and its last checkpoint whole.
#![cfg(target_os = "linux")]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{LazyLock, Mutex};

use gscream_vk::train::checkpoint;
use rayon::iter::{IntoParallelIterator as _, IntoParallelRefIterator as _, ParallelIterator as _};
use safetensors::SafeTensors;

use crate::common;
use crate::common::place::{Files, Place, assert_same, library, output, text};

const HOST_MEMORY: i32 = -1;
const DEVICE_MEMORY: i32 = -2;
const INITIALISATION: i32 = -3;
const LOST: i32 = -4;
const MAP: i32 = -5;
const FRAGMENTED_POOL: i32 = -12;
const POOL_MEMORY: i32 = -1_000_069_000;

const CREATE: &str = "vkCreateBuffer";
/// Buffers of a round of growth that cannot be made.
const MOMENTS: usize = 8;

/// What the first, the middle and the last call of a name are answered with.
fn answers(call: &str) -> [i32; 3] {
    match call {
        "vkCreateInstance" | "vkCreateDevice" => [INITIALISATION; 3],
        "vkEnumeratePhysicalDevices" => [INITIALISATION, HOST_MEMORY, INITIALISATION],
        "vkMapMemory" => [MAP, HOST_MEMORY, DEVICE_MEMORY],
        "vkAllocateDescriptorSets" => [POOL_MEMORY, FRAGMENTED_POOL, DEVICE_MEMORY],
        "vkQueueSubmit2" | "vkWaitForFences" | "vkGetQueryPoolResults" => [HOST_MEMORY, LOST, DEVICE_MEMORY],
        "vkDeviceWaitIdle" => [LOST; 3],
        _ => [DEVICE_MEMORY, HOST_MEMORY, DEVICE_MEMORY],
    }
}

/// Calls that the program or its loader does without.
const SPARE: [&str; 4] =
    ["vkCreatePipelineCache", "vkDeviceWaitIdle", "vkGetPipelineCacheData", "vkSetDebugUtilsObjectNameEXT"];

/// A call that fails; none without a name.
#[derive(Clone, Debug, Default)]
struct Fault {
    call: String,
    at: usize,
    result: i32,
    /// Those behind it fail as well.
    ever: bool,
    /// Every buffer gets memory of its own.
    alone: bool,
}

/// `common/failing_driver.rs`, compiled.
static LIBRARY: LazyLock<Option<PathBuf>> = LazyLock::new(|| library("failing_driver"));

/// A place whose programs meet a driver that fails, under the validation layer.
struct Driver {
    place: Place,
    /// Tensors of the checkpoints so far, by step.
    kept: Mutex<BTreeMap<u32, Files>>,
}

/// What a start came to.
struct Ended {
    output: Output,
    /// Names of calls and of passes, in their order.
    trace: Vec<String>,
    /// What the validation layer said.
    said: String,
}

impl Ended {
    fn count(&self, name: &str) -> usize {
        self.trace.iter().filter(|traced| *traced == name).count()
    }
}

impl Driver {
    fn new() -> Option<Self> {
        let library = LIBRARY.as_deref()?;
        // Growth behind step 4 alone.
        let mut settings = common::settings(6);
        settings.densify.until = 5;
        (settings.train.checkpoint_interval, settings.train.eval_interval, settings.train.log_interval) = (3, 5, 3);
        let place = Place::new(&settings);
        let layer = serde_json::json!({
            "file_format_version": "1.1.0",
            "layer": {
                "name": "VK_LAYER_failing_driver",
                "type": "INSTANCE",
                "library_path": library,
                "api_version": "1.3.0",
                "implementation_version": "1",
                "description": "a driver that fails",
                "functions": {
                    "vkGetInstanceProcAddr": "failing_instance_function",
                    "vkGetDeviceProcAddr": "failing_device_function",
                },
            },
        });
        fs::write(place.path().join("layer.json"), layer.to_string()).expect("writable");
        Some(Self { place, kept: Mutex::default() })
    }

    /// The training, with all calls that are there only where they are asked for.
    fn train(&self, run: &str, fault: &Fault) -> Ended {
        let more = ["--validate", "--profile", "--descriptors", "sets"];
        self.start(self.place.train(run, &more), run, fault)
    }

    fn start(&self, mut command: Command, name: &str, fault: &Fault) -> Ended {
        let of = |what: &str| self.place.path().join(format!("{name}.{what}"));
        let [layers, said, trace] = ["layers", "said", "trace"].map(of);
        let lines = [
            "debug_action = VK_DBG_LAYER_ACTION_LOG_MSG",
            "report_flags = error,warn",
            &format!("log_filename = {}", said.display()),
        ];
        fs::write(&layers, lines.map(|line| format!("khronos_validation.{line}\n")).concat()).expect("writable");
        command.env("VK_ADD_LAYER_PATH", self.place.path()).env("VK_INSTANCE_LAYERS", "VK_LAYER_failing_driver");
        command.env("VK_LAYER_SETTINGS_PATH", layers).env("FAULT_TRACE", &trace);
        command.env("FAULT_CALL", &fault.call).env("FAULT_AT", fault.at.to_string());
        command.env("FAULT_RESULT", fault.result.to_string());
        for (variable, set) in [("FAULT_EVER", fault.ever), ("FAULT_ALONE", fault.alone)] {
            if set {
                command.env(variable, "1");
            }
        }
        // Mesa's layer that sorts devices reads a list that it was refused.
        command.env("NODEVICE_SELECT", "1");
        let output = output(command);
        let read = |path: &Path| fs::read_to_string(path).unwrap_or_default();
        Ended { output, trace: read(&trace).lines().map(str::to_owned).collect(), said: read(&said) }
    }

    /// What a run has come to, but for its times.
    fn made(&self, run: &str) -> Files {
        let mut files = self.place.result(run);
        files.retain(|(name, _)| name != "trace.json");
        files
    }

    /// A run in which nothing fails, and what it comes to.
    fn whole(&self, alone: bool) -> (Ended, Files) {
        let run = format!("whole{}", u32::from(alone));
        let ended = self.train(&run, &Fault { alone, ..Fault::default() });
        assert_clean(&ended, &Fault::default());
        assert!(ended.output.status.success());
        (ended, self.made(&run))
    }

    /// Trains with this fault, and goes on from where the training ended. Whether it ended early.
    fn survives(&self, fault: &Fault, whole: &Files, resumes: bool) -> bool {
        let run = format!("{}-{}-{}", fault.call, fault.at, u32::from(fault.alone));
        let ended = self.train(&run, fault);
        assert_clean(&ended, fault);
        if ended.output.status.success() {
            assert_same(&self.made(&run), whole, &format!("{fault:?}"));
            return false;
        }
        let Some((step, path)) = checkpoint::list(&self.place.path().join(&run)).into_iter().next() else {
            return true;
        };
        let stderr = text(&ended.output.stderr);
        assert!(stderr.contains(&format!("gscream-vk train --resume {run}")), "{fault:?}: {stderr}");
        let tensors = tensors(&path);
        let known = self.kept.lock().expect("a test failed").get(&step).cloned();
        assert_same(&tensors, known.as_ref().unwrap_or(&tensors), &format!("{fault:?}, step {step}"));
        // A checkpoint that is another's is whole as that one is.
        if resumes || known.is_none() {
            let on = Fault { alone: fault.alone, ..Fault::default() };
            let resumed = self.start(self.place.resume(&run), &format!("{run}.resumed"), &on);
            assert!(resumed.output.status.success(), "{fault:?}: {}", text(&resumed.output.stderr));
            assert_same(&self.made(&run), whole, &format!("{fault:?}, gone on behind step {step}"));
            self.kept.lock().expect("a test failed").insert(step, tensors);
        }
        true
    }
}

/// A checkpoint's tensors but for the log, which has times.
fn tensors(path: &Path) -> Files {
    let bytes = fs::read(path).expect("readable");
    let read = SafeTensors::deserialize(&bytes).expect("a whole file");
    let named = read.iter().filter(|(name, _)| *name != "log");
    let mut tensors: Files = named.map(|(name, view)| (name.to_owned(), view.data().to_vec())).collect();
    tensors.sort();
    tensors
}

/// The program has ended by itself, with one sentence if it failed; all that it made on the device is gone, and the
/// validation layer has seen nothing amiss.
fn assert_clean(ended: &Ended, fault: &Fault) {
    let stderr = text(&ended.output.stderr);
    assert!(ended.count(&fault.call) >= fault.at, "{fault:?}: was not reached");
    assert!(ended.said.is_empty(), "{fault:?}: {stderr}{}", ended.said);
    for object in ["Instance", "Device"] {
        let create = format!("vkCreate{object}");
        let made = ended.count(&create) - usize::from(fault.call == create);
        assert_eq!(ended.count(&format!("vkDestroy{object}")), made, "{fault:?}: {object}");
    }
    if !ended.output.status.success() {
        assert_eq!(ended.output.status.code(), Some(1), "{fault:?}: {stderr}");
        assert!(!stderr.contains("panicked"), "{fault:?}: {stderr}");
        let errors = stderr.lines().filter(|line| line.contains("error: ")).count();
        let last = stderr.lines().last().unwrap_or_default();
        assert!(errors == 1 && last.starts_with("error: "), "{fault:?}: {stderr}");
    }
}

/// Faults at the first, the middle and the last call of each name of a trace.
fn faults(trace: &[String]) -> Vec<Fault> {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    for call in trace.iter().filter(|name| name.starts_with("vk") && !name.starts_with("vkDestroy")) {
        *counts.entry(call).or_default() += 1;
    }
    let mut faults = vec![];
    for (call, count) in counts {
        let places = BTreeSet::from([1, count.div_ceil(2), count]);
        for (at, result) in places.into_iter().zip(answers(call)) {
            faults.push(Fault { call: call.to_owned(), at, result, ..Fault::default() });
        }
    }
    faults
}

#[test]
fn a_training_at_each_call_that_fails() {
    let Some(driver) = Driver::new() else { return };
    let (ended, whole) = driver.whole(false);
    let mut faults = faults(&ended.trace);
    // What may run still is neither used nor freed, and gone in the end.
    for call in ["vkQueueSubmit2", "vkResetFences", "vkWaitForFences"] {
        let at = ended.count(call) / 2;
        faults.push(Fault { call: call.to_owned(), at, result: HOST_MEMORY, ever: true, alone: false });
    }
    let early: Vec<bool> =
        faults.par_iter().map(|fault| driver.survives(fault, &whole, fault.result == LOST)).collect();
    let names = |stopped: bool| -> BTreeSet<&str> {
        faults
            .iter()
            .zip(&early)
            .filter(|(_, early)| **early == stopped)
            .map(|(fault, _)| fault.call.as_str())
            .collect()
    };
    let spared: Vec<&str> = names(false).difference(&names(true)).copied().collect();
    assert_eq!(spared, SPARE, "all other failures end the training");
    println!("{} failures of {} calls", faults.len(), names(true).len() + spared.len());
}

#[test]
fn a_round_of_growth_at_buffers_that_cannot_be_made() {
    let Some(driver) = Driver::new() else { return };
    let (Ended { trace, .. }, whole) = driver.whole(true);
    let count = |trace: &[String], call: &str| trace.iter().filter(|name| *name == call).count();
    let grows = |name: &String| name.starts_with("densify/grow");
    let first = trace.iter().position(grows).expect("anchors grow");
    let last = trace.iter().rposition(grows).expect("anchors grow");
    let next = last + trace[last..].iter().position(|name| name.starts_with("render/")).expect("a step follows");
    let round = &trace[first..next];
    let (before, within) = (count(&trace[..first], CREATE), count(round, CREATE));
    assert!(within > 100, "{within} buffers");
    // Those of the device have memory that others have left; what the host writes and reads is small, and shares blocks
    // where not every buffer is alone.
    let allocations = count(round, "vkAllocateMemory");
    assert!(allocations <= 30, "{allocations} allocations for {within} buffers");
    // The candidates of all levels, the free cells of each of three, what grows, who is pruned, and what is left.
    let submissions = count(round, "vkQueueSubmit2");
    assert!(submissions <= 7, "{submissions} submissions");
    let fault = |moment: usize| {
        let at = before + 1 + moment * (within - 1) / (MOMENTS - 1);
        let result = [DEVICE_MEMORY, HOST_MEMORY][moment % 2];
        Fault { call: CREATE.to_owned(), at, result, alone: true, ..Fault::default() }
    };
    let early = (0..MOMENTS).into_par_iter().filter(|&moment| driver.survives(&fault(moment), &whole, true)).count();
    assert_eq!(early, MOMENTS, "each failure ends the training");
}

/// The rows that decide are read, halves are put into their places, and the lists of the stages are made anew.
#[test]
fn a_round_of_plain_gaussians_waits_three_times() {
    let Some(driver) = Driver::new() else { return };
    let more = ["--profile", "--set", "model.form=gaussians", "--set", "model.attention.enabled=false"];
    let ended = driver.start(driver.place.train("gaussians", &more), "gaussians", &Fault::default());
    assert_clean(&ended, &Fault::default());
    assert!(ended.output.status.success(), "{}", text(&ended.output.stderr));
    let trace = &ended.trace;
    let splits = |name: &String| name.starts_with("densify/");
    let first = trace.iter().position(splits).expect("Gaussians are split");
    let last = trace[..first].iter().rposition(|name| name.starts_with("optimizer/")).expect("a step went before");
    let renders = |name: &String| name.starts_with("render/");
    let next = first + trace[first..].iter().position(renders).expect("a step follows");
    let round = &trace[last..next];
    for call in ["vkQueueSubmit2", "vkWaitForFences"] {
        let times = round.iter().filter(|name| *name == call).count();
        assert_eq!(times, 4, "{call}: that of the step before and three of the round: {round:#?}");
    }
}

/// A recording that runs pass by pass goes through the rest of the step when one of its submissions has failed.
#[test]
fn a_comparison_at_calls_that_fail() {
    let Some(driver) = Driver::new() else { return };
    let verify = |fault: &Fault| {
        let command = driver.place.program(&["verify", "scene", "--config", "settings.toml", "--validate"]);
        let ended = driver.start(command, &format!("{}-{}", fault.call, fault.at), fault);
        assert_clean(&ended, fault);
        ended
    };
    let whole = verify(&Fault::default());
    assert!(whole.output.status.success());
    // A pass, what it is compared with, and the fill behind it.
    let middle = whole.trace.len() / 2;
    let fill = middle + whole.trace[middle..].iter().position(|name| name == "fill").expect("a step fills buffers");
    let fault = |(call, back): (&str, usize)| {
        let at = whole.trace[..fill].iter().filter(|name| *name == call).count() - back;
        Fault { call: call.to_owned(), at, result: HOST_MEMORY, ..Fault::default() }
    };
    let calls = ["vkBeginCommandBuffer", "vkQueueSubmit2"].map(|call| (0..6).map(move |back| (call, back)));
    calls.into_iter().flatten().collect::<Vec<_>>().into_par_iter().map(fault).for_each(|fault| {
        assert!(!verify(&fault).output.status.success(), "{fault:?}");
    });
}
