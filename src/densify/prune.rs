//! Anchors that stay transparent go.

use crate::gpu::kernels::densify::{prune, prune_cap, prune_gather};
use crate::gpu::{Buffer, Error, Gpu, Recorder, Reference};
use crate::model::anchors::Anchors;
use crate::primitives::{Compact, Count};

use super::{Config, Statistics};

impl Reference for prune::Kernel {
    fn reference(host: prune::Host<'_>, push: prune::Push, (): ()) {
        for a in 0..push.anchors as usize {
            let n = host.visits[a];
            let mut kept = true;
            if n > push.min_visits {
                // Float32 as on the device: a threshold.
                let faint = host.opacity_sum[a] < push.min_opacity * n as f32;
                kept = !faint;
                host.opacity_sum[a] = 0.0;
                host.visits[a] = 0;
            }
            host.keep[a] = kept.into();
        }
    }
}

impl Reference for prune_gather::Kernel {
    fn reference(host: prune_gather::Host<'_>, push: prune_gather::Push, (): ()) {
        let width = push.width as usize;
        for (to, &from) in host.to.chunks_mut(width).zip(&host.kept[..push.rows as usize]) {
            to.copy_from_slice(&host.from[from as usize * width..][..width]);
        }
    }
}

impl Reference for prune_cap::Kernel {
    fn reference(host: prune_cap::Host<'_>, push: prune_cap::Push, (): ()) {
        for row in host.log_scaling.chunks_mut(6).take(push.anchors as usize) {
            for value in &mut row[3..] {
                if *value > push.cap {
                    *value = push.cap;
                }
            }
        }
    }
}

/// Moves the rows `kept` of `buffer` together, in order, by way of a fresh buffer of the same size that takes its place.
/// Where there is no room for a second model, there is for one array at a time.
fn gather<T: bytemuck::Pod>(
    rec: &mut Recorder<'_>,
    kept: &Buffer<u32>,
    rows: u32,
    width: u32,
    buffer: &mut Buffer<T>,
) -> Result<(), Error> {
    rec.make_room(buffer.bytes())?;
    let gpu = rec.gpu();
    let fresh: Buffer<T> = gpu.stage(buffer.stage(), || gpu.buffer(buffer.name(), buffer.len()))?;
    // What lies behind the rows stays initialised: the optimiser works in whole vectors.
    rec.zero(&fresh);
    let buffers = prune_gather::Buffers { kept, from: &buffer.view(), to: &fresh.view() };
    let words = u64::from(rows) * u64::from(width);
    rec.run(prune_gather::Kernel, buffers, prune_gather::Push { rows, width }, words as usize);
    *buffer = fresh;
    Ok(())
}

