//! What is not a number, put into the model and the optimiser's state.

use gscream_vk::gpu::{Buffer, Gpu};
use gscream_vk::train::run::Run;

use super::{Case, common};

pub const CASES: &[Case] = &[Case { stage: "train", case: "explore", guarantee: "explore", run: explore }];

fn tensors<'a>(run: &'a Run<'_>) -> Vec<(&'static str, Buffer<f32>, usize)> {
    let step = run.step();
    let mut all = vec![("position", step.anchors.position.view(), 3)];
    for (name, p) in ["feature", "offset", "log_scaling"].into_iter().zip(step.anchors.parameters()) {
        let names: [&'static str; 3] = match name {
            "feature" => ["feature", "feature first", "feature root"],
            "offset" => ["offset", "offset first", "offset root"],
            _ => ["log_scaling", "log_scaling first", "log_scaling root"],
        };
        for (name, t) in names.into_iter().zip(p.tensors()) {
            all.push((name, t.view(), p.width as usize));
        }
    }
    for (name, t) in ["weights", "weights first", "weights root"].into_iter().zip(step.weights.tensors()) {
        all.push((name, t.view(), 1));
    }
    all
}

fn explore(gpu: &Gpu) {
    let scene = common::tiny();
    let settings = common::settings(20);
    let which = tensors(&Run::new(gpu, &scene, &settings).expect("room")).len();
    for t in 0..which {
        for poison in [f32::NAN, f32::INFINITY, 3e38] {
            let mut run = Run::new(gpu, &scene, &settings).expect("room");
            for s in 1..=2 {
                run.run_one(s).expect("runs");
            }
            let all = tensors(&run);
            let (name, buffer, width) = &all[t];
            let mut data = gpu.read(buffer).expect("read");
            let n = run.step().anchors.count as usize;
            let at = if *width == 1 { 40 } else { (n / 2) * width };
            for v in &mut data[at..at + width] {
                *v = poison;
            }
            gpu.write(buffer, &data).expect("write");
            drop(all);
            let size = run.step().plan.sizes[0];
            for s in 3..=5 {
                run.run_one(s).expect("runs");
                let terms = gpu.read(run.step().terms(size)).expect("read");
                let bad: Vec<String> = tensors(&run)
                    .iter()
                    .map(|(name, b, width)| {
                        let used = if *width == 1 { b.len() } else { n * width };
                        let bad = gpu.read_range(b, used).expect("read").iter().filter(|v| !v.is_finite()).count();
                        (name, bad, used)
                    })
                    .filter(|(_, bad, _)| *bad > 0)
                    .map(|(name, bad, n)| format!("{name} {bad}/{n}"))
                    .collect();
                println!("{} = {poison}: step {s}: {terms:?} {bad:?}", name_of(t));
            }
        }
    }
}

fn name_of(t: usize) -> &'static str {
    [
        "position", "feature", "feature first", "feature root", "offset", "offset first", "offset root", "log_scaling",
        "log_scaling first", "log_scaling root", "weights", "weights first", "weights root",
    ][t]
}
