//! LPIPS (Zhang et al. 2018, version 0.1): distance of two pictures in the features of VGG-16 or AlexNet.

use std::path::Path;

use image::{GrayImage, RgbImage};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::network::{Convolution, Error, Planes, Shape, Weights};

/// Distances by region; 0 is identical. Those of the mask are absent without one, or where it is empty.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Distance {
    /// Of the full image.
    pub full: f64,
    /// The map of the full image, averaged inside the mask.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mask: Option<f64>,
    /// Of the pictures cut to the mask's box, where that is large enough for the network.
    #[serde(rename = "box", skip_serializing_if = "Option::is_none", default)]
    pub bounding_box: Option<f64>,
}

/// Distances by network and range of its inputs.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Perceptual {
    /// VGG-16, inputs in \[-1, 1\], as its authors have it.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub vgg: Option<Distance>,
    /// VGG-16, inputs in \[0, 1\], as many papers have it without saying so.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub vgg_unit: Option<Distance>,
    /// AlexNet, inputs in \[-1, 1\].
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub alex: Option<Distance>,
    /// AlexNet, inputs in \[0, 1\].
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub alex_unit: Option<Distance>,
}

/// Which features.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Net {
    /// VGG-16.
    Vgg,
    /// AlexNet.
    Alex,
}

/// A layer as torchvision numbers it.
enum Layer {
    /// Index, outputs, shape; a rectifier follows.
    Convolve(usize, usize, Shape),
    /// The features here count.
    Tap,
    /// Window and stride.
    Pool(usize, usize),
}

impl Net {
    fn layers(self) -> Vec<Layer> {
        use Layer::{Convolve, Pool, Tap};
        let three = Shape::square(3, 1, 1);
        match self {
            Self::Vgg => vec![
                Convolve(0, 64, three),
                Convolve(2, 64, three),
                Tap,
                Pool(2, 2),
                Convolve(5, 128, three),
                Convolve(7, 128, three),
                Tap,
                Pool(2, 2),
                Convolve(10, 256, three),
                Convolve(12, 256, three),
                Convolve(14, 256, three),
                Tap,
                Pool(2, 2),
                Convolve(17, 512, three),
                Convolve(19, 512, three),
                Convolve(21, 512, three),
                Tap,
                Pool(2, 2),
                Convolve(24, 512, three),
                Convolve(26, 512, three),
                Convolve(28, 512, three),
                Tap,
            ],
            Self::Alex => vec![
                Convolve(0, 64, Shape::square(11, 4, 2)),
                Tap,
                Pool(3, 2),
                Convolve(3, 192, Shape::square(5, 1, 2)),
                Tap,
                Pool(3, 2),
                Convolve(6, 384, three),
                Tap,
                Convolve(8, 256, three),
                Tap,
                Convolve(10, 256, three),
                Tap,
            ],
        }
    }

    /// In words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vgg => "VGG",
            Self::Alex => "Alex",
        }
    }
}

/// What the networks were trained on, in \[-1, 1\]: mean and deviation of every channel.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

/// Added to the norm of a feature before it divides.
const EPSILON: f32 = 1e-10;

enum Step {
    Convolve(Convolution),
    /// Weight of every channel's squared difference.
    Tap(Vec<f32>),
    Pool(usize, usize),
}

/// A network with its weights.
pub struct Lpips {
    net: Net,
    steps: Vec<Step>,
}

