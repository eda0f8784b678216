//! Metrics against hand-computed numbers, an independent float64 computation and the golden photometric case.

use std::path::Path;

use gscream_vk::evaluate::fid::Inception;
use gscream_vk::evaluate::lpips::Lpips;
use gscream_vk::evaluate::{self, Error, Figures, Judge, Metrics, Report, ViewMetrics};
use image::{GrayImage, Luma, Rgb, RgbImage};
use rand::RngExt;
use rand_pcg::Pcg64;

fn noise(width: u32, height: u32, seed: u64) -> RgbImage {
    let mut generator = Pcg64::new(seed.into(), 1);
    RgbImage::from_fn(width, height, |_, _| Rgb(generator.random()))
}

fn mask(width: u32, height: u32, inside: impl Fn(u32, u32) -> bool) -> GrayImage {
    GrayImage::from_fn(width, height, |x, y| Luma([u8::from(inside(x, y))]))
}

fn unit(image: &RgbImage) -> Vec<f64> {
    image.as_raw().iter().map(|v| f64::from(*v) / 255.0).collect()
}

/// SSIM with the two-dimensional window written out, pixel by pixel and in centred moments.
fn direct_ssim(a: &[f64], b: &[f64], width: usize, height: usize) -> Vec<f64> {
    let gauss = |d: i64| (-(d * d) as f64 / 4.5).exp();
    let total: f64 = (-5..=5).flat_map(|i| (-5..=5).map(move |j| gauss(i) * gauss(j))).sum();
    let mut map = Vec::new();
    for row in 0..height as i64 {
        for column in 0..width as i64 {
            for channel in 0..3 {
                let mut samples = Vec::new();
                for dy in -5..=5 {
                    for dx in -5..=5 {
                        let (y, x) = (row + dy, column + dx);
                        let seen = (0..height as i64).contains(&y) && (0..width as i64).contains(&x);
                        let at =
                            |v: &[f64]| if seen { v[(y as usize * width + x as usize) * 3 + channel] } else { 0.0 };
                        samples.push((gauss(dy) * gauss(dx) / total, at(a), at(b)));
                    }
                }
                let expect = |f: &dyn Fn(f64, f64) -> f64| samples.iter().map(|(w, x, y)| w * f(*x, *y)).sum::<f64>();
                let (ma, mb) = (expect(&|x, _| x), expect(&|_, y| y));
                let (va, vb) = (expect(&|x, _| (x - ma).powi(2)), expect(&|_, y| (y - mb).powi(2)));
                let vab = expect(&|x, y| (x - ma) * (y - mb));
                let (c1, c2) = (1e-4, 9e-4);
                map.push((2.0 * ma * mb + c1) * (2.0 * vab + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2)));
            }
        }
    }
    map
}

/// Float64 with denominators of at least C2 = 9e-4: 121 additions in either order, each off by at most 1.1e-16.
const SSIM_TOLERANCE: f64 = 121.0 * 1.2e-16 / 9e-4 * 4.0;

fn close(a: f64, b: f64, tolerance: f64) -> bool {
    (a - b).abs() <= tolerance
}

#[test]
fn ssim_is_that_of_the_window_written_out() {
    for (width, height) in [(1, 1), (3, 2), (11, 11), (24, 7), (17, 30)] {
        let (a, b) = (noise(width, height, 1), noise(width, height, 2));
        let (width, height) = (width as usize, height as usize);
        let map = evaluate::ssim_map(&unit(&a), &unit(&b), width, height);
        for (i, (got, expected)) in map.iter().zip(direct_ssim(&unit(&a), &unit(&b), width, height)).enumerate() {
            assert!(close(*got, expected, SSIM_TOLERANCE), "{width} x {height}, {i}: {got} {expected}");
        }
    }
}

#[test]
fn ssim_is_that_of_the_golden_photometric_loss() {
    let bytes =
        std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/photometric.safetensors")).unwrap();
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let floats = |name: &str| -> Vec<f64> {
        let data = file.tensor(name).unwrap().data();
        data.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes(b.try_into().unwrap()))).collect()
    };
    let shape = file.tensor("rendered").unwrap().shape().to_vec();
    let (rendered, target, weight) = (floats("rendered"), floats("target"), floats("weight"));
    let ssim = evaluate::ssim_map(&rendered, &target, shape[1], shape[0]);
    let terms =
        (0..rendered.len()).map(|i| weight[i / 3] * (0.8 * (rendered[i] - target[i]).abs() + 0.2 * (1.0 - ssim[i])));
    let loss = terms.sum::<f64>() / rendered.len() as f64;
    let golden = f64::from_le_bytes(file.tensor("loss").unwrap().data().try_into().unwrap());
    // A mean of terms, each off by no more than an SSIM value may be, with weights up to 20.
    assert!(close(loss, golden, 20.0 * SSIM_TOLERANCE), "{loss} {golden}");
}

