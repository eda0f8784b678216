//! What the user says that the object is, and the masks that this makes.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use image::{GrayImage, RgbImage};

use super::click::{self, Cues, Mark};
use super::poses::Capture;
use super::record::{self, Folder};
use super::{Error, graph_cut, masks, picture_size};
use crate::scene::{self, resample};

/// How the user says what the object is in a view.
#[derive(Clone, Debug, PartialEq)]
pub enum Evidence {
    /// A mask, not 0 on the object.
    Mask(PathBuf),
    /// A mask that was cut by marks. It stays as it is, but what stands behind the object in it is not carried to other views.
    Cut(PathBuf),
    /// A box around it: x0, y0 and one past x1, y1, in pixels of the photograph.
    Box([u32; 4]),
    /// A picture of strokes: white or green on the object, black or red beside it, transparent or grey elsewhere.
    Strokes(PathBuf),
    /// A rough line around it, which closes itself: x and y of its corners, in pixels of the photograph.
    Lasso(Vec<[u32; 2]>),
    /// A pixel of it.
    Click([u32; 2]),
    /// A pixel that is none of it.
    Not([u32; 2]),
}

impl Evidence {
    /// The option that says so.
    fn option(&self) -> &'static str {
        match self {
            Self::Mask(_) | Self::Cut(_) => "--mask",
            Self::Box(_) => "--box",
            Self::Strokes(_) => "--strokes",
            Self::Lasso(_) => "--lasso",
            Self::Click(_) => "--click",
            Self::Not(_) => "--not",
        }
    }

    /// A mark of the page in a photograph of this size, which counts together with the others of its view; nothing for what
    /// is a mask by itself.
    fn mark(&self, size: [u32; 2], beside_marks: bool) -> Option<Mark> {
        // The middle of a pixel.
        let at =
            |[x, y]: [u32; 2]| [(f64::from(x) + 0.5) / f64::from(size[0]), (f64::from(y) + 0.5) / f64::from(size[1])];
        match self {
            Self::Box([x0, y0, x1, y1]) if beside_marks => {
                let corner = |x: u32, y: u32| [f64::from(x) / f64::from(size[0]), f64::from(y) / f64::from(size[1])];
                let [[x0, y0], [x1, y1]] = [corner(*x0, *y0), corner(*x1, *y1)];
                Some(Mark::Box { bounds: [x0, y0, x1, y1] })
            }
            Self::Lasso(points) => Some(Mark::Lasso { points: points.iter().map(|point| at(*point)).collect() }),
            Self::Click(point) => Some(Mark::Object { at: at(*point), scale: 0 }),
            Self::Not(point) => Some(Mark::Background { at: at(*point) }),
            Self::Mask(_) | Self::Cut(_) | Self::Strokes(_) | Self::Box(_) => None,
        }
    }
}

/// What is to be removed, by what the user says of it in some views.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// What it is called; the first one need not be called anything.
    pub name: String,
    /// What it is in a view, by the name of this.
    pub evidence: Vec<(String, Evidence)>,
    /// Whether masks that came with the photographs are its own.
    pub delivered: bool,
}

impl Default for Object {
    fn default() -> Self {
        Self { name: String::new(), evidence: vec![], delivered: true }
    }
}

/// Longest name of an object, characters.
const LONGEST: usize = 40;

impl Object {
    /// A name as it may be given to an object, without what is around it; nothing for one that cannot be said in a line.
    pub fn checked_name(text: &str) -> Option<&str> {
        let name = text.trim();
        (!name.is_empty() && name.chars().count() <= LONGEST && !name.chars().any(char::is_control)).then_some(name)
    }
}

/// The masks that are known of what is to be removed.
#[derive(Default)]
pub(super) struct Wanted {
    /// Objects that have one, by name, and theirs by view.
    pub objects: Vec<(String, BTreeMap<String, Given>)>,
    /// Of several objects together, by view: what the user has put or corrected in the scene's folder.
    pub whole: BTreeMap<String, Given>,
}

impl Wanted {
    /// What the user named of these objects.
    pub fn given(capture: &Capture, objects: &[Object]) -> Result<Self, Error> {
        let mut wanted = Self::default();
        for (at, object) in objects.iter().enumerate() {
            let name = if object.name.is_empty() { format!("object {}", at + 1) } else { object.name.clone() };
            let masks = given(capture, object).map_err(|error| match error {
                Error::Request(what) if objects.len() > 1 => Error::Request(format!("{name}: {what}")),
                other => other,
            })?;
            if !masks.is_empty() {
                wanted.objects.push((name, masks));
            }
        }
        Ok(wanted)
    }

