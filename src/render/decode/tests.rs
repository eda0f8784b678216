use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;

use super::backward::{chunks, listed_chunks, second_sum_threads, sum_threads};
use super::forward::each;
use super::*;
use crate::gpu::Reference;
use crate::gpu::kernels::render::{
    decode, decode_backward, decode_backward_feature, decode_backward_first, decode_backward_hidden,
    decode_backward_second, decode_backward_weights, decode_backward_weights_second, decode_hidden, decode_input,
    decode_lists, decode_opacity, decode_pack,
};
use crate::gpu::{Difference, Options, Timings, testing};
use crate::math::camera::split;
use crate::math::decoder::{self, FEATURE, Gaussian, input};

struct Model {
    offsets: usize,
    position: Vec<[f32; 3]>,
    feature: Vec<f32>,
    offset: Vec<[f32; 3]>,
    log_scaling: Vec<f32>,
    weights: Vec<f32>,
    visible: Vec<u32>,
    center: [f64; 3],
    above: f32,
}

fn random<const C: usize>(rng: &mut Pcg64, n: usize, low: f32, high: f32) -> Vec<[f32; C]> {
    (0..n).map(|_| std::array::from_fn(|_| low + (high - low) * rng.random::<f32>())).collect()
}

fn flat(rng: &mut Pcg64, n: usize, low: f32, high: f32) -> Vec<f32> {
    random::<1>(rng, n, low, high).into_flattened()
}

/// So many visible anchors among half as many more: every third is not.
fn model(rng: &mut Pcg64, visible: usize, offsets: usize) -> Model {
    let ids: Vec<u32> = (0..).filter(|i| i % 3 != 1).take(visible).collect();
    let anchors = ids.last().map_or(0, |&i| i as usize) + 2;
    Model {
        offsets,
        position: random(rng, anchors, -1.0, 1.0),
        feature: flat(rng, anchors * FEATURE, -1.0, 1.0),
        offset: random(rng, anchors * offsets, -1.0, 1.0),
        log_scaling: flat(rng, 6 * anchors, -6.0, 0.5),
        weights: flat(rng, Layout { offsets }.weights(), -0.3, 0.3),
        visible: ids,
        center: [0.2, -0.3, -3.0],
        above: Decode::ALL,
    }
}

impl Model {
    fn counted(&self) -> Vec<u32> {
        vec![1, 1, 1, self.visible.len() as u32]
    }
    fn layout(&self) -> Layout {
        Layout { offsets: self.offsets }
    }
}

fn unwritten<const C: usize>(n: usize) -> Vec<[f32; C]> {
    vec![[testing::UNWRITTEN; C]; n]
}

/// Runs a kernel against its twin and returns what it wrote. More threads than needed: the kernel has to stop.
fn twin<K: Reference>(
    kernel: K,
    gpu: &Gpu,
    constants: K::Constants,
    case: K::Arrays,
    push: K::Push,
    n: usize,
) -> K::Arrays
where
    K::Constants: Clone,
{
    testing::assert_twin_with(kernel, gpu, constants, case.clone(), push, n + 70);
    testing::run_twin(kernel, constants, case, push)
}