/// Removes anchors that were in view more than `min_anchor_visits` times with a mean opacity (sum of the positive
/// opacities per visit) below `min_opacity`. The others keep their order, parameters, moments and statistics; opacity
/// statistics of all that were judged start afresh. Then caps the Gaussians' log-scales. Returns how many went.
///
/// # Errors
/// As [`Gpu::buffer`].
pub fn run(gpu: &Gpu, anchors: &mut Anchors, statistics: &mut Statistics, config: &Config) -> Result<u32, Error> {
    let n = anchors.count;
    let offsets = anchors.offsets;
    let keep = gpu.buffer("keep", n as usize)?;
    let kept = gpu.buffer("kept", n as usize)?;
    let kept_count = gpu.buffer("kept_count", 1)?;
    let compact = Compact::new(gpu, n)?;
    let mut rec = gpu.recorder()?;
    let buffers = prune::Buffers { opacity_sum: &statistics.opacity_sum, visits: &statistics.visits, keep: &keep };
    let push = prune::Push { anchors: n, min_visits: config.min_anchor_visits, min_opacity: config.min_opacity as f32 };
    rec.run(prune::Kernel, buffers, push, n);
    compact.record(&mut rec, &keep, &kept, &kept_count, Count::Host(n));
    let kept_count = rec.read_back(&kept_count)?;
    rec.flush()?;
    let rows = gpu.read(&kept_count)?[0];
    let cap = config.max_log_scaling as f32;
    if rows == n && cap == f32::INFINITY {
        return Ok(0);
    }
    if rows < n {
        let rec = &mut rec;
        gather(rec, &kept, rows, 3, &mut anchors.position)?;
        for parameter in anchors.parameters_mut() {
            let width = parameter.width;
            for tensor in parameter.tensors_mut() {
                gather(rec, &kept, rows, width, tensor)?;
            }
        }
        gather(rec, &kept, rows, offsets, &mut statistics.gradient)?;
        gather(rec, &kept, rows, offsets, &mut statistics.seen)?;
        gather(rec, &kept, rows, 1, &mut statistics.opacity_sum)?;
        gather(rec, &kept, rows, 1, &mut statistics.visits)?;
        anchors.count = rows;
    }
    if cap < f32::INFINITY {
        let buffers = prune_cap::Buffers { log_scaling: &anchors.log_scaling().value };
        rec.run(prune_cap::Kernel, buffers, prune_cap::Push { anchors: rows, cap }, rows);
    }
    rec.submit()?.wait()?;
    Ok(n - rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::testing::{self, UNWRITTEN};
    use crate::model::files;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    const PATTERN: u32 = 0xdead_beef;

    #[test]
    fn kernels_match_their_twins() {
        let gpu = testing::gpu();
        for n in [0, 1, 63, 64, 65, 1000] {
            let mut rng = Pcg64Mcg::seed_from_u64(n as u64);
            let visits: Vec<u32> = (0..n + 3).map(|_| rng.random_range(70..100)).collect();
            let case = prune::Arrays {
                // A third exactly at the limit.
                opacity_sum: visits
                    .iter()
                    .map(|&v| 0.25 * v as f32 * [0.9, 1.0, 1.1][rng.random_range(0..3)])
                    .collect(),
                visits,
                keep: vec![PATTERN; n + 3],
            };
            let push = prune::Push { anchors: n as u32, min_visits: 80, min_opacity: 0.25 };
            testing::assert_twin(prune::Kernel, &gpu, case, push, n + 3);
            let mut kept: Vec<u32> = (0..n as u32).map(|i| 3 * i + 1).collect();
            kept.push(PATTERN);
            for width in [1, 3, 32] {
                let case = prune_gather::Arrays {
                    kept: kept.clone(),
                    from: (0..3 * (n + 1) as u32 * width).collect(),
                    to: vec![PATTERN; (n + 1) * width as usize],
                };
                let push = prune_gather::Push { rows: n as u32, width };
                testing::assert_twin(prune_gather::Kernel, &gpu, case, push, (n + 1) * width as usize);
            }
            let mut case =
                prune_cap::Arrays { log_scaling: (0..6 * (n + 1)).map(|_| rng.random_range(-3.0..1.0)).collect() };
            case.log_scaling[4] = UNWRITTEN;
            testing::assert_twin(
                prune_cap::Kernel,
                &gpu,
                case,
                prune_cap::Push { anchors: n as u32, cap: -1.0 },
                n + 1,
            );
        }
    }

    /// Every array of a model and its statistics, rows apart.
    fn rows(gpu: &Gpu, anchors: &Anchors, statistics: &Statistics) -> Vec<Vec<Vec<u32>>> {
        let n = anchors.count as usize;
        let mut all = vec![(gpu.read_range(&anchors.position.view(), 3 * n).unwrap(), 3)];
        for parameter in anchors.parameters() {
            for tensor in parameter.tensors() {
                let width = parameter.width as usize;
                all.push((gpu.read_range(&tensor.view(), width * n).unwrap(), width));
            }
        }
        let offsets = anchors.offsets as usize;
        all.push((gpu.read_range(&statistics.gradient.view(), offsets * n).unwrap(), offsets));
        all.push((gpu.read_range(&statistics.seen, offsets * n).unwrap(), offsets));
        all.push((gpu.read_range(&statistics.opacity_sum.view(), n).unwrap(), 1));
        all.push((gpu.read_range(&statistics.visits, n).unwrap(), 1));
        all.into_iter().map(|(words, width)| words.chunks(width).map(<[u32]>::to_vec).collect()).collect()
    }

    #[test]
    fn prunes_as_written_down() {
        let gpu = testing::gpu();
        let offsets = 10;
        // Which mean opacities there are, and what that prunes.
        for (n, faint, all_or_none) in
            [(1000, 0.3, None), (300, 0.0, Some(0)), (300, 1.0, Some(300)), (0, 0.5, Some(0)), (5000, 0.9, None)]
        {
            let mut rng = Pcg64Mcg::seed_from_u64(n as u64);
            let mut random = |len: usize| -> Vec<f32> { (0..len).map(|_| rng.random_range(-1.0..1.0)).collect() };
            let model = files::Anchors::new(
                offsets,
                random(3 * n).as_chunks().0.to_vec(),
                random(32 * n).as_chunks().0.to_vec(),
                random(3 * offsets * n),
                random(6 * n).as_chunks().0.to_vec(),
            );
            let mut anchors = Anchors::upload(&gpu, &model, n as u32 + 9).unwrap();
            for parameter in anchors.parameters() {
                gpu.write(&parameter.first, &random(n * parameter.width as usize)).unwrap();
                gpu.write(&parameter.root, &random(n * parameter.width as usize)).unwrap();
            }
            let mut statistics = Statistics::new(&gpu, anchors.capacity, offsets as u32, false).unwrap();
            gpu.write(&statistics.gradient, &random(n * offsets)).unwrap();
            gpu.write(&statistics.seen, &(0..(n * offsets) as u32).collect::<Vec<_>>()).unwrap();
            let always = all_or_none.is_some();
            let visits: Vec<u32> = (0..n).map(|_| if always { 100 } else { rng.random_range(0..200) }).collect();
            let mean = |rng: &mut Pcg64Mcg| if rng.random_bool(faint) { 0.004 } else { 0.006 };
            let sums: Vec<f32> = visits.iter().map(|&v| v as f32 * mean(&mut rng)).collect();
            gpu.write(&statistics.visits, &visits).unwrap();
            gpu.write(&statistics.opacity_sum, &sums).unwrap();
            let mut want = rows(&gpu, &anchors, &statistics);

            let config = Config { max_log_scaling: 0.5, ..Config::default() };
            let pruned = run(&gpu, &mut anchors, &mut statistics, &config).unwrap();

            let stays = |a: usize| visits[a] <= 80 || f64::from(sums[a]) / f64::from(visits[a]) >= 0.005;
            let last = want.len() - 1;
            for a in 0..n {
                if visits[a] > 80 {
                    want[last - 1][a] = vec![0];
                    want[last][a] = vec![0];
                }
                for value in &mut want[7][a][3..] {
                    *value = f32::from_bits(*value).min(0.5).to_bits();
                }
            }
            for rows in &mut want {
                let mut a = 0..n;
                rows.retain(|_| a.next().is_some_and(stays));
            }
            println!("{n} anchors, {pruned} pruned");
            assert_eq!(pruned as usize, n - want[0].len());
            assert_eq!(anchors.count as usize, want[0].len());
            assert!(all_or_none.is_none_or(|expected| expected == pruned));
            assert!(all_or_none.is_some() || (pruned > 0 && anchors.count > 0));
            assert!(rows(&gpu, &anchors, &statistics) == want);
        }
    }

    #[test]
    fn an_infinite_cap_leaves_the_scales_alone() {
        let gpu = testing::gpu();
        let model = files::Anchors::new(10, vec![[0.0; 3]], vec![[0.0; 32]], vec![0.0; 30], vec![[7.0; 6]]);
        let mut anchors = Anchors::upload(&gpu, &model, 0).unwrap();
        let mut statistics = Statistics::new(&gpu, 1, 10, false).unwrap();
        let config = Config { max_log_scaling: f64::INFINITY, ..Config::default() };
        assert_eq!(run(&gpu, &mut anchors, &mut statistics, &config).unwrap(), 0);
        assert_eq!(anchors.read(&gpu).unwrap(), model);
    }
}
