//! Pinhole camera with COLMAP's OPENCV lens; EWA projection of a Gaussian and its gradient.
//!
//! World to camera is `p_camera = R p + t`; x right, y down, z forward. The covariance follows Zwicker et al. 2001
//! ("EWA splatting"), `J R Sigma R^T J^T + 0.3 I`, with the lens in the Jacobian `J`.

/// Added to the diagonal of a projected covariance, px^2: the low-pass of 3D Gaussian Splatting.
pub const DILATION: f64 = 0.3;

pub use crate::scene::Camera;

impl Camera {
    /// Lowest x, y and highest x, y (normalised, undistorted) of the point at which the Jacobian is taken: the image
    /// and 30 % of half the field of view on each side.
    pub fn limits(&self) -> [f32; 4] {
        let axis = |i: usize| {
            let [size, focal, center] =
                [f64::from(self.size[i]), f64::from(self.focal[i]), f64::from(self.principal[i])];
            let margin = 0.3 * size / (2.0 * focal);
            ((-center / focal - margin) as f32, ((size - center) / focal + margin) as f32)
        };
        let ((x0, x1), (y0, y1)) = (axis(0), axis(1));
        [x0, y0, x1, y1]
    }

    /// Squared normalised radius at which the radial polynomial `r (1 + k1 r^2 + k2 r^4)` stops growing: farther
    /// points would be folded back into the picture. Infinite for a polynomial that always grows. The tangential
    /// terms, far smaller, are left out.
    pub fn max_radius2(&self) -> f32 {
        // 1 + 3 k1 u + 5 k2 u^2 = 0 for u = r^2, in the form that has no division by k2.
        let [k1, k2] = [f64::from(self.distortion[0]), f64::from(self.distortion[1])];
        let discriminant = 9.0 * k1 * k1 - 20.0 * k2;
        if discriminant < 0.0 {
            return f32::INFINITY;
        }
        let root = discriminant.sqrt();
        let roots = [2.0 / (-3.0 * k1 + root), 2.0 / (-3.0 * k1 - root)];
        // 2 / 0 is infinite or, for a polynomial without distortion, infinite on both sides: as it should be.
        roots.into_iter().filter(|&u| u > 0.0).fold(f64::INFINITY, f64::min) as f32
    }
}

/// A [`Camera`] as the kernels see it, in float64.
#[derive(Clone, Copy, Debug)]
pub struct Lens {
    /// World to camera, rows.
    pub rotation: [[f64; 3]; 3],
    /// World to camera.
    pub translation: [f64; 3],
    /// px.
    pub focal: [f64; 2],
    /// px.
    pub principal: [f64; 2],
    /// k1 k2 p1 p2.
    pub distortion: [f64; 4],
    /// As [`Camera::limits`].
    pub limits: [f64; 4],
    /// Depths are larger.
    pub near: f32,
    /// As [`Camera::max_radius2`].
    pub max_radius2: f32,
}

impl Lens {
    /// The camera with a near plane.
    pub fn new(camera: &Camera, near: f32) -> Self {
        Self {
            rotation: camera.rotation.map(|row| row.map(f64::from)),
            translation: camera.translation.map(f64::from),
            focal: camera.focal.map(f64::from),
            principal: camera.principal.map(f64::from),
            distortion: camera.distortion.map(f64::from),
            limits: camera.limits().map(f64::from),
            near,
            max_radius2: camera.max_radius2(),
        }
    }

