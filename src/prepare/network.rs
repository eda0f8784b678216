//! Networks that the user names, as ONNX files: inpainting in place of pieces of the surroundings, depth in place of the fit's own.
//!
//! | | inpainting (LaMa's exports) | depth (Depth Anything, DPT, MiDaS, ZoeDepth) |
//! | --- | --- | --- |
//! | inputs | the picture, `[1, 3, H, W]` float32, RGB from 0 to 1; the hole, `[1, 1, H, W]` float32, 1 in it | the picture, `[1, 3, H, W]` float32, RGB less (0.485, 0.456, 0.406) over (0.229, 0.224, 0.225) |
//! | H and W | the file's; where it leaves them open 512 x 512 | the file's; where it leaves them open the shorter side 518, both multiples of 14 |
//! | output | `[1, 3, H, W]` float32, RGB from 0 to 1, or to 255 if anything in it is larger than 2 | `[1, H, W]` or `[1, 1, H, W]` float32 |
//! | what it means | what lies in the hole is taken, the rest stays | disparity or depth, whichever follows the sparse points |
//!
//! They are run by tract, where the program was built with it (`--features onnx`).

use std::path::Path;

use image::{GrayImage, RgbImage, imageops};

use super::Error;

/// Side of an inpainting network's input that leaves it open.
const INPAINT: usize = 512;
/// Shorter side of a depth network's input that leaves it open, and what both are multiples of.
const DEPTH: [usize; 2] = [518, 14];
/// Around the hole this many times its larger side is shown to an inpainting network.
const AROUND: f64 = 2.0;
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];

/// An input or output: its name and its sides, none where the file leaves one open.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Port {
    name: String,
    sides: Vec<Option<usize>>,
}

impl std::fmt::Display for Port {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let side = |side: &Option<usize>| side.map_or_else(|| "?".into(), |n| n.to_string());
        let sides: Vec<String> = self.sides.iter().map(side).collect();
        write!(f, "{} [{}]", self.name, sides.join(", "))
    }
}

impl Port {
    /// Whether it can be one picture of so many channels.
    fn holds(&self, channels: usize) -> bool {
        matches!(*self.sides, [batch, c, _, _] if batch.is_none_or(|n| n == 1) && c.is_none_or(|n| n == channels))
    }

    /// Its height and width, where they are fixed.
    fn size(&self) -> Option<[usize; 2]> {
        let &[_, _, h, w] = self.sides.as_slice() else { return None };
        Some([h?, w?])
    }
}

fn refuse(path: &Path, what: String) -> Error {
    Error::File { path: path.to_owned(), what }
}

/// Names of ports for a sentence.
fn listed(ports: &[Port]) -> String {
    let names: Vec<String> = ports.iter().map(Port::to_string).collect();
    if names.is_empty() { "nothing".into() } else { names.join(" and ") }
}

/// Planes of a picture as a network takes them: channel by channel.
fn planes(picture: &RgbImage, value: impl Fn(usize, f32) -> f32) -> Vec<f32> {
    (0..3)
        .flat_map(|c| picture.pixels().map(move |p| (c, p.0[c])))
        .map(|(c, v)| value(c, f32::from(v) / 255.0))
        .collect()
}

/// An inpainting network.
#[derive(Debug)]
pub struct Inpainting {
    network: backend::Network,
    /// Places of picture and hole among the inputs.
    order: [usize; 2],
    size: [usize; 2],
}

