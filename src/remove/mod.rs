//! The page of `gscream-vk remove`: photographs to point at an object in, and what becomes of them.
//!
//! The page's visitors and the worker, who has the device, meet at a [`Session`]. Marks become masks in the visitors' own
//! threads ([`crate::prepare::click`]), with what the worker has laid down so far: the fit's depth, and the masks of other
//! views as the fit carries them. All that is to be kept lies in a folder for each object: `NAME.png`, the mask of a photograph, as
//! `prepare --mask` takes it, and `NAME.json`, the marks it was made of ([`objects`]). The last of two writers wins, view by
//! view; a revision counts the changes.

mod list;
pub mod objects;
pub mod repaint;
pub mod site;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError, RwLock};
use std::time::Duration;

use image::{GrayImage, RgbImage};
use serde::Serialize;

use crate::prepare::click::{self, Cues, Mark, working};
use crate::prepare::depth::DepthMap;
use crate::prepare::masks::{self, Carried};
use crate::scene::{self, resample};
use crate::view::live::Board;
use crate::view::server::{Refusal, Resource};
use objects::Entry;

/// Marks of a view at most.
const MOST_MARKS: usize = 400;
/// Masks of a view that are kept for a step back.
const KEPT_MASKS: usize = 10;
/// A view with so many marks at most gets its mask anew when the depth is known.
const FEW: usize = 3;
/// Pictures of that size that are kept.
const KEPT: usize = 6;
/// Pieces of a carried mask smaller than this share of its largest piece are none of it.
const SPECK: f64 = 0.02;
/// A view is worth a look if more than this part of the object there is not known from the marked ones.
pub const THIN: f64 = 0.15;

/// A photograph.
#[derive(Debug)]
pub struct Photo {
    /// The photograph's name.
    pub name: String,
    /// The photograph's file.
    pub path: PathBuf,
    /// Width and height, pixels.
    pub size: [u32; 2],
}

/// Where the mask of a photograph is from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Origin {
    /// There is none.
    #[default]
    None,
    /// Marks on the page.
    Marks,
    /// A file that was put there, or came with the photographs.
    File,
}

/// An object, and the state of each photograph of it.
struct Own {
    entry: Entry,
    views: Vec<View>,
}

/// The state of a photograph of an object.
#[derive(Clone, Default)]
struct View {
    marks: Vec<Mark>,
    origin: Origin,
    mask: Option<Arc<GrayImage>>,
    /// The part of the photograph that the mask covers.
    share: f64,
    /// Counts what was said of this view.
    version: u64,
    /// The version that the mask is of.
    drawn: u64,
    /// Masks of marks, the latest last, and whether the depth was known to them: what one more mark begins with. One that was on
    /// disk counts as it is.
    made: Vec<(Vec<Mark>, Option<bool>, Arc<GrayImage>)>,
    carried: Option<Arc<Shown>>,
}

/// The mask that other views' masks make of a photograph.
struct Shown {
    parts: Vec<f32>,
    size: [u32; 2],
    mask: GrayImage,
    share: f64,
    doubt: f64,
    /// The revision of the masks that it was carried from.
    revision: u64,
}

/// The part of the work that is going on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// The user points.
    #[default]
    Choosing,
    /// The object is being removed.
    Working,
    /// It is gone.
    Done,
}

/// A part of the work.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Part {
    /// The name of the part, in words.
    pub name: String,
    /// How much of it is done.
    pub done: u64,
    /// How much there is.
    pub all: u64,
}

#[derive(Default)]
struct State {
    /// Counts changes of masks.
    revision: u64,
    /// In the order of the list, and never none.
    objects: Vec<Own>,
    /// The object that was deleted last.
    deleted: Option<list::Deleted>,
    /// What the page is told of the views; nothing where that has changed since.
    said: Option<Arc<site::Views>>,
    phase: Phase,
    part: Option<Part>,
    /// Whether the fit is there.
    ready: bool,
    /// The revision that masks were carried from, to all views.
    carried: u64,
    /// The user wants it removed; whether in spite of what was found.
    wanted: Option<bool>,
    /// Views that a visitor wants to see without the object.
    asked: BTreeSet<usize>,
    /// Counts the removals that have ended.
    removals: u64,
    painting: repaint::Painting,
    problems: Vec<String>,
    error: Option<String>,
}

