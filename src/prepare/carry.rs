//! The step masks: what is known of each object in some views, carried to all others, and the objects together.
//!
//! A mask says of every pixel whether it is of its object, so that each object's masks vote by themselves: who marks one object
//! in one photograph and another one in the next does not say that the first is not there.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use image::{GrayImage, RgbImage};
use rayon::prelude::*;

use super::click::Cues;
use super::depth::DepthMap;
use super::fit::Fit;
use super::misplaced::{self, Looks};
use super::object::{Given, USERS, Wanted, joined};
use super::record::{Batch, Inputs};
use super::splats::Splats;
use super::{Error, Preparation, Step, Watch, abridged, hole, masks, outline, picture_size, poses};
use crate::multiview::DepthGrid;
use crate::scene::doctor::iou;
use crate::scene::{self, Camera, Scene, View};

/// A view shows a side of the object that no masked view shows if more than this part of the object there is unseen.
const THIN: f64 = 0.3;
/// Times that what was drawn is cut at most, and the overlap of two masks (intersection over union) from which on it stays.
const CUTS: usize = 4;
const SAME: f64 = 0.98;

/// What an object is carried with.
struct Carrier<'a> {
    scene: &'a Scene,
    fit: &'a Fit,
    /// Colours of the fit's anchors.
    colors: Vec<[f32; 3]>,
    /// `[view]` depth as it is measured; none where nothing needs it.
    grids: Vec<DepthGrid>,
    /// The photographs' files by name.
    files: BTreeMap<String, PathBuf>,
    /// `[view]` the photographs.
    pictures: Vec<RgbImage>,
    /// Units of the step that are done.
    units: u64,
}

/// An object in all views.
struct Carried {
    /// `[view]` its mask, as large as the photograph, and what it was made from.
    masks: Vec<(GrayImage, String)>,
    /// Views that show it.
    shown: usize,
    /// What was found out.
    notes: Vec<String>,
}

/// The views of a scene by what they say of an object.
struct Views<'a> {
    /// Views whose given masks vote.
    voters: Vec<&'a View>,
    /// Indices of those without a given mask.
    others: Vec<usize>,
    /// Names of the views whose cameras are wrong.
    wrong: BTreeSet<&'a str>,
}

impl Views<'_> {
    /// Whether a mask of this view says something of the other views.
    fn helps(&self, scene: &Scene, at: usize) -> bool {
        !self.wrong.contains(scene.train[at].name.as_str())
    }
}

/// An object as its given masks alone show it.
struct First<'a> {
    /// `[anchor]` whether it is behind the object and apart from it.
    behind: Vec<bool>,
    /// Names of the views whose masks lost what is behind.
    lost: Vec<&'a str>,
    /// `[view][pixel]` whether what is there is none of the object.
    beside: Vec<Vec<bool>>,
    /// Colours of the object and of what is around it.
    looks: Option<Looks>,
    /// `[other view]` the object.
    carried: Vec<masks::Carried>,
}

