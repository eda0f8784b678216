//! The few layers of which image networks are made, in float32 on the CPU, and reading their weights.
//!
//! A convolution gathers the input's patches into a matrix and multiplies; rows of patches are shared out over threads.

use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayView2};
use rayon::prelude::*;
use safetensors::{Dtype, SafeTensors};

/// Why weights cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file that cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: std::io::Error,
    },
    /// A file that is no safetensors file.
    #[error("{}: not a safetensors file ({what}); --help shows the line that converts the weights", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A tensor that is missing, or of another shape or type.
    #[error("{}: {what}; --help shows the line that converts the weights", path.display())]
    Tensor {
        /// The file.
        path: PathBuf,
        /// Which, and what is wrong.
        what: String,
    },
}

/// Named float32 tensors of one file.
pub struct Weights {
    path: PathBuf,
    bytes: Vec<u8>,
}

impl Weights {
    /// Reads a safetensors file.
    ///
    /// # Errors
    /// A file that cannot be read, or is of another format.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let bytes = std::fs::read(path).map_err(|source| Error::Io { path: path.to_owned(), source })?;
        let weights = Self { path: path.to_owned(), bytes };
        weights.parse()?;
        Ok(weights)
    }

    fn parse(&self) -> Result<SafeTensors<'_>, Error> {
        SafeTensors::deserialize(&self.bytes)
            .map_err(|error| Error::Format { path: self.path.clone(), what: error.to_string() })
    }

    /// An error of this file.
    pub(super) fn refuse(&self, what: String) -> Error {
        Error::Tensor { path: self.path.clone(), what }
    }

    /// The shape of a tensor, if it is there.
    pub(super) fn shape(&self, name: &str) -> Option<Vec<usize>> {
        self.parse().ok()?.tensor(name).ok().map(|tensor| tensor.shape().to_vec())
    }

    /// The values of a tensor of this shape.
    ///
    /// # Errors
    /// Where there is none, or it is of another shape or type.
    pub(super) fn tensor(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, Error> {
        let file = self.parse()?;
        let tensor = file.tensor(name).map_err(|_| self.refuse(format!("there is no tensor `{name}` ({shape:?})")))?;
        if tensor.shape() != shape || tensor.dtype() != Dtype::F32 {
            let (found, dtype) = (tensor.shape(), tensor.dtype());
            return Err(self.refuse(format!("tensor `{name}` is {dtype:?} {found:?}, it must be F32 {shape:?}")));
        }
        Ok(tensor.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect())
    }
}

/// Planes of values.
#[derive(Clone, Debug, PartialEq)]
pub struct Planes {
    /// `[channel, row, column]`.
    pub values: Vec<f32>,
    /// Channels.
    pub channels: usize,
    /// Width and height.
    pub size: [usize; 2],
}

impl Planes {
    /// Values by channel, row and column.
    pub fn new(channels: usize, [width, height]: [usize; 2], value: impl Fn(usize, usize, usize) -> f32) -> Self {
        let at = |i: usize| value(i / (width * height), i / width % height, i % width);
        Self { values: (0..channels * width * height).map(at).collect(), channels, size: [width, height] }
    }

    fn area(&self) -> usize {
        self.size[0] * self.size[1]
    }

    /// One channel.
    pub fn plane(&self, channel: usize) -> &[f32] {
        &self.values[channel * self.area()..(channel + 1) * self.area()]
    }

    /// Negative values become 0.
    #[must_use]
    pub fn relu(mut self) -> Self {
        self.values.iter_mut().for_each(|v| *v = v.max(0.0));
        self
    }

    /// The channels of all of them.
    pub fn concatenated(parts: &[&Planes]) -> Self {
        let size = parts[0].size;
        assert!(parts.iter().all(|part| part.size == size), "planes of one size");
        Self {
            values: parts.iter().flat_map(|part| part.values.iter().copied()).collect(),
            channels: parts.iter().map(|part| part.channels).sum(),
            size,
        }
    }

    fn pooled(
        &self,
        window: usize,
        stride: usize,
        pad: usize,
        pool: impl Fn(&mut dyn Iterator<Item = f32>) -> f32 + Sync,
    ) -> Self {
        let [w, h] = self.size;
        let size = [w, h].map(|n| (n + 2 * pad - window) / stride + 1);
        let values = (0..self.channels)
            .into_par_iter()
            .flat_map_iter(|channel| {
                let (plane, pool) = (self.plane(channel), &pool);
                (0..size[0] * size[1]).map(move |i| {
                    let range = |at: usize, side: usize| {
                        (at * stride).saturating_sub(pad)..(at * stride + window - pad).min(side)
                    };
                    let (rows, columns) = (range(i / size[0], h), range(i % size[0], w));
                    pool(&mut rows.flat_map(|y| columns.clone().map(move |x| plane[y * w + x])))
                })
            })
            .collect();
        Self { values, channels: self.channels, size }
    }