/// The worker's next task.
pub enum Wish {
    /// Nothing has changed for a while.
    Nothing,
    /// Masks of this revision are to be carried to all views: the objects by number, and view, version and mask of each.
    Carry(u64, BTreeMap<usize, Vec<Masked>>),
    /// What is ticked is to be removed; whether in spite of what is found.
    Remove(bool),
    /// This view is to be drawn without the object.
    Draw(usize),
    /// Something is to be repainted.
    Repaint(repaint::Repainting),
}

/// A view, a version of its mask, and that.
pub type Masked = (usize, u64, Arc<GrayImage>);

/// A view without the object.
pub struct After {
    /// The picture.
    pub jpeg: Vec<u8>,
    /// The share of the object that is left in it, 0 to 1; nothing where that cannot be told.
    pub residue: Option<f64>,
}

/// The share of the object that is left in some views, 0 to 1.
struct Left {
    /// The view with most of it.
    view: usize,
    /// The share that is left there.
    most: f64,
    /// The mean over all of them.
    mean: f64,
    /// Their number.
    of: usize,
}

/// The results of the work.
#[derive(Default)]
pub struct Results {
    page: Vec<Arc<Resource>>,
    files: Vec<(String, PathBuf)>,
    before: BTreeMap<usize, PathBuf>,
    /// The views without the object that were drawn.
    after: BTreeMap<usize, After>,
    /// The scene, and the views whose holes are filled there.
    filled: Option<(PathBuf, BTreeSet<usize>)>,
}

impl Results {
    /// The page that shows the scene, the files to take away by name, and the scene's photographs of the views that can be drawn
    /// without the object.
    pub fn new(page: Vec<Resource>, files: Vec<(String, PathBuf)>, before: BTreeMap<usize, PathBuf>) -> Self {
        Self { page: page.into_iter().map(Arc::new).collect(), files, before, ..Self::default() }
    }

    /// The share of the object that is left in the views drawn so far.
    fn left(&self) -> Option<Left> {
        let residue = |(number, after): (&usize, &After)| Some((*number, after.residue?));
        let all: Vec<(usize, f64)> = self.after.iter().filter_map(residue).collect();
        let (view, most) = *all.iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
        let mean = all.iter().map(|(_, residue)| residue).sum::<f64>() / all.len() as f64;
        Some(Left { view, most, mean, of: all.len() })
    }

    /// With the scene, in which these views have holes that are filled.
    pub fn filled(self, scene: PathBuf, views: BTreeSet<usize>) -> Self {
        Self { filled: Some((scene, views)), ..self }
    }
}

/// The state that the page and the worker share.
pub struct Session {
    title: String,
    /// That of the first object.
    folder: PathBuf,
    photos: Vec<Photo>,
    numbers: BTreeMap<String, usize>,
    state: Mutex<State>,
    changed: Condvar,
    depths: RwLock<BTreeMap<usize, Arc<[DepthMap; 2]>>>,
    /// One mask is cut at a time, and its files are written.
    cutting: Mutex<()>,
    /// One photograph is decoded at a time.
    decoding: Mutex<()>,
    thumbs: Vec<OnceLock<Vec<u8>>>,
    pictures: Mutex<VecDeque<(usize, Arc<RgbImage>)>>,
    live: RwLock<Option<Arc<Board>>>,
    results: RwLock<Results>,
    stop: Arc<AtomicBool>,
}

/// A refusal of what was said: a status and a sentence.
pub type Refused = (Refusal, String);

fn read<T>(lock: &RwLock<T>) -> std::sync::RwLockReadGuard<'_, T> {
    lock.read().unwrap_or_else(PoisonError::into_inner)
}

fn write<T>(lock: &RwLock<T>) -> std::sync::RwLockWriteGuard<'_, T> {
    lock.write().unwrap_or_else(PoisonError::into_inner)
}

impl View {
    /// With what the folder has of a photograph, or with a mask that came with it.
    fn open(photo: &Photo, folder: &Path, given: &BTreeMap<String, GrayImage>) -> Result<Self, scene::Error> {
        let mut view = Self { version: 1, drawn: 1, ..Self::default() };
        let kept = objects::read(folder, &photo.name, photo.size)?;
        let own = given.get(&photo.name).map(|mask| (vec![], mask.clone()));
        if let Some((marks, mask)) = kept.or(own) {
            view.origin = if marks.is_empty() { Origin::File } else { Origin::Marks };
            view.marks = marks;
            let mask = Arc::new(resample::nearest(&mask, working(photo.size)));
            view.share = share(&mask);
            if !view.marks.is_empty() {
                view.made.push((view.marks.clone(), None, mask.clone()));
            }
            view.mask = Some(mask);
        }
        Ok(view)
    }