/// Every kernel against its twin, each fed with the twins before it.
#[test]
fn kernels_match_their_twins() {
    let gpu = testing::gpu();
    let mut rng = Pcg64::seed_from_u64(1);
    let every = [(0, 10), (1, 10), (63, 10), (64, 10), (65, 10), (1000, 10), (65, 5), (3, 1), (130, 20)];
    // Tiles of both sizes; those that exist, all, none.
    for ((count, offsets), (tile, above)) in
        every.into_iter().zip([(2, 0.0), (16, 0.0), (16, -2.0), (2, 2.0)].into_iter().cycle())
    {
        let m = model(&mut rng, count, offsets);
        let (layout, slots, k) = (m.layout(), count * offsets, offsets as u32);
        let case = decode_pack::Arrays {
            weights: m.weights.clone(),
            groups: m.counted(),
            packed: unwritten(layout.packed() + 3),
            slot_count: vec![7],
        };
        let constants = decode_pack::Constants { offsets: k };
        let packed = twin(decode_pack::Kernel, &gpu, constants, case, (), layout.packed()).packed;
        let case = decode_input::Arrays {
            groups: m.counted(),
            visible: m.visible.clone(),
            position: m.position.clone(),
            feature: m.feature.clone(),
            inputs: unwritten(count * INPUT_VEC4 + 3),
        };
        let [center, center_low] = split(m.center);
        let push = decode_input::Push { center, center_low };
        let inputs = twin(decode_input::Kernel, &gpu, (), case, push, count).inputs;
        let shared = gpu.runs_lanes();
        let groups_of = |parts: usize| 8 * parts * count.div_ceil(64);
        let case = decode_hidden::Arrays {
            groups: m.counted(),
            packed: packed.clone(),
            inputs: inputs.clone(),
            hidden: unwritten(count * HIDDEN_VEC4 + 3),
            positive: vec![7; count * POSITIVE + 3],
        };
        if shared {
            twin(decode_hidden::Kernel::Cpu, &gpu, (), case.clone(), (), groups_of(2));
        }
        let tiles = |n: usize| n.div_ceil(tile as usize);
        let blocks = count.div_ceil(BLOCK_ANCHORS as usize);
        let decode_hidden::Arrays { hidden, positive, .. } =
            twin(decode_hidden::Kernel::Gpu, &gpu, (), case, (), blocks * 192);
        let case = decode_opacity::Arrays {
            groups: m.counted(),
            packed: packed.clone(),
            hidden: hidden.clone(),
            opacity: vec![testing::UNWRITTEN; slots + 3],
            flags: vec![7; slots + 3],
        };
        let constants = decode_opacity::Constants { offsets: k, tile };
        let push = decode_opacity::Push { above };
        let threads = tiles(count) * offsets.div_ceil(5);
        let flagged = twin(decode_opacity::Kernel, &gpu, constants, case, push, threads);
        let mut listed: Vec<u32> = (0..slots as u32).filter(|&i| flagged.flags[i as usize] == 1).collect();
        assert!(above == 0.0 || listed.len() == if above < 0.0 { slots } else { 0 });
        let found = listed.len();
        listed.extend([0; 3]);
        let case = decode_lists::Arrays {
            groups: m.counted(),
            listed: listed.clone(),
            listed_count: vec![found as u32],
            segments: vec![7; offsets + 4],
        };
        let constants = decode_lists::Constants { offsets: k };
        let segments = twin(decode_lists::Kernel, &gpu, constants, case, (), offsets + 1).segments;
        let case = decode::Arrays {
            segments: segments.clone(),
            listed: listed.clone(),
            visible: m.visible.clone(),
            anchor_position: m.position.clone(),
            offset: m.offset.clone(),
            log_scaling: m.log_scaling.clone(),
            packed: packed.clone(),
            hidden: hidden.clone(),
            position: unwritten(slots + 3),
            color: unwritten(slots + 3),
            scale: unwritten(slots + 3),
            rotation: unwritten(slots + 3),
            rotation_norm: vec![testing::UNWRITTEN; slots + 3],
        };
        let constants = decode::Constants { offsets: k, tile };
        let push = decode::Push { center, center_low };
        let forward = twin(decode::Kernel, &gpu, constants, case, push, tiles(found) + offsets);

        // Every other of those that exist touches a tile.
        let mut touched = vec![0; slots + 3];
        for &slot in &listed[..found] {
            touched[slot as usize] = (slot + slot / k) % 2 * 3;
        }
        let case = decode_backward::Arrays {
            groups: m.counted(),
            visible: m.visible.clone(),
            offset: Some(m.offset.clone()),
            log_scaling: m.log_scaling.clone(),
            drawn: touched,
            opacity: flagged.opacity,
            color: forward.color,
            scale: forward.scale,
            rotation: forward.rotation,
            rotation_norm: forward.rotation_norm,
            grad_position: Some(random(&mut rng, slots, -1.0, 1.0)),
            grad_opacity: flat(&mut rng, slots, -1.0, 1.0),
            grad_color: random(&mut rng, slots, -1.0, 1.0),
            grad_scale: random(&mut rng, slots, -1.0, 1.0),
            grad_rotation: random(&mut rng, slots, -1.0, 1.0),
            grad_offset: Some(unwritten(m.offset.len())),
            grad_log_scaling: Some(vec![testing::UNWRITTEN; m.log_scaling.len()]),
            grad_output: vec![[0.0; 4]; count * layout.rows() / 4 + 3],
        };
        let push = decode_backward::Push { above };
        let c = case.clone();
        let fixed_offset = decode_backward::Arrays { grad_offset: None, ..c.clone() };
        let fixed_scaling = decode_backward::Arrays { offset: None, grad_log_scaling: None, ..c };
        let fixed = decode_backward::Arrays { grad_position: None, grad_offset: None, ..fixed_scaling.clone() };
        // A thread an anchor, and one a Gaussian: the same sums.
        let [grad_output, same] = [0, each(k)].map(|each| {
            let constants = decode_backward::Constants { offsets: k, each };
            let threads = if each == 0 { count } else { count.div_ceil(each as usize) * 64 };
            for case in [&fixed_offset, &fixed_scaling, &fixed] {
                twin(decode_backward::Kernel, &gpu, constants, case.clone(), push, threads);
            }
            let got = twin(decode_backward::Kernel, &gpu, constants, case.clone(), push, threads);
            (
                got.grad_output,
                got.grad_log_scaling.expect("the case has it").iter().map(|v| v.to_bits()).collect::<Vec<_>>(),
            )
        });
        assert!(grad_output.1 == same.1, "so many threads, another sum");
        let (grad_output, _) = grad_output;
        let case = decode_backward_hidden::Arrays {
            groups: m.counted(),
            packed: packed.clone(),
            positive: positive.clone(),
            grad_output: grad_output.clone(),
            grad_hidden: unwritten(count * HIDDEN_VEC4 + 3),
        };
        let constants = decode_backward_hidden::Constants { offsets: k };
        if shared {
            twin(decode_backward_hidden::Kernel::Cpu, &gpu, constants, case.clone(), (), groups_of(3));
        }
        let threads = blocks * 3 * 64;
        let grad_hidden = twin(decode_backward_hidden::Kernel::Gpu, &gpu, constants, case, (), threads).grad_hidden;
        let case = decode_backward_feature::Arrays {
            groups: m.counted(),
            visible: m.visible.clone(),
            packed: packed.clone(),
            grad_hidden: grad_hidden.clone(),
            grad_feature: unwritten(m.feature.len() / 4),
        };
        if shared {
            twin(decode_backward_feature::Kernel::Cpu, &gpu, (), case.clone(), (), groups_of(1));
        }
        twin(decode_backward_feature::Kernel::Gpu, &gpu, (), case, (), blocks * 64);
        let parts = count.div_ceil(BLOCK);
        let case = decode_backward_first::Arrays {
            groups: m.counted(),
            inputs: inputs.clone(),
            grad_hidden: grad_hidden.clone(),
            partial: unwritten(parts * FIRST_VEC4 + 3),
        };
        if shared {
            twin(decode_backward_first::Kernel::Cpu, &gpu, (), case.clone(), (), parts * 8);
        }
        let first = twin(decode_backward_first::Kernel::Gpu, &gpu, (), case, (), parts * 240).partial;
        let grad_weights = vec![testing::UNWRITTEN; layout.weights() + 3];
        let chunks = listed_chunks(&segments, &listed, offsets).len();
        let case = decode_backward_second::Arrays {
            segments: segments.clone(),
            listed: listed.clone(),
            hidden: hidden.clone(),
            grad_output: grad_output.into_flattened(),
            partial: unwritten(chunks * SECOND_VEC4 + 3),
        };
        let of_head = |head: u32| decode_backward_second::Constants { offsets: k, head };
        let kernel = decode_backward_second::Kernel::Gpu;
        twin(kernel, &gpu, of_head(0), case.clone(), (), chunks * SECOND_THREADS as usize);
        let by_head = |case, head| twin(decode_backward_second::Kernel::Cpu, &gpu, of_head(head), case, (), chunks * 2);
        let second = (0..3).fold(case, by_head).partial;
        let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        let case = decode_backward_weights::Arrays { groups: m.counted(), partial: first, grad_weights };
        let grad_weights = [16, 1].map(|lanes| {
            let constants = decode_backward_weights::Constants { offsets: k, lanes };
            let threads = sum_threads(FIRST_VEC4, lanes);
            twin(decode_backward_weights::Kernel, &gpu, constants, case.clone(), (), threads).grad_weights
        });
        assert!(bits(&grad_weights[0]) == bits(&grad_weights[1]), "so many threads, another sum");
        let [grad_weights, _] = grad_weights;
        let case = decode_backward_weights_second::Arrays { segments, partial: second, grad_weights };
        let all = [16, 1].map(|lanes| {
            let constants = decode_backward_weights_second::Constants { offsets: k, lanes };
            let threads = second_sum_threads(offsets, lanes);
            twin(decode_backward_weights_second::Kernel, &gpu, constants, case.clone(), (), threads).grad_weights
        });
        assert!(bits(&all[0]) == bits(&all[1]), "so many threads, another sum");
        let [all, _] = all;
        assert!(all[..layout.weights()].iter().all(|g| g.is_finite()), "every weight has a gradient");
    }
}

