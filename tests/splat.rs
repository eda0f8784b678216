//! Splats of other programs: what is read of them, and that of a file only what was meant to changes.

use crate::common;
use std::path::Path;

use gscream_vk::config::Settings;
use gscream_vk::formats::{gltf, ply as own, spz};
use gscream_vk::gpu::testing;
use gscream_vk::math::harmonics::{ZEROTH, coefficients};
use gscream_vk::model::config::Form;
use gscream_vk::model::gaussians::{Cloud, sigmoid};
use gscream_vk::model::parameter::Parameter;
use gscream_vk::model::stored::Stored;
use gscream_vk::prepare::fit::Fit;
use gscream_vk::scene::{self, Hole, PriorKind, synthetic};
use gscream_vk::splat::cameras::{self, Posed};
use gscream_vk::splat::read::{Container, Splat, decode, of_degree};
use gscream_vk::splat::{chosen, fill};
use gscream_vk::train::begin;
use gscream_vk::train::run::{Run, Silent};

/// Gaussians whose numbers all differ.
fn cloud(n: usize, degree: u32) -> Cloud {
    let number = |i: usize, k: usize| ((i * 37 + k * 11) % 101) as f32 / 101.0 - 0.5;
    let three = |i: usize, k: usize| [number(i, k), number(i, k + 1), number(i, k + 2)];
    Cloud {
        position: (0..n).map(|i| three(i, 0).map(|v| 4.0 * v)).collect(),
        log_scale: (0..n).map(|i| three(i, 3).map(|v| v - 3.0)).collect(),
        rotation: (0..n)
            .map(|i| {
                let q = [0.9, number(i, 6), number(i, 7), number(i, 8)];
                let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt();
                q.map(|v| v / norm)
            })
            .collect(),
        logit: (0..n).map(|i| 4.0 * number(i, 9)).collect(),
        degree,
        harmonics: (0..n * coefficients(degree)).map(|i| three(i, 12)).collect(),
        antialiased: false,
    }
}

/// A PLY as another program might write it: properties in another order, one that is none of ours, comments, an element
/// behind the Gaussians.
fn foreign(cloud: &Cloud) -> (Vec<u8>, usize) {
    let rest = 3 * (coefficients(cloud.degree) - 1);
    let mut head = String::from("ply\nformat binary_little_endian 1.0\ncomment by hand\n");
    head += &format!("element vertex {}\nproperty uchar label\n", cloud.len());
    for name in ["opacity", "x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2"] {
        head += &format!("property float {name}\n");
    }
    (0..rest).for_each(|i| head += &format!("property float f_rest_{i}\n"));
    (0..3).for_each(|i| head += &format!("property double f_dc_{i}\n"));
    head += "element extra 1\nproperty int words\nend_header\n";
    let mut bytes = head.into_bytes();
    let stride = 1 + 4 * (11 + rest) + 24;
    for i in 0..cloud.len() {
        bytes.push(i as u8);
        let mut put = |value: f32| bytes.extend(value.to_le_bytes());
        put(cloud.logit[i]);
        cloud.position[i].into_iter().for_each(&mut put);
        cloud.rotation[i].into_iter().for_each(&mut put);
        cloud.log_scale[i].into_iter().for_each(&mut put);
        let harmonics = cloud.harmonics_of(i);
        (0..3).for_each(|c| harmonics[1..].iter().for_each(|rgb| put(rgb[c])));
        harmonics[0].into_iter().for_each(|v| bytes.extend(f64::from(v).to_le_bytes()));
    }
    bytes.extend(7i32.to_le_bytes());
    (bytes, stride)
}

#[test]
fn what_stays_keeps_its_bytes_and_its_order() {
    for degree in 0..=3 {
        let whole = cloud(20, degree);
        let (bytes, stride) = foreign(&whole);
        let splat = decode(bytes.clone()).expect("a splat");
        assert_eq!((splat.container, &splat.cloud), (Container::Ply, &whole));
        let kept: Vec<bool> = (0..20).map(|i| i % 3 != 1).collect();
        let added = cloud(4, 1);
        let after = splat.spliced(&kept, &added);
        let rows = |bytes: &[u8], count: usize| -> Vec<Vec<u8>> {
            let end = bytes.len() - 4;
            bytes[end - count * stride..end].chunks_exact(stride).map(<[u8]>::to_vec).collect()
        };
        let (before, now) = (rows(&bytes, 20), rows(&after, 13 + 4));
        let stayed: Vec<Vec<u8>> = (0..20).filter(|i| kept[*i]).map(|i| before[i].clone()).collect();
        assert_eq!(now[..13], stayed, "every byte, in the order of the file");
        assert_eq!(after[after.len() - 4..], 7i32.to_le_bytes(), "what stands behind the rows");
        let back = decode(after).expect("a splat");
        assert_eq!(back.len(), 17);
        assert_eq!(back.cloud.position[13..], added.position);
        // With the coefficients that the file has: none beyond its degree, zero where the fill has none.
        let shown = of_degree(&added, degree);
        assert_eq!(back.cloud.harmonics[13 * coefficients(degree)..], shown.harmonics);
        assert!(splat.spliced(&[true; 20], &Cloud::default()) == bytes, "nothing changes where nothing goes or comes");
    }
}

