//! What is not a number, put into the model and the optimiser's state.

use std::collections::BTreeSet;

use gscream_vk::config::Settings;
use gscream_vk::gpu::{Buffer, Gpu};
use gscream_vk::math::decoder::Layout;
use gscream_vk::scene::Scene;
use gscream_vk::train::run::{Run, Silent};

use super::{Case, common};

pub const CASES: &[Case] = &[
    Case {
        stage: "train: anchors",
        case: "an anchor's position, feature, offsets or log-scales not a number or infinite",
        guarantee: "a Gaussian whose place or extent is lost is not drawn: picture, depth and loss are, bit for bit, those without the anchor (a lost feature may be drawn as one of 0); the loss does not tell, the parameters stay lost for the sentinel to find; no index from them, no hang",
        run: anchors,
    },
    Case {
        stage: "train: decoders",
        case: "a weight of any decoder's tensors not a number or infinite",
        guarantee: "the step ends; a colour that is lost loses the picture and the loss with it, else both are finite; the weight stays lost",
        run: decoders,
    },
    Case {
        stage: "train: optimiser's state",
        case: "a moment of any parameter not a number or infinite",
        guarantee: "the element it belongs to is lost with the next step, and no other differs in a bit: a lost moment never looks whole again",
        run: moments,
    },
    Case {
        stage: "train",
        case: "lost anchors, weights and moments through statistics, attention, growing and pruning",
        guarantee: "every step ends, or the run ends with one sentence; no more anchors than without, nothing from the validation layer",
        run: whole_run,
    },
];

/// NaN with a payload, as any arithmetic may leave it, and the infinities.
const POISONS: [f32; 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

struct Setup {
    scene: Scene,
    settings: Settings,
}

impl Setup {
    fn new() -> Self {
        let mut scene = common::tiny();
        scene.test.clear();
        // What the device makes of it, not what the sentinel does about it: that is in tests/resume.rs.
        let mut settings = common::settings(13);
        settings.train.sentinel_interval = 0;
        Self { scene, settings }
    }

    fn run<'a>(&'a self, gpu: &'a Gpu) -> Run<'a> {
        Run::new(gpu, &self.scene, &self.settings).expect("the device has room")
    }
}

/// Sets elements of a tensor on the device.
fn put(gpu: &Gpu, buffer: &Buffer<f32>, at: std::ops::Range<usize>, value: f32) {
    let mut data = gpu.read(buffer).expect("read");
    data[at].fill(value);
    gpu.write(buffer, &data).expect("write");
}

/// What step 1 leaves: colour and depth, and the terms of the loss.
fn first_step(gpu: &Gpu, run: &mut Run<'_>) -> [Vec<u32>; 3] {
    run.run_one(1).expect("a step");
    let step = run.step();
    let size = step.plan.sizes[0];
    let picture = step.picture(size);
    let depth = picture.depth.as_ref().map(|d| gpu.read(d).expect("read")).expect("the scene has priors");
    let rgb = gpu.read(&picture.rgb).expect("read").into_flattened();
    let terms = gpu.read(step.terms(size)).expect("read");
    let finite = rgb.iter().chain(&depth).all(|v| v.is_finite());
    assert_eq!(terms.iter().all(|t| t.is_finite()), finite, "loss {terms:?}, picture finite: {finite}");
    [bits(&rgb), bits(&depth), bits(&terms)]
}

/// An anchor that is drawn in the view of step 1: without it the picture is another.
fn drawn_anchor(gpu: &Gpu, setup: &Setup) -> (usize, [Vec<u32>; 3]) {
    let all = first_step(gpu, &mut setup.run(gpu));
    let camera = &setup.scene.train[0].camera;
    // Five units behind the camera.
    let behind: [f32; 3] =
        std::array::from_fn(|i| (camera.center()[i] - 5.0 * f64::from(camera.rotation[2][i])) as f32);
    for anchor in 0.. {
        let mut run = setup.run(gpu);
        let position = run.step().anchors().position.view::<f32>();
        for (i, v) in behind.into_iter().enumerate() {
            put(gpu, &position, 3 * anchor + i..3 * anchor + i + 1, v);
        }
        let without = first_step(gpu, &mut run);
        if without[0] != all[0] && without[1] != all[1] {
            return (anchor, without);
        }
    }
    unreachable!("no anchor is drawn")
}

fn anchors(gpu: &Gpu) {
    let setup = Setup::new();
    let (anchor, without) = drawn_anchor(gpu, &setup);
    for poison in POISONS {
        for tensor in 0..4 {
            let mut run = setup.run(gpu);
            let of = |run: &Run<'_>| {
                let model = run.step().anchors();
                match tensor {
                    0 => (model.position.view::<f32>(), 3),
                    t => (model.parameters()[t - 1].value.view(), model.parameters()[t - 1].width as usize),
                }
            };
            let (buffer, width) = of(&run);
            put(gpu, &buffer, anchor * width..(anchor + 1) * width, poison);
            let name = format!("{} of anchor {anchor} = {poison}", buffer.name());
            let got = first_step(gpu, &mut run);
            // Log-scales of minus infinity are scales of 0, which float32 has: a point where the anchor is. A lost feature
            // goes through ReLU, a maximum with 0 that may or may not pass it on.
            if tensor != 1 && (tensor != 3 || poison != f32::NEG_INFINITY) {
                assert!(got == without, "{name}: the picture is not that without the anchor");
            }
            let after = gpu.read(&buffer).expect("read");
            let lost = after[anchor * width..(anchor + 1) * width].iter().all(|v| !v.is_finite());
            assert!(lost, "{name}: hidden");
            // Which anchors there are is nobody's to lose.
            assert_eq!(gpu.read(run.step().limits.overflow()).expect("read"), [0], "{name}");
        }
    }
}

