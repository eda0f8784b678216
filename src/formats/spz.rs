//! SPZ (Niantic's packed Gaussians), as <https://github.com/nianticlabs/spz> specifies it: a header and one array per
//! attribute. Versions 2 to 4 are read, 2 and 3 are written.
//!
//! | array | of a Gaussian | means |
//! | --- | --- | --- |
//! | positions | 3 x 24 bits, signed | fixed point with the header's fractional bits |
//! | alphas | u8 | opacity x 255 |
//! | colors | 3 x u8 | coefficient of degree 0 x 0.15 + 0.5, of 255 |
//! | scales | 3 x u8 | (natural logarithm + 10) x 16 |
//! | rotations, version 2 | 3 x u8 | x y z x 127.5 + 127.5, w follows and is positive |
//! | rotations, from version 3 on | u32 | place of the largest component of x y z w (2 bits), then the others: sign and 9 bits of sqrt 2 |
//! | harmonics | 3 x u8 per coefficient | coefficient x 128 + 128, coefficient by coefficient, rgb |
//!
//! Versions 2 and 3 are a gzip stream of a 16-byte header and the arrays. Version 4 has 32 bytes of header, records of
//! vendors that are skipped, a table with two u64 per array (bytes packed, bytes unpacked), and a Zstandard frame for each.
//! Version 1 has half floats for positions, which the specification does not describe; it is refused, and so is degree 4.
//!
//! The file does not say which way is up, and programs differ. Axes here are those of the PLY, as splat-transform has it.
//! The fractional bits are as many as the farthest Gaussian leaves (24 at most), so that a scene's unit costs nothing; the
//! scales' range (4.5e-5 to 380 units) is the format's.

use std::io::{Read, Write as _};

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use ruzstd::decoding::StreamingDecoder;

use crate::math::harmonics::coefficients;
use crate::model::gaussians::{Cloud, NORM_EPSILON, logit, sigmoid};

/// The first bytes of a header.
pub const MAGIC: [u8; 4] = *b"NGSP";
/// Bytes of the header that all versions have.
const HEADER: usize = 16;
/// Bytes of version 4's.
const LONG_HEADER: usize = 32;
/// Bytes of an entry of version 4's table.
const ENTRY: usize = 16;
/// The header's flag of Gaussians that were trained with antialiasing.
const ANTIALIASED: u8 = 1;
/// Colour coefficients are packed with this factor.
const COLOR: f64 = 0.15;
/// Largest magnitude of a rotation's component in the file.
const COMPONENT: u32 = (1 << 9) - 1;
/// Half the steps of a component of version 2.
const HALF: f64 = 127.5;
/// Gaussians at most, 9 GB of them.
const MOST_GAUSSIANS: usize = 1 << 27;
/// Fractional bits at most: JavaScript readers shift a 32-bit 1 by them.
const MOST_BITS: u32 = 24;
/// Bytes that a Zstandard frame may look back: every decoder is asked for as much, and longer arrays have longer ones.
const WINDOW: u64 = 8 << 20;

/// A version that is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Version {
    /// Rotations of 24 bits, for older readers.
    Two = 2,
    /// Rotations of 32 bits.
    #[default]
    Three = 3,
}

