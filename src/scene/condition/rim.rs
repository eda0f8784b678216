//! The object's rim: its shadow, its glow and its antialiased edge reach beyond the masks.

use image::{GrayImage, RgbImage};

use super::judge::Rims;
use crate::scene::{Scene, resample};

/// How far beyond a mask is looked, as a share of the picture's longer side.
const REACH: f64 = 0.025;
/// A ring was repainted where it differs from the photograph by more than so many times what the rest of the picture does ...
const TIMES: f64 = 2.0;
/// ... and one level of 8 bits, which rounding alone makes.
const LEVEL: f64 = 1.0;

/// A single ring is what resampling mixes at a mask's edge.
const FEWEST: u32 = 2;

/// Says by how many pixels an inpainted picture was repainted beyond its mask. Who inpaints takes the object's shadow along, in
/// a wider mask than the one delivered; the photographs still show it there. Masks as wide would lose what else they show.
pub(super) fn note_repainted(scene: &mut Scene) {
    let radius = |reference: &crate::scene::Reference| {
        let view = &scene.train[reference.view];
        Some((repainted(&reference.image, &view.image, view.mask.as_ref()?), view.name.clone()))
    };
    let inpainted = scene.references.iter().filter(|reference| !reference.truth);
    let Some((radius, name)) = inpainted.filter_map(radius).max_by_key(|(radius, _)| *radius) else { return };
    if radius >= FEWEST {
        scene.notes.push(format!(
            "reference {name} is repainted up to {radius} pixels beyond its mask; should a shadow stay around the hole, \
             --set scene.dilate_masks={radius} removes it"
        ));
    }
}

/// Rings around the mask, a pixel wide each, that differ from the photograph; counted up to the first that does not.
fn repainted(painted: &RgbImage, photograph: &RgbImage, mask: &GrayImage) -> u32 {
    let reach = (REACH * f64::from(mask.width().max(mask.height()))).ceil() as u32;
    let apart: Vec<f64> = painted
        .pixels()
        .zip(photograph.pixels())
        .map(|(p, q)| p.0.iter().zip(q.0).map(|(p, q)| f64::from(p.abs_diff(q))).sum::<f64>() / 3.0)
        .collect();
    // Mean over the pixels that are in the first mask and not in the second.
    let mean = |within: &dyn Fn(usize) -> bool| {
        let (sum, count) = apart
            .iter()
            .enumerate()
            .filter(|(pixel, _)| within(*pixel))
            .fold((0.0, 0_usize), |(sum, count), (_, apart)| (sum + apart, count + 1));
        (count > 0).then(|| sum / count as f64)
    };
    let far = resample::dilate(mask, 2 * reach);
    let Some(rest) = mean(&|pixel| far.as_raw()[pixel] == 0) else { return 0 };
    let mut inner = mask.clone();
    for radius in 1..=reach {
        let outer = resample::dilate(mask, radius);
        let ring = mean(&|pixel| outer.as_raw()[pixel] != 0 && inner.as_raw()[pixel] == 0);
        if ring.is_none_or(|ring| ring <= TIMES * rest + LEVEL) {
            return radius - 1;
        }
        inner = outer;
    }
    reach
}

/// Gives each train view with a mask its [`View::weight`](crate::scene::View::weight), which falls off to 0 over `rim`
/// pixels around the mask: the object's antialiased edge, shadow and glow reach beyond it.
pub(super) fn soften(scene: &mut Scene, rim: u32) {
    for view in &mut scene.train {
        let Some(hard) = &view.mask else { continue };
        let weight = view.weight.insert(hard.clone());
        for radius in (1..=rim).rev() {
            let value = (255.0 * (1.0 - f64::from(radius) / f64::from(rim + 1))).round() as u8;
            let grown = resample::dilate(hard, radius);
            // From the outermost ring inwards: nearer rings overwrite.
            weight.iter_mut().zip(grown.as_raw()).filter(|(_, g)| **g != 0).for_each(|(w, _)| *w = value);
        }
        weight.iter_mut().zip(hard.as_raw()).filter(|(_, h)| **h != 0).for_each(|(w, h)| *w = *h);
    }
}