    /// `R p + t`.
    pub fn to_camera(&self, p: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|i| dot(self.rotation[i], p) + self.translation[i])
    }

    /// `R p + t` in the kernels' float32 operations, for discrete decisions.
    pub fn to_camera_f32(&self, p: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|i| {
            let r = self.rotation[i].map(|v| v as f32);
            ((r[0] * p[0] + r[1] * p[1]) + r[2] * p[2]) + self.translation[i] as f32
        })
    }

    /// In front of the near plane and inside the lens's growing part; `p` from [`Lens::to_camera_f32`].
    pub fn in_front(&self, p: [f32; 3]) -> bool {
        let folded = p[0] * p[0] + p[1] * p[1] > self.max_radius2 * (p[2] * p[2]);
        p[2] > self.near && !folded
    }

    /// The limit at which each axis is clamped, if it is; `p` from [`Lens::to_camera_f32`].
    pub fn bounds(&self, p: [f32; 3]) -> [Option<f64>; 2] {
        std::array::from_fn(|i| {
            if p[i] > self.limits[i + 2] as f32 * p[2] {
                Some(self.limits[i + 2])
            } else if p[i] < self.limits[i] as f32 * p[2] {
                Some(self.limits[i])
            } else {
                None
            }
        })
    }

    /// COLMAP's OPENCV model on normalised coordinates.
    pub fn distort(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [k1, k2, p1, p2] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + k1 * r2 + k2 * r2 * r2;
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
        ]
    }

    /// Its derivative: xx, xy = yx, yy.
    pub fn distort_jacobian(&self, [x, y]: [f64; 2]) -> [f64; 3] {
        let [k1, k2, p1, p2] = self.distortion;
        let r2 = x * x + y * y;
        let (radial, slope) = (1.0 + k1 * r2 + k2 * r2 * r2, 2.0 * (k1 + 2.0 * k2 * r2));
        [
            radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
            radial + y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y,
        ]
    }

    /// Gradient to the coordinates through [`Lens::distort_jacobian`].
    pub fn distort_jacobian_backward(&self, [x, y]: [f64; 2], grad: [f64; 3]) -> [f64; 2] {
        let [k1, k2, p1, p2] = self.distortion;
        let (slope, k) = (2.0 * (k1 + 2.0 * k2 * (x * x + y * y)), 8.0 * k2);
        let xxx = 3.0 * x * slope + k * x * x * x + 6.0 * p2;
        let xxy = y * slope + k * x * x * y + 2.0 * p1;
        let xyy = x * slope + k * x * y * y + 2.0 * p2;
        let yyy = 3.0 * y * slope + k * y * y * y + 6.0 * p1;
        [grad[0] * xxx + grad[1] * xxy + grad[2] * xyy, grad[0] * xxy + grad[1] * xyy + grad[2] * yyy]
    }

    /// Rows of d pixel / d camera point at clamped normalised coordinates.
    fn jacobian(&self, at: [f64; 2], z: f64) -> [[f64; 3]; 2] {
        let [a, b, d] = self.distort_jacobian(at);
        let row = |f: f64, j: [f64; 2]| [f * j[0] / z, f * j[1] / z, -f * (j[0] * at[0] + j[1] * at[1]) / z];
        [row(self.focal[0], [a, b]), row(self.focal[1], [b, d])]
    }

    /// A row vector in camera coordinates times R.
    fn world_row(&self, v: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|i| (0..3).map(|k| v[k] * self.rotation[k][i]).sum())
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// A Gaussian on the picture.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Splat {
    /// px.
    pub mean: [f64; 2],
    /// xx, xy, yy in px^2, [`DILATION`] included.
    pub covariance: [f64; 3],
    /// Camera z.
    pub depth: f64,
}

/// A Gaussian's gradients.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GaussianGradient {
    /// World.
    pub position: [f64; 3],
    /// Of the standard deviations.
    pub scale: [f64; 3],
    /// Of the quaternion as given.
    pub rotation: [f64; 4],
}

