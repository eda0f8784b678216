//! The model before the first step: anchors from structure-from-motion points, networks from a seed.

use std::cmp::Ordering;
use std::collections::{BTreeMap, HashSet};
use std::num::NonZero;

use glam::{DMat3, DQuat, DVec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rand::distr::{Distribution, Uniform};
use rand_pcg::Pcg64;

use crate::math::harmonics::{ZEROTH, coefficients};
use crate::scene::Point;
use crate::statistics::median;

use super::files::{ATTENTION_WIDTH, Anchors, FEATURES, Tensor, Weights, weight_shapes};
use super::gaussians::{Cloud, logit};

/// Why a model cannot start from these points.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum Error {
    /// Nothing to start from.
    #[error("the reconstruction has no points: training starts from its sparse point cloud")]
    NoPoints,
    /// Plain Gaussians that cannot be begun with.
    #[error("{0}")]
    From(String),
    /// A point that is NaN or infinite.
    #[error("point {index} of the reconstruction is not finite ({position:?})")]
    NotFinite {
        /// Its index.
        index: usize,
        /// Its coordinates.
        position: [f32; 3],
    },
    /// A voxel derived from points that all coincide.
    #[error("the voxel cannot be derived from points that all coincide: set model.voxel to a positive length")]
    NoSpacing,
    /// A point beyond the grid's 32-bit cells.
    #[error(
        "point {index} of the reconstruction ({position:?}) lies more than 2^31 voxels of {voxel} from the origin: \
         raise model.voxel or remove the point"
    )]
    TooFar {
        /// Its index.
        index: usize,
        /// Its coordinates.
        position: [f32; 3],
        /// The voxel's edge.
        voxel: f64,
    },
}

/// Anchors at the start of training, and the grid they stand on.
#[derive(Debug, Clone, PartialEq)]
pub struct Initial {
    /// One anchor per occupied voxel, sorted by cell (x, then y, then z).
    pub anchors: Anchors,
    /// Edge of the voxel in scene units: the one asked for, or the one derived from the points.
    pub voxel: f64,
}

/// Snaps points to the voxel grid, one anchor per occupied cell at `round(p / voxel) * voxel` (Scaffold-GS, section 3.1).
///
/// `voxel <= 0` stands for the median nearest-neighbour distance of the points. Features and offsets are zero. All six
/// log-scales of an anchor are the logarithm of [`mean_distance_to_nearest`] with the voxel as its floor. The order of
/// the points and their duplicates do not matter.
///
/// # Errors
/// No points, points that are not finite or too far for 32-bit cells, or no spacing to derive a voxel from.
pub fn anchors(points: &[[f32; 3]], voxel: f64, offsets_per_anchor: usize) -> Result<Initial, Error> {
    if points.is_empty() {
        return Err(Error::NoPoints);
    }
    let broken = points.iter().enumerate().find(|(_, p)| !p.iter().all(|v| v.is_finite()));
    if let Some((index, &position)) = broken {
        return Err(Error::NotFinite { index, position });
    }
    let voxel = if voxel > 0.0 { voxel } else { median_nearest_distance(points).ok_or(Error::NoSpacing)? };
    let mut cells = Vec::with_capacity(points.len());
    for (index, &position) in points.iter().enumerate() {
        let cell = cell(position, voxel);
        if cell.iter().any(|v| v.abs() > f64::from(i32::MAX)) {
            return Err(Error::TooFar { index, position, voxel });
        }
        cells.push(cell.map(|v| v as i32));
    }
    cells.sort_unstable();
    cells.dedup();
    let position: Vec<[f32; 3]> = cells.iter().map(|cell| cell.map(|v| (f64::from(v) * voxel) as f32)).collect();
    let log_scaling = mean_distance_to_nearest(&position, voxel).into_iter().map(|d| [d.ln() as f32; 6]).collect();
    let (feature, offset) = (vec![[0.0; FEATURES]; position.len()], vec![0.0; position.len() * offsets_per_anchor * 3]);
    let anchors = Anchors::new(offsets_per_anchor, position, feature, offset, log_scaling);
    Ok(Initial { anchors, voxel })
}

