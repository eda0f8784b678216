//! The decoder of neural Gaussians (Scaffold-GS, section 3.2): three two-layer perceptrons and their activations.
//!
//! Heads are numbered 0 opacity, 1 color, 2 cov (scale 3, quaternion 4). A head's weights are, one behind the other,
//! `0.weight` (32 x 36), `0.bias` (32), `2.weight` (outputs x 32), `2.bias` (outputs), row-major.

#[cfg(test)]
pub mod exact;

/// Values of an anchor's feature.
pub const FEATURE: usize = 32;
/// Hidden units of a head.
pub const HIDDEN: usize = 32;
/// A head's input: feature, unit view direction, distance.
pub const INPUT: usize = 36;
/// Opacity, color, cov.
pub const HEADS: usize = 3;
/// Outputs per Gaussian of each head.
pub const PER_GAUSSIAN: [usize; HEADS] = [1, 3, 7];
/// Shortest quaternion that is normalised to length one, and shorter ones are divided by it (PyTorch's `normalize`).
pub const NORM_EPSILON: f64 = 1e-12;

/// Where a decoder for `offsets` Gaussians per anchor keeps its weights; also the padded layout of the kernels.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// Gaussians per anchor.
    pub offsets: usize,
}

impl Layout {
    /// Values of a padded input: 36, then 1 for the bias, then zeros.
    pub const PADDED_INPUT: usize = 40;
    /// Weights of one head's first layer, biases included.
    pub const FIRST: usize = HIDDEN * INPUT + HIDDEN;

    /// Outputs of a head.
    pub fn outputs(self, head: usize) -> usize {
        PER_GAUSSIAN[head] * self.offsets
    }

    /// First weight of a head; of head 3: the number of weights.
    pub fn head(self, head: usize) -> usize {
        (0..head).map(|h| Self::FIRST + (HIDDEN + 1) * self.outputs(h)).sum()
    }

    /// Number of weights.
    pub fn weights(self) -> usize {
        self.head(HEADS)
    }

    /// Weight of hidden `unit` for `input`; of its bias where `input` is 36.
    pub fn first(self, head: usize, unit: usize, input: usize) -> usize {
        self.head(head) + if input < INPUT { unit * INPUT + input } else { HIDDEN * INPUT + unit }
    }

    /// Weight of `output` for hidden `unit`; of its bias where `unit` is 32.
    pub fn second(self, head: usize, output: usize, unit: usize) -> usize {
        let from = self.head(head) + Self::FIRST;
        from + if unit < HIDDEN { output * HIDDEN + unit } else { self.outputs(head) * HIDDEN + output }
    }

    /// First padded output row of a head; of head 3: the number of rows.
    pub fn row(self, head: usize) -> usize {
        (0..head).map(|h| self.outputs(h).next_multiple_of(8)).sum()
    }

    /// Rows of all heads, each head's padded to a multiple of 8.
    pub fn rows(self) -> usize {
        self.row(HEADS)
    }

    /// The head of a padded row, and the output unless the row is padding.
    pub fn output_of(self, row: usize) -> (usize, Option<usize>) {
        let head = (1..HEADS).filter(|&h| row >= self.row(h)).count();
        let output = row - self.row(head);
        (head, (output < self.outputs(head)).then_some(output))
    }

    /// vec4s of the packed weights: first layer with its biases, second layer, its biases.
    pub fn packed(self) -> usize {
        (HEADS * HIDDEN * Self::PADDED_INPUT + self.rows() * (HIDDEN + 1)) / 4
    }
}

/// The decoder's input: unit view direction and distance behind the feature, of an anchor seen from the camera's centre.
/// Without a distance there is no direction.
pub fn input(feature: [f64; FEATURE], view: [f64; 3]) -> [f64; INPUT] {
    let distance = view.iter().map(|v| v * v).sum::<f64>().sqrt();
    std::array::from_fn(|i| match i {
        0..32 => feature[i],
        35 => distance,
        _ if distance > 0.0 => view[i - 32] / distance,
        _ => 0.0,
    })
}

/// A Gaussian's eleven outputs of the second layers: opacity, color 3, scale 3, quaternion 4.
pub type Raw = [f64; 11];

/// A neural Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Gaussian {
    /// Seen from where the anchor is seen from.
    pub position: [f64; 3],
    /// -1 to 1; it exists where > 0.
    pub opacity: f64,
    /// 0 to 1.
    pub color: [f64; 3],
    /// Standard deviations, world.
    pub scale: [f64; 3],
    /// Unit quaternion w x y z.
    pub rotation: [f64; 4],
    /// Length of the quaternion before.
    pub norm: f64,
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Logarithm of the largest float32: beyond it the kernels' exponential is that float.
pub const EXP_LIMIT: f64 = 88.72283;

