//! FID (Heusel et al. 2017) with the Inception network of pytorch-fid.

use std::path::Path;

use image::RgbImage;
use serde::{Deserialize, Serialize};

use super::network::{Convolution, Error, Planes, Shape, Weights};

/// Fréchet distances of the rendered views from the photographs as two sets; 0 is identical. A few dozen pictures make a
/// biased estimate: compare only figures of equally many.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Frechet {
    /// Of full images.
    pub full: f64,
    /// Of the pictures cut to the mask's box.
    #[serde(rename = "box", skip_serializing_if = "Option::is_none", default)]
    pub bounding_box: Option<f64>,
}

/// Side of the network's input, pixels.
const SIDE: usize = 299;
/// Numbers that describe a picture.
pub const FEATURES: usize = 2048;
/// Of the batch normalisations.
const EPSILON: f32 = 1e-3;

const ONE: Shape = Shape::square(1, 1, 0);
const THREE: Shape = Shape::square(3, 1, 1);
const DOWN: Shape = Shape::square(3, 2, 0);
const WIDE: Shape = Shape { window: [7, 1], stride: 1, pad: [3, 0] };
const TALL: Shape = Shape { window: [1, 7], stride: 1, pad: [0, 3] };
const ACROSS: Shape = Shape { window: [3, 1], stride: 1, pad: [1, 0] };
const UPRIGHT: Shape = Shape { window: [1, 3], stride: 1, pad: [0, 1] };

/// A chain of convolutions, each followed by a rectifier.
struct Chain(Vec<Convolution>);

impl Chain {
    /// `layers`: name below `block`, outputs, shape.
    fn read(weights: &Weights, block: &str, inputs: usize, layers: &[(&str, usize, Shape)]) -> Result<Self, Error> {
        let mut inputs = inputs;
        let read = |(name, outputs, shape): &(&str, usize, Shape)| {
            let name = if block.is_empty() { (*name).to_owned() } else { format!("{block}.{name}") };
            let of = [*outputs, inputs, shape.window[1], shape.window[0]];
            let mut weight = weights.tensor(&format!("{name}.conv.weight"), &of)?;
            let norm = |what: &str| weights.tensor(&format!("{name}.bn.{what}"), &[*outputs]);
            let (gain, bias, mean, variance) =
                (norm("weight")?, norm("bias")?, norm("running_mean")?, norm("running_var")?);
            // The normalisation is one factor and one summand per output.
            let factor: Vec<f32> = gain.iter().zip(&variance).map(|(g, v)| g / (v + EPSILON).sqrt()).collect();
            let patch = weight.len() / outputs;
            weight.chunks_exact_mut(patch).zip(&factor).for_each(|(row, f)| row.iter_mut().for_each(|w| *w *= f));
            let bias = bias.iter().zip(&mean).zip(&factor).map(|((b, m), f)| b - m * f).collect();
            inputs = *outputs;
            Ok(Convolution::new(weight, bias, *shape))
        };
        Ok(Self(layers.iter().map(read).collect::<Result<_, Error>>()?))
    }

    fn apply(&self, input: &Planes) -> Planes {
        let step = |planes: Option<Planes>, convolution: &Convolution| {
            let input = planes.as_ref().unwrap_or(input);
            Some(convolution.apply(input).expect("299 x 299 is large enough for every layer").relu())
        };
        self.0.iter().fold(None, step).expect("a chain has a layer")
    }
}

/// What goes first through a branch's pool.
#[derive(Clone, Copy)]
enum Pool {
    Average,
    Largest,
}

/// One part of a block whose channels are put one after the other.
enum Branch {
    Chain(Chain),
    /// A chain whose end feeds two more.
    Fork(Chain, [Chain; 2]),
    /// 3 x 3 pool, stride 1, then the chain.
    Pooled(Pool, Chain),
    /// 3 x 3 maximum, stride 2.
    Down,
}