    /// Whether it has a few marks at most, and the mask of these.
    fn is_few(&self) -> bool {
        (1..=FEW).contains(&self.marks.len()) && self.version == self.drawn
    }

    /// Whether it has a mask of something.
    fn has_object(&self) -> bool {
        self.mask.is_some() && self.share > 0.0
    }
}

impl State {
    /// The object of this number.
    fn own(&mut self, object: usize) -> Result<&mut Own, Refused> {
        let own = self.objects.iter_mut().find(|own| own.entry.number == object);
        own.ok_or_else(|| (Refusal::NotFound, format!("there is no object {object}; it may have been deleted")))
    }

    /// The objects that are to be removed.
    fn ticked(&self) -> impl Iterator<Item = &Own> {
        self.objects.iter().filter(|own| own.entry.remove || self.objects.len() == 1)
    }

    /// Refuses what cannot be changed while it is being removed.
    fn may_change(&self) -> Result<(), Refused> {
        match self.phase {
            Phase::Working => {
                Err((Refusal::Conflict, "the object is being removed; stop that first to change it".into()))
            }
            _ => Ok(()),
        }
    }
}

impl Session {
    /// The session of these photographs, with what the folder, and those of further objects beside it, have of earlier ones.
    /// `given` are masks that came with the photographs, by name, of the first object; those in the folder win.
    ///
    /// # Errors
    /// A photograph or a mask that cannot be read.
    pub fn open(
        title: &str,
        photographs: &BTreeMap<String, PathBuf>,
        folder: &Path,
        given: &BTreeMap<String, GrayImage>,
    ) -> Result<Arc<Self>, scene::Error> {
        let photo = |(name, path): (&String, &PathBuf)| {
            Ok(Photo { name: name.clone(), path: path.clone(), size: scene::dimensions(path)? })
        };
        let photos: Vec<Photo> = photographs.iter().map(photo).collect::<Result<_, scene::Error>>()?;
        let mut state = State { revision: 1, ..State::default() };
        for entry in objects::list(folder)? {
            let none = BTreeMap::new();
            let given = if entry.number == 1 { given } else { &none };
            let views = photos.iter().map(|photo| View::open(photo, &entry.folder(folder), given));
            let views = views.collect::<Result<_, _>>()?;
            state.objects.push(Own { entry, views });
        }
        let numbers = photos.iter().enumerate().map(|(i, photo)| (photo.name.clone(), i)).collect();
        Ok(Arc::new(Self {
            title: title.to_owned(),
            folder: folder.to_owned(),
            numbers,
            thumbs: photos.iter().map(|_| OnceLock::new()).collect(),
            photos,
            state: Mutex::new(state),
            changed: Condvar::new(),
            depths: RwLock::default(),
            cutting: Mutex::default(),
            decoding: Mutex::default(),
            pictures: Mutex::default(),
            live: RwLock::default(),
            results: RwLock::default(),
            stop: Arc::default(),
        }))
    }

    /// What a thread that panicked has left is whole: every change is one assignment.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The photographs, in the order of their names.
    pub fn photos(&self) -> &[Photo] {
        &self.photos
    }

    /// The number of the photograph of this name.
    pub fn number(&self, name: &str) -> Option<usize> {
        self.numbers.get(name).copied()
    }

