//! The model on disk: round trips, foreign and damaged files.

use std::io::Write;
use std::path::Path;

use gscream_vk::model::files::{self, Anchors, Error, POINT_CLOUD, WEIGHTS, Weights};
use gscream_vk::model::init;
use proptest::prelude::*;
use rand::RngExt;
use rand_pcg::Pcg64;

/// Anchors with every bit of a float32 in play: subnormals, negative zero, the largest finite numbers.
fn anchors(count: usize, offsets_per_anchor: usize, seed: u64) -> Anchors {
    let mut generator = Pcg64::new(seed.into(), 1);
    let mut value = || loop {
        let value = f32::from_bits(generator.random());
        if value.is_finite() {
            return value;
        }
    };
    Anchors::new(
        offsets_per_anchor,
        (0..count).map(|_| [(); 3].map(|()| value())).collect(),
        (0..count).map(|_| [(); 32].map(|()| value())).collect(),
        (0..count * offsets_per_anchor * 3).map(|_| value()).collect(),
        (0..count).map(|_| [(); 6].map(|()| value())).collect(),
    )
}

fn bits(anchors: &Anchors) -> Vec<u32> {
    let floats = anchors.position.iter().flatten().chain(anchors.feature.iter().flatten()).chain(&anchors.offset);
    floats.chain(anchors.log_scaling.iter().flatten()).map(|value| value.to_bits()).collect()
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

fn saved(anchors: &Anchors, weights: &Weights) -> tempfile::TempDir {
    let folder = folder();
    files::save(folder.path(), anchors, weights).unwrap();
    folder
}

/// Header lines and payload of a binary PLY file.
fn split(bytes: &[u8]) -> (Vec<String>, Vec<u8>) {
    let end = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap().lines().map(str::to_owned).collect();
    (header, bytes[end..].to_vec())
}

fn write_ply(path: &Path, header: &[String], payload: &[u8]) {
    let mut file = std::fs::File::create(path).unwrap();
    file.write_all((header.join("\n") + "\n").as_bytes()).unwrap();
    file.write_all(payload).unwrap();
}

/// The attribute names and the rows of a file whose attributes are all float.
fn rows(header: &[String], payload: &[u8]) -> (Vec<String>, Vec<Vec<f32>>) {
    let names: Vec<String> =
        header.iter().filter_map(|line| line.strip_prefix("property float ")).map(str::to_owned).collect();
    let floats: Vec<f32> = payload.chunks_exact(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap())).collect();
    let rows = floats.chunks_exact(names.len()).map(<[f32]>::to_vec).collect();
    (names, rows)
}

fn refusal(folder: &Path) -> String {
    files::load(folder).expect_err("this model is refused").to_string()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 32, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn a_model_comes_back_bit_for_bit(count in 0usize..40, k in 1usize..13, attention: bool, seed: u64) {
        let before = (anchors(count, k, seed), init::weights(seed, k, attention, 0.0));
        let folder = saved(&before.0, &before.1);
        let after = files::load(folder.path()).unwrap();
        prop_assert_eq!(bits(&after.0), bits(&before.0));
        prop_assert_eq!((after.0.offsets_per_anchor, after.0.position.len()), (k, count));
        prop_assert_eq!(after.1, before.1);
    }
}

#[test]
fn the_ply_has_the_published_names_order_and_layout() {
    let anchors = anchors(3, 10, 7);
    let folder = saved(&anchors, &init::weights(0, 10, false, 0.0));
    let (header, payload) = split(&std::fs::read(folder.path().join(POINT_CLOUD)).unwrap());
    assert_eq!(header[..3], ["ply", "format binary_little_endian 1.0", "element vertex 3"]);
    let (names, rows) = rows(&header, &payload);
    let mut expected: Vec<String> = ["x", "y", "z", "nx", "ny", "nz"].map(String::from).into();
    expected.extend((0..30).map(|i| format!("f_offset_{i}")));
    expected.extend((0..32).map(|i| format!("f_anchor_feat_{i}")));
    expected.push("opacity".into());
    expected.extend((0..6).map(|i| format!("scale_{i}")));
    expected.extend((0..4).map(|i| format!("rot_{i}")));
    assert_eq!(names, expected);
    assert_eq!(rows.len(), 3);
    for (anchor, row) in rows.iter().enumerate() {
        assert_eq!(row[..3], anchors.position[anchor]);
        assert_eq!(row[3..6], [0.0; 3]);
        for component in 0..3 {
            for offset in 0..10 {
                let value = anchors.offset[(anchor * 10 + offset) * 3 + component];
                assert_eq!(row[6 + component * 10 + offset], value, "f_offset is component-major");
            }
        }
        assert_eq!(row[36..68], anchors.feature[anchor]);
        // logit(0.1) = ln(0.1 / 0.9)
        assert_eq!(row[68], (0.1f64 / 0.9).ln() as f32);
        assert_eq!(row[69..75], anchors.log_scaling[anchor]);
        assert_eq!(row[75..], [1.0, 0.0, 0.0, 0.0]);
    }
}

