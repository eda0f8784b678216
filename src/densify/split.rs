//! Splitting plain Gaussians: those that have faded away become halves of others, as in 3DGS-MCMC (Kheradmand et al. 2024),
//! and new halves come until there are as many as the settings allow.
//!
//! A Gaussian becomes two along its longest axis, which lie apart: copies in one place have one gradient and would stay there.
//! Each is `DEVIATION` times as long and lies `SHIFT` of the deviation to its side, so that the two of them have its
//! variance; its opacity is such that they take as much of a picture as it did (`half`). Which ones are split is drawn by
//! opacity times deviation along that axis: the large ones that are seen leave the most to be told. (By the positions'
//! gradients, one capture came out 0.4 dB worse with one seed.) Halves begin without a first moment and keep the second one,
//! the pace of the one. It happens on the host, between steps, with the rows that change alone, and depends on the model, the
//! seed and the step alone. A round waits for the device twice: for the rows that decide, and for the halves.

use glam::{DMat3, DQuat};
use rand::RngExt as _;
use rand_pcg::Pcg64;
use rayon::prelude::*;

use super::{Config, Round};
use crate::gpu::kernels::densify::{prune_gather, split_scatter};
use crate::gpu::{Buffer, Error, Gpu, Recorder, Reference};
use crate::model::gaussians::{NORM_EPSILON, Static, sigmoid};

/// Deviation of a half along the axis, of that of the whole: divided by 1.6, as by 3DGS.
const DEVIATION: f64 = 0.625;
/// How far a half lies from the whole, in deviations of it: `DEVIATION^2 + SHIFT^2` is 1.
const SHIFT: f64 = 0.780_624_749_799_8;

/// Opacity that each half has of one of this opacity, seen across the axis.
///
/// One of opacity o takes `2 pi o` of a picture, in units of its deviations. Two of opacity h and deviation s, d to either
/// side, take `4 pi s h` less what both take, `pi s h^2 exp(-d^2 / s^2)`: h is the smaller root of the quadratic equation.
fn half(opacity: f64) -> f64 {
    let both = DEVIATION * (-(SHIFT / DEVIATION).powi(2)).exp();
    let twice = 2.0 * DEVIATION;
    (twice - (twice * twice - 2.0 * both * opacity).sqrt()) / both
}

/// A Gaussian that becomes two.
struct Split {
    /// The Gaussian, and then one of the halves.
    source: usize,
    /// The other half.
    place: usize,
    /// The longest of its axes.
    axis: usize,
    /// From the middle to the first half, world.
    shift: [f64; 3],
    /// Logit of the halves' opacity.
    logit: f32,
}

/// Different ones of these by weight, at most `most`: those of the largest `ln(u) / weight` (Efraimidis and Spirakis 2006).
fn draw(weights: &[f64], most: usize, round: Round) -> Vec<usize> {
    let mut generator = Pcg64::new(u128::from(round.seed) << 32 | u128::from(round.step), STREAM);
    let keys: Vec<f64> = weights.iter().map(|weight| generator.random::<f64>().ln() / weight).collect();
    let mut chosen: Vec<usize> = (0..weights.len()).filter(|i| weights[*i] > 0.0 && weights[*i].is_finite()).collect();
    let first = |a: &usize, b: &usize| keys[*b].total_cmp(&keys[*a]).then(a.cmp(b));
    if most < chosen.len() {
        chosen.select_nth_unstable_by(most, first);
        chosen.truncate(most);
    }
    chosen.sort_unstable_by(first);
    chosen
}

/// Stream of the generator that draws who is split, apart from those of other random choices of the same seed.
const STREAM: u128 = 0x7265_6c6f_6361_7465;

/// Share by which a round enlarges the number of plain Gaussians, as 3DGS-MCMC does.
pub const GROWTH: f64 = 0.05;

/// Rows that decide who becomes two and where the halves lie, on the host.
struct Rows {
    position: Vec<f32>,
    log_scale: Vec<f32>,
    quaternion: Vec<f32>,
    logit: Vec<f32>,
}