    /// A photograph at the size in which it is marked.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn picture(&self, number: usize) -> Result<Arc<RgbImage>, scene::Error> {
        let kept = || self.pictures.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, picture)) = kept().iter().find(|(of, _)| *of == number) {
            return Ok(picture.clone());
        }
        // Large photographs are decoded one at a time.
        let _turn = self.decoding.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, picture)) = kept().iter().find(|(of, _)| *of == number) {
            return Ok(picture.clone());
        }
        let Photo { path, size, .. } = &self.photos[number];
        let picture = Arc::new(resample::photograph(&scene::photograph(path, 1)?, working(*size)));
        let mut all = kept();
        all.retain(|(of, _)| *of != number);
        all.push_front((number, picture.clone()));
        all.truncate(KEPT);
        Ok(picture)
    }

    /// Replaces what is marked of an object in a view, and makes its mask. No marks are none: the view gets what other views say.
    ///
    /// # Errors
    /// Marks that make no sense; a time at which nothing can be marked; files that cannot be read or written.
    pub fn mark(&self, object: usize, number: usize, marks: Vec<Mark>) -> Result<u64, Refused> {
        if marks.len() > MOST_MARKS || !marks.iter().all(Mark::is_sound) {
            let why = "a mark lies outside the photograph, or there are too many";
            return Err((Refusal::BadRequest, why.into()));
        }
        self.cut(object, number, Some(marks))
    }

    /// Makes the masks of views with a few marks again, now that more is known than when they were made. One that is being made
    /// sees to that itself.
    pub fn again(&self) {
        let those = |own: &Own| -> Vec<(usize, usize)> {
            (0..own.views.len()).filter(|i| own.views[*i].is_few()).map(|i| (own.entry.number, i)).collect()
        };
        let all: Vec<(usize, usize)> = self.lock().objects.iter().flat_map(those).collect();
        for (object, number) in all {
            if let Err((_, why)) = self.cut(object, number, None) {
                log::info!("{}: {why}", self.photos[number].name);
            }
        }
    }

    /// Makes the mask of a view of these marks, or of those that it has. Marks and mask change together, or not at all. Where its depth
    /// became known meanwhile, the mask is made once more.
    fn cut(&self, object: usize, number: usize, marks: Option<Vec<Mark>>) -> Result<u64, Refused> {
        let version = {
            let mut state = self.lock();
            state.may_change()?;
            let revision = state.revision;
            let view = &mut state.own(object)?.views[number];
            // Somebody has marked it since it was listed.
            if marks.is_none() && !view.is_few() {
                return Ok(revision);
            }
            view.version += 1;
            let version = view.version;
            state.said = None;
            version
        };
        // The object is not removed meanwhile, nor deleted: that waits for its turn, too.
        let turn = self.cutting.lock().unwrap_or_else(PoisonError::into_inner);
        let (view, revision, folder) = {
            let mut state = self.lock();
            let revision = state.revision;
            let own = state.own(object)?;
            (own.views[number].clone(), revision, own.entry.folder(&self.folder))
        };
        // Somebody was faster: the last one wins.
        if view.version != version {
            return Ok(revision);
        }
        let depth = read(&self.depths).get(&number).cloned();
        let marks = marks.unwrap_or_else(|| view.marks.clone());
        let made = self.made((&folder, number), &view, &marks, depth.as_deref());
        let mut state = self.lock();
        state.said = None;
        let own = &mut state.own(object)?.views[number];
        // A later one goes on with what was there before.
        let drawn = own.version == version;
        match made {
            Ok(mask) => {
                own.origin = if mask.is_some() { Origin::Marks } else { Origin::None };
                if let Some(mask) = &mask {
                    own.share = share(mask);
                    own.made.retain(|(other, ..)| *other != marks);
                    own.made.push((marks.clone(), Some(depth.is_some()), mask.clone()));
                    let many = own.made.len().saturating_sub(KEPT_MASKS);
                    own.made.drain(..many);
                }
                (own.marks, own.mask) = (marks, mask);
                own.drawn = version;
                let late = depth.is_none() && own.is_few() && read(&self.depths).contains_key(&number);
                state.revision += 1;
                state.error = None;
                self.changed.notify_all();
                let revision = state.revision;
                drop((state, turn));
                // The marks count, whatever comes of the second time.
                if late { self.cut(object, number, None).or(Ok(revision)) } else { Ok(revision) }
            }
            Err(refused) => {
                if drawn {
                    own.drawn = version;
                }
                Err(refused)
            }
        }
    }

    /// The mask that marks make of a view, on disk as well. Where that fails, what was on disk stays or is put back.
    fn made(
        &self,
        (folder, number): (&Path, usize),
        view: &View,
        marks: &[Mark],
        depth: Option<&[DepthMap; 2]>,
    ) -> Result<Option<Arc<GrayImage>>, Refused> {
        let mask = if marks.is_empty() {
            None
        } else {
            let picture = self.picture(number).map_err(|error| (Refusal::Busy, error.to_string()))?;
            let carried = view.carried.as_ref().map(|shown| (shown.parts.as_slice(), shown.size));
            let [fit, measured] = [0, 1].map(|which| depth.map(|depths| &depths[which]));
            let cues = Cues { depth: fit, measured, carried, ..Cues::default() };
            // From the longest beginning of the marks that was made already.
            let fits = |with: &Option<bool>| with.is_none_or(|with| with == depth.is_some());
            let begun = view.made.iter().filter(|(own, with, _)| fits(with) && marks.starts_with(own));
            Some(match begun.max_by_key(|(own, ..)| own.len()) {
                Some((own, _, mask)) => (own.len() + 1..=marks.len()).fold(mask.clone(), |before, count| {
                    Arc::new(click::next(&picture, &marks[..count], &before, &cues))
                }),
                None => Arc::new(click::mask(&picture, marks, &cues)),
            })
        };
        let Photo { name, size, .. } = &self.photos[number];
        if let Err(error) = objects::write(folder, name, *size, marks, mask.as_deref()) {
            if view.origin == Origin::Marks {
                // The mask may have been written and its marks not. The error that is told is the first one.
                let _ = objects::write(folder, name, *size, &view.marks, view.mask.as_deref());
            }
            return Err((Refusal::Busy, format!("{}: cannot be written: {error}", folder.display())));
        }
        Ok(mask)
    }

    /// Asks for what is ticked to be removed, also in spite of what was found.
    ///
    /// # Errors
    /// Nothing is marked; it is being done already.
    pub fn remove(&self, despite: bool) -> Result<(), Refused> {
        let _turn = self.cutting.lock().unwrap_or_else(PoisonError::into_inner);
        let mut state = self.lock();
        if !state.ticked().any(|own| own.views.iter().any(View::has_object)) {
            let why = match state.objects.len() {
                1 => "nothing is marked yet; draw around what is to be removed",
                _ => "no object that is ticked is marked yet; tick one, or draw around it",
            };
            return Err((Refusal::Conflict, why.into()));
        }
        if state.phase == Phase::Working {
            return Err((Refusal::Conflict, "the object is being removed already".into()));
        }
        self.stop.store(false, Ordering::Relaxed);
        // That of an earlier training.
        *write(&self.live) = None;
        state.phase = Phase::Working;
        state.wanted = Some(despite);
        state.asked.clear();
        (state.error, state.problems) = (None, vec![]);
        self.changed.notify_all();
        Ok(())
    }

    /// Asks for an end of the work.
    pub fn stop(&self) {
        let mut state = self.lock();
        if state.phase == Phase::Working {
            self.stop.store(true, Ordering::Relaxed);
            // What has not begun yet does not begin.
            if state.wanted.take().is_some() {
                state.phase = Phase::Choosing;
            }
            self.changed.notify_all();
        }
    }

    // ------------------------------------------------------------ the worker's side

    /// The wish to end what is being worked at.
    pub fn stopping(&self) -> Arc<AtomicBool> {
        self.stop.clone()
    }

    /// A part of the work begins.
    pub fn begin(&self, name: &str, all: u64) {
        self.lock().part = Some(Part { name: name.to_owned(), done: 0, all });
    }

    /// So much of it is done.
    pub fn at(&self, done: u64) {
        if let Some(part) = &mut self.lock().part {
            part.done = done;
        }
    }

    /// The part has ended.
    pub fn end(&self) {
        self.lock().part = None;
    }

    /// Something has gone wrong: a sentence for the page. The user points again.
    pub fn fail(&self, why: impl Into<String>) {
        let mut state = self.lock();
        (state.phase, state.part, state.error) = (Phase::Choosing, None, Some(why.into()));
    }

    /// The work was stopped. The user points again.
    pub fn stopped(&self) {
        let mut state = self.lock();
        (state.phase, state.part) = (Phase::Choosing, None);
        self.stop.store(false, Ordering::Relaxed);
    }

    /// What speaks against going on, sentence by sentence: the user decides, once the work has ended for it.
    pub fn found(&self, problems: Vec<String>) {
        self.lock().problems = problems;
    }

    /// Whether something was found that speaks against going on.
    pub fn has_problems(&self) -> bool {
        !self.lock().problems.is_empty()
    }

    /// The training can be looked at.
    pub fn show(&self, board: Arc<Board>) {
        *write(&self.live) = Some(board);
    }

    /// The object is gone.
    pub fn done(&self, results: Results) {
        *write(&self.results) = results;
        let mut state = self.lock();
        (state.phase, state.part) = (Phase::Done, None);
        state.removals += 1;
        state.trained();
    }

    /// A view without the object; where it cannot be drawn, it is not asked for again.
    pub fn drew(&self, number: usize, after: Option<After>) {
        let mut results = write(&self.results);
        match after {
            Some(after) => drop(results.after.insert(number, after)),
            None => drop(results.before.remove(&number)),
        }
    }

    /// A view without the object, which is asked for unless it is there.
    fn after(&self, number: usize) -> Result<Vec<u8>, Refusal> {
        let results = read(&self.results);
        if let Some(After { jpeg, .. }) = results.after.get(&number) {
            return Ok(jpeg.clone());
        }
        let mut state = self.lock();
        if state.phase != Phase::Done || !results.before.contains_key(&number) {
            return Err(Refusal::NotFound);
        }
        state.asked.insert(number);
        self.changed.notify_all();
        Err(Refusal::Busy)
    }

    /// The fit is there.
    pub fn ready(&self) {
        self.lock().ready = true;
    }

    /// The depth of a view: the fit's, and as it is measured.
    pub fn knows(&self, number: usize, depths: [DepthMap; 2]) {
        write(&self.depths).insert(number, Arc::new(depths));
    }

    /// Keeps what an object's masks of this revision make of a view; nothing of it is kept where they have changed since.
    pub fn carry(&self, revision: u64, object: usize, number: usize, carried: Carried, size: [u32; 2]) -> bool {
        let mask = masks::threshold(&carried.object, size, working(self.photos[number].size), masks::OBJECT);
        let doubt = carried.thinness().unwrap_or(0.0);
        let mask = masks::without_specks(&mask, SPECK);
        let share = share(&mask);
        let mut state = self.lock();
        if state.revision != revision || state.phase == Phase::Working {
            return false;
        }
        let Ok(own) = state.own(object) else { return true };
        let shown = Shown { parts: carried.object, size, mask, share, doubt, revision };
        own.views[number].carried = Some(Arc::new(shown));
        state.said = None;
        true
    }

    /// The masks of this revision were carried to all views.
    pub fn carried(&self, revision: u64) {
        let mut state = self.lock();
        state.carried = revision;
        if state.revision != revision {
            return;
        }
        state.said = None;
        for own in state.objects.iter_mut().filter(|own| !own.views.iter().any(View::has_object)) {
            own.views.iter_mut().for_each(|view| view.carried = None);
        }
    }

    /// Whether there is something to do that is not what is being done for this revision.
    pub fn is_stale(&self, revision: u64) -> bool {
        let state = self.lock();
        state.revision != revision || state.wanted.is_some()
    }

    /// The next task, waiting for it for a while.
    pub fn wish(&self, patience: Duration) -> Wish {
        let state = self.lock();
        let idle = |state: &mut State| {
            let asked = state.wanted.is_some() || state.painting.wanted.is_some() || !state.asked.is_empty();
            !asked && (state.carried == state.revision || !state.ready)
        };
        let (mut state, _) =
            self.changed.wait_timeout_while(state, patience, idle).unwrap_or_else(PoisonError::into_inner);
        if let Some(what) = state.painting.wanted.take() {
            return Wish::Repaint(what);
        }
        if let Some(despite) = state.wanted.take() {
            return Wish::Remove(despite);
        }
        if let Some(number) = state.asked.pop_last() {
            return Wish::Draw(number);
        }
        if !state.ready || state.carried == state.revision {
            return Wish::Nothing;
        }
        let of = |(i, view): (usize, &View)| Some((i, view.drawn, view.mask.clone()?));
        let masks = |own: &Own| (own.entry.number, own.views.iter().enumerate().filter_map(of).collect());
        Wish::Carry(state.revision, state.objects.iter().map(masks).collect())
    }
}

/// The part of a mask's pixels that are the object.
fn share(mask: &GrayImage) -> f64 {
    mask.as_raw().iter().filter(|v| **v != 0).count() as f64 / mask.as_raw().len().max(1) as f64
}

#[cfg(test)]
mod tests;
