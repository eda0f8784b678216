//! The model on disk: `point_cloud.ply` for the anchors and `weights.safetensors` for the networks.
//!
//! `point_cloud.ply` has the attribute names of Scaffold-GS files, one float32 vertex per anchor, binary little endian:
//! `x y z nx ny nz f_offset_0.. f_anchor_feat_0..31 opacity scale_0..5 rot_0..3`.
//! - `f_offset_{c K + k}` is component c of offset k: such files hold the (K, 3) offsets transposed to (3, K).
//! - `scale_*` are the six log-scales (natural logarithm of scene units): three for the offsets, three for the Gaussians.
//! - `nx ny nz` are zero; `opacity` and `rot_*` are an anchor's own, which nothing reads: logit(0.1) and (1, 0, 0, 0).
//! - Arrays that Scaffold-GS does not have follow as `NAME_0..`; in a file without them all their elements are the initial
//!   value.
//!
//! `weights.safetensors` has float32 tensors under PyTorch's names, weights as (outputs, inputs):
//! `mlp_{opacity,cov,color}.{0,2}.{weight,bias}` and, if attention was trained,
//! `{to_qk,context_to_qk,to_v,context_to_v}.weight` and `{to_out,context_to_out}.{weight,bias}`.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufRead, BufReader, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use crate::atomic::AtomicWriteFile;
use crate::sentence::one_line;
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{
    ElementDef, Encoding, Header, Property, PropertyAccess, PropertyAccessResult, PropertyDef, PropertyType, ScalarType,
};
use ply_rs_bw::writer::Writer;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};

use super::arrays::{ARRAYS, Array};
pub use super::arrays::{Anchors, FEATURES};

/// Inputs of a decoder: feature, unit view direction, distance.
pub const DECODER_INPUTS: usize = FEATURES + 4;
/// Hidden width of a decoder.
pub const DECODER_HIDDEN: usize = 32;
/// Width of the attention's projections: 8 heads of 64.
pub const ATTENTION_WIDTH: usize = 512;
/// The anchors' file within a model's folder.
pub const POINT_CLOUD: &str = "point_cloud.ply";
/// The networks' file within a model's folder.
pub const WEIGHTS: &str = "weights.safetensors";

/// logit(0.1), the opacity that such files carry for an anchor itself.
const PLACEHOLDER_OPACITY: f32 = -2.197_224_6;

/// A float32 tensor, row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    /// Its extents, outermost first.
    pub shape: Vec<usize>,
    /// Its values, as many as the product of the extents.
    pub data: Vec<f32>,
}

/// The networks, by PyTorch's names.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Weights {
    /// Name to tensor.
    pub tensors: BTreeMap<String, Tensor>,
}

impl Weights {
    /// Whether the attention's projections are there.
    pub fn has_attention(&self) -> bool {
        self.tensors.contains_key("to_qk.weight")
    }

    /// The three decoders as the device keeps them: opacity, color, cov, each tensor behind the other.
    ///
    /// # Panics
    /// When a tensor is missing: [`load`] and `init::weights` leave none out.
    pub fn decoders(&self) -> Vec<f32> {
        self.flat(decoder_order().iter().map(String::as_str))
    }

    /// The attention's projections as the device keeps them.
    ///
    /// # Panics
    /// Without attention: see [`Weights::has_attention`].
    pub fn attention(&self) -> Vec<f32> {
        self.flat(ATTENTION_ORDER)
    }

    fn flat<'a>(&self, names: impl IntoIterator<Item = &'a str>) -> Vec<f32> {
        names.into_iter().flat_map(|name| self.tensors[name].data.iter().copied()).collect()
    }

    /// From the arrays of the device.
    ///
    /// # Panics
    /// When a length does not fit K = `offsets_per_anchor`.
    pub fn from_device(offsets_per_anchor: usize, decoders: &[f32], attention: Option<&[f32]>) -> Self {
        let shapes: BTreeMap<String, Vec<usize>> =
            weight_shapes(offsets_per_anchor, attention.is_some()).into_iter().collect();
        let mut tensors = BTreeMap::new();
        let mut take = |names: Vec<String>, mut from: &[f32]| {
            for name in names {
                let shape = shapes[&name].clone();
                let (data, rest) = from.split_at(shape.iter().product());
                from = rest;
                tensors.insert(name, Tensor { shape, data: data.to_vec() });
            }
            assert!(from.is_empty(), "{} weights too many", from.len());
        };
        take(decoder_order(), decoders);
        if let Some(attention) = attention {
            take(ATTENTION_ORDER.map(str::to_owned).to_vec(), attention);
        }
        Self { tensors }
    }
}

