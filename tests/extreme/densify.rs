//! Growing and pruning without anything to judge, with everything in one place, far out, and down to nothing.

use gscream_vk::densify::{Config, Round, Statistics, grow, prune};
use gscream_vk::gpu::Gpu;
use gscream_vk::model::anchors::Anchors;
use gscream_vk::model::files;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::Case;

const OFFSETS: u32 = 10;
const VOXEL: f32 = 0.01;

pub const CASES: &[Case] = &[
    Case {
        stage: "densify",
        case: "no visits at all; gradient sums of NaN, infinity and 1e30 without a visit",
        guarantee: "nothing grows, nothing is pruned, not a bit changes: a mean needs visits",
        run: no_visits,
    },
    Case {
        stage: "densify: grow",
        case: "2,000 anchors in one voxel, all Gaussians asking",
        guarantee: "one new anchor per free cell and level, the second round adds none to the same cells",
        run: one_voxel,
    },
    Case {
        stage: "densify: grow",
        case: "1e6 and 1.9e6 voxels from the origin",
        guarantee: "no overflow; every new anchor lies in its cell and is found there: the second round adds none",
        run: far_out,
    },
    Case {
        stage: "densify: grow",
        case: "2.1e6, 1e7, 1e9 and 1e30 voxels from the origin; positions that are not numbers",
        guarantee: "no anchor where float32 does not tell cells apart; counted and said, never a wrapped integer",
        run: too_far,
    },
    Case {
        stage: "densify: prune",
        case: "all anchors transparent, then a step's worth of growing",
        guarantee: "no anchor left is a state like any other: growing, pruning and reading go on, memory stays",
        run: all_pruned,
    },
    Case {
        stage: "densify: prune",
        case: "opacity sums of NaN and infinity",
        guarantee: "an anchor whose opacity is not a number is not pruned on its account; others as ever",
        run: opacity_not_a_number,
    },
];

fn model(position: Vec<[f32; 3]>) -> files::Anchors {
    let n = position.len();
    files::Anchors::new(
        OFFSETS as usize,
        position,
        (0..n).map(|a| std::array::from_fn(|c| (a * 32 + c) as f32 * 1e-3)).collect(),
        vec![0.0; n * 3 * OFFSETS as usize],
        vec![[VOXEL.ln(); 6]; n],
    )
}

struct Scene {
    anchors: Anchors,
    statistics: Statistics,
}

impl Scene {
    fn new(gpu: &Gpu, model: &files::Anchors) -> Self {
        let anchors = Anchors::upload(gpu, model, 0).expect("upload");
        let statistics = Statistics::new(gpu, anchors.capacity, OFFSETS, false).expect("buffers");
        Self { anchors, statistics }
    }

    /// So many sightings of this mean gradient for every Gaussian, so many visits of this mean opacity for every anchor.
    fn seen(&self, gpu: &Gpu, (seen, gradient): (u32, f32), (visits, opacity): (u32, f32)) {
        let anchors = self.anchors.count as usize;
        let slots = anchors * OFFSETS as usize;
        let write = |buffer, value: f32, n| gpu.write(buffer, &vec![value; n]).expect("write");
        let count = |buffer, value: u32, n| gpu.write(buffer, &vec![value; n]).expect("write");
        write(&self.statistics.gradient, gradient * seen as f32, slots);
        count(&self.statistics.seen, seen, slots);
        write(&self.statistics.opacity_sum, opacity * visits as f32, anchors);
        count(&self.statistics.visits, visits, anchors);
    }

    fn grow(&mut self, gpu: &Gpu, voxel: f32, step: u32) -> grow::Grown {
        let round = Round { voxel, seed: 3, step };
        grow::run(gpu, &mut self.anchors, &mut self.statistics, &Config::default(), round).expect("a round")
    }

    fn prune(&mut self, gpu: &Gpu) -> u32 {
        let config = Config { max_log_scaling: f64::INFINITY, ..Config::default() };
        prune::run(gpu, &mut self.anchors, &mut self.statistics, &config).expect("a round")
    }

    fn read(&self, gpu: &Gpu) -> files::Anchors {
        self.anchors.read(gpu).expect("read")
    }
}

fn no_visits(gpu: &Gpu) {
    let model = model((0..100).map(|i| [i as f32 * VOXEL, 0.0, 1.0]).collect());
    for gradient in [0.0, f32::NAN, f32::INFINITY, 1e30] {
        let mut scene = Scene::new(gpu, &model);
        gpu.write(&scene.statistics.gradient, &vec![gradient; 1000]).expect("write");
        gpu.write(&scene.statistics.opacity_sum, &vec![gradient; 100]).expect("write");
        assert_eq!(scene.grow(gpu, VOXEL, 1500), grow::Grown::default(), "{gradient}");
        assert_eq!(scene.prune(gpu), 0, "{gradient}");
        assert_eq!(scene.read(gpu), model);
        let kept = gpu.read(&scene.statistics.gradient).expect("read");
        assert!(kept.iter().all(|g| g.to_bits() == gradient.to_bits()));
    }
}

fn one_voxel(gpu: &Gpu) {
    // All anchors in the cell of the origin, their Gaussians three voxels to the right of it.
    let mut crowd = model(vec![[0.0; 3]; 2000]);
    crowd.offset.chunks_mut(3).for_each(|o| o[0] = 3.0);
    let mut scene = Scene::new(gpu, &crowd);
    scene.seen(gpu, (100, 1.0), (10, 0.5));
    let grown = scene.grow(gpu, VOXEL, 1500);
    // Level 0 has cells of 16 voxels: the anchors' own. Levels 1 and 2 (4 voxels and 1) have one free cell each.
    assert_eq!(grown, grow::Grown { added: 2, ..grow::Grown::default() });
    let after = scene.read(gpu);
    assert_eq!(after.position[2000..], [[0.04, 0.0, 0.0], [0.03, 0.0, 0.0]]);
    let largest: [f32; 32] = std::array::from_fn(|c| crowd.feature[1999][c]);
    assert!(after.feature[2000..].iter().all(|f| *f == largest), "the largest of all candidates");
    for step in [1600, 1700] {
        scene.seen(gpu, (100, 1.0), (10, 0.5));
        // The new ones' own Gaussians lie in their cells.
        assert_eq!(scene.grow(gpu, VOXEL, step).added, 0, "step {step}");
    }
}

