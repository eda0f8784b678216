//! SPZ version 3 (Niantic's packed Gaussians): a gzip stream of a 16-byte header and one array per attribute.
//!
//! | array | of a Gaussian | means |
//! | --- | --- | --- |
//! | positions | 3 x 24 bits, signed | fixed point with the header's fractional bits |
//! | alphas | u8 | opacity x 255 |
//! | colors | 3 x u8 | coefficient of degree 0 x 0.15 + 0.5, of 255 |
//! | scales | 3 x u8 | (natural logarithm + 10) x 16 |
//! | rotations | u32 | place of the largest component of x y z w (2 bits), then the others: sign and 9 bits of sqrt 2 |
//! | harmonics | 3 x u8 per coefficient | coefficient x 128 + 128, coefficient by coefficient, rgb |
//!
//! Axes are those of the PLY. Version 4 is refused by common readers. The fractional bits are as many as the farthest
//! Gaussian leaves (24 at most), so that a scene's unit costs nothing; the scales' range (4.5e-5 to 380 units) is the format's.

use std::io::{Read as _, Write as _};

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;

use crate::math::harmonics::coefficients;
use crate::model::gaussians::{Cloud, logit, sigmoid};

const MAGIC: u32 = 0x5053_474e;
const VERSION: u32 = 3;
const HEADER: usize = 16;
/// Colour coefficients are packed with this factor.
const COLOR: f64 = 0.15;
/// Largest magnitude of a rotation's component in the file.
const COMPONENT: u32 = (1 << 9) - 1;
/// Gaussians at most, 9 GB of them.
const MOST_GAUSSIANS: usize = 1 << 27;
/// Fractional bits at most: JavaScript readers shift a 32-bit 1 by them.
const MOST_BITS: u32 = 24;