    /// Adds masks in the scene's folder that are not the program's own: one object has more of its own.
    pub fn correct(&mut self, folder: &Folder, capture: &Capture) -> Result<(), Error> {
        match self.objects.as_mut_slice() {
            [] => {
                let found = corrected(folder, capture, &BTreeMap::new())?;
                self.objects.extend((!found.is_empty()).then(|| (String::new(), found)));
            }
            [(_, given)] => given.extend(corrected(folder, capture, given)?),
            _ => self.whole = corrected(folder, capture, &BTreeMap::new())?,
        }
        Ok(())
    }
}

/// What the masks of the user's own are made from.
pub(super) const USERS: &str = "the user's own";

/// A mask that was given or derived from a box, as large as the photograph, and what it was made from.
#[derive(Clone)]
pub(super) struct Given {
    pub mask: GrayImage,
    pub from: String,
    /// All that was drawn, if the mask was cut from it alone: it can be cut again once more is known of the view.
    pub drawn: Vec<Drawn>,
    /// Whether it was cut from something drawn, by the program or on its page.
    pub cut: bool,
}

/// A drawing that a minimum cut makes a mask of.
#[derive(Clone)]
pub(super) enum Drawn {
    /// A box alone, in pixels of the photograph.
    Box([u32; 4]),
    /// Marks that are taken together.
    Marks(Vec<Mark>),
}

impl Drawn {
    /// The mask that the drawing means, as large as the photograph; nothing if nothing there differs from what is around it.
    fn cut(&self, picture: &RgbImage, cues: &Cues<'_>) -> Option<GrayImage> {
        let mask = match self {
            Self::Box(bounds) => click::from_box(picture, *bounds, cues)?,
            Self::Marks(marks) => {
                let size = [picture.width(), picture.height()];
                // Clicks mean what is there, whatever others show.
                let outlined = marks.iter().all(|mark| mark.bounds().is_some());
                let cues = &Cues { carried: cues.carried.filter(|_| outlined), ..*cues };
                let mask = click::mask(&resample::photograph(picture, click::working(size)), marks, cues);
                let own = [mask.width(), mask.height()];
                masks::threshold(&masks::parts(&mask, own), own, size, 0.5)
            }
        };
        mask.as_raw().iter().any(|v| *v != 0).then_some(mask)
    }
}

impl Given {
    /// A mask that counts as it is.
    pub fn fixed(mask: GrayImage, from: String) -> Self {
        Self { mask, from, drawn: vec![], cut: false }
    }

    /// The mask cut again from what was drawn in its photograph, by what is known besides its colours; the same where nothing was drawn
    /// or nothing would be left.
    ///
    /// # Errors
    /// A photograph that cannot be read.
    pub fn placed(&self, photograph: &Path, cues: &Cues<'_>) -> Result<Self, Error> {
        let picture = scene::photograph(photograph, 1)?;
        let cuts = self.drawn.iter().map(|drawn| drawn.cut(&picture, cues));
        let cuts: Option<Vec<GrayImage>> = cuts.collect();
        let Some(mask) = cuts.and_then(|cuts| cuts.into_iter().reduce(joined)) else { return Ok(self.clone()) };
        Ok(Self { mask, from: format!("{}, by places in space", self.from), ..self.clone() })
    }
}

/// Two masks of one size as one, of all that either covers.
pub(super) fn joined(mut one: GrayImage, other: GrayImage) -> GrayImage {
    one.iter_mut().zip(other.as_raw()).for_each(|(one, other)| *one = (*one).max(*other));
    one
}

pub(super) fn no_such_view<'a>(name: &str, option: &str, views: impl Iterator<Item = &'a str>) -> Error {
    let names: Vec<&str> = views.collect();
    let near = names.iter().max_by(|a, b| strsim::jaro(a, name).total_cmp(&strsim::jaro(b, name)));
    let hint = near.map_or_else(String::new, |near| format!(" (did you mean {near}?)"));
    Error::Request(format!("{option} {name}: no photograph has this name{hint}"))
}

/// Whether a box has an inside and lies within a picture of this size.
fn is_box([x0, y0, x1, y1]: [u32; 4], size: [u32; 2]) -> bool {
    x0 < x1 && y0 < y1 && x1 <= size[0] && y1 <= size[1]
}