/// Anchors for these points at the voxel that the settings name, or at the one derived from the points times its factor.
///
/// The first three features are the mean colour of the anchor's points, from -1 to 1 times `color_features`; the offsets
/// are uniform in +- half of it, drawn from `seed`. 0 gives Scaffold-GS's zeros.
///
/// # Errors
/// As [`anchors`].
pub fn from_points(points: &[Point], config: &super::Config, seed: u64) -> Result<Initial, Error> {
    let positions: Vec<[f32; 3]> = points.iter().map(|p| p.position).collect();
    let derived = || median_nearest_distance(&positions).map_or(0.0, |d| d * config.voxel_factor);
    let voxel = if config.voxel > 0.0 { config.voxel } else { derived() };
    let mut initial = anchors(&positions, voxel, config.offsets as usize)?;
    if config.color_features > 0.0 {
        let feature = &mut initial.anchors.feature;
        for (feature, color) in feature.iter_mut().zip(mean_colors(points, voxel)) {
            for (feature, color) in feature.iter_mut().zip(color) {
                *feature = (config.color_features * (color / 127.5 - 1.0)) as f32;
            }
        }
        let mut generator = Pcg64::new(u128::from(seed), OFFSETS_STREAM);
        let spread = (0.5 * config.color_features) as f32;
        let uniform = Uniform::new_inclusive(-spread, spread).expect("the bound is positive and finite");
        initial.anchors.offset.fill_with(|| uniform.sample(&mut generator));
    }
    Ok(initial)
}

/// Plain Gaussians at these points, at most `config.max_gaussians` of the densify settings: more points than that are
/// thinned to one at the mean of each cell of the finest grid with as few occupied cells.
///
/// They are seven tenths as wide as [`mean_distance_to_nearest`], of the points' colours from all sides, and of the opacity
/// that the settings say. Where the points around one lie on a surface (by their spread) it is a disc along it, a tenth as thick as
/// the distance; elsewhere it is round. The order of the points does not matter.
///
/// # Errors
/// No points, or points that are not finite.
pub fn gaussians(points: &[Point], config: &super::Config, most: u32) -> Result<Cloud, Error> {
    if points.is_empty() {
        return Err(Error::NoPoints);
    }
    let broken = points.iter().enumerate().find(|(_, p)| !p.position.iter().all(|v| v.is_finite()));
    if let Some((index, point)) = broken {
        return Err(Error::NotFinite { index, position: point.position });
    }
    let mut points: Vec<([f64; 3], [f64; 3])> =
        points.iter().map(|p| (p.position.map(f64::from), p.color.map(f64::from))).collect();
    let order = |a: &([f64; 3], [f64; 3]), b: &([f64; 3], [f64; 3])| {
        let of = |p: &([f64; 3], [f64; 3])| [p.0, p.1];
        of(a).as_flattened().partial_cmp(of(b).as_flattened()).unwrap_or(Ordering::Equal)
    };
    points.sort_unstable_by(order);
    points.dedup_by(|a, b| a.0 == b.0);
    if points.len() > most as usize {
        points = thinned(&points, most as usize);
    }
    let position: Vec<[f32; 3]> = points.iter().map(|(p, _)| p.map(|v| v as f32)).collect();
    let floor = median_nearest_distance(&position).map_or(1e-3, |d| (d * 0.01).max(1e-6));
    let normals = normals(&position);
    let log_scale = mean_distance_to_nearest(&position, floor).into_iter().zip(&normals).map(|(distance, normal)| {
        let [wide, thick] =
            [WIDTH, if normal.is_some() { THICKNESS } else { WIDTH }].map(|v| (v * distance).ln() as f32);
        [wide, wide, thick]
    });
    let rotation = normals.iter().map(|normal| {
        let turn = normal.map_or(DQuat::IDENTITY, |normal| DQuat::from_rotation_arc(DVec3::Z, normal));
        [turn.w, turn.x, turn.y, turn.z].map(|v| v as f32)
    });
    let each = coefficients(config.degree);
    let harmonics = points.iter().flat_map(|(_, color)| {
        let first = color.map(|v| ((v / 255.0 - 0.5) / ZEROTH) as f32);
        std::iter::once(first).chain(std::iter::repeat_n([0.0; 3], each - 1))
    });
    let opacity = if config.opacity > 0.0 { config.opacity } else { 0.1 };
    Ok(Cloud {
        log_scale: log_scale.collect(),
        rotation: rotation.collect(),
        logit: vec![logit(opacity); points.len()],
        degree: config.degree,
        harmonics: harmonics.collect(),
        position,
        antialiased: false,
    })
}

