//! Binary glTF 2.0 with the ratified extension `KHR_gaussian_splatting`.
//!
//! One mesh of one POINTS primitive: `POSITION`, and under the extension's prefix `ROTATION` (x y z w), `SCALE` (linear),
//! `OPACITY` (0 to 1) and `SH_DEGREE_l_COEF_n`, all float32; kernel `ellipse`, colour space `srgb_rec709_display`. The
//! file's axes are glTF's, +Y up: half a turn about x away from the cloud's. Viewers without the extension draw the
//! points in `COLOR_0`, which glTF wants linear.

use serde_json::{Value, json};

use crate::math::harmonics::{HALF_TURN_ABOUT_X, ZEROTH, coefficients};
use crate::model::gaussians::{Cloud, logit, sigmoid};

/// The extension's name, and the prefix of its attributes.
pub const EXTENSION: &str = "KHR_gaussian_splatting";
const MAGIC: u32 = 0x4654_6c67;
const JSON: u32 = 0x4e4f_534a;
const BIN: u32 = 0x004e_4942;
const FLOAT: u32 = 5126;
const POINTS: u32 = 0;

/// The linear value of a displayed one (IEC 61966-2-1).
fn linear(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// Name, components and floats of every attribute.
fn attributes(cloud: &Cloud) -> Vec<(String, usize, Vec<f32>)> {
    let n = cloud.len();
    let each = coefficients(cloud.degree);
    let of = |name: &str| format!("{EXTENSION}:{name}");
    // Half a turn about x: y and z change sign; the quaternion is multiplied by i from the left.
    let turned = |[w, x, y, z]: [f32; 4]| [w, -z, y, -x];
    let color = |i: usize| {
        let rgb = cloud.harmonics_of(i)[0].map(|v| linear((0.5 + ZEROTH * f64::from(v)).clamp(0.0, 1.0)) as f32);
        [rgb[0], rgb[1], rgb[2], sigmoid(cloud.logit[i]) as f32]
    };
    let mut all = vec![
        ("POSITION".to_owned(), 3, cloud.position.iter().flat_map(|[x, y, z]| [*x, -y, -z]).collect()),
        ("COLOR_0".to_owned(), 4, (0..n).flat_map(color).collect()),
        (of("ROTATION"), 4, cloud.rotation.iter().flat_map(|q| turned(*q)).collect()),
        (of("SCALE"), 3, cloud.log_scale.as_flattened().iter().map(|v| f64::from(*v).exp() as f32).collect()),
        (of("OPACITY"), 1, cloud.logit.iter().map(|l| sigmoid(*l) as f32).collect()),
    ];
    let mut first = 0;
    for degree in 0..=cloud.degree as usize {
        for coefficient in 0..2 * degree + 1 {
            let k = first + coefficient;
            let values = (0..n).flat_map(|i| cloud.harmonics[i * each + k].map(|v| HALF_TURN_ABOUT_X[k] * v));
            all.push((of(&format!("SH_DEGREE_{degree}_COEF_{coefficient}")), 3, values.collect()));
        }
        first += 2 * degree + 1;
    }
    all
}

/// Lowest and highest of each component.
fn bounds(values: &[f32], components: usize) -> (Vec<f32>, Vec<f32>) {
    let fold = |start: f32, pick: fn(f32, f32) -> f32| {
        (0..components).map(|c| values.iter().skip(c).step_by(components).fold(start, |a, b| pick(a, *b))).collect()
    };
    (fold(f32::INFINITY, f32::min), fold(f32::NEG_INFINITY, f32::max))
}

/// The file's bytes.
///
/// # Errors
/// More than the format's 4 GiB.
pub fn encode(cloud: &Cloud) -> Result<Vec<u8>, String> {
    let attributes = attributes(cloud);
    let (mut views, mut accessors, mut names) = (vec![], vec![], serde_json::Map::new());
    let mut bin: Vec<u8> = vec![];
    for (name, components, values) in &attributes {
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][components - 1];
        names.insert(name.clone(), json!(accessors.len()));
        let mut accessor =
            json!({ "bufferView": views.len(), "componentType": FLOAT, "count": cloud.len(), "type": kind });
        if name == "POSITION" {
            let (low, high) = bounds(values, *components);
            accessor["min"] = json!(low);
            accessor["max"] = json!(high);
        }
        accessors.push(accessor);
        views.push(json!({ "buffer": 0, "byteOffset": bin.len(), "byteLength": 4 * values.len() }));
        bin.extend_from_slice(bytemuck::cast_slice(values));
    }
    let splats = json!({
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    });
    let document = json!({
        "asset": { "version": "2.0", "generator": concat!("gscream-vk ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{
            "mode": POINTS, "attributes": names, "extensions": { (EXTENSION): splats },
        }] }],
        "buffers": [{ "byteLength": bin.len() }],
        "bufferViews": views,
        "accessors": accessors,
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = 12 + 8 + text.len() + 8 + bin.len();
    let length = u32::try_from(length).map_err(|_| {
        format!(
            "glTF holds at most 4 GiB and {} Gaussians need {length} bytes: leave glb out of --formats",
            cloud.len()
        )
    })?;
    let mut file = Vec::with_capacity(length as usize);
    for word in [MAGIC, 2, length, text.len() as u32, JSON] {
        file.extend_from_slice(&word.to_le_bytes());
    }
    file.extend_from_slice(&text);
    for word in [bin.len() as u32, BIN] {
        file.extend_from_slice(&word.to_le_bytes());
    }
    file.extend_from_slice(&bin);
    Ok(file)
}