impl Rows {
    /// Reads the rows of all Gaussians, in one submission.
    fn read(gpu: &Gpu, gaussians: &Static) -> Result<Self, Error> {
        let mut rec = gpu.recorder()?;
        let mut copies = vec![];
        for parameter in &gaussians.parameters()[..=LOGIT] {
            let words = gaussians.count as usize * parameter.width as usize;
            let copy = gpu.readback(parameter.names.value, words)?;
            rec.copy(&parameter.value, &copy, words);
            copies.push((copy, words));
        }
        rec.submit()?.wait()?;
        let mut rows = copies.iter().map(|(copy, words)| gpu.read_range(copy, *words));
        let mut next = || rows.next().expect("one of each parameter");
        Ok(Self { position: next()?, log_scale: next()?, quaternion: next()?, logit: next()? })
    }

    /// The longest axis, and the deviation along it.
    fn longest(&self, i: usize) -> (usize, f64) {
        let of = &self.log_scale[3 * i..3 * i + 3];
        let axis = (1..3).fold(0, |longest, k| if of[k] > of[longest] { k } else { longest });
        (axis, f64::from(of[axis]).exp())
    }

    /// Which Gaussians become two: those that have faded make place for halves, and so does what is behind the last up to
    /// `target`. Places come in ascending order.
    fn splits(&self, faded: f64, target: usize, round: Round) -> Vec<Split> {
        let opacity: Vec<f64> = self.logit.par_iter().map(|logit| sigmoid(*logit)).collect();
        let weight = |i: usize| if opacity[i] < faded { 0.0 } else { opacity[i] * self.longest(i).1 };
        let weights: Vec<f64> = (0..opacity.len()).into_par_iter().map(weight).collect();
        let places: Vec<usize> =
            (0..opacity.len()).filter(|i| opacity[*i] < faded).chain(opacity.len()..target).collect();
        let split = |(source, place): (usize, usize)| {
            let (axis, deviation) = self.longest(source);
            let [w, x, y, z] = std::array::from_fn(|k| f64::from(self.quaternion[4 * source + k]));
            let turned = DQuat::from_xyzw(x, y, z, w);
            let turned = DMat3::from_quat(turned / turned.length().max(NORM_EPSILON));
            let half = half(opacity[source]).max(faded);
            let shift = (turned.col(axis) * deviation * SHIFT).to_array();
            Split { source, place, axis, shift, logit: (half / (1.0 - half)).ln() as f32 }
        };
        draw(&weights, places.len(), round).into_iter().zip(places).map(split).collect()
    }

    /// The values at `which` of [`Static::parameters`] of all first halves and then of all others, where they are not those
    /// of the whole.
    fn halves(&self, splits: &[Split], which: usize) -> Option<Vec<f32>> {
        let both = || [1.0, -1.0].into_iter().flat_map(|side| splits.iter().map(move |split| (side, split)));
        match which {
            POSITION => Some(
                both()
                    .flat_map(|(side, split)| {
                        let at = |k| f64::from(self.position[3 * split.source + k]) + side * split.shift[k];
                        [0, 1, 2].map(|k| at(k) as f32)
                    })
                    .collect(),
            ),
            LOG_SCALE => Some(
                both()
                    .flat_map(|(_, split)| {
                        let mut of: [f32; 3] = std::array::from_fn(|k| self.log_scale[3 * split.source + k]);
                        of[split.axis] += DEVIATION.ln() as f32;
                        of
                    })
                    .collect(),
            ),
            LOGIT => Some(both().map(|(_, split)| split.logit).collect()),
            _ => None,
        }
    }
}

impl Reference for split_scatter::Kernel {
    fn reference(host: split_scatter::Host<'_>, push: split_scatter::Push, (): ()) {
        let width = push.width as usize;
        for (row, &place) in host.from.chunks(width).zip(&host.places[..push.rows as usize]) {
            host.to[place as usize * width..][..width].copy_from_slice(row);
        }
    }
}

/// Puts rows into a tensor.
fn put(rec: &mut Recorder<'_>, tensor: &Buffer<f32>, places: &Buffer<u32>, width: u32, from: &Buffer<f32>) {
    let rows = places.len() as u32;
    let buffers = split_scatter::Buffers { places, from: &from.view(), to: &tensor.view() };
    rec.run(split_scatter::Kernel, buffers, split_scatter::Push { rows, width }, rows as usize * width as usize);
}

