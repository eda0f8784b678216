//! PLY files of Gaussians as other programs write them: one row per Gaussian, of which every byte is kept, or SuperSplat's
//! compressed form.
//!
//! A row has `x y z f_dc_0..2 opacity scale_0..2 rot_0..3`, in any order and of any scalar type, `f_rest_*` of degree 1 to 3
//! as in [`crate::formats::ply`], and whatever else its program put there. The compressed form (`packed_*`, as
//! splat-transform documents it by its reader) has the bounds of every 256 Gaussians in the element `chunk`.

use crate::math::harmonics::{ZEROTH, coefficients};
use crate::model::gaussians::{Cloud, logit};

/// Gaussians of a chunk of the compressed form.
const CHUNK: usize = 256;
/// Longest header that is looked for.
const HEADER: usize = 1 << 16;
const END: &[u8] = b"end_header\n";

/// A scalar type of the format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    fn read(self, from: &[u8]) -> f32 {
        let four = || [from[0], from[1], from[2], from[3]];
        match self {
            Self::I8 => f32::from(from[0] as i8),
            Self::U8 => f32::from(from[0]),
            Self::I16 => f32::from(i16::from_le_bytes([from[0], from[1]])),
            Self::U16 => f32::from(u16::from_le_bytes([from[0], from[1]])),
            Self::I32 => i32::from_le_bytes(four()) as f32,
            Self::U32 => u32::from_le_bytes(four()) as f32,
            Self::F32 => f32::from_le_bytes(four()),
            Self::F64 => {
                let mut eight = [0; 8];
                eight.copy_from_slice(&from[..8]);
                f64::from_le_bytes(eight) as f32
            }
        }
    }

    fn write(self, value: f32, to: &mut [u8]) {
        match self {
            Self::F32 => to.copy_from_slice(&value.to_le_bytes()),
            Self::F64 => to.copy_from_slice(&f64::from(value).to_le_bytes()),
            // Whole numbers hold nothing that is learnt.
            _ => to.fill(0),
        }
    }
}

/// A property of an element.
#[derive(Clone, Debug)]
struct Property {
    name: String,
    scalar: Scalar,
    /// First byte within the row.
    at: usize,
}

/// An element of the file: rows of one length.
#[derive(Clone, Debug)]
struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
    /// Bytes of a row.
    stride: usize,
    /// First byte within the file.
    at: usize,
}

impl Element {
    fn find(&self, name: &str) -> Option<&Property> {
        self.properties.iter().find(|property| property.name == name)
    }

    fn need(&self, name: &str) -> Result<&Property, String> {
        self.find(name).ok_or_else(|| format!("its element {} has no property {name}", self.name))
    }

    fn row<'b>(&self, bytes: &'b [u8], i: usize) -> &'b [u8] {
        let first = self.at + i * self.stride;
        &bytes[first..first + self.stride]
    }
}

fn value(row: &[u8], property: &Property) -> f32 {
    property.scalar.read(&row[property.at..])
}

/// The elements of a file, whose rows are all there.
fn elements(bytes: &[u8]) -> Result<Vec<Element>, String> {
    let head = &bytes[..bytes.len().min(HEADER)];
    if !head.starts_with(b"ply") {
        return Err("it does not begin as a PLY file".into());
    }
    let normal = |end: &[u8]| head.windows(end.len()).position(|w| w == end).map(|at| at + end.len());
    let body = normal(END).or_else(|| normal(b"end_header\r\n")).ok_or("its header does not end")?;
    let text = std::str::from_utf8(&head[..body]).map_err(|_| "its header is not text")?;
    let mut elements: Vec<Element> = vec![];
    let mut format = None;
    for line in text.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            ["format", name, _] => format = Some(name),
            ["element", name, count] => {
                let count = count.parse().map_err(|_| format!("its header says `{line}`"))?;
                elements.push(Element { name: name.into(), count, properties: vec![], stride: 0, at: 0 });
            }
            ["property", "list", ..] => return Err(format!("its header says `{line}`, and Gaussians have no lists")),
            ["property", scalar, name] => {
                let scalar = Scalar::named(scalar).ok_or_else(|| format!("its header says `{line}`"))?;
                let element = elements.last_mut().ok_or("its header has a property before any element")?;
                if element.find(name).is_some() {
                    return Err(format!("its element {} has the property {name} twice", element.name));
                }
                element.properties.push(Property { name: name.into(), scalar, at: element.stride });
                element.stride += scalar.bytes();
            }
            _ => {}
        }
    }
    match format {
        Some("binary_little_endian") => {}
        Some(other) => return Err(format!("it is {other}; save it as binary_little_endian")),
        None => return Err("its header names no format".into()),
    }
    let mut at = body;
    for element in &mut elements {
        element.at = at;
        at = element
            .count
            .checked_mul(element.stride)
            .and_then(|length| at.checked_add(length))
            .filter(|end| *end <= bytes.len())
            .ok_or_else(|| {
                format!("it is cut off within the {} rows of {} that its header declares", element.count, element.name)
            })?;
        if element.stride == 0 && element.count > 0 {
            return Err(format!("its header declares {} {} without a property", element.count, element.name));
        }
    }
    Ok(elements)
}