impl Branch {
    fn apply(&self, input: &Planes) -> Planes {
        match self {
            Self::Chain(chain) => chain.apply(input),
            Self::Fork(stem, ends) => {
                let stem = stem.apply(input);
                Planes::concatenated(&[&ends[0].apply(&stem), &ends[1].apply(&stem)])
            }
            Self::Pooled(Pool::Average, chain) => chain.apply(&input.averaged()),
            Self::Pooled(Pool::Largest, chain) => chain.apply(&input.max_pooled(3, 1, 1)),
            Self::Down => input.max_pooled(3, 2, 0),
        }
    }
}

/// The network with its weights.
pub struct Inception {
    stem: [Chain; 2],
    blocks: Vec<Vec<Branch>>,
}

impl Inception {
    /// Reads pytorch-fid's weights by their names there.
    ///
    /// # Errors
    /// A file that cannot be read; tensors that are missing or of another shape.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let weights = &Weights::read(path)?;
        let first =
            [("Conv2d_1a_3x3", 32, DOWN), ("Conv2d_2a_3x3", 32, Shape::square(3, 1, 0)), ("Conv2d_2b_3x3", 64, THREE)];
        let second = [("Conv2d_3b_1x1", 80, ONE), ("Conv2d_4a_3x3", 192, Shape::square(3, 1, 0))];
        let stem = [Chain::read(weights, "", 3, &first)?, Chain::read(weights, "", 64, &second)?];
        let mut blocks = vec![];
        for (block, inputs, pool) in [("Mixed_5b", 192, 32), ("Mixed_5c", 256, 64), ("Mixed_5d", 288, 64)] {
            let chain = |layers: &[_]| Chain::read(weights, block, inputs, layers);
            blocks.push(vec![
                Branch::Chain(chain(&[("branch1x1", 64, ONE)])?),
                Branch::Chain(chain(&[("branch5x5_1", 48, ONE), ("branch5x5_2", 64, Shape::square(5, 1, 2))])?),
                Branch::Chain(chain(&[
                    ("branch3x3dbl_1", 64, ONE),
                    ("branch3x3dbl_2", 96, THREE),
                    ("branch3x3dbl_3", 96, THREE),
                ])?),
                Branch::Pooled(Pool::Average, chain(&[("branch_pool", pool, ONE)])?),
            ]);
        }
        let chain = |layers: &[_]| Chain::read(weights, "Mixed_6a", 288, layers);
        blocks.push(vec![
            Branch::Chain(chain(&[("branch3x3", 384, DOWN)])?),
            Branch::Chain(chain(&[
                ("branch3x3dbl_1", 64, ONE),
                ("branch3x3dbl_2", 96, THREE),
                ("branch3x3dbl_3", 96, DOWN),
            ])?),
            Branch::Down,
        ]);
        for (block, inner) in [("Mixed_6b", 128), ("Mixed_6c", 160), ("Mixed_6d", 160), ("Mixed_6e", 192)] {
            let chain = |layers: &[_]| Chain::read(weights, block, 768, layers);
            blocks.push(vec![
                Branch::Chain(chain(&[("branch1x1", 192, ONE)])?),
                Branch::Chain(chain(&[
                    ("branch7x7_1", inner, ONE),
                    ("branch7x7_2", inner, WIDE),
                    ("branch7x7_3", 192, TALL),
                ])?),
                Branch::Chain(chain(&[
                    ("branch7x7dbl_1", inner, ONE),
                    ("branch7x7dbl_2", inner, TALL),
                    ("branch7x7dbl_3", inner, WIDE),
                    ("branch7x7dbl_4", inner, TALL),
                    ("branch7x7dbl_5", 192, WIDE),
                ])?),
                Branch::Pooled(Pool::Average, chain(&[("branch_pool", 192, ONE)])?),
            ]);
        }
        let chain = |layers: &[_]| Chain::read(weights, "Mixed_7a", 768, layers);
        blocks.push(vec![
            Branch::Chain(chain(&[("branch3x3_1", 192, ONE), ("branch3x3_2", 320, DOWN)])?),
            Branch::Chain(chain(&[
                ("branch7x7x3_1", 192, ONE),
                ("branch7x7x3_2", 192, WIDE),
                ("branch7x7x3_3", 192, TALL),
                ("branch7x7x3_4", 192, DOWN),
            ])?),
            Branch::Down,
        ]);
        for (block, inputs, pool) in [("Mixed_7b", 1280, Pool::Average), ("Mixed_7c", 2048, Pool::Largest)] {
            let chain = |inputs, layers: &[_]| Chain::read(weights, block, inputs, layers);
            blocks.push(vec![
                Branch::Chain(chain(inputs, &[("branch1x1", 320, ONE)])?),
                Branch::Fork(
                    chain(inputs, &[("branch3x3_1", 384, ONE)])?,
                    [chain(384, &[("branch3x3_2a", 384, ACROSS)])?, chain(384, &[("branch3x3_2b", 384, UPRIGHT)])?],
                ),
                Branch::Fork(
                    chain(inputs, &[("branch3x3dbl_1", 448, ONE), ("branch3x3dbl_2", 384, THREE)])?,
                    [
                        chain(384, &[("branch3x3dbl_3a", 384, ACROSS)])?,
                        chain(384, &[("branch3x3dbl_3b", 384, UPRIGHT)])?,
                    ],
                ),
                Branch::Pooled(pool, chain(inputs, &[("branch_pool", 192, ONE)])?),
            ]);
        }
        Ok(Self { stem, blocks })
    }

    /// The numbers that describe a picture.
    pub fn features(&self, image: &RgbImage) -> Vec<f32> {
        let size = [image.width(), image.height()].map(|n| n as usize);
        let planes = Planes::new(3, size, |c, y, x| f32::from(image.as_raw()[3 * (y * size[0] + x) + c]) / 255.0);
        let mut planes = planes.resized([SIDE; 2]);
        planes.values.iter_mut().for_each(|v| *v = 2.0 * *v - 1.0);
        for chain in &self.stem {
            planes = chain.apply(&planes).max_pooled(3, 2, 0);
        }
        for branches in &self.blocks {
            let parts: Vec<Planes> = branches.iter().map(|branch| branch.apply(&planes)).collect();
            planes = Planes::concatenated(&parts.iter().collect::<Vec<_>>());
        }
        planes.means()
    }
}