/// Standard deviation of a Gaussian at a point along the surface, and across it, in mean distances to the nearest points.
const WIDTH: f64 = 0.7;
const THICKNESS: f64 = 0.1;
/// Points around one that tell the surface, itself included.
const AROUND: usize = 12;
/// They lie on a surface if they spread across it by at most this part of their whole spread (sums of squares).
const FLAT: f64 = 0.15;

/// The direction across which the points around each spread least, if they lie on a surface: the normal of Hoppe et al. 1992,
/// either way round.
fn normals(positions: &[[f32; 3]]) -> Vec<Option<DVec3>> {
    use rayon::prelude::*;

    let wide: Vec<[f64; 3]> = positions.iter().map(|p| p.map(f64::from)).collect();
    // Four points are the fewest that need not lie on a plane.
    let Some(asked) = NonZero::new(AROUND.min(positions.len())).filter(|asked| asked.get() >= 4) else {
        return vec![None; positions.len()];
    };
    let tree: ImmutableKdTree<f64, 3> = ImmutableKdTree::new_from_slice(&wide);
    let one = |position: &[f64; 3]| {
        let found = tree.nearest_n::<SquaredEuclidean>(position, asked);
        let around: Vec<DVec3> = found.iter().map(|near| DVec3::from(wide[near.item as usize])).collect();
        let mean = around.iter().sum::<DVec3>() / around.len() as f64;
        let spread = around.iter().fold(DMat3::ZERO, |sum, point| {
            let off = *point - mean;
            sum + DMat3::from_cols(off * off.x, off * off.y, off * off.z)
        });
        let whole = spread.x_axis.x + spread.y_axis.y + spread.z_axis.z;
        least_axis(&spread, whole).filter(|axis| (spread * *axis).dot(*axis) <= FLAT * whole)
    };
    wide.par_iter().map(one).collect()
}

/// The eigenvector of the least eigenvalue of a symmetric matrix without negative ones, whose sum this is: inverse iteration.
fn least_axis(matrix: &DMat3, sum: f64) -> Option<DVec3> {
    let scaled = *matrix * (1.0 / sum);
    // Without the small addition the inverse of an exact plane would not exist.
    let inverse = (scaled + DMat3::IDENTITY * 1e-6).inverse();
    // A start along none of the axes, which are often those of what is built.
    let mut axis = DVec3::new(0.48, 0.6, 0.64);
    for _ in 0..24 {
        axis = (inverse * axis).try_normalize()?;
    }
    axis.is_finite().then_some(axis)
}

/// The means of these positions and colours in the cells of a grid that at most `most` are occupied of.
fn thinned(points: &[([f64; 3], [f64; 3])], most: usize) -> Vec<([f64; 3], [f64; 3])> {
    let widest = (0..3).map(|c| points.iter().fold(0.0f64, |m, p| m.max((p.0[c] - points[0].0[c]).abs())));
    let mut side = widest.fold(1e-30, f64::max) * 2.0;
    let keys = |side: f64| points.iter().map(move |p| p.0.map(|v| ((v / side).floor() + 0.0).to_bits()));
    let occupied = |side: f64| keys(side).collect::<HashSet<_>>().len();
    // The side is found between one that is too long and one that is too short; both ends and halves are the same anywhere.
    while occupied(side) <= most {
        side *= 0.5;
    }
    let (mut short, mut long) = (side, side * 2.0);
    for _ in 0..5 {
        let middle = 0.5 * (short + long);
        if occupied(middle) > most { short = middle } else { long = middle }
    }
    // Beyond the grid's first side, where a single cell is not enough, everything is one.
    let mut cells = BTreeMap::<[u64; 3], ([f64; 6], f64)>::new();
    for (key, (position, color)) in keys(long).zip(points) {
        let (sum, count) = cells.entry(key).or_default();
        sum.iter_mut().zip(position.iter().chain(color)).for_each(|(sum, v)| *sum += v);
        *count += 1.0;
    }
    let mean = |(sum, count): ([f64; 6], f64)| {
        let [x, y, z, r, g, b] = sum.map(|v| v / count);
        ([x, y, z], [r, g, b])
    };
    let mut kept: Vec<_> = cells.into_values().map(mean).collect();
    kept.truncate(most);
    kept
}

