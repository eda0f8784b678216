//! Pinhole camera with COLMAP's OPENCV lens; EWA projection of a Gaussian and its gradient.
//!
//! World to camera is `p_camera = R (p - c)`; x right, y down, z forward. The covariance follows Zwicker et al. 2001
//! ("EWA splatting"), `C = J R Sigma R^T J^T + 0.3 I`, with the lens in the Jacobian `J`.
//!
//! It is kept factored, as (N, k, V): V = yy, k = xy / yy, N = det C / yy, so that
//! `d^T C^-1 d = (dx - k dy)^2 / N + dy^2 / V`. With the rows u0, u1 of `U = J R Q S`, `det C = |u0 x u1|^2 +
//! 0.3 (|u0|^2 + |u1|^2) + 0.09` (Cauchy and Binet), and the components of `u0 x u1` are those of `m0 x m1` times two
//! of the three scales (m0, m1 the rows of `J R Q`): sums of squares without cancellation, whatever the axes' ratios.

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
            focal: camera.focal.map(f64::from),
            principal: camera.principal.map(f64::from),
            distortion: camera.distortion.map(f64::from),
            limits: camera.limits().map(f64::from),
            near,
            max_radius2: camera.max_radius2(),
        }
    }

    /// `R p` of a point seen from the camera's centre.
    pub fn to_camera(&self, p: [f64; 3]) -> [f64; 3] {
        self.rotation.map(|row| dot(row, p))
    }

    /// `R p` in the kernels' float32 operations, for discrete decisions.
    pub fn to_camera_f32(&self, p: [f32; 3]) -> [f32; 3] {
        self.rotation.map(|row| {
            let r = row.map(|v| v as f32);
            (r[0] * p[0] + r[1] * p[1]) + r[2] * p[2]
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

/// A point seen from the camera's centre, given as its rounded value and the rest, in the kernels' float32 operations.
pub fn from_center(p: [f32; 3], [high, low]: [[f32; 3]; 2]) -> [f32; 3] {
    std::array::from_fn(|i| (p[i] - high[i]) - low[i])
}

/// A float64 vector as its rounded value and the (rounded) rest.
pub fn split(v: [f64; 3]) -> [[f32; 3]; 2] {
    let high = v.map(|v| v as f32);
    [high, std::array::from_fn(|i| (v[i] - f64::from(high[i])) as f32)]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// A Gaussian on the picture.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Splat {
    /// px.
    pub mean: [f64; 2],
    /// Factored, [`DILATION`] included: variance of x given y in px^2, slope of x on y, variance of y in px^2.
    pub covariance: [f64; 3],
    /// Camera z.
    pub depth: f64,
}

/// A factored covariance's entries xx, xy, yy.
pub fn entries([narrow, slope, variance]: [f64; 3]) -> [f64; 3] {
    [narrow + slope * slope * variance, slope * variance, variance]
}

/// The factors (N, k, V) of a covariance with the entries xx, xy, yy.
pub fn factors([xx, xy, yy]: [f64; 3]) -> [f64; 3] {
    [xx - xy * xy / yy, xy / yy, yy]
}

/// Gradient to the factors, given those of the entries xx, xy (both off-diagonal ones together), yy.
pub fn entries_backward([_, slope, variance]: [f64; 3], [gxx, gxy, gyy]: [f64; 3]) -> [f64; 3] {
    [gxx, 2.0 * slope * variance * gxx + variance * gxy, slope * slope * gxx + slope * gxy + gyy]
}

/// Gradient to the entries xx, xy (both together), yy, given those of the [`factors`].
pub fn factors_backward([_, slope, variance]: [f64; 3], [gn, gk, gv]: [f64; 3]) -> [f64; 3] {
    [gn, -2.0 * slope * gn + gk / variance, slope * slope * gn - slope * gk / variance + gv]
}

/// Largest standard deviation of a Gaussian on the picture and largest coordinate of its mean, px (2^60): there squares
/// and quotients in float32 are finite. What is larger is absent.
pub const MAX_DEVIATION: f64 = (1u64 << 60) as f64;

impl Splat {
    /// Within [`MAX_DEVIATION`], and all a number.
    pub fn representable(&self) -> bool {
        let [xx, _, yy] = entries(self.covariance);
        let most = MAX_DEVIATION * MAX_DEVIATION;
        self.mean.iter().all(|m| m.abs() <= MAX_DEVIATION)
            && xx <= most
            && yy <= most
            && self.covariance[1].abs() <= most
            && self.depth <= most
    }
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

/// A Gaussian's axes on the picture.
struct Axes {
    /// Rows of `J R Q`.
    m: [[f64; 3]; 2],
    /// Rows of `J R Q S`.
    u: [[f64; 3]; 2],
    /// `m0 x m1`.
    n: [f64; 3],
    variance: f64,
    slope: f64,
}

impl Axes {
    /// From the rows of `J R`.
    fn new(t: [[f64; 3]; 2], q: &[[f64; 3]; 3], s: [f64; 3]) -> Self {
        let m: [[f64; 3]; 2] = t.map(|t| std::array::from_fn(|k| (0..3).map(|i| t[i] * q[i][k]).sum()));
        let u = m.map(|m| std::array::from_fn(|k| m[k] * s[k]));
        let variance = dot(u[1], u[1]) + DILATION;
        Self { m, u, n: cross(m[0], m[1]), variance, slope: dot(u[0], u[1]) / variance }
    }

    /// Variance of x given y.
    fn narrow(&self, s: [f64; 3]) -> f64 {
        let deviation = self.variance.sqrt();
        let minors: [f64; 3] = std::array::from_fn(|i| s[(i + 1) % 3] * s[(i + 2) % 3] * self.n[i] / deviation);
        DILATION + dot(minors, minors) + DILATION * dot(self.u[0], self.u[0]) / self.variance
    }

    /// `m0 - k m1 = (0.3 m0 + (s^2 m1) x n) / V`, without the cancellation.
    fn residual(&self, s: [f64; 3]) -> [f64; 3] {
        let turned = cross(std::array::from_fn(|i| s[i] * (self.u[1][i] / self.variance)), self.n);
        std::array::from_fn(|i| DILATION / self.variance * self.m[0][i] + turned[i])
    }
}

/// EWA projection of a Gaussian seen from the camera's centre. `bounds` are the clamped coordinates of the point at
/// which the Jacobian is taken.
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
    let axes = Axes::new(lens.jacobian(at, p[2]).map(|row| lens.world_row(row)), &q, scale);
    Splat {
        mean: std::array::from_fn(|i| pixel[i] * lens.focal[i] + lens.principal[i]),
        covariance: [axes.narrow(scale), axes.slope, axes.variance],
        depth: p[2],
    }
}

/// Three standard deviations of the longer axis of a covariance xx xy yy.
pub fn three_sigma([xx, xy, yy]: [f64; 3]) -> f64 {
    3.0 * (0.5 * (xx + yy) + (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt()).sqrt()
}

/// Gradient of [`project`]; `grad.covariance` is that of the factors.
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
    let t = lens.jacobian(at, z).map(|row| lens.world_row(row));
    let axes = Axes::new(t, &q, scale);
    let ([_, m1], [_, u1]) = (axes.m, axes.u);
    // With r = u0 - k u1 = s h: dN = 2 r (du0 - k du1), V dk = u1 du0 + (r - k u1) du1.
    let h = axes.residual(scale);
    let r: [f64; 3] = std::array::from_fn(|k| scale[k] * h[k]);
    let [g_narrow, g_slope, g_variance] = [grad.covariance[0], grad.covariance[1] / axes.variance, grad.covariance[2]];
    let gu0: [f64; 3] = std::array::from_fn(|k| 2.0 * g_narrow * r[k] + g_slope * u1[k]);
    let gu1 = std::array::from_fn(|k| g_slope * r[k] + 2.0 * g_variance * u1[k] - axes.slope * gu0[k]);
    let gu = [gu0, gu1];
    // m0 gu0 + m1 gu1, whose large terms cancel.
    let grad_scale: [f64; 3] =
        std::array::from_fn(|k| 2.0 * (g_narrow * r[k] * h[k] + m1[k] * (g_slope * r[k] + g_variance * u1[k])));
    // M = Q diag(s), u = t M.
    let grad_m: [[f64; 3]; 3] =
        std::array::from_fn(|i| std::array::from_fn(|k| t[0][i] * gu[0][k] + t[1][i] * gu[1][k]));
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
    }
    // All rows of J are in proportion to 1/z, as is the Gaussian's size.
    grad_z -= dot(grad_scale, scale) / z;
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