#[test]
fn containers_say_the_same() {
    for degree in 0..=3 {
        let whole = cloud(300, degree);
        let read = |bytes: Vec<u8>, container| {
            let splat = decode(bytes).expect("a splat");
            assert_eq!(splat.container, container);
            splat.cloud
        };
        assert_eq!(read(own::encode(&whole), Container::Ply).position, whole.position);
        let glb = read(gltf::encode(&whole).expect("small"), Container::Glb);
        assert_eq!((&glb.position, &glb.harmonics), (&whole.position, &whole.harmonics));
        let packed = read(spz::encode(&whole, spz::Version::Three).expect("near"), Container::Spz);
        let most = |a: &[[f32; 3]], b: &[[f32; 3]]| {
            a.as_flattened().iter().zip(b.as_flattened()).fold(0f32, |m, (a, b)| m.max((a - b).abs()))
        };
        // Two units leave 21 fractional bits of 24 signed ones; log-scales are sixteenths.
        assert!(most(&packed.position, &whole.position) <= 0.5 / (1 << 21) as f32 + 1e-7);
        assert!(most(&packed.log_scale, &whole.log_scale) <= 0.5 / 16.0 + 1e-6);
        let compressed = read(compress(&whole), Container::CompressedPly);
        // Half a step of ten bits over at most 4 units, and of eleven over 1.
        assert!(most(&compressed.position, &whole.position) <= 4.0 / 1023.0 / 2.0 + 1e-5);
        assert!(most(&compressed.log_scale, &whole.log_scale) <= 1.0 / 1023.0 / 2.0 + 1e-5);
        for (a, b) in compressed.logit.iter().zip(&whole.logit) {
            assert!((sigmoid(*a) - sigmoid(*b)).abs() <= 0.5 / 255.0 + 1e-6);
        }
        for (a, b) in compressed.rotation.iter().zip(&whole.rotation) {
            // Three components of ten bits over the root of two; the fourth follows with at most three times their error.
            let step = std::f32::consts::SQRT_2 / 1023.0 / 2.0;
            let dot: f32 = a.iter().zip(b).map(|(a, b)| a * b).sum();
            assert!(a.iter().zip(b).all(|(a, b)| (a * dot.signum() - b).abs() <= 3.0 * step + 1e-5), "{a:?} {b:?}");
        }
        for (i, (a, b)) in compressed.harmonics.iter().zip(&whole.harmonics).enumerate() {
            // Colours are eighths of bits of their chunk's range, the others bytes from -4 to 4.
            let bound = if i % coefficients(degree) == 0 { 1.0 / 255.0 / 2.0 } else { 8.0 / 255.0 / 2.0 };
            assert!((0..3).all(|c| (a[c] - b[c]).abs() <= bound + 1e-5), "{a:?} {b:?}");
        }
    }
}

/// SuperSplat's compressed PLY, written from its layout.
fn compress(cloud: &Cloud) -> Vec<u8> {
    let (n, rest) = (cloud.len(), 3 * (coefficients(cloud.degree) - 1));
    let colors: Vec<[f32; 3]> = (0..n).map(|i| cloud.harmonics_of(i)[0].map(|v| 0.5 + ZEROTH as f32 * v)).collect();
    let stems = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];
    let mut head = format!("ply\nformat binary_little_endian 1.0\nelement chunk {}\n", n.div_ceil(256));
    for three in stems.chunks(3) {
        for end in ["min", "max"] {
            three.iter().for_each(|stem| head += &format!("property float {end}_{stem}\n"));
        }
    }
    head += &format!("element vertex {n}\n");
    ["position", "rotation", "scale", "color"].iter().for_each(|n| head += &format!("property uint packed_{n}\n"));
    if rest > 0 {
        head += &format!("element sh {n}\n");
        (0..rest).for_each(|i| head += &format!("property uchar f_rest_{i}\n"));
    }
    let mut bytes = (head + "end_header\n").into_bytes();
    let bounds = |values: &[[f32; 3]]| {
        let fold = |c: usize, start: f32, f: fn(f32, f32) -> f32| values.iter().fold(start, |m, v| f(m, v[c]));
        let low: [f32; 3] = std::array::from_fn(|c| fold(c, f32::INFINITY, f32::min));
        (low, std::array::from_fn::<f32, 3, _>(|c| fold(c, f32::NEG_INFINITY, f32::max)))
    };
    let arrays = [&cloud.position, &cloud.log_scale, &colors];
    for first in (0..n).step_by(256) {
        for array in arrays {
            let (low, high) = bounds(&array[first..(first + 256).min(n)]);
            low.iter().chain(&high).for_each(|v| bytes.extend(v.to_le_bytes()));
        }
    }
    let part = |value: f32, low: f32, high: f32, most: u32| {
        let part = if high > low { (value - low) / (high - low) } else { 0.0 };
        (part * most as f32).round().clamp(0.0, most as f32) as u32
    };
    for i in 0..n {
        let first = i / 256 * 256;
        let three = |array: &[[f32; 3]], most: [u32; 3]| -> [u32; 3] {
            let (low, high) = bounds(&array[first..(first + 256).min(n)]);
            std::array::from_fn(|c| part(array[i][c], low[c], high[c], most[c]))
        };
        let word = |[a, b, c]: [u32; 3]| a << 21 | b << 11 | c;
        let q = cloud.rotation[i];
        let largest = (1..4).fold(0, |best, k| if q[k].abs() > q[best].abs() { k } else { best });
        let sign = q[largest].signum();
        let others = (0..4).filter(|k| *k != largest);
        let turn = others.fold(largest as u32, |word, k| {
            let most = std::f32::consts::FRAC_1_SQRT_2;
            word << 10 | part(q[k] * sign, -most, most, 1023)
        });
        let [r, g, b] = three(&colors, [255; 3]);
        let alpha = (sigmoid(cloud.logit[i]) * 255.0).round() as u32;
        let words = [
            word(three(&cloud.position, [2047, 1023, 2047])),
            turn,
            word(three(&cloud.log_scale, [2047, 1023, 2047])),
            r << 24 | g << 16 | b << 8 | alpha,
        ];
        words.iter().for_each(|word| bytes.extend(word.to_le_bytes()));
    }
    for i in 0..n {
        for c in 0..3 {
            let higher = &cloud.harmonics_of(i)[1..];
            bytes.extend(higher.iter().map(|rgb| ((rgb[c] + 4.0) * 255.0 / 8.0).round() as u8));
        }
    }
    bytes
}