impl Inpainting {
    /// Reads the file.
    ///
    /// # Errors
    /// A file that is damaged or no such network; a program that was built without ONNX.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let file = backend::File::open(path)?;
        let inputs = file.inputs();
        let find = |channels: usize| {
            let fixed = |port: &Port| port.holds(channels) && port.sides[1].is_some();
            inputs.iter().position(fixed).or_else(|| inputs.iter().position(|port| port.holds(channels)))
        };
        let outputs = file.outputs();
        let known = match (find(3), find(1)) {
            (Some(picture), Some(hole)) if inputs.len() == 2 && picture != hole => Some([picture, hole]),
            _ => None,
        };
        let (Some(order), true) = (known, outputs.first().is_some_and(|port| port.holds(3) || port.sides.is_empty()))
        else {
            return Err(refuse(
                path,
                format!(
                    "not an inpainting network like LaMa: a picture [1, 3, H, W] and a hole [1, 1, H, W] are expected as inputs \
                     and a picture [1, 3, H, W] as output; its inputs are {}, its outputs {}",
                    listed(inputs),
                    listed(outputs)
                ),
            ));
        };
        let size = inputs[order[0]].size().or_else(|| inputs[order[1]].size()).unwrap_or([INPAINT; 2]);
        let [h, w] = size;
        let mut shapes = [[1, 3, h, w]; 2];
        shapes[order[1]] = [1, 1, h, w];
        Ok(Self { network: file.compile(&shapes)?, order, size })
    }

    /// Fills the pixels of `hole`; the others stay. `rgb` is row-major, 0 to 1, `size` its width and height.
    ///
    /// # Errors
    /// A network that gives something else than a picture.
    pub fn fill(&self, rgb: &mut [[f32; 3]], hole: &[bool], size: [usize; 2]) -> Result<(), Error> {
        let Some(window) = window(hole, size) else { return Ok(()) };
        let [x0, y0, side_x, side_y] = window;
        let at = |x: usize, y: usize| (y0 + y) * size[0] + x0 + x;
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let picture = RgbImage::from_fn(side_x as u32, side_y as u32, |x, y| {
            image::Rgb(rgb[at(x as usize, y as usize)].map(byte))
        });
        let inside = GrayImage::from_fn(side_x as u32, side_y as u32, |x, y| {
            image::Luma([if hole[at(x as usize, y as usize)] { 255 } else { 0 }])
        });
        let [h, w] = self.size;
        let (w32, h32) = (w as u32, h as u32);
        let small = imageops::resize(&picture, w32, h32, imageops::FilterType::CatmullRom);
        // Whatever has a part of the hole in it is of the hole.
        let soft = imageops::resize(&inside, w32, h32, imageops::FilterType::Triangle);
        let mask: Vec<f32> = soft.pixels().map(|p| f32::from(u8::from(p.0[0] > 0))).collect();
        let pixels = w * h;
        let mut shown = planes(&small, |_, v| v);
        for (i, value) in shown.iter_mut().enumerate() {
            *value *= 1.0 - mask[i % pixels];
        }
        let mut inputs = vec![vec![], vec![]];
        inputs[self.order[0]] = shown;
        inputs[self.order[1]] = mask;
        let (shape, values) = self.network.run(inputs)?;
        if values.len() != 3 * pixels || values.iter().any(|v| !v.is_finite()) {
            return Err(refuse(
                self.network.path(),
                format!(
                    "the network gave {shape:?} numbers, or some that are not finite, in place of a picture of {w} x {h}"
                ),
            ));
        }
        let scale = if values.iter().any(|v| *v > 2.0) { 1.0 / 255.0 } else { 1.0 };
        let color = |i: usize| image::Rgb([0, 1, 2].map(|c| values[c * pixels + i] * scale));
        let made = image::Rgb32FImage::from_fn(w32, h32, |x, y| color((y * w32 + x) as usize));
        let large = imageops::resize(&made, side_x as u32, side_y as u32, imageops::FilterType::CatmullRom);
        for (x, y, pixel) in large.enumerate_pixels() {
            let i = at(x as usize, y as usize);
            if hole[i] {
                rgb[i] = pixel.0.map(|v| v.clamp(0.0, 1.0));
            }
        }
        Ok(())
    }
}

/// The part of a picture that is shown for a hole: x, y, width, height. None without a hole.
fn window(hole: &[bool], [w, h]: [usize; 2]) -> Option<[usize; 4]> {
    let on = || hole.iter().enumerate().filter(|(_, on)| **on).map(|(i, _)| [i % w, i / w]);
    let low: [usize; 2] = [on().map(|p| p[0]).min()?, on().map(|p| p[1]).min()?];
    let high: [usize; 2] = [on().map(|p| p[0]).max()?, on().map(|p| p[1]).max()?];
    let larger = (0..2).map(|i| high[i] - low[i] + 1).max()?;
    // A square about its middle, as far as the picture goes.
    let side = ((larger as f64 * AROUND).ceil() as usize).max(64);
    let part = |i: usize, all: usize| {
        let side = side.min(all);
        let start = (low[i] + high[i]).div_ceil(2).saturating_sub(side / 2).min(all - side);
        [start, side]
    };
    let ([x, side_x], [y, side_y]) = (part(0, w), part(1, h));
    Some([x, y, side_x, side_y])
}

/// A network that tells depth or disparity.
#[derive(Debug)]
pub struct Depth {
    file: backend::File,
    /// Its input's height and width, where they are fixed.
    size: Option<[usize; 2]>,
    /// What it was compiled for last: photographs are mostly of one size.
    compiled: std::cell::RefCell<Option<([usize; 2], backend::Network)>>,
}

