//! Golden cases of kind `rasterize`: binning, blending and its gradients, on every tiling the device can run.

use gscream_vk::gpu::{Check, Gpu, testing};
use gscream_vk::math::camera::{factors, factors_backward};
use gscream_vk::primitives::Count;
use gscream_vk::primitives::limit::Limits;
use gscream_vk::render::bin::Bin;
use gscream_vk::render::project::Projected;
use gscream_vk::render::rasterize::{self, Backward, Outputs, Picture, PictureGradient};
use gscream_vk::render::slots::Slots;
use gscream_vk::render::tiling::Tiling;

use super::support::{Case, cases};

/// Pixels in which a sample's alpha or transmittance lies within float32 rounding of its threshold, and the Gaussians
/// that touch such a pixel: there the result may legitimately flip.
///
/// Rounding: the exponent is a sum of three terms of at most q = 2 ln 255 = 11, the transmittance a product of up to
/// some hundred factors; 1e-5 relative covers both.
fn boundary(case: &Case) -> (Vec<bool>, Vec<bool>) {
    let [width, height] = case.size("size");
    let (mean, covariance) = (case.vectors::<2>("mean"), case.vectors::<4>("covariance"));
    let (depth, opacity) = (case.f32("depth"), case.f64("opacity"));
    let n = depth.len();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| depth[a].total_cmp(&depth[b]));
    let mut pixels = vec![false; (width * height) as usize];
    let mut gaussians = vec![false; n];
    for y in 0..height {
        for x in 0..width {
            let mut transmittance = 1.0;
            let mut touched = vec![];
            let mut near = false;
            for &g in &order {
                let [a, b, _, c] = covariance[g].map(f64::from);
                let det = a * c - b * b;
                let (dx, dy) = (f64::from(x) + 0.5 - f64::from(mean[g][0]), f64::from(y) + 0.5 - f64::from(mean[g][1]));
                let power = -0.5 * (c * dx * dx + a * dy * dy - 2.0 * b * dx * dy) / det;
                let alpha = (opacity[g] * power.exp()).min(0.99);
                near |= (alpha * 255.0 - 1.0).abs() < 1e-5;
                if alpha * 255.0 < 1.0 - 1e-5 {
                    continue;
                }
                touched.push(g);
                let after = transmittance * (1.0 - alpha);
                near |= (after / 1e-4 - 1.0).abs() < 1e-5;
                if after < 1e-4 {
                    break;
                }
                transmittance = after;
            }
            if near {
                pixels[(y * width + x) as usize] = true;
                touched.into_iter().for_each(|g| gaussians[g] = true);
            }
        }
    }
    (pixels, gaussians)
}

/// Compares all but the elements in the band.
fn compare(case: &Case, tensor: &str, got: &[f32], want: &[f64], band: &[bool], check: Check) {
    let width = got.len() / band.len();
    let keep = |i: usize| !band[i / width];
    let got: Vec<f32> = got.iter().enumerate().filter(|(i, _)| keep(*i)).map(|(_, v)| *v).collect();
    let want: Vec<f64> = want.iter().enumerate().filter(|(i, _)| keep(*i)).map(|(_, v)| *v).collect();
    case.compare_with(tensor, &got, &want, check);
}

fn narrow(v: [f64; 3]) -> [f32; 3] {
    v.map(|v| v as f32)
}

#[test]
fn rasterize() {
    testing::gpu_in_both_forms().for_each(|gpu| rasterize_in_one_form(&gpu));
}