/// The kernels' exponential of a log-scale: saturated at the largest float32, so that 0 times it is 0.
pub fn exp_saturated(x: f64) -> f64 {
    if x > EXP_LIMIT { f64::from(f32::MAX) } else { x.exp() }
}

/// The activations.
pub fn activate(raw: Raw, anchor: [f64; 3], offset: [f64; 3], log_scaling: [f64; 6]) -> Gaussian {
    let q = [raw[7], raw[8], raw[9], raw[10]];
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    Gaussian {
        position: std::array::from_fn(|i| anchor[i] + offset[i] * exp_saturated(log_scaling[i])),
        opacity: raw[0].tanh(),
        color: std::array::from_fn(|i| sigmoid(raw[1 + i])),
        scale: std::array::from_fn(|i| exp_saturated(log_scaling[3 + i]) * sigmoid(raw[4 + i])),
        rotation: q.map(|v| v / norm.max(NORM_EPSILON)),
        norm,
    }
}

/// Gradients through [`activate`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ActivationGradient {
    /// Of the second layers' outputs.
    pub raw: Raw,
    /// Of the offset.
    pub offset: [f64; 3],
    /// Of the log-scales, this Gaussian's share.
    pub log_scaling: [f64; 6],
}

/// Backward of [`activate`], from its result `of` and the gradient `grad` (whose `norm` is not used).
pub fn activate_backward(
    of: &Gaussian,
    offset: [f64; 3],
    log_scaling: [f64; 6],
    grad: &Gaussian,
) -> ActivationGradient {
    let mut g = ActivationGradient::default();
    g.raw[0] = grad.opacity * (1.0 - of.opacity * of.opacity);
    for i in 0..3 {
        let spread = exp_saturated(log_scaling[i]);
        g.offset[i] = grad.position[i] * spread;
        g.log_scaling[i] = grad.position[i] * (offset[i] * spread);
        g.raw[1 + i] = grad.color[i] * of.color[i] * (1.0 - of.color[i]);
        g.log_scaling[3 + i] = grad.scale[i] * of.scale[i];
        // The sigmoid is scale / size; where the size underflowed to 0, so did the scale and its gradient.
        let size = exp_saturated(log_scaling[3 + i]).max(1e-37);
        g.raw[4 + i] = grad.scale[i] * of.scale[i] * (1.0 - of.scale[i] / size);
    }
    let along: f64 = (0..4).map(|i| of.rotation[i] * grad.rotation[i]).sum();
    for i in 0..4 {
        g.raw[7 + i] = if of.norm < NORM_EPSILON {
            grad.rotation[i] / NORM_EPSILON
        } else {
            (grad.rotation[i] - of.rotation[i] * along) / of.norm
        };
    }
    g
}

/// One anchor's Gaussians by the unpadded weights: what all kernels together compute.
pub fn decode(
    layout: Layout,
    weights: &[f64],
    input: &[f64; INPUT],
    anchor: [f64; 3],
    offset: &[[f64; 3]],
    log_scaling: [f64; 6],
) -> Vec<Gaussian> {
    let hidden = hidden(layout, weights, input);
    (0..layout.offsets)
        .map(|k| {
            let mut raw = [0.0; 11];
            for (at, (head, output)) in outputs_of(k).enumerate() {
                let products = (0..HIDDEN).map(|j| weights[layout.second(head, output, j)] * hidden[head][j]);
                raw[at] = products.sum::<f64>() + weights[layout.second(head, output, HIDDEN)];
            }
            activate(raw, anchor, offset[k], log_scaling)
        })
        .collect()
}

/// Head and output of each of Gaussian `k`'s eleven raw values.
pub fn outputs_of(k: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..HEADS).flat_map(move |head| (0..PER_GAUSSIAN[head]).map(move |i| (head, PER_GAUSSIAN[head] * k + i)))
}

fn hidden(layout: Layout, weights: &[f64], input: &[f64; INPUT]) -> [[f64; HIDDEN]; HEADS] {
    std::array::from_fn(|head| {
        std::array::from_fn(|unit| {
            let products = (0..INPUT).map(|i| weights[layout.first(head, unit, i)] * input[i]);
            (products.sum::<f64>() + weights[layout.first(head, unit, INPUT)]).max(0.0)
        })
    })
}
