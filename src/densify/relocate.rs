//! Moving and adding plain Gaussians, as 3DGS-MCMC does (Kheradmand et al. 2024): those that have faded away move onto
//! others, and new ones begin on others until there are as many as the settings allow.
//!
//! Which ones take others is drawn by opacity. A Gaussian of opacity o that becomes n of them leaves the picture as it was,
//! to first order, with the opacity `1 - (1 - o)^(1/n)` each and scales that keep its integral (equation 9 there). All of
//! them begin with moments of zero. It happens on the host, between steps, an array at a time, and depends on the model,
//! the seed and the step alone.

use rand::RngExt as _;
use rand_pcg::Pcg64;

use super::Config;
use crate::gpu::{Error, Gpu};
use crate::model::gaussians::{Static, sigmoid};

/// The seed of a round's random numbers.
#[derive(Clone, Copy, Debug)]
pub struct Round {
    /// The run's seed.
    pub seed: u64,
    /// The step behind which the round comes.
    pub step: u32,
}

/// A Gaussian that takes others onto itself.
#[derive(Debug, Clone, PartialEq)]
struct Shared {
    /// The Gaussian.
    source: usize,
    /// The Gaussians that become copies of it.
    copies: Vec<usize>,
    /// Logit of the opacity that each has then.
    logit: f32,
    /// Added to each of the log-scales.
    log_scale: f32,
}

/// One Gaussian becomes as many at most: their scales are sums of binomials of this number, with either sign.
const MOST: usize = 51;

/// Opacity that each of n Gaussians in the place of one has, and the factor of its scales.
fn shared(opacity: f64, n: usize) -> (f64, f64) {
    let each = 1.0 - (1.0 - opacity).powf(1.0 / n as f64);
    let mut sum = 0.0;
    for i in 0..n {
        let mut binomial = 1.0;
        for k in 0..=i {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            sum += sign * binomial * each.powi(k as i32 + 1) / ((k + 1) as f64).sqrt();
            binomial *= (i - k) as f64 / (k + 1) as f64;
        }
    }
    (each, opacity / sum)
}

/// Which Gaussians take which, in the order of the takers, so that `target` are there; those of an opacity below
/// `faded` move.
fn draw(opacity: &[f64], faded: f64, target: usize, round: Round) -> Vec<Shared> {
    let moving = (0..opacity.len()).filter(|i| opacity[*i] < faded).chain(opacity.len()..target);
    let mut sum = 0.0;
    let below: Vec<f64> = opacity
        .iter()
        .map(|o| {
            sum += if *o < faded { 0.0 } else { *o };
            sum
        })
        .collect();
    if sum <= 0.0 {
        return vec![];
    }
    let mut generator = Pcg64::new(u128::from(round.seed) << 32 | u128::from(round.step), STREAM);
    let mut takers: std::collections::BTreeMap<usize, Vec<usize>> = std::collections::BTreeMap::new();
    for copy in moving {
        let at = generator.random::<f64>() * sum;
        let source = below.partition_point(|sum| *sum <= at).min(opacity.len() - 1);
        takers.entry(source).or_default().push(copy);
    }
    let one = |(source, copies): (usize, Vec<usize>)| {
        let (each, factor) = shared(opacity[source].min(LARGEST), (copies.len() + 1).min(MOST));
        let each = each.max(faded);
        Shared { source, copies, logit: (each / (1.0 - each)).ln() as f32, log_scale: factor.ln() as f32 }
    };
    takers.into_iter().map(one).collect()
}

/// Opacity above which a Gaussian is as opaque as another.
const LARGEST: f64 = 1.0 - 1e-6;

/// Stream of the generator that draws who takes whom, apart from those of other random choices of the same seed.
const STREAM: u128 = 0x7265_6c6f_6361_7465;

/// Copies the rows of those that are taken, and fills both moments of all that took part.
fn apply(shared: &[Shared], tensors: &mut [Vec<f32>; 3], width: usize) {
    let [value, moments @ ..] = tensors;
    for Shared { source, copies, .. } in shared {
        for copy in copies {
            value.copy_within(source * width..(source + 1) * width, copy * width);
        }
        for row in copies.iter().chain([source]) {
            moments.iter_mut().for_each(|moment| moment[row * width..(row + 1) * width].fill(0.0));
        }
    }
}

/// Share by which a round enlarges the number of plain Gaussians, as 3DGS-MCMC does.
pub const GROWTH: f64 = 0.05;