/// A file that splat-transform 3.7.0 wrote of mip.ply, 24 Gaussians of degree 3 with numbers of everywhere.
fn fixture(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/splats").join(name))
        .expect("a file of the repository")
}

fn assert_near(got: &[[f32; 3]], want: &[[f32; 3]], most: f32, what: &str) {
    assert_eq!(got.len(), want.len(), "{what}");
    let off = got.as_flattened().iter().zip(want.as_flattened()).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
    assert!(off <= most, "{what}: {off} of {most}");
}

/// Rounded as that program does it: to 12 fractional bits, to 16th parts of a natural logarithm, to 255 steps; harmonics to bytes
/// first, then to five bits of degree 1 and four of the others.
#[test]
fn spz_of_its_own_program_is_what_it_was_made_of() {
    let source = decode(fixture("mip.ply")).expect("a splat").cloud;
    for name in ["mip-3.spz", "mip-4.spz"] {
        let splat = decode(fixture(name)).expect(name);
        let got = &splat.cloud;
        assert_eq!((splat.container, got.degree, got.antialiased), (Container::Spz, 3, true), "{name}");
        assert_near(&got.position, &source.position, 0.5 / 4096.0 + 1e-6, "positions");
        assert_near(&got.log_scale, &source.log_scale, 0.5 / 16.0 + 1e-6, "scales");
        for i in 0..source.len() {
            let (a, b) = (got.harmonics_of(i), source.harmonics_of(i));
            assert_near(&a[..1], &b[..1], 0.5 / 255.0 / 0.15 + 1e-6, "colours");
            assert_near(&a[1..4], &b[1..4], (0.5 * 8.0 + 0.5) / 128.0 + 1e-6, "degree 1");
            assert_near(&a[4..], &b[4..], (0.5 * 16.0 + 0.5) / 128.0 + 1e-6, "degrees 2 and 3");
            assert!((sigmoid(got.logit[i]) - sigmoid(source.logit[i])).abs() <= 0.5 / 255.0 + 1e-4);
            let dot: f32 = got.rotation[i].iter().zip(source.rotation[i]).map(|(a, b)| a * b).sum();
            // The angle is at most 6e-3, as in the format's own tests.
            assert!(dot.abs() >= 1.0 - 1e-5, "{dot}");
        }
        // Nothing of the tag is lost on the way into a file with rows.
        assert!(decode(splat.spliced(&[true; 24], &Cloud::default())).expect("a splat").cloud.antialiased, "{name}");
    }
}

/// What that program reads of its own file, mip-sog.ply, in the same order: the lists and the palette are its choice.
#[test]
fn sog_of_its_own_program_is_what_that_reads() {
    let source = decode(fixture("mip-sog.ply")).expect("a splat").cloud;
    let splat = decode(fixture("mip.sog")).expect("a splat");
    let got = &splat.cloud;
    assert_eq!((splat.container, got.len(), got.degree, got.antialiased), (Container::Sog, 24, 3, true));
    // Float32's rounding; half a step of an opacity at the ends, which that program cuts off at a millionth.
    assert_near(&got.position, &source.position, 1e-5, "positions");
    assert_near(&got.log_scale, &source.log_scale, 1e-6, "scales");
    assert_near(&got.harmonics, &source.harmonics, 1e-6, "harmonics");
    for i in 0..24 {
        assert!((sigmoid(got.logit[i]) - sigmoid(source.logit[i])).abs() <= 1.1e-4);
        let dot: f32 = got.rotation[i].iter().zip(source.rotation[i]).map(|(a, b)| a * b).sum();
        assert!((dot - 1.0).abs() < 1e-5, "{dot}");
    }
    let named = |from: &str, to: &str| {
        // The text is stored as it is; its checksum then is another's, and the file is refused before it is read.
        let mut bytes = fixture("mip.sog");
        let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).expect("it is there");
        bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
        decode(bytes).expect_err("refused")
    };
    assert!(named("\"count\":24", "\"count\":99").contains("meta.json"));
}

/// Rows without any first word are told by the file's name.
#[test]
fn dot_splat_is_read_by_its_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.SPLAT");
    let whole = cloud(20, 2);
    std::fs::write(&path, gscream_vk::formats::splat::encode(&whole)).expect("a file");
    let splat = gscream_vk::splat::read::read(&path).expect("a splat");
    assert_eq!((splat.container, &splat.cloud.position), (Container::Splat, &whole.position));
    std::fs::write(&path, [0; 33]).expect("a file");
    let error = gscream_vk::splat::read::read(&path).expect_err("33 bytes").to_string();
    assert!(error.contains("32 for each Gaussian") && error.contains("scene.SPLAT"), "{error}");
    std::fs::write(&path, []).expect("a file");
    assert!(gscream_vk::splat::read::read(&path).is_err());
}