/// Where a row has what is drawn.
#[derive(Clone, Debug)]
struct Columns {
    position: [Property; 3],
    first: [Property; 3],
    /// \[channel, coefficient beyond the first\].
    rest: Vec<Property>,
    opacity: Property,
    scale: [Property; 3],
    rotation: [Property; 4],
    degree: u32,
}

impl Columns {
    fn of(vertex: &Element) -> Result<Self, String> {
        let three = |names: [&str; 3]| -> Result<[Property; 3], String> {
            let [a, b, c] = names.map(|name| vertex.need(name).cloned());
            Ok([a?, b?, c?])
        };
        if vertex.find("scale_1").is_some() && vertex.find("scale_2").is_none() {
            return Err("its Gaussians are flat (no scale_2), as those of 2DGS; this program draws solid ones".into());
        }
        let mut rest = vec![];
        while let Some(property) = vertex.find(&format!("f_rest_{}", rest.len())) {
            rest.push(property.clone());
        }
        let degree = degree_of(rest.len())?;
        let [a, b, c, d] = ["rot_0", "rot_1", "rot_2", "rot_3"].map(|name| vertex.need(name).cloned());
        Ok(Self {
            position: three(["x", "y", "z"])?,
            first: three(["f_dc_0", "f_dc_1", "f_dc_2"])?,
            rest,
            opacity: vertex.need("opacity")?.clone(),
            scale: three(["scale_0", "scale_1", "scale_2"])?,
            rotation: [a?, b?, c?, d?],
            degree,
        })
    }

    fn append(&self, row: &[u8], cloud: &mut Cloud) {
        cloud.position.push(std::array::from_fn(|c| value(row, &self.position[c])));
        cloud.harmonics.push(std::array::from_fn(|c| value(row, &self.first[c])));
        let rest = coefficients(self.degree) - 1;
        for k in 0..rest {
            cloud.harmonics.push(std::array::from_fn(|c| value(row, &self.rest[c * rest + k])));
        }
        cloud.logit.push(value(row, &self.opacity));
        cloud.log_scale.push(std::array::from_fn(|c| value(row, &self.scale[c])));
        cloud.rotation.push(std::array::from_fn(|c| value(row, &self.rotation[c])));
    }

    /// Writes a Gaussian of a cloud of any degree into a row of zeros.
    fn write(&self, cloud: &Cloud, i: usize, row: &mut [u8]) {
        let mut put = |property: &Property, value: f32| {
            let range = property.at..property.at + property.scalar.bytes();
            property.scalar.write(value, &mut row[range]);
        };
        let harmonics = cloud.harmonics_of(i);
        let rest = coefficients(self.degree) - 1;
        for c in 0..3 {
            put(&self.position[c], cloud.position[i][c]);
            put(&self.first[c], harmonics[0][c]);
            put(&self.scale[c], cloud.log_scale[i][c]);
            for k in 0..rest {
                put(&self.rest[c * rest + k], harmonics.get(k + 1).map_or(0.0, |rgb| rgb[c]));
            }
        }
        put(&self.opacity, cloud.logit[i]);
        (0..4).for_each(|c| put(&self.rotation[c], cloud.rotation[i][c]));
    }
}

fn degree_of(rest: usize) -> Result<u32, String> {
    (0..=3)
        .find(|degree| 3 * (coefficients(*degree) - 1) == rest)
        .ok_or_else(|| format!("it has {rest} properties f_rest_*; degrees 0 to 3 have 0, 9, 24 or 45"))
}

