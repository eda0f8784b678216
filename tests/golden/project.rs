//! Golden cases of kind `project`.

use gscream_vk::gpu::kernels::render::{project, project_backward};
use gscream_vk::gpu::{Check, testing};
use gscream_vk::math::camera::{Camera, entries, entries_backward};
use gscream_vk::render::project as stage;

use crate::support::{Case, cases};

pub fn camera(case: &Case, prefix: &str) -> Camera {
    let r = case.vectors::<3>(&format!("{prefix}.R"));
    let i = case.f32(&format!("{prefix}.intrinsics"));
    let t = case.vectors::<3>(&format!("{prefix}.t"));
    Camera {
        rotation: [r[0], r[1], r[2]],
        translation: t[0].map(f64::from),
        focal: [i[0], i[1]],
        principal: [i[2], i[3]],
        distortion: [i[4], i[5], i[6], i[7]],
        size: case.size(&format!("{prefix}.size")),
    }
}

/// xx, xy (or the sum of both off-diagonals), yy of flat 2x2 matrices.
fn symmetric(flat: &[f64], sum: bool) -> Vec<f64> {
    flat.chunks_exact(4).flat_map(|m| [m[0], if sum { m[1] + m[2] } else { m[1] }, m[3]]).collect()
}

fn narrow(v: [f64; 3]) -> [f32; 3] {
    v.map(|v| v as f32)
}

#[test]
fn project() {
    let gpu = testing::gpu();
    for case in cases("project") {
        let (camera, n) = (camera(&case, "camera"), case.shape("position")[0]);
        let center = camera.center();
        let arrays = project::Arrays {
            count: vec![n as u32],
            list: (0..n as u32).collect(),
            position: case
                .vectors::<3>("position")
                .into_iter()
                .map(|p| std::array::from_fn(|i| (f64::from(p[i]) - center[i]) as f32))
                .collect(),
            scale: case.vectors("scale"),
            rotation: case.vectors("rotation"),
            mean: vec![[testing::UNWRITTEN; 2]; n],
            covariance: vec![[testing::UNWRITTEN; 3]; n],
            depth: vec![testing::UNWRITTEN; n],
        };
        // The oracle has no near plane (its points are all in front of the camera) and lets the lens fold back.
        let push = project::Push { max_radius2: f32::INFINITY, ..stage::push(&camera, 0.0) };
        let forward = testing::run_once(project::Kernel, &gpu, &arrays, push, n);
        let check = |binding| <project::Kernel as gscream_vk::gpu::Reference>::check(binding);
        let backward_check = |binding| <project_backward::Kernel as gscream_vk::gpu::Reference>::check(binding);
        case.compare("mean", forward.mean.as_flattened(), check("mean"));
        let covariance: Vec<f32> = forward.covariance.iter().flat_map(|c| narrow(entries(c.map(f64::from)))).collect();
        case.compare_with("covariance", &covariance, &symmetric(&case.f64("covariance"), false), check("covariance"));
        case.compare("depth", &forward.depth, check("depth"));
        let upstream = symmetric(&case.f64("upstream.covariance"), true);
        let arrays = project_backward::Arrays {
            count: arrays.count,
            list: arrays.list,
            position: arrays.position,
            scale: arrays.scale,
            rotation: arrays.rotation,
            grad_mean: case.vectors("upstream.mean"),
            grad_covariance: upstream
                .chunks_exact(3)
                .zip(&forward.covariance)
                .map(|(g, c)| narrow(entries_backward(c.map(f64::from), [g[0], g[1], g[2]])))
                .collect(),
            grad_depth: Some(case.f32("upstream.depth")),
            grad_position: vec![[testing::UNWRITTEN; 3]; n],
            grad_scale: vec![[testing::UNWRITTEN; 3]; n],
            grad_rotation: vec![[testing::UNWRITTEN; 4]; n],
        };
        let push = stage::push_backward(&camera, 0.0);
        let got = testing::run_once(project_backward::Kernel, &gpu, &arrays, push, n);
        let compare = |tensor: &'static str, got: &[f32]| {
            let Check { relative, absolute, band } = backward_check(tensor);
            // The sum of two float32 upstream entries was rounded once more.
            let check = Check { relative: relative + 6e-8, absolute: absolute + 6e-8, band };
            case.compare(&tensor.replace("grad_", "grad."), got, check);
        };
        compare("grad_position", got.grad_position.as_flattened());
        compare("grad_scale", got.grad_scale.as_flattened());
        compare("grad_rotation", got.grad_rotation.as_flattened());
    }
}