/// What is done to a glTF file's document.
type Change<'a> = &'a dyn Fn(&mut serde_json::Value);

/// A GLB as another program may write it: positions between other bytes, rotations and opacities as integers, and the mesh below
/// two nodes, which move, turn and scale it.
fn foreign_glb(change: impl Fn(&mut serde_json::Value)) -> Vec<u8> {
    let mut bin: Vec<u8> = vec![];
    for position in [[1f32, 2.0, 3.0], [-4.0, 0.5, 0.25]] {
        bin.extend(7f32.to_le_bytes());
        position.iter().for_each(|v| bin.extend(v.to_le_bytes()));
    }
    // x y z w: half a turn about y, and none, of 32,767 steps.
    [0, 32767, 0, 0, 0, 0, 0, 32767i16].iter().for_each(|v| bin.extend(v.to_le_bytes()));
    // Scale and colour of both: 0.5 in x, 1 in y and z.
    [0.5f32, 1.0, 1.0, 0.5, 1.0, 1.0].iter().for_each(|v| bin.extend(v.to_le_bytes()));
    // Opacity in steps of 255, 4 bytes apart.
    bin.extend([51, 0, 0, 0, 204, 0, 0, 0]);
    let name = |name: &str| format!("{}:{name}", gltf::EXTENSION);
    let accessor = |view: u32, kind: u32, shape: &str| serde_json::json!({ "bufferView": view, "componentType": kind, "count": 2, "type": shape });
    let mut document = serde_json::json!({
        "asset": { "version": "2.0" },
        "nodes": [
            { "mesh": 1, "scale": [2, 2, 2] },
            { "children": [0], "translation": [1, 2, 3], "rotation": [0, 0, 1, 0] },
        ],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 } }] }, { "primitives": [{
            "mode": 0,
            "attributes": { "POSITION": 0, (name("ROTATION")): 1, (name("SCALE")): 2,
                            (name("SH_DEGREE_0_COEF_0")): 2, (name("OPACITY")): 3 },
            "extensions": { (gltf::EXTENSION): { "kernel": "ellipse", "colorSpace": "srgb_rec709_display" } },
        }] }],
        "buffers": [{ "byteLength": bin.len() }],
        "bufferViews": [
            { "buffer": 0, "byteLength": 32, "byteStride": 16 },
            { "buffer": 0, "byteOffset": 32, "byteLength": 16 },
            { "buffer": 0, "byteOffset": 48, "byteLength": 24 },
            { "buffer": 0, "byteOffset": 72, "byteLength": 8, "byteStride": 4 },
        ],
        "accessors": [accessor(0, 5126, "VEC3"), accessor(1, 5122, "VEC4"), accessor(2, 5126, "VEC3"),
                      accessor(3, 5121, "SCALAR")],
    });
    document["accessors"][0]["byteOffset"] = 4.into();
    document["accessors"][1]["normalized"] = true.into();
    document["accessors"][3]["normalized"] = true.into();
    change(&mut document);
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut bytes = b"glTF".to_vec();
    for word in [2, 28 + text.len() + bin.len(), text.len()] {
        bytes.extend((word as u32).to_le_bytes());
    }
    bytes.extend(b"JSON");
    bytes.extend(text);
    bytes.extend((bin.len() as u32).to_le_bytes());
    bytes.extend(b"BIN\0");
    bytes.extend(bin);
    bytes
}

#[test]
fn a_glb_of_another_program_is_where_its_nodes_have_it() {
    let splat = decode(foreign_glb(|_| ())).expect("a splat");
    let cloud = &splat.cloud;
    // Twice as large, half a turn about z, moved by (1, 2, 3), and half a turn about x into the cloud's axes.
    let want = [[1.0 - 2.0, -(2.0 - 4.0), -(3.0 + 6.0)], [1.0 + 8.0, -(2.0 - 1.0), -(3.0 + 0.5)]];
    assert_near(&cloud.position, &want, 1e-5, "positions");
    assert_near(&cloud.log_scale, &[[0.0, 2f32.ln(), 2f32.ln()]; 2], 1e-5, "scales");
    assert_near(&cloud.harmonics, &[[0.5, 1.0, 1.0]; 2], 0.0, "colours");
    assert!((sigmoid(cloud.logit[0]) - 0.2).abs() < 1e-6 && (sigmoid(cloud.logit[1]) - 0.8).abs() < 1e-6);
    // Half turns: y then z is x, and x once more is none; z then x is y.
    for (q, axis) in [(cloud.rotation[0], 0), (cloud.rotation[1], 2)] {
        assert!((q[axis].abs() - 1.0).abs() < 1e-5, "{q:?}");
    }
    let changes: [(&str, Change); 12] = [
        ("not within the file", &|d| d["accessors"][0]["count"] = 3.into()),
        ("not within the file", &|d| d["accessors"][0]["count"] = u64::MAX.into()),
        ("not within the file", &|d| d["bufferViews"][0]["byteStride"] = 8.into()),
        ("not within the file", &|d| d["bufferViews"][1]["byteOffset"] = 72.into()),
        ("not within the file", &|d| d["accessors"][2]["sparse"] = serde_json::json!({ "count": 1 })),
        ("of another type", &|d| d["accessors"][1]["type"] = "VEC3".into()),
        ("stretches", &|d| d["nodes"][0]["scale"][0] = 3.into()),
        ("stretches", &|d| d["nodes"][0]["scale"] = serde_json::json!([-2, 2, 2])),
        ("in a circle", &|d| d["nodes"][0]["children"] = serde_json::json!([1])),
        ("lin_rec709_display", &|d| {
            d["meshes"][1]["primitives"][0]["extensions"][gltf::EXTENSION]["colorSpace"] = "lin_rec709_display".into();
        }),
        ("none of its meshes", &|d| d["meshes"][1]["primitives"][0]["extensions"] = serde_json::json!({})),
        ("2 splats", &|d| d["meshes"][0] = d["meshes"][1].clone()),
    ];
    for (what, change) in changes {
        let error = decode(foreign_glb(change)).expect_err(what);
        assert!(error.contains(what), "{what}: {error}");
    }
}

