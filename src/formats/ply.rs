//! The PLY file of 3D Gaussian Splatting: 62 float32 per Gaussian, binary little endian, no comment lines but [`TAG`].
//!
//! `x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0..2 rot_0..3`: normals 0, `f_rest` fifteen coefficients of red,
//! then green, then blue, those beyond the cloud's degree 0; opacity as logit, scales as natural logarithms, the unit
//! quaternion as w x y z.

use crate::math::harmonics::coefficients;
use crate::model::gaussians::Cloud;

/// Floats of a Gaussian.
pub const FLOATS: usize = 62;
/// The line of Gaussians that were trained with antialiasing, as Brush and splat-transform write it.
pub const TAG: &str = "comment SplatRenderMode: mip\n";
/// Coefficients per channel behind the first, of degree 3.
const REST: usize = 15;

/// Names of a Gaussian's floats, in the order of the file.
pub fn properties() -> Vec<String> {
    let numbered = |stem: &'static str, count| (0..count).map(move |i| format!("{stem}_{i}"));
    ["x", "y", "z", "nx", "ny", "nz"]
        .map(str::to_owned)
        .into_iter()
        .chain(numbered("f_dc", 3))
        .chain(numbered("f_rest", 3 * REST))
        .chain(["opacity".to_owned()])
        .chain(numbered("scale", 3))
        .chain(numbered("rot", 4))
        .collect()
}

fn header(count: usize, antialiased: bool) -> String {
    let tag = if antialiased { TAG } else { "" };
    let properties: String = properties().iter().map(|name| format!("property float {name}\n")).collect();
    format!("ply\nformat binary_little_endian 1.0\n{tag}element vertex {count}\n{properties}end_header\n")
}

/// The file's bytes.
pub fn encode(cloud: &Cloud) -> Vec<u8> {
    let mut bytes = header(cloud.len(), cloud.antialiased).into_bytes();
    bytes.reserve_exact(cloud.len() * FLOATS * 4);
    for i in 0..cloud.len() {
        let harmonics = cloud.harmonics_of(i);
        let mut row = [0f32; FLOATS];
        row[..3].copy_from_slice(&cloud.position[i]);
        row[6..9].copy_from_slice(&harmonics[0]);
        for (k, coefficient) in harmonics.iter().enumerate().skip(1) {
            for (channel, value) in coefficient.iter().enumerate() {
                row[9 + channel * REST + k - 1] = *value;
            }
        }
        row[54] = cloud.logit[i];
        row[55..58].copy_from_slice(&cloud.log_scale[i]);
        row[58..].copy_from_slice(&cloud.rotation[i]);
        row.iter().for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
    }
    bytes
}

/// Whether these are the first bytes of a PLY file of Gaussians, of whatever program: it has colours as harmonics.
pub fn is_gaussians(bytes: &[u8]) -> bool {
    let head = &bytes[..bytes.len().min(1 << 16)];
    let end = head.windows(10).position(|w| w == b"end_header").unwrap_or(head.len());
    String::from_utf8_lossy(&head[..end]).lines().any(|line| line.trim_end().ends_with(" f_dc_0"))
}

/// Reads what [`encode`] wrote; harmonics have the lowest degree that holds all that are not 0.
///
/// # Errors
/// Any other file, or one that is cut off.
pub fn decode(bytes: &[u8]) -> Result<Cloud, String> {
    let broken = |what: &str| format!("not a PLY file as `gscream-vk export` writes it: {what}");
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).ok_or_else(|| broken("it has no header"))?;
    let (head, body) = bytes.split_at(at + end.len());
    let head = std::str::from_utf8(head).map_err(|_| broken("the header is not text"))?;
    let count = head.lines().find_map(|line| line.strip_prefix("element vertex ")?.parse().ok());
    let count: usize = count.ok_or_else(|| broken("it does not say how many Gaussians it holds"))?;
    let antialiased = head.contains(TAG);
    if head != header(count, antialiased) {
        return Err(broken("its header is another"));
    }
    if count.checked_mul(FLOATS * 4) != Some(body.len()) {
        return Err(broken("it is cut off"));
    }
    let (words, _) = body.as_chunks::<4>();
    let values: Vec<f32> = words.iter().map(|word| f32::from_le_bytes(*word)).collect();
    let (rows, _) = values.as_chunks::<FLOATS>();
    let highest = |row: &[f32; FLOATS]| (0..REST).rev().find(|k| (0..3).any(|c| row[9 + c * REST + k] != 0.0));
    let last = rows.iter().filter_map(highest).max().map_or(0, |k| k + 1);
    let degree = (0..3).find(|d| coefficients(*d) > last).unwrap_or(3);
    let mut cloud = Cloud { degree, antialiased, ..Cloud::default() };
    for row in rows {
        cloud.position.push([row[0], row[1], row[2]]);
        cloud.harmonics.push([row[6], row[7], row[8]]);
        for k in 0..coefficients(degree) - 1 {
            cloud.harmonics.push(std::array::from_fn(|c| row[9 + c * REST + k]));
        }
        cloud.logit.push(row[54]);
        cloud.log_scale.push([row[55], row[56], row[57]]);
        cloud.rotation.push([row[58], row[59], row[60], row[61]]);
    }
    Ok(cloud)
}