/// Raises the train views' weights where other views do not confirm what is around the masks.
pub(super) fn raise(scene: &mut Scene, rims: &Rims) {
    for (weight, values) in scene.train.iter_mut().map(|v| v.weight.as_mut()).zip(&rims.values) {
        let Some(weight) = weight else { continue };
        weight.iter_mut().zip(values).for_each(|(w, v)| *w = (*w).max(*v));
    }
    let Some(first) = rims.shares.first() else { return };
    scene.notes.push(format!(
        "the masks are too tight: by what the other views see there, {:.0} % of the pixels next to them show the object, and \
         some do up to {} pixels away; these are left out (scene.judge_rim)",
        100.0 * first,
        rims.shares.len()
    ));
}

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;
    use crate::scene::{Config, load, synthetic};

    fn scene() -> Scene {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        let options =
            synthetic::Options { width: 160, height: 120, train_views: 6, test_views: 1, ..Default::default() };
        synthetic::write(&dir, &options).expect("a scene");
        load(&dir, &Config::default()).expect("it loads")
    }

    /// Changes the reference's pixels up to so many `beyond` the mask; `paint` gets a pixel's index and its colour.
    fn painted(scene: &mut Scene, beyond: u32, paint: impl Fn(u32, Rgb<u8>) -> Rgb<u8>) {
        let reference = &mut scene.references[0];
        let mask = scene.train[reference.view].mask.as_ref().expect("a mask");
        let wide = resample::dilate(mask, beyond);
        for (i, (pixel, w)) in reference.image.pixels_mut().zip(wide.as_raw()).enumerate() {
            if *w != 0 {
                *pixel = paint(i as u32, *pixel);
            }
        }
    }

    /// The weight is 255 in the mask, falls off evenly over the rim and is 0 beyond; the mask stays as it was delivered.
    #[test]
    fn the_weight_falls_off_and_the_mask_stays() {
        let mut scene = scene();
        let masks: Vec<Option<GrayImage>> = scene.train.iter().map(|v| v.mask.clone()).collect();
        scene.train[1].mask = None;
        soften(&mut scene, 2);
        assert_eq!(scene.train[1].weight, None, "without a mask every pixel has the weight outside");
        for (view, mask) in scene.train.iter().zip(&masks).filter(|(view, _)| view.mask.is_some()) {
            assert_eq!(view.mask, *mask);
            let weight = view.blend().expect("a weight");
            let ring = |radius: u32| resample::dilate(view.mask.as_ref().expect("a mask"), radius).into_raw();
            let [mask, near, far] = [ring(0), ring(1), ring(2)];
            for (pixel, value) in weight.as_raw().iter().enumerate() {
                let expected = match [mask[pixel], near[pixel], far[pixel]] {
                    [255, ..] => 255,
                    [_, 255, _] => 170,
                    [.., 255] => 85,
                    _ => 0,
                };
                assert_eq!(*value, expected, "{} {pixel}", view.name);
            }
        }
    }

    #[test]
    fn it_is_said_how_far_beyond_the_mask_was_repainted() {
        let mut scene = scene();
        // The built-in reference is the photograph outside its hole.
        let own = {
            let reference = &scene.references[0];
            let view = &scene.train[reference.view];
            repainted(&reference.image, &view.image, view.mask.as_ref().expect("a mask"))
        };
        assert_eq!(own, 0, "nothing was repainted");
        note_repainted(&mut scene);
        assert!(scene.notes.iter().all(|n| !n.contains("beyond its mask")));

        // A network leaves noise everywhere, and another colour up to three pixels beyond the mask.
        painted(&mut scene, 1000, |i, p| Rgb(p.0.map(|v| v.saturating_add((i * 7 % 5) as u8))));
        painted(&mut scene, 3, |_, p| Rgb(p.0.map(|v| 255 - v)));
        note_repainted(&mut scene);
        let note = scene.notes.last().expect("a note");
        assert!(note.contains("3 pixels beyond its mask") && note.contains("--set scene.dilate_masks=3"), "{note}");
    }

    /// Not what a network left, but the place itself at another time.
    #[test]
    fn the_truth_was_not_repainted() {
        let mut scene = scene();
        painted(&mut scene, 3, |_, p| Rgb(p.0.map(|v| 255 - v)));
        scene.references[0].truth = true;
        note_repainted(&mut scene);
        assert!(scene.notes.iter().all(|n| !n.contains("beyond its mask")));
    }

    #[test]
    fn a_picture_of_which_nothing_is_left_tells_nothing() {
        let white = RgbImage::from_pixel(40, 30, Rgb([255; 3]));
        let black = RgbImage::new(40, 30);
        assert_eq!(repainted(&white, &black, &GrayImage::from_pixel(40, 30, image::Luma([255]))), 0);
        let mut spot = GrayImage::new(40, 30);
        spot.put_pixel(20, 15, image::Luma([255]));
        assert_eq!(repainted(&white, &black, &spot), 0, "it differs everywhere alike");
    }
}