impl Depth {
    /// Reads the file.
    ///
    /// # Errors
    /// As [`Inpainting::open`].
    pub fn open(path: &Path) -> Result<Self, Error> {
        let file = backend::File::open(path)?;
        let map = |port: &Port| match port.sides[..] {
            [] => true,
            [batch, _, _] => batch.is_none_or(|n| n == 1),
            [_, _, _, _] => port.holds(1),
            _ => false,
        };
        let (inputs, outputs) = (file.inputs(), file.outputs());
        if inputs.len() != 1 || !inputs[0].holds(3) || !outputs.first().is_some_and(map) {
            return Err(refuse(
                path,
                format!(
                    "not a depth network like Depth Anything: a picture [1, 3, H, W] is expected as input and a map [1, H, W] as \
                     output; its inputs are {}, its outputs {}",
                    listed(inputs),
                    listed(outputs)
                ),
            ));
        }
        let size = inputs[0].size();
        Ok(Self { file, size, compiled: None.into() })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// The map of a picture: its values row by row, and its width and height.
    ///
    /// # Errors
    /// A network that gives something else than a map.
    pub fn of(&self, picture: &RgbImage) -> Result<(Vec<f32>, [u32; 2]), Error> {
        let [h, w] = self.size.unwrap_or_else(|| {
            let [shorter, multiple] = DEPTH;
            let (w, h) = (f64::from(picture.width()), f64::from(picture.height()));
            let scale = shorter as f64 / w.min(h);
            [h, w].map(|side| ((side * scale / multiple as f64).round() as usize).max(1) * multiple)
        });
        let mut compiled = self.compiled.borrow_mut();
        if compiled.as_ref().is_none_or(|(size, _)| *size != [h, w]) {
            *compiled = Some(([h, w], self.file.compile(&[[1, 3, h, w]])?));
        }
        let (_, network) = compiled.as_ref().expect("it was just compiled");
        let resized = imageops::resize(picture, w as u32, h as u32, imageops::FilterType::CatmullRom);
        let input = planes(&resized, |c, v| (v - MEAN[c]) / DEVIATION[c]);
        let (shape, values) = network.run(vec![input])?;
        let sides: Vec<usize> = shape.iter().copied().filter(|n| *n != 1).collect();
        let &[rows, columns] = sides.as_slice() else {
            return Err(refuse(self.path(), format!("the network gave {shape:?} numbers in place of a map")));
        };
        if values.iter().any(|v| v.is_infinite()) {
            return Err(refuse(self.path(), "the network gave values that are not finite".into()));
        }
        Ok((values, [columns as u32, rows as u32]))
    }
}

#[cfg(feature = "onnx")]
mod backend {
    use std::path::PathBuf;
    use std::sync::Arc;

    use tract_onnx::pb;
    use tract_onnx::prelude::*;

    use super::*;

    /// What went wrong, the outermost first, in one line.
    fn causes(error: &TractError) -> String {
        let causes: Vec<String> = error.chain().map(|cause| cause.to_string().replace('\n', " ")).collect();
        causes.join(": ")
    }

    /// A file that was read.
    pub struct File {
        path: PathBuf,
        proto: pb::ModelProto,
        inputs: Vec<Port>,
        outputs: Vec<Port>,
    }

    impl std::fmt::Debug for File {
        fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            write!(f, "{}", self.path.display())
        }
    }

    fn port(info: &pb::ValueInfoProto) -> Port {
        use pb::tensor_shape_proto::dimension::Value;
        let tensor = info.r#type.as_ref().and_then(|t| t.value.as_ref()).map(|pb::type_proto::Value::TensorType(t)| t);
        let shape = tensor.and_then(|tensor| tensor.shape.as_ref());
        let side = |dim: &pb::tensor_shape_proto::Dimension| match dim.value {
            Some(Value::DimValue(n)) => usize::try_from(n).ok().filter(|n| *n > 0),
            _ => None,
        };
        let sides = shape.map(|shape| shape.dim.iter().map(side).collect()).unwrap_or_default();
        Port { name: info.name.clone(), sides }
    }

