//! `.splat` (antimatter15): 32 bytes per Gaussian and nothing else.
//!
//! | bytes | of a Gaussian | means |
//! | --- | --- | --- |
//! | 12 | 3 x float32 | position |
//! | 12 | 3 x float32 | standard deviations |
//! | 4 | 4 x u8 | displayed red, green and blue, and opacity, of 255 |
//! | 4 | 4 x u8 | quaternion w x y z x 128 + 128 |
//!
//! Axes are those of the PLY. Harmonics beyond degree 0 are left out.

use crate::math::harmonics::ZEROTH;
use crate::model::gaussians::{Cloud, NORM_EPSILON, logit, sigmoid};

/// Bytes of a Gaussian.
const ROW: usize = 32;

fn byte(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// The file's bytes.
pub fn encode(cloud: &Cloud) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(cloud.len() * ROW);
    for i in 0..cloud.len() {
        cloud.position[i].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        cloud.log_scale[i].iter().for_each(|v| bytes.extend((f64::from(*v).exp() as f32).to_le_bytes()));
        bytes.extend(cloud.harmonics_of(i)[0].map(|v| byte((0.5 + ZEROTH * f64::from(v)) * 255.0)));
        bytes.push(byte(sigmoid(cloud.logit[i]) * 255.0));
        let q = cloud.rotation[i].map(f64::from);
        let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt().max(NORM_EPSILON);
        bytes.extend(q.map(|v| byte(v / norm * 128.0 + 128.0)));
    }
    bytes
}

/// Reads a file: the Gaussians as a viewer sees them, rounded.
///
/// # Errors
/// A length that is no number of Gaussians.
pub fn decode(bytes: &[u8]) -> Result<Cloud, String> {
    let (rows, rest) = bytes.as_chunks::<ROW>();
    if !rest.is_empty() {
        return Err(format!("its {} bytes are not {ROW} for each Gaussian; is it cut off?", bytes.len()));
    }
    let mut cloud = Cloud::default();
    for row in rows {
        let float = |at: usize| f32::from_le_bytes(std::array::from_fn(|i| row[at + i]));
        cloud.position.push([0, 4, 8].map(float));
        cloud.log_scale.push([12, 16, 20].map(|at| float(at).ln()));
        cloud.harmonics.push([24, 25, 26].map(|at: usize| ((f64::from(row[at]) / 255.0 - 0.5) / ZEROTH) as f32));
        cloud.logit.push(logit(f64::from(row[27]) / 255.0));
        let q = [28, 29, 30, 31].map(|at: usize| (f64::from(row[at]) - 128.0) / 128.0);
        let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt().max(NORM_EPSILON);
        cloud.rotation.push(q.map(|v| (v / norm) as f32));
    }
    Ok(cloud)
}
