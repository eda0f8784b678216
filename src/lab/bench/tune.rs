//! The choices of tile and group shapes that exist as data, each option in turn on the same work: what is best on this
//! device, with its evidence, in the form of a table for the source.

use rand::RngExt;
use rand_pcg::Pcg64;
use serde::{Deserialize, Serialize};

use super::ceilings::span;
use crate::config::Settings;
use crate::gpu::{self, Form, Gpu};
use crate::lab::pareto;
use crate::lab::report::Error;
use crate::lab::report::kernels::Bench;
use crate::lab::statistics::Spread;
use crate::math::attention::{FEATURE, WEIGHTS};
use crate::model::attention::{Attention, Pair, Sharing};
use crate::primitives::Count;
use crate::primitives::sort::{self, Pairs, Sort, Tuning};
use crate::render::config::Tiles;
use crate::render::tiling::Tiling;

/// One way to do it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OptionFigures {
    /// Its name.
    pub option: String,
    /// Whether it is what the program takes by itself on this device.
    pub shipped: bool,
    /// Milliseconds.
    pub milliseconds: Spread,
    /// These in terms of the shipped one's, round by round.
    pub ratio: Spread,
}

/// A choice.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ChoiceFigures {
    /// What is chosen.
    pub choice: String,
    /// What was timed.
    pub work: String,
    /// The options, the fastest first.
    pub options: Vec<OptionFigures>,
    /// The shipped one unless most rounds agree that another is faster.
    pub best: String,
}

impl ChoiceFigures {
    /// From the times of every option in every round; `shipped` is an index.
    fn new(choice: &str, work: String, names: &[String], times: &[Vec<f64>], shipped: usize) -> Self {
        let mut options: Vec<OptionFigures> = names
            .iter()
            .zip(times)
            .enumerate()
            .map(|(i, (name, own))| OptionFigures {
                option: name.clone(),
                shipped: i == shipped,
                milliseconds: Spread::of(own),
                ratio: pareto::ratio(own, &times[shipped]),
            })
            .collect();
        options.sort_by(|a, b| a.ratio.median.total_cmp(&b.ratio.median));
        let best = options.iter().find(|o| o.shipped || pareto::is_shorter(&o.ratio));
        let best = best.map_or_else(|| names[shipped].clone(), |o| o.option.clone());
        Self { choice: choice.to_owned(), work, options, best }
    }
}

/// Times of all options, interleaved: the first round warms up and does not count.
fn rounds<E>(
    options: usize,
    repetitions: usize,
    mut time: impl FnMut(usize) -> Result<f64, E>,
) -> Result<Vec<Vec<f64>>, E> {
    let mut times = vec![vec![]; options];
    for round in 0..=repetitions.max(1) {
        for turn in 0..options {
            let which = (turn + round) % options;
            let milliseconds = time(which)?;
            if round > 0 {
                times[which].push(milliseconds);
            }
        }
    }
    Ok(times)
}

/// Shapes of the rasteriser's tiles, by the whole step: binning has a part in it.
fn tiles(
    gpu: &Gpu,
    settings: &Settings,
    repetitions: usize,
    make: &mut dyn FnMut(&Settings) -> Result<Bench, Error>,
) -> Result<Option<ChoiceFigures>, Error> {
    if Tiling::of(gpu) != Tiling::Narrow {
        // The narrow shape needs subgroups of 8.
        return Ok(None);
    }
    let shapes = [(Tiles::Narrow, "narrow"), (Tiles::Wide, "wide")];
    let mut benches = vec![];
    for (shape, _) in shapes {
        let mut settings = settings.clone();
        settings.render.tiles = shape;
        benches.push(make(&settings)?);
    }
    let views = benches[0].views().len();
    let times = rounds(shapes.len(), repetitions, |which| {
        let mut sum = 0.0;
        for view in 0..views {
            sum += span(&benches[which].clock(gpu, view)?.passes) * 1e-6 / views as f64;
        }
        Ok::<_, Error>(sum)
    })?;
    let names = shapes.map(|(_, name)| name.to_owned());
    Ok(Some(ChoiceFigures::new("render.tiles", "the whole step".into(), &names, &times, 0)))
}

