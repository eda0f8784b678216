//! A hole of which photographs tell nothing, as its picture goes on around it.
//!
//! Where views are too near each other to tell planes from what is rough, planes and short borders say little about what ends
//! where: a bench, a hedge and gravel meet behind the object. What the picture looks like says more. The hole is filled with
//! large pieces of all that is around it (`texture`), so that edges go on and end together; the surface that a piece is copied
//! from is the one that is expected there.

use rayon::prelude::*;

use super::color::{self, Filling, Photograph};
use super::guess::{parts, surroundings, thick};
use super::surface::{SAME, Sight, Sights};
use super::texture::{self, Texture};
use crate::prepare::planes::{self, Plane};
use crate::scene::Camera;

/// A view's hole, filled with pieces of all surfaces around it.
pub struct Whole {
    /// `[pixel]` RGB, 0 to 1.
    rgb: Vec<[f32; 3]>,
    /// `[pixel]` the pixel it was copied from; nothing where it is not filled.
    from: Vec<Option<usize>>,
}

impl Whole {
    /// Fills what is guessed of a picture with this width and height; nothing where nothing can be.
    fn of(filling: &Filling, size @ [w, h]: [usize; 2]) -> Option<Self> {
        let mut whole = Self { rgb: filling.rgb.clone(), from: vec![None; w * h] };
        let thick = thick(&filling.guessed, size.map(|n| n as u32));
        let left: Vec<usize> = (0..w * h).filter(|i| thick[*i]).collect();
        for part in parts(&left, size) {
            let (cells, size) = surroundings(&part, size);
            let mut texture = Texture {
                size,
                rgb: cells.iter().map(|i| filling.rgb[*i]).collect(),
                hole: cells.iter().map(|i| filling.guessed[*i]).collect(),
                source: cells.iter().map(|i| !filling.guessed[*i]).collect(),
            };
            let Some(copied) = texture::fill(&mut texture) else { continue };
            for (cell, i) in cells.iter().enumerate() {
                if let Some(from) = copied[cell] {
                    (whole.rgb[*i], whole.from[*i]) = (texture.rgb[cell], Some(cells[from]));
                }
            }
        }
        whole.from.iter().any(Option::is_some).then_some(whole)
    }

    /// `[site]` of a view the surface that what is copied there is on; nothing where nothing is.
    fn surfaces(&self, sight: &Sight, camera: &Camera) -> Vec<Option<u8>> {
        let w = camera.size[0] as usize;
        let one = |site: usize| {
            let [x, y] = camera.project(camera.along(sight.ray(site), 1.0))?;
            let inside = x >= 0.0 && y >= 0.0 && (x as u32) < camera.size[0] && (y as u32) < camera.size[1];
            let from = self.from[inside.then(|| y as usize * w + x as usize)?]?;
            surface(sight, camera, from)
        };
        (0..sight.hole.len()).into_par_iter().map(|site| sight.hole[site].then(|| one(site))?).collect()
    }

    /// Gives what is guessed its colours.
    pub fn paint(&self, filling: &mut Filling) {
        for i in (0..self.from.len()).filter(|i| self.from[*i].is_some()) {
            if std::mem::replace(&mut filling.guessed[i], false) {
                filling.rgb[i] = self.rgb[i];
            }
        }
    }
}

/// The surface of a pixel: what is on none by its surroundings may lie on a plane all the same, by its own depth.
fn surface(sight: &Sight, camera: &Camera, i: usize) -> Option<u8> {
    let w = camera.size[0] as usize;
    let ray = camera.unproject([(i % w) as f64 + 0.5, (i / w) as f64 + 0.5])?;
    let place = sight.grid.place(ray);
    let label = sight.surface_at(place);
    if usize::from(label) < sight.planes.len() {
        return Some(label);
    }
    let z = sight.depth_at(place);
    let off = |plane: &Plane| (planes::on(plane, ray) * z - 1.0).abs();
    let near = sight.planes.iter().map(off).enumerate().filter(|(_, off)| *off <= SAME);
    Some(near.min_by(|a, b| a.1.total_cmp(&b.1)).map_or(label, |(plane, _)| plane as u8))
}