/// Rows of the rotation matrix of quaternion (w, x, y, z), not normalised here.
pub fn rotation_matrix([w, x, y, z]: [f64; 4]) -> [[f64; 3]; 3] {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// Gradient to the quaternion through [`rotation_matrix`].
pub fn rotation_matrix_backward([w, x, y, z]: [f64; 4], g: [[f64; 3]; 3]) -> [f64; 4] {
    let (yz, zx, xy) = (g[2][1] - g[1][2], g[0][2] - g[2][0], g[1][0] - g[0][1]);
    let (sxy, sxz, syz) = (g[0][1] + g[1][0], g[0][2] + g[2][0], g[1][2] + g[2][1]);
    [
        2.0 * (x * yz + y * zx + z * xy),
        2.0 * (w * yz + y * sxy + z * sxz - 2.0 * x * (g[1][1] + g[2][2])),
        2.0 * (w * zx + x * sxy + z * syz - 2.0 * y * (g[0][0] + g[2][2])),
        2.0 * (w * xy + x * sxz + y * syz - 2.0 * z * (g[0][0] + g[1][1])),
    ]
}

/// EWA projection. `bounds` are the clamped coordinates of the point at which the Jacobian is taken.
pub fn project(
    lens: &Lens,
    position: [f64; 3],
    scale: [f64; 3],
    rotation: [f64; 4],
    bounds: [Option<f64>; 2],
) -> Splat {
    let p = lens.to_camera(position);
    let xy = [p[0] / p[2], p[1] / p[2]];
    let pixel = lens.distort(xy);
    let at = [bounds[0].unwrap_or(xy[0]), bounds[1].unwrap_or(xy[1])];
    let q = rotation_matrix(rotation);
    let u = lens.jacobian(at, p[2]).map(|row| axes(lens.world_row(row), &q, scale));
    Splat {
        mean: std::array::from_fn(|i| pixel[i] * lens.focal[i] + lens.principal[i]),
        covariance: [dot(u[0], u[0]) + DILATION, dot(u[0], u[1]), dot(u[1], u[1]) + DILATION],
        depth: p[2],
    }
}

/// Three standard deviations of the longer axis of a covariance xx xy yy.
pub fn three_sigma([xx, xy, yy]: [f64; 3]) -> f64 {
    3.0 * (0.5 * (xx + yy) + (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt()).sqrt()
}

/// `t Q diag(s)`.
fn axes(t: [f64; 3], q: &[[f64; 3]; 3], s: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| (0..3).map(|i| t[i] * q[i][k]).sum::<f64>() * s[k])
}

/// Gradient of [`project`]; `grad.covariance[1]` is that of both off-diagonal entries together.
pub fn project_backward(
    lens: &Lens,
    position: [f64; 3],
    scale: [f64; 3],
    rotation: [f64; 4],
    bounds: [Option<f64>; 2],
    grad: Splat,
) -> GaussianGradient {
    let p = lens.to_camera(position);
    let z = p[2];
    let xy = [p[0] / z, p[1] / z];
    let at = [bounds[0].unwrap_or(xy[0]), bounds[1].unwrap_or(xy[1])];
    let q = rotation_matrix(rotation);
    let rows = lens.jacobian(at, z);
    let t = rows.map(|row| lens.world_row(row));
    let u = t.map(|row| axes(row, &q, scale));
    let [gxx, gxy, gyy] = grad.covariance;
    let gu: [[f64; 3]; 2] = [
        std::array::from_fn(|k| 2.0 * gxx * u[0][k] + gxy * u[1][k]),
        std::array::from_fn(|k| gxy * u[0][k] + 2.0 * gyy * u[1][k]),
    ];
    // M = Q diag(s), u = t M.
    let grad_m: [[f64; 3]; 3] =
        std::array::from_fn(|i| std::array::from_fn(|k| t[0][i] * gu[0][k] + t[1][i] * gu[1][k]));
    let grad_scale = std::array::from_fn(|k| (0..3).map(|i| grad_m[i][k] * q[i][k]).sum());
    let grad_q = grad_m.map(|row| std::array::from_fn(|k| row[k] * scale[k]));
    let grad_rows: [[f64; 3]; 2] = gu.map(|g| {
        let grad_t: [f64; 3] = std::array::from_fn(|i| (0..3).map(|k| g[k] * scale[k] * q[i][k]).sum());
        std::array::from_fn(|i| dot(lens.rotation[i], grad_t))
    });
    let d = lens.distort_jacobian(at);
    let d = [[d[0], d[1]], [d[1], d[2]]];
    let mut grad_at = [0.0; 2];
    let mut grad_d = [[0.0; 2]; 2];
    let mut grad_z = grad.depth;
    for i in 0..2 {
        let e = grad_rows[i].map(|g| g * lens.focal[i] / z);
        for j in 0..2 {
            grad_d[i][j] = e[j] - e[2] * at[j];
            grad_at[j] -= e[2] * d[i][j];
        }
        grad_z -= dot(grad_rows[i], rows[i]) / z;
    }
    let through = lens.distort_jacobian_backward(at, [grad_d[0][0], grad_d[0][1] + grad_d[1][0], grad_d[1][1]]);
    let m = lens.distort_jacobian(xy);
    let gm = [grad.mean[0] * lens.focal[0], grad.mean[1] * lens.focal[1]];
    let mut grad_xy = [m[0] * gm[0] + m[1] * gm[1], m[1] * gm[0] + m[2] * gm[1]];
    for i in 0..2 {
        if bounds[i].is_none() {
            grad_xy[i] += grad_at[i] + through[i];
        }
    }
    let grad_p = [grad_xy[0] / z, grad_xy[1] / z, grad_z - (grad_xy[0] * xy[0] + grad_xy[1] * xy[1]) / z];
    GaussianGradient {
        position: lens.world_row(grad_p),
        scale: grad_scale,
        rotation: rotation_matrix_backward(rotation, grad_q),
    }
}