/// splat-transform turns a PLY half around z where this program takes x: both are up in glTF, and a half turn about y apart.
#[test]
fn glb_of_splat_transform_is_what_it_was_made_of() {
    let mut source = decode(fixture("mip.ply")).expect("a splat").cloud;
    source.turn(glam::DMat3::from_diagonal(glam::DVec3::new(-1.0, 1.0, -1.0)));
    let splat = decode(fixture("mip.glb")).expect("a splat");
    assert_eq!((splat.container, splat.cloud.degree), (Container::Glb, 3));
    // Float32 throughout, and the turn's own rounding.
    assert_near(&splat.cloud.position, &source.position, 1e-5, "positions");
    assert_near(&splat.cloud.log_scale, &source.log_scale, 1e-5, "scales");
    assert_near(&splat.cloud.harmonics, &source.harmonics, 1e-5, "harmonics");
}

/// Version 2 byte by byte, after the specification.
#[test]
fn spz_of_version_2_by_hand() {
    let mut raw = b"NGSP".to_vec();
    raw.extend([2, 0, 0, 0, 1, 0, 0, 0, 0, 8, 0, 0]);
    // -1.5, 0 and 2 with 8 fractional bits.
    raw.extend([0x80, 0xfe, 0xff, 0, 0, 0, 0, 2, 0]);
    raw.extend([51, 0, 255, 128, 160, 0, 144]);
    // x of 1, y and z of half a step, w of nothing.
    raw.extend([255, 127, 127]);
    let zip = |raw: &[u8]| {
        let mut packed = flate2::write::GzEncoder::new(vec![], flate2::Compression::fast());
        std::io::Write::write_all(&mut packed, raw).expect("memory");
        packed.finish().expect("memory")
    };
    let cloud = decode(zip(&raw)).expect("a splat").cloud;
    assert_eq!((cloud.position[0], cloud.log_scale[0]), ([-1.5, 0.0, 2.0], [0.0, -10.0, -1.0]));
    assert!((sigmoid(cloud.logit[0]) - 0.2).abs() < 1e-6);
    assert_near(&cloud.harmonics, &[[-0.5 / 0.15, 0.5 / 0.15, 0.5 / 255.0 / 0.15]], 1e-6, "colour");
    let q = cloud.rotation[0];
    assert!(q[0] == 0.0 && q[1] > 0.9999 && q[2].abs() < 0.004 && q[3].abs() < 0.004, "{q:?}");
    let with = |at: usize, value: u8| {
        let mut changed = raw.clone();
        changed[at] = value;
        decode(zip(&changed)).expect_err("refused")
    };
    assert_eq!(with(4, 1), "it is SPZ of version 1; versions 2, 3 and 4 are read");
    assert_eq!(with(4, 5), "it is SPZ of version 5; versions 2, 3 and 4 are read");
    assert_eq!(with(12, 4), "it is SPZ of degree 4; degrees 0 to 3 are read");
    assert!(with(9, 255).contains("cut off") && with(11, 255).contains("Gaussians"));
    // Version 4 cut off anywhere, or with a table that promises more.
    let frames = fixture("mip-4.spz");
    (0..frames.len()).for_each(|end| assert!(decode(frames[..end].to_vec()).is_err(), "{end}"));
    for at in [8, 11, 15, 16, 19, 32, 39, 40, 47] {
        let mut changed = frames.clone();
        changed[at] ^= 0x80;
        assert!(decode(changed).is_err(), "{at}");
    }
}

/// What programs write for it, the last one of a header, and that it goes into what is written again.
#[test]
fn the_antialias_tag_of_a_ply_is_kept() {
    let whole = Cloud { antialiased: true, ..cloud(5, 1) };
    let tagged = own::encode(&whole);
    assert!(decode(tagged.clone()).expect("a splat").cloud.antialiased);
    let with = |comments: &str| {
        let tag = tagged.windows(own::TAG.len()).position(|w| w == own::TAG.as_bytes()).expect("it is there");
        decode([&tagged[..tag], comments.as_bytes(), &tagged[tag + own::TAG.len()..]].concat()).expect("a splat")
    };
    for (comments, is) in [
        ("", false),
        ("comment antialiased 1\n", true),
        ("comment splatrendermode: MIP\r\n", true),
        ("comment SplatRenderMode: default\n", false),
        ("comment antialiased 1\ncomment SplatRenderMode: 2dgs\n", false),
        ("comment mip\n", false),
    ] {
        let splat = with(comments);
        assert_eq!(splat.cloud.antialiased, is, "{comments}");
        let again = decode(splat.spliced(&[true, false, true, true, true], &cloud(2, 0))).expect("a splat");
        assert_eq!((again.len(), again.cloud.antialiased), (6, is), "{comments}");
    }
}

