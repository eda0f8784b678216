//! SOG of version 2 (PlayCanvas' spatially ordered Gaussians), bundled: a zip of `meta.json` and lossless WebP pictures, as
//! <https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog> specifies it. A Gaussian is the same pixel
//! of every picture, row by row.
//!
//! | picture | of a Gaussian | means |
//! | --- | --- | --- |
//! | `means_l`, `means_u` | rgb: low and high byte | x y z as sign x ln(1 + magnitude), 65,535 steps between the least and the most |
//! | `scales` | rgb | entries of a list of natural logarithms |
//! | `quats` | rgba | the three smaller components of w x y z x sqrt 2, of 255 from -1 to 1; 252 + place of the largest |
//! | `sh0` | rgba | entries of a list of coefficients of degree 0; opacity x 255 |
//! | `shN_labels` | rg: low and high byte | place in the palette |
//! | `shN_centroids` | rgb, 64 palette places a row | entries of a list of coefficients |
//!
//! Written here: Gaussians in Morton order; lists of 256 of which half lie evenly between the least and the most value, so that
//! none is off by more than a 254th of that, and half at values of equal share; a palette that is exact up to 65,536
//! Gaussians and beyond that of the means of groups, the widest of which are divided first. Axes are those of the PLY.

use std::collections::BinaryHeap;
use std::io::{Cursor, Read as _, Write as _};

use image_webp::{ColorType, WebPDecoder, WebPEncoder};
use serde::{Deserialize, Serialize};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use crate::math::harmonics::coefficients;
use crate::model::gaussians::{Cloud, NORM_EPSILON, logit, sigmoid};

/// The version that is read and written.
const VERSION: u32 = 2;
/// The word for `model` of Gaussians that were trained with antialiasing.
const ANTIALIASED: &str = "antialiased";
/// Entries of a list.
const ENTRIES: usize = 256;
/// Steps of a position.
const STEPS: f64 = 65535.0;
/// The fourth byte of a rotation whose first component is the largest; one more for each next.
const LARGEST: u8 = 252;
/// Entries of the palette at most, and in a row of its picture.
const PALETTE: usize = 1 << 16;
const PALETTE_ROW: usize = 64;
/// The longest side of a WebP picture.
const SIDE: usize = 16383;
/// Gaussians for each byte of a file at most. Positions alone take bytes, unless the Gaussians stand in rows.
const EACH_BYTE: usize = 64;
/// Pixels of a picture beyond one for each Gaussian: some programs round sides up.
const MARGIN: usize = 1 << 16;

/// `meta.json`.
#[derive(Serialize, Deserialize)]
struct Meta {
    version: u32,
    count: usize,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    model: Option<String>,
    means: Means,
    scales: List,
    quats: Files,
    sh0: List,
    #[serde(default, rename = "shN", skip_serializing_if = "Option::is_none")]
    rest: Option<Rest>,
}

#[derive(Serialize, Deserialize)]
struct Means {
    mins: [f64; 3],
    maxs: [f64; 3],
    files: Vec<String>,
}

#[derive(Serialize, Deserialize)]
struct List {
    /// JSON has no number for infinity.
    codebook: Vec<Option<f32>>,
    files: Vec<String>,
}

#[derive(Serialize, Deserialize)]
struct Files {
    files: Vec<String>,
}

#[derive(Serialize, Deserialize)]
struct Rest {
    count: usize,
    bands: u32,
    codebook: Vec<Option<f32>>,
    files: Vec<String>,
}

fn byte(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

fn broken(what: &str) -> String {
    format!("not a SOG file of version {VERSION}: {what}")
}

/// A place on the scale of the positions.
fn fold(v: f32) -> f64 {
    f64::from(v).abs().ln_1p().copysign(v.into())
}

fn unfold(v: f64) -> f32 {
    v.abs().exp_m1().copysign(v) as f32
}

/// A list of values and, for each that was given, its nearest entry's place.
fn listed(values: &[f32]) -> (Vec<f32>, Vec<u8>) {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f32::total_cmp);
    let (Some(&low), Some(&high)) = (sorted.first(), sorted.last()) else { return (vec![0.0; ENTRIES], vec![]) };
    let half = ENTRIES / 2;
    let part = |i: usize| i as f64 / (half - 1) as f64;
    let even = |i: usize| (f64::from(low) * (1.0 - part(i)) + f64::from(high) * part(i)) as f32;
    let share = |i: usize| sorted[((2 * i + 1) * sorted.len() / (2 * half)).min(sorted.len() - 1)];
    let mut list: Vec<f32> = (0..half).map(even).chain((0..half).map(share)).collect();
    list.sort_unstable_by(f32::total_cmp);
    let nearest = |v: &f32| {
        let above = list.partition_point(|entry| entry < v).min(ENTRIES - 1);
        let below = above.saturating_sub(1);
        if (list[below] - v).abs() <= (list[above] - v).abs() { below as u8 } else { above as u8 }
    };
    let places = values.iter().map(nearest).collect();
    (list, places)
}