/// Records that two halves take the places of each of the splits.
fn apply(rec: &mut Recorder<'_>, gaussians: &Static, rows: &Rows, splits: &[Split]) -> Result<(), Error> {
    let gpu = rec.gpu();
    let [from, to] = [|split: &Split| split.source as u32, |split: &Split| split.place as u32];
    let sources: Vec<u32> = splits.iter().map(from).collect();
    let places: Vec<u32> = splits.iter().map(to).collect();
    let both = gpu.constant("split_both", &[&sources[..], &places[..]].concat())?;
    let [sources, places] = [gpu.constant("split_sources", &sources)?, gpu.constant("split_places", &places)?];
    let rows_of = |width: u32| splits.len() * width as usize;
    let widest = gaussians.parameters().iter().map(|parameter| parameter.width).max().unwrap_or(0);
    let zeros = gpu.buffer("split_zeros", 2 * rows_of(widest))?;
    rec.zero(&zeros);
    for (which, parameter) in gaussians.parameters().into_iter().enumerate() {
        let width = parameter.width;
        // What the whole has, for its other half.
        let copy = |rec: &mut Recorder<'_>, tensor: &Buffer<f32>| -> Result<(), Error> {
            let found = gpu.buffer("split_rows", rows_of(width))?;
            let buffers = prune_gather::Buffers { kept: &sources, from: &tensor.view(), to: &found.view() };
            let push = prune_gather::Push { rows: splits.len() as u32, width };
            rec.run(prune_gather::Kernel, buffers, push, rows_of(width));
            put(rec, tensor, &places, width, &found);
            Ok(())
        };
        match rows.halves(splits, which) {
            Some(halves) => put(rec, &parameter.value, &both, width, &gpu.constant("split_halves", &halves)?),
            None => copy(rec, &parameter.value)?,
        }
        put(rec, &parameter.first, &both, width, &zeros);
        copy(rec, &parameter.root)?;
    }
    Ok(())
}

/// Splits Gaussians into the places of those that have faded below `config.min_opacity`, and into new ones: [`GROWTH`] of
/// all, up to `config.max_gaussians` and the room there is. Returns how many faded ones are halves now. Nothing may be in
/// flight.
///
/// # Errors
/// Errors of the copies.
pub fn run(gpu: &Gpu, gaussians: &mut Static, config: &Config, round: Round) -> Result<u32, Error> {
    let count = gaussians.count as usize;
    let grown = (count as f64 * (1.0 + GROWTH)).ceil() as usize;
    let target = grown.min(config.max_gaussians as usize).min(gaussians.capacity as usize).max(count);
    let rows = Rows::read(gpu, gaussians)?;
    let splits = rows.splits(config.min_opacity, target, round);
    let Some(last) = splits.last().map(|split| split.place) else { return Ok(0) };
    let now = count.max(last + 1);
    let mut rec = gpu.recorder()?;
    apply(&mut rec, gaussians, &rows, &splits)?;
    rec.submit()?.wait()?;
    gaussians.count = now as u32;
    Ok(splits.iter().filter(|split| split.place < count).count() as u32)
}

