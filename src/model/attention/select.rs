//! Which anchors attend to one another in a step: those seen in a square patch near the mask, as many inside it as
//! around it, drawn without replacement.
//!
//! Every candidate has a counter-based random number of (seed, step, anchor); the smallest of each side are taken. One
//! sort puts the candidates inside first, those around behind them and all others last:
//! [`Select::candidates`], a stable sort of the pairs by the [`KEY_BITS`], [`Select::take`].

use std::ops::Range;

use rand::{Rng, RngExt};

use crate::gpu::kernels::model::{attention_select, attention_select_take};
use crate::gpu::{Buffer, Error, Gpu, Recorder, Reference, Threads};
use crate::math::camera::{from_center, split};

/// The bits of the keys to sort by: two of the side, nineteen random ones. Ties keep the order of the anchors.
pub const KEY_BITS: Range<u32> = 11..32;

/// A rectangle of pixels within a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Patch {
    /// Lowest column and row.
    pub corner: [u32; 2],
    /// Columns and rows.
    pub side: [u32; 2],
}

/// A square of `side` pixels (less where the picture of `size` is smaller) whose centre is uniform in `bounds`, the
/// mask's bounding box (lowest column and row, and those behind the last), shifted into the picture.
///
/// # Panics
/// When the bounds are empty.
pub fn patch_position(rng: &mut impl Rng, bounds: ([u32; 2], [u32; 2]), side: u32, size: [u32; 2]) -> Patch {
    let ([left, top], [right, bottom]) = bounds;
    let patch = size.map(|s| s.min(side));
    let mut place = |bounds: Range<u32>, axis: usize| {
        rng.random_range(bounds).saturating_sub(patch[axis] / 2).min(size[axis] - patch[axis])
    };
    Patch { corner: [place(left..right, 0), place(top..bottom, 1)], side: patch }
}

/// A camera as the selection needs it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Rows of the rotation, world to camera.
    pub rotation: [[f32; 3]; 3],
    /// The camera's position, scene units.
    pub center: [f64; 3],
    /// fx, fy, cx, cy in pixels.
    pub lens: [f32; 4],
    /// k1, k2, p1, p2.
    pub distortion: [f32; 4],
    /// Smallest depth, scene units.
    pub near: f32,
    /// Squared radius on normalised coordinates at which the lens polynomial folds back; infinite where it does not.
    pub max_radius2: f32,
    /// Columns and rows of the picture.
    pub size: [u32; 2],
}

/// The step's random numbers and place.
#[derive(Clone, Copy, Debug)]
pub struct Draw {
    /// Where to look.
    pub patch: Patch,
    /// Of the run.
    pub seed: u32,
    /// Of the training.
    pub step: u32,
}

fn spread(v: u32) -> u32 {
    let v = (v ^ (v >> 16)).wrapping_mul(0x7feb_352d);
    let v = (v ^ (v >> 15)).wrapping_mul(0x846c_a68b);
    v ^ (v >> 16)
}

fn random_key(seed: u32, step: u32, item: u32) -> u32 {
    spread(item ^ spread(step ^ spread(seed)))
}

/// The pixel of a point in camera coordinates. Float32 in the kernel's order: the decision is discrete.
fn patch_pixel(p: [f32; 3], push: &attention_select::Push) -> Option<[f32; 2]> {
    let ([k1, k2, p1, p2], [fx, fy, cx, cy]) = (push.distortion, push.lens);
    let in_front = p[2] > push.near;
    if !in_front || p[0] * p[0] + p[1] * p[1] > push.max_radius2 * (p[2] * p[2]) {
        return None;
    }
    let (x, y) = (p[0] / p[2], p[1] / p[2]);
    let r2 = x * x + y * y;
    let radial = 1.0 + r2 * (k1 + k2 * r2);
    let u = (x * radial + 2.0 * p1 * (x * y)) + p2 * (r2 + 2.0 * (x * x));
    let v = (y * radial + 2.0 * p2 * (x * y)) + p1 * (r2 + 2.0 * (y * y));
    Some([fx * u + cx, fy * v + cy])
}