/// Beyond 65,536 anchors, and 524,288 Gaussians, a chunk has more than 64.
#[test]
fn long_chunks_match_their_twins() {
    let gpu = testing::gpu();
    let mut rng = Pcg64::seed_from_u64(11);
    let (count, offsets) = (65_601, 9);
    let layout = Layout { offsets };
    let groups = vec![1, 1, 1, count as u32];
    let parts = chunks(count).count();
    assert_eq!(parts, 513);
    let case = decode_backward_first::Arrays {
        groups: groups.clone(),
        inputs: random(&mut rng, count * INPUT_VEC4, -1.0, 1.0),
        grad_hidden: random(&mut rng, count * HIDDEN_VEC4, -1.0, 1.0),
        partial: unwritten(parts * FIRST_VEC4 + 3),
    };
    let partial = twin(decode_backward_first::Kernel::Gpu, &gpu, (), case, (), parts * 240).partial;
    let grad_weights = vec![testing::UNWRITTEN; layout.weights() + 3];
    let case = decode_backward_weights::Arrays { groups, partial, grad_weights };
    let constants = decode_backward_weights::Constants { offsets: 9, lanes: 16 };
    let threads = sum_threads(FIRST_VEC4, 16);
    let grad_weights = twin(decode_backward_weights::Kernel, &gpu, constants, case, (), threads).grad_weights;
    let listed: Vec<u32> = (0..(count * offsets) as u32).collect();
    let segments: Vec<u32> = (0..=9).map(|k| k * count as u32).chain([count as u32]).collect();
    let chunks = listed_chunks(&segments, &listed, offsets).len();
    assert_eq!(chunks, 9 * 513);
    let case = decode_backward_second::Arrays {
        segments: segments.clone(),
        listed,
        hidden: random(&mut rng, count * HIDDEN_VEC4, -1.0, 1.0),
        grad_output: flat(&mut rng, count * layout.rows(), -1.0, 1.0),
        partial: vec![[0.0; 4]; chunks * SECOND_VEC4 + 3],
    };
    let constants = decode_backward_second::Constants { offsets: 9, head: 0 };
    let partial = twin(decode_backward_second::Kernel::Cpu, &gpu, constants, case, (), chunks * 2).partial;
    let case = decode_backward_weights_second::Arrays { segments, partial, grad_weights };
    let constants = decode_backward_weights_second::Constants { offsets: 9, lanes: 16 };
    let threads = second_sum_threads(offsets, 16);
    twin(decode_backward_weights_second::Kernel, &gpu, constants, case, (), threads);
}

