//! NumPy's `.npy`, as far as maps need it: float32, float64, uint8 and uint16 in either byte order and memory order.
//!
//! The format is NumPy's own ("numpy.lib.format"): a magic, a version, the header's length, the header, which is a Python
//! dictionary, and the values. What the header says is held against the file's length before anything is allocated.

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::Path;

use super::Error;
use super::picture::MAX_PIXELS;

const MAGIC: &[u8; 6] = b"\x93NUMPY";
/// NumPy itself writes 128 bytes and refuses more than 10,000.
const LONGEST_HEADER: u64 = 10_000;

/// An array of two sides, each longer than 1, or shorter ones that say which is which.
#[derive(Debug)]
pub struct Map {
    /// Row-major.
    pub values: Vec<f32>,
    /// Width, height.
    pub size: [u32; 2],
}

/// Bytes in front of the values of a written file are a multiple of this, as NumPy aligns them.
const ALIGNMENT: usize = 64;

/// The bytes of a float32 map (row-major, `size` = width, height) as a file of format version 1.0.
///
/// # Panics
/// Unless there is a value per pixel.
pub fn encode(values: &[f32], [width, height]: [u32; 2]) -> Vec<u8> {
    assert_eq!(values.len(), width as usize * height as usize, "a value per pixel");
    let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({height}, {width}), }}");
    let start = MAGIC.len() + 4;
    // The header ends with a line break, and at least one space stands before the next multiple.
    let length = (start + header.len() + 1) / ALIGNMENT * ALIGNMENT + ALIGNMENT - start;
    let mut bytes = MAGIC.to_vec();
    bytes.extend([1, 0]);
    bytes.extend((length as u16).to_le_bytes());
    bytes.extend(format!("{header:<0$}\n", length - 1).bytes());
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    bytes
}

/// Reads an array of rows x columns; axes of length 1 around it count for nothing.
///
/// # Errors
/// Another file, type or shape; more or fewer values than the header says.
pub fn read(path: &Path) -> Result<Map, Error> {
    let invalid = |what: String| Error::File { path: path.to_path_buf(), what };
    let io = |source: io::Error| match source.kind() {
        io::ErrorKind::UnexpectedEof => invalid("not a readable NumPy array: the file ends within its header".into()),
        _ => Error::Io { path: path.to_path_buf(), source },
    };
    let file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    let mut input = BufReader::new(file);
    let mut start = [0; 8];
    input.read_exact(&mut start).map_err(io)?;
    let [magic @ .., version, _] = start;
    if magic != *MAGIC || !(1..=3).contains(&version) {
        return Err(invalid(
            "not a readable NumPy array: it does not begin as one does; save it with numpy.save".into(),
        ));
    }
    let (before, header_length) = if version == 1 {
        let mut bytes = [0; 2];
        input.read_exact(&mut bytes).map_err(io)?;
        (10, u64::from(u16::from_le_bytes(bytes)))
    } else {
        let mut bytes = [0; 4];
        input.read_exact(&mut bytes).map_err(io)?;
        (12, u64::from(u32::from_le_bytes(bytes)))
    };
    if header_length > LONGEST_HEADER {
        let what = format!("not a readable NumPy array: its header is said to have {header_length} bytes");
        return Err(invalid(what));
    }
    let mut header = vec![0; header_length as usize];
    input.read_exact(&mut header).map_err(io)?;
    let header = String::from_utf8_lossy(&header);
    let Header { descr, fortran, shape } = Header::parse(&header)
        .ok_or_else(|| invalid("not a readable NumPy array: its header is no dictionary of NumPy's".into()))?;
    let decode = decoder(&descr).ok_or_else(|| {
        invalid("the array's type must be float32, float64, uint8 or uint16; save it with `.astype('float32')`".into())
    })?;
    // Networks leave batch and channel axes of length 1 around the map.
    let sides: Vec<u64> = shape.iter().copied().filter(|n| *n != 1).collect();
    let &[h, w] = sides.as_slice() else {
        return Err(invalid(format!("the array's shape is {shape:?}, it must be rows x columns")));
    };
    let pixels = w.checked_mul(h).filter(|pixels| (1..=MAX_PIXELS).contains(pixels));
    let pixels =
        pixels.ok_or_else(|| invalid(format!("the array's shape is {shape:?}; a map has 1 to {MAX_PIXELS} values")))?;
    let (wanted, found) = (pixels * decode.bytes, length.saturating_sub(before + header_length));
    if found != wanted {
        return Err(invalid(format!(
            "not a readable NumPy array: its header says {h} x {w} values of {} bytes, {wanted} bytes together, and {found} \
             follow; copy or save it again",
            decode.bytes
        )));
    }
    let mut bytes = vec![];
    input.take(wanted).read_to_end(&mut bytes).map_err(io)?;
    let mut values: Vec<f32> = bytes.chunks_exact(decode.bytes as usize).map(decode.value).collect();
    if values.len() as u64 != pixels {
        return Err(invalid("not a readable NumPy array: the file ends within its values".into()));
    }
    if fortran {
        let (w, h) = (w as usize, h as usize);
        values = (0..w * h).map(|i| values[i % w * h + i / w]).collect();
    }
    // At most 2^28 values, so that each side fits.
    Ok(Map { values, size: [w as u32, h as u32] })
}