impl Reference for attention_select::Kernel {
    fn reference(host: attention_select::Host<'_>, push: attention_select::Push, (): ()) {
        for i in 0..host.visible_count[0] as usize {
            let anchor = host.visible[i];
            let p = from_center(host.position[anchor as usize], [push.center, push.center_low]);
            let rows = [push.rotation0, push.rotation1, push.rotation2];
            let camera: [f32; 3] = std::array::from_fn(|k| (rows[k][0] * p[0] + rows[k][1] * p[1]) + rows[k][2] * p[2]);
            let within = |at: &[f32; 2]| {
                (0..2).all(|k| at[k] >= push.corner[k] as f32 && at[k] < (push.corner[k] + push.side[k]) as f32)
            };
            let side = patch_pixel(camera, &push).filter(within).map_or(2, |at| {
                let word = host.picture[at[1] as usize * push.width as usize + at[0] as usize];
                u32::from(word >> 24 < 128)
            });
            if side < 2 {
                host.candidates[side as usize] += 1;
            }
            host.keys[i] = side << 30 | random_key(push.seed, push.step, anchor) >> 2;
            host.anchors[i] = anchor;
        }
    }
}

impl Reference for attention_select_take::Kernel {
    fn reference(host: attention_select_take::Host<'_>, push: attention_select_take::Push, (): ()) {
        let fewer = host.candidates[0].min(host.candidates[1]);
        let n = if fewer > push.too_few { fewer.min(push.capacity) } else { 0 };
        host.tokens.copy_from_slice(&[n, n]);
        for i in 0..n as usize {
            host.inside[i] = host.sorted_anchors[i];
            host.around[i] = host.sorted_anchors[host.candidates[0] as usize + i];
        }
    }
}

/// The chosen anchors.
#[derive(Clone, Copy, Debug)]
pub struct Chosen<'a> {
    /// `[2]` inside, around; equal, both 0 where the step skips the attention.
    pub tokens: &'a Buffer<u32>,
    /// `[capacity]` anchors inside the mask.
    pub inside: &'a Buffer<u32>,
    /// `[capacity]` anchors around it.
    pub around: &'a Buffer<u32>,
}

/// Sort keys and the anchors that go with them, one pair per visible anchor.
#[derive(Clone, Copy, Debug)]
pub struct Candidates<'a> {
    /// Side and random number.
    pub keys: &'a Buffer<u32>,
    /// Anchor.
    pub anchors: &'a Buffer<u32>,
}

/// Selection of at most `capacity` tokens a side.
#[derive(Debug)]
pub struct Select {
    capacity: u32,
    too_few: u32,
    keys: Buffer<u32>,
    anchors: Buffer<u32>,
    candidates: Buffer<u32>,
    tokens: Buffer<u32>,
    inside: Buffer<u32>,
    around: Buffer<u32>,
}