/// The decoders' tensors as they lie one behind the other on the device.
fn decoder_order() -> Vec<String> {
    let tensors = ["0.weight", "0.bias", "2.weight", "2.bias"];
    ["opacity", "color", "cov"].iter().flat_map(|head| tensors.map(|t| format!("mlp_{head}.{t}"))).collect()
}

/// The attention's tensors as they lie one behind the other on the device.
const ATTENTION_ORDER: [&str; 8] = [
    "to_qk.weight",
    "context_to_qk.weight",
    "to_v.weight",
    "context_to_v.weight",
    "to_out.weight",
    "to_out.bias",
    "context_to_out.weight",
    "context_to_out.bias",
];

/// Names and shapes of all tensors for K Gaussians per anchor: the decoders, then the attention if asked for.
pub fn weight_shapes(offsets_per_anchor: usize, attention: bool) -> Vec<(String, Vec<usize>)> {
    let mut shapes = Vec::new();
    for (head, outputs) in [("opacity", 1), ("cov", 7), ("color", 3)] {
        let outputs = outputs * offsets_per_anchor;
        shapes.push((format!("mlp_{head}.0.weight"), vec![DECODER_HIDDEN, DECODER_INPUTS]));
        shapes.push((format!("mlp_{head}.0.bias"), vec![DECODER_HIDDEN]));
        shapes.push((format!("mlp_{head}.2.weight"), vec![outputs, DECODER_HIDDEN]));
        shapes.push((format!("mlp_{head}.2.bias"), vec![outputs]));
    }
    if attention {
        for name in ["to_qk", "context_to_qk", "to_v", "context_to_v"] {
            shapes.push((format!("{name}.weight"), vec![ATTENTION_WIDTH, FEATURES]));
        }
        for name in ["to_out", "context_to_out"] {
            shapes.push((format!("{name}.weight"), vec![FEATURES, ATTENTION_WIDTH]));
            shapes.push((format!("{name}.bias"), vec![FEATURES]));
        }
    }
    shapes
}

/// Counts the model's lengths in units of which `unit` make one of those they are counted in now, and leaves what it
/// shows as it is: positions and scales are multiplied, and what the decoders make of a distance is divided. Offsets are
/// in units of the scales.
pub fn rescale(anchors: &mut Anchors, weights: &mut Weights, unit: f64) {
    if unit == 1.0 {
        return;
    }
    let scaled = |x: f32| (f64::from(x) * unit) as f32;
    anchors.position.iter_mut().for_each(|p| *p = p.map(scaled));
    let log = unit.ln();
    anchors.log_scaling.iter_mut().flatten().for_each(|s| *s = (f64::from(*s) + log) as f32);
    for head in ["opacity", "cov", "color"] {
        let Some(first) = weights.tensors.get_mut(&format!("mlp_{head}.0.weight")) else { continue };
        for row in first.data.chunks_exact_mut(DECODER_INPUTS) {
            if let Some(distance) = row.last_mut() {
                *distance = (f64::from(*distance) / unit) as f32;
            }
        }
    }
}