/// Reads what [`encode`] wrote, back into the cloud's axes.
///
/// # Errors
/// Any other file, or one that is cut off.
pub fn decode(bytes: &[u8]) -> Result<Cloud, String> {
    let broken = |what: &str| format!("not a glTF file as `gscream-vk export` writes it: {what}");
    let word = |at: usize| {
        let word = bytes.get(at..at + 4).and_then(|w| <[u8; 4]>::try_from(w).ok());
        word.map(u32::from_le_bytes).ok_or_else(|| broken("it is cut off"))
    };
    if [word(0)?, word(4)?, word(16)?] != [MAGIC, 2, JSON] {
        return Err(broken("its first words are others"));
    }
    let end = 20 + word(12)? as usize;
    let text = bytes.get(20..end).ok_or_else(|| broken("it is cut off"))?;
    let document: Value = serde_json::from_slice(text).map_err(|e| broken(&e.to_string()))?;
    let bin = bytes.get(end + 8..end + 8 + word(end)? as usize).ok_or_else(|| broken("it is cut off"))?;
    let primitive = &document["meshes"][0]["primitives"][0];
    let floats = |name: &str| -> Result<Vec<f32>, String> {
        let missing = || broken(&format!("it has no attribute {name}"));
        let at = primitive["attributes"][name].as_u64().ok_or_else(missing)? as usize;
        let view =
            &document["bufferViews"][document["accessors"][at]["bufferView"].as_u64().ok_or_else(missing)? as usize];
        let [first, length] = ["byteOffset", "byteLength"].map(|key| view[key].as_u64().unwrap_or(0) as usize);
        let part = bin.get(first..).and_then(|rest| rest.get(..length)).ok_or_else(missing)?;
        Ok(part.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect())
    };
    let of = |name: &str| floats(&format!("{EXTENSION}:{name}"));
    let degree = (1..4).take_while(|l| of(&format!("SH_DEGREE_{l}_COEF_0")).is_ok()).count() as u32;
    let each = coefficients(degree);
    let position = floats("POSITION")?;
    let n = position.len() / 3;
    let mut harmonics = vec![[0f32; 3]; n * each];
    let mut k = 0;
    for l in 0..=degree as usize {
        for m in 0..2 * l + 1 {
            let values = of(&format!("SH_DEGREE_{l}_COEF_{m}"))?;
            for (i, rgb) in values.as_chunks::<3>().0.iter().enumerate().take(n) {
                harmonics[i * each + k] = rgb.map(|v| HALF_TURN_ABOUT_X[k] * v);
            }
            k += 1;
        }
    }
    let turned = |q: &[f32; 4]| {
        let [a, b, c, d] = *q;
        [a, -d, c, -b]
    };
    let cloud = Cloud {
        position: position.as_chunks().0.iter().map(|[x, y, z]| [*x, -y, -z]).collect(),
        log_scale: of("SCALE")?.as_chunks().0.iter().map(|s: &[f32; 3]| s.map(|v| f64::from(v).ln() as f32)).collect(),
        rotation: of("ROTATION")?.as_chunks().0.iter().map(turned).collect(),
        logit: of("OPACITY")?.iter().map(|o| logit(f64::from(*o))).collect(),
        degree,
        harmonics,
        antialiased: false,
    };
    if [cloud.log_scale.len(), cloud.rotation.len(), cloud.logit.len()] != [n; 3] {
        return Err(broken("its attributes are not of the same number of Gaussians"));
    }
    Ok(cloud)
}
