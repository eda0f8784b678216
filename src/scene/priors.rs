//! Depth priors, and how they stand on disk: `.npy`, `.exr` and `.png`, in any resolution with the picture's proportions.

use std::path::Path;

use exr::meta::MetaData;

use super::npy::{self, Map};
use super::picture::{self, MAX_PIXELS, MOST_GROWTH};
use super::{Error, resample};

/// What the values of a prior mean, up to an unknown positive scale and a shift.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PriorKind {
    /// Grows with the distance z from the camera plane.
    Depth,
    /// Grows with 1 / z.
    Disparity,
}

impl PriorKind {
    pub(super) fn folder(self) -> &'static str {
        match self {
            PriorKind::Depth => "depth",
            PriorKind::Disparity => "disparity",
        }
    }

    pub(super) fn suffix(self) -> &'static str {
        match self {
            PriorKind::Depth => "_depth",
            PriorKind::Disparity => "_disparity",
        }
    }

    pub(super) fn other(self) -> PriorKind {
        match self {
            PriorKind::Depth => PriorKind::Disparity,
            PriorKind::Disparity => PriorKind::Depth,
        }
    }
}

/// A monocular depth map, known up to scale and shift. Views of one scene may differ in kind.
#[derive(Clone, Debug, PartialEq)]
pub struct Prior {
    /// Depth or disparity.
    pub kind: PriorKind,
    /// [row-major pixel], height x width of its view; NaN where there is none.
    pub values: Vec<f32>,
}

/// A prior's values in their own range, from the 2nd to the 98th hundredth of them, NaN where there is none: about 0 to
/// 1, whatever its unit. The depth losses' weights mean that range; it is the unit of the priors that GScream's weights
/// were chosen for, and of no other.
pub fn in_own_range(values: &[f32]) -> Vec<f32> {
    let [low, width] = own_range(values);
    values.iter().map(|v| ((f64::from(*v) - low) / width) as f32).collect()
}

/// Where the range of [`in_own_range`] begins, and its width: 0 and 1 without a value.
pub fn own_range(values: &[f32]) -> [f64; 2] {
    let mut sorted: Vec<f32> = values.iter().copied().filter(|v| v.is_finite()).collect();
    if sorted.is_empty() {
        return [0.0, 1.0];
    }
    sorted.sort_unstable_by(f32::total_cmp);
    let at = |share: f64| f64::from(sorted[((sorted.len() - 1) as f64 * share).round() as usize]);
    let range = |low: f64, high: f64| (high > low).then_some([low, high - low]);
    // A map that is flat but for a few pixels still has a range.
    range(at(0.02), at(0.98)).or_else(|| range(at(0.0), at(1.0))).unwrap_or([at(0.0), 1.0])
}

impl Prior {
    /// Whether some pixels have no value.
    pub fn has_gaps(&self) -> bool {
        self.values.iter().any(|v| v.is_nan())
    }

    /// Whether it has one value only, or none.
    pub(super) fn is_flat(&self) -> bool {
        let mut values = self.values.iter().filter(|v| v.is_finite());
        let first = values.next();
        values.all(|v| Some(v) == first)
    }
}

/// File extensions read here, lower case.
pub(super) const EXTENSIONS: [&str; 3] = ["npy", "exr", "png"];

/// Bytes of the largest OpenEXR picture that is read, over all its channels.
const MAX_EXR_BYTES: u64 = 8 * MAX_PIXELS;

/// Reads a prior and brings it to `size`, for a picture whose own size is `picture`.
///
/// Priors often come at a depth network's resolution: any size is accepted whose proportions are those of the picture
/// within 1 %, and resampled by area (shrinking) or linearly (growing). 8- and 16-bit PNG is scaled to [0, 1]; NumPy and
/// OpenEXR values are taken as they are; NaN means that there is no prior at that pixel.
///
/// # Errors
/// Unreadable files, infinite values, other proportions than the picture's.
pub fn read(path: &Path, kind: PriorKind, picture: [u32; 2], size: [u32; 2]) -> Result<Prior, Error> {
    let map = stored(path, picture)?;
    if let Some(at) = map.values.iter().position(|v| v.is_infinite()) {
        let (row, column) = (at / map.size[0] as usize, at % map.size[0] as usize);
        return Err(Error::NotFinite { path: path.to_path_buf(), value: map.values[at], row, column });
    }
    Ok(Prior { kind, values: resample::map(&map.values, map.size, size) })
}