/// Mean 8-bit RGB of the points in each occupied cell, in the order of [`anchors`].
fn mean_colors(points: &[Point], voxel: f64) -> impl Iterator<Item = [f64; 3]> {
    let mut cells = BTreeMap::<[i64; 3], ([u64; 3], u64)>::new();
    for point in points {
        let (sum, count) = cells.entry(cell(point.position, voxel).map(|v| v as i64)).or_default();
        for (sum, color) in sum.iter_mut().zip(point.color) {
            *sum += u64::from(color);
        }
        *count += 1;
    }
    cells.into_values().map(|(sum, count)| sum.map(|v| v as f64 / count as f64))
}

/// The cell of the grid that a position is snapped to.
fn cell(position: [f32; 3], voxel: f64) -> [f64; 3] {
    position.map(|v| (f64::from(v) / voxel).round_ties_even())
}

/// Mean distance of each position to its three nearest neighbours, or to as many as there are; at least `floor`.
///
/// `floor` must be positive. It is what a lone position gets, and it keeps the logarithm finite where positions coincide:
/// anchors of different cells are a voxel apart, but far from the origin float32 may round two of them together.
pub fn mean_distance_to_nearest(positions: &[[f32; 3]], floor: f64) -> Vec<f64> {
    nearest_distances(positions, 3)
        .into_iter()
        .map(|distances| match distances.len() {
            0 => floor,
            n => (distances.iter().sum::<f64>() / n as f64).max(floor),
        })
        .collect()
}

/// Median over the distinct points of the distance to the nearest other one; `None` if all points coincide.
pub fn median_nearest_distance(points: &[[f32; 3]]) -> Option<f64> {
    let mut distinct = points.to_vec();
    // -0 and 0 are the same place.
    distinct.iter_mut().flatten().for_each(|v| *v += 0.0);
    distinct.sort_unstable_by(|a, b| a.iter().map(|v| v.to_bits()).cmp(b.iter().map(|v| v.to_bits())));
    distinct.dedup();
    median(nearest_distances(&distinct, 1).into_iter().flatten())
}

/// Distances of each position to its `count` nearest others, ascending; fewer if there are fewer others.
fn nearest_distances(positions: &[[f32; 3]], count: usize) -> Vec<Vec<f64>> {
    use rayon::prelude::*;

    // Float64, so that a distance is the exact one between the float32 positions.
    let wide: Vec<[f64; 3]> = positions.iter().map(|p| p.map(f64::from)).collect();
    let Some(asked) = NonZero::new((count + 1).min(positions.len())) else { return Vec::new() };
    let tree: ImmutableKdTree<f64, 3> = ImmutableKdTree::new_from_slice(&wide);
    wide.par_iter()
        .map(|p| {
            let found = tree.nearest_n::<SquaredEuclidean>(p, asked);
            // The first is the position itself, or one that coincides with it: distance 0 either way.
            found.iter().skip(1).map(|neighbour| neighbour.distance.sqrt()).collect()
        })
        .collect()
}

/// Stream of the generator that draws initial weights, apart from the streams of other random choices of the same seed.
const WEIGHTS_STREAM: u128 = 0x6465_636f_6465_7273;
/// The same for initial offsets.
const OFFSETS_STREAM: u128 = 0x6f66_6673_6574_7300;