/// Moves those that have faded below `config.min_opacity` and adds new ones, [`GROWTH`] of all, up to
/// `config.max_gaussians` and the room there is. Returns how many moved. Nothing may be in flight.
///
/// # Errors
/// Errors of the copies.
pub fn run(gpu: &Gpu, gaussians: &mut Static, config: &Config, round: Round) -> Result<u32, Error> {
    let count = gaussians.count as usize;
    let opacity: Vec<f64> = gaussians.logit.read(gpu, gaussians.count)?.into_iter().map(sigmoid).collect();
    let grown = (count as f64 * (1.0 + GROWTH)).ceil() as usize;
    let target = grown.min(config.max_gaussians as usize).min(gaussians.capacity as usize).max(count);
    let shared = draw(&opacity, config.min_opacity, target, round);
    let moved = shared.iter().flat_map(|shared| &shared.copies).filter(|copy| **copy < count).count();
    if shared.is_empty() {
        return Ok(0);
    }
    for (i, parameter) in gaussians.parameters().into_iter().enumerate() {
        let width = parameter.width as usize;
        let [value, first, root] = parameter.tensors().map(|tensor| gpu.read_range(tensor, count * width));
        let mut tensors = [value?, first?, root?];
        tensors.iter_mut().for_each(|tensor| tensor.resize(target * width, 0.0));
        apply(&shared, &mut tensors, width);
        for Shared { source, copies, logit, log_scale } in &shared {
            for row in copies.iter().chain([source]) {
                let row = &mut tensors[0][row * width..(row + 1) * width];
                match i {
                    LOG_SCALE => row.iter_mut().for_each(|v| *v += log_scale),
                    LOGIT => row.fill(*logit),
                    _ => {}
                }
            }
        }
        parameter.tensors().into_iter().zip(&tensors).try_for_each(|(to, tensor)| gpu.write(to, tensor))?;
    }
    gaussians.count = target as u32;
    Ok(moved as u32)
}

/// Places in [`Static::parameters`].
const LOG_SCALE: usize = 1;
const LOGIT: usize = 3;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing;
    use crate::model::gaussians::{Cloud, logit};

    /// In the middle of a pixel the n of them let as much through as the one did; and a single one is itself.
    #[test]
    fn a_share_lets_as_much_through() {
        for opacity in [0.01, 0.3, 0.9, 0.999_999] {
            let (same, factor) = shared(opacity, 1);
            assert!((same - opacity).abs() < 1e-12 && (factor - 1.0).abs() < 1e-12);
            for n in [2, 3, 10, MOST] {
                let (each, factor) = shared(opacity, n);
                assert!(((1.0 - each).powi(n as i32) - (1.0 - opacity)).abs() < 1e-9, "{opacity} {n}");
                // Along a line through its middle the n of them take as much as the one: equation 9.
                let steps = 20_000;
                let at = |i: usize| -8.0 + 16.0 * i as f64 / f64::from(steps);
                let taken = |each: f64, width: f64, n: usize| -> f64 {
                    let one = |x: f64| 1.0 - (1.0 - each * (-0.5 * (x / width) * (x / width)).exp()).powi(n as i32);
                    (0..=steps as usize).map(|i| one(at(i))).sum::<f64>() * 16.0 / f64::from(steps)
                };
                let (one, many) = (taken(opacity, 1.0, 1), taken(each, factor, n));
                assert!((one - many).abs() < 1e-6 * one, "{opacity} {n}: {one} {many}");
            }
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
    fn faded_ones_move_and_new_ones_come_until_there_is_no_room() {
        let gpu = testing::gpu();
        let (n, config) = (40, Config { max_gaussians: 46, ..Config::default() });
        let moved = |seed: u64| {
            let mut gaussians = Static::with_room(&gpu, &cloud(n), 45, 0.05).expect("room");
            gpu.write(&gaussians.position.first, &vec![1.0; 3 * n]).expect("written");
            let counts: Vec<(u32, u32)> = (1..=3)
                .map(|step| {
                    let moved = run(&gpu, &mut gaussians, &config, Round { seed, step }).expect("a round");
                    (moved, gaussians.count)
                })
                .collect();
            assert_eq!(counts, [(10, 42), (0, 45), (0, 45)], "a twentieth of 40 and of 42, and then the room is full");
            let first = gpu.read_range(&gaussians.position.first, 45 * 3).expect("moments");
            (gaussians.read(&gpu).expect("Gaussians"), first)
        };
        let (after, first) = moved(1);
        let before = cloud(n);
        assert!(after.logit.iter().all(|l| sigmoid(*l) >= config.min_opacity), "none is faded");
        for i in 0..after.len() {
            // Positions say which one each was.
            let was = after.position[i][0] as usize;
            assert!(!was.is_multiple_of(4) && (i >= n || i.is_multiple_of(4) || was == i), "{i} was {was}");
            assert_eq!(after.harmonics_of(i)[0], before.harmonics_of(was)[0]);
            let others = after.position.iter().filter(|p| p[0] as usize == was).count();
            assert_eq!(others > 1, sigmoid(after.logit[i]) < sigmoid(before.logit[was]) - 1e-6, "{i}: {others}");
            assert_eq!(others == 1, first[3 * i] == 1.0, "moments of what took part are zero");
        }
        assert!(moved(1) == (after.clone(), first), "the same seed, the same Gaussians");
        assert!(moved(2).0 != after, "another, others");
    }

    /// Nothing to go by is left as it is.
    #[test]
    fn a_model_that_has_faded_stays() {
        assert_eq!(draw(&[0.001; 9], 0.005, 12, Round { seed: 0, step: 1 }), []);
        assert_eq!(draw(&[0.5; 9], 0.005, 9, Round { seed: 0, step: 1 }), []);
    }
}
