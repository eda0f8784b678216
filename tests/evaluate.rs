//! Metrics against hand-computed numbers, an independent float64 computation and the golden photometric case.

use std::path::Path;

use gscream_vk::evaluate::{self, Error, Figures, Metrics, Report, ViewMetrics};
use image::{GrayImage, Luma, Rgb, Rgb32FImage, RgbImage};
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
    // 20 dB is a tenth of the range everywhere.
    let (zero, tenth) = (Rgb32FImage::new(5, 5), Rgb32FImage::from_pixel(5, 5, Rgb([0.1; 3])));
    let psnr = evaluate::compare_float(&tenth, &zero, None).unwrap().full.psnr;
    // 0.1 is rounded to float32: relative error 2^-25 at most, 20 / ln(10) times that in dB.
    assert!(close(psnr, 20.0, 8.7 * 3e-8), "{psnr}");
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
    assert_eq!(unmasked, Metrics { full: all.full, mask: None, bounding_box: None });
}

#[test]
fn float_images_agree_with_their_bytes() {
    let (rendered, truth) = (noise(20, 12, 9), noise(20, 12, 10));
    let float = |image: &RgbImage| {
        let values = image.as_raw().iter().map(|v| f32::from(*v) / 255.0).collect();
        Rgb32FImage::from_raw(20, 12, values).unwrap()
    };
    let bytes = evaluate::compare(&rendered, &truth, None).unwrap().full;
    let floats = evaluate::compare_float(&float(&rendered), &float(&truth), None).unwrap().full;
    // Values differ by half a unit in the last place of float32, 3e-8; a squared error by twice that, and MSE is above 0.1.
    assert!(close(bytes.psnr, floats.psnr, 4.4 * 2.0 * 3e-8 / 0.1));
    // Moments differ by 1.2e-7 and the denominators of noise are above 0.05.
    assert!(close(bytes.ssim, floats.ssim, 4.0 * 1.2e-7 / 0.05));
    assert_eq!(bytes.flip, floats.flip);
}

#[test]
fn what_cannot_be_compared_is_refused() {
    let image = RgbImage::new(4, 3);
    let message = evaluate::compare(&image, &RgbImage::new(4, 4), None).unwrap_err().to_string();
    assert_eq!(message, "the photograph is 4 x 4, but the rendered image is 4 x 3");
    let message = evaluate::compare(&image, &image, Some(&GrayImage::new(3, 4))).unwrap_err().to_string();
    assert_eq!(message, "the mask is 3 x 4, but the rendered image is 4 x 3");
    assert!(matches!(evaluate::compare(&RgbImage::new(0, 3), &RgbImage::new(0, 3), None), Err(Error::Empty)));
    let mut nan = Rgb32FImage::new(4, 3);
    nan.put_pixel(2, 1, Rgb([0.0, f32::NAN, 0.0]));
    let message = evaluate::compare_float(&nan, &Rgb32FImage::new(4, 3), None).unwrap_err().to_string();
    assert_eq!(message, "pixel (2, 1) of the rendered image is not finite");
}

fn figures(psnr: f64, ssim: f64, flip: f64) -> Figures {
    Figures { psnr, ssim, flip }
}

fn report() -> Report {
    let view = |name: &str, full, mask, bounding_box| ViewMetrics {
        name: name.to_owned(),
        metrics: Metrics { full, mask, bounding_box },
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
    let unmasked = Report::new(vec![ViewMetrics {
        name: "x".into(),
        metrics: Metrics { full: figures(1.0, 0.5, 0.5), mask: None, bounding_box: None },
    }]);
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
