//! The soft shadow around the object's foot, which no light from one side explains ([`crate::prepare::shadow`]).
//!
//! On the chart of the plane that the object stands on the light falls off smoothly. What is darker than that around the foot,
//! in all channels alike, and hangs together with it, is the object's shade. It goes with the object: it is filled as the place
//! under it is.

use glam::DVec3;
use image::GrayImage;
use rayon::prelude::*;

use super::color::Photograph;
use super::guess::Chart;
use super::surface::{SAME, Sights};
use crate::prepare::planes;
use crate::scene::{Camera, resample};

/// Logarithm of the luminance by which the shade's middle is darker than the surface, at least, and its border.
const DARK: f64 = -0.06;
const DARK_BORDER: f64 = -0.035;
/// Largest difference of the logarithms of two channels: what is of another colour is no shade.
const TINTED: f64 = 0.06;
/// The shade reaches at most so many times the foot's width from it.
const REACH: f64 = 0.8;
/// How far from the foot it may be that no view shows the plane, in the foot's widths.
const UNSEEN: f64 = 0.3;
/// Largest deviation (median of absolute values) of the surface from smooth light for a shade to be told on it.
const ROUGH: f64 = 0.05;
/// Half the width of the squares that the differences are averaged over, as a part of the foot's width.
const SMOOTH: f64 = 0.05;
/// Half the width of a line, with the squares, as a part of the foot's.
const THIN: f64 = 0.1;
/// Fewest sites of the foot.
const FEWEST_SITES: usize = 8;
/// The dark part of a shade covers at least this part of the foot's area, and all of it at most so much: what is larger is a
/// pattern of the surface, or something else's shadow.
const LEAST: f64 = 0.05;
const MOST: f64 = 3.5;
/// The least area that is known of the plane where the farthest shade would end, as a part of the foot's.
const LEAST_RING: f64 = 0.2;
/// Views that are asked for the colours of the plane.
const VIEWS: usize = 12;