fn byte(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// Fractional bits for the farthest coordinate: as many as 24 signed bits leave.
fn fractional_bits(cloud: &Cloud) -> u32 {
    let farthest = cloud.position.as_flattened().iter().fold(0f64, |m, v| m.max(f64::from(v.abs())));
    let room = f64::from((1 << 23) - 1);
    (0..=MOST_BITS).rev().find(|bits| farthest * f64::from(1u32 << bits) <= room).unwrap_or(0)
}

/// A unit quaternion w x y z in 32 bits.
fn pack_rotation([w, x, y, z]: [f32; 4]) -> u32 {
    let q = [x, y, z, w].map(f64::from);
    let largest = (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    // q and -q are one rotation: the largest component is positive and follows from the others.
    let flip = q[largest] < 0.0;
    (0..4).filter(|i| *i != largest).fold(largest as u32, |word, i| {
        let negative = u32::from((q[i] < 0.0) != flip);
        let magnitude = (f64::from(COMPONENT) * q[i].abs() * std::f64::consts::SQRT_2 + 0.5) as u32;
        word << 10 | negative << 9 | magnitude.min(COMPONENT)
    })
}

fn unpack_rotation(mut word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut q = [0f64; 4];
    for i in (0..4).rev().filter(|i| *i != largest) {
        let magnitude = f64::from(word & COMPONENT) / f64::from(COMPONENT) * std::f64::consts::FRAC_1_SQRT_2;
        q[i] = if word >> 9 & 1 == 1 { -magnitude } else { magnitude };
        word >>= 10;
    }
    q[largest] = (1.0 - q.iter().map(|v| v * v).sum::<f64>()).max(0.0).sqrt();
    let [x, y, z, w] = q.map(|v| v as f32);
    [w, x, y, z]
}

/// The file's bytes.
///
/// # Errors
/// A position that 24 bits cannot hold: farther than 8 million scene units from the origin.
pub fn encode(cloud: &Cloud) -> Result<Vec<u8>, String> {
    let bits = fractional_bits(cloud);
    let unit = f64::from(1u32 << bits);
    let count = cloud.len() as u32;
    let mut raw = Vec::with_capacity(HEADER + cloud.len() * (20 + 3 * (coefficients(cloud.degree) - 1)));
    for word in [MAGIC, VERSION, count] {
        raw.extend_from_slice(&word.to_le_bytes());
    }
    raw.extend_from_slice(&[cloud.degree as u8, bits as u8, 0, 0]);
    for value in cloud.position.as_flattened() {
        let fixed = (f64::from(*value) * unit).round();
        if fixed.abs() >= f64::from(1 << 23) {
            return Err(format!(
                "SPZ cannot hold a Gaussian {value} units from the origin: leave it out of --formats, or move the scene"
            ));
        }
        raw.extend_from_slice(&(fixed as i32).to_le_bytes()[..3]);
    }
    raw.extend(cloud.logit.iter().map(|l| byte(sigmoid(*l) * 255.0)));
    for i in 0..cloud.len() {
        raw.extend(cloud.harmonics_of(i)[0].map(|v| byte((f64::from(v) * COLOR + 0.5) * 255.0)));
    }
    raw.extend(cloud.log_scale.as_flattened().iter().map(|v| byte((f64::from(*v) + 10.0) * 16.0)));
    for rotation in &cloud.rotation {
        raw.extend_from_slice(&pack_rotation(*rotation).to_le_bytes());
    }
    for i in 0..cloud.len() {
        for coefficient in &cloud.harmonics_of(i)[1..] {
            raw.extend(coefficient.map(|v| byte(f64::from(v) * 128.0 + 128.0)));
        }
    }
    let mut out = GzEncoder::new(vec![], Compression::best());
    let packed = out.write_all(&raw).and_then(|()| out.finish());
    packed.map_err(|error| format!("the Gaussians cannot be compressed: {error}"))
}

/// Standard deviations that the format cannot tell from its smallest or largest.
pub fn beyond_range(cloud: &Cloud) -> usize {
    let cut = |v: &&f32| !(-10.0..=5.9375).contains(&f64::from(**v));
    cloud.log_scale.as_flattened().iter().filter(cut).count()
}

/// Reads a file of version 3: the Gaussians as a viewer sees them, rounded.
///
/// # Errors
/// Any other file, or one that is cut off.
pub fn decode(bytes: &[u8]) -> Result<Cloud, String> {
    let broken = |what: String| format!("not an SPZ file of version {VERSION}: {what}");
    let cut = || broken("it is cut off".to_owned());
    let mut unpacked = GzDecoder::new(bytes);
    let mut header = [0; HEADER];
    unpacked.read_exact(&mut header).map_err(|e| broken(e.to_string()))?;
    let (words, _) = header.as_chunks::<4>();
    let [magic, version, count, last] = std::array::from_fn(|i| u32::from_le_bytes(words[i]));
    if [magic, version] != [MAGIC, VERSION] {
        return Err(broken("its first words are others".to_owned()));
    }
    let n = count as usize;
    let [degree, bits, ..] = last.to_le_bytes().map(u32::from);
    if degree > 3 || bits > MOST_BITS {
        return Err(broken(format!("degree {degree} with {bits} fractional bits")));
    }
    let rest = coefficients(degree) - 1;
    if n > MOST_GAUSSIANS {
        return Err(broken(format!("{n} Gaussians")));
    }
    // No more than it says: a small stream may go on for gigabytes.
    let mut raw = vec![];
    let wanted = (n * (20 + 3 * rest)) as u64;
    unpacked.take(wanted).read_to_end(&mut raw).map_err(|e| broken(e.to_string()))?;
    let mut at = 0;
    let mut take = |each: usize| {
        let part = raw.get(at..at + n * each).ok_or_else(cut);
        at += n * each;
        part
    };
    let (positions, alphas, colors) = (take(9)?, take(1)?, take(3)?);
    let (scales, rotations, harmonics) = (take(3)?, take(4)?, take(3 * rest)?);
    let fixed = |b: &[u8; 3]| {
        let value = i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8;
        (f64::from(value) / f64::from(1u32 << bits)) as f32
    };
    let positions: Vec<f32> = positions.as_chunks().0.iter().map(fixed).collect();
    let scale = |b: &[u8; 3]| b.map(|v| f32::from(v) / 16.0 - 10.0);
    let color = |b: &[u8; 3]| b.map(|v| ((f64::from(v) / 255.0 - 0.5) / COLOR) as f32);
    let higher: Vec<[f32; 3]> =
        harmonics.as_chunks().0.iter().map(|b: &[u8; 3]| b.map(|v| (f32::from(v) - 128.0) / 128.0)).collect();
    let mut all = vec![];
    for (i, b) in colors.as_chunks::<3>().0.iter().enumerate() {
        all.push(color(b));
        all.extend_from_slice(&higher[i * rest..(i + 1) * rest]);
    }
    Ok(Cloud {
        position: positions.as_chunks().0.to_vec(),
        log_scale: scales.as_chunks().0.iter().map(scale).collect(),
        rotation: rotations.as_chunks().0.iter().map(|b| unpack_rotation(u32::from_le_bytes(*b))).collect(),
        logit: alphas.iter().map(|a| logit(f64::from(*a) / 255.0)).collect(),
        degree,
        harmonics: all,
    })
}
