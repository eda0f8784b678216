//! Which masks of a composed scene the preparation gets: as few as a user gives.

use std::path::Path;

use glam::{DMat3, DVec3};
use image::GrayImage;

use super::Error;
use super::truth::{self, Truth};
use crate::scene::{Camera, View};

/// Longer side of the pictures that are looked at, pixels.
const SIDE: u32 = 256;
/// Cameras stand all around where the directions to two of them are farther apart than this, as a cosine: 120 degrees.
const AROUND: f64 = -0.5;
/// A further mask must be at least this share as large as the largest: a user names a view that shows the object well.
const LEAST: f64 = 0.3;

/// The names of the views whose masks are given: the one with the largest that does not touch the border, and each further
/// one as far from those before it as possible. As many as asked for; unasked one, or two where cameras stand all around.
pub(super) fn choose(set: &Path, truth: &Truth, masks: Option<usize>) -> Result<Vec<String>, Error> {
    let mut scene = truth::load(set, SIDE)?;
    scene.train.retain(|view| !truth.wrong.contains(&view.name));
    let shown: Vec<(&View, &GrayImage, usize)> = scene
        .train
        .iter()
        .filter_map(|view| {
            let mask = view.mask.as_ref()?;
            Some((view, mask, mask.as_raw().iter().filter(|v| **v != 0).count()))
        })
        .filter(|(.., pixels)| *pixels > 0)
        .collect();
    let place = place(&shown);
    let direction = |camera: &Camera| (DVec3::from(camera.center()) - place).normalize_or_zero();
    let whole = shown.iter().any(|(_, mask, _)| !touches_border(mask));
    let largest =
        shown.iter().filter(|(_, mask, _)| !whole || !touches_border(mask)).max_by_key(|(.., pixels)| *pixels);
    let Some((first, _, most)) = largest else {
        return Err(Error::Set { path: set.to_owned(), what: "no view with a right camera shows the object" });
    };
    let mut chosen = vec![*first];
    let usable: Vec<&View> =
        shown.iter().filter(|(.., pixels)| *pixels as f64 >= LEAST * *most as f64).map(|(view, ..)| *view).collect();
    // How far a view is from the nearest of those chosen, as a cosine.
    let near = |view: &View, chosen: &[&View]| {
        let own = direction(&view.camera);
        chosen.iter().map(|other| own.dot(direction(&other.camera))).fold(-1.0, f64::max)
    };
    let wanted = masks.unwrap_or_else(|| {
        let farthest = usable.iter().map(|view| near(view, &chosen)).fold(1.0, f64::min);
        if farthest < AROUND { 2 } else { 1 }
    });
    while chosen.len() < wanted {
        let rest = usable.iter().filter(|view| !chosen.iter().any(|known| known.name == view.name));
        let Some(next) = rest.min_by(|a, b| near(a, &chosen).total_cmp(&near(b, &chosen))) else { break };
        chosen.push(*next);
    }
    Ok(chosen.into_iter().map(|view| view.name.clone()).collect())
}

fn touches_border(mask: &GrayImage) -> bool {
    let (w, h) = mask.dimensions();
    mask.enumerate_pixels().any(|(x, y, v)| v.0[0] != 0 && (x == 0 || y == 0 || x + 1 == w || y + 1 == h))
}

/// Where the object is: the point nearest to the rays through the middles of its masks.
fn place(shown: &[(&View, &GrayImage, usize)]) -> DVec3 {
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for (view, mask, pixels) in shown {
        let sum = mask
            .enumerate_pixels()
            .filter(|(.., v)| v.0[0] != 0)
            .fold([0.0; 2], |[a, b], (x, y, _)| [a + f64::from(x) + 0.5, b + f64::from(y) + 0.5]);
        let Some(ahead) = view.camera.lift(sum.map(|v| v / *pixels as f64), 1.0) else { continue };
        let center = DVec3::from(view.camera.center());
        let ray = (DVec3::from(ahead) - center).normalize();
        // Across the ray alone: the identity less the ray's own direction.
        let across = DMat3::IDENTITY - DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
        normal += across;
        right += across * center;
    }
    // Rays that are all parallel meet nowhere; all directions are alike then.
    if normal.determinant().abs() > 1e-9 { normal.inverse() * right } else { DVec3::ZERO }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{room360, synthetic};

    #[test]
    fn one_mask_from_one_side_and_two_from_all_around() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let [room, around] = ["room", "around"].map(|name| folder.path().join(name));
        let options =
            synthetic::Options { width: 80, height: 60, train_views: 10, test_views: 0, ..Default::default() };
        synthetic::write(&room, &options).expect("a scene");
        synthetic::write_bare(&room, &options).expect("its truth");
        let options = room360::Options { width: 80, height: 60, train_views: 16, test_views: 0, ..Default::default() };
        room360::write(&around, &options).expect("a scene");
        room360::write_bare(&around, &options).expect("its truth");
        let truth = Truth { wrong: vec![], seen_share: 1.0, depth: String::new() };
        assert_eq!(choose(&room, &truth, None).expect("a mask").len(), 1);
        assert_eq!(choose(&room, &truth, Some(3)).expect("three masks").len(), 3);
        let two = choose(&around, &truth, None).expect("two masks");
        assert_eq!(two.len(), 2);
        let scene = truth::load(&around, SIDE).expect("it loads");
        let [a, b] = [0, 1].map(|i| {
            let view = scene.train.iter().find(|view| view.name == two[i]).expect("its view");
            DVec3::from(view.camera.center()) - DVec3::new(0.0, 0.0, 0.5)
        });
        assert!(a.angle_between(b) > 2.0, "they stand opposite: {two:?}");
        // A view with a wrong camera is not named.
        let truth = Truth { wrong: vec![two[0].clone()], ..truth };
        assert!(!choose(&around, &truth, None).expect("two others").contains(&two[0]));
    }
}