fn byte(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// Fractional bits for the farthest coordinate: as many as 24 signed bits leave.
fn fractional_bits(cloud: &Cloud) -> u32 {
    let farthest = cloud.position.as_flattened().iter().fold(0f64, |m, v| m.max(f64::from(v.abs())));
    let room = f64::from((1 << 23) - 1);
    (0..=MOST_BITS).rev().find(|bits| farthest * f64::from(1u32 << bits) <= room).unwrap_or(0)
}

/// The rotation's unit quaternion x y z w: other programs' need not have length one.
fn unit([w, x, y, z]: [f32; 4]) -> [f64; 4] {
    let q = [x, y, z, w].map(f64::from);
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt().max(NORM_EPSILON);
    q.map(|v| v / norm)
}

/// A quaternion w x y z in 32 bits.
fn pack_rotation(rotation: [f32; 4]) -> u32 {
    let q = unit(rotation);
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

/// A quaternion w x y z in 24 bits: x y z of the one of q and -q that has a positive w.
fn pack_small_rotation(rotation: [f32; 4]) -> [u8; 3] {
    let [x, y, z, w] = unit(rotation);
    let sign = if w < 0.0 { -1.0 } else { 1.0 };
    [x, y, z].map(|v| byte(v * sign * HALF + HALF))
}

fn unpack_small_rotation(bytes: &[u8; 3]) -> [f32; 4] {
    let [x, y, z] = bytes.map(|b| f64::from(b) / HALF - 1.0);
    let w = (1.0 - x * x - y * y - z * z).max(0.0).sqrt();
    // Three rounded components may be longer than one by themselves.
    let norm = (w * w + x * x + y * y + z * z).sqrt();
    [w, x, y, z].map(|v| (v / norm) as f32)
}

/// The file's bytes.
///
/// # Errors
/// A position that 24 bits cannot hold: farther than 8 million scene units from the origin.
pub fn encode(cloud: &Cloud, version: Version) -> Result<Vec<u8>, String> {
    let bits = fractional_bits(cloud);
    let unit = f64::from(1u32 << bits);
    let count = cloud.len() as u32;
    let mut raw = Vec::with_capacity(HEADER + cloud.len() * (20 + 3 * (coefficients(cloud.degree) - 1)));
    raw.extend_from_slice(&MAGIC);
    for word in [version as u32, count] {
        raw.extend_from_slice(&word.to_le_bytes());
    }
    let flags = if cloud.antialiased { ANTIALIASED } else { 0 };
    raw.extend_from_slice(&[cloud.degree as u8, bits as u8, flags, 0]);
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
        match version {
            Version::Two => raw.extend_from_slice(&pack_small_rotation(*rotation)),
            Version::Three => raw.extend_from_slice(&pack_rotation(*rotation).to_le_bytes()),
        }
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

/// The header of a file, within the format's limits.
struct Header {
    version: u32,
    count: usize,
    degree: u32,
    bits: u32,
    antialiased: bool,
    /// Of version 4: how many arrays there are.
    streams: usize,
}

impl Header {
    fn read(bytes: [u8; HEADER]) -> Result<Self, String> {
        let (words, _) = bytes.as_chunks::<4>();
        let [_, version, count, _] = std::array::from_fn(|i| u32::from_le_bytes(words[i]));
        let [degree, bits, flags, streams] = words[3];
        if words[0] != MAGIC {
            return Err(broken("its first bytes are others"));
        }
        if !(2..=4).contains(&version) {
            return Err(format!("it is SPZ of version {version}; versions 2, 3 and 4 are read"));
        }
        if degree > 3 {
            return Err(format!("it is SPZ of degree {degree}; degrees 0 to 3 are read"));
        }
        if u32::from(bits) > MOST_BITS {
            return Err(broken(&format!("positions have {bits} fractional bits")));
        }
        if count as usize > MOST_GAUSSIANS {
            return Err(broken(&format!("{count} Gaussians")));
        }
        let antialiased = flags & ANTIALIASED != 0;
        let [degree, bits] = [degree, bits].map(u32::from);
        Ok(Self { version, count: count as usize, degree, bits, antialiased, streams: streams.into() })
    }

    /// Bytes of every array: positions, alphas, colors, scales, rotations, harmonics.
    fn sizes(&self) -> [usize; 6] {
        let rotation = if self.version == 2 { 3 } else { 4 };
        [9, 1, 3, 3, rotation, 3 * (coefficients(self.degree) - 1)].map(|each| each * self.count)
    }
}

fn broken(what: &str) -> String {
    format!("not an SPZ file of version 2 to 4: {what}")
}

/// No more of a stream than it should hold, for a small one may go on for gigabytes, and no less.
fn exactly(size: usize, from: impl Read) -> Result<Vec<u8>, String> {
    let mut bytes = vec![];
    from.take(size as u64).read_to_end(&mut bytes).map_err(|error| broken(&error.to_string()))?;
    if bytes.len() < size { Err(broken("it is cut off")) } else { Ok(bytes) }
}

/// Reads a file of version 2, 3 or 4: the Gaussians as a viewer sees them, rounded.
///
/// # Errors
/// Any other file, or one that is cut off.
pub fn decode(bytes: &[u8]) -> Result<Cloud, String> {
    if bytes.starts_with(&MAGIC) { of_frames(bytes) } else { of_gzip(bytes) }
}

/// Versions 2 and 3.
fn of_gzip(bytes: &[u8]) -> Result<Cloud, String> {
    let mut unpacked = GzDecoder::new(bytes);
    let mut first = [0; HEADER];
    unpacked.read_exact(&mut first).map_err(|error| broken(&error.to_string()))?;
    let header = Header::read(first)?;
    if header.version == 4 {
        return Err(broken("its version is 4, which has no gzip around it"));
    }
    let sizes = header.sizes();
    let whole = exactly(sizes.iter().sum(), unpacked)?;
    let mut rest = whole.as_slice();
    let arrays = sizes.map(|size| {
        let (array, behind) = rest.split_at(size);
        rest = behind;
        array
    });
    Ok(unpack(&header, arrays))
}

/// Version 4.
fn of_frames(bytes: &[u8]) -> Result<Cloud, String> {
    let cut = || broken("it is cut off");
    let part = |at: usize, size: usize| {
        let end = at.checked_add(size).ok_or_else(cut)?;
        bytes.get(at..end).ok_or_else(cut)
    };
    let long = part(0, LONG_HEADER)?;
    let header = Header::read(std::array::from_fn(|i| long[i]))?;
    if header.version != 4 {
        return Err(broken(&format!("its version is {}, which is within gzip", header.version)));
    }
    let table = u32::from_le_bytes(std::array::from_fn(|i| long[HEADER + i])) as usize;
    if table < LONG_HEADER {
        return Err(broken("its table begins within its header"));
    }
    let entries = part(table, header.streams * ENTRY)?;
    let number = |i: usize| u64::from_le_bytes(std::array::from_fn(|b| entries[8 * i + b]));
    let mut at = table + entries.len();
    let mut arrays: [Vec<u8>; 6] = Default::default();
    // Arrays without bytes may be left out; the only such of a splat is the last.
    for (i, (array, size)) in arrays.iter_mut().zip(header.sizes()).enumerate().filter(|(_, (_, size))| *size > 0) {
        if i >= header.streams || number(2 * i + 1) != size as u64 {
            return Err(broken("its table is not of as many Gaussians as its header"));
        }
        let packed = part(at, usize::try_from(number(2 * i)).map_err(|_| cut())?)?;
        at += packed.len();
        let frame = StreamingDecoder::new_with_max_window_size(packed, WINDOW.max(size as u64));
        *array = exactly(size, frame.map_err(|error| broken(&error.to_string()))?)?;
    }
    Ok(unpack(&header, arrays.each_ref().map(Vec::as_slice)))
}

fn unpack(header: &Header, arrays: [&[u8]; 6]) -> Cloud {
    let [positions, alphas, colors, scales, rotations, harmonics] = arrays;
    let unit = f64::from(1u32 << header.bits);
    let fixed = |b: &[u8; 3]| (f64::from(i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) / unit) as f32;
    let positions: Vec<f32> = positions.as_chunks().0.iter().map(fixed).collect();
    let scale = |b: &[u8; 3]| b.map(|v| f32::from(v) / 16.0 - 10.0);
    let rotation = match header.version {
        2 => rotations.as_chunks().0.iter().map(unpack_small_rotation).collect(),
        _ => rotations.as_chunks().0.iter().map(|b| unpack_rotation(u32::from_le_bytes(*b))).collect(),
    };
    let color = |b: &[u8; 3]| b.map(|v| ((f64::from(v) / 255.0 - 0.5) / COLOR) as f32);
    let rest = coefficients(header.degree) - 1;
    let higher: Vec<[f32; 3]> =
        harmonics.as_chunks().0.iter().map(|b: &[u8; 3]| b.map(|v| (f32::from(v) - 128.0) / 128.0)).collect();
    let mut all = vec![];
    for (i, b) in colors.as_chunks::<3>().0.iter().enumerate() {
        all.push(color(b));
        all.extend_from_slice(&higher[i * rest..(i + 1) * rest]);
    }
    Cloud {
        position: positions.as_chunks().0.to_vec(),
        log_scale: scales.as_chunks().0.iter().map(scale).collect(),
        rotation,
        logit: alphas.iter().map(|a| logit(f64::from(*a) / 255.0)).collect(),
        degree: header.degree,
        harmonics: all,
        antialiased: header.antialiased,
    }
}