/// The masks that the user named of an object.
fn given(capture: &Capture, object: &Object) -> Result<BTreeMap<String, Given>, Error> {
    let mut all = BTreeMap::new();
    for (name, (path, inverted)) in capture.masks.iter().filter(|_| object.delivered) {
        // Masks of no photograph are not this scene's.
        let Some(photograph) = capture.photographs.get(name) else { continue };
        let size = picture_size(photograph)?;
        let mut mask = read_mask(path, size)?;
        if *inverted {
            mask.iter_mut().for_each(|v| *v = 255 - *v);
        }
        // Of those that came with the photographs an empty one is a view without the object.
        let mask = capture.mask(name, checked(path, mask, size, true)?);
        all.insert(name.clone(), Given::fixed(mask, format!("{}", path.display())));
    }
    let on = |stem: &str, kind: &dyn Fn(&Evidence) -> bool| {
        object
            .evidence
            .iter()
            .find(|(name, evidence)| scene::stem(name) == stem && kind(evidence))
            .map(|(_, evidence)| evidence)
    };
    // Views of which a mask or a box was named: of several the object is what any of them covers.
    let mut named: BTreeSet<String> = BTreeSet::new();
    for (name, evidence) in &object.evidence {
        let stem = scene::stem(name).to_owned();
        let option = evidence.option();
        let Some(photograph) = capture.photographs.get(&stem) else {
            return Err(no_such_view(name, option, capture.photographs.keys().map(String::as_str)));
        };
        let size = picture_size(photograph)?;
        let is_mark = |other: &Evidence| matches!(other, Evidence::Lasso(_) | Evidence::Click(_) | Evidence::Not(_));
        let marked = on(&stem, &is_mark).is_some();
        if all.contains_key(&stem) && marked && evidence.mark(size, true).is_some() {
            // They were taken together.
            continue;
        }
        let given = match evidence {
            Evidence::Lasso(_) | Evidence::Click(_) | Evidence::Not(_) => of_marks(object, &stem, photograph, size)?,
            Evidence::Box(_) if marked => of_marks(object, &stem, photograph, size)?,
            Evidence::Mask(path) | Evidence::Cut(path) => {
                let mask = checked(path, read_mask(path, size)?, size, false)?;
                let (cut, how) = match evidence {
                    Evidence::Cut(_) => (true, ", cut by marks"),
                    _ => (false, ""),
                };
                Given { cut, ..Given::fixed(mask, format!("--mask {}{how}", path.display())) }
            }
            Evidence::Box(bounds) => {
                let [x0, y0, x1, y1] = *bounds;
                if !is_box(*bounds, size) {
                    return Err(Error::Request(format!(
                        "--box {name}={x0},{y0},{x1},{y1}: not a box within the photograph, which is {}x{}; give x0,y0,x1,y1 \
                         with x0 < x1 and y0 < y1",
                        size[0], size[1]
                    )));
                }
                if on(&stem, &|other| matches!(other, Evidence::Strokes(_))).is_some() {
                    // It bounds what the strokes reach.
                    continue;
                }
                let picture = scene::photograph(photograph, 1)?;
                let drawn = Drawn::Box(*bounds);
                let mask = drawn.cut(&picture, &Cues::default()).ok_or_else(|| {
                    Error::Request(format!(
                        "--box {name}={x0},{y0},{x1},{y1}: nothing in the box differs from what is around it; draw it closer, \
                         or give a mask"
                    ))
                })?;
                Given {
                    mask,
                    from: format!("--box {x0},{y0},{x1},{y1} and a graph cut"),
                    drawn: vec![drawn],
                    cut: true,
                }
            }
            Evidence::Strokes(path) => {
                let picture = scene::photograph(photograph, 1)?;
                let strokes = graph_cut::Strokes::read(path, size)?;
                let bounds = on(&stem, &|other| matches!(other, Evidence::Box(_)));
                let (mask, within) = match bounds {
                    Some(Evidence::Box(bounds)) if is_box(*bounds, size) => {
                        let [x0, y0, x1, y1] = bounds;
                        let mask = graph_cut::from_strokes_in_box(&picture, &strokes, *bounds);
                        (mask, format!(" within --box {x0},{y0},{x1},{y1}"))
                    }
                    _ => (graph_cut::from_strokes(&picture, &strokes), String::new()),
                };
                if mask.as_raw().iter().all(|v| *v == 0) {
                    return Err(Error::Request(format!(
                        "--strokes {name}: no stroke on the object lies within the box; draw one there"
                    )));
                }
                Given { cut: true, ..Given::fixed(mask, format!("--strokes {}{within}", path.display())) }
            }
        };
        let mask = capture.mask(&stem, given.mask);
        if mask.as_raw().iter().all(|v| *v == 0) {
            return Err(Error::Request(format!(
                "{option} {name}: the object lies where the photograph's lens sees more than a pinhole does; mask a view that \
                 has it nearer to the middle"
            )));
        }
        let joins = matches!(evidence, Evidence::Mask(_) | Evidence::Cut(_) | Evidence::Box(_)) && !marked;
        let given = match all.remove(&stem) {
            Some(before) if joins && named.contains(&stem) => {
                let all_drawn = !before.drawn.is_empty() && !given.drawn.is_empty();
                let drawn = if all_drawn { [before.drawn, given.drawn].concat() } else { vec![] };
                let cut = before.cut && given.cut;
                Given { mask: joined(before.mask, mask), from: format!("{}, {}", before.from, given.from), drawn, cut }
            }
            // Of a photograph that the scene has resampled the drawing is elsewhere.
            _ if capture.is_resampled(&stem) => Given { mask, drawn: vec![], ..given },
            _ => Given { mask, ..given },
        };
        if joins {
            named.insert(stem.clone());
        }
        all.insert(stem, given);
    }
    Ok(all)
}