#[test]
fn psnr_by_hand_on_every_region() {
    // Black against black but for two pixels: 51 / 255 = 0.2 in one channel, 0.4 in three.
    let truth = RgbImage::new(4, 3);
    let mut rendered = truth.clone();
    rendered.put_pixel(1, 1, Rgb([0, 51, 0]));
    rendered.put_pixel(3, 2, Rgb([102, 102, 102]));
    let inside = mask(4, 3, |x, y| (x, y) == (1, 1) || (x, y) == (2, 2));
    let metrics = evaluate::compare(&rendered, &truth, Some(&inside)).unwrap();
    let decibel = |mse: f64| -10.0 * mse.log10();
    let square = 0.2f64 * 0.2;
    assert!(close(metrics.full.psnr, decibel((square + 3.0 * 4.0 * square) / 36.0), 1e-12));
    // The mask holds two pixels, its box 2 x 2; the brighter pixel is in neither.
    assert!(close(metrics.mask.unwrap().psnr, decibel(square / 6.0), 1e-12));
    assert!(close(metrics.bounding_box.unwrap().psnr, decibel(square / 12.0), 1e-12));
    let white = RgbImage::from_pixel(3, 3, Rgb([255; 3]));
    let psnr = evaluate::compare(&white, &RgbImage::new(3, 3), None).unwrap().full.psnr;
    assert_eq!(psnr.to_bits(), 0f64.to_bits(), "an error of the whole range is 0 dB, not -0");
}

#[test]
fn ssim_and_flip_of_a_region_are_means_of_their_maps() {
    let (rendered, truth) = (noise(30, 20, 3), noise(30, 20, 4));
    let map = direct_ssim(&unit(&rendered), &unit(&truth), 30, 20);
    let at = |x: usize, y: usize| (0..3).map(|c| map[(y * 30 + x) * 3 + c]).sum::<f64>() / 3.0;
    let mean = |pixels: &[(usize, usize)]| pixels.iter().map(|&(x, y)| at(x, y)).sum::<f64>() / pixels.len() as f64;
    let all: Vec<_> = (0..20).flat_map(|y| (0..30).map(move |x| (x, y))).collect();

    // An L: its box holds more than it does.
    let shape = |x: usize, y: usize| (4..8).contains(&x) && (2..15).contains(&y) || (4..20).contains(&x) && y == 14;
    let inside: Vec<_> = all.iter().copied().filter(|&(x, y)| shape(x, y)).collect();
    let boxed: Vec<_> = all.iter().copied().filter(|(x, y)| (4..20).contains(x) && (2..15).contains(y)).collect();
    let image = mask(30, 20, |x, y| shape(x as usize, y as usize));
    let metrics = evaluate::compare(&rendered, &truth, Some(&image)).unwrap();
    assert!(close(metrics.full.ssim, mean(&all), SSIM_TOLERANCE));
    assert!(close(metrics.mask.unwrap().ssim, mean(&inside), SSIM_TOLERANCE));
    assert!(close(metrics.bounding_box.unwrap().ssim, mean(&boxed), SSIM_TOLERANCE));

    // The mean over a partition of the image is the mean over the image, for FLIP too.
    let outside = mask(30, 20, |x, y| !shape(x as usize, y as usize));
    let rest = evaluate::compare(&rendered, &truth, Some(&outside)).unwrap();
    let part = |figure: fn(&Figures) -> f64| {
        let (n, m) = (inside.len() as f64, (all.len() - inside.len()) as f64);
        (n * figure(&metrics.mask.unwrap()) + m * figure(&rest.mask.unwrap())) / (n + m)
    };
    assert!(close(part(|f| f.ssim), metrics.full.ssim, 1e-13));
    assert!(close(part(|f| f.flip), metrics.full.flip, 1e-13));
    assert_ne!(metrics.mask.unwrap().flip, metrics.full.flip);
    assert_eq!(rest.bounding_box.unwrap(), rest.full, "the box of the outside is the whole image");
}

