//! Photographs whose cameras are wrong: masks of theirs that are not carried, and masks that are carried beside the object.
//!
//! A mask in a photograph that stands elsewhere than its camera is carried to whatever else is in its way.
//!
//! A camera that a model without texture has a little turned still fits its few points, and what is carried to it falls beside the
//! object: half of that is outside the mask, for every other photograph to take for what is behind it. The object's colours tell:
//! they are learnt where its masks are given, and a mask under which they are not is moved to where they are.

use std::collections::{BTreeMap, BTreeSet};

use image::{GrayImage, RgbImage};

use super::object::Given;
use super::{Error, abridged, masks};
use crate::multiview::DepthGrid;
use crate::scene::{Scene, View, resample};

/// Longer side of the pictures that masks are moved in, pixels.
const SIDE: u32 = 160;
/// Steps of a colour's channels.
const STEPS: usize = 12;
/// Share of a colour's count that goes to each of its six neighbours.
const SPREAD: f64 = 0.1;
/// Colours that are this rare on one side tell no more than those that are half as rare.
const RARE: f64 = 1e-5;
/// The logarithm of how much likelier a colour is on one side, at most.
const SURE: f32 = 3.0;
/// Surroundings that the object's colours are compared with, as parts of the mask's longer side: those of the given masks, and
/// those of a mask that is looked at.
const AROUND: f64 = 0.5;
const BESIDE: f64 = 0.15;
/// A mask is moved at most by this part of its shorter side.
const FARTHEST: f64 = 0.5;
/// Smallest mask that is looked at, pixels of the reduced picture.
const LEAST: usize = 40;
/// The mean of the logarithms in a mask without that beside it: moved to at least this, and so much more than where it was. Right masks
/// of six captures have 3 to 5, and gain 0.3 at most; one beside its object had -0.7 and gained 4. Masks at the border of a picture,
/// of which little is seen, come to less than 2.
const FITS: f32 = 2.0;
const BETTER: f32 = 1.5;
/// The mean of the logarithms from which on a mask lies on the object, whatever is beside it: two thirds of a mask where colours are sure.
const THERE: f32 = 1.0;

/// Names of the train views whose cameras are in a wrong place, by what the others show.
pub fn wrong<'a>(scene: &'a Scene, grids: &[DepthGrid]) -> BTreeSet<&'a str> {
    scene.train.iter().zip(grids).filter(|(_, grid)| !grid.trusted).map(|(view, _)| view.name.as_str()).collect()
}

/// A line on the train views whose cameras are in a wrong place, if there are any.
pub fn said(scene: &Scene, grids: &[DepthGrid]) -> Option<String> {
    let wrong = wrong(scene, grids);
    (!wrong.is_empty()).then(|| {
        format!(
            "the model has the cameras of {} of {} photographs in a wrong place, by what the others show; nothing is taken from these: {}. \
             More photographs between them and the others, or all pairs matched (colmap exhaustive_matcher), may mend the model",
            wrong.len(),
            scene.train.len(),
            Vec::from_iter(wrong).join(", ")
        )
    })
}

/// The views whose given masks are carried to the others, and a line on those whose masks are not, being wrong.
///
/// # Errors
/// Where no given mask can be carried.
pub fn voters<'a>(
    scene: &'a Scene,
    wrong: &BTreeSet<&str>,
    given: &BTreeMap<String, Given>,
) -> Result<(Vec<&'a View>, Option<String>), Error> {
    let masked = scene.train.iter().filter(|view| given.contains_key(&view.name));
    let (lost, voters): (Vec<&View>, Vec<&View>) = masked.partition(|view| wrong.contains(view.name.as_str()));
    let names: Vec<&str> = lost.iter().map(|view| view.name.as_str()).collect();
    let why = "the model has the camera in a wrong place, for what is seen from there contradicts most other photographs, or agrees with them next to nowhere";
    match (lost.first(), voters.is_empty()) {
        (None, _) => Ok((voters, None)),
        (Some(_), false) => {
            Ok((voters, Some(format!("{}: {why}; the masks there are not carried to these", abridged(&names)))))
        }
        (Some(first), true) => {
            let right = scene.train.iter().map(|view| view.name.as_str()).filter(|name| !wrong.contains(name));
            let (before, after): (Vec<&str>, Vec<&str>) = right.partition(|name| *name < first.name.as_str());
            let hint = after.first().or(before.last()).map_or_else(String::new, |name| format!(", such as {name}"));
            let what =
                format!("{}: {why}, so that no mask is carried to these; mask another one{hint}", abridged(&names));
            Err(Error::Request(what))
        }
    }
}