/// Why a model cannot be saved or loaded.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file or folder that cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file that is not what its name says, or is cut off.
    #[error("{}: {}", path.display(), one_line(reason))]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong and, where there is something to do, what.
        reason: String,
    },
    /// A PLY file without an attribute that a model needs.
    #[error("{}: no vertex attribute `{attribute}`; it is not a point cloud of Scaffold-GS anchors", path.display())]
    MissingAttribute {
        /// The file.
        path: PathBuf,
        /// The attribute.
        attribute: String,
    },
    /// An attribute that is NaN or infinite.
    #[error("{}: attribute `{attribute}` of vertex {vertex} is {value}, not a finite number", path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The attribute.
        attribute: String,
        /// The vertex, counted from 0.
        vertex: usize,
        /// Its value.
        value: f32,
    },
    /// A model in memory whose parts do not fit each other.
    #[error("the model cannot be saved: {0}")]
    Inconsistent(String),
}

/// Writes both files into `folder`, creating it. Each file replaces its predecessor only when both are complete, so that
/// a crash while writing leaves the old model.
///
/// # Errors
/// A folder that cannot be written, or a model whose parts do not fit each other.
pub fn save(folder: &Path, anchors: &Anchors, weights: &Weights) -> Result<(), Error> {
    check(anchors, weights)?;
    std::fs::create_dir_all(folder).map_err(|source| Error::Io { path: folder.to_owned(), source })?;
    let (cloud, networks) = (folder.join(POINT_CLOUD), folder.join(WEIGHTS));
    let cloud_file = write_temporary(&cloud, |out| write_anchors(out, anchors))?;
    let networks_file = write_temporary(&networks, |out| write_weights(out, weights))?;
    cloud_file.commit().map_err(|source| Error::Io { path: cloud, source })?;
    networks_file.commit().map_err(|source| Error::Io { path: networks, source })
}

/// Reads what [`save`] wrote, or another program's files of the same layout: attributes in any order, of any scalar type
/// and in any PLY encoding; attributes that a model does not need are ignored.
///
/// # Errors
/// A missing or foreign file, a missing attribute or tensor, a wrong count or shape, a value that is not finite.
pub fn load(folder: &Path) -> Result<(Anchors, Weights), Error> {
    let anchors = load_anchors(&folder.join(POINT_CLOUD))?;
    let weights = load_weights(&folder.join(WEIGHTS), anchors.offsets_per_anchor)?;
    Ok((anchors, weights))
}

fn check(anchors: &Anchors, weights: &Weights) -> Result<(), Error> {
    let n = anchors.position.len();
    let k = anchors.offsets_per_anchor;
    if k == 0 {
        return Err(Error::Inconsistent("no offsets per anchor".to_owned()));
    }
    for array in &ARRAYS {
        let (len, wanted) = ((array.get)(anchors).len(), n * anchors.width(array));
        if len != wanted {
            let name = array.names.value;
            return Err(Error::Inconsistent(format!("{len} values of `{name}` instead of {wanted} for {n} positions")));
        }
    }
    let expected: BTreeMap<_, _> = weight_shapes(k, weights.has_attention()).into_iter().collect();
    for (name, shape) in &expected {
        match weights.tensors.get(name) {
            None => return Err(Error::Inconsistent(format!("tensor `{name}` is missing"))),
            Some(tensor) if tensor.shape != *shape || tensor.data.len() != shape.iter().product::<usize>() => {
                return Err(Error::Inconsistent(format!(
                    "tensor `{name}` has shape {:?} and {} values instead of {shape:?}",
                    tensor.shape,
                    tensor.data.len()
                )));
            }
            Some(_) => {}
        }
    }
    match weights.tensors.keys().find(|name| !expected.contains_key(*name)) {
        Some(name) => Err(Error::Inconsistent(format!("tensor `{name}` belongs to no network"))),
        None => Ok(()),
    }
}

pub(super) fn write_temporary(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&mut AtomicWriteFile>) -> io::Result<()>,
) -> Result<AtomicWriteFile, Error> {
    let failed = |source| Error::Io { path: path.to_owned(), source };
    let mut file = AtomicWriteFile::open(path).map_err(failed)?;
    let mut out = BufWriter::with_capacity(1 << 20, &mut file);
    write(&mut out).and_then(|()| out.flush()).map_err(failed)?;
    drop(out);
    // On the disk already, so that two such files are renamed in one instant, with no wait between them.
    file.sync_all().map_err(failed)?;
    Ok(file)
}