struct Results {
    outputs: Vec<(&'static str, Vec<f32>)>,
    gradients: Vec<(&'static str, Vec<f32>)>,
    upstream: Vec<Gaussian>,
}

impl Results {
    /// Sets a Gaussian's outputs but its opacity, and its gradient, to 0.
    fn forget(&mut self, slot: usize) {
        for (name, values) in &mut self.outputs {
            let width = match *name {
                "opacity" => continue,
                "rotation" => 4,
                _ => 3,
            };
            values[width * slot..][..width].fill(0.0);
        }
        self.upstream[slot] = Gaussian::default();
    }
}

/// Both stages on the device. Gradient buffers start at `before`.
fn run(gpu: &Gpu, m: &Model, rng: &mut Pcg64, capacity: u32, before: f32, timings: Option<&mut Timings>) -> Results {
    let fine = "the device has memory for a test";
    let position = gpu.upload("anchor", &m.position).expect(fine);
    let feature = gpu.upload("feature", &m.feature).expect(fine);
    let offset = gpu.upload("offset", &m.offset).expect(fine);
    let log_scaling = gpu.upload("log_scaling", &m.log_scaling).expect(fine);
    let weights = gpu.upload("weights", &m.weights).expect(fine);
    let visible = gpu.upload("visible", &m.visible).expect(fine);
    let count = gpu.upload("visible_count", &[m.visible.len() as u32]).expect(fine);
    let slots = capacity as usize * m.offsets;
    let g3: [Vec<[f32; 3]>; 3] = std::array::from_fn(|_| random(rng, slots, -1.0, 1.0));
    let (g1, g4) = (flat(rng, slots, -1.0, 1.0), random::<4>(rng, slots, -1.0, 1.0));
    let [gp, gc, gs] = std::array::from_fn(|i| gpu.upload("upstream", &g3[i]).expect(fine));
    let go = gpu.upload("upstream opacity", &g1).expect(fine);
    let gr = gpu.upload("upstream rotation", &g4).expect(fine);
    let to_feature = gpu.upload("grad_feature", &vec![before; m.feature.len()]).expect(fine);
    let to_offset = gpu.upload("grad_offset", &vec![[before; 3]; m.offset.len()]).expect(fine);
    let to_scaling = gpu.upload("grad_log_scaling", &vec![before; m.log_scaling.len()]).expect(fine);
    let to_weights = gpu.upload("grad_weights", &vec![before; m.weights.len()]).expect(fine);
    let forward = Decode::of(gpu, capacity, m.offsets as u32, m.above).expect(fine);
    let backward = DecodeBackward::new(gpu, &forward).expect(fine);
    let anchors = Anchors {
        position: &position,
        feature: &feature,
        offset: &offset,
        log_scaling: &log_scaling,
        weights: &weights,
        visible: &visible,
    };
    let drawn = forward.decoded();
    let grad = GaussianGradients { drawn, position: &gp, opacity: &go, color: &gc, scale: &gs, rotation: &gr };
    let to =
        AnchorGradients { feature: &to_feature, offset: &to_offset, log_scaling: &to_scaling, weights: &to_weights };
    let step = || {
        let mut rec = gpu.recorder().expect(fine);
        forward.record(&mut rec, anchors, &count, m.center);
        backward.record(&mut rec, &forward, anchors, grad, to);
        rec.submit().and_then(crate::gpu::Submission::wait).expect("the device runs it")
    };
    step();
    if let Some(timings) = timings {
        (0..5).for_each(|_| timings.add(&step()));
    }
    let read3 = |b: &Buffer<[f32; 3]>| gpu.read(b).expect(fine).into_flattened();
    let read = |b: &Buffer<f32>| gpu.read(b).expect(fine);
    let upstream = (0..slots).map(|s| Gaussian {
        position: wide(g3[0][s]),
        opacity: g1[s].into(),
        color: wide(g3[1][s]),
        scale: wide(g3[2][s]),
        rotation: wide(g4[s]),
        norm: 0.0,
    });
    Results {
        outputs: vec![
            ("position", read3(&forward.position)),
            ("opacity", read(&forward.opacity)),
            ("color", read3(&forward.color)),
            ("scale", read3(&forward.scale)),
            ("rotation", gpu.read(&forward.rotation).expect(fine).into_flattened()),
        ],
        gradients: vec![
            ("offset", read3(&to_offset)),
            ("log_scaling", read(&to_scaling)),
            ("feature", read(&to_feature)),
            ("weights", read(&to_weights)),
        ],
        upstream: upstream.collect(),
    }
}

/// The stages (counts on the device, packing, tiles, sums over chunks) against the float64 decoder anchor by anchor.
#[test]
fn stages_match_the_decoder() {
    let gpu = testing::gpu();
    let mut rng = Pcg64::seed_from_u64(2);
    let cases = [(0usize, 10, Decode::ALL), (1, 10, Decode::ALL), (85, 10, Decode::EXISTING)];
    let more = [(500, 10, Decode::ALL), (500, 10, Decode::EXISTING), (77, 7, Decode::EXISTING)];
    for (count, offsets, above) in cases.into_iter().chain(more) {
        let mut m = model(&mut rng, count, offsets);
        m.above = above;
        let mut got = run(&gpu, &m, &mut rng, count as u32 + 5, 7.0, None);
        let layout = m.layout();
        let weights: Vec<f64> = m.weights.iter().map(|&w| w.into()).collect();
        let before = |n: usize| vec![7.0; n];
        let mut grad_weights = vec![0.0; weights.len()];
        let (mut offset, mut scaling, mut feature) =
            (before(3 * m.offset.len()), before(m.log_scaling.len()), before(m.feature.len()));
        let mut outputs = [3, 1, 3, 3, 4].map(|width| vec![0.0; width * count * offsets]);
        for (v, &anchor) in m.visible.iter().enumerate() {
            let a = anchor as usize;
            let row: [f64; FEATURE] = std::array::from_fn(|i| m.feature[FEATURE * a + i].into());
            let at: [f64; 3] = std::array::from_fn(|i| f64::from(m.position[a][i]) - m.center[i]);
            let ls = six(&m.log_scaling, a);
            let x = input(row, at);
            let o: Vec<[f64; 3]> = m.offset[a * offsets..][..offsets].iter().map(|o| wide(*o)).collect();
            let gaussians = decoder::decode(layout, &weights, &x, at, &o, ls);
            for (k, g) in gaussians.iter().enumerate() {
                let slot = k * count + v;
                outputs[1][slot] = g.opacity;
                // What is not decoded is not written, and its gradient is not read.
                if g.opacity <= f64::from(above) {
                    got.forget(slot);
                    continue;
                }
                for (which, values) in [(0, &g.position[..]), (2, &g.color), (3, &g.scale), (4, &g.rotation)] {
                    outputs[which][values.len() * slot..][..values.len()].copy_from_slice(values);
                }
            }
            let upstream: Vec<Gaussian> = (0..offsets).map(|k| got.upstream[k * count + v]).collect();
            let g = decoder::exact::decode_backward(layout, &weights, &x, at, &o, ls, &upstream, &mut grad_weights);
            for (k, _) in gaussians.iter().enumerate().filter(|(_, g)| g.opacity > f64::from(above)) {
                offset[3 * (a * offsets + k)..][..3].copy_from_slice(&g.offset[k]);
            }
            scaling[6 * a..][..6].copy_from_slice(&g.log_scaling);
            feature[FEATURE * a..][..FEATURE].copy_from_slice(&g.feature);
        }
        // A chain of three sums of 40, 33 and 72 products, and as many again over anchors.
        let compare = |name: &str, got: &[f32], want: &[f64]| {
            let got: Vec<f64> = got.iter().map(|&v| v.into()).collect();
            let difference = Difference::of("decode", name, &got[..want.len()], want, sums(300));
            assert!(difference.ok(), "{count} anchors: {difference}");
            assert!(difference.cosine > 1.0 - 1e-9, "{difference}");
        };
        for ((name, got), want) in got.outputs.iter().zip(&outputs) {
            compare(name, got, want);
        }
        for ((name, got), want) in got.gradients.iter().zip([offset, scaling, feature, grad_weights]) {
            compare(name, got, &want);
        }
    }
}

/// More visible anchors than the capacity: nothing is written beyond the buffers, the rest is as without overflow.
#[test]
fn a_full_stage_stays_within_its_buffers() {
    let gpu = testing::gpu();
    let m = model(&mut Pcg64::seed_from_u64(3), 100, 10);
    let full = run(&gpu, &m, &mut Pcg64::seed_from_u64(4), 70, 0.0, None);
    let room = run(&gpu, &m, &mut Pcg64::seed_from_u64(4), 100, 0.0, None);
    for ((_, a), (_, b)) in full.outputs.iter().zip(&room.outputs) {
        let width = b.len() / 1000;
        for (k, (a, b)) in a.chunks(70 * width).zip(b.chunks(100 * width)).enumerate() {
            assert_eq!(a, &b[..a.len()], "Gaussians {k}");
        }
    }
}

/// Same inputs, same bytes.
#[test]
fn gradients_are_deterministic() {
    let gpu = testing::gpu();
    let m = model(&mut Pcg64::seed_from_u64(5), 700, 10);
    let [a, b] = [0, 1].map(|_| run(&gpu, &m, &mut Pcg64::seed_from_u64(6), 700, 0.0, None));
    assert_eq!(a.gradients, b.gradients);
}

/// A camera on an anchor: no direction, distance 0, nothing that is not finite.
#[test]
fn a_camera_on_an_anchor_sees_no_direction() {
    let gpu = testing::gpu();
    let mut m = model(&mut Pcg64::seed_from_u64(7), 2, 10);
    m.center = m.center.map(|v| (v as f32).into());
    m.position[m.visible[1] as usize] = m.center.map(|v| v as f32);
    let results = run(&gpu, &m, &mut Pcg64::seed_from_u64(8), 2, 0.0, None);
    assert!(results.outputs.iter().chain(&results.gradients).all(|(_, v)| v.iter().all(|x| x.is_finite())));
    let x = input([0.5; FEATURE], [0.0; 3]);
    assert_eq!(x[32..], [0.0; 4]);
}

/// Chunks stay at 64 anchors up to 65,536 and at most 1,024 afterwards; none is empty, none is missed.
#[test]
fn chunks_partition_the_anchors() {
    for n in [0, 1, 64, 65, 65_536, 65_537, 250_000] {
        let all: Vec<_> = chunks(n).collect();
        assert!(all.len() <= CHUNKS && all.iter().map(ExactSizeIterator::len).sum::<usize>() == n);
        assert!(n > 65_536 || all.iter().all(|c| c.len() <= BLOCK));
    }
}

/// Prints milliseconds per pass when `GSCREAM_TIMINGS` is set; always checks that every pass was timed.
#[test]
fn passes_are_timed() {
    let device = std::env::var("GSCREAM_DEVICE").ok();
    let gpu = Gpu::open(&Options { device, timestamps: true, ..Options::default() }).expect("a device");
    let wanted = std::env::var_os("GSCREAM_TIMINGS").is_some();
    for count in if wanted { vec![2000, 20_000] } else { vec![10] } {
        let m = model(&mut Pcg64::seed_from_u64(9), count, 10);
        let mut timings = Timings::default();
        run(&gpu, &m, &mut Pcg64::seed_from_u64(10), count as u32, 0.0, Some(&mut timings));
        println!("{count} visible anchors\n{}", timings.table());
        assert!(timings.per_submission().iter().any(|(name, ..)| *name == "render/decode_backward_weights"));
    }
}
