//! The camera: a pose, a pinhole and COLMAP's OPENCV lens distortion, of which every supported model is a special case.

/// One photograph's camera, at the resolution of that photograph.
///
/// World to camera is `p_cam = R p + t` in COLMAP's frame (x right, y down, looking along +z). Pixel (column, row) is
/// sampled at (column + 0.5, row + 0.5), and the principal point is given in the same coordinates, which is COLMAP's own
/// convention. Lengths in the image are pixels, lengths in the world are the units of the COLMAP model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// R, row-major: `rotation[i]` is the i-th camera axis in world coordinates.
    pub rotation: [[f32; 3]; 3],
    /// t, in float64: the centre of a camera far from the world's origin must not be rounded to float32.
    pub translation: [f64; 3],
    /// fx, fy in pixels.
    pub focal: [f32; 2],
    /// cx, cy in pixels.
    pub principal: [f32; 2],
    /// k1, k2, p1, p2 of Brown's model as COLMAP and OpenCV write it; all zero for a pinhole.
    pub distortion: [f32; 4],
    /// Width, height in pixels.
    pub size: [u32; 2],
}

impl Camera {
    /// The camera's position c in the world: `R c + t = 0` for the rotation as it is, whose float32 rows are orthogonal
    /// only to 2^-24. `-R^T t` would be off by that much of `|t|`.
    pub fn center(&self) -> [f64; 3] {
        let [a, b, c] = self.rotation.map(|row| row.map(f64::from));
        let cross = |a: [f64; 3], b: [f64; 3]| {
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        };
        // The inverse of a matrix with rows a, b, c has the columns b x c, c x a, a x b over their triple product.
        let columns = [cross(b, c), cross(c, a), cross(a, b)];
        let triple: f64 = (0..3).map(|i| a[i] * columns[0][i]).sum();
        std::array::from_fn(|i| -(0..3).map(|k| columns[k][i] * self.translation[k]).sum::<f64>() / triple)
    }

    /// The translation that puts a camera with such a (rounded) rotation at `center`.
    pub fn translation_to(rotation: &[[f32; 3]; 3], center: [f64; 3]) -> [f64; 3] {
        rotation.map(|row| -(0..3).map(|k| f64::from(row[k]) * center[k]).sum::<f64>())
    }

    /// The same camera for the same picture resampled to `to` = (width, height): focal lengths and principal point are
    /// multiplied by the exact ratio of each axis, so that sides that do not divide evenly stay consistent.
    pub fn scaled(&self, to: [u32; 2]) -> Camera {
        let ratio = |axis: usize| f64::from(to[axis]) / f64::from(self.size[axis]);
        let scale = |v: [f32; 2]| std::array::from_fn(|axis| (f64::from(v[axis]) * ratio(axis)) as f32);
        Camera { focal: scale(self.focal), principal: scale(self.principal), size: to, ..*self }
    }

    /// World to camera coordinates; the last component is the depth z.
    pub fn to_camera(&self, point: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|i| {
            self.translation[i] + (0..3).map(|k| f64::from(self.rotation[i][k]) * point[k]).sum::<f64>()
        })
    }

    /// Where a world point falls, in pixels (it may lie outside the picture). `None` at or behind the camera plane.
    pub fn project(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        let [x, y, z] = self.to_camera(point);
        if z <= 0.0 {
            return None;
        }
        let d = distort([x / z, y / z], self.distortion.map(f64::from));
        Some(std::array::from_fn(|i| d[i] * f64::from(self.focal[i]) + f64::from(self.principal[i])))
    }

    /// The undistorted normalised coordinates (x / z, y / z) seen at a pixel position, by Newton's method on
    /// [`distort`]. `None` where the distortion folds over and has no inverse.
    pub fn unproject(&self, pixel: [f64; 2]) -> Option<[f64; 2]> {
        let target = std::array::from_fn(|i| (pixel[i] - f64::from(self.principal[i])) / f64::from(self.focal[i]));
        undistort(target, self.distortion.map(f64::from))
    }

    /// Where a world point falls within the picture, in pixels. `None` outside, and at or behind the camera plane.
    pub fn within(&self, point: [f64; 3]) -> Option<[f64; 2]> {
        let [w, h] = self.size.map(f64::from);
        self.project(point).filter(|[x, y]| (0.0..w).contains(x) && (0.0..h).contains(y))
    }

    /// The row-major pixel that a world point falls into, if it is within the picture.
    pub fn pixel_of(&self, point: [f64; 3]) -> Option<usize> {
        self.within(point).map(|[x, y]| y as usize * self.size[0] as usize + x as usize)
    }

    /// The pixel position of the centre of a row-major pixel.
    pub fn pixel_center(&self, pixel: usize) -> [f64; 2] {
        let width = self.size[0] as usize;
        [(pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5]
    }

    /// The world point on the ray of normalised coordinates (x / z, y / z) at a depth z, world units.
    pub fn along(&self, [x, y]: [f64; 2], depth: f64) -> [f64; 3] {
        let (center, seen) = (self.center(), [x * depth, y * depth, depth]);
        std::array::from_fn(|i| center[i] + (0..3).map(|k| f64::from(self.rotation[k][i]) * seen[k]).sum::<f64>())
    }

    /// The world point seen at a pixel position at a depth z, world units: the inverse of [`Camera::project`]. `None`
    /// where the lens has no inverse.
    pub fn lift(&self, pixel: [f64; 2], depth: f64) -> Option<[f64; 3]> {
        Some(self.along(self.unproject(pixel)?, depth))
    }
}