/// Reads a map of the same formats as it is and takes the nearest of its pixels for each of `size`.
///
/// # Errors
/// Unreadable files, other proportions than the picture's.
pub(super) fn nearest(path: &Path, picture: [u32; 2], size: [u32; 2]) -> Result<Vec<f32>, Error> {
    let map = stored(path, picture)?;
    let at = |i: u32, axis: usize| {
        // The pixel of the map that holds the centre of pixel i.
        ((2 * u64::from(i) + 1) * u64::from(map.size[axis]) / (2 * u64::from(size[axis]))) as usize
    };
    let row = |y: u32| at(y, 1) * map.size[0] as usize;
    Ok((0..size[1])
        .flat_map(|y| (0..size[0]).map(move |x| (x, y)))
        .map(|(x, y)| map.values[row(y) + at(x, 0)])
        .collect())
}

/// A file's values, whose proportions are those of `picture` within 1 %.
fn stored(path: &Path, picture: [u32; 2]) -> Result<Map, Error> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    let fits = |size: [u32; 2]| {
        let [w, h] = size.map(f64::from);
        let proportion = (w / h) / (f64::from(picture[0]) / f64::from(picture[1]));
        let off = (proportion - 1.0).abs() > 0.01;
        if off { Err(Error::PriorSize { path: path.to_path_buf(), size, picture }) } else { Ok(()) }
    };
    match extension.as_str() {
        "npy" => {
            let map = npy::read(path)?;
            fits(map.size)?;
            Ok(map)
        }
        "exr" => {
            fits(exr_size(path)?)?;
            exr(path)
        }
        _ => {
            fits(picture::dimensions(path)?)?;
            png(path)
        }
    }
}

fn invalid(path: &Path, what: impl std::fmt::Display) -> Error {
    Error::File { path: path.to_path_buf(), what: what.to_string() }
}

/// Width and height of an OpenEXR picture's first layer, whose headers are held against the file's length.
fn exr_size(path: &Path) -> Result<[u32; 2], Error> {
    let unreadable = |e: exr::error::Error| invalid(path, format!("not a readable OpenEXR picture: {e}"));
    let length = std::fs::metadata(path).map_err(|source| Error::Io { path: path.to_path_buf(), source })?.len();
    let meta = MetaData::read_from_file(path, false).map_err(unreadable)?;
    for header in &meta.headers {
        let [w, h] = [header.layer_size.0, header.layer_size.1].map(|n| n as u64);
        let pixels = w.saturating_mul(h);
        if !(1..=MAX_PIXELS).contains(&pixels) {
            return Err(invalid(path, format!("the OpenEXR picture is {w}x{h}; a map has 1 to {MAX_PIXELS} values")));
        }
        let bytes = pixels.saturating_mul(header.channels.bytes_per_pixel as u64);
        if bytes > MAX_EXR_BYTES {
            let count = header.channels.list.len();
            return Err(invalid(
                path,
                format!("the OpenEXR picture is {w}x{h} with {count} channels; keep the one that is depth"),
            ));
        }
        if bytes > length.saturating_mul(MOST_GROWTH) {
            let what =
                format!("the OpenEXR picture is said to be {w}x{h}, which {length} bytes cannot hold; copy it again");
            return Err(invalid(path, what));
        }
    }
    let first = meta.headers.first().ok_or_else(|| invalid(path, "the OpenEXR picture is empty"))?;
    // At most 2^28 pixels, so that each side fits.
    Ok([first.layer_size.0 as u32, first.layer_size.1 as u32])
}

fn exr(path: &Path) -> Result<Map, Error> {
    let image = exr::image::read::read_first_flat_layer_from_file(path)
        .map_err(|e| invalid(path, format!("not a readable OpenEXR picture: {e}")))?;
    let layer = image.layer_data;
    let channels = &layer.channel_data.list;
    let named = |name: &str| channels.iter().find(|c| c.name.to_string().eq_ignore_ascii_case(name));
    let channel = ["Z", "depth", "disparity", "Y", "R"]
        .into_iter()
        .find_map(named)
        .or_else(|| channels.first())
        .ok_or_else(|| invalid(path, "the OpenEXR picture has no channels"))?;
    let size = [layer.size.0, layer.size.1].map(|n| u32::try_from(n).unwrap_or(0));
    let values: Vec<f32> = channel.sample_data.values_as_f32().collect();
    if values.is_empty() || values.len() as u64 != u64::from(size[0]) * u64::from(size[1]) {
        return Err(invalid(path, "the OpenEXR picture has a channel of another size than its own; save one channel"));
    }
    Ok(Map { values, size })
}