// ---------------------------------------------------------------- point_cloud.ply

/// The attributes of an array, in the order of the file.
fn columns(array: &Array, offsets_per_anchor: usize) -> impl Iterator<Item = String> + use<> {
    let stem = array.stem;
    (0..(array.width)(offsets_per_anchor as u32)).map(move |column| format!("{stem}_{column}"))
}

/// The attributes of a vertex, in the order of the file.
fn attributes(offsets_per_anchor: usize) -> Vec<String> {
    let of = |array: &Array| columns(array, offsets_per_anchor);
    let [feature, offset, log_scaling, others @ ..] = &ARRAYS;
    ["x", "y", "z", "nx", "ny", "nz"]
        .map(str::to_owned)
        .into_iter()
        .chain(of(offset))
        .chain(of(feature))
        .chain(["opacity".to_owned()])
        .chain(of(log_scaling))
        .chain((0..4).map(|i| format!("rot_{i}")))
        .chain(others.iter().flat_map(of))
        .collect()
}

/// The scalar values of a vertex in the order of the header's properties. The library asks for and hands over properties
/// in that order, so that no name is looked up per value; a list property counts as one NaN.
#[derive(Default)]
struct Row {
    values: Vec<f32>,
    next: Cell<usize>,
}

impl PropertyAccess for Row {
    fn new() -> Self {
        Self { values: Vec::with_capacity(96), next: Cell::new(0) }
    }

    fn set_property(&mut self, _name: &str, property: Property) -> PropertyAccessResult {
        self.values.push(property.to_f32_lossy().unwrap_or(f32::NAN));
        PropertyAccessResult::Set
    }

    fn set_float(&mut self, _name: &str, value: f32) -> PropertyAccessResult {
        self.values.push(value);
        PropertyAccessResult::Set
    }

    fn get_float(&self, _name: &str) -> Option<f32> {
        let next = self.next.get();
        self.next.set(next + 1);
        self.values.get(next).copied()
    }
}

fn write_anchors(out: &mut impl Write, anchors: &Anchors) -> io::Result<()> {
    let k = anchors.offsets_per_anchor;
    let mut vertex = ElementDef::new("vertex".to_owned());
    vertex.count = anchors.position.len();
    for name in attributes(k) {
        let property = PropertyDef::new(name.clone(), PropertyType::Scalar(ScalarType::Float));
        vertex.properties.insert(name, property);
    }
    let mut header = Header::new();
    header.encoding = Encoding::BinaryLittleEndian;
    header.elements.insert(vertex.name.clone(), vertex.clone());
    let writer = Writer::<Row>::new();
    writer.write_header(out, &header)?;
    let [feature, offset, log_scaling, others @ ..] = &ARRAYS;
    let put = |row: &mut Row, anchor: usize, array: &Array| {
        let width = anchors.width(array);
        let values = &(array.get)(anchors)[anchor * width..][..width];
        row.values.extend((0..width).map(|column| values[(array.element)(k, column)]));
    };
    let mut row = Row::new();
    for anchor in 0..vertex.count {
        row.next.set(0);
        row.values.clear();
        row.values.extend(anchors.position[anchor]);
        row.values.extend([0.0; 3]);
        put(&mut row, anchor, offset);
        put(&mut row, anchor, feature);
        row.values.push(PLACEHOLDER_OPACITY);
        put(&mut row, anchor, log_scaling);
        row.values.extend([1.0, 0.0, 0.0, 0.0]);
        others.iter().for_each(|array| put(&mut row, anchor, array));
        writer.write_little_endian_element(out, &row, &vertex)?;
    }
    Ok(())
}

