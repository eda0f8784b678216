//! Photographs of lenses that training does not project with, fisheyes above all, resampled to those of a pinhole.
//!
//! The pinhole has the size, the principal point and, in the middle of the picture, the resolution of the photograph. What
//! a fisheye shows at more than some 60 degrees from its axis lies outside. Where that would leave pixels that the
//! photograph does not show, the focal length is made larger until there are none.

use image::{GrayImage, Luma, Rgb, RgbImage};
use rayon::prelude::*;

use crate::scene::colmap::Lens;

/// How much larger the focal length may become.
const LARGEST: f64 = 4.0;
/// From one try to the next.
const STEP: f64 = 1.01;

/// The lens's picture of a photograph of another size.
pub fn scaled(lens: &Lens, to: [u32; 2]) -> Lens {
    let ratio: [f64; 2] = std::array::from_fn(|i| f64::from(to[i]) / f64::from(lens.size[i]));
    let scale = |v: [f64; 2]| std::array::from_fn(|i| v[i] * ratio[i]);
    Lens { focal: scale(lens.focal), principal: scale(lens.principal), size: to, ..*lens }
}

/// Where a ray (x / z, y / z) falls, in pixels; nothing where the lens folds over, so that some other ray falls there, too.
pub fn project(lens: &Lens, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
    let c = lens.coefficients;
    let r = x.hypot(y);
    let theta = r.atan();
    // Along a ray of the picture: the angle, or its part, per r.
    let fisheye = |[k1, k2, k3, k4]: [f64; 4]| {
        let t2 = theta * theta;
        let grows = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)));
        let part = 1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)));
        (grows > 0.0 && part > 0.0).then_some(part * if r > 1e-9 { theta / r } else { 1.0 })
    };
    let radially = |factor: f64| [x * factor, y * factor];
    let at = match lens.model {
        "OPENCV_FISHEYE" => radially(fisheye([c[0], c[1], c[2], c[3]])?),
        "SIMPLE_RADIAL_FISHEYE" => radially(fisheye([c[0], 0.0, 0.0, 0.0])?),
        "RADIAL_FISHEYE" => radially(fisheye([c[0], c[1], 0.0, 0.0])?),
        "FOV" => {
            let omega = c[0];
            // Without an angle it is a pinhole.
            let factor = if omega.abs() < 1e-6 || r < 1e-9 {
                if omega.abs() < 1e-6 { 1.0 } else { 2.0 * (omega / 2.0).tan() / omega }
            } else {
                (2.0 * r * (omega / 2.0).tan()).atan() / (r * omega)
            };
            radially(factor)
        }
        "THIN_PRISM_FISHEYE" => {
            let [k1, k2, p1, p2, k3, k4, sx, sy, ..] = c;
            fisheye([k1, k2, k3, k4])?;
            let angle = if r > 1e-9 { theta / r } else { 1.0 };
            let [u, v] = [x * angle, y * angle];
            let r2 = u * u + v * v;
            let radial = r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
            [
                u + u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u) + sx * r2,
                v + v * radial + 2.0 * p2 * u * v + p1 * (r2 + 2.0 * v * v) + sy * r2,
            ]
        }
        "FULL_OPENCV" => {
            let [k1, k2, p1, p2, k3, k4, k5, k6, ..] = c;
            let factor = |r: f64| {
                let r2 = r * r;
                (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
            };
            // It grows along the ray, here and on the way.
            let (r2, radial) = (r * r, factor(r));
            let growing = (1..=16).map(|i| r * f64::from(i) / 16.0).map(|r| r * factor(r));
            let mut last = 0.0;
            for at in growing {
                if r > 1e-9 && at <= last {
                    return None;
                }
                last = at;
            }
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
            ]
        }
        _ => crate::scene::distort([x, y], [c[0], c[1], c[2], c[3]]),
    };
    let pixel = std::array::from_fn(|i| at[i] * lens.focal[i] + lens.principal[i]);
    pixel.iter().all(|v: &f64| v.is_finite()).then_some(pixel)
}