fn rasterize_in_one_form(gpu: &Gpu) {
    let tilings: &[Tiling] =
        if gpu.info().subgroup_size == 8 { &[Tiling::Wide, Tiling::Narrow] } else { &[Tiling::Wide] };
    for case in cases("rasterize") {
        for &tiling in tilings {
            let size = case.size("size");
            let pixels = (size[0] * size[1]) as usize;
            let mean = gpu.upload("mean", &case.vectors::<2>("mean")).unwrap();
            let n = mean.len() as u32;
            let covariance: Vec<[f32; 3]> = case
                .vectors::<4>("covariance")
                .into_iter()
                .map(|[a, b, _, c]| narrow(factors([a, b, c].map(f64::from))))
                .collect();
            let factored = covariance.clone();
            let covariance = gpu.upload("covariance", &covariance).unwrap();
            let depth = gpu.upload("depth", &case.f32("depth")).unwrap();
            let opacity = gpu.upload("opacity", &case.f32("opacity")).unwrap();
            let color = gpu.upload("color", &case.vectors::<3>("color")).unwrap();
            let background = case.vectors::<3>("background")[0];
            let limits = Limits::new(gpu).unwrap();
            let count = gpu.upload("count", &[n]).unwrap();
            let existing = Slots::all(gpu, n).unwrap();
            let grid = tiling.grid(size);
            let pairs = n * grid[0] * grid[1];
            let bin = Bin::new(gpu, tiling, n, pairs, size).unwrap();
            let picture = Picture::new(gpu, size, pixels, Outputs::Transmittance).unwrap();
            let backward = Backward::new(gpu, tiling, n as usize, pairs as usize, Outputs::Transmittance).unwrap();
            let grad_rgb = gpu.upload("grad_rgb", &case.vectors::<3>("upstream.rgb")).unwrap();
            let grad_z = gpu.upload("grad_depth_map", &case.f32("upstream.z")).unwrap();
            let grad_t = gpu.upload("grad_transmittance", &case.f32("upstream.transmittance")).unwrap();

            let mut rec = gpu.recorder().unwrap();
            let projected = Projected {
                slots: Count::Device(&count),
                existing: &existing,
                mean: &mean,
                covariance: &covariance,
                depth: &depth,
                opacity: &opacity,
                color: &color,
            };
            let binned = bin.record(&mut rec, projected, size, &limits);
            rasterize::forward(&mut rec, tiling, projected, binned, background, &picture);
            let gradient = PictureGradient { rgb: &grad_rgb, depth: Some(&grad_z), transmittance: Some(&grad_t) };
            // What touches no tile is not written: no gradient.
            rec.zero(&backward.grad_mean);
            rec.zero(&backward.grad_covariance);
            rec.zero(&backward.grad_opacity);
            rec.zero(&backward.grad_color);
            backward.grad_depth.iter().for_each(|grad_depth| rec.zero(grad_depth));
            backward.record(&mut rec, tiling, projected, binned, &picture, gradient);
            rec.submit().unwrap().wait().unwrap();
            assert_eq!(gpu.read(limits.overflow()).unwrap(), [0]);

            let (band, touched) = boundary(&case);
            let banded = band.iter().filter(|b| **b).count();
            println!("{} {tiling:?}: {banded} of {pixels} pixels in the boundary band", case.name);
            assert!(banded * 50 <= pixels, "the band is too wide to test anything");
            // Sums of some hundred terms of at most one, each good to 1e-6 (exponential and exponent).
            let picture_check = Check { relative: 1e-5, absolute: 1e-5, band: 0.0 };
            let rgb = gpu.read(&picture.rgb).unwrap();
            compare(&case, "rgb", rgb.as_flattened(), &case.f64("rgb"), &band, picture_check);
            let (z, t) = picture.depth.as_ref().zip(picture.transmittance.as_ref()).expect("asked for");
            compare(&case, "z", &gpu.read(z).unwrap(), &case.f64("z"), &band, picture_check);
            compare(&case, "transmittance", &gpu.read(t).unwrap(), &case.f64("transmittance"), &band, picture_check);
            // Sums over up to 2,000 pixels with cancellation; 1 / (1 - alpha) <= 100 amplifies 1e-7 to 1e-5 of the sum.
            let check = Check { relative: 2e-4, absolute: 2e-5, band: 0.0 };
            let read = |b: &[[f32; 2]]| b.as_flattened().to_vec();
            let grad_mean = read(&gpu.read(&backward.grad_mean).unwrap());
            compare(&case, "grad.mean", &grad_mean, &case.f64("grad.mean"), &touched, check);
            let want: Vec<f64> =
                case.f64("grad.covariance").chunks_exact(4).flat_map(|c| [c[0], c[1] + c[2], c[3]]).collect();
            let got = gpu.read(&backward.grad_covariance).unwrap();
            let got: Vec<[f32; 3]> = got
                .iter()
                .zip(&factored)
                .map(|(g, c)| narrow(factors_backward(c.map(f64::from), g.map(f64::from))))
                .collect();
            compare(&case, "grad.covariance", got.as_flattened(), &want, &touched, check);
            let got = gpu.read(&backward.grad_opacity).unwrap();
            compare(&case, "grad.opacity", &got, &case.f64("grad.opacity"), &touched, check);
            let got = gpu.read(&backward.grad_color).unwrap();
            compare(&case, "grad.color", got.as_flattened(), &case.f64("grad.color"), &touched, check);
            let got = gpu.read(backward.grad_depth.as_ref().expect("asked for")).unwrap();
            compare(&case, "grad.depth", &got, &case.f64("grad.depth"), &touched, check);
        }
    }
}