impl Preparation<'_> {
    pub(super) fn masks(
        &mut self,
        scene: &Scene,
        fit: &Fit,
        splats: &mut Splats,
        wanted: &Wanted,
    ) -> Result<(), Error> {
        let objects = &wanted.objects;
        let several = objects.len() > 1;
        let mut inputs = Inputs::default().with(self.fit_hash()).with(outline::METHOD);
        for (object, given) in objects {
            inputs = if several { inputs.with(object) } else { inputs };
            for (name, Given { mask, from, .. }) in given {
                inputs = inputs.with(name).with(mask.as_raw()).with(from);
            }
        }
        let whole = wanted.whole.iter();
        let inputs = whole.fold(inputs, |inputs, (name, given)| inputs.with(name).with(given.mask.as_raw())).finish();
        if self.skips(Step::Masks, &inputs)? {
            return Ok(());
        }
        let posed = |name: &str| scene.train.iter().any(|view| view.name == name);
        if let Some(name) = objects.iter().flat_map(|(_, given)| given.keys()).find(|name| !posed(name)) {
            return Err(Error::Request(format!(
                "{name}: the model has no camera for this photograph; mask another one"
            )));
        }
        if objects.is_empty() {
            return Err(Error::Request("no view has a mask yet: name one with --mask NAME=FILE.png".into()));
        }
        let units: usize = objects.iter().map(|(_, given)| given.len() + scene.train.len()).sum();
        self.watch.begin(Step::Masks, units as u64);
        let needs_depth = |given: &BTreeMap<String, Given>| {
            !is_in_all(scene, given) || given.values().any(|given| !given.drawn.is_empty())
        };
        let needed = objects.iter().any(|(_, given)| needs_depth(given));
        let grids = if needed { self.matched(scene)?.depths(scene) } else { vec![] };
        let files = scene::pictures(&self.folder.root().join(poses::IMAGES))?;
        let mut carrier = Carrier::new(scene, fit, splats, grids, files)?;
        let mut batch = Batch::default();
        batch.notes.extend(misplaced::said(scene, &carrier.grids));
        let mut union: Vec<Option<(GrayImage, String)>> = vec![None; scene.train.len()];
        for (object, given) in objects {
            let name = several.then_some(object.as_str());
            let Carried { masks, shown, notes } = carrier.carry(splats, given, name, self.watch)?;
            let [label, what] =
                name.map_or(["".into(), "the object".into()], |name| [format!("{name}: "), name.into()]);
            batch.notes.extend(notes.into_iter().map(|note| format!("{label}{note}")));
            batch.figures.insert(format!("views with {what}"), shown as f64);
            for (sum, (mask, from)) in union.iter_mut().zip(masks) {
                *sum = Some(match sum.take() {
                    Some((others, of)) => (joined(others, mask), format!("{of}; {label}{from}")),
                    None => (mask, format!("{label}{from}")),
                });
            }
        }
        for (view, (mask, from)) in scene.train.iter().zip(union.into_iter().flatten()) {
            if from != USERS && !wanted.whole.contains_key(&view.name) {
                batch.gray(format!("masks/{}.png", view.name), &mask, from);
            }
        }
        if !wanted.whole.is_empty() {
            let names: Vec<&str> = wanted.whole.keys().map(String::as_str).collect();
            batch.notes.push(format!(
                "masks that were made by hand in the scene are of all objects together, and stay: {}; they say nothing of other \
                 views",
                abridged(&names)
            ));
        }
        self.write(Step::Masks, inputs, batch)?;
        self.watch.end();
        Ok(())
    }
}

/// Whether all views have a mask.
fn is_in_all(scene: &Scene, given: &BTreeMap<String, Given>) -> bool {
    scene.train.iter().all(|view| given.contains_key(&view.name))
}

impl<'a> Carrier<'a> {
    fn new(
        scene: &'a Scene,
        fit: &'a Fit,
        splats: &mut Splats,
        grids: Vec<DepthGrid>,
        files: BTreeMap<String, PathBuf>,
    ) -> Result<Self, Error> {
        let colors = masks::colors(splats, &scene.train)?;
        let picture = |view: &View| scene::photograph_within(&files[&view.name], outline::SIDE);
        let pictures: Vec<Result<_, scene::Error>> = scene.train.par_iter().map(picture).collect();
        let pictures = pictures.into_iter().collect::<Result<_, _>>()?;
        Ok(Self { scene, fit, colors, grids, files, pictures, units: 0 })
    }

    fn turn(&mut self, watch: &mut dyn Watch) -> Result<(), Error> {
        self.units += 1;
        watch.turn(self.units)
    }

    /// Masks that were cut by colours alone, cut again by where in space pixels are, and by the votes of other views if there are any.
    fn placed(
        &self,
        splats: &mut Splats,
        given: &BTreeMap<String, Given>,
        votes: Option<&masks::Votes>,
    ) -> Result<BTreeMap<String, Given>, Error> {
        let mut all = given.clone();
        let shares = votes.map(|votes| votes.count(self.fit.positions(), &self.colors));
        for (view, grid) in self.scene.train.iter().zip(&self.grids) {
            let Some(given) = all.get_mut(&view.name).filter(|given| !given.drawn.is_empty()) else { continue };
            let [fit, measured] = [DepthMap::of(splats, &view.camera)?, DepthMap::confirmed(grid, &view.camera)];
            let carried = shares.as_ref().map(|shares| shares.carry(splats, &view.camera)).transpose()?;
            let parts = carried.map(|carried| carried.believed());
            let carried = parts.as_ref().map(|parts| (parts.as_slice(), view.camera.size));
            let cues = Cues { depth: Some(&fit), measured: Some(&measured), carried, ..Cues::default() };
            *given = given.placed(&self.files[&view.name], &cues)?;
        }
        Ok(all)
    }

