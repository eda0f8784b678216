//! The list of objects: one more, another name, whether it is to be removed, one less and back again.

use std::path::PathBuf;
use std::sync::PoisonError;

use serde::Deserialize;

use super::objects::{self, Entry};
use super::{Own, Refused, Session, View};
use crate::atomic;
use crate::prepare::Object;
use crate::view::server::Refusal;

/// Objects at most.
const MOST: usize = 24;

/// An object that can come back.
pub(super) struct Deleted {
    /// Its place in the list.
    place: usize,
    pub own: Own,
    /// What was on disk.
    files: Vec<(PathBuf, Vec<u8>)>,
}

/// A change of the list; objects go by their numbers.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Change {
    /// Another object.
    Add {},
    /// Another name for one.
    Rename {
        /// Which.
        object: usize,
        /// The name.
        name: String,
    },
    /// Whether one is to be removed.
    Tick {
        /// Which.
        object: usize,
        /// Whether.
        remove: bool,
    },
    /// One is forgotten, with its marks.
    Delete {
        /// Which.
        object: usize,
    },
    /// The one that was deleted last comes back.
    Restore {},
}

impl Session {
    /// Changes the list, here and on disk, or nothing.
    ///
    /// # Errors
    /// Changes that make no sense; a time at which nothing can be changed; files that cannot be read or written.
    pub fn change(&self, change: Change) -> Result<(), Refused> {
        // No mask is written meanwhile.
        let _turn = self.cutting.lock().unwrap_or_else(PoisonError::into_inner);
        self.lock().may_change()?;
        match change {
            Change::Add {} => self.add(),
            Change::Rename { object, name } => {
                let why = "a name is one line of 1 to 40 characters";
                let name = Object::checked_name(&name).ok_or((Refusal::BadRequest, why.to_owned()))?;
                self.set(object, |entry| name.clone_into(&mut entry.name))
            }
            Change::Tick { object, remove } => self.set(object, |entry| entry.remove = remove),
            Change::Delete { object } => self.delete(object),
            Change::Restore {} => self.restore(),
        }
    }

    fn keep(&self, list: &[Entry]) -> Result<(), Refused> {
        objects::keep(&self.folder, list).map_err(|error| {
            let path = self.folder.with_extension("json");
            (Refusal::Busy, format!("{}: cannot be written: {error}", path.display()))
        })
    }

    fn entries(&self) -> Vec<Entry> {
        self.lock().objects.iter().map(|own| own.entry.clone()).collect()
    }

    fn set(&self, object: usize, set: impl Fn(&mut Entry)) -> Result<(), Refused> {
        self.lock().own(object)?;
        let mut list = self.entries();
        list.iter_mut().filter(|entry| entry.number == object).for_each(&set);
        self.keep(&list)?;
        let mut state = self.lock();
        set(&mut state.own(object)?.entry);
        state.said = None;
        Ok(())
    }

    fn add(&self) -> Result<(), Refused> {
        let mut list = self.entries();
        if list.len() >= MOST {
            return Err((Refusal::Conflict, format!("there are {MOST} objects already; delete one first")));
        }
        let deleted = self.lock().deleted.as_ref().map(|deleted| deleted.own.entry.number);
        // What lies in a folder that the list does not have is the user's.
        let is_free = |entry: &Entry| {
            Some(entry.number) != deleted
                && list.iter().all(|other| other.number != entry.number)
                && !entry.folder(&self.folder).exists()
        };
        let entry = (2..).map(Entry::new).find(is_free).expect("a number that is not taken");
        list.push(entry.clone());
        self.keep(&list)?;
        let view = View { version: 1, drawn: 1, ..View::default() };
        let mut state = self.lock();
        state.objects.push(Own { entry, views: vec![view; self.photos.len()] });
        state.said = None;
        Ok(())
    }

    fn delete(&self, object: usize) -> Result<(), Refused> {
        let failed = |error: std::io::Error| (Refusal::Busy, format!("object {object} cannot be deleted: {error}"));
        let list = self.entries();
        let place = list.iter().position(|entry| entry.number == object);
        let (Some(place), 2..) = (place, list.len()) else {
            return Err((Refusal::Conflict, "the only object cannot be deleted; clear its marks".into()));
        };
        let folder = list[place].folder(&self.folder);
        let files = objects::files(&folder, self.photos.iter().map(|photo| &photo.name)).map_err(failed)?;
        let rest: Vec<Entry> = list.into_iter().filter(|entry| entry.number != object).collect();
        self.keep(&rest)?;
        files.iter().try_for_each(|(path, _)| std::fs::remove_file(path)).map_err(failed)?;
        // A folder that has something else in it stays.
        let _ = std::fs::remove_dir(folder);
        let mut state = self.lock();
        let mut own = state.objects.remove(place);
        // Marks that wait for their turn are not made any more.
        own.views.iter_mut().for_each(|view| view.drawn = view.version);
        state.deleted = Some(Deleted { place, own, files });
        state.said = None;
        Ok(())
    }

    fn restore(&self) -> Result<(), Refused> {
        let failed = |error: std::io::Error| (Refusal::Busy, format!("the object cannot be brought back: {error}"));
        let mut list = self.entries();
        {
            let state = self.lock();
            let nothing = (Refusal::Conflict, "no object was deleted".to_owned());
            let Deleted { place, own, files } = state.deleted.as_ref().ok_or(nothing)?;
            files.iter().try_for_each(|(path, bytes)| atomic::write_below(path, bytes)).map_err(failed)?;
            list.insert((*place).min(list.len()), own.entry.clone());
        }
        self.keep(&list)?;
        let mut state = self.lock();
        if let Some(Deleted { place, own, .. }) = state.deleted.take() {
            let place = place.min(state.objects.len());
            state.objects.insert(place, own);
        }
        state.said = None;
        Ok(())
    }
}