    /// The largest value of every window; what is outside does not count.
    pub fn max_pooled(&self, window: usize, stride: usize, pad: usize) -> Self {
        self.pooled(window, stride, pad, |values| values.fold(f32::NEG_INFINITY, f32::max))
    }

    /// The mean of every 3 x 3 window around a value; what is outside does not count.
    pub fn averaged(&self) -> Self {
        self.pooled(3, 1, 1, |values| {
            let (sum, count) = values.fold((0.0, 0.0), |(sum, count), v| (sum + v, count + 1.0));
            sum / count
        })
    }

    /// The mean of every channel.
    pub fn means(&self) -> Vec<f32> {
        let mean = |c: usize| self.plane(c).iter().map(|v| f64::from(*v)).sum::<f64>() / self.area() as f64;
        (0..self.channels).map(|c| mean(c) as f32).collect()
    }

    /// At another size, linear between the four nearest values, whose centres lie at halves; beyond the outermost centres
    /// the border's values. Shrinking samples: it does not average.
    pub fn resized(&self, size: [usize; 2]) -> Self {
        let [w, h] = self.size;
        let axis = |i: usize, from: usize, to: usize| {
            let at = ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).max(0.0);
            let low = (at as usize).min(from - 1);
            (low, (low + 1).min(from - 1), (at - low as f64) as f32)
        };
        let columns: Vec<_> = (0..size[0]).map(|x| axis(x, w, size[0])).collect();
        let rows: Vec<_> = (0..size[1]).map(|y| axis(y, h, size[1])).collect();
        Self::new(self.channels, size, |c, y, x| {
            let plane = self.plane(c);
            let ((x0, x1, u), (y0, y1, v)) = (columns[x], rows[y]);
            let row = |y: usize| plane[y * w + x0] * (1.0 - u) + plane[y * w + x1] * u;
            row(y0) * (1.0 - v) + row(y1) * v
        })
    }
}

/// How a convolution walks over its input, horizontally and vertically.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Columns and rows of a patch.
    pub window: [usize; 2],
    /// Step between patches.
    pub stride: usize,
    /// Zeros around the input.
    pub pad: [usize; 2],
}

impl Shape {
    /// A square patch.
    pub const fn square(window: usize, stride: usize, pad: usize) -> Self {
        Self { window: [window; 2], stride, pad: [pad; 2] }
    }
}

/// A convolution with a bias.
#[derive(Debug)]
pub struct Convolution {
    /// [output, input x row x column].
    weight: Array2<f32>,
    bias: Vec<f32>,
    shape: Shape,
}

/// Outputs computed at once by a thread: their patches of up to 4,608 values take 9 MiB.
const BLOCK: usize = 512;

impl Convolution {
    /// `weight` is `[output, input, row, column]`.
    ///
    /// # Panics
    /// Unless `weight` has a patch of inputs for every bias.
    pub fn new(weight: Vec<f32>, bias: Vec<f32>, shape: Shape) -> Self {
        let patch = weight.len() / bias.len();
        let weight = Array2::from_shape_vec((bias.len(), patch), weight).expect("a patch for every output");
        Self { weight, bias, shape }
    }