/// Places in [`Static::parameters`].
const POSITION: usize = 0;
const LOG_SCALE: usize = 1;
const LOGIT: usize = 3;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::export::draw::Drawer;
    use crate::gpu::testing;
    use crate::model::gaussians::{Cloud, logit};
    use crate::render::Config as Render;
    use crate::scene::Camera;

    /// Share of the light that two halves take along the axis, x from the middle in deviations of the whole and y across it.
    fn taken(each: f64, x: f64, y: f64) -> f64 {
        let of = |side: f64| each * (-0.5 * (((x - side) / DEVIATION).powi(2) + y * y)).exp();
        1.0 - (1.0 - of(SHIFT)) * (1.0 - of(-SHIFT))
    }

    /// The most that halves differ from the whole, as a share of its opacity.
    fn most(opacity: f64) -> f64 {
        let whole = |x: f64| opacity * (-0.5 * x * x).exp();
        let at = (0..=400).map(|i| f64::from(i) * 0.01);
        at.map(|x| (taken(half(opacity), x, 0.0) - whole(x)).abs()).fold(0.0, f64::max) / opacity
    }

    /// They take as much of a picture, and stray nowhere further than in the middle, which they leave.
    #[test]
    fn halves_take_as_much_of_a_picture() {
        assert!((DEVIATION * DEVIATION + SHIFT * SHIFT - 1.0).abs() < 1e-12);
        for opacity in [1e-3, 0.1, 0.5, 0.9, 1.0] {
            let at = |i: i32| f64::from(i) * 0.05;
            let each = half(opacity);
            assert!(each > 0.79 * opacity && each < 0.85 * opacity, "{opacity}: {each}");
            let cells = (-120..=120).flat_map(|i| (-120..=120).map(move |j| taken(each, at(i), at(j))));
            let (sum, whole) = (cells.sum::<f64>() * 0.05 * 0.05, 2.0 * std::f64::consts::PI * opacity);
            assert!((sum - whole).abs() < 1e-4 * whole, "{opacity}: {sum} for {whole}");
            let middle = 1.0 - taken(each, 0.0, 0.0) / opacity;
            assert!((most(opacity) - middle).abs() < 1e-9 && middle < 0.39, "{opacity}: {middle}");
        }
    }

    /// A picture of one, long and turned, and of its halves: they differ by no more than is derived, and in the mean hardly.
    #[test]
    fn halves_are_drawn_nearly_as_the_whole() {
        let gpu = testing::gpu();
        let camera = Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0, 0.0, 4.0],
            focal: [80.0, 80.0],
            principal: [32.0, 32.0],
            distortion: [0.0; 4],
            size: [64, 64],
        };
        for opacity in [0.2, 0.9] {
            let one = Cloud {
                position: vec![[0.05, -0.1, 0.0]],
                // Turned by 60 degrees about the line of sight.
                log_scale: vec![[0.1f32.ln(), 0.3f32.ln(), 0.05f32.ln()]],
                rotation: vec![[0.866_025_4, 0.0, 0.0, 0.5]],
                logit: vec![logit(opacity)],
                degree: 0,
                harmonics: vec![[1.0; 3]],
                antialiased: false,
            };
            let picture = |gaussians: Static| {
                let drawer = Drawer::new(&gpu, gaussians, &Render::default(), [0.0; 3]);
                drawer.and_then(|mut drawer| drawer.draw(&camera)).expect("a picture")
            };
            let whole = picture(Static::upload(&gpu, &one).expect("room"));
            let mut gaussians = Static::with_room(&gpu, &one, 2, 1.0).expect("room");
            run(&gpu, &mut gaussians, &Config::default(), Round { voxel: 0.0, seed: 0, step: 1 }).expect("a round");
            assert_eq!(gaussians.count, 2);
            let [a, b] = gaussians.read(&gpu).expect("readable").position[..] else { panic!("two halves") };
            let apart = (0..3).map(|k| f64::from(a[k] - b[k]).powi(2)).sum::<f64>().sqrt();
            assert!((apart - 2.0 * SHIFT * 0.3).abs() < 1e-5, "{apart}");
            let halves = picture(gaussians);
            let color = 0.5 + 0.282_095; // of the harmonics
            let sum = |picture: &[[f32; 3]]| picture.iter().map(|rgb| f64::from(rgb[0])).sum::<f64>();
            let differ = whole.iter().zip(&halves).map(|(a, b)| f64::from(a[0] - b[0]).abs()).fold(0.0, f64::max);
            // A hundredth for what pictures add to every Gaussian's variance and leave out beyond its rim.
            assert!(differ < color * opacity * most(opacity) + 0.01, "{opacity}: {differ}");
            let ratio = sum(&halves) / sum(&whole);
            assert!((ratio - 1.0).abs() < 0.01, "{opacity}: {ratio}");
        }
    }

    #[test]
    fn rows_are_put_in_their_places() {
        let gpu = testing::gpu();
        for (rows, width) in [(0, 3), (1, 1), (21, 3), (64, 4), (100, 12)] {
            let case = split_scatter::Arrays {
                places: (0..rows as u32).map(|row| 2 * row + 1).collect(),
                from: (0..(rows * width) as u32).collect(),
                to: vec![0xdead_beef; (2 * rows + 2) * width],
            };
            let push = split_scatter::Push { rows: rows as u32, width: width as u32 };
            testing::assert_twin(split_scatter::Kernel, &gpu, case, push, rows * width);
        }
    }

    fn cloud(n: usize) -> Cloud {
        Cloud {
            position: (0..n).map(|i| [i as f32, 0.0, 0.0]).collect(),
            log_scale: (0..n).map(|i| [i as f32 * 0.1; 3]).collect(),
            rotation: vec![[1.0, 0.0, 0.0, 0.0]; n],
            logit: (0..n).map(|i| if i % 4 == 0 { -9.0 } else { logit(0.1 + 0.02 * i as f64) }).collect(),
            degree: 1,
            harmonics: (0..4 * n).map(|i| [i as f32; 3]).collect(),
            antialiased: false,
        }
    }

    #[test]
    fn faded_ones_become_halves_and_new_ones_come_until_there_is_no_room() {
        let gpu = testing::gpu();
        let (n, config) = (40, Config { max_gaussians: 46, ..Config::default() });
        let split = |seed: u64| {
            let mut gaussians = Static::with_room(&gpu, &cloud(n), 45, 0.05).expect("room");
            for moment in [&gaussians.position.first, &gaussians.position.root] {
                gpu.write(moment, &vec![1.0; 3 * n]).expect("written");
            }
            let counts: Vec<(u32, u32)> = (1..=3)
                .map(|step| {
                    let moved = run(&gpu, &mut gaussians, &config, Round { voxel: 0.0, seed, step }).expect("a round");
                    (moved, gaussians.count)
                })
                .collect();
            assert_eq!(counts, [(10, 42), (0, 45), (0, 45)], "a twentieth of 40 and of 42, and then the room is full");
            let moments = [&gaussians.position.first, &gaussians.position.root];
            (gaussians.read(&gpu).expect("Gaussians"), moments.map(|m| gpu.read_range(m, 45 * 3).expect("moments")))
        };
        let (after, [first, root]) = split(1);
        let before = cloud(n);
        assert!(after.logit.iter().all(|l| sigmoid(*l) >= config.min_opacity), "none is faded");
        for i in 0..after.len() {
            // Harmonics say which one each was.
            let was = after.harmonics_of(i)[0][0] as usize / 4;
            assert!(!was.is_multiple_of(4) && (i >= n || i.is_multiple_of(4) || was == i), "{i} was {was}");
            let others = (0..after.len()).filter(|j| after.harmonics_of(*j)[0][0] as usize / 4 == was).count();
            assert_eq!(others > 1, sigmoid(after.logit[i]) < sigmoid(before.logit[was]) - 1e-6, "{i}: {others}");
            assert_eq!(others > 1, after.position[i] != before.position[was], "halves lie apart");
            assert_eq!(others == 1, first[3 * i] == 1.0, "halves have no first moment");
            assert_eq!(root[3 * i], 1.0, "and the second one of the whole");
        }
        assert!(split(1) == (after.clone(), [first, root]), "the same seed, the same Gaussians");
        assert!(split(2).0 != after, "another, others");
    }

    /// Nothing to go by is left as it is, and what has no weight, or one that is no number, is not drawn.
    #[test]
    fn what_has_faded_stays() {
        let gpu = testing::gpu();
        let faded = Cloud { logit: vec![-9.0; 9], ..cloud(9) };
        let mut gaussians = Static::with_room(&gpu, &faded, 12, 1.0).expect("room");
        let moved =
            run(&gpu, &mut gaussians, &Config::default(), Round { voxel: 0.0, seed: 0, step: 1 }).expect("a round");
        assert_eq!((moved, gaussians.count), (0, 9));
        let weights = [0.0, 1.0, f64::INFINITY, f64::NAN, 2.0];
        for step in 1..20 {
            let mut drawn = draw(&weights, 4, Round { voxel: 0.0, seed: 0, step });
            drawn.sort_unstable();
            assert_eq!(drawn, [1, 4]);
        }
        let heavier = (0..1000).filter(|&step| draw(&weights, 1, Round { voxel: 0.0, seed: 0, step }) == [4]).count();
        assert!((600..730).contains(&heavier), "two thirds of the draws: {heavier}");
    }
}