/// A photograph's way into a pinhole's picture of the same size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pinhole {
    /// What took the photograph, at its size.
    pub lens: Lens,
    /// fx, fy in pixels; principal point and size are the lens's.
    pub focal: [f64; 2],
}

impl Pinhole {
    /// The pinhole for a lens; nothing if no focal length up to four times the lens's shows a part of the photograph
    /// alone.
    pub fn of(lens: Lens) -> Option<Self> {
        let [w, h] = lens.size.map(f64::from);
        // Corners and edges see farthest from the axis.
        let steps = 64;
        let border: Vec<[f64; 2]> = (0..=steps)
            .map(|i| f64::from(i) / f64::from(steps))
            .flat_map(|t| [[t * w, 0.0], [t * w, h], [0.0, t * h], [w, t * h]])
            .collect();
        let mut factor = 1.0;
        while factor <= LARGEST {
            let pinhole = Self { lens, focal: lens.focal.map(|f| f * factor) };
            let inside = |at: &[f64; 2]| {
                let slack = 0.5;
                let within = |v: f64, size: f64| (-slack..=size + slack).contains(&v);
                pinhole.source(*at).is_some_and(|[x, y]| within(x, w) && within(y, h))
            };
            if border.iter().all(inside) {
                return Some(pinhole);
            }
            factor *= STEP;
        }
        None
    }

    /// Where in the photograph lies what the pinhole shows at a pixel position.
    pub fn source(&self, at: [f64; 2]) -> Option<[f64; 2]> {
        let Lens { principal, .. } = self.lens;
        project(&self.lens, std::array::from_fn(|i| (at[i] - principal[i]) / self.focal[i]))
    }

    /// The photograph, interpolated between the four nearest pixels; those beyond the edge are those on it.
    pub fn photograph(&self, picture: &RgbImage) -> RgbImage {
        let (width, height) = picture.dimensions();
        let row = |y: u32| -> Vec<u8> {
            (0..width)
                .flat_map(|x| {
                    let Some(at) = self.source([f64::from(x) + 0.5, f64::from(y) + 0.5]) else { return [0; 3] };
                    let corner = at.map(|v| (v - 0.5).floor());
                    let share: [f64; 2] = std::array::from_fn(|i| at[i] - 0.5 - corner[i]);
                    let stored = |dx: f64, dy: f64| {
                        let clamp = |v: f64, size: u32| v.clamp(0.0, f64::from(size - 1)) as u32;
                        let Rgb(color) = picture.get_pixel(clamp(corner[0] + dx, width), clamp(corner[1] + dy, height));
                        color.map(f64::from)
                    };
                    let [a, b, c, d] = [stored(0.0, 0.0), stored(1.0, 0.0), stored(0.0, 1.0), stored(1.0, 1.0)];
                    std::array::from_fn(|i| {
                        let above = a[i] * (1.0 - share[0]) + b[i] * share[0];
                        let below = c[i] * (1.0 - share[0]) + d[i] * share[0];
                        (above * (1.0 - share[1]) + below * share[1]).round() as u8
                    })
                })
                .collect()
        };
        let rows: Vec<Vec<u8>> = (0..height).into_par_iter().map(row).collect();
        RgbImage::from_raw(width, height, rows.concat()).expect("a colour per pixel")
    }