/// The colours of the object, and of what is around it where its masks are given.
pub struct Looks {
    /// `[colour]` the logarithm of how much likelier it is on the object.
    likelier: Vec<f32>,
}

/// The size at which masks are moved.
fn reduced(size: [u32; 2]) -> [u32; 2] {
    let longest = size[0].max(size[1]).max(1);
    size.map(|n| (n * SIDE.min(longest) / longest).max(1))
}

fn color(pixel: [u8; 3]) -> usize {
    pixel.iter().fold(0, |number, v| number * STEPS + usize::from(*v) * STEPS / 256)
}

/// `[pixel]` whether it lies beside a mask, no farther than this part of the mask's longer side.
fn beside(mask: &GrayImage, part: f64) -> Vec<bool> {
    let on = || mask.enumerate_pixels().filter(|(_, _, v)| v.0[0] != 0);
    let extent = |of: &dyn Fn(u32, u32) -> u32| {
        let (low, high) = on().fold((u32::MAX, 0), |(a, b), (x, y, _)| (a.min(of(x, y)), b.max(of(x, y))));
        high.saturating_sub(low)
    };
    let longer = extent(&|x, _| x).max(extent(&|_, y| y));
    let near = resample::dilate(mask, ((part * f64::from(longer)).round() as u32).max(2));
    near.as_raw().iter().zip(mask.as_raw()).map(|(near, own)| *near != 0 && *own == 0).collect()
}

impl Looks {
    /// Learnt from photographs and their masks, which need not be of one size; nothing where these show no object, or nothing but.
    pub fn of<'a>(masked: impl Iterator<Item = (&'a RgbImage, &'a GrayImage)>) -> Option<Self> {
        let mut counts = [vec![0.0f64; STEPS.pow(3)], vec![0.0f64; STEPS.pow(3)]];
        for (picture, mask) in masked {
            let size = reduced(picture.dimensions().into());
            let picture = resample::photograph(picture, size);
            let mask = masks::threshold(&masks::parts(mask, size), size, size, 0.5);
            let around = beside(&mask, AROUND);
            for (i, pixel) in picture.pixels().enumerate() {
                let side = match (mask.as_raw()[i] != 0, around[i]) {
                    (true, _) => 0,
                    (false, true) => 1,
                    (false, false) => continue,
                };
                counts[side][color(pixel.0)] += 1.0;
            }
        }
        let [inside, outside] = counts.map(|counts| {
            let sum: f64 = counts.iter().sum();
            spread(&counts).into_iter().map(move |count| count / sum).collect::<Vec<f64>>()
        });
        let likelier =
            inside.iter().zip(&outside).map(|(a, b)| (((a + RARE) / (b + RARE)).ln() as f32).clamp(-SURE, SURE));
        let likelier: Vec<f32> = likelier.collect();
        likelier.iter().all(|v| v.is_finite()).then_some(Self { likelier })
    }

    /// The parts of the picture's width and height by which a mask of any size is to be moved to lie on the object; nothing where it does, and
    /// where colours do not tell.
    pub fn shift(&self, picture: &RgbImage, mask: &GrayImage) -> Option<[f64; 2]> {
        let size @ [w, h] = reduced(picture.dimensions().into());
        let picture = resample::photograph(picture, size);
        let mask = masks::threshold(&masks::parts(mask, size), size, size, 0.5);
        let likelier: Vec<f32> = picture.pixels().map(|pixel| self.likelier[color(pixel.0)]).collect();
        let around = beside(&mask, BESIDE);
        let place = |i: usize| [i as i32 % w as i32, i as i32 / w as i32];
        let all = || 0..mask.as_raw().len();
        let inside: Vec<[i32; 2]> = all().filter(|i| mask.as_raw()[*i] != 0).map(place).collect();
        let outside: Vec<[i32; 2]> = all().filter(|i| around[*i]).map(place).collect();
        if inside.len() < LEAST || outside.is_empty() {
            return None;
        }
        let shorter = (0..2).map(|a| {
            let along = || inside.iter().map(|at| at[a]);
            along().max().unwrap_or(0) - along().min().unwrap_or(0) + 1
        });
        let farthest = (FARTHEST * f64::from(shorter.min().unwrap_or(0))).round() as i32;
        // Beyond the picture nothing tells.
        let mean = |of: &[[i32; 2]], [dx, dy]: [i32; 2]| {
            let at = |[x, y]: &[i32; 2]| {
                let [x, y] = [x + dx, y + dy];
                let inside = x >= 0 && y >= 0 && x < w as i32 && y < h as i32;
                if inside { likelier[(y * w as i32 + x) as usize] } else { 0.0 }
            };
            of.iter().map(at).sum::<f32>() / of.len() as f32
        };
        // What looks like the object may be behind it.
        if mean(&inside, [0, 0]) >= THERE {
            return None;
        }
        let fits = |shift: [i32; 2]| mean(&inside, shift) - mean(&outside, shift);
        let shifts = (-farthest..=farthest).flat_map(|dy| (-farthest..=farthest).map(move |dx| [dx, dy]));
        let (best, shift) =
            shifts.map(|shift| (fits(shift), shift)).reduce(|best, next| if next.0 > best.0 { next } else { best })?;
        let moved = best >= FITS && best >= fits([0, 0]) + BETTER;
        moved.then(|| [f64::from(shift[0]) / f64::from(w), f64::from(shift[1]) / f64::from(h)])
    }
}

