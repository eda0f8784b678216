//! The passes and barriers of a step, as a text whose every line is meant.
//!
//! A barrier that is lost or added is a line of the difference. `INSTA_UPDATE=always cargo test --test schedule` takes
//! the new text; look at the difference before committing it.

#[allow(dead_code)]
mod common;

use gscream_vk::gpu::{Gpu, testing};
use gscream_vk::render::bin::Tiling;
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
    let gpu = testing::gpu();
    // Kernels come in a narrow form for subgroups of 8, with tiles of their own; other sizes share one schedule.
    let narrow = Tiling::of(gpu.info().subgroup_size) == Tiling::of(8);
    let form = if narrow { "subgroups_of_8" } else { "other_subgroups" };
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
        insta::assert_snapshot!(format!("{name}_{form}"), schedule(&gpu, scene, step));
    }
}