impl Select {
    /// Room for `capacity` tokens a side out of `anchors` anchors; a step with `too_few` candidates on a side, or fewer,
    /// has no tokens.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn new(gpu: &Gpu, anchors: usize, capacity: u32, too_few: u32) -> Result<Self, Error> {
        Ok(Self {
            capacity,
            too_few,
            keys: gpu.buffer("candidate_keys", anchors)?,
            anchors: gpu.buffer("candidate_anchors", anchors)?,
            candidates: gpu.buffer("candidates", 2)?,
            tokens: gpu.buffer("tokens", 2)?,
            inside: gpu.buffer("inside_anchors", capacity as usize)?,
            around: gpu.buffer("around_anchors", capacity as usize)?,
        })
    }

    /// Records keys and anchors of the first `visible_count` pairs; sort them by [`KEY_BITS`] before [`Self::take`].
    /// `picture` holds the view's mask in the highest byte of each pixel; `threads` covers the visible anchors.
    ///
    /// # Panics
    /// When the patch is not within the picture.
    #[allow(clippy::too_many_arguments, reason = "three of them are the visible anchors")]
    pub fn candidates<'t>(
        &self,
        rec: &mut Recorder<'_>,
        (visible, visible_count, threads): (&Buffer<u32>, &Buffer<u32>, impl Into<Threads<'t>>),
        position: &Buffer<[f32; 3]>,
        picture: &Buffer<u32>,
        view: &View,
        draw: Draw,
    ) -> Candidates<'_> {
        let Patch { corner, side } = draw.patch;
        assert!((0..2).all(|k| corner[k] + side[k] <= view.size[k]), "{:?} in {:?}", draw.patch, view.size);
        assert!(picture.len() >= (view.size[0] * view.size[1]) as usize, "{picture:?} of {:?}", view.size);
        let [rotation0, rotation1, rotation2] = view.rotation;
        let [center, center_low] = split(view.center);
        let View { lens, distortion, near, max_radius2, .. } = *view;
        let push = attention_select::Push {
            rotation0,
            rotation1,
            rotation2,
            center,
            center_low,
            lens,
            distortion,
            near,
            max_radius2,
            corner,
            side,
            width: view.size[0],
            seed: draw.seed,
            step: draw.step,
        };
        let Self { keys, anchors, candidates, .. } = self;
        rec.zero(candidates);
        let buffers =
            attention_select::Buffers { visible_count, visible, position, picture, keys, anchors, candidates };
        rec.run(attention_select::Kernel, buffers, push, threads);
        Candidates { keys, anchors }
    }

    /// Records the choice from the anchors in the order of their keys.
    pub fn take(&self, rec: &mut Recorder<'_>, sorted_anchors: &Buffer<u32>) -> Chosen<'_> {
        let Self { candidates, tokens, inside, around, .. } = self;
        let buffers = attention_select_take::Buffers { candidates, sorted_anchors, tokens, inside, around };
        let push = attention_select_take::Push { capacity: self.capacity, too_few: self.too_few };
        rec.run(attention_select_take::Kernel, buffers, push, self.capacity.max(1));
        Chosen { tokens, inside, around }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::gpu::testing;

    const VIEW: View = View {
        rotation: [[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]],
        // Of the translation (0.1, -0.2, 4).
        center: [2.32, 0.2, -3.26],
        lens: [90.0, 91.0, 50.5, 38.0],
        distortion: [0.03, -0.01, 0.002, -0.001],
        near: 0.2,
        max_radius2: 20.0,
        size: [101, 77],
    };

    struct Scene {
        visible: Vec<u32>,
        position: Vec<[f32; 3]>,
        picture: Vec<u32>,
    }

    /// `n` visible of `2 n` anchors, some behind the camera; a disc for a mask.
    fn scene(n: usize, seed: u64) -> Scene {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let position = (0..2 * n).map(|_| std::array::from_fn(|_| rng.random_range(-5.0..5.0))).collect();
        let visible = (0..n as u32).map(|i| 2 * i + 1).collect();
        let picture = (0..VIEW.size[0] * VIEW.size[1])
            .map(|i| {
                let (x, y) = (i % VIEW.size[0], i / VIEW.size[0]);
                let inside = x.abs_diff(50).pow(2) + y.abs_diff(40).pow(2) < 400;
                (if inside { 0xff00_0000 } else { 0 }) | rng.random_range(0..0x0100_0000)
            })
            .collect();
        Scene { visible, position, picture }
    }

    fn draw() -> Draw {
        Draw { patch: Patch { corner: [20, 10], side: [64, 60] }, seed: 7, step: 15_001 }
    }

    /// Candidates and tokens on the device, every pass beside its twin; sorted on the host.
    fn select(gpu: &Gpu, scene: &Scene, capacity: u32, draw: Draw) -> (Vec<u32>, [Vec<u32>; 2]) {
        let n = scene.visible.len();
        let upload = |name, data: &[u32]| gpu.upload(name, data).expect("memory for the test");
        let (visible, picture) = (upload("visible", &scene.visible), upload("picture", &scene.picture));
        let (count, position) = (upload("visible_count", &[n as u32]), gpu.upload("position", &scene.position));
        let position = position.expect("memory for the test");
        let stage = Select::new(gpu, n.max(1), capacity, 11).expect("memory for the test");
        let mut rec = gpu.checked().expect("a recorder");
        let pairs = stage.candidates(&mut rec, (&visible, &count, n), &position, &picture, &VIEW, draw);
        let first = rec.submit().expect("the device runs it");
        let read = |buffer| gpu.read_range(buffer, n).expect("readable");
        let mut sorted: Vec<(u32, u32)> = read(pairs.keys).into_iter().zip(read(pairs.anchors)).collect();
        sorted.sort_by_key(|(key, _)| key >> KEY_BITS.start);
        let sorted: Vec<u32> = sorted.into_iter().map(|(_, anchor)| anchor).collect();
        let sorted = upload("sorted", &sorted);
        let mut rec = gpu.checked().expect("a recorder");
        let chosen = stage.take(&mut rec, &sorted);
        let second = rec.submit().expect("the device runs it");
        for difference in first.differences.iter().chain(&second.differences) {
            assert!(difference.ok(), "{n} anchors: {difference}");
        }
        drop((first, second));
        let tokens = gpu.read(chosen.tokens).expect("readable");
        let lists = [chosen.inside, chosen.around].map(|b| gpu.read_range(b, tokens[0] as usize).expect("readable"));
        (tokens, lists)
    }

    #[test]
    fn matches_its_twins() {
        let gpu = testing::gpu();
        for n in [0, 1, 63, 64, 65, 1000, 20_000] {
            for capacity in [1, 12, 200] {
                select(&gpu, &scene(n, 3), capacity, draw());
            }
        }
    }

    #[test]
    fn equal_numbers_from_the_right_sides_without_repetition() {
        let gpu = testing::gpu();
        let scene = scene(30_000, 4);
        let (tokens, [inside, around]) = select(&gpu, &scene, 100, draw());
        assert_eq!(tokens, [100, 100]);
        let all: HashSet<u32> = inside.iter().chain(&around).copied().collect();
        assert_eq!(all.len(), 200, "an anchor is chosen twice");
        let mask_of = |anchor: u32| {
            let p = scene.position[anchor as usize].map(f64::from);
            let camera: [f64; 3] = std::array::from_fn(|k| {
                (0..3).map(|c| f64::from(VIEW.rotation[k][c]) * (p[c] - VIEW.center[c])).sum::<f64>()
            });
            let (x, y) = (camera[0] / camera[2], camera[1] / camera[2]);
            let [k1, k2, p1, p2] = VIEW.distortion.map(f64::from);
            let [fx, fy, cx, cy] = VIEW.lens.map(f64::from);
            let r2 = x * x + y * y;
            let radial = 1.0 + k1 * r2 + k2 * r2 * r2;
            let u = fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + cx;
            let v = fy * (y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)) + cy;
            assert!((20.0..84.0).contains(&u) && (10.0..70.0).contains(&v), "anchor {anchor} at {u}, {v}");
            scene.picture[v as usize * 101 + u as usize] >> 24 != 0
        };
        assert!(inside.iter().all(|&a| mask_of(a)));
        assert!(!around.iter().any(|&a| mask_of(a)));
        let again = select(&gpu, &scene, 100, draw());
        assert_eq!(again.1, [inside.clone(), around], "not the same twice");
        let other = select(&gpu, &scene, 100, Draw { step: 15_002, ..draw() });
        let common = other.1[0].iter().filter(|a| inside.contains(a)).count();
        assert!(common < 90, "{common} of 100 tokens are the last step's");
    }

    #[test]
    fn too_few_on_a_side_means_none() {
        let gpu = testing::gpu();
        let mut scene = scene(20_000, 5);
        scene.picture.iter_mut().for_each(|word| *word &= 0x00ff_ffff);
        assert_eq!(select(&gpu, &scene, 100, draw()).0, [0, 0]);
        let gpu = testing::gpu();
        for (candidates, n) in [([11, 900], 0), ([900, 11], 0), ([12, 13], 12), ([900, 800], 64), ([0, 0], 0)] {
            let case = attention_select_take::Arrays {
                candidates: candidates.to_vec(),
                sorted_anchors: (0..2000).collect(),
                tokens: vec![u32::MAX; 2],
                inside: vec![u32::MAX; 64],
                around: vec![u32::MAX; 64],
            };
            let push = attention_select_take::Push { capacity: 64, too_few: 11 };
            testing::assert_twin(attention_select_take::Kernel, &gpu, case.clone(), push, 64u32);
            let after = testing::run_once(attention_select_take::Kernel, &gpu, &case, push, 64u32);
            assert_eq!(after.tokens, [n, n]);
        }
    }

    /// Every one of many candidates is chosen about equally often: 200 draws of 100 out of some 500; with p = 0.2 the
    /// count of one is 40 with a deviation of 5.7: none beyond six of them.
    #[test]
    fn keys_are_uniform() {
        let mut chosen = vec![0; 500];
        for step in 0..200 {
            let mut keys: Vec<_> = (0..500).map(|a| (random_key(9, step, a) >> 2 >> KEY_BITS.start, a)).collect();
            keys.sort_unstable();
            keys[..100].iter().for_each(|&(_, a)| chosen[a as usize] += 1);
        }
        assert!(chosen.iter().all(|c| (6..=74).contains(c)), "{:?}, {:?}", chosen.iter().min(), chosen.iter().max());
    }

    #[test]
    fn patches_lie_in_the_picture_and_touch_the_box() {
        let mut rng = Pcg64Mcg::seed_from_u64(1);
        for (low, high, size) in [
            ([300, 200], [420, 280], [1008, 567]),
            ([0, 0], [20, 10], [1008, 567]),
            ([990, 560], [1008, 567], [1008, 567]),
            ([10, 10], [40, 30], [120, 90]),
            ([3, 4], [4, 5], [300, 100]),
        ] {
            let corners: HashSet<_> = (0..500)
                .map(|_| {
                    let patch = patch_position(&mut rng, (low, high), 256, size);
                    for k in 0..2 {
                        assert_eq!(patch.side[k], 256.min(size[k]));
                        assert!(patch.corner[k] + patch.side[k] <= size[k], "{patch:?} in {size:?}");
                        assert!(patch.corner[k] < high[k] && patch.corner[k] + patch.side[k] > low[k], "{patch:?}");
                    }
                    patch.corner
                })
                .collect();
            assert!(corners.len() > 400 || low != [300, 200], "{} places only", corners.len());
        }
    }
}