/// Counts of colours, with some of each at its neighbours.
fn spread(counts: &[f64]) -> Vec<f64> {
    let mut all = vec![0.0; counts.len()];
    for (i, count) in counts.iter().enumerate().filter(|(_, count)| **count > 0.0) {
        all[i] += count;
        for step in [1, STEPS, STEPS * STEPS] {
            let along = i / step % STEPS;
            if along > 0 {
                all[i - step] += SPREAD * count;
            }
            if along + 1 < STEPS {
                all[i + step] += SPREAD * count;
            }
        }
    }
    all
}

/// A map (width, height `size`) moved by parts of its width and height; 0 where nothing comes from.
pub fn moved(map: &[f32], [w, h]: [u32; 2], shift: [f64; 2]) -> Vec<f32> {
    let [dx, dy] = [shift[0] * f64::from(w), shift[1] * f64::from(h)].map(|v| v.round() as i64);
    let from = |i: usize| {
        let [x, y] = [i as i64 % i64::from(w) - dx, i as i64 / i64::from(w) - dy];
        let inside = x >= 0 && y >= 0 && x < i64::from(w) && y < i64::from(h);
        if inside { map[(y * i64::from(w) + x) as usize] } else { 0.0 }
    };
    (0..map.len()).map(from).collect()
}

#[cfg(test)]
mod tests {
    use image::{Luma, Rgb};

    use super::*;
    use crate::scene::{self, synthetic};

    /// A blue can with a red label on a grey floor, its left side at this column.
    fn picture(left: u32) -> (RgbImage, GrayImage) {
        let on = |x: u32, y: u32| (left..left + 30).contains(&x) && (30..90).contains(&y);
        let noise = |x: u32, y: u32| ((x * 7 + y * 13) % 9) as u8;
        let color = |x, y| match (on(x, y), y > 50) {
            (true, false) => Rgb([30, 40, 150 + noise(x, y)]),
            (true, true) => Rgb([190 + noise(x, y), 70, 60]),
            (false, _) => Rgb([170 + noise(x, y); 3]),
        };
        let mask = GrayImage::from_fn(160, 120, |x, y| Luma([if on(x, y) { 255 } else { 0 }]));
        (RgbImage::from_fn(160, 120, color), mask)
    }