/// Adds the shade to the masks of all views (as large as the pictures of these cameras). Returns whether there is any. `of` is
/// a solved view.
pub fn add(sights: &Sights, photographs: &[Photograph<'_>], of: usize, masks: &mut [GrayImage]) -> bool {
    let Some((chart, shade)) = find(sights, photographs, of) else { return false };
    let own = &photographs[of].camera;
    let points: Vec<DVec3> = (shade.iter().enumerate().filter(|(_, shade)| **shade))
        .map(|(i, _)| {
            let point = chart.point(i);
            DVec3::from(own.along([point.x / point.z, point.y / point.z], point.z))
        })
        .collect();
    masks.par_iter_mut().enumerate().for_each(|(view, mask)| {
        let (camera, sight) = (&photographs[view].camera, &sights.0[view]);
        let (w, h) = mask.dimensions();
        let mut more = GrayImage::new(w, h);
        let mut nearest = f64::INFINITY;
        for point in &points {
            let Some((site, z)) = sight.see(*point) else { continue };
            // Behind something else it is not in the picture.
            if !sight.hole[site] && sight.depth[site] < (1.0 - 2.0 * SAME) * z {
                continue;
            }
            let Some([x, y]) = camera.project(point.to_array()) else { continue };
            if let Some(pixel) = more.get_pixel_mut_checked(x.max(0.0) as u32, y.max(0.0) as u32) {
                pixel.0 = [255];
                nearest = nearest.min(z);
            }
        }
        if nearest.is_finite() {
            // A texel covers so many pixels where it is nearest; its neighbours close the gaps.
            let pixels = chart.scale * f64::from(camera.focal[0].max(camera.focal[1])) / nearest;
            let more = resample::dilate(&more, pixels.ceil().max(1.0) as u32);
            mask.iter_mut().zip(more.as_raw()).for_each(|(m, more)| *m = (*m).max(*more));
        }
    });
    true
}

/// The chart of the plane that the object stands on, and `[texel]` whether it is shaded, or covered by the object.
fn find(sights: &Sights, photographs: &[Photograph<'_>], of: usize) -> Option<(Chart, Vec<bool>)> {
    let (camera, sight) = (&photographs[of].camera, &sights.0[of]);
    // The foot is where no other photograph looks.
    let foot = |number: usize| {
        let sites = 0..sight.hole.len();
        sites.filter(move |s| sight.hole[*s] && !sight.measured[*s] && usize::from(sight.surface[*s]) == number)
    };
    let number = (0..sight.planes.len()).max_by_key(|number| foot(*number).count())?;
    let rays: Vec<[f64; 2]> = foot(number).map(|site| sight.ray(site)).collect();
    if rays.len() < FEWEST_SITES {
        return None;
    }
    let chart = Chart::new(sight.planes[number], &rays, f64::from(camera.focal[0].max(camera.focal[1])), 2.0)?;
    let light = luminances(sights, photographs, of, &chart);
    let mut footing = vec![false; light.len()];
    let texels = chart.middle / (chart.scale * f64::from(camera.focal[0]));
    for ray in &rays {
        let Some([x, y]) = chart.pixel(*ray) else { continue };
        // A site is as wide as its stride.
        let half = (0.5 * f64::from(sight.grid.stride) * f64::from(camera.size[0])
            / f64::from(sight.grid.camera.size[0])
            * texels)
            .ceil() as i64;
        for (dx, dy) in (-half..=half).flat_map(|dy| (-half..=half).map(move |dx| (dx, dy))) {
            let (u, v) = (x as i64 + dx, y as i64 + dy);
            if u >= 0 && v >= 0 && (u as usize) < chart.size[0] && (v as usize) < chart.size[1] {
                footing[v as usize * chart.size[0] + u as usize] = true;
            }
        }
    }
    // What no view shows of the plane around those, where the view itself has the hole, is under the object as well.
    let in_hole = |i: usize| {
        let point = chart.point(i);
        let site = (point.z > 0.0).then(|| sight.grid.place([point.x / point.z, point.y / point.z]));
        let site = site.and_then(|[x, y]| sight.grid.site(x.floor() as i64, y.floor() as i64));
        site.is_some_and(|site| sight.hole[site])
    };
    let unseen: Vec<bool> = (0..light.len()).map(|i| light[i][0].is_nan() && in_hole(i)).collect();
    spread(&mut footing, &unseen, chart.size);
    let mut shade = shaded(&light, &footing, chart.size)?;
    // A site of the foot reaches beyond the mask, into the darkest of the shade.
    shade.iter_mut().zip(&footing).for_each(|(shade, foot)| *shade |= foot);
    Some((chart, shade))
}

/// Adds what is unseen and hangs together with the foot to it.
fn spread(foot: &mut [bool], unseen: &[bool], size: [usize; 2]) {
    let mut left: Vec<bool> = foot.iter().zip(unseen).map(|(foot, unseen)| *foot || *unseen).collect();
    for first in 0..foot.len() {
        if foot[first] {
            planes::connected(first, &mut left, size).into_iter().for_each(|i| foot[i] = true);
        }
    }
}

/// `[texel]` logarithms of what the views show of the plane: the median of each channel; NaN where none shows it.
fn luminances(sights: &Sights, photographs: &[Photograph<'_>], of: usize, chart: &Chart) -> Vec<[f64; 3]> {
    let own: &Camera = &photographs[of].camera;
    let trusted: Vec<usize> = (0..photographs.len()).filter(|k| sights.0[*k].grid.trusted).collect();
    let every = trusted.len().div_ceil(VIEWS).max(1);
    let one = |i: usize| -> [f64; 3] {
        let point = chart.point(i);
        if point.z <= 0.0 {
            return [f64::NAN; 3];
        }
        let world = DVec3::from(own.along([point.x / point.z, point.y / point.z], point.z));
        let some = trusted.iter().step_by(every);
        let shown = some.filter_map(|k| sights.0[*k].shows(world, SAME).and_then(|_| photographs[*k].color(world)));
        let shown: Vec<[f32; 3]> = shown.collect();
        std::array::from_fn(|c| {
            let mut values: Vec<f32> = shown.iter().map(|color| color[c]).collect();
            values.sort_unstable_by(f32::total_cmp);
            values.get(values.len() / 2).map_or(f64::NAN, |v| f64::from(v.max(1.0 / 255.0)).ln())
        })
    };
    (0..chart.size[0] * chart.size[1]).into_par_iter().map(one).collect()
}

/// Which texels are shaded by what stands on the `foot`; `None` where none are, or the surface is too rough to tell.
fn shaded(light: &[[f64; 3]], foot: &[bool], size @ [w, h]: [usize; 2]) -> Option<Vec<bool>> {
    let feet = || (0..foot.len()).filter(|i| foot[*i]);
    let range = |f: &dyn Fn(usize) -> usize| {
        let (low, high) = feet().fold((usize::MAX, 0), |(low, high), i| (low.min(f(i)), high.max(f(i))));
        high + 1 - low
    };
    let width = range(&|i| i % w).max(range(&|i| i / w)) as f64;
    let raw: Vec<u8> = foot.iter().map(|foot| if *foot { 255 } else { 0 }).collect();
    let reach = (REACH * width).ceil() as u32;
    let away = resample::distances(&GrayImage::from_raw(w as u32, h as u32, raw)?, reach);
    let known: Vec<usize> = (0..foot.len()).filter(|i| !foot[*i] && light[*i][0].is_finite()).collect();
    // Smooth light: a polynomial of second degree by reweighted least squares, of each channel; the shade itself loses its weight.
    let basis = |i: usize| {
        let (x, y) = ((i % w) as f64 / w as f64 - 0.5, (i / w) as f64 / h as f64 - 0.5);
        [1.0, x, y, x * x, x * y, y * y]
    };
    let some: Vec<usize> = known.iter().copied().step_by(known.len().div_ceil(4000).max(1)).collect();
    if some.len() < 200 {
        return None;
    }
    let fits: Vec<([f64; 6], f64)> = (0..3).map(|c| robust(&some, &basis, |i| light[i][c])).collect::<Option<_>>()?;
    let rough = fits.iter().fold(0.0, |most: f64, (_, rough)| most.max(*rough));
    log::debug!("shade: a foot of {width} texels, the surface is rough by {rough:.3}");
    if rough > ROUGH {
        return None;
    }
    let off = |i: usize, c: usize| light[i][c] - basis(i).iter().zip(fits[c].0).map(|(b, k)| b * k).sum::<f64>();
    let radius = ((SMOOTH * width).round() as i64).max(1);
    let smooth = |i: usize| -> Option<[f64; 3]> {
        let (x, y) = ((i % w) as i64, (i / w) as i64);
        let around = (y - radius..=y + radius).flat_map(|v| (x - radius..=x + radius).map(move |u| (u, v)));
        let inside = around.filter(|(u, v)| *u >= 0 && *v >= 0 && (*u as usize) < w && (*v as usize) < h);
        let near: Vec<usize> = inside
            .map(|(u, v)| v as usize * w + u as usize)
            .filter(|j| !foot[*j] && light[*j][0].is_finite())
            .collect();
        (!near.is_empty())
            .then(|| std::array::from_fn(|c| near.iter().map(|j| off(*j, c)).sum::<f64>() / near.len() as f64))
    };
    let differences: Vec<Option<[f64; 3]>> =
        (0..foot.len()).into_par_iter().map(|i| if away[i] <= reach && !foot[i] { smooth(i) } else { None }).collect();
    let darker = |i: usize, than: f64| {
        differences[i].is_some_and(|off| {
            let (low, high) = off.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(*v), b.max(*v)));
            (off[0] + off[1] + off[2]) / 3.0 < than && high - low < TINTED
        })
    };
    // From the foot outwards, through what is darker.
    let mut shade = vec![false; foot.len()];
    let mut queue: Vec<usize> = feet().collect();
    while let Some(i) = queue.pop() {
        let (x, y) = (i % w, i / w);
        for v in y.saturating_sub(1)..(y + 2).min(h) {
            for u in x.saturating_sub(1)..(x + 2).min(w) {
                let next = v * size[0] + u;
                // What is next to the foot, where no view shows the plane, is passed.
                let unseen = light[next][0].is_nan() && f64::from(away[next]) <= UNSEEN * width;
                if !foot[next] && !shade[next] && (darker(next, DARK_BORDER) || away[next] <= 1 || unseen) {
                    shade[next] = true;
                    queue.push(next);
                }
            }
        }
    }
    let dark = |shade: &[bool]| (0..foot.len()).filter(|i| shade[*i] && darker(*i, DARK)).count() as f64;
    let whole = dark(&shade);
    // What is thin is a joint or another line, which the foot happens to stand beside.
    let thick = resample::opened([w as u32, h as u32], |i| shade[i] || foot[i], (THIN * width).ceil() as u32);
    shade.iter_mut().zip(thick.as_raw()).for_each(|(shade, thick)| *shade &= *thick != 0);
    let area = shade.iter().filter(|shade| **shade).count() as f64;
    let core = dark(&shade);
    // A shade ends: what is dark as far as one looks is another surface.
    let far = |i: &usize| f64::from(away[*i]) > 0.9 * REACH * width;
    let ring = (0..foot.len()).filter(|i| differences[*i].is_some()).filter(far);
    let (at_end, all) = ring.fold((0, 0), |(k, n), i| (k + usize::from(shade[i]), n + 1));
    let darkest = differences.iter().flatten().min_by(|a, b| a.iter().sum::<f64>().total_cmp(&b.iter().sum()));
    log::debug!("shade: the darkest is {darkest:.2?}");
    log::debug!("shade: {area} texels, {core} of them dark, {at_end} of {all} at the end of what is looked at");
    let foot = feet().count() as f64;
    // Where it would end is to be seen.
    let ends = all as f64 >= LEAST_RING * foot && (5 * at_end < all || at_end == 0);
    // Where most of it is lines, what is left of them beside the foot is none.
    (core >= LEAST * foot && core >= 0.2 * area && core >= 0.5 * whole && area <= MOST * foot && ends).then_some(shade)
}

/// Coefficients of least squares in which what is far off loses its weight (Cauchy), and the median of the absolute residuals.
fn robust(of: &[usize], basis: &dyn Fn(usize) -> [f64; 6], value: impl Fn(usize) -> f64) -> Option<([f64; 6], f64)> {
    let mut weights = vec![1.0; of.len()];
    let mut found = ([0.0; 6], 0.0);
    for _ in 0..8 {
        let (mut m, mut r) = ([[0.0; 6]; 6], [0.0; 6]);
        for (i, weight) in of.iter().zip(&weights) {
            let b = basis(*i);
            for j in 0..6 {
                (0..6).for_each(|k| m[j][k] += weight * b[j] * b[k]);
                r[j] += weight * b[j] * value(*i);
            }
        }
        let solved = solve(m, r)?;
        let residual = |i: usize| value(i) - basis(i).iter().zip(solved).map(|(b, k)| b * k).sum::<f64>();
        let mut sizes: Vec<f64> = of.iter().map(|i| residual(*i).abs()).collect();
        sizes.sort_unstable_by(f64::total_cmp);
        let middle = sizes[sizes.len() / 2];
        let scale = (2.0 * middle).max(1e-6);
        weights = of.iter().map(|i| 1.0 / (1.0 + (residual(*i) / scale).powi(2))).collect();
        found = (solved, middle);
    }
    Some(found)
}

/// Gauss's elimination with pivots; `None` of a singular matrix.
fn solve(mut m: [[f64; 6]; 6], mut r: [f64; 6]) -> Option<[f64; 6]> {
    for column in 0..6 {
        let pivot = (column..6).max_by(|a, b| m[*a][column].abs().total_cmp(&m[*b][column].abs()))?;
        if m[pivot][column].abs() < 1e-12 {
            return None;
        }
        m.swap(column, pivot);
        r.swap(column, pivot);
        for row in column + 1..6 {
            let factor = m[row][column] / m[column][column];
            (column..6).for_each(|k| m[row][k] -= factor * m[column][k]);
            r[row] -= factor * r[column];
        }
    }
    for column in (0..6).rev() {
        let known: f64 = (column + 1..6).map(|k| m[column][k] * r[k]).sum();
        r[column] = (r[column] - known) / m[column][column];
    }
    Some(r)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [120, 100];

    fn light(value: impl Fn(f64, f64) -> [f64; 3]) -> Vec<[f64; 3]> {
        (0..SIZE[0] * SIZE[1]).map(|i| value((i % SIZE[0]) as f64, (i / SIZE[0]) as f64).map(f64::ln)).collect()
    }

    fn foot() -> Vec<bool> {
        (0..SIZE[0] * SIZE[1])
            .map(|i| ((i % SIZE[0]) as f64 - 60.0).hypot((i / SIZE[0]) as f64 - 50.0) < 12.0)
            .collect()
    }

    /// A soft shade to the left of the foot on a floor whose light falls off: it is found, and nothing on the other side.
    #[test]
    fn a_soft_shade_is_found() {
        let shade = |x: f64, y: f64| 0.35 * (-((x - 48.0) / 9.0).powi(2) - ((y - 50.0) / 9.0).powi(2)).exp();
        let floor = light(|x, y| [0.8, 0.75, 0.7].map(|v| v * (1.0 - 0.002 * x) * (1.0 - shade(x, y))));
        let found = shaded(&floor, &foot(), SIZE).expect("a shade");
        for (i, found) in found.iter().enumerate().filter(|(i, _)| !foot()[*i]) {
            let (x, y) = ((i % SIZE[0]) as f64, (i / SIZE[0]) as f64);
            assert!(*found || shade(x, y) < 0.05, "({x}, {y}) is left");
            assert!(!found || x < 75.0, "({x}, {y}) is no shade");
        }
    }

    /// A foot of which few sites are on the plane is all that no view shows around them, so that its shade, many times as large as they
    /// are, is one. What is unseen elsewhere is no foot.
    #[test]
    fn the_foot_is_all_that_is_unseen_around_it() {
        let disc = |i: usize, x: f64, y: f64| ((i % SIZE[0]) as f64 - x).hypot((i / SIZE[0]) as f64 - y) < 12.0;
        let sites = || (0..SIZE[0] * SIZE[1]).map(|i| i / SIZE[0] == 52 && (55..63).contains(&(i % SIZE[0])));
        let unseen: Vec<bool> = (0..SIZE[0] * SIZE[1]).map(|i| disc(i, 60.0, 50.0) || disc(i, 100.0, 80.0)).collect();
        let shade = |x: f64, y: f64| 0.35 * (-((x - 48.0) / 9.0).powi(2) - ((y - 50.0) / 9.0).powi(2)).exp();
        let mut floor = light(|x, y| [0.8, 0.75, 0.7].map(|v| v * (1.0 - shade(x, y))));
        floor.iter_mut().zip(&unseen).filter(|(_, unseen)| **unseen).for_each(|(v, _)| *v = [f64::NAN; 3]);
        let mut spread_out: Vec<bool> = sites().collect();
        assert!(shaded(&floor, &spread_out, SIZE).is_none());
        spread(&mut spread_out, &unseen, SIZE);
        assert_eq!(spread_out, foot());
        assert!(shaded(&floor, &spread_out, SIZE).is_some());
    }

    /// Dark joints between tiles run away from the foot, and a shadow of something else touches it: neither is the foot's shade.
    #[test]
    fn patterns_and_other_shadows_stay() {
        let joint = |v: f64| v.rem_euclid(30.0) < 2.0;
        let tiles = light(|x, y| if joint(x) || joint(y) { [0.4, 0.37, 0.35] } else { [0.8, 0.75, 0.7] });
        assert!(shaded(&tiles, &foot(), SIZE).is_none());
        let one = light(|x, _| if (59.0..61.0).contains(&x) { [0.4, 0.37, 0.35] } else { [0.8, 0.75, 0.7] });
        assert!(shaded(&one, &foot(), SIZE).is_none());
        let wide = |x: f64, y: f64| x < 52.0 && (y - 50.0).abs() < 25.0;
        let shadow = light(|x, y| if wide(x, y) { [0.5, 0.47, 0.44] } else { [0.8, 0.75, 0.7] });
        assert!(shaded(&shadow, &foot(), SIZE).is_none());
    }

    /// Without a shade, on another surface that begins at the foot, and beside something of another colour there is none.
    #[test]
    fn none_is_invented() {
        let plain = light(|x, _| [0.8, 0.75, 0.7].map(|v| v * (1.0 - 0.002 * x)));
        assert!(shaded(&plain, &foot(), SIZE).is_none());
        let carpet = light(|_, y| if y > 50.0 { [0.4, 0.38, 0.35] } else { [0.8, 0.75, 0.7] });
        assert!(shaded(&carpet, &foot(), SIZE).is_none());
        let stain = light(|x, y| if (x - 45.0).hypot(y - 50.0) < 8.0 { [0.7, 0.5, 0.2] } else { [0.8, 0.75, 0.7] });
        assert!(shaded(&stain, &foot(), SIZE).is_none());
    }
}