/// The Fréchet distance of two sets of features as normal distributions:
/// `|mean a - mean b|^2 + tr(A) + tr(B) - 2 tr((A B)^(1/2))` with the sets' covariances A and B.
///
/// With centred features as columns of X and Y, `A = X X^T / (n - 1)`, and the eigenvalues of A B are the squared singular
/// values of `X^T Y` over both counts less one: the root's trace is the sum of the singular values of a matrix as small as
/// the sets, and no root of a singular 2048 x 2048 matrix is ever taken. `None` with fewer than two pictures in a set.
///
/// # Panics
/// Unless all features are equally many.
pub fn frechet(a: &[Vec<f32>], b: &[Vec<f32>]) -> Option<f64> {
    if a.len() < 2 || b.len() < 2 {
        return None;
    }
    let length = a[0].len();
    let mean = |set: &[Vec<f32>]| -> Vec<f64> {
        assert!(set.iter().all(|features| features.len() == length), "features of one kind");
        (0..length).map(|i| set.iter().map(|f| f64::from(f[i])).sum::<f64>() / set.len() as f64).collect()
    };
    let (mean_a, mean_b) = (mean(a), mean(b));
    let centred = |set: &[Vec<f32>], mean: &[f64]| -> Vec<Vec<f64>> {
        set.iter().map(|f| f.iter().zip(mean).map(|(v, m)| f64::from(*v) - m).collect()).collect()
    };
    let (x, y) = (centred(a, &mean_a), centred(b, &mean_b));
    let dot = |p: &[f64], q: &[f64]| p.iter().zip(q).map(|(p, q)| p * q).sum::<f64>();
    let trace = |set: &[Vec<f64>]| set.iter().map(|f| dot(f, f)).sum::<f64>() / (set.len() - 1) as f64;
    let columns: Vec<Vec<f64>> = y.iter().map(|q| x.iter().map(|p| dot(p, q)).collect()).collect();
    let root = singular_values(columns).iter().sum::<f64>() / (((a.len() - 1) * (b.len() - 1)) as f64).sqrt();
    let apart: f64 = mean_a.iter().zip(&mean_b).map(|(p, q)| (p - q).powi(2)).sum();
    Some(apart + trace(&x) + trace(&y) - 2.0 * root)
}

