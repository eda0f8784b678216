//! Binary glTF 2.0 with the ratified extension `KHR_gaussian_splatting`.
//!
//! One mesh of one POINTS primitive: `POSITION`, and under the extension's prefix `ROTATION` (x y z w), `SCALE` (linear),
//! `OPACITY` (0 to 1) and `SH_DEGREE_l_COEF_n`, all float32; kernel `ellipse`, colour space `srgb_rec709_display`. The
//! file's axes are glTF's, +Y up: half a turn about x away from the cloud's. Viewers without the extension draw the
//! points in `COLOR_0`, which glTF wants linear.
//!
//! Other programs' files are read with integers, normalised or not, with interleaved attributes, and with nodes that move,
//! turn and scale; sparse accessors and several splats in a file are not.

use glam::{DMat3, DMat4, DQuat, DVec3};
use serde_json::{Value, json};

use crate::math::harmonics::{HALF_TURN_ABOUT_X, ZEROTH, coefficients};
use crate::model::gaussians::{Cloud, logit, sigmoid};

/// The extension's name, and the prefix of its attributes.
pub const EXTENSION: &str = "KHR_gaussian_splatting";
const MAGIC: u32 = 0x4654_6c67;
const JSON: u32 = 0x4e4f_534a;
const BIN: u32 = 0x004e_4942;
const BYTE: u64 = 5120;
const UNSIGNED_BYTE: u64 = 5121;
const SHORT: u64 = 5122;
const UNSIGNED_SHORT: u64 = 5123;
const FLOAT: u64 = 5126;
/// The colours that harmonics are trained for.
const COLORS: &str = "srgb_rec709_display";
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
        "colorSpace": COLORS,
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

/// The parts of a file.
struct File<'b> {
    document: Value,
    bin: &'b [u8],
}

fn broken(what: &str) -> String {
    format!("not a glTF file of Gaussians: {what}")
}

fn whole(value: &Value) -> Option<usize> {
    value.as_u64().and_then(|number| usize::try_from(number).ok())
}

impl<'b> File<'b> {
    fn parse(bytes: &'b [u8]) -> Result<Self, String> {
        let cut = || broken("it is cut off");
        let word = |at: usize| {
            let word = bytes.get(at..at + 4).and_then(|w| <[u8; 4]>::try_from(w).ok());
            word.map(u32::from_le_bytes).ok_or_else(cut)
        };
        if [word(0)?, word(4)?, word(16)?] != [MAGIC, 2, JSON] {
            return Err(broken("its first words are others"));
        }
        let end = 20 + word(12)? as usize;
        let text = bytes.get(20..end).ok_or_else(cut)?;
        let document = serde_json::from_slice(text).map_err(|error| broken(&error.to_string()))?;
        let bin = bytes.get(end + 8..end + 8 + word(end)? as usize).ok_or_else(cut)?;
        Ok(Self { document, bin })
    }

    /// The number of the mesh with the splat, and its primitive.
    fn splat(&self) -> Result<(usize, &Value), String> {
        let parts = |value: &'_ Value| value.as_array().map_or(0, Vec::len);
        let meshes = &self.document["meshes"];
        let all = (0..parts(meshes)).flat_map(|m| (0..parts(&meshes[m]["primitives"])).map(move |p| (m, p)));
        let found: Vec<_> = all
            .map(|(mesh, part)| (mesh, &meshes[mesh]["primitives"][part]))
            .filter(|(_, primitive)| primitive["extensions"].get(EXTENSION).is_some())
            .collect();
        match found[..] {
            [one] => Ok(one),
            [] => Err(broken(&format!("none of its meshes has the extension {EXTENSION}"))),
            _ => Err(format!("it holds {} splats; join them into one", found.len())),
        }
    }

    /// An accessor's numbers, one after the other: any type of component, normalised or not, at any distance.
    fn numbers(&self, at: usize, components: usize) -> Option<Vec<f32>> {
        let accessor = &self.document["accessors"][at];
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][components - 1];
        // Values that are given one by one would need no bytes of their own.
        if accessor["type"] != kind || accessor.get("sparse").is_some() {
            return None;
        }
        let view = &self.document["bufferViews"][whole(&accessor["bufferView"])?];
        let [first, offset, stride] = [&view["byteOffset"], &accessor["byteOffset"], &view["byteStride"]]
            .map(|value| if value.is_null() { Some(0) } else { whole(value) });
        let (first, offset, stride) = (first?, offset?, stride?);
        let (count, length) = (whole(&accessor["count"])?, whole(&view["byteLength"])?);
        let part = self.bin.get(first..first.checked_add(length)?)?.get(offset..)?;
        if whole(&view["buffer"])? != 0 || count == 0 {
            return None;
        }
        let kind = accessor["componentType"].as_u64()?;
        let bytes = match kind {
            BYTE | UNSIGNED_BYTE => 1,
            SHORT | UNSIGNED_SHORT => 2,
            FLOAT => 4,
            _ => return None,
        };
        let own = components * bytes;
        let stride = if stride == 0 { own } else { stride };
        // The last element ends within the view, and none begins within another.
        if stride < own || (count - 1).checked_mul(stride)?.checked_add(own)? > part.len() {
            return None;
        }
        let scaled = |value: f32, most: f32| {
            if accessor["normalized"] == true { (value / most).max(-1.0) } else { value }
        };
        let number = |b: &[u8]| match kind {
            BYTE => scaled(f32::from(b[0] as i8), 127.0),
            UNSIGNED_BYTE => scaled(f32::from(b[0]), 255.0),
            SHORT => scaled(f32::from(i16::from_le_bytes([b[0], b[1]])), 32767.0),
            UNSIGNED_SHORT => scaled(f32::from(u16::from_le_bytes([b[0], b[1]])), 65535.0),
            _ => f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
        };
        Some((0..count).flat_map(|i| part[i * stride..][..own].chunks_exact(bytes).map(number)).collect())
    }

    /// From the mesh into the scene: the product of the matrices of its node and of those above it.
    fn transform(&self, mesh: usize) -> Result<DMat4, String> {
        let nodes = self.document["nodes"].as_array().map_or(&[][..], Vec::as_slice);
        let mut above = vec![None; nodes.len()];
        for (i, node) in nodes.iter().enumerate() {
            for child in node["children"].as_array().into_iter().flatten().filter_map(whole) {
                if let Some(above) = above.get_mut(child) {
                    *above = Some(i);
                }
            }
        }
        let mut at = nodes.iter().position(|node| whole(&node["mesh"]) == Some(mesh));
        let mut transform = DMat4::IDENTITY;
        // A tree is no deeper than it has nodes.
        for _ in 0..nodes.len() {
            let Some(node) = at else { break };
            transform = local(&nodes[node]) * transform;
            at = above[node];
        }
        if at.is_some() { Err(broken("its nodes are in a circle")) } else { Ok(transform) }
    }
}