#[test]
fn flip_lies_where_the_difference_is_and_takes_the_photograph_as_reference() {
    // 120 columns: FLIP's filters reach less than 20 pixels at 67 pixels per degree.
    let truth = noise(120, 16, 5);
    let mut rendered = truth.clone();
    for y in 0..16 {
        for x in 0..30 {
            rendered.put_pixel(x, y, Rgb(truth.get_pixel(x, y).0.map(|v| 255 - v)));
        }
    }
    let near = evaluate::compare(&rendered, &truth, Some(&mask(120, 16, |x, _| x < 30))).unwrap();
    let far = evaluate::compare(&rendered, &truth, Some(&mask(120, 16, |x, _| x >= 60))).unwrap();
    assert!(near.mask.unwrap().flip > 0.2, "{near:?}");
    assert!(far.mask.unwrap().flip < 1e-4, "{far:?}");
    assert!((near.full.flip * 120.0 - near.mask.unwrap().flip * 30.0).abs() < 0.1 * near.full.flip * 120.0);
    let library = {
        let image = |i: &RgbImage| nv_flip::FlipImageRgb8::with_data(120, 16, i.as_raw());
        let map = nv_flip::flip(image(&truth), image(&rendered), nv_flip::DEFAULT_PIXELS_PER_DEGREE).to_vec();
        map.iter().map(|v| f64::from(*v)).sum::<f64>() / map.len() as f64
    };
    assert!(close(near.full.flip, library, 1e-12));
}

