//! The passes and barriers of a step, as a text whose every line is meant.
//!
//! A barrier that is lost or added is a line of the difference. `INSTA_UPDATE=always cargo test --test suite schedule` takes
//! the new text; look at the difference before committing it.

use crate::common;
use crate::common::skip::{Lack, skip};
use gscream_vk::gpu::{Command, Entry, Form, Gpu, testing};
use gscream_vk::render::tiling::Tiling;
use gscream_vk::scene::Scene;
use gscream_vk::train::run::Run;

fn schedule(gpu: &Gpu, scene: &Scene, step: u32) -> String {
    let settings = common::settings(20);
    let mut run = Run::new(gpu, scene, &settings).expect("the device has room");
    let mut rec = gpu.recorder().expect("a recorder");
    let view = run.record(&mut rec, step).expect("the device has room");
    let schedule = rec.schedule();
    format!("step {step}, {view}: {} passes, {} barriers\n{schedule}", schedule.passes(), schedule.barriers())
}

#[test]
fn passes_and_barriers_of_a_step() {
    for gpu in testing::gpu_in_both_forms() {
        let form = match gpu.form() {
            Form::Gpu => "gpu",
            Form::Cpu if Tiling::of(&gpu) == Tiling::Narrow => "subgroups_of_8",
            Form::Cpu => {
                let size = gpu.info().subgroup_size;
                let why =
                    format!("the CPU's schedules kept here are those of subgroups of 8, and this device has {size}");
                skip(Lack::SubgroupsOf8, &why);
                continue;
            }
        };
        schedules(&gpu, form);
    }
}

fn schedules(gpu: &Gpu, form: &str) {
    let whole = common::tiny();
    let bare = {
        let mut scene = whole.clone();
        scene.references.clear();
        scene.train.iter_mut().for_each(|view| (view.mask, view.prior) = (None, None));
        scene
    };
    for (name, scene, step) in [
        // Another view than the reference, before statistics and attention.
        ("first", &whole, 1),
        // The reference view, with both.
        ("reference", &whole, 4),
        // Another view, with both.
        ("later", &whole, 5),
        // Photographs alone, with statistics.
        ("bare", &bare, 4),
    ] {
        insta::assert_snapshot!(format!("{name}_{form}"), schedule(gpu, scene, step));
    }
}

/// Nothing that costs the device anything is in no schedule: no fill between passes, no barrier that no hazard demands.
#[test]
fn the_device_is_given_what_the_schedule_says() {
    for gpu in testing::gpu_in_both_forms() {
        let (scene, settings) = (common::tiny(), common::settings(20));
        let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
        for step in [1, 4, 5] {
            let mut rec = gpu.recorder().expect("a recorder");
            run.record(&mut rec, step).expect("the device has room");
            let mut submission = rec.submit().expect("the device takes it");
            let scheduled = std::mem::take(&mut submission.schedule).entries.into_iter().map(|entry| match entry {
                Entry::Barrier { .. } => Command::Barrier,
                Entry::Pass { name: "fill", .. } => Command::Fill,
                Entry::Pass { name: "copy", .. } => Command::Copy,
                Entry::Pass { .. } => Command::Dispatch,
            });
            // What came before is waited for, and the host waits for what is in here.
            let around = || std::iter::once(Command::Barrier);
            let wanted: Vec<Command> = around().chain(scheduled).chain(around()).collect();
            assert!(wanted.len() > 80, "step {step}: {} commands", wanted.len());
            assert_eq!(submission.commands, wanted, "step {step}");
            submission.wait().expect("the device runs it");
        }
    }
}
