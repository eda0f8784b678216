use std::collections::BTreeSet;
use std::path::Path;

use super::ceilings::Ceilings;
use super::compare::{self, Subject};
use super::cost;
use super::counts::Counts;
use super::step::{Bound, HostFigures, PassFigures, StepFigures, floor};
use super::{Device, Record};
use crate::lab::statistics::Spread;

/// Kernels that are no part of a step: growing and pruning, what comes before training or after it, and what measures.
const NO_STEP: [&str; 5] = ["densify/grow", "densify/prune", "densify/split", "multiview/", "lab/bench/"];

/// Every kernel with its variants, from the sources.
fn kernels() -> BTreeSet<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("glsl");
    let mut names = BTreeSet::new();
    for entry in walkdir::WalkDir::new(&root) {
        let path = entry.expect("readable").into_path();
        if path.extension().is_none_or(|e| e != "comp") {
            continue;
        }
        let name = path.strip_prefix(&root).expect("inside").with_extension("");
        let name = name.to_string_lossy().replace('\\', "/");
        let source = std::fs::read_to_string(&path).expect("readable");
        let variants = source.lines().filter_map(|line| line.strip_prefix("// variant ")?.split_once(':'));
        names.extend(variants.map(|(variant, _)| format!("{name}_{}", variant.trim())));
        names.insert(name);
    }
    names
}

#[test]
fn every_kernel_of_a_step_has_a_formula() {
    let all = kernels();
    assert!(all.len() > 80, "{} kernels: is this the right folder?", all.len());
    let of_a_step = |name: &&String| !NO_STEP.iter().any(|p| name.starts_with(p));
    let without: Vec<&String> = all.iter().filter(of_a_step).filter(|name| cost::formula(name).is_none()).collect();
    assert!(without.is_empty(), "no formula in src/lab/bench/cost.rs for {without:?}");
    // And no formula for what there is not.
    for formula in cost::all().filter(|f| !["fill", "copy"].contains(&f.pass)) {
        assert!(all.contains(formula.pass), "{} is no kernel", formula.pass);
        for variant in formula.variants {
            assert!(all.contains(&format!("{}_{variant}", formula.pass)), "{} has no variant {variant}", formula.pass);
        }
        assert!(!formula.derivation.is_empty());
    }
    assert!(cost::formula("render/decode_backward_fused").is_none(), "a new kernel needs a line of its own");
}

/// A record of made-up numbers.
pub(super) fn record() -> Record {
    let spread = |median: f64| Spread::of(&[0.9 * median, median, 1.2 * median]);
    let ceilings = Ceilings {
        copy_f32: spread(2.0),
        copy_vec4: spread(3.0),
        copy_cached: spread(4.0),
        fma: spread(10.0),
        exp: spread(2.5),
        dispatch: spread(10.0),
        spacing: spread(12.0),
        barrier: spread(1.0),
    };
    let work = cost::Work { bytes: 8e6, operations: 1e6, exponentials: 0.0 };
    let (floor, bound) = floor(&work, 1.0, &ceilings.rates());
    let pass = |name: &str, ms: f64| PassFigures {
        pass: name.into(),
        dispatches: 1.0,
        milliseconds: spread(ms),
        work: Some(work),
        floor: Some(floor),
        bound: Some(bound),
        ratio: Some(ms / floor),
        best_ratio: Some(0.9 * ms / floor),
    };
    let step = StepFigures {
        step: 51,
        views: vec!["a".into(), "b".into()],
        repetitions: 3,
        counts: Counts { pairs: 1e4, samples: 64e4, blended: 16e4, ..Counts::default() },
        passes: vec![
            pass("render/cpu/rasterize_backward", 8.0),
            pass("optimizer/adam", 4.0),
            PassFigures { work: None, floor: None, bound: None, ratio: None, ..pass("render/unheard_of", 1.0) },
        ],
        barriers: 2.0,
        between: spread(0.5),
        between_floor: 0.002,
        total: spread(13.5),
        total_floor: 2.0 * floor + 0.002,
        device_bytes: 1 << 20,
        host: HostFigures { recording: spread(0.2), submission: spread(0.1), waiting: spread(13.6) },
    };
    Record {
        version: "0".into(),
        command: "gscream-vk bench scene".into(),
        device: Device {
            name: "device".into(),
            kind: "cpu".into(),
            driver: "driver 1".into(),
            subgroup_size: 8,
            max_binding_bytes: 1 << 27,
        },
        settings: serde_json::json!({ "render": { "near": 0.2, "tiles": "auto" }, "epsilon": 1e-15 }),
        scene: crate::lab::report::SceneFacts {
            name: "scene".into(),
            train_views: 3,
            test_views: 0,
            size: [64, 48],
            points: 100,
            masks: 3,
            priors: 0,
            references: 1,
        },
        warm_up: 50,
        ceilings,
        step,
        predictions: vec![],
    }
}