/// Numbers of the Gaussians by the interleaved bits of where they stand.
fn ordered(position: &[[f32; 3]], bounds: &[[f64; 2]; 3]) -> Vec<usize> {
    let key = |p: &[f32; 3]| {
        (0..3).fold(0u64, |key, c| {
            let [low, high] = bounds[c];
            let part = (fold(p[c]) - low) / (high - low).max(f64::MIN_POSITIVE);
            let cell = (part * 1023.0) as u64;
            (0..10).fold(key, |key, bit| key | (cell >> bit & 1) << (3 * bit + c as u64))
        })
    };
    let mut order: Vec<usize> = (0..position.len()).collect();
    order.sort_by_cached_key(|i| key(&position[*i]));
    order
}

/// A group of rows whose mean may stand for them.
struct Group {
    rows: Vec<u32>,
    mean: Vec<f32>,
    /// The column that differs most among them.
    widest: usize,
    /// The sum of squared distances from the mean.
    off: f64,
}

impl Group {
    fn new(rows: Vec<u32>, all: &[f32], columns: usize) -> Self {
        let row = |i: &u32| &all[*i as usize * columns..][..columns];
        let mut mean = vec![0f64; columns];
        rows.iter().for_each(|i| mean.iter_mut().zip(row(i)).for_each(|(sum, v)| *sum += f64::from(*v)));
        mean.iter_mut().for_each(|sum| *sum /= rows.len() as f64);
        let mut spread = vec![0f64; columns];
        for i in &rows {
            spread.iter_mut().zip(row(i).iter().zip(&mean)).for_each(|(s, (v, m))| *s += (f64::from(*v) - m).powi(2));
        }
        let widest = (0..columns).fold(0, |best, c| if spread[c] > spread[best] { c } else { best });
        Self { mean: mean.iter().map(|v| *v as f32).collect(), off: spread.iter().sum(), rows, widest }
    }
}