    /// The convolved planes; `None` where the input is smaller than a patch.
    pub fn apply(&self, input: &Planes) -> Option<Planes> {
        let Shape { window: [ww, wh], stride, pad: [pw, ph] } = self.shape;
        let [w, h] = input.size;
        let side = |n: usize, pad: usize, window: usize| Some((n + 2 * pad).checked_sub(window)? / stride + 1);
        let size = [side(w, pw, ww)?, side(h, ph, wh)?];
        let (area, patch) = (size[0] * size[1], input.channels * ww * wh);
        assert_eq!(patch, self.weight.ncols(), "the weights are those of these planes");
        let block = |start: usize| {
            let count = BLOCK.min(area - start);
            let mut columns = vec![0.0; patch * count];
            for (k, row) in columns.chunks_exact_mut(count).enumerate() {
                let (channel, dy, dx) = (k / (ww * wh), k / ww % wh, k % ww);
                let plane = input.plane(channel);
                for (i, value) in row.iter_mut().enumerate() {
                    let (y, x) = ((start + i) / size[0] * stride + dy, (start + i) % size[0] * stride + dx);
                    // Wrapping below 0 makes it larger than any side.
                    let (y, x) = (y.wrapping_sub(ph), x.wrapping_sub(pw));
                    if y < h && x < w {
                        *value = plane[y * w + x];
                    }
                }
            }
            let columns = ArrayView2::from_shape((patch, count), &columns).expect("as many as counted");
            self.weight.dot(&columns)
        };
        let blocks: Vec<Array2<f32>> = (0..area.div_ceil(BLOCK)).into_par_iter().map(|i| block(i * BLOCK)).collect();
        let mut values = vec![0.0; self.bias.len() * area];
        values.par_chunks_exact_mut(area).enumerate().for_each(|(output, plane)| {
            for (block, out) in blocks.iter().zip(plane.chunks_mut(BLOCK)) {
                out.iter_mut().zip(block.row(output)).for_each(|(out, value)| *out = value + self.bias[output]);
            }
        });
        Some(Planes { values, channels: self.bias.len(), size })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(channels: usize, size: [usize; 2]) -> Planes {
        Planes::new(channels, size, |c, y, x| (c * 100 + y * 10 + x) as f32)
    }

    #[test]
    fn a_convolution_is_that_written_out() {
        let shapes = [
            Shape::square(3, 1, 1),
            Shape::square(3, 2, 0),
            Shape::square(1, 1, 0),
            Shape { window: [5, 1], stride: 1, pad: [2, 0] },
            Shape { window: [1, 3], stride: 2, pad: [0, 1] },
        ];
        for shape in shapes {
            // More outputs than one block has.
            let (input, [ww, wh]) = (ramp(2, [33, 31]), shape.window);
            let weight: Vec<f32> = (0..3 * 2 * ww * wh).map(|i| ((i * 7 % 11) as f32) - 5.0).collect();
            let convolution = Convolution::new(weight.clone(), vec![0.5, -1.0, 2.0], shape);
            let output = convolution.apply(&input).expect("large enough");
            let [w, h] = output.size;
            for (o, y, x) in (0..3).flat_map(|o| (0..h).flat_map(move |y| (0..w).map(move |x| (o, y, x)))) {
                let mut sum = f64::from([0.5f32, -1.0, 2.0][o]);
                for (c, dy, dx) in (0..2).flat_map(|c| (0..wh).flat_map(move |dy| (0..ww).map(move |dx| (c, dy, dx)))) {
                    let (iy, ix) = (
                        (y * shape.stride + dy) as i64 - shape.pad[1] as i64,
                        (x * shape.stride + dx) as i64 - shape.pad[0] as i64,
                    );
                    if (0..31).contains(&iy) && (0..33).contains(&ix) {
                        sum += f64::from(weight[((o * 2 + c) * wh + dy) * ww + dx])
                            * f64::from(input.plane(c)[iy as usize * 33 + ix as usize]);
                    }
                }
                // Whole numbers below 2^24 and halves: exact in float32.
                assert_eq!(f64::from(output.plane(o)[y * w + x]), sum, "{shape:?} {o} {y} {x}");
            }
        }
        assert_eq!(Convolution::new(vec![0.0; 9], vec![0.0], Shape::square(3, 1, 0)).apply(&ramp(1, [2, 5])), None);
    }

    #[test]
    fn pools_and_sizes() {
        let planes = ramp(1, [4, 3]);
        assert_eq!(planes.max_pooled(3, 2, 0).values, [22.0]);
        assert_eq!(planes.max_pooled(2, 2, 0).values, [11.0, 13.0]);
        assert_eq!(planes.max_pooled(3, 1, 1).values[..4], [11.0, 12.0, 13.0, 13.0]);
        assert_eq!(planes.averaged().values[0], (0.0 + 1.0 + 10.0 + 11.0) / 4.0);
        assert_eq!(planes.averaged().values[5], 11.0);
        assert_eq!(planes.means(), [11.5]);
        assert_eq!(planes.resized([4, 3]), planes);
        assert_eq!(planes.resized([2, 3]).values[..2], [0.5, 2.5]);
        assert_eq!(ramp(1, [2, 1]).resized([4, 1]).values, [0.0, 0.25, 0.75, 1.0]);
        assert_eq!(Planes::concatenated(&[&planes, &ramp(2, [4, 3])]).channels, 3);
        assert_eq!(Planes::new(1, [2, 1], |_, _, x| x as f32 - 0.5).relu().values, [0.0, 0.5]);
    }
}