/// Reads the anchors of a `point_cloud.ply`; see [`load`].
///
/// # Errors
/// As [`load`].
pub fn load_anchors(path: &Path) -> Result<Anchors, Error> {
    let broken = |reason: String| Error::Format { path: path.to_owned(), reason };
    let file = File::open(path).map_err(|source| Error::Io { path: path.to_owned(), source })?;
    let mut reader = Reader::new(BufReader::with_capacity(1 << 20, file));
    let parser = Parser::<Row>::new();
    let header = parser.read_header(&mut reader).map_err(|error| broken(format!("not a PLY file ({error})")))?;
    let mut columns = None;
    for element in header.elements.values() {
        if element.name == "vertex" {
            columns = Some(Columns::find(path, element)?);
        } else if let Some(columns) = columns {
            // Elements after the vertices are of no use.
            return Ok(columns.anchors());
        }
        if element.count > 0 && element.properties.is_empty() {
            let (count, name) = (element.count, &element.name);
            return Err(broken(format!("its header declares {count} {name} without a property; save the model again")));
        }
        for index in 0..element.count {
            let row = read_row(&parser, &mut reader, header.encoding, element).map_err(|error| {
                let (count, name) = (element.count, &element.name);
                broken(format!("cut off or damaged at {name} {index} of {count}, which its header declares ({error})"))
            })?;
            if let Some(columns) = &mut columns {
                columns.append(path, index, &row.values)?;
            }
        }
    }
    let Some(columns) = columns else { return Err(broken("a PLY file without vertices".to_owned())) };
    let mut rest = reader.into_inner();
    let left = rest.fill_buf().map_err(|source| Error::Io { path: path.to_owned(), source })?;
    if header.encoding != Encoding::Ascii && !left.is_empty() {
        return Err(broken("goes on after the last vertex that its header declares".to_owned()));
    }
    Ok(columns.anchors())
}