    /// Takes what shows these anchors out of masks in these views that were cut and that nobody has seen. Returns the names of those that
    /// have lost something.
    fn clear_behind(
        splats: &mut Splats,
        given: &mut BTreeMap<String, Given>,
        views: &[&'a View],
        behind: &[bool],
    ) -> Result<Vec<&'a str>, Error> {
        let mut lost = vec![];
        for view in views.iter().filter(|_| behind.contains(&true)) {
            let Some(Given { mask, .. }) = given.get_mut(&view.name).filter(|given| !given.drawn.is_empty()) else {
                continue;
            };
            let part = masks::part_of(splats, &view.camera, behind)?;
            let away = masks::threshold(&part, view.camera.size, mask.dimensions().into(), 0.5);
            let both: Vec<usize> =
                (0..away.as_raw().len()).filter(|i| mask.as_raw()[*i] != 0 && away.as_raw()[*i] != 0).collect();
            both.iter().for_each(|i| mask.as_mut()[*i] = 0);
            lost.extend((!both.is_empty()).then_some(view.name.as_str()));
        }
        Ok(lost)
    }

    /// `[view][pixel]` of the fit's pictures: whether what is there is none of the object, by the given masks and the depth that
    /// is measured between the photographs.
    fn beside(&self, given: &BTreeMap<String, Given>) -> Vec<Vec<bool>> {
        let views = &self.scene.train;
        let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        let mask = |view: &View| given.get(&view.name).map(|given| &given.mask);
        hole::ground::beside(&self.grids, &cameras, &views.iter().map(mask).collect::<Vec<_>>())
    }

    /// Lets the given masks vote.
    fn vote(
        splats: &mut Splats,
        views: &Views,
        given: &BTreeMap<String, Given>,
        votes: &mut masks::Votes,
    ) -> Result<(), Error> {
        for view in &views.voters {
            votes.add(splats, &view.camera, &masks::parts(&given[&view.name].mask, view.camera.size))?;
        }
        Ok(())
    }

    /// `[other view]` the object by these votes, without what is beside it.
    fn carried(
        &self,
        splats: &mut Splats,
        views: &Views,
        votes: &masks::Votes,
        beside: &[Vec<bool>],
    ) -> Result<Vec<masks::Carried>, Error> {
        let shares = votes.count(self.fit.positions(), &self.colors);
        let carried = views.others.iter().map(|at| {
            let mut carried = shares.carry(splats, &self.scene.train[*at].camera)?;
            for (part, _) in carried.object.iter_mut().zip(&beside[*at]).filter(|(_, beside)| **beside) {
                *part = 0.0;
            }
            Ok(carried)
        });
        carried.collect()
    }

    /// A view's mask by its photograph, and whether it was moved.
    fn refine(&self, looks: Option<&Looks>, carried: &masks::Carried, at: usize) -> (GrayImage, bool) {
        let (size, picture) = (self.scene.train[at].camera.size, &self.pictures[at]);
        let rough = masks::threshold(&carried.object, size, size, masks::OBJECT);
        let shift = looks.and_then(|looks| looks.shift(picture, &rough));
        let moved = shift.map(|shift| misplaced::moved(&carried.object, size, shift));
        (outline::of(picture, moved.as_ref().unwrap_or(&carried.object), size), moved.is_some())
    }