#[test]
fn weights_have_pytorch_names_and_shapes() {
    let folder = saved(&anchors(1, 10, 0), &init::weights(0, 10, true, 0.0));
    let bytes = std::fs::read(folder.path().join(WEIGHTS)).unwrap();
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let mut found: Vec<(String, Vec<usize>)> =
        file.tensors().iter().map(|(name, view)| (name.clone(), view.shape().to_vec())).collect();
    found.sort();
    let golden = |name: &str| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name);
        let bytes = std::fs::read(path).unwrap();
        let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let wanted =
            |name: &str| name.starts_with("mlp_") || name.starts_with("to_") || name.starts_with("context_to_");
        let tensors = file.tensors().into_iter().filter(|(name, _)| wanted(name));
        tensors.map(|(name, view)| (name, view.shape().to_vec())).collect::<Vec<_>>()
    };
    let mut expected = golden("decode.safetensors");
    expected.extend(golden("attention.safetensors"));
    expected.sort();
    assert_eq!(found, expected);
}

#[test]
fn permuted_extra_and_double_attributes_load_the_same() {
    let anchors = anchors(5, 4, 3);
    let folder = saved(&anchors, &init::weights(0, 4, false, 0.0));
    let path = folder.path().join(POINT_CLOUD);
    let (header, payload) = split(&std::fs::read(&path).unwrap());
    let (names, rows) = rows(&header, &payload);

    // Backwards, x as a double, a colour byte and a list between, another element before.
    let mut changed: Vec<String> = header[..2].to_vec();
    changed.push("comment from elsewhere".into());
    changed.extend(["element camera 2", "property int id", "element vertex 5"].map(String::from));
    let mut bytes: Vec<u8> = [1i32, 2].iter().flat_map(|id| id.to_le_bytes()).collect();
    for (i, name) in names.iter().enumerate().rev() {
        changed.push(format!("property {} {name}", if name == "x" { "double" } else { "float" }));
        if i == 20 {
            changed.push("property uchar red".into());
            changed.push("property list uchar float history".into());
        }
    }
    changed.extend(["element face 1", "property list uchar int vertex_indices", "end_header"].map(String::from));
    for row in &rows {
        for (i, value) in row.iter().enumerate().rev() {
            match names[i].as_str() {
                "x" => bytes.extend(f64::from(*value).to_le_bytes()),
                _ => bytes.extend(value.to_le_bytes()),
            }
            if i == 20 {
                bytes.extend([255, 2]);
                bytes.extend([1.5f32, f32::NAN].iter().flat_map(|v| v.to_le_bytes()));
            }
        }
    }
    bytes.extend([0]);
    write_ply(&path, &changed, &bytes);
    let loaded = files::load(folder.path()).unwrap().0;
    assert_eq!(bits(&loaded), bits(&anchors));

    let mut ascii = header.clone();
    ascii[1] = "format ascii 1.0".into();
    let text: String =
        rows.iter().map(|row| row.iter().map(f32::to_string).collect::<Vec<_>>().join(" ") + "\n").collect();
    write_ply(&path, &ascii, text.as_bytes());
    assert_eq!(bits(&files::load(folder.path()).unwrap().0), bits(&anchors));

    let mut big = header;
    big[1] = "format binary_big_endian 1.0".into();
    let swapped: Vec<u8> = payload.chunks_exact(4).flat_map(|b| [b[3], b[2], b[1], b[0]]).collect();
    write_ply(&path, &big, &swapped);
    assert_eq!(bits(&files::load(folder.path()).unwrap().0), bits(&anchors));
}

#[test]
fn damaged_and_foreign_point_clouds_are_refused() {
    let folder = saved(&anchors(6, 2, 1), &init::weights(0, 2, false, 0.0));
    let path = folder.path().join(POINT_CLOUD);
    let shown = path.display().to_string();
    let good = std::fs::read(&path).unwrap();
    let (header, payload) = split(&good);

    for attribute in ["x", "f_anchor_feat_31", "f_offset_3", "f_offset_5", "scale_5"] {
        let kept: Vec<String> =
            header.iter().filter(|line| !line.ends_with(&format!(" {attribute}"))).cloned().collect();
        write_ply(&path, &kept, &payload);
        let message = refusal(folder.path());
        assert!(message.starts_with(&format!("{shown}: no vertex attribute `{attribute}`; ")), "{message}");
    }

    write_ply(&path, &header, &payload[..payload.len() - 1]);
    assert!(refusal(folder.path()).starts_with(&format!("{shown}: cut off or damaged at vertex 5 of 6, ")));
    write_ply(&path, &header, &[payload.as_slice(), &[0; 4]].concat());
    assert_eq!(refusal(folder.path()), format!("{shown}: goes on after the last vertex that its header declares"));

    let columns = payload.len() / 4 / 6;
    let mut nan = payload.clone();
    nan[(4 * columns + 6 + 3) * 4..][..4].copy_from_slice(&f32::NAN.to_le_bytes());
    write_ply(&path, &header, &nan);
    assert_eq!(
        refusal(folder.path()),
        format!("{shown}: attribute `f_offset_3` of vertex 4 is NaN, not a finite number")
    );

    std::fs::write(&path, b"P6 not a ply").unwrap();
    assert!(refusal(folder.path()).starts_with(&format!("{shown}: not a PLY file ")));
    std::fs::write(&path, b"ply\nformat ascii 1.0\nelement face 0\nproperty int a\nend_header\n").unwrap();
    assert_eq!(refusal(folder.path()), format!("{shown}: a PLY file without vertices"));
    std::fs::remove_file(&path).unwrap();
    assert!(matches!(files::load(folder.path()), Err(Error::Io { path: missing, .. }) if missing == path));
}