/// A node's own matrix.
fn local(node: &Value) -> DMat4 {
    fn numbers<const N: usize>(value: &Value) -> Option<[f64; N]> {
        value.as_array()?.iter().filter_map(Value::as_f64).collect::<Vec<_>>().try_into().ok()
    }
    if let Some(matrix) = numbers::<16>(&node["matrix"]) {
        return DMat4::from_cols_array(&matrix);
    }
    let scale = numbers(&node["scale"]).map_or(DVec3::ONE, DVec3::from_array);
    let rotation = numbers(&node["rotation"]).map_or(DQuat::IDENTITY, DQuat::from_array);
    let translation = numbers(&node["translation"]).map_or(DVec3::ZERO, DVec3::from_array);
    DMat4::from_scale_rotation_translation(scale, rotation, translation)
}

/// Brings a cloud, which is in the cloud's axes, to where its node has it in the file's.
fn place(cloud: &mut Cloud, transform: DMat4) -> Result<(), String> {
    if transform == DMat4::IDENTITY {
        return Ok(());
    }
    let matrix = DMat3::from_mat4(transform);
    let size = matrix.determinant().cbrt();
    let turn = matrix * size.recip();
    // What is left of a turn is orthonormal, up to float32's digits.
    let off = (turn * turn.transpose() - DMat3::IDENTITY).to_cols_array().into_iter().fold(0f64, |m, v| m.max(v.abs()));
    if !(transform.is_finite() && size > 0.0 && off < 1e-5) {
        return Err(
            "a node stretches or mirrors its Gaussians, which makes others of them; apply its matrix first".into()
        );
    }
    let half_turn = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    cloud.rescale(size);
    cloud.turn(half_turn * turn * half_turn);
    let by = half_turn * transform.w_axis.truncate();
    for position in &mut cloud.position {
        *position = (DVec3::from_array(position.map(f64::from)) + by).to_array().map(|v| v as f32);
    }
    Ok(())
}

/// Reads a file of one splat, of any program, into the cloud's axes.
///
/// # Errors
/// Any other file, or one that is cut off.
pub fn decode(bytes: &[u8]) -> Result<Cloud, String> {
    let file = File::parse(bytes)?;
    let (mesh, primitive) = file.splat()?;
    let colors = &primitive["extensions"][EXTENSION]["colorSpace"];
    if !colors.is_null() && colors != COLORS {
        return Err(format!("its colours are {colors}; {COLORS} is read"));
    }
    let attributes = &primitive["attributes"];
    let floats = |name: &str, components: usize| {
        let at = whole(&attributes[name]).ok_or_else(|| broken(&format!("it has no attribute {name}")))?;
        let numbers = file.numbers(at, components);
        numbers.ok_or_else(|| broken(&format!("its attribute {name} is not within the file, or of another type")))
    };
    let of = |name: &str, components: usize| floats(&format!("{EXTENSION}:{name}"), components);
    let has = |degree: &u32| !attributes[format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_0")].is_null();
    let degree = (1..4).take_while(has).count() as u32;
    let each = coefficients(degree);
    let position = floats("POSITION", 3)?;
    let n = position.len() / 3;
    let mut harmonics = vec![[0f32; 3]; n * each];
    let mut k = 0;
    for l in 0..=degree as usize {
        for m in 0..2 * l + 1 {
            let values = of(&format!("SH_DEGREE_{l}_COEF_{m}"), 3)?;
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
    let scale = of("SCALE", 3)?;
    let mut cloud = Cloud {
        position: position.as_chunks().0.iter().map(|[x, y, z]| [*x, -y, -z]).collect(),
        log_scale: scale.as_chunks().0.iter().map(|s: &[f32; 3]| s.map(|v| f64::from(v).ln() as f32)).collect(),
        rotation: of("ROTATION", 4)?.as_chunks().0.iter().map(turned).collect(),
        logit: of("OPACITY", 1)?.iter().map(|o| logit(f64::from(*o))).collect(),
        degree,
        harmonics,
        antialiased: false,
    };
    if [cloud.log_scale.len(), cloud.rotation.len(), cloud.logit.len()] != [n; 3] {
        return Err(broken("its attributes are not of the same number of Gaussians"));
    }
    place(&mut cloud, file.transform(mesh)?)?;
    Ok(cloud)
}