/// Networks in PyTorch's default initialisation of `Linear`: weights and biases uniform in
/// +-1/sqrt(fan in). Decoders first, so that they are the same with and without attention.
///
/// Where `opacity` is above 0 the opacity decoder's last bias is what gives that opacity (tanh) by itself. Drawn at random,
/// an output that is negative for all anchors exists for none, has no gradient, and its Gaussians are never born.
pub fn weights(seed: u64, offsets_per_anchor: usize, attention: bool, opacity: f64) -> Weights {
    let mut generator = Pcg64::new(u128::from(seed), WEIGHTS_STREAM);
    let mut tensors = BTreeMap::new();
    for (name, shape) in weight_shapes(offsets_per_anchor, attention) {
        let bound = 1.0 / (fan_in(&name, &shape) as f32).sqrt();
        let uniform = Uniform::new_inclusive(-bound, bound).expect("the bound is positive and finite");
        let mut data: Vec<f32> = (0..shape.iter().product()).map(|_| uniform.sample(&mut generator)).collect();
        if opacity > 0.0 && name == OPACITY_BIAS {
            data.fill(opacity.atanh() as f32);
        }
        tensors.insert(name, Tensor { shape, data });
    }
    Weights { tensors }
}

const OPACITY_BIAS: &str = "mlp_opacity.2.bias";