/// Fills the hole of a view that is not solved yet from all surfaces around it, and has its surfaces expected where they are copied
/// to; nothing where planes tell more.
pub fn expect(sights: &mut Sights, photographs: &[Photograph<'_>], of: usize, seed: u64) -> Option<Whole> {
    if sights.0[of].knows_planes() {
        return None;
    }
    let mut solved = sights.clone();
    solved.solve(of, seed);
    let (sight, camera) = (&solved.0[of], &photographs[of].camera);
    let filling = color::gather(&solved, photographs, of);
    let whole = Whole::of(&filling, camera.size.map(|n| n as usize))?;
    sights.0[of].expected = whole.surfaces(sight, camera);
    Some(whole)
}

#[cfg(test)]
mod tests {
    use image::RgbImage;

    use super::super::surface::tests::{SIZE, views};
    use super::*;

    /// A red wall and a far green one behind it, which begins at an oblique line. The cameras of all other views are wrong, so that
    /// none tells of the hole: in it, too, both go on along their line, in colour and in depth.
    #[test]
    fn what_is_expected_is_what_the_picture_goes_on_with() {
        const OF: usize = 2;
        let (mut grids, cameras, masks) = views(0.4);
        let camera = cameras[OF];
        let red = |i: usize| (i % SIZE[0] as usize) as f64 + 0.5 < 20.0 + 0.25 * (i / SIZE[0] as usize) as f64;
        grids.iter_mut().enumerate().filter(|(view, _)| *view != OF).for_each(|(_, grid)| grid.trusted = false);
        for (i, depth) in grids[OF].depth.iter_mut().enumerate().filter(|(i, z)| **z > 3.0 && !red(*i)) {
            *depth = 6.0 + 0.001 * i as f64 / f64::from(SIZE[0]);
        }
        let pixels = (SIZE[0] * SIZE[1]) as usize;
        let bytes = (0..pixels).flat_map(|i| if red(i) { [180, 40, 40] } else { [40, 160, 60] }).collect();
        let picture = RgbImage::from_raw(SIZE[0], SIZE[1], bytes).expect("three bytes per pixel");
        let photographs: Vec<Photograph<'_>> = (cameras.iter().zip(&masks))
            .map(|(camera, hole)| Photograph { camera: *camera, picture: &picture, hole: hole.clone() })
            .collect();
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        let whole = expect(&mut sights, &photographs, OF, 1).expect("two surfaces meet");
        sights.solve(OF, 1);
        let mut filling = color::gather(&sights, &photographs, OF);
        let hole: Vec<usize> = (0..pixels).filter(|i| filling.guessed[*i]).collect();
        assert!(hole.len() > 100, "{}", hole.len());
        hole.iter().for_each(|i| filling.rgb[*i] = [0.0; 3]);
        whole.paint(&mut filling);
        let [colors, depths] = [0, 1].map(|of| {
            let right = hole.iter().filter(|i| match of {
                0 => !filling.guessed[**i] && (filling.rgb[**i][0] > filling.rgb[**i][1]) == red(**i),
                _ => (surface(&sights.0[OF], &camera, **i) == surface(&sights.0[OF], &camera, 0)) == red(**i),
            });
            right.count() as f64 / hole.len() as f64
        });
        assert!(colors > 0.9 && depths > 0.9, "{colors}, {depths} of {}", hole.len());
    }

    /// Planes that are known by more than depth tell where they end.
    #[test]
    fn known_planes_need_no_picture() {
        let (grids, cameras, masks) = views(0.4);
        let picture = RgbImage::new(SIZE[0], SIZE[1]);
        let photographs: Vec<Photograph<'_>> = (cameras.iter().zip(&masks))
            .map(|(camera, hole)| Photograph { camera: *camera, picture: &picture, hole: hole.clone() })
            .collect();
        let mut sights = Sights::new(grids, &cameras, &masks, &masks);
        sights.0[2].around = vec![[0.0, 0.0, 0.25]];
        assert!(expect(&mut sights, &photographs, 2, 1).is_none() && sights.0[2].expected.is_empty());
    }
}