impl PartialEq for Group {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Group {}

impl PartialOrd for Group {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Group {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.off.total_cmp(&other.off)
    }
}

/// At most so many rows that stand for all, and the one of each.
fn palette(all: &[f32], columns: usize, most: usize) -> (Vec<f32>, Vec<u32>) {
    let count = all.len() / columns;
    if count <= most {
        return (all.to_vec(), (0..count as u32).collect());
    }
    let mut groups = BinaryHeap::from([Group::new((0..count as u32).collect(), all, columns)]);
    while groups.len() < most && groups.peek().is_some_and(|group| group.off > 0.0) {
        let Some(group) = groups.pop() else { break };
        let Group { rows, mean, widest, .. } = group;
        let above = |i: &u32| all[*i as usize * columns + widest] > mean[widest];
        let (high, low): (Vec<u32>, Vec<u32>) = rows.into_iter().partition(above);
        // Rounding may put all of them on one side: then the mean is as near as it gets.
        let whole = high.is_empty() || low.is_empty();
        for rows in [high, low].into_iter().filter(|rows| !rows.is_empty()) {
            let mut group = Group::new(rows, all, columns);
            if whole {
                group.off = 0.0;
            }
            groups.push(group);
        }
    }
    let mut labels = vec![0u32; count];
    let mut means = Vec::with_capacity(groups.len() * columns);
    for (label, group) in groups.into_iter().enumerate() {
        means.extend(group.mean);
        group.rows.iter().for_each(|i| labels[*i as usize] = label as u32);
    }
    (means, labels)
}

fn picture(pixels: &[[u8; 4]], width: usize, height: usize) -> Result<Vec<u8>, String> {
    let mut bytes = vec![];
    let encoder = WebPEncoder::new(&mut bytes);
    let encoded = encoder.encode(pixels.as_flattened(), width as u32, height as u32, ColorType::Rgba8);
    encoded.map_err(|error| format!("a picture of the SOG file cannot be written: {error}"))?;
    Ok(bytes)
}

/// The file's bytes.
///
/// # Errors
/// More Gaussians than a picture has pixels, or none, or numbers that are none.
pub fn encode(cloud: &Cloud) -> Result<Vec<u8>, String> {
    let count = cloud.len();
    if count == 0 || cloud.first_not_finite().is_some() {
        return Err("SOG holds finite numbers of at least one Gaussian".into());
    }
    let width = ((count as f64).sqrt() / 4.0).ceil() as usize * 4;
    let height = count.div_ceil(width).next_multiple_of(4);
    if width > SIDE || height > SIDE {
        return Err(format!("SOG cannot hold {count} Gaussians: leave it out of --formats"));
    }
    let bounds: [[f64; 2]; 3] = std::array::from_fn(|c| {
        let folded = cloud.position.iter().map(|p| fold(p[c]));
        folded.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
    });
    let order = ordered(&cloud.position, &bounds);
    let pixels = |of: &dyn Fn(usize) -> [u8; 4]| {
        let mut pixels: Vec<[u8; 4]> = order.iter().map(|i| of(*i)).collect();
        pixels.resize(width * height, [0, 0, 0, 255]);
        picture(&pixels, width, height)
    };
    let step = |i: usize| -> [u16; 3] {
        std::array::from_fn(|c| {
            let [low, high] = bounds[c];
            ((fold(cloud.position[i][c]) - low) / (high - low).max(f64::MIN_POSITIVE) * STEPS).round() as u16
        })
    };
    let means = |byte: usize| {
        pixels(&|i| {
            let [x, y, z] = step(i).map(|v| v.to_le_bytes()[byte]);
            [x, y, z, 255]
        })
    };
    let quaternion = |i: usize| {
        let q = cloud.rotation[i].map(f64::from);
        let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt().max(NORM_EPSILON);
        let largest = (1..4).fold(0, |best, k| if q[k].abs() > q[best].abs() { k } else { best });
        let factor = std::f64::consts::SQRT_2 / norm * q[largest].signum();
        let mut others = (0..4).filter(|k| *k != largest).map(|k| byte((q[k] * factor * 0.5 + 0.5) * 255.0));
        let mut next = || others.next().unwrap_or(0);
        [next(), next(), next(), LARGEST + largest as u8]
    };
    let (scale_list, scales) = listed(cloud.log_scale.as_flattened());
    let first: Vec<f32> = (0..count).flat_map(|i| cloud.harmonics_of(i)[0]).collect();
    let (color_list, colors) = listed(&first);
    let mut files = vec![
        ("means_l.webp", means(0)?),
        ("means_u.webp", means(1)?),
        ("quats.webp", pixels(&quaternion)?),
        ("scales.webp", pixels(&|i| [scales[3 * i], scales[3 * i + 1], scales[3 * i + 2], 255])?),
        (
            "sh0.webp",
            pixels(&|i| {
                let [r, g, b] = [0, 1, 2].map(|c| colors[3 * i + c]);
                [r, g, b, byte(sigmoid(cloud.logit[i]) * 255.0)]
            })?,
        ),
    ];
    let mut rest = None;
    if cloud.degree > 0 {
        let each = coefficients(cloud.degree) - 1;
        let all: Vec<f32> = (0..count).flat_map(|i| cloud.harmonics_of(i)[1..].as_flattened().to_vec()).collect();
        let (centroids, labels) = palette(&all, 3 * each, PALETTE);
        let places = centroids.len() / (3 * each);
        let (list, entries) = listed(&centroids);
        let mut swatches: Vec<[u8; 4]> = entries.as_chunks::<3>().0.iter().map(|[r, g, b]| [*r, *g, *b, 255]).collect();
        let rows = places.div_ceil(PALETTE_ROW);
        swatches.resize(rows * PALETTE_ROW * each, [0, 0, 0, 255]);
        files.push(("shN_centroids.webp", picture(&swatches, PALETTE_ROW * each, rows)?));
        files.push((
            "shN_labels.webp",
            pixels(&|i| {
                let [low, high, ..] = labels[i].to_le_bytes();
                [low, high, 0, 255]
            })?,
        ));
        let files = ["shN_centroids.webp", "shN_labels.webp"].map(str::to_owned).into();
        let codebook = list.into_iter().map(Some).collect();
        rest = Some(Rest { count: places, bands: cloud.degree, codebook, files });
    }
    let named = |name: &str| vec![name.to_owned()];
    let meta = Meta {
        version: VERSION,
        count,
        model: cloud.antialiased.then(|| ANTIALIASED.to_owned()),
        means: Means {
            mins: bounds.map(|[low, _]| low),
            maxs: bounds.map(|[_, high]| high),
            files: ["means_l.webp", "means_u.webp"].map(str::to_owned).into(),
        },
        scales: List { codebook: scale_list.into_iter().map(Some).collect(), files: named("scales.webp") },
        quats: Files { files: named("quats.webp") },
        sh0: List { codebook: color_list.into_iter().map(Some).collect(), files: named("sh0.webp") },
        rest,
    };
    let failed = |error: String| format!("the SOG file cannot be put together: {error}");
    files.push(("meta.json", serde_json::to_vec(&meta).map_err(|error| failed(error.to_string()))?));
    let mut archive = ZipWriter::new(Cursor::new(vec![]));
    // The pictures are compressed already, and readers take files that are stored.
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for (name, bytes) in &files {
        archive.start_file(*name, options).map_err(|error| failed(error.to_string()))?;
        archive.write_all(bytes).map_err(|error| failed(error.to_string()))?;
    }
    Ok(archive.finish().map_err(|error| failed(error.to_string()))?.into_inner())
}

/// The pictures of an archive.
struct Archive<'b> {
    zip: ZipArchive<Cursor<&'b [u8]>>,
}