fn decoders(gpu: &Gpu) {
    let setup = Setup::new();
    let layout = Layout { offsets: setup.settings.model.offsets as usize };
    for poison in POISONS {
        for head in 0..3 {
            let out = layout.offsets * [1, 3, 7][head];
            // 0.weight, 0.bias, 2.weight, 2.bias
            let lengths = [32 * 36, 32, 32 * out, out];
            let mut at = layout.head(head);
            for length in lengths {
                let mut run = setup.run(gpu);
                let weights = run.step().learnt.weights().expect("decoders").value.view();
                put(gpu, &weights, at + length / 2..at + length / 2 + 1, poison);
                first_step(gpu, &mut run);
                let after = gpu.read(&weights).expect("read");
                assert!(!after[at + length / 2].is_finite(), "head {head}, weight {at} + {}: hidden", length / 2);
                at += length;
            }
            assert_eq!(at, layout.head(head + 1));
        }
    }
}

fn moments(gpu: &Gpu) {
    let setup = Setup::new();
    let tensors = |run: &Run<'_>| -> Vec<[Buffer<f32>; 3]> {
        let step = run.step();
        let parameters = step.learnt.rows().into_iter().chain(step.learnt.weights());
        parameters.map(|p| p.tensors().map(Buffer::view)).collect()
    };
    // Room for anchors to come, and what fills a buffer up to whole vectors, holds whatever it holds.
    let read = |run: &Run<'_>| -> Vec<Vec<u32>> {
        let step = run.step();
        let of_anchors = step.learnt.rows().into_iter().map(|p| (step.learnt.count() * p.width) as usize);
        let lengths = of_anchors.chain(step.learnt.weights().map(|weights| weights.width as usize));
        let words = |(tensors, n): ([Buffer<f32>; 3], usize)| {
            tensors.map(|buffer| bits(&gpu.read_range(&buffer, n).expect("read")))
        };
        tensors(run).into_iter().zip(lengths).flat_map(words).collect()
    };
    let mut whole = setup.run(gpu);
    whole.run_one(1).expect("a step");
    let whole = read(&whole);
    for poison in POISONS {
        for parameter in 0..4 {
            for moment in [1, 2] {
                let mut run = setup.run(gpu);
                let at = 77;
                put(gpu, &tensors(&run)[parameter][moment], at..at + 1, poison);
                run.run_one(1).expect("a step");
                let got = read(&run);
                let name = format!("{} = {poison}", tensors(&run)[parameter][moment].name());
                for (tensor, (got, whole)) in got.iter().zip(&whole).enumerate() {
                    let differ: BTreeSet<usize> = (0..got.len()).filter(|&i| got[i] != whole[i]).collect();
                    let own = tensor / 3 == parameter;
                    assert!(
                        differ.is_empty() || (own && differ == BTreeSet::from([at])),
                        "{name}: {tensor}, {differ:?}"
                    );
                    if own && tensor % 3 != 3 - moment {
                        assert!(!f32::from_bits(got[at]).is_finite(), "{name}: {tensor} looks whole");
                    }
                }
            }
        }
    }
}

fn whole_run(gpu: &Gpu) {
    let setup = Setup::new();
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut run = setup.run(gpu);
    let most = {
        run.train(folder.path(), &mut Silent).expect("a run");
        run.step().anchors().count
    };
    drop(run);
    for poison in POISONS {
        for what in 0..8 {
            let mut run = setup.run(gpu);
            run.run_one(1).expect("a step");
            let step = run.step();
            let n = step.anchors().count as usize;
            // Every seventh anchor, or every 97th weight.
            let spread = |buffer: &Buffer<f32>, width: usize, n: usize, every: usize| {
                let mut data = gpu.read(buffer).expect("read");
                for i in (0..n).step_by(every) {
                    data[i * width..(i + 1) * width].fill(poison);
                }
                gpu.write(buffer, &data).expect("write");
            };
            match what {
                0 => spread(&step.anchors().position.view(), 3, n, 7),
                w @ 1..=3 => {
                    let p = &step.anchors().parameters()[w - 1];
                    spread(&p.value, p.width as usize, n, 7);
                }
                w @ 4..=5 => {
                    let p = step.anchors().feature();
                    spread(p.tensors()[w - 3], p.width as usize, n, 7);
                }
                w => {
                    let weights = step.learnt.weights().expect("decoders");
                    spread(weights.tensors()[w - 6], 1, weights.width as usize, 97)
                }
            }
            let folder = tempfile::tempdir().expect("a temporary folder");
            match run.train(folder.path(), &mut Silent) {
                Ok(_) => {}
                Err(error) => {
                    let text = error.to_string();
                    assert!(!text.is_empty() && !text.contains('\n'), "{text}");
                }
            }
            assert!(run.step().anchors().count <= 2 * most, "{} anchors", run.step().anchors().count);
        }
    }
}