#[test]
fn damaged_and_foreign_weights_are_refused() {
    let anchors = anchors(1, 3, 1);
    let folder = saved(&anchors, &init::weights(0, 3, false, 0.0));
    let path = folder.path().join(WEIGHTS);
    let shown = path.display().to_string();
    let good = std::fs::read(&path).unwrap();

    std::fs::write(&path, &good[..good.len() - 4]).unwrap();
    assert!(refusal(folder.path()).starts_with(&format!("{shown}: not a safetensors file, or cut off ")));
    let mut nan = good.clone();
    let last = nan.len() - 4;
    nan[last..].copy_from_slice(&f32::NAN.to_le_bytes());
    std::fs::write(&path, &nan).unwrap();
    let message = refusal(folder.path());
    assert!(message.starts_with(&format!("{shown}: value ")) && message.contains(" is NaN"), "{message}");

    // Weights of a model with another number of Gaussians per anchor.
    let other = saved(&self::anchors(1, 5, 1), &init::weights(0, 5, false, 0.0));
    std::fs::copy(other.path().join(WEIGHTS), &path).unwrap();
    assert_eq!(
        refusal(folder.path()),
        format!("{shown}: tensor `mlp_opacity.2.weight` is F32 [5, 32]; this model needs F32 [3, 32]")
    );

    let tensor = safetensors::tensor::TensorView::new(safetensors::Dtype::F64, vec![1], &[0; 8]).unwrap();
    std::fs::write(&path, safetensors::serialize([("step", tensor)], None).unwrap()).unwrap();
    assert_eq!(refusal(folder.path()), format!("{shown}: no tensor `mlp_opacity.0.weight`"));
}

#[test]
fn an_inconsistent_model_is_refused_and_leaves_the_old_one() {
    let (anchors, weights) = (anchors(4, 2, 1), init::weights(0, 2, false, 0.0));
    let folder = saved(&anchors, &weights);
    let mut short = anchors.clone();
    short.offset.pop();
    let mut partial = init::weights(0, 2, true, 0.0);
    partial.tensors.remove("to_out.bias");
    let mut foreign = weights.clone();
    foreign.tensors.insert("discriminator".into(), weights.tensors["mlp_cov.2.bias"].clone());
    for (anchors, weights) in
        [(&short, &weights), (&anchors, &partial), (&anchors, &foreign), (&anchors, &init::weights(0, 3, false, 0.0))]
    {
        assert!(matches!(files::save(folder.path(), anchors, weights), Err(Error::Inconsistent(_))));
    }
    let (kept, _) = files::load(folder.path()).unwrap();
    assert_eq!(bits(&kept), bits(&anchors));
    let names: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(names.len(), 2, "no temporary file is left: {names:?}");
}

#[test]
fn saving_where_a_file_stands_names_it() {
    let folder = folder();
    let path = folder.path().join("model");
    std::fs::write(&path, b"").unwrap();
    let refused = files::save(&path, &anchors(1, 1, 0), &init::weights(0, 1, false, 0.0));
    assert!(matches!(refused, Err(Error::Io { path: named, .. }) if named == path));
}

/// 500,000 anchors of 79 attributes are 158 MB. The bound is thirty times what a desktop needs for it, but well below what
/// a lookup of every value by name through a map costs.
#[test]
fn half_a_million_anchors_are_saved_and_loaded_in_seconds() {
    let anchors = anchors(500_000, 10, 9);
    let weights = init::weights(0, 10, false, 0.0);
    let start = std::time::Instant::now();
    let folder = saved(&anchors, &weights);
    let written = start.elapsed();
    let loaded = files::load(folder.path()).unwrap().0;
    let read = start.elapsed() - written;
    eprintln!("500,000 anchors: saved in {written:.2?}, loaded in {read:.2?}");
    assert!(bits(&loaded) == bits(&anchors));
    assert!(start.elapsed().as_secs() < 60);
}

#[test]
fn the_device_order_round_trips() {
    for attention in [false, true] {
        let weights = init::weights(3, 7, attention, 0.0);
        let flat = weights.decoders();
        assert_eq!(flat.len(), gscream_vk::math::decoder::Layout { offsets: 7 }.weights());
        let attention = attention.then(|| weights.attention());
        assert_eq!(Weights::from_device(7, &flat, attention.as_deref()), weights);
    }
}