#[test]
fn identical_images_are_infinite_one_and_zero() {
    let image = noise(25, 14, 6);
    let metrics = evaluate::compare(&image, &image, Some(&mask(25, 14, |x, y| x == 24 && y == 0))).unwrap();
    for figures in [metrics.full, metrics.mask.unwrap(), metrics.bounding_box.unwrap()] {
        assert_eq!(figures.psnr, f64::INFINITY);
        assert!(close(figures.ssim, 1.0, 1e-12), "{figures:?}");
        assert_eq!(figures.flip, 0.0);
    }
    let text = serde_json::to_string(&metrics).unwrap();
    assert!(text.contains(r#""psnr":"inf""#), "{text}");
    assert_eq!(serde_json::from_str::<Metrics>(&text).unwrap().full.psnr, f64::INFINITY);
    assert!(serde_json::from_str::<Metrics>(&text.replace("inf", "lots")).is_err());
}

#[test]
fn masks_of_one_pixel_none_and_all() {
    let (rendered, truth) = (noise(19, 13, 7), noise(19, 13, 8));
    for (column, row) in [(0, 0), (18, 12), (7, 4)] {
        let one = evaluate::compare(&rendered, &truth, Some(&mask(19, 13, |x, y| (x, y) == (column, row)))).unwrap();
        let difference = |c: usize| {
            let value = |image: &RgbImage| f64::from(image.get_pixel(column, row).0[c]);
            (value(&rendered) - value(&truth)) / 255.0
        };
        let mse = (0..3).map(|c| difference(c).powi(2)).sum::<f64>() / 3.0;
        assert!(close(one.mask.unwrap().psnr, -10.0 * mse.log10(), 1e-12));
        assert_eq!(one.mask, one.bounding_box);
    }
    let none = evaluate::compare(&rendered, &truth, Some(&mask(19, 13, |_, _| false))).unwrap();
    assert_eq!((none.mask, none.bounding_box), (None, None));
    let all = evaluate::compare(&rendered, &truth, Some(&mask(19, 13, |_, _| true))).unwrap();
    assert_eq!((all.mask, all.bounding_box), (Some(all.full), Some(all.full)));
    let unmasked = evaluate::compare(&rendered, &truth, None).unwrap();
    assert_eq!(unmasked, Metrics::new(all.full));
}

#[test]
fn what_cannot_be_compared_is_refused() {
    let image = RgbImage::new(4, 3);
    let message = evaluate::compare(&image, &RgbImage::new(4, 4), None).unwrap_err().to_string();
    assert_eq!(message, "the photograph is 4 x 4, but the rendered image is 4 x 3");
    let message = evaluate::compare(&image, &image, Some(&GrayImage::new(3, 4))).unwrap_err().to_string();
    assert_eq!(message, "the mask is 3 x 4, but the rendered image is 4 x 3");
    assert!(matches!(evaluate::compare(&RgbImage::new(0, 3), &RgbImage::new(0, 3), None), Err(Error::Empty)));
}

fn figures(psnr: f64, ssim: f64, flip: f64) -> Figures {
    Figures { psnr, ssim, flip }
}

fn report() -> Report {
    let view = |name: &str, full, mask, bounding_box| ViewMetrics {
        name: name.to_owned(),
        metrics: Metrics { mask, bounding_box, ..Metrics::new(full) },
    };
    Report::new(vec![
        view("a", figures(20.0, 0.5, 0.25), Some(figures(10.0, 0.125, 0.5)), Some(figures(12.0, 0.25, 0.5))),
        view("20220819_104351", figures(30.0, 0.75, 0.125), None, None),
        view("c", figures(31.0, 1.0, 0.0), Some(figures(14.0, 0.25, 0.25)), Some(figures(f64::INFINITY, 1.0, 0.0))),
    ])
}

#[test]
fn means_are_arithmetic_and_those_of_the_mask_over_the_views_that_have_one() {
    let mean = report().mean.unwrap();
    assert_eq!((mean.views, mean.masked_views), (3, 2));
    assert_eq!(mean.metrics.full, figures(27.0, 0.75, 0.125));
    assert_eq!(mean.metrics.mask, Some(figures(12.0, 0.1875, 0.375)));
    assert_eq!(mean.metrics.bounding_box, Some(figures(f64::INFINITY, 0.625, 0.25)));
    assert_eq!(Report::new(Vec::new()).mean, None);
}

#[test]
fn the_table_is_aligned() {
    let expected = "                              full image              inside mask               mask's box
view                PSNR    SSIM    FLIP     PSNR    SSIM    FLIP     PSNR    SSIM    FLIP
a                  20.00  0.5000  0.2500    10.00  0.1250  0.5000    12.00  0.2500  0.5000
20220819_104351    30.00  0.7500  0.1250        -       -       -        -       -       -
c                  31.00  1.0000  0.0000    14.00  0.2500  0.2500      inf  1.0000  0.0000
mean               27.00  0.7500  0.1250    12.00  0.1875  0.3750      inf  0.6250  0.2500
mean over 3 views, of the mask over the 2 views that have one; mean PSNR is the mean of the views' PSNR
";
    assert_eq!(report().table(), expected);
    let unmasked = Report::new(vec![ViewMetrics { name: "x".into(), metrics: Metrics::new(figures(1.0, 0.5, 0.5)) }]);
    let expected = "                   full image
view     PSNR    SSIM    FLIP
x        1.00  0.5000  0.5000
mean     1.00  0.5000  0.5000
mean over 1 view; mean PSNR is the mean of the views' PSNR
";
    assert_eq!(unmasked.table(), expected);
}

#[test]
fn the_json_holds_the_report() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("metrics.json");
    report().write_json(&path).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    assert_eq!(serde_json::from_str::<Report>(&text).unwrap(), report());
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(json["mean"]["full"]["psnr"], 27.0);
    assert_eq!(json["mean"]["box"]["psnr"], "inf");
    assert_eq!(json["mean"]["masked_views"], 2);
    assert_eq!(json["views"][0]["mask"]["ssim"], 0.125);
    assert!(json["views"][1].get("mask").is_none(), "absent means absent");
    let refused = report().write_json(&folder.path().join("no/such/folder/metrics.json"));
    assert!(matches!(refused, Err(Error::Write { .. })));
}

// ---------------------------------------------------------------- networks

/// Float32 numbers in [0, 1) of 24 bits that follow from a tensor's name, as tests/networks/networks.py makes them.
fn uniform(name: &str, count: usize) -> impl Iterator<Item = f32> {
    let seed = name.bytes().fold(2_166_136_261u32, |seed, byte| (seed ^ u32::from(byte)).wrapping_mul(16_777_619));
    (0..count as u32).map(move |i| {
        let mut h = i.wrapping_mul(2_654_435_761).wrapping_add(seed);
        h = (h ^ (h >> 16)).wrapping_mul(0x7feb_352d);
        h = (h ^ (h >> 15)).wrapping_mul(0x846c_a68b);
        h ^= h >> 16;
        (h >> 8) as f32 * 2f32.powi(-24)
    })
}

/// A made-up tensor, likewise, as bytes.
fn tensor(name: &str, shape: &[usize]) -> Vec<u8> {
    let values = uniform(name, shape.iter().product());
    let bound = (6.0 / shape[1..].iter().product::<usize>() as f64).sqrt() as f32;
    let value = |v: f32| {
        if name.starts_with("lin") || name.ends_with("running_var") {
            v + 0.5
        } else if name.ends_with("bn.weight") {
            v * 0.25 + 1.0
        } else if shape.len() == 4 {
            (v * 2.0 - 1.0) * bound
        } else {
            (v * 2.0 - 1.0) * 0.125
        }
    };
    values.flat_map(|v| value(v).to_le_bytes()).collect()
}

/// Writes made-up tensors of these names and shapes.
fn write_weights(path: &Path, tensors: &[(String, Vec<usize>)]) {
    let bytes: Vec<Vec<u8>> = tensors.iter().map(|(name, shape)| tensor(name, shape)).collect();
    let views = tensors.iter().zip(&bytes).map(|((name, shape), bytes)| {
        (name, safetensors::tensor::TensorView::new(safetensors::Dtype::F32, shape.clone(), bytes).unwrap())
    });
    std::fs::write(path, safetensors::serialize(views, None).unwrap()).unwrap();
}

fn picture(k: u32) -> RgbImage {
    RgbImage::from_fn(75, 53, |x, y| {
        Rgb([0, 1, 2].map(|c| ((x * 7 + y * 13 + c * 50 + (x * y) % 31 * 5 + k * 37 + k * x / 3) % 256) as u8))
    })
}

/// (index, outputs, inputs, window) of the convolutions, channels of the taps.
type Topology = (&'static [(usize, usize, usize, usize)], [usize; 5]);

const VGG: Topology = (
    &[
        (0, 64, 3, 3),
        (2, 64, 64, 3),
        (5, 128, 64, 3),
        (7, 128, 128, 3),
        (10, 256, 128, 3),
        (12, 256, 256, 3),
        (14, 256, 256, 3),
        (17, 512, 256, 3),
        (19, 512, 512, 3),
        (21, 512, 512, 3),
        (24, 512, 512, 3),
        (26, 512, 512, 3),
        (28, 512, 512, 3),
    ],
    [64, 128, 256, 512, 512],
);
const ALEX: Topology = (
    &[(0, 64, 3, 11), (3, 192, 64, 5), (6, 384, 192, 3), (8, 256, 384, 3), (10, 256, 256, 3)],
    [64, 192, 384, 256, 256],
);

fn lpips_tensors((layers, taps): Topology) -> Vec<(String, Vec<usize>)> {
    let of = |&(i, outputs, inputs, window): &(usize, usize, usize, usize)| {
        [
            (format!("features.{i}.weight"), vec![outputs, inputs, window, window]),
            (format!("features.{i}.bias"), vec![outputs]),
        ]
    };
    let taps =
        taps.iter().enumerate().map(|(i, channels)| (format!("lin{i}.model.1.weight"), vec![1, *channels, 1, 1]));
    layers.iter().flat_map(of).chain(taps).collect()
}

fn stored() -> serde_json::Value {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/networks/values.json");
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

/// Float32 sums of up to 4,608 products in another order, through 13 layers: each is off by some 1e-6 of the layer's
/// size, and distances are differences of features brought to length 1.
const NETWORK_TOLERANCE: f64 = 2e-4;

#[test]
fn lpips_is_that_of_pytorch() {
    let folder = tempfile::tempdir().unwrap();
    let inside = mask(75, 53, |x, y| (20..62).contains(&x) && (10..45).contains(&y) && !(x < 30 && y < 20));
    for (name, topology) in [("vgg", VGG), ("alex", ALEX)] {
        let path = folder.path().join(name);
        write_weights(&path, &lpips_tensors(topology));
        let judge = Judge { lpips: vec![Lpips::read(&path).unwrap()], ..Judge::default() };
        let (a, b) = (picture(1), picture(2));
        let found = judge.compare(&a, &b, Some(&inside), None).unwrap().lpips.unwrap();
        let (signed, unit) = if name == "vgg" { (found.vgg, found.vgg_unit) } else { (found.alex, found.alex_unit) };
        assert_eq!(found.vgg.is_some(), name == "vgg");
        for (range, distance) in [("signed", signed.unwrap()), ("unit", unit.unwrap())] {
            let wanted = &stored()[name][range];
            for (region, value) in
                [("full", Some(distance.full)), ("mask", distance.mask), ("box", distance.bounding_box)]
            {
                let (value, wanted) = (value.unwrap(), wanted[region].as_f64().unwrap());
                assert!((value / wanted - 1.0).abs() < NETWORK_TOLERANCE, "{name} {range} {region}: {value} {wanted}");
            }
        }
        let same = judge.compare(&a, &a, None, None).unwrap().lpips.unwrap();
        let same = same.vgg.or(same.alex).unwrap();
        assert_eq!((same.full, same.mask, same.bounding_box), (0.0, None, None));
    }
    let none = Judge::default().compare(&picture(1), &picture(2), None, None).unwrap();
    assert!(none.lpips.is_none() && !serde_json::to_string(&none).unwrap().contains("lpips"), "absent, not zero");
}

#[test]
fn weights_of_other_names_or_shapes_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights.safetensors");
    let refusal = |tensors: &[(String, Vec<usize>)]| {
        write_weights(&path, tensors);
        Lpips::read(&path).err().unwrap().to_string().replace(path.to_str().unwrap(), "FILE")
    };
    let mut tensors = lpips_tensors(ALEX);
    tensors.retain(|(name, _)| name != "lin3.model.1.weight");
    let missing = refusal(&tensors);
    tensors = lpips_tensors(ALEX);
    tensors[2].1 = vec![192, 64, 3, 3];
    let mut all =
        vec![missing, refusal(&tensors), refusal(&[]), refusal(&[("features.0.weight".into(), vec![8, 3, 3, 3])])];
    std::fs::write(&path, "no weights").unwrap();
    let error =
        |error: Option<evaluate::network::Error>| error.unwrap().to_string().replace(path.to_str().unwrap(), "FILE");
    all.push(error(Lpips::read(&path).err()));
    std::fs::remove_file(&path).unwrap();
    all.push(error(Inception::read(&path).err()));
    write_weights(&path, &lpips_tensors(ALEX));
    all.push(error(Inception::read(&path).err()));
    insta::assert_snapshot!("weights_errors", all.join("\n"));
}

/// (block, name, outputs, inputs, rows, columns) of pytorch-fid's Inception.
fn inception_tensors() -> Vec<(String, Vec<usize>)> {
    let mut all: Vec<(String, [usize; 4])> = vec![];
    let mut put = |block: &str, layers: &[(&str, usize, usize, usize, usize)]| {
        for (name, outputs, inputs, rows, columns) in layers {
            let name = if block.is_empty() { (*name).to_owned() } else { format!("{block}.{name}") };
            all.push((name, [*outputs, *inputs, *rows, *columns]));
        }
    };
    put(
        "",
        &[
            ("Conv2d_1a_3x3", 32, 3, 3, 3),
            ("Conv2d_2a_3x3", 32, 32, 3, 3),
            ("Conv2d_2b_3x3", 64, 32, 3, 3),
            ("Conv2d_3b_1x1", 80, 64, 1, 1),
            ("Conv2d_4a_3x3", 192, 80, 3, 3),
        ],
    );
    for (block, n, pool) in [("Mixed_5b", 192, 32), ("Mixed_5c", 256, 64), ("Mixed_5d", 288, 64)] {
        put(
            block,
            &[
                ("branch1x1", 64, n, 1, 1),
                ("branch5x5_1", 48, n, 1, 1),
                ("branch5x5_2", 64, 48, 5, 5),
                ("branch3x3dbl_1", 64, n, 1, 1),
                ("branch3x3dbl_2", 96, 64, 3, 3),
                ("branch3x3dbl_3", 96, 96, 3, 3),
                ("branch_pool", pool, n, 1, 1),
            ],
        );
    }
    put(
        "Mixed_6a",
        &[
            ("branch3x3", 384, 288, 3, 3),
            ("branch3x3dbl_1", 64, 288, 1, 1),
            ("branch3x3dbl_2", 96, 64, 3, 3),
            ("branch3x3dbl_3", 96, 96, 3, 3),
        ],
    );
    for (block, c) in [("Mixed_6b", 128), ("Mixed_6c", 160), ("Mixed_6d", 160), ("Mixed_6e", 192)] {
        put(
            block,
            &[
                ("branch1x1", 192, 768, 1, 1),
                ("branch7x7_1", c, 768, 1, 1),
                ("branch7x7_2", c, c, 1, 7),
                ("branch7x7_3", 192, c, 7, 1),
                ("branch7x7dbl_1", c, 768, 1, 1),
                ("branch7x7dbl_2", c, c, 7, 1),
                ("branch7x7dbl_3", c, c, 1, 7),
                ("branch7x7dbl_4", c, c, 7, 1),
                ("branch7x7dbl_5", 192, c, 1, 7),
                ("branch_pool", 192, 768, 1, 1),
            ],
        );
    }
    put(
        "Mixed_7a",
        &[
            ("branch3x3_1", 192, 768, 1, 1),
            ("branch3x3_2", 320, 192, 3, 3),
            ("branch7x7x3_1", 192, 768, 1, 1),
            ("branch7x7x3_2", 192, 192, 1, 7),
            ("branch7x7x3_3", 192, 192, 7, 1),
            ("branch7x7x3_4", 192, 192, 3, 3),
        ],
    );
    for (block, n) in [("Mixed_7b", 1280), ("Mixed_7c", 2048)] {
        put(
            block,
            &[
                ("branch1x1", 320, n, 1, 1),
                ("branch3x3_1", 384, n, 1, 1),
                ("branch3x3_2a", 384, 384, 1, 3),
                ("branch3x3_2b", 384, 384, 3, 1),
                ("branch3x3dbl_1", 448, n, 1, 1),
                ("branch3x3dbl_2", 384, 448, 3, 3),
                ("branch3x3dbl_3a", 384, 384, 1, 3),
                ("branch3x3dbl_3b", 384, 384, 3, 1),
                ("branch_pool", 192, n, 1, 1),
            ],
        );
    }
    let norms = ["weight", "bias", "running_mean", "running_var"];
    all.into_iter()
        .flat_map(|(name, shape)| {
            let norm = norms.map(|what| (format!("{name}.bn.{what}"), vec![shape[0]]));
            std::iter::once((format!("{name}.conv.weight"), shape.to_vec())).chain(norm)
        })
        .collect()
}

#[test]
fn fid_is_that_of_pytorch_fid() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("inception.safetensors");
    write_weights(&path, &inception_tensors());
    let judge = Judge { inception: Some(Inception::read(&path).unwrap()), ..Judge::default() };
    let wanted = &stored()["fid"];
    let features = judge.inception.as_ref().unwrap().features(&picture(1));
    assert_eq!(features.len(), evaluate::fid::FEATURES);
    let largest = features.iter().fold(0f32, |largest, v| largest.max(v.abs()));
    for (i, wanted) in wanted["features"].as_array().unwrap().iter().enumerate() {
        let (found, wanted) = (features[64 * i], wanted.as_f64().unwrap());
        assert!((f64::from(found) - wanted).abs() < NETWORK_TOLERANCE * f64::from(largest), "{i}: {found} {wanted}");
    }
    let mut judging = judge.start();
    for k in [1, 2, 3] {
        judging.add("view", &picture(k), &picture(k + 3), None, None).unwrap();
    }
    let fid = judging.report().mean.unwrap().fid.unwrap();
    // PyTorch's root of a 2048 x 2048 matrix of rank 2 is the less exact side: it is defined up to what is added to its
    // diagonal.
    let (found, wanted) = (fid.full, wanted["distance"].as_f64().unwrap());
    assert!((found / wanted - 1.0).abs() < 1e-2, "{found} {wanted}");
    assert_eq!(fid.bounding_box, None);
}

// ---------------------------------------------------------------- regions

#[test]
fn regions_by_hand() {
    // Black against a grey that grows by column: every region has its own error.
    let truth = RgbImage::new(20, 12);
    let rendered = RgbImage::from_fn(20, 12, |x, _| Rgb([5 * x as u8; 3]));
    let inside = mask(20, 12, |x, _| x >= 10);
    let seen = mask(20, 12, |x, _| x % 2 == 0);
    let metrics = evaluate::compare_seen(&rendered, &truth, Some(&inside), Some(&seen)).unwrap();
    let psnr = |columns: &mut dyn Iterator<Item = u32>| {
        let squares: Vec<f64> = columns.map(|x| (f64::from(5 * x) / 255.0).powi(2)).collect();
        -10.0 * (squares.iter().sum::<f64>() / squares.len() as f64).log10()
    };
    // 3 pixels on either side of the edge between columns 9 and 10.
    for (figures, columns) in [
        (Some(metrics.full), 0..20),
        (metrics.mask, 10..20),
        (metrics.bounding_box, 10..20),
        (metrics.outside, 0..10),
        (metrics.rim, 7..13),
    ] {
        assert!(close(figures.unwrap().psnr, psnr(&mut columns.clone()), 1e-12), "{columns:?}: {figures:?}");
    }
    for (figures, columns) in [
        (metrics.full_seen, 0..20),
        (metrics.mask_seen, 10..20),
        (metrics.box_seen, 10..20),
        (metrics.outside_seen, 0..10),
        (metrics.rim_seen, 8..13),
    ] {
        assert!(close(figures.unwrap().psnr, psnr(&mut columns.clone().step_by(2)), 1e-12), "{columns:?}: {figures:?}");
    }
    assert_eq!(metrics.seen_share, Some(0.5));
    // The old figures are those of a comparison without a map.
    let plain = evaluate::compare(&rendered, &truth, Some(&inside)).unwrap();
    assert_eq!((plain.full, plain.mask, plain.bounding_box), (metrics.full, metrics.mask, metrics.bounding_box));
    assert_eq!((plain.outside, plain.rim, plain.outside_seen), (metrics.outside, metrics.rim, None));
    // An empty mask: outside is everywhere, and there is no edge. Nothing seen: no figures.
    let none = evaluate::compare_seen(&rendered, &truth, Some(&GrayImage::new(20, 12)), Some(&GrayImage::new(20, 12)));
    let none = none.unwrap();
    assert_eq!((none.outside, none.rim, none.full_seen, none.seen_share), (Some(none.full), None, None, Some(0.0)));
    let text = serde_json::to_value(metrics).unwrap();
    for key in
        ["full", "mask", "box", "outside", "rim", "full_seen", "mask_seen", "box_seen", "outside_seen", "rim_seen"]
    {
        assert!(text[key]["psnr"].is_f64(), "{key}");
    }
    let message = evaluate::compare_seen(&rendered, &truth, None, Some(&GrayImage::new(3, 4))).unwrap_err().to_string();
    assert_eq!(message, "the map of seen pixels is 3 x 4, but the rendered image is 20 x 12");
}

#[test]
fn the_table_has_a_block_by_region_where_there_are_more_than_three() {
    let (rendered, truth) = (noise(40, 30, 1), noise(40, 30, 2));
    let inside = mask(40, 30, |x, y| (10..20).contains(&x) && (10..20).contains(&y));
    let seen = mask(40, 30, |x, _| x < 30);
    let judge = Judge { protocol: evaluate::Protocol::Spinnerf, ..Judge::default() };
    let mut judging = judge.start();
    let metrics = judging.add("a", &rendered, &truth, Some(&inside), Some(&seen)).unwrap();
    metrics.geometry = Some(evaluate::Geometry { relative_error: Some(0.0123), completeness: 0.875 });
    let residue = |name: &str, residue| evaluate::Residue { name: name.into(), residue };
    let report = judging.report().with_residues(vec![residue("x", 0.25), residue("y", 0.75)]);
    insta::assert_snapshot!("table_by_region", report.table());
    assert_eq!(report.mean.unwrap().residue, Some(0.5));
}

/// A tenth of 10 pixels on every side, within the picture.
#[test]
fn a_protocols_box_grows_by_its_margin() {
    let (rendered, truth) = (noise(40, 30, 1), noise(40, 30, 2));
    let inside = mask(40, 30, |x, y| (10..20).contains(&x) && y < 10);
    let grown = mask(40, 30, |x, y| (9..21).contains(&x) && y < 11);
    let of = |protocol, mask: &GrayImage| {
        let judge = Judge { protocol, ..Judge::default() };
        judge.compare(&rendered, &truth, Some(mask), None).unwrap()
    };
    let (plain, spin) = (of(evaluate::Protocol::Plain, &inside), of(evaluate::Protocol::Spinnerf, &inside));
    assert_eq!((plain.full, plain.mask), (spin.full, spin.mask));
    assert_eq!(spin.bounding_box, of(evaluate::Protocol::Plain, &grown).mask);
    assert_eq!(of(evaluate::Protocol::Mvip, &inside), plain);
    let departs = evaluate::Protocol::Gscream.departs([252, 142]).unwrap();
    assert!(departs.contains("252 x 142") && departs.contains("1008 x 567"), "{departs}");
    assert_eq!(
        (evaluate::Protocol::Gscream.departs([1008, 567]), evaluate::Protocol::Plain.departs([5, 5])),
        (None, None)
    );
}