    /// A mask of the photograph, by the nearest pixel.
    pub fn mask(&self, mask: &GrayImage) -> GrayImage {
        let (width, height) = mask.dimensions();
        GrayImage::from_fn(width, height, |x, y| {
            let at = self.source([f64::from(x) + 0.5, f64::from(y) + 0.5]);
            let inside = |v: f64, size: u32| (0.0..f64::from(size)).contains(&v);
            let at = at.filter(|[x, y]| inside(*x, width) && inside(*y, height));
            Luma([at.map_or(0, |[x, y]| mask.get_pixel(x as u32, y as u32).0[0])])
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [u32; 2] = [160, 120];

    fn lens(model: &'static str, coefficients: &[f64]) -> Lens {
        let mut all = [0.0; 12];
        all[..coefficients.len()].copy_from_slice(coefficients);
        Lens { model, focal: [70.0, 72.0], principal: [81.0, 58.5], coefficients: all, size: SIZE }
    }

    fn lenses() -> Vec<Lens> {
        vec![
            lens("OPENCV_FISHEYE", &[0.03, -0.01, 0.004, -0.001]),
            lens("SIMPLE_RADIAL_FISHEYE", &[-0.02]),
            lens("RADIAL_FISHEYE", &[0.02, 0.01]),
            lens("THIN_PRISM_FISHEYE", &[0.02, -0.01, 0.001, -0.002, 0.003, 0.0, 0.002, -0.001]),
            lens("FULL_OPENCV", &[-0.15, 0.04, 0.001, 0.002, 0.01, 0.02, 0.01, 0.001]),
            lens("FULL_OPENCV", &[0.3, 0.1]),
            lens("FOV", &[0.9]),
        ]
    }

    /// By hand: an equidistant fisheye has the ray at 45 degrees at pi / 4 focal lengths, whatever its direction.
    #[test]
    fn fisheyes_measure_angles() {
        let equidistant = lens("OPENCV_FISHEYE", &[]);
        let s = 0.5f64.sqrt();
        let [x, y] = project(&equidistant, [s, -s]).unwrap();
        let quarter = std::f64::consts::FRAC_PI_4;
        assert!((x - (81.0 + 70.0 * quarter * s)).abs() < 1e-12 && (y - (58.5 - 72.0 * quarter * s)).abs() < 1e-12);
        // With k1 its angle of 0.5 becomes 0.5 (1 + 0.1 * 0.25).
        let bent = lens("SIMPLE_RADIAL_FISHEYE", &[0.1]);
        let [x, _] = project(&bent, [0.5f64.tan(), 0.0]).unwrap();
        assert!((x - (81.0 + 70.0 * 0.5125)).abs() < 1e-12);
        // FULL_OPENCV without its own coefficients is OPENCV.
        let ray = [0.3, -0.4];
        let full = project(&lens("FULL_OPENCV", &[-0.1, 0.02, 0.004, -0.003]), ray).unwrap();
        let plain = project(&lens("OPENCV", &[-0.1, 0.02, 0.004, -0.003]), ray).unwrap();
        assert!((full[0] - plain[0]).abs() < 1e-12 && (full[1] - plain[1]).abs() < 1e-12);
        // theta (1 - theta^2) falls from 0.577 on.
        assert_eq!(project(&lens("SIMPLE_RADIAL_FISHEYE", &[-1.0]), [0.7, 0.0]), None);
    }

    /// What a ray sees: waves so long that interpolation hardly bends them.
    fn world([x, y]: [f64; 2]) -> [f64; 3] {
        [(4.0 * x).sin(), (4.0 * y).sin(), (3.0 * (x + y)).cos()].map(|v| 127.5 + 100.0 * v)
    }

    /// The ray of a pixel, by search: nothing of the code under test but `project`.
    fn ray(lens: &Lens, pixel: [f64; 2]) -> Option<[f64; 2]> {
        let mut at = std::array::from_fn(|i| (pixel[i] - lens.principal[i]) / lens.focal[i]);
        for _ in 0..200 {
            let here = project(lens, at)?;
            let error: [f64; 2] = std::array::from_fn(|i| (pixel[i] - here[i]) / lens.focal[i]);
            if error[0].hypot(error[1]) < 1e-9 {
                return Some(at);
            }
            at = std::array::from_fn(|i| at[i] + 0.5 * error[i]);
        }
        None
    }

    /// A rendered photograph resampled is the pinhole's own rendering. Interpolation errs by 1/8 of the second derivative
    /// along each axis, which is at most 100 * 4^2 per ray squared, and a pixel is at most 1/50 of a ray's unit here
    /// (1/70 in the middle; near the edge fisheyes shrink): 2 / 8 * 1600 / 2500 = 0.16; rounding twice adds 1.
    #[test]
    fn a_resampled_photograph_is_what_a_pinhole_sees() {
        for lens in lenses() {
            let pinhole = Pinhole::of(lens).unwrap();
            let of = |color: Option<[f64; 3]>| Rgb(color.unwrap_or_default().map(|v| v.round() as u8));
            let photograph = RgbImage::from_fn(SIZE[0], SIZE[1], |x, y| {
                of(ray(&lens, [f64::from(x) + 0.5, f64::from(y) + 0.5]).map(world))
            });
            let resampled = pinhole.photograph(&photograph);
            let (mut compared, mut worst) = (0, 0.0f64);
            for (x, y, Rgb(found)) in resampled.enumerate_pixels() {
                let at = [f64::from(x) + 0.5, f64::from(y) + 0.5];
                let [u, v] = pinhole.source(at).unwrap();
                // At the edge of the photograph there is nothing to interpolate with.
                let inner =
                    (1.0..f64::from(SIZE[0]) - 1.0).contains(&u) && (1.0..f64::from(SIZE[1]) - 1.0).contains(&v);
                let shrunk = pinhole.source([at[0] + 1.0, at[1]]).map_or(0.0, |[right, _]| right - u);
                if inner && shrunk > 0.0 {
                    let want = world(std::array::from_fn(|i| (at[i] - lens.principal[i]) / pinhole.focal[i]));
                    // A pixel of the photograph in units of the ray.
                    let unit = 1.0 / (shrunk * pinhole.focal[0]);
                    let tolerance = 1.0 + 2.0 / 8.0 * 1600.0 * unit * unit;
                    for i in 0..3 {
                        let off = (f64::from(found[i]) - want[i]).abs();
                        worst = worst.max(off / tolerance);
                        assert!(off <= tolerance, "{}: {x} {y} {off} > {tolerance}", lens.model);
                    }
                    compared += 1;
                }
            }
            println!(
                "{}: focal x {:.2}, {compared} pixels, worst {worst:.2} of the tolerance",
                lens.model,
                pinhole.focal[0] / lens.focal[0]
            );
            // No pixel is left without a source: all but the outermost are compared.
            assert!(compared > 158 * 118 * 9 / 10, "{}: {compared}", lens.model);
        }
    }

    #[test]
    fn masks_follow_their_photographs() {
        for lens in lenses() {
            let pinhole = Pinhole::of(lens).unwrap();
            let disc = |[x, y]: [f64; 2]| (x - 0.1).hypot(y + 0.05) < 0.3;
            let mask = GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| {
                let ray = ray(&lens, [f64::from(x) + 0.5, f64::from(y) + 0.5]);
                Luma([if ray.is_some_and(disc) { 255 } else { 0 }])
            });
            let resampled = pinhole.mask(&mask);
            let mut wrong = 0;
            let mut on = 0;
            for (x, y, pixel) in resampled.enumerate_pixels() {
                let at = [f64::from(x) + 0.5, f64::from(y) + 0.5];
                let want = disc(std::array::from_fn(|i| (at[i] - lens.principal[i]) / pinhole.focal[i]));
                wrong += usize::from(want != (pixel.0[0] != 0));
                on += usize::from(want);
            }
            // Pixels on its edge, of which there are 2 pi 0.3 * 70 = 130, may go either way.
            assert!(on > 1000 && wrong < 130, "{}: {wrong} of {on}", lens.model);
        }
    }

    #[test]
    fn lenses_of_other_sizes_are_scaled() {
        let half = scaled(&lens("FOV", &[0.9]), [80, 60]);
        assert_eq!((half.focal, half.principal, half.size), ([35.0, 36.0], [40.5, 29.25], [80, 60]));
    }

    #[test]
    fn a_lens_that_folds_has_no_pinhole() {
        assert_eq!(Pinhole::of(lens("SIMPLE_RADIAL_FISHEYE", &[-9.0])), None);
    }
}