/// Random cells about this far out along every axis, an anchor in each; the Gaussians in neighbouring cells.
fn around(distance: f64, voxel: f32) -> files::Anchors {
    let mut rng = Pcg64Mcg::seed_from_u64(6);
    let position = (0..200).map(|_| {
        std::array::from_fn(|_| {
            let cell = (distance * rng.random_range(0.99..1.0)).round() * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            (cell * f64::from(voxel)) as f32
        })
    });
    let mut model = model(position.collect());
    model.log_scaling.fill([voxel.ln(); 6]);
    model.offset.iter_mut().for_each(|o| *o = rng.random_range(-40.0f32..40.0).round());
    model
}

fn far_out(gpu: &Gpu) {
    // Voxels that are no powers of two: side, inverse and products are all rounded.
    for voxel in [0.01, 0.0037, 1.9] {
        for distance in [1e6, 1.9e6] {
            let mut scene = Scene::new(gpu, &around(distance, voxel));
            scene.seen(gpu, (100, 1.0), (10, 0.5));
            let grown = scene.grow(gpu, voxel, 1500);
            assert!(grown.added > 1000 && grown.beyond == 0, "{distance:e} voxels of {voxel}: {grown:?}");
            let after = scene.read(gpu);
            for p in after.position[200..].iter().flatten() {
                let cell = f64::from(*p) / f64::from(voxel);
                assert!((cell - cell.round()).abs() < 0.25 && cell.abs() < 1.01 * distance, "{p} is between cells");
            }
            // The same numbers again, so that the same Gaussians ask for the same cells.
            let slots = vec![0; after.position.len() * OFFSETS as usize];
            gpu.write(&scene.statistics.seen, &slots).expect("write");
            gpu.write(&scene.statistics.seen, &vec![100; 200 * OFFSETS as usize]).expect("write");
            gpu.write(&scene.statistics.gradient, &vec![100.0; 200 * OFFSETS as usize]).expect("write");
            assert_eq!(scene.grow(gpu, voxel, 1500).added, 0, "{distance:e} voxels of {voxel}: a second in one cell");
        }
    }
}

fn too_far(gpu: &Gpu) {
    for distance in [2.1e6, 1e7, 1e9, 1e30, f64::NAN, f64::INFINITY] {
        let mut model = around(if distance.is_finite() { distance } else { 100.0 }, VOXEL);
        if !distance.is_finite() {
            model.position.fill([0.5, distance as f32, 0.0]);
        }
        let mut scene = Scene::new(gpu, &model);
        scene.seen(gpu, (100, 1.0), (10, 0.5));
        let grown = scene.grow(gpu, VOXEL, 1500);
        // The finest level never has a cell there, the coarser ones only up to 16 times as far.
        assert!(grown.beyond > 0, "{distance:e}: {grown:?}");
        let positions = scene.read(gpu).position;
        if distance.is_nan() || distance > 3.2e7 {
            assert_eq!(grown.added, 0, "{distance:e}: {grown:?}");
        }
        let far = positions[200..].iter().flatten().all(|p| f64::from(p.abs()) < 1.01 * distance * f64::from(VOXEL));
        assert!(far, "{distance:e}: an anchor came from a wrapped cell");
        gpu.write(&scene.statistics.seen, &vec![0; positions.len() * OFFSETS as usize]).expect("write");
        gpu.write(&scene.statistics.seen, &vec![100; 200 * OFFSETS as usize]).expect("write");
        gpu.write(&scene.statistics.gradient, &vec![100.0; 200 * OFFSETS as usize]).expect("write");
        assert_eq!(scene.grow(gpu, VOXEL, 1500).added, 0, "{distance:e}: a second in one cell");
    }
}

fn all_pruned(gpu: &Gpu) {
    let mut scene = Scene::new(gpu, &model((0..300).map(|i| [i as f32 * VOXEL, 0.0, 1.0]).collect()));
    let bytes = gpu.memory().0;
    scene.seen(gpu, (100, 1.0), (100, 0.001));
    assert_eq!(scene.prune(gpu), 300);
    assert_eq!(scene.anchors.count, 0);
    assert_eq!(scene.read(gpu).position.len(), 0);
    for step in [1600, 1700] {
        assert_eq!(scene.grow(gpu, VOXEL, step), grow::Grown::default());
        assert_eq!(scene.prune(gpu), 0);
    }
    assert_eq!(gpu.memory().0, bytes);
}

fn opacity_not_a_number(gpu: &Gpu) {
    let mut scene = Scene::new(gpu, &model((0..300).map(|i| [i as f32 * VOXEL, 0.0, 1.0]).collect()));
    scene.seen(gpu, (0, 0.0), (100, 0.001));
    let poisons = [f32::NAN, f32::INFINITY];
    let sums: Vec<f32> = (0..300).map(|a| if a % 10 < 2 { poisons[a % 10] } else { 0.1 }).collect();
    gpu.write(&scene.statistics.opacity_sum, &sums).expect("write");
    assert_eq!(scene.prune(gpu), 240);
    assert_eq!(scene.anchors.count, 60);
}