/// How the attention's kernels share the work.
fn attention(gpu: &Gpu, tokens: u32, repetitions: usize) -> Result<Option<ChoiceFigures>, gpu::Error> {
    let ways = Sharing::all(gpu);
    if ways.len() < 2 {
        return Ok(None);
    }
    let n = tokens as usize * FEATURE;
    let mut rng = Pcg64::new(0, 3);
    let mut values = |n: usize| (0..n).map(|_| rng.random_range(-1.7f32..1.7)).collect::<Vec<f32>>();
    let upload = |values: Vec<f32>| gpu.upload("tokens' features", &values);
    let features = [upload(values(n))?, upload(values(n))?];
    let upstream = [upload(values(n))?, upload(values(n))?];
    let weights = gpu.upload("weights", &Attention::initial_weights(&mut Pcg64::new(0, 4)))?;
    let grad_weights = gpu.buffer::<f32>("grad_weights", WEIGHTS)?;
    let counts = gpu.upload("tokens", &[tokens, tokens])?;
    let stages = ways.iter().map(|&way| Attention::of(gpu, tokens, way)).collect::<Result<Vec<_>, _>>()?;
    let best = Sharing::best(gpu, tokens);
    let shipped = ways.iter().position(|&way| way == best).expect("the best way is one of all");
    let pair = |of: &'_ [gpu::Buffer<f32>; 2]| (of[0].view(), of[1].view());
    let times = rounds(ways.len(), repetitions, |which| {
        let stage = &stages[which];
        let mut rec = gpu.recorder()?;
        let ((a, b), (c, d)) = (pair(&features), pair(&upstream));
        let (features, upstream) = (Pair { inside: &a, around: &b }, Pair { inside: &c, around: &d });
        stage.forward(&mut rec, &counts, features, &weights);
        stage.backward(&mut rec, &counts, features, &weights, upstream, &grad_weights);
        Ok::<_, gpu::Error>(span(&rec.submit()?.wait()?) * 1e-6)
    })?;
    let names: Vec<String> = ways.iter().map(|way| format!("{way:?}").to_lowercase()).collect();
    let work = format!("attention both ways, {tokens} tokens a side");
    Ok(Some(ChoiceFigures::new("attention kernels", work, &names, &times, shipped)))
}

/// Keys of a thread and bits of a digit of the radix sort.
fn sorting(gpu: &Gpu, keys: u32, bits: u32, repetitions: usize) -> Result<ChoiceFigures, gpu::Error> {
    let cpu = gpu.form() == Form::Cpu;
    let of = |items, digit_bits| Tuning { items, digit_bits };
    let tunings = [
        if cpu { sort::CPU } else { sort::GPU },
        if cpu { sort::GPU } else { sort::CPU },
        of(16, 7),
        of(32, 6),
        of(32, 7),
        of(64, 6),
        of(64, 7),
        of(128, 7),
    ];
    let mut rng = Pcg64::new(0, 5);
    let words: Vec<u32> = (0..keys).map(|_| rng.random_range(0..1u32 << bits)).collect();
    let initial = gpu.upload("initial keys", &words)?;
    let (keys_buffer, values) = (gpu.upload("keys", &words)?, gpu.buffer("values", words.len())?);
    let count = gpu.upload("count", &[keys])?;
    let sorts = tunings.map(|tuning| Sort::tuned(gpu, keys, tuning));
    let sorts = sorts.into_iter().collect::<Result<Vec<_>, _>>()?;
    let times = rounds(sorts.len(), repetitions, |which| {
        let mut rec = gpu.recorder()?;
        // A second pass writes into the keys that it was given.
        rec.copy(&initial, &keys_buffer, words.len());
        rec.submit()?.wait()?;
        let mut rec = gpu.recorder()?;
        let pairs = Pairs { keys: &keys_buffer, values: &values };
        sorts[which].record_indices(&mut rec, pairs, Count::Device(&count), 0..bits);
        Ok::<_, gpu::Error>(span(&rec.submit()?.wait()?) * 1e-6)
    })?;
    let names = tunings.map(|t| format!("items {}, digit_bits {}", t.items, t.digit_bits));
    Ok(ChoiceFigures::new("sort", format!("{keys} keys of {bits} bits"), &names, &times, 0))
}