fn png(path: &Path) -> Result<Map, Error> {
    let image = picture::decode(path)?;
    let size = [image.width(), image.height()];
    fn grey<T: Copy + PartialEq>(colors: &[T]) -> Option<T> {
        colors.iter().all(|v| *v == colors[0]).then_some(colors[0])
    }
    let values = picture::by_pixel(
        &image,
        |colors| grey(colors).map(|v| f32::from(v) / 255.0),
        |colors| grey(colors).map(|v| f32::from(v) / 65535.0),
    );
    let values: Option<Vec<f32>> = values.into_iter().collect();
    let values = values.ok_or_else(|| {
        invalid(path, "a prior is one grey channel, this is a colour picture; save the values, not a colour map")
    })?;
    Ok(Map { values, size })
}

/// Spearman's rank correlation of two maps of the same size over the pixels where `valid`; at most about 65,536 of them,
/// evenly spread. `None` with fewer than 16 pixels or a constant side.
pub(crate) fn rank_correlation(a: &[f32], b: &[f32], valid: impl Fn(usize) -> bool) -> Option<f64> {
    let usable: Vec<usize> = (0..a.len()).filter(|i| valid(*i)).collect();
    let picked: Vec<usize> = usable.iter().copied().step_by(usable.len().div_ceil(1 << 16).max(1)).collect();
    if picked.len() < 16 {
        return None;
    }
    let (ra, rb) = (ranks(&picked, a), ranks(&picked, b));
    let mean = (picked.len() - 1) as f64 / 2.0;
    let dot = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(p, q)| (p - mean) * (q - mean)).sum::<f64>();
    let scale = (dot(&ra, &ra) * dot(&rb, &rb)).sqrt();
    (scale > 0.0).then(|| dot(&ra, &rb) / scale)
}

/// Ranks from 0, ties sharing their mean rank.
fn ranks(picked: &[usize], values: &[f32]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..picked.len()).collect();
    order.sort_by(|i, j| values[picked[*i]].total_cmp(&values[picked[*j]]));
    let mut out = vec![0.0; picked.len()];
    let mut start = 0;
    for run in order.chunk_by(|i, j| values[picked[*i]] == values[picked[*j]]) {
        let rank = start as f64 + (run.len() - 1) as f64 / 2.0;
        run.iter().for_each(|i| out[*i] = rank);
        start += run.len();
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rank_correlation_sees_monotone_relations() {
        let depth: Vec<f32> = (0..400).map(|i| 1.0 + i as f32 * 0.1).collect();
        let disparity: Vec<f32> = depth.iter().map(|z| 1.0 / z).collect();
        let all = |_: usize| true;
        assert!((rank_correlation(&depth, &disparity, all).expect("400 pixels") + 1.0).abs() < 1e-12);
        assert!((rank_correlation(&depth, &depth, all).expect("400 pixels") - 1.0).abs() < 1e-12);
        assert_eq!(rank_correlation(&depth, &[2.0; 400], all), None);
        assert_eq!(rank_correlation(&depth, &disparity, |i| i < 15), None);
        // Only valid pixels count: the second half is reversed.
        let mixed: Vec<f32> = (0..400).map(|i| if i < 200 { depth[i] } else { -depth[i] }).collect();
        assert!((rank_correlation(&depth, &mixed, |i| i < 200).expect("200 pixels") - 1.0).abs() < 1e-12);
        // Ties share their rank: a step against a ramp of four is 2 / sqrt(5), by hand.
        let (ramp, step): (Vec<f32>, Vec<f32>) = (0..16).map(|i| ((i / 4) as f32, (i / 8) as f32)).unzip();
        assert!((rank_correlation(&ramp, &step, all).expect("16 pixels") - 2.0 / 5f64.sqrt()).abs() < 1e-12);
    }
}
