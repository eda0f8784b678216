//! Stiff and extreme cases: what is guaranteed where float32 is under strain, and the test that it holds.
//!
//! Each case states its guarantee in words; `run` fails where it does not hold. The table of all of them is a golden file
//! (`tests/snapshots/extreme__guarantees.snap`), so that a weaker guarantee is a line of a diff.

mod attention;
#[allow(dead_code)]
#[path = "../common/mod.rs"]
mod common;
mod decode;
mod densify;
mod inputs;
mod long;
mod losses;
mod optimizer;
mod picture;
mod poison;
mod primitives;
mod project;
mod screen;

use gscream_vk::gpu::{Form, Gpu, Options, testing};
use libtest_mimic::{Arguments, Trial};

/// A case and what is guaranteed for it.
pub struct Case {
    /// Stage or command.
    pub stage: &'static str,
    /// What is extreme.
    pub case: &'static str,
    /// What holds all the same: finite, within a bound that is derived in the source, or refused in these words.
    pub guarantee: &'static str,
    /// Panics where the guarantee does not hold.
    pub run: fn(&Gpu),
}

/// Every case.
fn cases() -> Vec<&'static Case> {
    let stages: [&[Case]; 12] = [
        project::CASES,
        screen::CASES,
        decode::CASES,
        picture::CASES,
        losses::CASES,
        attention::CASES,
        optimizer::CASES,
        densify::CASES,
        primitives::CASES,
        inputs::CASES,
        poison::CASES,
        long::CASES,
    ];
    stages.into_iter().flatten().collect()
}

/// Stages whose work takes another form on a GPU.
const FORMED: [&str; 5] = ["attention", "bin", "bin, rasterize", "cull to decode_backward", "decode"];

fn table(cases: &[&Case]) -> String {
    let mut text = String::from("| stage | case | guarantee |\n| --- | --- | --- |\n");
    for Case { stage, case, guarantee, .. } in cases {
        text.push_str(&format!("| {stage} | {case} | {guarantee} |\n"));
    }
    text
}

fn main() {
    let arguments = Arguments::from_args();
    let cases = cases();
    let guarantees = table(&cases);
    let trial = |case: &'static Case, form: Option<Form>| {
        let name = format!("{}: {}{}", case.stage, case.case, form.map_or("", |_| " (form of GPUs)"));
        let trial = Trial::test(name, move || {
            let gpu = testing::gpu_with(Options { form, ..Options::default() });
            (case.run)(&gpu);
            Ok(())
        });
        // Minutes: `.ci/run` has it.
        trial.with_ignored_flag(long::CASES.iter().any(|long| long.case == case.case))
    };
    let mut trials: Vec<Trial> = cases.iter().map(|case| trial(case, None)).collect();
    // On a CPU driver, what has a form for GPUs is tried in that form, too.
    let formed = cases.iter().filter(|case| FORMED.contains(&case.stage));
    trials.extend(formed.map(|case| trial(case, Some(Form::Gpu))));
    trials.push(Trial::test("guarantees", move || {
        insta::with_settings!({snapshot_path => "../snapshots", prepend_module_to_snapshot => false}, {
            insta::assert_snapshot!("extreme__guarantees", guarantees);
        });
        Ok(())
    }));
    libtest_mimic::run(&arguments, trials).exit();
}