/// How a value is read.
struct Decoder {
    bytes: u64,
    value: fn(&[u8]) -> f32,
}

/// The decoder of a type in NumPy's notation: byte order, kind, bytes.
fn decoder(descr: &str) -> Option<Decoder> {
    /// The value's own bytes, of which `chunks_exact` gives as many as there are.
    fn own<const N: usize>(bytes: &[u8]) -> [u8; N] {
        bytes.try_into().expect("as many bytes as the type has")
    }
    let value: fn(&[u8]) -> f32 = match descr {
        "<f4" => |b| f32::from_le_bytes(own(b)),
        ">f4" => |b| f32::from_be_bytes(own(b)),
        "<f8" => |b| f64::from_le_bytes(own(b)) as f32,
        ">f8" => |b| f64::from_be_bytes(own(b)) as f32,
        "<u2" => |b| f32::from(u16::from_le_bytes(own(b))),
        ">u2" => |b| f32::from(u16::from_be_bytes(own(b))),
        "|u1" | "<u1" | ">u1" => |b| f32::from(b[0]),
        _ => return None,
    };
    let bytes = descr.bytes().last().map(|digit| u64::from(digit - b'0'))?;
    Some(Decoder { bytes, value })
}

/// What the dictionary says.
#[derive(Debug, PartialEq)]
struct Header {
    descr: String,
    fortran: bool,
    shape: Vec<u64>,
}

impl Header {
    fn parse(text: &str) -> Option<Self> {
        // The three keys have values of known form, none of which can hold a key.
        let value = |key: &str| {
            let at = ['\'', '"'].into_iter().find_map(|quote| {
                let quoted = format!("{quote}{key}{quote}");
                Some(text.find(&quoted)? + quoted.len())
            })?;
            Some(text[at..].trim_start().strip_prefix(':')?.trim_start())
        };
        let descr = value("descr")?;
        // A type of several fields is a list, which is none of ours.
        let descr = match descr.chars().next()? {
            quote @ ('\'' | '"') => descr[1..].split_once(quote)?.0,
            _ => "",
        };
        let fortran = match value("fortran_order")? {
            yes if yes.starts_with("True") => true,
            no if no.starts_with("False") => false,
            _ => return None,
        };
        let (shape, _) = value("shape")?.strip_prefix('(')?.split_once(')')?;
        // Python 2 wrote long integers with an L.
        let sides = shape.split(',').map(str::trim).filter(|side| !side.is_empty());
        let shape = sides.map(|side| side.trim_end_matches('L').parse().ok()).collect::<Option<_>>()?;
        Some(Self { descr: descr.to_owned(), fortran, shape })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(header: &str, values: &[u8]) -> Vec<u8> {
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.bytes());
        bytes.extend(values);
        bytes
    }