    impl File {
        pub fn open(path: &Path) -> Result<Self, Error> {
            let bytes = std::fs::read(path).map_err(|source| Error::Io { path: path.to_owned(), source })?;
            let damaged = || refuse(path, "no whole ONNX file: it is cut off, damaged, or of another kind".into());
            let proto = onnx().proto_model_for_read(&mut bytes.as_slice()).map_err(|_| damaged())?;
            let graph = proto.graph.as_ref().filter(|graph| !graph.node.is_empty()).ok_or_else(damaged)?;
            // Older exports list the weights among the inputs.
            let weight = |name: &str| graph.initializer.iter().any(|tensor| tensor.name == name);
            let inputs = graph.input.iter().filter(|info| !weight(&info.name)).map(port).collect();
            let outputs = graph.output.iter().map(port).collect();
            Ok(Self { path: path.to_owned(), inputs, outputs, proto })
        }

        pub fn path(&self) -> &Path {
            &self.path
        }

        pub fn inputs(&self) -> &[Port] {
            &self.inputs
        }

        pub fn outputs(&self) -> &[Port] {
            &self.outputs
        }

        /// Makes it ready for inputs of these shapes.
        pub fn compile(&self, shapes: &[[usize; 4]]) -> Result<Network, Error> {
            let make = || -> TractResult<Arc<TypedRunnableModel>> {
                let onnx = onnx().with_ignore_output_shapes(true);
                let mut model = onnx.model_for_proto_model(&self.proto)?;
                for (i, shape) in shapes.iter().enumerate() {
                    model.set_input_fact(i, f32::fact(shape).into())?;
                }
                model.into_optimized()?.into_runnable()
            };
            let runnable = make().map_err(|error| {
                refuse(
                    &self.path,
                    format!("a network that cannot be run with inputs of {shapes:?}: {}", causes(&error)),
                )
            })?;
            Ok(Network { path: self.path.clone(), shapes: shapes.to_vec(), runnable })
        }
    }

    /// A network for inputs of certain shapes.
    pub struct Network {
        path: PathBuf,
        shapes: Vec<[usize; 4]>,
        runnable: Arc<TypedRunnableModel>,
    }

    impl std::fmt::Debug for Network {
        fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            write!(f, "{} for {:?}", self.path.display(), self.shapes)
        }
    }

    impl Network {
        pub fn path(&self) -> &Path {
            &self.path
        }

        /// The first output's shape and values.
        pub fn run(&self, inputs: Vec<Vec<f32>>) -> Result<(Vec<usize>, Vec<f32>), Error> {
            let run = || -> TractResult<(Vec<usize>, Vec<f32>)> {
                let tensors = self
                    .shapes
                    .iter()
                    .zip(&inputs)
                    .map(|(shape, values)| Tensor::from_shape(shape, values).map(IntoTValue::into_tvalue));
                let outputs = self.runnable.run(tensors.collect::<TractResult<_>>()?)?;
                let first = outputs[0].cast_to::<f32>()?;
                let values = first.to_plain_array_view::<f32>()?.iter().copied().collect();
                Ok((first.shape().to_vec(), values))
            };
            run().map_err(|error| refuse(&self.path, format!("the network could not be run: {}", causes(&error))))
        }
    }
}

#[cfg(not(feature = "onnx"))]
mod backend {
    use super::*;

    /// Never made.
    #[derive(Debug)]
    pub enum File {}

    impl File {
        pub fn open(path: &Path) -> Result<Self, Error> {
            let what =
                "this program was built without networks; `cargo install --features onnx` builds one that runs them";
            Err(refuse(path, what.into()))
        }

        pub fn path(&self) -> &Path {
            match *self {}
        }

        pub fn inputs(&self) -> &[Port] {
            match *self {}
        }

        pub fn outputs(&self) -> &[Port] {
            match *self {}
        }

        pub fn compile(&self, _shapes: &[[usize; 4]]) -> Result<Network, Error> {
            match *self {}
        }
    }

    /// Never made.
    #[derive(Debug)]
    pub enum Network {}

    impl Network {
        pub fn path(&self) -> &Path {
            match *self {}
        }