    /// A mask in a photograph whose camera is wrong is not carried; where there is no other, another photograph is named.
    #[test]
    fn masks_of_wrong_cameras_are_not_carried() {
        let folder = tempfile::tempdir().expect("a folder");
        let dir = folder.path().join("scene");
        let options = synthetic::Options {
            width: 32,
            height: 24,
            train_views: 4,
            test_views: 0,
            points: 50,
            ..Default::default()
        };
        synthetic::write(&dir, &options).expect("a scene");
        let scene = scene::load(&dir, &scene::Config::default()).expect("it loads");
        let name = |at: usize| scene.train[at].name.clone();
        let mask = || Given::fixed(GrayImage::new(32, 24), String::new());
        let given =
            |views: &[usize]| -> BTreeMap<String, Given> { views.iter().map(|at| (name(*at), mask())).collect() };
        let (own, other, next) = (name(1), name(2), name(3));
        let wrong = BTreeSet::from([own.as_str(), other.as_str()]);
        let found = |views: &[usize]| voters(&scene, &wrong, &given(views));
        let (voters, note) = found(&[1, 3]).expect("one is right");
        assert_eq!(voters.iter().map(|view| &view.name).collect::<Vec<_>>(), [&next]);
        assert!(note.is_some_and(|note| note.starts_with(&format!("{own}: "))));
        assert!(found(&[0, 3]).is_ok_and(|(voters, note)| voters.len() == 2 && note.is_none()));
        let error = found(&[1, 2]).expect_err("both are wrong").to_string();
        assert!(
            error.starts_with(&format!("{own}, {other}: ")) && error.ends_with(&format!("such as {next}")),
            "{error}"
        );
    }

    #[test]
    fn a_mask_beside_the_object_is_moved_onto_it() {
        let (learnt, mask) = picture(60);
        let looks = Looks::of(std::iter::once((&learnt, &mask))).expect("an object");
        // The camera is wrong by twelve pixels.
        let (other, truth) = picture(72);
        let shift = looks.shift(&other, &mask).expect("it is moved");
        assert!((shift[0] * 160.0 - 12.0).abs() < 1.01 && (shift[1] * 120.0).abs() < 1.01, "{shift:?}");
        let back = moved(&masks::parts(&mask, [160, 120]), [160, 120], [12.0 / 160.0, 0.0]);
        assert_eq!(masks::threshold(&back, [160, 120], [160, 120], 0.5), truth);
        // By a pixel or two is what the outline is refined by.
        assert_eq!(looks.shift(&picture(62).0, &mask), None);
    }

    /// Before a wall of the object's colours a mask on the object stays, though the end of the wall stands out more.
    #[test]
    fn what_looks_like_the_object_behind_it_does_not_move_it() {
        let (learnt, mask) = picture(60);
        let looks = Looks::of(std::iter::once((&learnt, &mask))).expect("an object");
        let wall = |x: u32, y: u32| (45..105).contains(&x) && (28..92).contains(&y);
        let other =
            RgbImage::from_fn(160, 120, |x, y| if wall(x, y) { Rgb([190, 70, 60]) } else { *learnt.get_pixel(x, y) });
        assert_eq!(looks.shift(&other, &mask), None);
    }

    /// Where the object's colours are those of its surroundings, and where it is out of the picture, its mask stays.
    #[test]
    fn what_colours_do_not_tell_is_not_moved() {
        let (learnt, mask) = picture(60);
        let looks = Looks::of(std::iter::once((&learnt, &mask))).expect("an object");
        let floor = RgbImage::from_pixel(160, 120, Rgb([172; 3]));
        assert_eq!(looks.shift(&floor, &mask), None);
        let plain = Looks::of(std::iter::once((&floor, &mask))).expect("an object");
        assert_eq!(plain.shift(&learnt, &mask), None);
        assert!(Looks::of(std::iter::once((&learnt, &GrayImage::new(160, 120)))).is_none());
    }
}
