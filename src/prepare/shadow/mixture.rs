//! Colours of a surface in light: a mixture of Gaussians over their logarithms.
//!
//! A colour is its brightness, the mean of the channels' logarithms, and two differences of channels: what takes the same
//! ratio of all channels changes the first alone.

use rand::RngExt as _;
use rand_pcg::Pcg64;

/// Materials, at most.
const PARTS: usize = 6;
/// Least deviations: of the brightness and of the differences.
const LEAST: [f64; 3] = [0.03, 0.02, 0.02];
/// Density of colours that no material has.
const OTHER: f64 = 1e-3;

/// Brightness and two differences of channels, of logarithms.
pub type Color = [f64; 3];

/// The colour of the channels' logarithms.
pub fn color([r, g, b]: [f32; 3]) -> Color {
    let [r, g, b] = [r, g, b].map(f64::from);
    [(r + g + b) / 3.0, r - g, 0.5 * (r + g) - b]
}

/// A colour in shadow as it is in light.
pub fn brightened(color: Color, drop: Color) -> Color {
    std::array::from_fn(|i| color[i] + drop[i])
}

/// The channels' logarithms of a colour.
pub fn channels([y, u, v]: Color) -> [f64; 3] {
    // r + g + b = 3 y; r - g = u; (r + g) / 2 - b = v.
    let sum = 2.0 * y + 2.0 / 3.0 * v;
    [0.5 * (sum + u), 0.5 * (sum - u), 3.0 * y - sum]
}

/// One material.
#[derive(Clone, Copy, Debug)]
struct Part {
    share: f64,
    mean: Color,
    variance: Color,
}

impl Part {
    fn density(&self, x: Color) -> f64 {
        let mut exponent = 0.0;
        let mut scale = 1.0;
        for ((x, mean), variance) in x.into_iter().zip(self.mean).zip(self.variance) {
            exponent += (x - mean).powi(2) / variance;
            scale *= std::f64::consts::TAU * variance;
        }
        self.share * (-0.5 * exponent).exp() / scale.sqrt()
    }
}

/// Materials and how often each is.
#[derive(Clone, Debug)]
pub struct Mixture {
    parts: Vec<Part>,
}

/// What a mixture makes of a colour.
pub struct Expected {
    /// The mean of the materials that it can be.
    pub mean: Color,
    /// How far the colours of these are from that.
    pub variance: Color,
}

impl Mixture {
    /// Fitted to colours by expectation and maximisation from a spread start; nothing where there are too few.
    pub fn fit(colors: &[Color], rounds: usize) -> Option<Self> {
        if colors.len() < 30 {
            return None;
        }
        let mut rng = Pcg64::new(3, 71);
        // Each start is drawn in proportion to its squared distance from those before it (k-means++).
        let apart = |a: &Color, b: &Color| (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>();
        let mut means = vec![colors[rng.random_range(0..colors.len())]];
        let mut nearest: Vec<f64> = colors.iter().map(|c| apart(c, &means[0])).collect();
        while means.len() < PARTS {
            let sum: f64 = nearest.iter().sum();
            if sum <= 1e-9 {
                break;
            }
            let mut left = rng.random_range(0.0..sum);
            let at = nearest.iter().position(|d| {
                left -= d;
                left <= 0.0
            });
            let next = colors[at.unwrap_or(colors.len() - 1)];
            nearest.iter_mut().zip(colors).for_each(|(d, c)| *d = d.min(apart(c, &next)));
            means.push(next);
        }
        let share = 1.0 / means.len() as f64;
        let variance = LEAST.map(|d| 9.0 * d * d);
        let mut mixture = Self { parts: means.into_iter().map(|mean| Part { share, mean, variance }).collect() };
        for _ in 0..rounds {
            mixture.step(colors);
        }
        Some(mixture)
    }

    fn step(&mut self, colors: &[Color]) {
        let mut sums = vec![[0.0f64; 7]; self.parts.len()];
        for x in colors {
            let own: Vec<f64> = self.parts.iter().map(|part| part.density(*x)).collect();
            let all = own.iter().sum::<f64>() + OTHER;
            for (sum, own) in sums.iter_mut().zip(own) {
                let share = own / all;
                sum[0] += share;
                for i in 0..3 {
                    sum[1 + i] += share * x[i];
                    sum[4 + i] += share * x[i] * x[i];
                }
            }
        }
        let all: f64 = sums.iter().map(|sum| sum[0]).sum::<f64>().max(1e-9);
        for (part, sum) in self.parts.iter_mut().zip(sums) {
            if sum[0] < 1.0 {
                part.share = 0.0;
                continue;
            }
            part.share = sum[0] / all;
            part.mean = std::array::from_fn(|i| sum[1 + i] / sum[0]);
            part.variance =
                std::array::from_fn(|i| (sum[4 + i] / sum[0] - part.mean[i].powi(2)).max(LEAST[i] * LEAST[i]));
        }
        self.parts.retain(|part| part.share > 0.0);
    }

    /// The logarithm of a colour's density.
    pub fn ln(&self, x: Color) -> f64 {
        (self.parts.iter().map(|part| part.density(x)).sum::<f64>() + OTHER).ln()
    }

    /// What the colour would be on the whole; nothing for a colour that no material has.
    pub fn expected(&self, x: Color) -> Option<Expected> {
        let own: Vec<f64> = self.parts.iter().map(|part| part.density(x)).collect();
        let all: f64 = own.iter().sum();
        if all < OTHER {
            return None;
        }
        let mean: Color =
            std::array::from_fn(|i| self.parts.iter().zip(&own).map(|(p, d)| d * p.mean[i]).sum::<f64>() / all);
        let variance = std::array::from_fn(|i| {
            let spread = |p: &Part| p.variance[i] + (p.mean[i] - mean[i]).powi(2);
            self.parts.iter().zip(&own).map(|(p, d)| d * spread(p)).sum::<f64>() / all
        });
        Some(Expected { mean, variance })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colors_go_there_and_back() {
        let back = channels(color([0.3, -1.2, 2.0]));
        assert!((back[0] - 0.3).abs() < 1e-6 && (back[1] + 1.2).abs() < 1e-6 && (back[2] - 2.0).abs() < 1e-6);
        // One ratio of all channels is brightness alone.
        let (a, b) = (color([0.3, -1.2, 2.0]), color([0.8, -0.7, 2.5]));
        assert!((b[0] - a[0] - 0.5).abs() < 1e-6 && (b[1] - a[1]).abs() < 1e-6 && (b[2] - a[2]).abs() < 1e-6);
    }

    #[test]
    fn two_materials_are_told_apart() {
        let mut rng = Pcg64::new(1, 2);
        let mut noise = || rng.random_range(-0.05..0.05);
        let colors: Vec<Color> = (0..500)
            .map(|i| if i % 3 == 0 { [-2.0 + noise(), 0.3, noise()] } else { [-0.5 + noise(), noise(), 0.2] })
            .collect();
        let mixture = Mixture::fit(&colors, 10).expect("enough colours");
        let dark = mixture.expected([-2.02, 0.3, 0.0]).expect("a material");
        assert!((dark.mean[0] + 2.0).abs() < 0.02, "{:?}", dark.mean);
        assert!(mixture.ln([-1.2, 0.1, 0.0]) < mixture.ln([-0.5, 0.0, 0.2]) - 3.0);
        assert!(mixture.expected([3.0, 2.0, 0.0]).is_none());
        assert!(Mixture::fit(&colors[..3], 10).is_none());
    }
}