    /// The object as the given masks alone show it. They lose what is behind it.
    fn first(
        &self,
        splats: &mut Splats,
        views: &Views<'a>,
        given: &mut BTreeMap<String, Given>,
    ) -> Result<First<'a>, Error> {
        let mut votes = masks::Votes::new(splats);
        Self::vote(splats, views, given, &mut votes)?;
        // Masks that were not cut are believed: they may be of things behind one another.
        let all_cut = given.values().all(|given| given.cut);
        let positions = self.fit.positions();
        let behind = if all_cut { votes.behind(positions) } else { vec![false; positions.len()] };
        let lost = Self::clear_behind(splats, given, &views.voters, &behind)?;
        if !lost.is_empty() {
            votes = masks::Votes::new(splats);
            Self::vote(splats, views, given, &mut votes)?;
        }
        votes.deny(&behind);
        let beside = if views.others.is_empty() { vec![] } else { self.beside(given) };
        let at = |name: &String| self.scene.train.iter().position(|view| view.name == *name);
        let looks = Looks::of(given.iter().filter_map(|(name, given)| Some((&self.pictures[at(name)?], &given.mask))));
        let carried = self.carried(splats, views, &votes, &beside)?;
        Ok(First { behind, lost, beside, looks, carried })
    }

    /// Votes of the outlines of two dozen other views: what the first ones miss of the object's other sides these have between them.
    fn seen_by_others(
        &self,
        splats: &mut Splats,
        views: &Views,
        first: &First,
        watch: &mut dyn Watch,
    ) -> Result<masks::Votes, Error> {
        let others = &views.others;
        let some = (0..others.len()).into_par_iter().step_by(others.len().div_ceil(outline::VOTERS).max(1));
        let outlines: Vec<(usize, (GrayImage, bool))> =
            some.map(|i| (others[i], self.refine(first.looks.as_ref(), &first.carried[i], others[i]))).collect();
        let mut votes = masks::Votes::new(splats);
        for (at, (mask, _)) in outlines.iter().filter(|(at, (_, moved))| !moved && views.helps(self.scene, *at)) {
            let camera = &self.scene.train[*at].camera;
            votes.add(splats, camera, &masks::parts(mask, camera.size))?;
            watch.go_on()?;
        }
        votes.deny(&first.behind);
        Ok(votes)
    }

    /// An object to all views, of which it is said how one more is masked by the name of the object, where there are several.
    fn carry(
        &mut self,
        splats: &mut Splats,
        drawn: &BTreeMap<String, Given>,
        object: Option<&str>,
        watch: &mut dyn Watch,
    ) -> Result<Carried, Error> {
        let scene = self.scene;
        let wrong = misplaced::wrong(scene, &self.grids);
        let mut given = self.placed(splats, drawn, None)?;
        let (voters, misplaced) = misplaced::voters(scene, &wrong, &given)?;
        let others = (0..scene.train.len()).filter(|at| !drawn.contains_key(&scene.train[*at].name)).collect();
        let views = Views { voters, others, wrong };
        self.units += views.voters.len() as u64;
        watch.turn(self.units)?;
        let mut cuts = 1;
        let (first, mut votes) = loop {
            let first = self.first(splats, &views, &mut given)?;
            let votes = self.seen_by_others(splats, &views, &first, watch)?;
            if cuts < CUTS && !views.others.is_empty() {
                cuts += 1;
                let again = self.placed(splats, drawn, Some(&votes))?;
                if again.iter().any(|(name, again)| iou(&again.mask, &given[name].mask) < SAME) {
                    given = again;
                    continue;
                }
            }
            break (first, votes);
        };
        Self::vote(splats, &views, &given, &mut votes)?;
        votes.deny(&first.behind);
        let carried = self.carried(splats, &views, &votes, &first.beside)?;
        let others = &views.others;
        let mut outlines: Vec<(GrayImage, bool)> = others
            .par_iter()
            .zip(&carried)
            .map(|(at, carried)| self.refine(first.looks.as_ref(), carried, *at))
            .collect();
        self.clear(&given, others, &mut outlines);
        let moved = others.iter().zip(&outlines).filter(|(_, (_, moved))| *moved).map(|(at, _)| *at);
        let moved: Vec<usize> = moved.collect();
        let names: Vec<&str> = views.voters.iter().map(|view| view.name.as_str()).collect();
        let masks = self.large(&given, &names, outlines, watch)?;
        let shown = masks.iter().filter(|(mask, _)| mask.as_raw().iter().any(|v| *v != 0)).count();
        let lost = (!first.lost.is_empty()).then(|| {
            let names = abridged(&first.lost);
            format!("what stands behind the object and apart from it is none of it, and was taken out of its mask in {names}")
        });
        // A mask in a view whose camera is wrong would help no other.
        let thin = others.iter().zip(&first.carried).filter(|(at, _)| views.helps(scene, **at));
        let thin: Vec<(f64, usize)> = thin.filter_map(|(at, carried)| Some((carried.thinness()?, *at))).collect();
        let notes = misplaced.into_iter().chain(lost).chain(self.notes(shown, thin, &moved, object)).collect();
        Ok(Carried { masks, shown, notes })
    }

    /// Clears what others show beside the object from the outlines of the views that have no mask.
    fn clear(&self, given: &BTreeMap<String, Given>, others: &[usize], outlines: &mut [(GrayImage, bool)]) {
        let views = &self.scene.train;
        if others.is_empty() || self.grids.len() != views.len() {
            return;
        }
        let mut all: Vec<GrayImage> = views
            .iter()
            .map(|view| given.get(&view.name).map_or_else(GrayImage::default, |g| g.mask.clone()))
            .collect();
        others.iter().zip(&mut *outlines).for_each(|(at, (mask, _))| all[*at] = std::mem::take(mask));
        let cameras: Vec<Camera> =
            views.iter().zip(&all).map(|(view, mask)| view.camera.scaled(mask.dimensions().into())).collect();
        let is_given: Vec<bool> = views.iter().map(|view| given.contains_key(&view.name)).collect();
        let cleared = hole::complete::clear_strays(&self.grids, &cameras, &mut all, &is_given);
        log::debug!("masks: parts of {cleared:?} show what others have beside the object");
        others.iter().zip(outlines).for_each(|(at, (mask, _))| *mask = std::mem::take(&mut all[*at]));
    }

    /// `[view]` the given masks and the outlines of all others, carried `from` some, as large as the photographs, and what they were made
    /// from.
    fn large(
        &mut self,
        given: &BTreeMap<String, Given>,
        from: &[&str],
        outlines: Vec<(GrayImage, bool)>,
        watch: &mut dyn Watch,
    ) -> Result<Vec<(GrayImage, String)>, Error> {
        let carried = format!("carried from {}", abridged(from));
        let mut outlines = outlines.into_iter();
        let mut all = vec![];
        for view in &self.scene.train {
            if let Some(Given { mask, from, .. }) = given.get(&view.name) {
                all.push((mask.clone(), from.clone()));
                continue;
            }
            let (mask, _) = outlines.next().expect("an outline of each view that has no mask");
            let small = [mask.width(), mask.height()];
            let size = picture_size(&self.files[&view.name])?;
            all.push((masks::threshold(&masks::parts(&mask, small), small, size, 0.5), carried.clone()));
            self.turn(watch)?;
        }
        Ok(all)
    }

    /// What is to be said of an object: views that show it, how much of it was not seen in which, and where it was moved.
    fn notes(&self, shown: usize, mut thin: Vec<(f64, usize)>, moved: &[usize], object: Option<&str>) -> Vec<String> {
        let views = &self.scene.train;
        let mut notes = vec![];
        if shown < 3 {
            notes.push(format!(
                "the object is in {shown} of {} views only: what is behind it is hardly seen from elsewhere",
                views.len()
            ));
        }
        thin.sort_by(|a, b| b.0.total_cmp(&a.0));
        let weak: Vec<&(f64, usize)> = thin.iter().filter(|(part, _)| *part > THIN).collect();
        if let Some((part, at)) = weak.first() {
            let name = &views[*at].name;
            let option = object.map_or_else(String::new, |object| format!("--object {object:?} "));
            notes.push(format!(
                "{} views show sides of the object that the given masks do not; please mask {name} as well \
                 ({option}--mask {name}=...): {:.0} % of the object there were not seen",
                weak.len(),
                100.0 * part
            ));
        }
        if !moved.is_empty() {
            let moved: Vec<&str> = moved.iter().map(|at| views[*at].name.as_str()).collect();
            notes.push(format!(
                "the object is not where the cameras of these photographs have it, and their masks are moved onto it: {}; \
                 train --set 'scene.leave_out={moved:?}' leaves them out",
                abridged(&moved)
            ));
        }
        notes
    }
}