/// The rows of a file, byte by byte.
#[derive(Clone, Debug)]
pub struct Rows {
    bytes: Vec<u8>,
    vertex: Element,
    columns: Columns,
}

impl Rows {
    /// The file with the rows of `kept` in their order, each as it was, and those of `added` behind them. Properties that
    /// are no Gaussian's are 0 in those. Everything before and behind the rows stays as it is, but for their number.
    ///
    /// # Panics
    /// Unless there is a flag for every row.
    pub fn spliced(&self, kept: &[bool], added: &Cloud) -> Vec<u8> {
        let Self { bytes, vertex, columns } = self;
        assert_eq!(kept.len(), vertex.count, "a flag for every row");
        let count = kept.iter().filter(|kept| **kept).count() + added.len();
        let end = vertex.at + vertex.count * vertex.stride;
        let mut file = Vec::with_capacity(bytes.len() + added.len() * vertex.stride);
        let head_end = body_of(bytes);
        for line in bytes[..head_end].split_inclusive(|byte| *byte == b'\n') {
            let words: Vec<&[u8]> = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()).collect();
            if words.len() == 3 && words[0] == b"element" && words[1] == b"vertex" {
                let ending: &[u8] = if line.ends_with(b"\r\n") { b"\r\n" } else { b"\n" };
                file.extend_from_slice(format!("element vertex {count}").as_bytes());
                file.extend_from_slice(ending);
            } else {
                file.extend_from_slice(line);
            }
        }
        file.extend_from_slice(&bytes[head_end..vertex.at]);
        let rows = bytes[vertex.at..end].chunks_exact(vertex.stride);
        rows.zip(kept).filter(|(_, kept)| **kept).for_each(|(row, _)| file.extend_from_slice(row));
        for i in 0..added.len() {
            let at = file.len();
            file.resize(at + vertex.stride, 0);
            columns.write(added, i, &mut file[at..]);
        }
        file.extend_from_slice(&bytes[end..]);
        file
    }
}

/// The first byte behind the header of a file that has one.
fn body_of(bytes: &[u8]) -> usize {
    let find = |end: &[u8]| bytes.windows(end.len()).position(|w| w == end).map(|at| at + end.len());
    find(END).or_else(|| find(b"end_header\r\n")).unwrap_or(0)
}

/// Whether the header's comments say that the Gaussians were trained with antialiasing: `SplatRenderMode: mip` of Brush and
/// splat-transform, `antialiased 1` of Postshot. The last one holds.
fn antialiased(bytes: &[u8]) -> bool {
    let text = String::from_utf8_lossy(&bytes[..body_of(&bytes[..bytes.len().min(HEADER)])]).to_lowercase();
    let mut said =
        text.lines().filter_map(
            |line| match line.strip_prefix("comment ")?.split_whitespace().collect::<Vec<_>>()[..] {
                ["splatrendermode:", mode] => Some(mode == "mip"),
                ["antialiased", flag] => Some(flag == "1"),
                _ => None,
            },
        );
    said.next_back().unwrap_or(false)
}

/// The Gaussians of a file of either form, and its rows where they can be kept byte by byte.
///
/// # Errors
/// Files of other things, or that are cut off: what is wrong, in words that follow the file's name.
pub fn read(bytes: Vec<u8>) -> Result<(Cloud, Option<Rows>), String> {
    let elements = elements(&bytes)?;
    let antialiased = antialiased(&bytes);
    let element = |name: &str| elements.iter().find(|element| element.name == name);
    let vertex = element("vertex").ok_or("it has no element vertex")?;
    if vertex.find("packed_position").is_some() {
        let chunks = element("chunk").ok_or("it has packed Gaussians and no element chunk")?;
        return Ok((Cloud { antialiased, ..unpacked(&bytes, chunks, vertex, element("sh"))? }, None));
    }
    if vertex.find("f_dc_0").is_none() && vertex.find("f_anchor_feat_0").is_some() {
        return Err("it holds anchors, which are no splat; `gscream-vk export` makes one of their run".into());
    }
    if vertex.find("f_dc_0").is_none() {
        return Err("it is a point cloud without Gaussians (no f_dc_0)".into());
    }
    let columns = Columns::of(vertex)?;
    let mut cloud = Cloud { degree: columns.degree, antialiased, ..Cloud::default() };
    (0..vertex.count).for_each(|i| columns.append(vertex.row(&bytes, i), &mut cloud));
    let vertex = vertex.clone();
    Ok((cloud, Some(Rows { bytes, vertex, columns })))
}