/// Singular values of a matrix given by its columns: these are rotated in pairs until all are orthogonal (one-sided
/// Jacobi), and their lengths are the answer.
fn singular_values(mut columns: Vec<Vec<f64>>) -> Vec<f64> {
    let dot = |p: &[f64], q: &[f64]| p.iter().zip(q).map(|(p, q)| p * q).sum::<f64>();
    // Converges quadratically: some ten rounds for any size that occurs.
    for _ in 0..60 {
        let mut done = true;
        for j in 1..columns.len() {
            let (head, tail) = columns.split_at_mut(j);
            let q = &mut tail[0];
            for p in head {
                let (pp, qq, pq) = (dot(p, p), dot(q, q), dot(p, q));
                if pq.abs() <= 1e-15 * (pp * qq).sqrt() {
                    continue;
                }
                done = false;
                let zeta = (qq - pp) / (2.0 * pq);
                let tangent = zeta.signum() / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
                let cosine = 1.0 / (1.0 + tangent * tangent).sqrt();
                let sine = cosine * tangent;
                for (p, q) in p.iter_mut().zip(q.iter_mut()) {
                    (*p, *q) = (cosine * *p - sine * *q, sine * *p + cosine * *q);
                }
            }
        }
        if done {
            break;
        }
    }
    columns.iter().map(|column| dot(column, column).sqrt()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn singular_values_of_known_matrices() {
        let sorted = |columns: Vec<Vec<f64>>| {
            let mut values = singular_values(columns);
            values.sort_by(f64::total_cmp);
            values
        };
        // [[3, 0], [4, 5]]: 3 sqrt 5 and sqrt 5.
        let found = sorted(vec![vec![3.0, 4.0], vec![0.0, 5.0]]);
        assert!((found[0] - 5f64.sqrt()).abs() < 1e-14 && (found[1] - 3.0 * 5f64.sqrt()).abs() < 1e-14, "{found:?}");
        // Equal columns: one direction.
        let found = sorted(vec![vec![1.0, 2.0], vec![1.0, 2.0]]);
        assert!(found[0].abs() < 1e-14 && (found[1] - 10f64.sqrt()).abs() < 1e-14, "{found:?}");
        assert_eq!(sorted(vec![vec![0.0; 2]; 2]), [0.0; 2]);
    }

    #[test]
    fn frechet_distances_by_hand() {
        // Along one axis: means 1 and 5, deviations sqrt(2) and 3 sqrt(2): 16 + (2 sqrt 2)^2.
        let set = |values: &[f32]| -> Vec<Vec<f32>> { values.iter().map(|v| vec![*v, 7.0]).collect() };
        let found = frechet(&set(&[0.0, 2.0]), &set(&[2.0, 8.0])).expect("two each");
        assert!((found - 24.0).abs() < 1e-12, "{found}");
        let same = set(&[1.0, 4.0, 6.0]);
        assert!(frechet(&same, &same).expect("three each").abs() < 1e-12);
        assert_eq!(frechet(&same[..1], &same), None);
        // Independent axes, more features than pictures: 2 + 2 + 0.
        let (a, b) = ([vec![1.0, 0.0, 0.0], vec![-1.0, 0.0, 0.0]], [vec![0.0, 1.0, 0.0], vec![0.0, -1.0, 0.0]]);
        assert!((frechet(&a, &b).expect("two each") - 4.0).abs() < 1e-12);
    }
}