#[test]
fn what_is_no_splat_is_refused_in_one_sentence() {
    let whole = own::encode(&cloud(5, 0));
    let renamed = |from: &str, to: &str| {
        let text: Vec<u8> = whole.clone();
        let at = text.windows(from.len()).position(|w| w == from.as_bytes()).expect("it is there");
        [&text[..at], to.as_bytes(), &text[at + from.len()..]].concat()
    };
    for (bytes, what) in [
        (vec![], "none of PLY, SPZ, SOG and GLB"),
        (b"ply\n".to_vec(), "header does not end"),
        (whole[..whole.len() - 1].to_vec(), "cut off"),
        (renamed("binary_little_endian", "ascii"), "save it as binary_little_endian"),
        (renamed("f_rest_44", "f_other__"), "degrees 0 to 3"),
        (renamed("float scale_2", "float scale_9"), "2DGS"),
        (renamed("float opacity", "float opaque_"), "no property opacity"),
        (renamed("float f_dc_0", "float f_xx_0"), "point cloud without Gaussians"),
        (renamed("element vertex 5", "element vertex 0"), "no Gaussian"),
        (renamed("element vertex 5", "element vertex 99999999999999999999"), "its header says"),
        (renamed("element vertex 5", "element vertex 9999999999999999999"), "cut off"),
    ] {
        let error = decode(bytes).expect_err(what);
        assert!(error.contains(what) && !error.contains('\n'), "{what}: {error}");
    }
}

/// Infinity stands for an opacity of 1 and for flat Gaussians; what is no number is kept and not drawn.
#[test]
fn numbers_at_infinity_are_drawn_and_no_numbers_are_not() {
    let mut whole = cloud(4, 0);
    whole.logit[0] = f32::INFINITY;
    whole.log_scale[1][2] = f32::NEG_INFINITY;
    whole.position[2][0] = f32::NAN;
    let bytes = own::encode(&whole);
    let splat = decode(bytes.clone()).expect("a splat");
    assert_eq!(splat.drawn, [true, true, false, true]);
    assert!(splat.cloud.first_not_finite().is_none());
    assert!(splat.spliced(&[true; 4], &Cloud::default()) == bytes, "the file keeps them");
}

#[test]
fn cameras_of_3dgs_stand_where_they_say() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("cameras.json");
    let entry = |name: &str, x: f64| {
        format!(
            r#"{{"id":0,"img_name":"{name}","width":1600,"height":800,"position":[{x},2,3],"fx":900,"fy":910,
            "rotation":[[0,0,1],[1,0,0],[0,1,0]]}}"#
        )
    };
    let write = |entries: &[String]| std::fs::write(&path, format!("[{}]", entries.join(","))).expect("a file");
    write(&[entry("b.jpg", 1.0), entry("a", 4.0), entry("c.png", 5.0)]);
    let posed = cameras::read(&path).expect("cameras");
    let names: Vec<&str> = posed.iter().map(|posed| posed.name.as_str()).collect();
    assert_eq!(names, ["a", "b", "c"]);
    let camera = posed[1].camera;
    // A half of 1600 x 800; the camera's axis ahead is the third column: x of the world.
    assert_eq!((camera.size, camera.focal, camera.principal), ([800, 400], [450.0, 455.0], [400.0, 200.0]));
    let [x, y] = camera.project([11.0, 2.0, 3.0]).expect("it is ahead");
    assert!((x - 400.0).abs() < 1e-4 && (y - 200.0).abs() < 1e-4, "{x} {y}");
    for (entries, what) in [
        (vec![entry("a", 0.0), entry("a", 1.0), entry("b", 2.0)], "two cameras called a"),
        (vec![entry("a", 0.0), entry("../b", 1.0), entry("c", 2.0)], "no file can be called"),
        (vec![entry("a", 0.0)], "three are the least"),
        (vec![entry("a", 1e300), entry("b", 1.0), entry("c", 2.0)], "stands nowhere"),
    ] {
        write(&entries);
        let error = cameras::read(Path::new(&path)).expect_err(what).to_string();
        assert!(error.contains(what), "{error}");
    }
}