        pub fn run(&self, _inputs: Vec<Vec<f32>>) -> Result<(Vec<usize>, Vec<f32>), Error> {
            match *self {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_hold_the_hole_and_stay_in_the_picture() {
        let hole = |x0: usize, y0: usize, x1: usize, y1: usize| -> Vec<bool> {
            (0..200 * 100).map(|i| (x0..x1).contains(&(i % 200)) && (y0..y1).contains(&(i / 200))).collect()
        };
        assert_eq!(window(&hole(0, 0, 0, 0), [200, 100]), None);
        assert_eq!(window(&hole(90, 40, 130, 60), [200, 100]), Some([70, 10, 80, 80]));
        assert_eq!(window(&hole(190, 0, 200, 10), [200, 100]), Some([136, 0, 64, 64]));
        assert_eq!(window(&hole(10, 0, 190, 100), [200, 100]), Some([0, 0, 200, 100]));
    }

    #[cfg(not(feature = "onnx"))]
    #[test]
    fn without_the_feature_it_is_said_how_to_get_it() {
        let error = Inpainting::open(Path::new("lama.onnx")).unwrap_err().to_string();
        assert!(
            error.starts_with("lama.onnx: this program was built without networks")
                && error.contains("--features onnx")
        );
    }
}

/// Tiny files written here, and what they must give.
#[cfg(all(test, feature = "onnx"))]
mod files {
    use std::path::PathBuf;

    use super::*;

    /// Protocol buffers by hand: a field of bytes, and one of a number.
    fn field(number: u32, bytes: &[u8]) -> Vec<u8> {
        [varint(u64::from(number << 3 | 2)), varint(bytes.len() as u64), bytes.to_vec()].concat()
    }

    fn number(field: u32, value: u64) -> Vec<u8> {
        [varint(u64::from(field << 3)), varint(value)].concat()
    }

    fn varint(mut value: u64) -> Vec<u8> {
        let mut bytes = vec![];
        while value >= 0x80 {
            bytes.push(value as u8 | 0x80);
            value >>= 7;
        }
        bytes.push(value as u8);
        bytes
    }

    /// An input or output of float32; 0 leaves a side open.
    fn info(name: &str, sides: &[u64]) -> Vec<u8> {
        let side = |n: &u64| field(1, &if *n == 0 { field(2, b"side") } else { number(1, *n) });
        let shape: Vec<u8> = sides.iter().flat_map(side).collect();
        let tensor = [number(1, 1), field(2, &shape)].concat();
        [field(1, name.as_bytes()), field(2, &field(1, &tensor))].concat()
    }

    fn node(operator: &str, inputs: &[&str], output: &str) -> Vec<u8> {
        let inputs: Vec<u8> = inputs.iter().flat_map(|name| field(1, name.as_bytes())).collect();
        [inputs, field(2, output.as_bytes()), field(4, operator.as_bytes())].concat()
    }

    fn weight(name: &str, sides: &[u64], values: &[f32]) -> Vec<u8> {
        let sides: Vec<u8> = sides.iter().flat_map(|n| number(1, *n)).collect();
        let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        [sides, number(2, 1), field(8, name.as_bytes()), field(9, &raw)].concat()
    }

    fn model(nodes: &[Vec<u8>], weights: &[Vec<u8>], inputs: &[Vec<u8>], outputs: &[Vec<u8>]) -> Vec<u8> {
        let part =
            |number: u32, parts: &[Vec<u8>]| parts.iter().flat_map(|bytes| field(number, bytes)).collect::<Vec<_>>();
        let graph = [part(1, nodes), field(2, b"tiny"), part(5, weights), part(11, inputs), part(12, outputs)].concat();
        let opset = field(8, &number(2, 13));
        [number(1, 8), field(7, &graph), opset].concat()
    }

    /// picture + hole * colour, times `scale`: what it gets is blacked out in the hole.
    fn inpainting(h: u64, w: u64, scale: f32, swapped: bool) -> Vec<u8> {
        let nodes = [
            node("Mul", &["hole", "color"], "filled"),
            node("Add", &["picture", "filled"], "sum"),
            node("Mul", &["sum", "scale"], "out"),
        ];
        let weights = [weight("color", &[1, 3, 1, 1], &[0.2, 0.4, 0.8]), weight("scale", &[1, 1, 1, 1], &[scale])];
        let mut inputs = [info("picture", &[1, 3, h, w]), info("hole", &[1, 1, h, w])];
        if swapped {
            inputs.reverse();
        }
        model(&nodes, &weights, &inputs, &[info("out", &[1, 3, h, w])])
    }

    /// The sum of the normalised channels with these weights.
    fn depth(h: u64, w: u64) -> Vec<u8> {
        let nodes = [node("Conv", &["pixel_values", "weights"], "map"), node("Squeeze", &["map", "axis"], "out")];
        let axis = [number(1, 1), number(2, 7), field(8, b"axis"), field(9, &1i64.to_le_bytes())].concat();
        let weights = [weight("weights", &[1, 3, 1, 1], &[1.0, 2.0, -1.0]), axis];
        model(&nodes, &weights, &[info("pixel_values", &[0, 3, h, w])], &[info("out", &[0, h, w])])
    }

    fn saved(bytes: &[u8]) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("network.onnx");
        std::fs::write(&path, bytes).unwrap();
        (folder, path)
    }

    #[test]
    fn an_inpainting_network_fills_the_hole_and_nothing_else() {
        for (bytes, what) in [
            (inpainting(64, 64, 1.0, false), "0 to 1"),
            (inpainting(64, 64, 255.0, false), "0 to 255"),
            (inpainting(64, 64, 1.0, true), "the hole first"),
            (inpainting(0, 0, 1.0, false), "any size"),
        ] {
            let (_folder, path) = saved(&bytes);
            let network = Inpainting::open(&path).unwrap();
            let size = [80, 70];
            let mut rgb = vec![[0.6, 0.5, 0.1]; 80 * 70];
            let before = rgb.clone();
            let hole: Vec<bool> =
                (0..80 * 70).map(|i| (30..50).contains(&(i % 80)) && (20..44).contains(&(i / 80))).collect();
            network.fill(&mut rgb, &hole, size).unwrap();
            for (i, inside) in hole.iter().enumerate() {
                if !inside {
                    assert_eq!(rgb[i], before[i], "{what}");
                }
            }
            // Away from the hole's edge, over which resizing reaches two pixels, it is the network's colour.
            for (i, want) in [0.2, 0.4, 0.8].into_iter().enumerate() {
                let found = rgb[32 * 80 + 40][i];
                assert!((found - want).abs() < 1e-3, "{what}: {found} for {want}");
            }
            // A hole of nothing needs no network.
            network.fill(&mut rgb, &vec![false; 80 * 70], size).unwrap();
        }
    }

    #[test]
    fn a_depth_network_sees_normalised_colours() {
        let picture = RgbImage::from_pixel(64, 40, image::Rgb([51, 102, 204]));
        let value = |v: f32, c: usize| (v - MEAN[c]) / DEVIATION[c];
        let want = value(0.2, 0) + 2.0 * value(0.4, 1) - value(0.8, 2);
        // 64 x 40 with 518 on the shorter side is 828.8 wide, 59.2 times 14.
        for (h, w, size) in [(28, 42, [42, 28]), (0, 0, [59 * 14, 518])] {
            let (_folder, path) = saved(&depth(h, w));
            let (values, found) = Depth::open(&path).unwrap().of(&picture).unwrap();
            assert_eq!(found.map(|n| n as usize), size);
            assert_eq!(values.len(), size[0] * size[1]);
            assert!(values.iter().all(|v| (v - want).abs() < 1e-4), "{} for {want}", values[0]);
        }
    }

    #[test]
    fn what_is_no_such_network_is_refused() {
        let says = |bytes: &[u8]| {
            let (_folder, path) = saved(bytes);
            let [a, b] = [Inpainting::open(&path).map(|_| ()), Depth::open(&path).map(|_| ())];
            [a, b].map(|result| result.err().map_or_else(String::new, |error| error.to_string()))
        };
        let whole = inpainting(64, 64, 1.0, false);
        for cut in [0, 1, 20, whole.len() / 2, whole.len() - 1] {
            for error in says(&whole[..cut]) {
                assert!(error.contains("network.onnx: no whole ONNX file"), "{cut}: {error}");
            }
        }
        assert!(says(b"not a network at all").iter().all(|error| error.contains("no whole ONNX file")));
        let [inpainting, other] = says(&whole);
        assert!(inpainting.is_empty(), "{inpainting}");
        assert!(
            other.contains("not a depth network like Depth Anything") && other.contains("picture [1, 3, 64, 64]"),
            "{other}"
        );
        let [other, depth] = says(&depth(28, 28));
        assert!(depth.is_empty(), "{depth}");
        assert!(
            other.contains("not an inpainting network like LaMa") && other.contains("pixel_values [?, 3, 28, 28]"),
            "{other}"
        );
        let strange = model(
            &[node("Sorcery", &["picture", "hole"], "out")],
            &[],
            &[info("picture", &[1, 3, 64, 64]), info("hole", &[1, 1, 64, 64])],
            &[info("out", &[1, 3, 64, 64])],
        );
        let [unknown, _] = says(&strange);
        assert!(unknown.contains("cannot be run") && unknown.contains("Sorcery"), "{unknown}");
    }
}