/// Keys of the sort.
const KEYS: u32 = 1 << 20;

/// Runs every choice. `make` puts the step that the tiles are judged by on the device.
///
/// # Errors
/// When the device has no room, or is lost.
pub(crate) fn measure(
    gpu: &Gpu,
    settings: &Settings,
    repetitions: usize,
    make: &mut dyn FnMut(&Settings) -> Result<Bench, Error>,
    say: &mut dyn FnMut(&str),
) -> Result<Vec<ChoiceFigures>, Error> {
    super::ensure_timestamps(gpu)?;
    let mut all = vec![];
    say("bench: shapes of the tiles");
    all.extend(tiles(gpu, settings, repetitions, make)?);
    say("bench: shapes of the attention");
    all.extend(attention(gpu, settings.model.attention.tokens, repetitions)?);
    for bits in [14, 28] {
        say(&format!("bench: shapes of the sort, keys of {bits} bits"));
        all.push(sorting(gpu, KEYS, bits, repetitions)?);
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, testing};
    use crate::skip::{Lack, skip};

    #[test]
    fn the_shipped_option_stays_unless_most_rounds_agree() {
        let names = ["a", "b", "c"].map(str::to_owned);
        let of =
            |times: [&[f64]; 3]| ChoiceFigures::new("choice", "work".into(), &names, &times.map(<[f64]>::to_vec), 0);
        let faster = of([&[2.0, 2.2, 2.1], &[1.0, 1.1, 1.2], &[4.0, 4.0, 4.0]]);
        assert_eq!((faster.best.as_str(), faster.options[0].option.as_str()), ("b", "b"));
        assert!(faster.options.iter().filter(|o| o.shipped).all(|o| o.option == "a" && o.ratio.median == 1.0));
        // Faster in its median and slower in every other round.
        let torn = of([&[1.0, 1.0, 1.0, 1.0], &[0.9, 1.2, 0.9, 1.2], &[4.0; 4]]);
        assert_eq!(torn.best, "a");
        let same = of([&[1.0; 3], &[0.99; 3], &[2.0; 3]]);
        assert_eq!(same.best, "a", "two per cent are no reason");
    }

    #[test]
    fn every_option_has_its_turn() {
        let mut order = vec![];
        let times = rounds(3, 2, |which| {
            order.push(which);
            Ok::<_, gpu::Error>(which as f64)
        });
        assert_eq!(times.expect("no errors"), [[0.0; 2], [1.0; 2], [2.0; 2]]);
        assert_eq!(order, [0, 1, 2, 1, 2, 0, 2, 0, 1], "nobody is always first");
    }

    /// All options give the same result on a validated device: sorted keys.
    #[test]
    fn the_choices_run() {
        let gpu = testing::fresh_gpu(Options { timestamps: true, ..Options::default() });
        if gpu.info().timestamp_period <= 0.0 {
            skip(Lack::Timestamps, &format!("{} has no timestamps", gpu.info().name));
            return;
        }
        let sorted = sorting(&gpu, 3000, 14, 1).expect("the device has room");
        assert_eq!(sorted.options.len(), 8);
        assert_eq!(sorted.options.iter().filter(|o| o.shipped).count(), 1);
        let attended = attention(&gpu, 13, 2).expect("the device has room");
        assert_eq!(attended.is_some(), gpu.runs_lanes(), "a choice only where there is one");
        let options = attended.map_or_else(Vec::new, |attended| attended.options);
        assert!(options.iter().all(|o| o.milliseconds.median > 0.0 && o.milliseconds.repetitions == 2));
    }
}