/// Brown's distortion of normalised coordinates with coefficients k1, k2, p1, p2 (COLMAP's OPENCV model).
pub fn distort([x, y]: [f64; 2], [k1, k2, p1, p2]: [f64; 4]) -> [f64; 2] {
    let r2 = x * x + y * y;
    let radial = 1.0 + k1 * r2 + k2 * r2 * r2;
    [x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)]
}

/// The inverse of [`distort`]: Newton's method from the distorted position, to 1e-12 in normalised coordinates.
pub fn undistort(target: [f64; 2], coefficients: [f64; 4]) -> Option<[f64; 2]> {
    let [k1, k2, p1, p2] = coefficients;
    let [mut x, mut y] = target;
    for _ in 0..50 {
        let d = distort([x, y], coefficients);
        let (ex, ey) = (d[0] - target[0], d[1] - target[1]);
        if ex.abs().max(ey.abs()) < 1e-12 {
            return Some([x, y]);
        }
        let r2 = x * x + y * y;
        let radial = 1.0 + k1 * r2 + k2 * r2 * r2;
        let slope = 2.0 * (k1 + 2.0 * k2 * r2);
        let xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x;
        let xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
        let yy = radial + y * y * slope + 2.0 * p2 * x + 6.0 * p1 * y;
        let determinant = xx * yy - xy * xy;
        // Beyond the fold the map from ray to pixel reverses; no ray there is the one the lens took.
        if determinant <= 0.0 || !determinant.is_finite() {
            return None;
        }
        x -= (yy * ex - xy * ey) / determinant;
        y -= (xx * ey - xy * ex) / determinant;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undistort_inverts_distort() {
        for lens in [[0.0; 4], [0.03, 0.0, 0.0, 0.0], [-0.1, 0.02, 0.0, 0.0], [0.1, -0.03, 0.004, -0.003]] {
            for (i, j) in (-8..=8).flat_map(|i| (-8..=8).map(move |j| (i, j))) {
                let ray = [f64::from(i) / 10.0, f64::from(j) / 10.0];
                let back = undistort(distort(ray, lens), lens).expect("these lenses do not fold in this field of view");
                // The iteration stops within 1e-12 of the distorted position; the map's slope is at least 0.5 here.
                assert!(
                    (back[0] - ray[0]).abs() < 2e-12 && (back[1] - ray[1]).abs() < 2e-12,
                    "{lens:?}: {ray:?} {back:?}"
                );
            }
        }
    }

    #[test]
    fn lifting_is_the_inverse_of_projecting() {
        // A turn about a skew axis; float32 rows are orthogonal to 1e-7 or so.
        let camera = Camera {
            rotation: [[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]],
            translation: [0.4, -1.5, 3.0],
            focal: [60.0, 58.0],
            principal: [33.0, 23.0],
            distortion: [-0.1, 0.02, 0.003, -0.002],
            size: [64, 48],
        };
        for pixel in [0, 77, 64 * 48 - 1] {
            let position = camera.pixel_center(pixel);
            let point = camera.lift(position, 2.5).expect("the lens has an inverse");
            let back = camera.project(point).expect("ahead");
            // Rows that are off by 1e-7 move the point by as much of its distance, at 60 pixels a unit.
            assert!((0..2).all(|k| (back[k] - position[k]).abs() < 3e-5), "{position:?} {back:?}");
            assert!((camera.to_camera(point)[2] - 2.5).abs() < 1e-6);
            assert_eq!(camera.pixel_of(point), Some(pixel));
        }
        for outside in [[-0.1, 5.0], [64.1, 5.0], [5.0, -0.1], [5.0, 48.1]] {
            assert_eq!(camera.within(camera.lift(outside, 2.5).expect("the lens has an inverse")), None);
        }
        let folded = Camera { distortion: [-1.0, 0.0, 0.0, 0.0], ..camera };
        assert_eq!(folded.lift([64.0, 24.0], 2.5), None);
    }

    /// x (1 - x^2) reaches 0.385 at most: nothing is seen beyond.
    #[test]
    fn a_folding_lens_has_no_rays_beyond_the_fold() {
        let lens = [-1.0, 0.0, 0.0, 0.0];
        assert!(undistort([0.38, 0.0], lens).is_some_and(|[x, _]| x < 1.0 / 3f64.sqrt()));
        assert_eq!(undistort([0.40, 0.0], lens), None);
        assert_eq!(undistort([2.0, 1.0], lens), None);
    }
}