    fn of(bytes: &[u8]) -> Result<Map, Error> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npy");
        std::fs::write(&path, bytes).unwrap();
        read(&path)
    }

    #[test]
    fn every_type_and_order_is_read() {
        let rows = [1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0];
        let columns = [1.0f32, 4.0, 2.0, 5.0, 3.0, 6.0];
        let bytes =
            |values: &[f32], of: &dyn Fn(f32) -> Vec<u8>| values.iter().flat_map(|v| of(*v)).collect::<Vec<u8>>();
        let header = |descr: &str, fortran: &str| {
            format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': (1, 2, 3), }}   \n")
        };
        for (descr, of_value) in [
            ("<f4", &(|v: f32| v.to_le_bytes().to_vec()) as &dyn Fn(f32) -> Vec<u8>),
            (">f4", &|v| v.to_be_bytes().to_vec()),
            ("<f8", &|v| f64::from(v).to_le_bytes().to_vec()),
            (">f8", &|v| f64::from(v).to_be_bytes().to_vec()),
            ("<u2", &|v| (v as u16).to_le_bytes().to_vec()),
            (">u2", &|v| (v as u16).to_be_bytes().to_vec()),
            ("|u1", &|v| vec![v as u8]),
        ] {
            for (values, fortran) in [(&rows, "False"), (&columns, "True")] {
                let map = of(&file(&header(descr, fortran), &bytes(values, of_value))).unwrap();
                assert_eq!((map.values, map.size), (rows.to_vec(), [3, 2]), "{descr} {fortran}");
            }
        }
    }

    /// Another program reads the same from it, for shapes of every number of digits.
    #[test]
    fn written_files_are_read_by_the_library() {
        for (w, h) in [(1, 1), (3, 2), (1000, 7), (12, 100_000), (100_000, 12)] {
            let values: Vec<f32> = (0..w * h).map(|i| i as f32 / 7.0).collect();
            let bytes = encode(&values, [w as u32, h as u32]);
            let read: ndarray::Array2<f32> = ndarray_npy::ReadNpyExt::read_npy(&bytes[..]).unwrap();
            assert_eq!(read, ndarray::Array2::from_shape_vec((h, w), values).unwrap(), "{w} x {h}");
        }
    }

    /// 128 bytes that claim terabytes, and headers that are no dictionaries, are refused without being believed.
    #[test]
    fn headers_are_not_believed() {
        let header = |shape: &str| format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({shape}), }}");
        let refused = |bytes: &[u8]| of(bytes).unwrap_err().to_string();
        for shape in ["1048576, 1048576", "18446744073709551615, 18446744073709551615", "65536, 65536", "0, 3"] {
            assert!(refused(&file(&header(shape), &[])).contains("a map has 1 to 268435456 values"), "{shape}");
        }
        assert!(refused(&file(&header("16384, 16384"), &[])).contains("1073741824 bytes together, and 0 follow"));
        assert!(refused(&file(&header("2, 3"), &[0; 25])).contains("24 bytes together, and 25 follow"));
        assert!(refused(&file(&header("6"), &[0; 24])).contains("it must be rows x columns"));
        assert!(refused(&file(&header("2, 3").replace("<f4", "<c8"), &[0; 24])).contains("the array's type must be"));
        for text in ["", "((((((((((", "{'descr': ", "{'descr': '<f4', 'shape': (2, 3), }"] {
            assert!(refused(&file(text, &[0; 24])).contains("no dictionary"), "{text}");
        }
        let mut second = b"\x93NUMPY\x02\x00".to_vec();
        second.extend(u32::MAX.to_le_bytes());
        assert!(refused(&second).contains("its header is said to have 4294967295 bytes"));
        for bytes in [&b""[..], b"\x93NUMPY", b"\x93NUMPY\x01\x00\x80"] {
            assert!(refused(bytes).contains("the file ends within its header"));
        }
        assert!(refused(b"\x93NUMPX\x01\x00\x80\x00").contains("does not begin as one does"));
    }
}