/// Inputs of the layer that the tensor belongs to. A bias has as many as the weight beside it.
fn fan_in(name: &str, shape: &[usize]) -> usize {
    match shape {
        [_, inputs] => *inputs,
        _ if name.starts_with("mlp_") && name.contains(".0.") => super::files::DECODER_INPUTS,
        _ if name.starts_with("mlp_") => super::files::DECODER_HIDDEN,
        _ => ATTENTION_WIDTH,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Distances to the three nearest others by comparing all pairs.
    fn brute_force(positions: &[[f32; 3]], floor: f64) -> Vec<f64> {
        positions
            .iter()
            .enumerate()
            .map(|(i, p)| {
                let distance =
                    |q: &[f32; 3]| (0..3).map(|c| f64::from(p[c]) - f64::from(q[c])).map(|d| d * d).sum::<f64>();
                let mut all: Vec<f64> =
                    positions.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, q)| distance(q).sqrt()).collect();
                all.sort_by(f64::total_cmp);
                all.truncate(3);
                let mean = all.iter().sum::<f64>() / all.len() as f64;
                if all.is_empty() { floor } else { mean.max(floor) }
            })
            .collect()
    }

    fn random_points(count: usize, seed: u64) -> Vec<[f32; 3]> {
        let mut generator = Pcg64::new(u128::from(seed), 3);
        let uniform = Uniform::new(-4.0f32, 4.0).expect("a range");
        (0..count).map(|_| [(); 3].map(|()| uniform.sample(&mut generator))).collect()
    }

    #[test]
    fn one_to_four_points_have_the_mean_of_the_neighbours_there_are() {
        let points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 8.0]];
        let expected: [&[f64]; 4] = [
            &[0.25],
            &[1.0, 1.0],
            &[(1.0 + 3.0) / 2.0, (1.0 + 10f64.sqrt()) / 2.0, (3.0 + 10f64.sqrt()) / 2.0],
            &[
                (1.0 + 3.0 + 8.0) / 3.0,
                (1.0 + 10f64.sqrt() + 65f64.sqrt()) / 3.0,
                (3.0 + 10f64.sqrt() + 73f64.sqrt()) / 3.0,
                (8.0 + 65f64.sqrt() + 73f64.sqrt()) / 3.0,
            ],
        ];
        for (count, expected) in (1..=4).zip(expected) {
            let initial = anchors(&points[..count], 0.25, 10).expect("points");
            assert_eq!(initial.anchors.position.len(), count);
            for (position, log_scaling) in initial.anchors.position.iter().zip(&initial.anchors.log_scaling) {
                let index = points.iter().position(|p| p == position).expect("points on the grid stay");
                assert_eq!(*log_scaling, [expected[index].ln() as f32; 6], "{count} points, point {index}");
            }
            assert!(initial.anchors.feature.iter().flatten().chain(&initial.anchors.offset).all(|v| *v == 0.0));
            assert_eq!(initial.anchors.offset.len(), count * 30);
        }
    }

    #[test]
    fn points_snap_to_the_grid_and_become_unique_whatever_their_order() {
        let points = [[0.26, -0.26, 0.0], [0.3, -0.2, 0.1], [0.0, 0.0, 0.0], [-0.0, 0.1, -0.1], [9.99, 0.0, 0.0]];
        let initial = anchors(&points, 0.5, 1).expect("points");
        assert_eq!(initial.anchors.position, [[0.0, 0.0, 0.0], [0.5, -0.5, 0.0], [0.5, 0.0, 0.0], [10.0, 0.0, 0.0]]);
        let mut doubled: Vec<_> = points.iter().rev().copied().collect();
        doubled.extend(points);
        assert_eq!(anchors(&doubled, 0.5, 1).expect("points"), initial);
    }

    #[test]
    fn features_begin_as_the_mean_colour_of_a_cells_points_and_offsets_within_the_spread() {
        let point = |position, color| Point { position, color };
        let points = [
            point([0.1, 0.0, 0.0], [255, 0, 51]),
            point([9.0, 0.0, 0.0], [0, 255, 0]),
            point([-0.1, 0.0, 0.0], [0, 0, 204]),
        ];
        let config = crate::model::Config { voxel: 1.0, color_features: 2.0, ..Default::default() };
        let made = |points: &[Point], seed| from_points(points, &config, seed).expect("points").anchors;
        let anchors = made(&points, 1);
        assert_eq!(anchors.feature[0][..4], [0.0, -2.0, 0.0, 0.0]);
        assert_eq!(anchors.feature[1][..4], [-2.0, 2.0, -2.0, 0.0]);
        assert!(anchors.offset.iter().all(|v| v.abs() <= 1.0));
        assert!(anchors.offset.iter().any(|v| *v > 0.6) && anchors.offset.iter().any(|v| *v < -0.6));
        let backwards: Vec<Point> = points.iter().rev().cloned().collect();
        assert_eq!(made(&backwards, 1), anchors, "the order of the points does not matter");
        assert_ne!(made(&points, 2).offset, anchors.offset, "another seed, other offsets");
        let plain =
            from_points(&points, &crate::model::Config { voxel: 1.0, ..Default::default() }, 1).expect("points");
        let positions: Vec<[f32; 3]> = points.iter().map(|p| p.position).collect();
        assert_eq!(plain, super::anchors(&positions, 1.0, 10).expect("points"), "zeros unless asked for");
    }

    #[test]
    fn plain_gaussians_stand_at_the_points_or_at_the_means_of_cells() {
        let colored = |position: [f32; 3]| Point { position, color: [255, 0, 51] };
        let points: Vec<Point> = random_points(1000, 4).into_iter().map(colored).collect();
        let config = crate::model::Config { degree: 1, ..Default::default() };
        let made = |points: &[Point], most| gaussians(points, &config, most).expect("points");
        let all = made(&points, 1000);
        let mut sorted: Vec<[f32; 3]> = points.iter().map(|p| p.position).collect();
        sorted.sort_by(|a, b| a.partial_cmp(b).expect("finite"));
        assert_eq!(all.position, sorted);
        // Half a white less 127.5 steps of 255 either way, and nothing that depends on the direction.
        assert!((f64::from(all.harmonics_of(7)[0][0]) * ZEROTH - 0.5).abs() < 1e-6);
        assert!((f64::from(all.harmonics_of(7)[0][1]) * ZEROTH + 0.5).abs() < 1e-6);
        assert_eq!(all.harmonics_of(7)[1..], [[0.0; 3]; 3]);
        assert!(all.logit.iter().all(|l| (crate::model::gaussians::sigmoid(*l) - 0.1).abs() < 1e-6));
        let spacing = mean_distance_to_nearest(&sorted, 1e-9);
        let near = |log: f32, width: f64| (f64::from(log).exp() - width).abs() < 1e-5;
        for ([x, y, z], d) in all.log_scale.iter().zip(spacing) {
            assert!(near(*x, WIDTH * d) && near(*y, WIDTH * d) && (near(*z, WIDTH * d) || near(*z, THICKNESS * d)));
        }
        let mut doubled: Vec<Point> = points.iter().rev().copied().collect();
        doubled.extend(&points);
        assert_eq!(made(&doubled, 1000), all, "neither order nor duplicates matter");
        for most in [999, 300, 1] {
            let few = made(&doubled, most);
            assert!(few.len() <= most as usize && few.len() as f64 >= 0.6 * f64::from(most), "{} of {most}", few.len());
            assert!(few.position.as_flattened().iter().all(|v| v.abs() <= 4.0), "means stay among the points");
        }
        assert_eq!(gaussians(&[], &config, 9), Err(Error::NoPoints));
        let far = gaussians(&[colored([f32::NAN, 0.0, 0.0])], &config, 9);
        assert!(matches!(far, Err(Error::NotFinite { index: 0, .. })));
        assert_eq!(made(&points[..1], 9).len(), 1, "a single one has no neighbour to be measured by");
    }

    /// Points on a slanted plane become discs along it, also when it is one of the axes' planes; where points fill space, or are
    /// too few, they are round.
    #[test]
    fn points_on_a_surface_become_discs_along_it() {
        let black = |position: [f32; 3]| Point { position, color: [0; 3] };
        let made = |points: &[Point]| gaussians(points, &crate::model::Config::default(), 1000).expect("points");
        for normal in [DVec3::new(0.3, -0.5, 0.8).normalize(), DVec3::X, DVec3::NEG_Z] {
            let (across, up) = normal.any_orthonormal_pair();
            // A tenth of their distance off it.
            let noise = random_points(400, 9);
            let place = |i: usize| {
                let (u, v) = ((i % 20) as f64, (i / 20) as f64);
                (across * u + up * v + normal * (f64::from(noise[i][0]) * 0.025)).to_array().map(|v| v as f32)
            };
            let discs = made(&(0..400).map(|i| black(place(i))).collect::<Vec<_>>());
            for (rotation, [x, _, z]) in discs.rotation.iter().zip(&discs.log_scale) {
                let [w, x_, y_, z_] = rotation.map(f64::from);
                let thin = DQuat::from_xyzw(x_, y_, z_, w) * DVec3::Z;
                assert!(thin.dot(normal).abs() > 0.97, "{thin} for {normal}");
                assert!((f64::from(x - z).exp() - WIDTH / THICKNESS).abs() < 1e-3);
            }
        }
        let grid = |i: usize| [i % 6, i / 6 % 6, i / 36].map(|v| v as f32);
        let filled = made(&(0..216).map(|i| black(grid(i))).collect::<Vec<_>>());
        let inside = (0..216).filter(|i| filled.position[*i].iter().all(|v| (1.5..3.5).contains(v)));
        assert!(inside.clone().count() == 8 && inside.into_iter().all(|i| filled.rotation[i] == [1.0, 0.0, 0.0, 0.0]));
        let three = made(&[[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]].map(black));
        assert!(three.log_scale.iter().all(|s| s[0] == s[2]));
    }

    #[test]
    fn the_median_spacing_counts_distinct_points_once() {
        // Nearest distances of 0, 1, 3, 7: 1, 1, 2, 4, and the mean of the two in the middle.
        let line = |xs: &[f32]| xs.iter().map(|&x| [x, 0.0, 0.0]).collect::<Vec<_>>();
        assert_eq!(median_nearest_distance(&line(&[0.0, 1.0, 3.0, 7.0])), Some(1.5));
        assert_eq!(median_nearest_distance(&line(&[0.0, 3.0, 7.0])), Some(3.0));
        assert_eq!(median_nearest_distance(&line(&[0.0, 3.0, 7.0, 7.0, 7.0, 7.0, -0.0])), Some(3.0));
        assert_eq!(median_nearest_distance(&line(&[2.0, 2.0, 2.0])), None);
        assert_eq!(median_nearest_distance(&[]), None);
        let points = line(&[0.0, 3.0, 7.0]);
        for voxel in [0.0, -1.0] {
            assert_eq!(anchors(&points, voxel, 1).expect("points").voxel, 3.0);
        }
    }

    #[test]
    fn coinciding_positions_get_the_floor() {
        let many = vec![[1.0f32, 2.0, 3.0]; 1000];
        assert!(mean_distance_to_nearest(&many, 1e-3).iter().all(|d| *d == 1e-3));
        let log = anchors(&many, 0.5, 1).expect("points").anchors.log_scaling;
        assert_eq!(log, [[0.5f32.ln(); 6]]);
        // Far from the origin cells of 1e-4 collapse in float32, and their scales stay finite.
        let far: Vec<_> = (0..50).map(|i| [5000.0 + 5e-4 * i as f32, 0.0, 0.0]).collect();
        assert!(anchors(&far, 1e-4, 1).expect("points").anchors.log_scaling.iter().flatten().all(|v| v.is_finite()));
    }

    #[test]
    fn neighbours_are_those_of_all_pairs() {
        let mut points = random_points(700, 1);
        // A plane of the grid: many equal coordinates on an axis.
        points.extend((0..400).map(|i| [(i % 20) as f32 * 0.5, (i / 20) as f32 * 0.5, 1.0]));
        for (got, expected) in mean_distance_to_nearest(&points, 1e-9).iter().zip(brute_force(&points, 1e-9)) {
            // Sums of three float64 squares in either order differ by a few units in the last place.
            assert!((got - expected).abs() <= 1e-14 * expected, "{got} {expected}");
        }
    }

    #[test]
    fn a_capture_of_73_000_points_takes_seconds() {
        let start = std::time::Instant::now();
        let initial = anchors(&random_points(73_000, 2), 0.0, 10).expect("points");
        assert!(initial.anchors.position.len() > 50_000 && initial.voxel > 0.05 && initial.voxel < 0.15);
        let cells = anchors(&random_points(73_000, 2), 0.4, 10).expect("points");
        // 20 cells of 0.4 an axis and half a cell at either end: nearly all of 21^3 are hit.
        assert!((9_000..=9_261).contains(&cells.anchors.position.len()), "{}", cells.anchors.position.len());
        assert!(start.elapsed().as_secs() < 20, "{:?}", start.elapsed());
    }

    #[test]
    fn what_cannot_start_is_refused() {
        assert_eq!(anchors(&[], 0.1, 10), Err(Error::NoPoints));
        assert_eq!(anchors(&[[1.0; 3]; 5], 0.0, 10), Err(Error::NoSpacing));
        let nan = anchors(&[[0.0; 3], [0.0, f32::INFINITY, 0.0]], 0.1, 10);
        assert!(matches!(nan, Err(Error::NotFinite { index: 1, .. })));
        assert!(matches!(anchors(&[[1e7, 0.0, 0.0]], 1e-3, 10), Err(Error::TooFar { index: 0, .. })));
    }

    #[test]
    fn weights_are_uniform_in_the_bound_of_their_fan_in_and_repeat_with_the_seed() {
        let drawn = weights(5, 10, true, 0.0);
        assert_eq!(drawn, weights(5, 10, true, 0.0));
        assert_ne!(drawn, weights(6, 10, true, 0.0));
        let decoders = weights(5, 10, false, 0.0);
        assert!(decoders.tensors.iter().all(|(name, tensor)| drawn.tensors[name] == *tensor));
        assert_eq!((decoders.tensors.len(), drawn.tensors.len()), (12, 20));
        for (name, tensor) in &drawn.tensors {
            let inputs: f64 = match name.as_str() {
                "to_out.weight" | "to_out.bias" | "context_to_out.weight" | "context_to_out.bias" => 512.0,
                name if name.starts_with("mlp_") && name.contains(".0.") => 36.0,
                _ => 32.0,
            };
            let bound = 1.0 / inputs.sqrt();
            let n = tensor.data.len() as f64;
            let mean = tensor.data.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
            let largest = tensor.data.iter().fold(0.0f64, |m, v| m.max(f64::from(v.abs())));
            assert!(largest <= bound * (1.0 + 1e-6), "{name}");
            // The largest of n uniform magnitudes falls below 1 - 20/n with probability e^-20; the mean's standard
            // deviation is bound / sqrt(3 n), and 6 of them are exceeded once in 5e8.
            assert!(largest >= bound * (1.0 - 20.0 / n), "{name}");
            assert!(mean.abs() <= 6.0 * bound / (3.0 * n).sqrt(), "{name}");
        }
        // With an opacity to begin with, one bias alone is another.
        let opaque = weights(5, 10, true, 0.5);
        for (name, tensor) in &drawn.tensors {
            let other = &opaque.tensors[name];
            if name == OPACITY_BIAS {
                assert!(
                    other.data.len() == 10 && other.data.iter().all(|v| (v.tanh() - 0.5).abs() < 1e-6),
                    "{other:?}"
                );
            } else {
                assert_eq!(tensor, other, "{name}");
            }
        }
    }
}
