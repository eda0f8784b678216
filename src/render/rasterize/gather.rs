//! A Gaussian's gradients: the sums over its pairs.

use crate::gpu::kernels::render::rasterize_gather;
use crate::gpu::{Check, Reference};

impl Reference for rasterize_gather::Kernel {
    fn reference(mut host: rasterize_gather::Host<'_>, (): (), (): ()) {
        let drawn = host.drawn_count[0] as usize;
        let fits = host.pair_count[0] > 0;
        let marked = |p: usize| host.marks.is_none_or(|marks| marks[p / 32] >> (p % 32) & 1 == 1);
        for s in host.drawn[..drawn].iter().map(|&slot| slot as usize) {
            let first = host.first_pair[s] as usize;
            let end = first + if fits { host.tiles[s] as usize } else { 0 };
            let pairs: Vec<usize> = (first..end).filter(|p| marked(*p)).collect();
            let sum = |f: &dyn Fn(usize) -> f32| pairs.iter().map(|p| f64::from(f(*p))).sum::<f64>();
            let g: [f64; 3] = std::array::from_fn(|c| sum(&|p| host.pair_conic[p][c]));
            let [a, _, b] = host.conic[s].map(f64::from);
            host.grad_mean[s] = std::array::from_fn(|c| sum(&|p| host.pair_mean[p][c]) as f32);
            host.grad_covariance[s] = [(-a * a * g[0]) as f32, g[1] as f32, (-b * b * g[2]) as f32];
            host.grad_opacity[s] = sum(&|p| host.pair_opacity[p]) as f32;
            host.grad_color[s] = std::array::from_fn(|c| sum(&|p| host.pair_color[p][c]) as f32);
            if let (Some(grad_depth), Some(pair_depth)) = (&mut host.grad_depth, host.pair_depth) {
                grad_depth[s] = sum(&|p| pair_depth[p]) as f32;
            }
        }
    }
    /// A running sum over a Gaussian's tiles whose terms cancel, relative to the tensor's largest element.
    fn check(_: &'static str) -> Check {
        Check { relative: 1e-4, absolute: 1e-5, band: 0.0 }
    }
}