/// What `export` says of its cameras is read as well, with the place where the axis goes through the picture.
#[test]
fn cameras_of_export_stand_where_they_say() {
    let folder = tempfile::tempdir().expect("a folder");
    let entry = |name: &str, principal: &str| {
        format!(
            r#"{{"name":"{name}","center":[1,2,3],"rotation":[[0,1,0],[0,0,1],[1,0,0]],"fov":90,"size":[200,100],"roll":0{principal}}}"#
        )
    };
    let write = |principals: [&str; 3]| {
        let all: Vec<_> =
            ["a", "b", "c"].iter().zip(principals).map(|(name, principal)| entry(name, principal)).collect();
        let text = format!(r#"{{"version":"1","cameras":[{}]}}"#, all.join(","));
        std::fs::write(folder.path().join("export.json"), text).expect("a file");
    };
    write(["", r#","principal":[0.25,0.5]"#, r#","principal":null"#]);
    let found = cameras::beside(&folder.path().join("scene.ply")).expect("it is beside the splat");
    let posed = cameras::read(&found).expect("cameras");
    for (one, column) in posed.iter().zip([400.0, 200.0, 400.0]) {
        let camera = one.camera;
        assert_eq!((camera.size, camera.focal), ([800, 400], [400.0; 2]));
        // Ahead is x of the world.
        let [x, y] = camera.project([11.0, 2.0, 3.0]).expect("it is ahead");
        assert!((x - column).abs() < 1e-3 && (y - 200.0).abs() < 1e-3, "{x} {y}");
    }
    write(["", r#","principal":[1e30,0.5]"#, ""]);
    let error = cameras::read(&found).expect_err("a picture far from its axis").to_string();
    assert!(error.contains("camera b: its principal point"), "{error}");
    std::fs::write(folder.path().join("export.json"), "{}").expect("a file");
    let error = cameras::read(&found).expect_err("no cameras").to_string();
    assert!(error.contains("neither a cameras.json"), "{error}");
}

/// A fine ball on a floor, before a wall: Gaussians are as large as pixels of a camera before it, a little above, would be.
fn on_a_floor() -> Splat {
    let mut cloud = Cloud::default();
    let mut put = |position: [f32; 3], color: f32| {
        let far = position.iter().zip([0.0, 2.0, 5.0]).map(|(a, b): (&f32, f32)| (a - b).powi(2)).sum::<f32>().sqrt();
        cloud.position.push(position);
        cloud.log_scale.push([(0.01 * far).ln(); 3]);
        cloud.rotation.push([1.0, 0.0, 0.0, 0.0]);
        cloud.logit.push(4.0);
        cloud.harmonics.push([color; 3]);
    };
    for i in 0..100 {
        for j in 0..100 {
            let [u, v] = [i, j].map(|k| 0.08 * k as f32 - 4.0);
            put([u, 0.0, v], 0.5);
            put([u, v + 4.0, -4.0], -0.5);
        }
    }
    let golden = 2.399_963_f32;
    for i in 0..6000 {
        let height = 1.0 - (2 * i + 1) as f32 / 6000.0;
        let around = (1.0 - height * height).sqrt();
        let (sin, cos) = (golden * i as f32).sin_cos();
        put([0.6 * cos * around, 0.6 + 0.6 * height, 0.6 * sin * around], 0.0);
    }
    decode(own::encode(&cloud)).expect("our own file")
}

/// Views of a splat without cameras show what it is of, from above the floor, upright, each near another.
#[test]
fn views_are_chosen_where_there_are_no_cameras() {
    let gpu = testing::gpu();
    let splat = on_a_floor();
    let posed = chosen::cameras(&gpu, &splat, 24, &mut |_| Ok(())).expect("views");
    assert!((12..=24).contains(&posed.len()), "{}", posed.len());
    for Posed { name, camera } in &posed {
        let center = camera.center();
        assert!(center[1] > 0.2 && center[2] > -4.0, "{name} stands at {center:?}");
        assert!(camera.rotation[1][1] < 0.0, "{name}: down is down");
        assert!(camera.within([0.0, 0.6, 0.0]).is_some(), "{name} sees the ball");
    }
    let ways: Vec<[f64; 3]> = posed
        .iter()
        .map(|one| {
            let [x, y, z] = one.camera.center();
            let far = (x * x + (y - 0.6).powi(2) + z * z).sqrt();
            [x / far, (y - 0.6) / far, z / far]
        })
        .collect();
    for (i, a) in ways.iter().enumerate() {
        let near = ways.iter().enumerate().filter(|(j, _)| *j != i);
        let near = near.map(|(_, b)| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>()).fold(-1.0, f64::max);
        // Half a radian, and what the middle of the densest is off the ball's.
        assert!(near > 0.8, "{}: {near}", posed[i].name);
    }
    // Nothing opaque is nothing to look at.
    let mut faint = splat;
    faint.cloud.logit.fill(-6.0);
    let error = chosen::cameras(&gpu, &faint, 24, &mut |_| Ok(())).expect_err("nothing to see").to_string();
    assert!(error.contains("--cameras"), "{error}");
}

/// Each view's filled hole begins with Gaussians where no earlier one has: the same surface again with none, another one with all of its own.
#[test]
fn all_views_holes_begin_with_something() {
    let gpu = testing::gpu();
    let folder = tempfile::tempdir().expect("a folder");
    let dir = folder.path().join("scene");
    synthetic::write(&dir, &synthetic::Options::default()).expect("a scene");
    let mut scene = scene::load(&dir, &scene::Config::default()).expect("it loads");
    let reference = scene.references[0].clone();
    let rest = Cloud {
        position: vec![[0.0, 0.0, -1e4]],
        log_scale: vec![[-3.0; 3]],
        rotation: vec![[1.0, 0.0, 0.0, 0.0]],
        logit: vec![-3.0],
        harmonics: vec![[0.0; 3]],
        ..Cloud::default()
    };
    let fit = Fit { model: Stored::Gaussians(rest.clone()), settings: Settings::default() };
    let among = |rest: &Cloud, scene: &scene::Scene| fill::begin(&gpu, scene, &dir, rest, &fit).expect("a fill").len();
    let begun = |scene: &scene::Scene| among(&rest, scene);
    scene.holes.clear();
    let alone = begun(&scene);
    assert!(alone > 100, "{alone}");
    let camera = scene.train[reference.view].camera;
    let prior = reference.prior.as_ref().expect("the built-in scene's");
    let depth: Vec<f32> =
        prior.values.iter().map(|v| if prior.kind == PriorKind::Disparity { 1.0 / v } else { *v }).collect();
    let filled = scene.train[reference.view].mask.clone().expect("one");
    let inside = filled.as_raw().iter().filter(|inside| **inside != 0).count();
    let hole = |depth: Vec<f32>| Hole {
        view: reference.view,
        image: reference.image.clone(),
        covered: filled.clone(),
        filled: filled.clone(),
        depth: Some(depth),
    };
    assert_eq!(reference.image.dimensions(), (camera.size[0], camera.size[1]));
    scene.holes = vec![hole(depth.clone())];
    assert_eq!(begun(&scene), alone);
    scene.holes.push(hole(depth.iter().map(|z| 0.8 * z).collect()));
    assert_eq!(begun(&scene), alone + inside);
    scene.holes.push(hole(vec![f32::NAN; depth.len()]));
    assert_eq!(begun(&scene), alone + inside);
    // Before what stands before the hole nothing begins, though it looks other than what is in the hole.
    let near = 0.3 * depth[filled.as_raw().iter().position(|inside| *inside != 0).expect("a hole")];
    let middle = camera.lift(camera.principal.map(f64::from), f64::from(near)).expect("ahead");
    let mut before = rest.clone();
    before.position = vec![middle.map(|v| v as f32)];
    before.log_scale = vec![[near.ln(); 3]];
    before.logit = vec![8.0];
    assert_eq!(among(&before, &scene), 0);
}

#[test]
fn runs_of_flags_are_ranges() {
    let flags = [true, true, false, true, false, false, true];
    assert_eq!(fill::ranges(&flags), [[0, 2], [3, 4], [6, 7]]);
}

/// A training that goes on from a splat: those that are to stay do, bit by bit, and the others learn.
#[test]
fn frozen_gaussians_stay_and_the_others_learn() {
    let (gpu, scene) = (testing::gpu(), common::tiny());
    let mut settings: Settings = common::settings(20);
    settings.model.attention.enabled = false;
    settings.model.form = Form::Gaussians;
    settings.densify.enabled = false;
    let mut start = begin::gaussians(&scene, &settings).expect("points");
    let count = start.len();
    start.rescale(scene.unit);
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("start.ply");
    std::fs::write(&path, own::encode(&start)).expect("a file");
    settings.model.from = path.to_string_lossy().into_owned();
    let frozen = count / 3 + 1;
    settings.model.frozen = frozen as u32;
    settings.validate().expect("settings that make sense");
    let mut run = Run::new(&gpu, &scene, &settings).expect("the device has room");
    let read = |run: &Run<'_>| -> Vec<_> {
        let read = |row: &Parameter| (row.width as usize, row.read(&gpu, count as u32).expect("readable"));
        run.step().learnt.rows().into_iter().map(read).collect()
    };
    let before = read(&run);
    run.train(folder.path(), &mut Silent).expect("a run");
    for ((width, before), (_, after)) in before.iter().zip(&read(&run)) {
        let edge = width * frozen;
        assert!(before[..edge] == after[..edge], "those that are frozen");
        assert!(before[edge..] != after[edge..], "those that are not");
    }
    settings.model.frozen = count as u32 + 1;
    let error = Run::new(&gpu, &scene, &settings).err().expect("fewer than are to stay").to_string();
    assert!(error.contains("set model.frozen to fewer"), "{error}");
    settings.densify.enabled = true;
    assert!(settings.validate().is_err(), "growth splits them");
}

#[test]
fn nothing_of_the_users_is_written_over() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let splat = foreign(&cloud(400, 1)).0;
    std::fs::write(at("scene.ply"), &splat).expect("a file");
    let entry = |name: &str, x: f64| {
        format!(
            r#"{{"id":0,"img_name":"{name}","width":64,"height":48,"position":[{x},0,-6],"fx":60,"fy":60,
            "rotation":[[1,0,0],[0,1,0],[0,0,1]]}}"#
        )
    };
    let cameras = [entry("a", -0.5), entry("b", 0.0), entry("c", 0.5)].join(",");
    std::fs::write(at("cameras.json"), format!("[{cameras}]")).expect("a file");
    image::GrayImage::from_pixel(64, 48, image::Luma([255])).save(at("mask.png")).expect("a file");
    let refused = |out: &str, says: &str| {
        let mut program = std::process::Command::new(env!("CARGO_BIN_EXE_gscream-vk"));
        let program = program.current_dir(folder.path()).args(["remove", "scene.ply", "--mask", "a=mask.png", "--yes"]);
        let output = program.args(["--out", out]).output().expect("it runs");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(1) && said.contains(says), "{said}");
    };
    refused(".", "scene.ply: what is made would be written over it");
    assert_eq!(std::fs::read(at("scene.ply")).expect("it is there"), splat);
    std::fs::create_dir_all(at("out/views")).expect("a folder");
    std::fs::write(at("out/views/mine.txt"), "mine").expect("a file");
    refused("out", "other files are there already");
    assert_eq!(std::fs::read(at("out/views/mine.txt")).expect("it is there"), b"mine");
}