impl Lpips {
    /// Reads the weights of either network: torchvision's `features.N.weight` and `.bias`, LPIPS's `linN.model.1.weight`.
    /// Which network it is, its first convolution tells.
    ///
    /// # Errors
    /// A file that cannot be read; tensors that are missing or of another shape.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let weights = Weights::read(path)?;
        let first = "features.0.weight";
        let net = match weights.shape(first).as_deref() {
            Some([64, 3, 3, 3]) => Net::Vgg,
            Some([64, 3, 11, 11]) => Net::Alex,
            Some(other) => {
                let what =
                    format!("tensor `{first}` is {other:?}, VGG-16's is [64, 3, 3, 3] and AlexNet's [64, 3, 11, 11]");
                return Err(weights.refuse(what));
            }
            None => return Err(weights.refuse(format!("there is no tensor `{first}`"))),
        };
        let (mut steps, mut channels, mut taps) = (vec![], 3, 0);
        for layer in net.layers() {
            steps.push(match layer {
                Layer::Convolve(index, outputs, shape) => {
                    let of = [outputs, channels, shape.window[1], shape.window[0]];
                    let weight = weights.tensor(&format!("features.{index}.weight"), &of)?;
                    let bias = weights.tensor(&format!("features.{index}.bias"), &[outputs])?;
                    channels = outputs;
                    Step::Convolve(Convolution::new(weight, bias, shape))
                }
                Layer::Tap => {
                    taps += 1;
                    Step::Tap(weights.tensor(&format!("lin{}.model.1.weight", taps - 1), &[1, channels, 1, 1])?)
                }
                Layer::Pool(window, stride) => Step::Pool(window, stride),
            });
        }
        Ok(Self { net, steps })
    }

    /// Which network it is.
    pub fn net(&self) -> Net {
        self.net
    }

    /// The map of distances, `[row-major pixel]`, and its mean as LPIPS has it: the sum of every layer's own mean. `None`
    /// where the pictures are too small for the network. `unit`: inputs are in \[0, 1\] instead of \[-1, 1\].
    fn distances(&self, a: &RgbImage, b: &RgbImage, unit: bool) -> Option<(Planes, f64)> {
        let size = [a.width(), a.height()].map(|n| n as usize);
        let input = |image: &RgbImage| {
            Planes::new(3, size, |c, y, x| {
                let value = f32::from(image.as_raw()[3 * (y * size[0] + x) + c]) / 255.0;
                ((if unit { value } else { 2.0 * value - 1.0 }) - SHIFT[c]) / SCALE[c]
            })
        };
        let mut both = [input(a), input(b)];
        let mut map = Planes::new(1, size, |_, _, _| 0.0);
        let mut sum = 0.0;
        for step in &self.steps {
            match step {
                Step::Convolve(convolution) => {
                    both = [convolution.apply(&both[0])?.relu(), convolution.apply(&both[1])?.relu()];
                }
                Step::Pool(window, stride) => {
                    if both[0].size.iter().any(|side| side < window) {
                        return None;
                    }
                    both = both.map(|planes| planes.max_pooled(*window, *stride, 0));
                }
                Step::Tap(weights) => {
                    let layer = difference(&both[0], &both[1], weights);
                    sum += f64::from(layer.means()[0]);
                    map.values.iter_mut().zip(layer.resized(size).values).for_each(|(sum, value)| *sum += value);
                }
            }
        }
        Some((map, sum))
    }

    /// Distances of two pictures by region. `None` where they are too small for the network.
    ///
    /// # Panics
    /// Unless pictures and mask are equally large.
    pub fn compare(
        &self,
        a: &RgbImage,
        b: &RgbImage,
        mask: Option<&GrayImage>,
        bounding_box: Option<[u32; 4]>,
        unit: bool,
    ) -> Option<Distance> {
        assert_eq!(a.dimensions(), b.dimensions(), "pictures of one size");
        let (map, full) = self.distances(a, b, unit)?;
        let inside = mask.map(|mask| {
            let values = map.values.iter().zip(mask.as_raw()).filter(|(_, m)| **m != 0);
            values.fold((0.0, 0.0), |(sum, count), (v, _)| (sum + f64::from(*v), count + 1.0))
        });
        let boxed = bounding_box.and_then(|[x, y, width, height]| {
            let cut = |image: &RgbImage| image::imageops::crop_imm(image, x, y, width, height).to_image();
            Some(self.distances(&cut(a), &cut(b), unit)?.1)
        });
        let mask = inside.filter(|(_, count)| *count > 0.0).map(|(sum, count)| sum / count);
        Some(Distance { full, mask, bounding_box: boxed })
    }
}

/// Weighted squared difference of the features at every place, each brought to length 1.
fn difference(a: &Planes, b: &Planes, weights: &[f32]) -> Planes {
    let area = a.size[0] * a.size[1];
    let norm = |planes: &Planes, i: usize| {
        let square: f32 = (0..planes.channels).map(|c| planes.values[c * area + i].powi(2)).sum();
        square.sqrt() + EPSILON
    };
    let at = |i: usize| {
        let (na, nb) = (norm(a, i), norm(b, i));
        (0..a.channels).map(|c| weights[c] * (a.values[c * area + i] / na - b.values[c * area + i] / nb).powi(2)).sum()
    };
    Planes { values: (0..area).into_par_iter().map(at).collect(), channels: 1, size: a.size }
}