fn read_row<R: BufRead>(
    parser: &Parser<Row>,
    reader: &mut Reader<R>,
    encoding: Encoding,
    element: &ElementDef,
) -> io::Result<Row> {
    let row = match encoding {
        Encoding::BinaryLittleEndian => parser.read_little_endian_element(reader.get_mut(), element)?,
        Encoding::BinaryBigEndian => parser.read_big_endian_element(reader.get_mut(), element)?,
        Encoding::Ascii => {
            let mut line = String::new();
            if reader.get_mut().read_line(&mut line)? == 0 {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            parser.read_ascii_element(&line, element)?
        }
    };
    Ok(row)
}

/// Where a model's attributes stand in a row of the file, and what was read of them.
struct Columns {
    names: Vec<String>,
    position: [usize; 3],
    offsets_per_anchor: usize,
    /// \[array, element\] in the order of [`ARRAYS`]; empty for one that the file does not have.
    arrays: [Vec<usize>; ARRAYS.len()],
    read: Vec<[f32; 3]>,
    values: [Vec<f32>; ARRAYS.len()],
}

impl Columns {
    fn find(path: &Path, vertex: &ElementDef) -> Result<Self, Error> {
        let names: Vec<String> = vertex.properties.values().map(|property| property.name.clone()).collect();
        let index: BTreeMap<&str, usize> = names.iter().enumerate().map(|(i, name)| (name.as_str(), i)).collect();
        let column = |attribute: String| match index.get(attribute.as_str()) {
            Some(&i) => Ok(i),
            None => Err(Error::MissingAttribute { path: path.to_owned(), attribute }),
        };
        let position = [column("x".into())?, column("y".into())?, column("z".into())?];
        let [feature, offset, _, others @ ..] = &ARRAYS;
        if index.contains_key(format!("{}_{FEATURES}", feature.stem).as_str()) {
            let reason =
                format!("anchors have more than {FEATURES} feature components; this program decodes {FEATURES}");
            return Err(Error::Format { path: path.to_owned(), reason });
        }
        // The highest number says how many there should be, in threes, so that a gap is named.
        let numbers = names.iter().filter_map(|name| name.strip_prefix(offset.stem)?.strip_prefix('_')?.parse().ok());
        let offsets_per_anchor = numbers.max().map_or(1, |last: usize| (last / 3 + 1).min(u32::MAX as usize / 3));
        let mut arrays = [const { Vec::new() }; ARRAYS.len()];
        for (array, found) in ARRAYS.iter().zip(&mut arrays) {
            let of = || columns(array, offsets_per_anchor);
            let own = others.iter().any(|other| other.names == array.names);
            if own && !of().any(|name| index.contains_key(name.as_str())) {
                continue;
            }
            // No more than the file has attributes: the first that is missing ends it.
            let in_file = of().map(&column).collect::<Result<Vec<_>, _>>()?;
            *found = vec![0; in_file.len()];
            for (i, column) in in_file.into_iter().enumerate() {
                found[(array.element)(offsets_per_anchor, i)] = column;
            }
        }
        let values = [const { Vec::new() }; ARRAYS.len()];
        Ok(Self { names, position, offsets_per_anchor, arrays, read: vec![], values })
    }

    fn append(&mut self, path: &Path, vertex: usize, row: &[f32]) -> Result<(), Error> {
        let names = &self.names;
        let value = |column: usize| match row[column] {
            value if value.is_finite() => Ok(value),
            value => {
                let attribute = names[column].clone();
                Err(Error::NotFinite { path: path.to_owned(), attribute, vertex, value })
            }
        };
        let [x, y, z] = self.position;
        self.read.push([value(x)?, value(y)?, value(z)?]);
        for (columns, values) in self.arrays.iter().zip(&mut self.values) {
            for &column in columns {
                values.push(value(column)?);
            }
        }
        Ok(())
    }

    /// The anchors that were read. Arrays that the file does not have begin with their initial value.
    fn anchors(self) -> Anchors {
        let mut anchors =
            Anchors { position: self.read, offsets_per_anchor: self.offsets_per_anchor, ..Anchors::default() };
        for (array, values) in ARRAYS.iter().zip(self.values) {
            (array.set)(&mut anchors, values);
        }
        anchors.completed()
    }
}

// ---------------------------------------------------------------- weights.safetensors

fn write_weights(out: &mut impl Write, weights: &Weights) -> io::Result<()> {
    let bytes: BTreeMap<&str, Vec<u8>> = weights
        .tensors
        .iter()
        .map(|(name, tensor)| (name.as_str(), tensor.data.iter().flat_map(|v| v.to_le_bytes()).collect()))
        .collect();
    let mut views = Vec::with_capacity(bytes.len());
    for (name, tensor) in &weights.tensors {
        let view =
            TensorView::new(Dtype::F32, tensor.shape.clone(), &bytes[name.as_str()]).map_err(io::Error::other)?;
        views.push((name.as_str(), view));
    }
    out.write_all(&safetensors::serialize(views, None).map_err(io::Error::other)?)
}

/// Reads the networks for K Gaussians per anchor; see [`load`].
///
/// # Errors
/// As [`load`].
pub fn load_weights(path: &Path, offsets_per_anchor: usize) -> Result<Weights, Error> {
    let broken = |reason: String| Error::Format { path: path.to_owned(), reason };
    let mut bytes = Vec::new();
    File::open(path)
        .and_then(|mut file| file.read_to_end(&mut bytes))
        .map_err(|source| Error::Io { path: path.to_owned(), source })?;
    let file = SafeTensors::deserialize(&bytes)
        .map_err(|error| broken(format!("not a safetensors file, or cut off ({error})")))?;
    let attention = file.tensor("to_qk.weight").is_ok();
    let mut tensors = BTreeMap::new();
    for (name, shape) in weight_shapes(offsets_per_anchor, attention) {
        let view = file.tensor(&name).map_err(|_| broken(format!("no tensor `{name}`")))?;
        if view.dtype() != Dtype::F32 || view.shape() != shape {
            let (kind, found) = (view.dtype(), view.shape());
            return Err(broken(format!("tensor `{name}` is {kind:?} {found:?}; this model needs F32 {shape:?}")));
        }
        let data: Vec<f32> = view.data().as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        if let Some(index) = data.iter().position(|value| !value.is_finite()) {
            return Err(broken(format!("value {index} of tensor `{name}` is {}, not a finite number", data[index])));
        }
        tensors.insert(name, Tensor { shape, data });
    }
    Ok(Weights { tensors })
}