impl Archive<'_> {
    fn file(&mut self, name: &str) -> Result<Vec<u8>, String> {
        let wrong = |error: &dyn std::fmt::Display| broken(&format!("{name}: {error}"));
        let mut file = self.zip.by_name(name).map_err(|error| wrong(&error))?;
        let mut bytes = vec![];
        file.read_to_end(&mut bytes).map_err(|error| wrong(&error))?;
        Ok(bytes)
    }

    /// Pixels of one of a property's pictures and its width; it has at most so many.
    fn picture(&mut self, files: &[String], at: usize, most: usize) -> Result<(Vec<[u8; 4]>, usize), String> {
        let name = files.get(at).ok_or_else(|| broken("it names too few pictures"))?;
        let bytes = self.file(name)?;
        let wrong = |what: &dyn std::fmt::Display| broken(&format!("{name}: {what}"));
        let mut decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(|error| wrong(&error))?;
        let (width, height) = decoder.dimensions();
        let size = width as usize * height as usize;
        if size > most {
            return Err(wrong(&format!("{width} x {height} pixels are too many")));
        }
        if decoder.is_lossy() {
            return Err(wrong(&"it is compressed with loss, which changes every number"));
        }
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        let mut flat = vec![0; channels * size];
        decoder.read_image(&mut flat).map_err(|error| wrong(&error))?;
        let pixel = |p: &[u8]| [p[0], p[1], p[2], p.get(3).copied().unwrap_or(255)];
        Ok((flat.chunks_exact(channels).map(pixel).collect(), width as usize))
    }
}