/// Parts of `bits` bits of a word, counted from 0 to 1, the first highest.
fn parts<const N: usize>(word: u32, bits: [u32; N]) -> [f64; N] {
    let mut left = bits.iter().sum::<u32>();
    bits.map(|bits| {
        left -= bits;
        let most = (1u32 << bits) - 1;
        f64::from((word >> left) & most) / f64::from(most)
    })
}

fn unpacked(bytes: &[u8], chunks: &Element, vertex: &Element, sh: Option<&Element>) -> Result<Cloud, String> {
    if chunks.count < vertex.count.div_ceil(CHUNK) {
        return Err(format!("its {} chunks are too few for {} Gaussians", chunks.count, vertex.count));
    }
    let bounds = |stem: &str, axes: [&str; 3]| -> Result<[[Property; 2]; 3], String> {
        let [a, b, c] = axes.map(|axis| -> Result<[Property; 2], String> {
            let of = |end: &str| chunks.need(&format!("{end}_{stem}{axis}")).cloned();
            Ok([of("min")?, of("max")?])
        });
        Ok([a?, b?, c?])
    };
    let axes = ["x", "y", "z"];
    let (places, scales) = (bounds("", axes)?, bounds("scale_", axes)?);
    // Older files have colours from 0 to 1.
    let colors = chunks.find("min_r").map(|_| bounds("", ["r", "g", "b"])).transpose()?;
    let word = |name: &str| match vertex.need(name)? {
        property if property.scalar == Scalar::U32 => Ok(property.at),
        _ => Err(format!("its property {name} is no 32-bit word")),
    };
    let [place, turn, size, color] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"].map(word);
    let (place, turn, size, color) = (place?, turn?, size?, color?);
    let mut rest: Vec<&Property> = vec![];
    if let Some(sh) = sh.filter(|sh| sh.count == vertex.count) {
        while let Some(property) = sh.find(&format!("f_rest_{}", rest.len())) {
            rest.push(property);
        }
    }
    let degree = degree_of(rest.len())?;
    let each = coefficients(degree) - 1;
    let mut cloud = Cloud { degree, ..Cloud::default() };
    for i in 0..vertex.count {
        let (row, chunk) = (vertex.row(bytes, i), chunks.row(bytes, i / CHUNK));
        let word = |at: usize| u32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]]);
        let within = |[low, high]: &[Property; 2], part: f64| {
            let [low, high] = [low, high].map(|property| f64::from(value(chunk, property)));
            (low * (1.0 - part) + high * part) as f32
        };
        let three = |at: usize, bounds: &[[Property; 2]; 3]| -> [f32; 3] {
            let parts = parts(word(at), [11, 10, 11]);
            std::array::from_fn(|c| within(&bounds[c], parts[c]))
        };
        cloud.position.push(three(place, &places));
        cloud.log_scale.push(three(size, &scales));
        cloud.rotation.push(unpack_rotation(word(turn)));
        let [r, g, b, alpha] = parts(word(color), [8; 4]);
        let rgb = [r, g, b];
        cloud.harmonics.push(std::array::from_fn(|c| {
            let shown = colors.as_ref().map_or(rgb[c], |bounds| f64::from(within(&bounds[c], rgb[c])));
            ((shown - 0.5) / ZEROTH) as f32
        }));
        for k in 0..each {
            let sh = sh.expect("its properties were counted").row(bytes, i);
            // A byte spreads from -4 to 4.
            cloud.harmonics.push(std::array::from_fn(|c| value(sh, rest[c * each + k]) * (8.0 / 255.0) - 4.0));
        }
        cloud.logit.push(logit(alpha));
    }
    Ok(cloud)
}

/// A unit quaternion w x y z: two bits name the largest component, ten bits each hold the others, times the root of two,
/// from -1 to 1.
fn unpack_rotation(word: u32) -> [f32; 4] {
    let others = parts(word & 0x3fff_ffff, [10; 3]).map(|part| (part - 0.5) * std::f64::consts::SQRT_2);
    let largest = (1.0 - others.iter().map(|v| v * v).sum::<f64>()).max(0.0).sqrt();
    let mut q = others.into_iter();
    std::array::from_fn(|i| if i == (word >> 30) as usize { largest } else { q.next().unwrap_or(0.0) } as f32)
}
