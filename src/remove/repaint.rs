//! What is repainted by hand on the page, once the object is gone: strokes of a brush where the fill is wrong, and where a patch
//! for it lies. The worker repaints the scene; trained is it with that when the object is removed again.

use image::GrayImage;
use serde::Deserialize;
use serde_json::{Value, json};

use super::{Phase, Refused, Session, State, read};
use crate::prepare::click::Mark;
use crate::prepare::hole::repaint;
use crate::view::server::Refusal;

/// The body of a POST to `/api/repaint`.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Asked {
    /// A part is made anew.
    Paint {
        /// The photograph in which it was brushed.
        view: String,
        /// Strokes of the brush.
        strokes: Vec<Mark>,
        /// How far right and down of it the patch lies, as parts of the photograph's width and height.
        offset: Option<[f64; 2]>,
    },
    /// The last one is taken back.
    Undo {},
}

/// What the worker is to repaint.
pub enum Repainting {
    /// This part of a view's hole, with the patch that lies so far from it in pixels.
    Paint(usize, GrayImage, Option<[i32; 2]>),
    /// The last one is taken back.
    Undo,
}

/// What was repainted since the page is there.
#[derive(Default)]
pub(super) struct Painting {
    /// What the worker is to do.
    pub wanted: Option<Repainting>,
    busy: bool,
    /// Counts what was done.
    count: u64,
    /// What it counted when the scene was trained last.
    trained: u64,
    /// Why the last one came to nothing.
    refused: Option<String>,
}

impl Session {
    /// Asks for a part to be repainted.
    ///
    /// # Errors
    /// There is nothing to repaint yet, or something is being repainted; strokes that make no sense.
    pub fn repaint(&self, asked: Asked) -> Result<(), Refused> {
        let wanted = match asked {
            Asked::Undo {} => Repainting::Undo,
            Asked::Paint { view, strokes, offset } => {
                let number = self.view(&view)?;
                let is_brush = |mark: &Mark| matches!(mark, Mark::Brush { object: true, .. }) && mark.is_sound();
                let near = |by: &[f64; 2]| by.iter().all(|v| v.abs() <= 1.0);
                if strokes.is_empty() || !strokes.iter().all(is_brush) || !offset.as_ref().is_none_or(near) {
                    let why = "brush over what is wrong first, within the photograph";
                    return Err((Refusal::BadRequest, why.into()));
                }
                let size = self.photos[number].size;
                let pixels = |by: [f64; 2]| [0, 1].map(|a| (by[a] * f64::from(size[a])).round() as i32);
                Repainting::Paint(number, Mark::brushed(&strokes, size), offset.map(pixels))
            }
        };
        let mut state = self.lock();
        if state.phase != Phase::Done || state.painting.busy {
            let why = if state.painting.busy { "another part is being repainted" } else { "remove the object first" };
            return Err((Refusal::Conflict, why.into()));
        }
        state.painting = Painting { wanted: Some(wanted), busy: true, refused: None, ..state.painting };
        self.changed.notify_all();
        Ok(())
    }

    /// What was to be repainted is done, or this is why not.
    pub fn repainted(&self, refused: Option<String>) {
        let mut state = self.lock();
        state.painting.count += u64::from(refused.is_none());
        (state.painting.busy, state.painting.refused) = (false, refused);
    }

    /// The photograph of this number with its hole filled, at the size of the filling.
    pub(super) fn filled(&self, number: usize) -> Option<image::RgbImage> {
        let (scene, photograph) = {
            let results = read(&self.results);
            (results.filled.as_ref()?.0.clone(), results.before.get(&number)?.clone())
        };
        let _turn = self.decoding.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        repaint::filled(&scene, &self.photos[number].name, &photograph).ok()
    }
}

impl State {
    /// What is painted now is what was trained.
    pub(super) fn trained(&mut self) {
        self.painting.trained = self.painting.count;
    }

    /// What the page is told of it.
    pub(super) fn painting(&self) -> Value {
        let Painting { busy, count, trained, refused, .. } = &self.painting;
        json!({ "busy": busy, "count": count, "untrained": count != trained, "refused": refused })
    }
}