/// Reads a file: the Gaussians as a viewer sees them, rounded.
///
/// # Errors
/// Any other file, or one that is cut off.
pub fn decode(bytes: &[u8]) -> Result<Cloud, String> {
    let zip = ZipArchive::new(Cursor::new(bytes)).map_err(|error| broken(&error.to_string()))?;
    let mut archive = Archive { zip };
    let text = archive.file("meta.json")?;
    let meta: serde_json::Value = serde_json::from_slice(&text).map_err(|error| broken(&error.to_string()))?;
    match meta.get("version").and_then(serde_json::Value::as_u64) {
        Some(2) => {}
        Some(version) => return Err(format!("it is SOG of version {version}; version 2 is read")),
        None => return Err("it is SOG of version 1; version 2 is read".into()),
    }
    let antialiased = [("model", ANTIALIASED.into()), ("antialias", true.into())];
    let antialiased = antialiased.iter().any(|(key, value)| meta.get(key) == Some(value));
    if meta.get("model").is_some_and(|model| model == "2dgs") {
        return Err("its Gaussians are flat, as those of 2DGS; this program draws solid ones".into());
    }
    let meta: Meta = serde_json::from_value(meta).map_err(|error| broken(&error.to_string()))?;
    let count = meta.count;
    if count / EACH_BYTE > bytes.len() {
        return Err(broken(&format!("{count} Gaussians in {} bytes", bytes.len())));
    }
    let mut own = |files: &[String], at: usize| -> Result<Vec<[u8; 4]>, String> {
        let (mut pixels, _) = archive.picture(files, at, count + MARGIN)?;
        if pixels.len() < count {
            return Err(broken("a picture has fewer pixels than Gaussians"));
        }
        pixels.truncate(count);
        Ok(pixels)
    };
    let (low, high) = (own(&meta.means.files, 0)?, own(&meta.means.files, 1)?);
    let (quats, scales, colors) = (own(&meta.quats.files, 0)?, own(&meta.scales.files, 0)?, own(&meta.sh0.files, 0)?);
    // What is no number is kept and not drawn.
    let entry = |list: &[Option<f32>], i: u8| list.get(usize::from(i)).copied().flatten().unwrap_or(f32::NAN);
    let Means { mins, maxs, .. } = &meta.means;
    let place = |i: usize| {
        std::array::from_fn(|c| {
            let part = f64::from(u16::from_le_bytes([low[i][c], high[i][c]])) / STEPS;
            unfold(mins[c] * (1.0 - part) + maxs[c] * part)
        })
    };
    let three = |list: &[Option<f32>], [r, g, b, _]: [u8; 4]| [r, g, b].map(|i| entry(list, i));
    let mut cloud = Cloud {
        position: (0..count).map(place).collect(),
        log_scale: scales.iter().map(|pixel| three(&meta.scales.codebook, *pixel)).collect(),
        rotation: quats.iter().map(unpack_rotation).collect(),
        logit: colors.iter().map(|pixel| logit(f64::from(pixel[3]) / 255.0)).collect(),
        degree: 0,
        harmonics: colors.iter().map(|pixel| three(&meta.sh0.codebook, *pixel)).collect(),
        antialiased,
    };
    if let Some(rest) = meta.rest.filter(|rest| rest.bands > 0) {
        if rest.bands > 3 || rest.count > PALETTE {
            return Err(broken(&format!("a palette of {} with {} bands", rest.count, rest.bands)));
        }
        let each = coefficients(rest.bands) - 1;
        let labels = own(&rest.files, 1)?;
        let rows = rest.count.div_ceil(PALETTE_ROW);
        let (swatches, width) = archive.picture(&rest.files, 0, PALETTE_ROW * each * rows + MARGIN)?;
        if width != PALETTE_ROW * each {
            return Err(broken(&format!("its palette is {width} pixels wide")));
        }
        let first = std::mem::take(&mut cloud.harmonics);
        cloud.degree = rest.bands;
        for (first, label) in first.into_iter().zip(&labels) {
            let place = usize::from(u16::from_le_bytes([label[0], label[1]])) * each;
            let own = swatches.get(place..place + each).ok_or_else(|| broken("a label is beyond its palette"))?;
            cloud.harmonics.push(first);
            cloud.harmonics.extend(own.iter().map(|pixel| three(&rest.codebook, *pixel)));
        }
    }
    Ok(cloud)
}

/// A unit quaternion w x y z.
fn unpack_rotation(pixel: &[u8; 4]) -> [f32; 4] {
    let [a, b, c, which] = *pixel;
    // Other values are no rotation, which is read as none.
    let Some(largest) = which.checked_sub(LARGEST) else { return [1.0, 0.0, 0.0, 0.0] };
    let others = [a, b, c].map(|v| (f64::from(v) / 255.0 * 2.0 - 1.0) * std::f64::consts::FRAC_1_SQRT_2);
    let rest = (1.0 - others.iter().map(|v| v * v).sum::<f64>()).max(0.0).sqrt();
    let mut others = others.into_iter();
    std::array::from_fn(|k| if k == usize::from(largest) { rest } else { others.next().unwrap_or(0.0) } as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows about three places in a palette of three are those places' means.
    #[test]
    fn a_palette_finds_groups() {
        let places = [[0.0, 1.0], [0.0, -1.0], [4.0, 0.0]];
        let row = |i: usize| places[i % 3].map(|v: f32| v + ((i * 7) % 5) as f32 * 0.01);
        let all: Vec<f32> = (0..30).flat_map(row).collect();
        let (means, labels) = palette(&all, 2, 3);
        assert_eq!((means.len(), labels.len()), (6, 30));
        for (i, label) in labels.iter().enumerate() {
            let mean = &means[2 * *label as usize..][..2];
            // No row is farther from its place than 0.04.
            assert!((0..2).all(|c| (mean[c] - row(i)[c]).abs() <= 0.04), "{i}: {mean:?}");
        }
        let (means, labels) = palette(&all, 2, 30);
        assert!(means == all && labels == (0..30).collect::<Vec<u32>>(), "none is changed where there is room");
        assert_eq!(palette(&[2.0; 8], 2, 2).0, [2.0, 2.0], "nothing is divided that is the same");
    }
}