#[test]
fn floors_are_the_longest_of_three() {
    let ceilings = record().ceilings;
    let of = |bytes, operations, exponentials| {
        floor(&cost::Work { bytes, operations, exponentials }, 2.0, &ceilings.rates())
    };
    // The best: 4.8 GB/s, 12 G/s, 3 G/s; two dispatches of 9 us.
    let close =
        |(ms, by): (f64, Bound), want: f64, bound| assert!((ms - want).abs() < 1e-9 && by == bound, "{ms} {by:?}");
    close(of(9.6e6, 1e6, 1e5), 2.018, Bound::Memory);
    close(of(9.6e6, 36e6, 1e5), 3.018, Bound::Operations);
    close(of(9.6e6, 36e6, 12e6), 4.018, Bound::Exponentials);
    close(of(96.0, 6.0, 0.0), 0.018_02, Bound::Dispatch);
    close(of(0.0, 0.0, 0.0), 0.018, Bound::Dispatch);
}

/// Written and read again a record is the same, but for the last place of a number at times.
#[test]
fn records_survive_json() {
    let record = record();
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("bench.json");
    std::fs::write(&path, record.to_json()).expect("writable");
    let read = compare::read(&path).expect("a record");
    let again = |r: &Record| serde_json::from_str::<Record>(&r.to_json()).expect("a record");
    assert_eq!(again(&read), again(&record));
    assert_eq!(read.step.passes.len(), 3);
    let medians = |r: &Record| r.step.passes.iter().map(|p| p.milliseconds.median).collect();
    let (a, b): (Vec<f64>, Vec<f64>) = (medians(&read), medians(&record));
    assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() <= 1e-12 * b), "{a:?} {b:?}");

    std::fs::write(&path, "{}").expect("writable");
    let says = compare::read(&path).expect_err("no record").to_string();
    assert!(says.contains("bench.json: is no record of `bench` (missing field"), "{says}");
    let says = compare::read(&folder.path().join("none.json")).expect_err("no file").to_string();
    assert!(says.contains("none.json: cannot be read: "), "{says}");
}

#[test]
fn other_subjects_are_refused() {
    let old = record();
    let subject = |r: &Record, check: &dyn Fn(Result<Vec<String>, compare::Error>)| {
        let subject = Subject {
            device: &r.device,
            scene: &r.scene,
            settings: &r.settings,
            warm_up: r.warm_up,
            step: r.step.step,
        };
        check(compare::ensure_comparable(Path::new("old.json"), &old, subject));
    };
    subject(&old, &|result| assert_eq!(result.expect("the same"), Vec::<String>::new()));
    let refused = |change: &dyn Fn(&mut Record), words: &str| {
        let mut new = record();
        change(&mut new);
        subject(&new, &|result| {
            let says = result.expect_err(words).to_string();
            assert!(says.starts_with("old.json: was measured ") && says.contains(words), "{says}");
        });
    };
    refused(&|r| r.device.name = "another".into(), "on device, this run is on another:");
    refused(&|r| r.scene.size = [32, 24], "on scene (64 x 48, ");
    refused(
        &|r| r.settings["render"]["tiles"] = "wide".into(),
        "with render.tiles = \"auto\", this run is with render.tiles = \"wide\"",
    );
    refused(&|r| r.warm_up = 60, "at step 51 behind 50 steps of warm-up, this run is at step 51 behind 60");
    let marked = |change: &dyn Fn(&mut Record), words: &str| {
        let mut new = record();
        change(&mut new);
        subject(&new, &|result| assert_eq!(result.expect("comparable"), [words]));
    };
    marked(&|r| r.device.driver = "driver 2".into(), "the driver was driver 1, and is driver 2 now");
    // A number that was read as its neighbour is the same.
    let mut neighbour = record();
    neighbour.settings["epsilon"] = (1e-15 * (1.0 + 4e-16)).into();
    assert_ne!(neighbour.settings, old.settings);
    subject(&neighbour, &|result| assert_eq!(result.expect("the same"), Vec::<String>::new()));
    marked(&|r| r.settings["fresh"] = 1.into(), "settings that only one of the two has: fresh");
}

#[test]
fn changes_and_their_ranges() {
    let old = record();
    let mut new = record();
    new.step.passes[0].milliseconds = Spread::of(&[3.9, 4.0, 4.4]);
    new.step.passes[2].pass = "render/fused".into();
    let comparison = compare::compare(&old, &new, vec!["so".into()]);
    let change = |name: &str| comparison.passes.iter().find(|c| c.name == name).expect("compared").clone();
    let raster = change("render/cpu/rasterize_backward");
    assert_eq!((raster.old, raster.new, raster.ratio), (Some(8.0), Some(4.0), Some(0.5)));
    // Quartiles of 7.2, 8, 9.6: 7.6 and 8.8; of 3.9, 4, 4.4: 3.95 and 4.2.
    let [low, high] = raster.range.expect("a range");
    assert!((low - 3.95 / 8.8).abs() < 1e-12 && (high - 4.2 / 7.6).abs() < 1e-12, "{low} {high}");
    assert_eq!((change("render/fused").old, change("render/unheard_of").new), (None, None));
    assert!(comparison.whole.iter().all(|c| c.ratio == Some(1.0)));
    assert_eq!(comparison.passes[0].name, raster.name, "what costs most comes first");
    let text = comparison.to_string();
    assert!(text.starts_with("note: so\n") && text.contains("render/fused"), "{text}");
}

#[test]
fn a_record_as_text() {
    insta::assert_snapshot!(super::text::record(&record()));
}