/// The mask of all marks in one view: boxes and lassos first, then the clicks on the object, then those beside it.
fn of_marks(object: &Object, stem: &str, photograph: &Path, size: [u32; 2]) -> Result<Given, Error> {
    let rank = |evidence: &Evidence| match evidence {
        Evidence::Box(_) | Evidence::Lasso(_) => 0,
        Evidence::Not(_) => 2,
        _ => 1,
    };
    let mut own: Vec<&Evidence> =
        object.evidence.iter().filter(|(name, _)| scene::stem(name) == stem).map(|(_, evidence)| evidence).collect();
    own.sort_by_key(|evidence| rank(evidence));
    let mut marks = vec![];
    for evidence in own {
        let Some(mark) = evidence.mark(size, true) else {
            let (option, clicks) = (evidence.option(), "--lasso, --click and --not");
            return Err(Error::Request(format!(
                "{option} {stem}: does not go with {clicks} of the same view; give one of them"
            )));
        };
        if !mark.is_sound() {
            return Err(Error::Request(format!(
                "{} {stem}: not within the photograph, which is {}x{}, or with nothing in it",
                evidence.option(),
                size[0],
                size[1]
            )));
        }
        marks.push(mark);
    }
    let says_where = marks.iter().any(|mark| !matches!(mark, Mark::Background { .. }));
    let from = format!("{} marks", marks.len());
    let drawn = Drawn::Marks(marks);
    let Some(mask) = drawn.cut(&scene::photograph(photograph, 1)?, &Cues::default()) else {
        return Err(Error::Request(if says_where {
            format!(
                "{stem}: nothing at its marks differs from what is around them; draw the --lasso or --box closer, or give a mask"
            )
        } else {
            format!(
                "--not {stem}: says nothing without a --click, --lasso or --box in the same view; say where the object is"
            )
        }));
    };
    Ok(Given { mask, from, drawn: vec![drawn], cut: true })
}

/// Masks in the scene's folder that are not the program's own: the user has put or corrected them there.
fn corrected(
    folder: &Folder,
    capture: &Capture,
    given: &BTreeMap<String, Given>,
) -> Result<BTreeMap<String, Given>, Error> {
    let masks = folder.root().join("masks");
    let mut all = BTreeMap::new();
    if !masks.is_dir() {
        return Ok(all);
    }
    for (name, path) in scene::pictures(&masks)? {
        let Some(photograph) = capture.photographs.get(&name) else { continue };
        let below = path.strip_prefix(folder.root()).ok().and_then(record::key);
        let relative = below.expect("the files of masks/ lie below the scene");
        if !given.contains_key(&name) && folder.is_users(&relative)? {
            let size = picture_size(photograph)?;
            let mask = checked(&path, read_mask(&path, size)?, size, true)?;
            all.insert(name, Given::fixed(mask, USERS.into()));
        }
    }
    Ok(all)
}

/// A mask of a photograph of this size, as large as its file has it: its proportions are looked at before it is decoded.
pub(super) fn read_mask(path: &Path, size: [u32; 2]) -> Result<GrayImage, Error> {
    let found = picture_size(path)?;
    let ratio = |s: [u32; 2]| f64::from(s[0]) / f64::from(s[1]);
    if found != size && (ratio(found) / ratio(size) - 1.0).abs() > 0.01 {
        return Err(scene::Error::MaskSize { path: path.to_owned(), size: found, picture: size }.into());
    }
    Ok(scene::mask(path, 1)?)
}

/// A mask as large as its photograph that is neither full nor, unless that is allowed, empty.
fn checked(path: &Path, mask: GrayImage, size: [u32; 2], may_be_empty: bool) -> Result<GrayImage, Error> {
    let found = [mask.width(), mask.height()];
    let refuse = |what: String| Err(Error::File { path: path.to_owned(), what });
    let mask = if found == size { mask } else { resample::nearest(&mask, size) };
    let object = mask.as_raw().iter().filter(|v| **v != 0).count();
    if object == mask.as_raw().len() {
        return refuse("the mask covers the whole picture; the object must be the part that is not black".into());
    }
    if object == 0 && !may_be_empty {
        return refuse("the mask is empty; paint the object in any colour but black".into());
    }
    Ok(mask)
}
