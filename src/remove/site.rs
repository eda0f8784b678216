//! The page over HTTP: what is asked for, and what is said.

use std::fs::File;
use std::io::Cursor;
use std::path::Path;
use std::sync::{Arc, PoisonError};

use image::{GrayImage, ImageFormat, Rgba, RgbaImage};
use serde::Deserialize;
use serde_json::json;

use super::{Origin, Phase, Photo, Refused, Session, THIN, View, read};
use crate::prepare::click::{Mark, working};
use crate::scene::{self, resample};
use crate::view::server::{Answer, Body, Refusal, Resource, Site};

const PAGE: &str = include_str!("page.html");
const STYLE: &str = include_str!("page.css");
const PROGRAM: &str = include_str!("page.js");
/// Width of a thumbnail, pixels.
const THUMB: u32 = 240;
/// Colours of a mask's inside and rim: of one that was marked, and of one that was carried.
const COLORS: [[[u8; 4]; 2]; 2] =
    [[[255, 80, 60, 105], [255, 240, 235, 255]], [[255, 170, 30, 95], [255, 235, 190, 235]]];

/// The body of a POST to `/api/marks`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Marked {
    view: String,
    marks: Vec<Mark>,
}

/// The body of a POST to `/api/remove`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Removed {
    #[serde(default)]
    despite: bool,
}

fn text(kind: &'static str, text: &'static str) -> Answer<'static> {
    Answer { kind, gzip: false, bytes: Body::Borrowed(text.as_bytes()) }
}

fn owned(kind: &'static str, bytes: Vec<u8>) -> Answer<'static> {
    Answer { kind, gzip: false, bytes: Body::Owned(bytes) }
}

/// The value of a field of a query, its escapes undone; nothing where it is not there or is no text.
fn field(query: &str, name: &str) -> Option<String> {
    let value = query.split('&').find_map(|field| field.split_once('=').filter(|(key, _)| *key == name))?.1;
    let mut bytes = vec![];
    let mut rest = value.bytes();
    while let Some(byte) = rest.next() {
        bytes.push(if byte == b'%' {
            let digits = [rest.next()?, rest.next()?];
            u8::from_str_radix(std::str::from_utf8(&digits).ok()?, 16).ok()?
        } else {
            byte
        });
    }
    String::from_utf8(bytes).ok()
}

fn jpeg(picture: &image::RgbImage, quality: u8) -> Result<Vec<u8>, Refusal> {
    scene::jpeg(picture, quality).map_err(|_| Refusal::Busy)
}

/// A mask as a picture to lay over its photograph.
fn overlay(mask: &GrayImage, [inside, rim]: [[u8; 4]; 2]) -> Result<Vec<u8>, Refusal> {
    let (w, h) = mask.dimensions();
    let on = |x: i64, y: i64| {
        let there = x >= 0 && y >= 0 && x < i64::from(w) && y < i64::from(h);
        !there || mask.get_pixel(x as u32, y as u32).0[0] != 0
    };
    let picture = RgbaImage::from_fn(w, h, |x, y| {
        let (x, y) = (i64::from(x), i64::from(y));
        if !on(x, y) {
            return Rgba([0; 4]);
        }
        // The rim of a large picture is two pixels wide.
        let reach = 1 + i64::from(w.max(h) > 600);
        let inner = on(x - reach, y) && on(x + reach, y) && on(x, y - reach) && on(x, y + reach);
        Rgba(if inner { inside } else { rim })
    });
    let mut bytes = Cursor::new(vec![]);
    picture.write_to(&mut bytes, ImageFormat::Png).map_err(|_| Refusal::Busy)?;
    Ok(bytes.into_inner())
}

impl View {
    /// The mask that counts, and which of the two kinds it is.
    fn shown(&self) -> Option<(&GrayImage, usize)> {
        match (&self.mask, &self.carried) {
            (Some(mask), _) => Some((mask, 0)),
            (None, Some(carried)) => Some((&carried.mask, 1)),
            (None, None) => None,
        }
    }

    /// As the page reads it.
    fn status(&self, photo: &Photo) -> serde_json::Value {
        let carried = self.carried.as_ref().filter(|_| self.mask.is_none());
        let shown = self.mask.is_some() || carried.is_some();
        json!({
            "name": photo.name, "size": photo.size, "marks": self.marks, "origin": self.origin,
            "busy": self.version != self.drawn,
            // Changes with the overlay.
            "overlay": shown.then(|| format!("{}-{}", self.drawn, carried.map_or(0, |c| c.revision))),
            "doubt": carried.map(|c| c.doubt), "share": shown.then(|| carried.map_or(self.share, |c| c.share)),
        })
    }
}

/// What the page is told of the views.
pub(super) struct Views {
    /// JSON of all of them.
    text: String,
    /// How many have a mask of their own.
    marked: usize,
    /// The one that is worth a look most, and how much of the object is not known there.
    next: Option<(f64, String)>,
}

impl Views {
    fn of(photos: &[Photo], views: &[View]) -> Self {
        let all: Vec<_> = photos.iter().zip(views).map(|(photo, view)| view.status(photo)).collect();
        let unsure = |(photo, view): (&Photo, &View)| {
            let carried = view.carried.as_ref().filter(|carried| view.mask.is_none() && carried.doubt > THIN)?;
            Some((carried.doubt, photo.name.clone()))
        };
        Self {
            text: serde_json::Value::from(all).to_string(),
            marked: views.iter().filter(|view| view.origin != Origin::None).count(),
            next: photos.iter().zip(views).filter_map(unsure).max_by(|a, b| a.0.total_cmp(&b.0)),
        }
    }
}

impl Session {
    /// The photograph that a query names.
    fn named(&self, query: &str) -> Result<usize, Refusal> {
        field(query, "view").and_then(|name| self.number(&name)).ok_or(Refusal::NotFound)
    }

    /// A photograph at another size.
    fn decoded(&self, path: &Path, size: [u32; 2]) -> Result<image::RgbImage, scene::Error> {
        // Large photographs are decoded one at a time.
        let _turn = self.decoding.lock().unwrap_or_else(PoisonError::into_inner);
        Ok(resample::photograph(&scene::photograph(path, 1)?, size))
    }

    fn thumbnail(&self, number: usize) -> Result<Vec<u8>, Refusal> {
        if let Some(made) = self.thumbs[number].get() {
            return Ok(made.clone());
        }
        let photo = &self.photos[number];
        let picture = self.decoded(&photo.path, thumb(photo.size)).map_err(|_| Refusal::NotFound)?;
        let made = jpeg(&picture, 80)?;
        Ok(self.thumbs[number].get_or_init(|| made).clone())
    }

    fn overlaid(&self, number: usize, small: bool) -> Result<Vec<u8>, Refusal> {
        let view = self.lock().views[number].clone();
        let (mask, kind) = view.shown().ok_or(Refusal::NotFound)?;
        if small {
            return overlay(&resample::mask(mask, thumb(self.photos[number].size)), COLORS[kind]);
        }
        overlay(mask, COLORS[kind])
    }

    /// The state as the page reads it. That of the views is made when it changes, not when it is asked for.
    pub(super) fn status(&self) -> String {
        let (files, compare): (Vec<_>, Vec<_>) = {
            let results = read(&self.results);
            let size = |path: &Path| std::fs::metadata(path).map_or(0, |file| file.len());
            let files = results.files.iter().map(|(name, path)| json!({ "name": name, "bytes": size(path) })).collect();
            (files, results.before.keys().map(|number| self.photos[*number].name.as_str()).collect())
        };
        let steps = read(&self.live).as_ref().map(|board| board.steps().map(u64::from));
        let (views, status) = {
            let mut state = self.lock();
            let views = match &state.said {
                Some(said) => said.clone(),
                None => Arc::new(Views::of(&self.photos, &state.views)),
            };
            state.said = Some(views.clone());
            let mut part = state.part.clone();
            if let (Some(part), Some([done, all])) = (part.as_mut().filter(|part| part.name == "train"), steps) {
                (part.done, part.all) = (done, all);
            }
            let status = json!({
                "title": self.title, "revision": state.revision, "phase": state.phase, "part": part,
                "ready": state.ready, "carrying": state.ready && state.carried != state.revision,
                "marked": views.marked,
                "next": views.next.as_ref().map(|(_, name)| name), "doubt": views.next.as_ref().map(|(doubt, _)| doubt),
                "problems": state.problems, "error": state.error,
                "live": steps.is_some() && state.phase == Phase::Working, "files": files,
                "compare": compare, "removals": state.removals,
            });
            (views, status)
        };
        let status = status.to_string();
        let open = status.strip_suffix('}').expect("an object in JSON ends with a brace");
        format!("{open},\"views\":{}}}", views.text)
    }
}

/// The size of a thumbnail.
fn thumb(size: [u32; 2]) -> [u32; 2] {
    let width = THUMB.min(size[0]);
    [width, (u64::from(size[1]) * u64::from(width) / u64::from(size[0].max(1))).max(1) as u32]
}

impl Site for Session {
    fn get(&self, path: &str, query: &str) -> Result<Answer<'_>, Refusal> {
        if let Some(rest) = path.strip_prefix("/live/") {
            let board = read(&self.live).clone().ok_or(Refusal::NotFound)?;
            let Answer { kind, gzip, bytes } = board.get(&format!("/{rest}"), query)?;
            return Ok(Answer { kind, gzip, bytes: bytes.into_static() });
        }
        if let Some(rest) = path.strip_prefix("/result") {
            let results = read(&self.results);
            let resource = results.page.iter().find(|resource| resource.path == rest).ok_or(Refusal::NotFound)?;
            let Resource { kind, gzip, .. } = **resource;
            return Ok(Answer { kind, gzip, bytes: Body::Shared(resource.clone()) });
        }
        if let Some(name) = path.strip_prefix("/download/") {
            let results = read(&self.results);
            let (_, path) = results.files.iter().find(|(own, _)| own == name).ok_or(Refusal::NotFound)?;
            let file = File::open(path).map_err(|_| Refusal::NotFound)?;
            let length = file.metadata().map_err(|_| Refusal::NotFound)?.len();
            return Ok(Answer { kind: "application/octet-stream", gzip: false, bytes: Body::File(file, length) });
        }
        match path {
            "/" => Ok(text("text/html; charset=utf-8", PAGE)),
            "/page.css" => Ok(text("text/css", STYLE)),
            "/page.js" => Ok(text("text/javascript", PROGRAM)),
            "/api/state" => Ok(owned("application/json", self.status().into_bytes())),
            "/photo.jpg" => {
                let number = self.named(query)?;
                let picture = self.picture(number).map_err(|_| Refusal::NotFound)?;
                Ok(owned("image/jpeg", jpeg(&picture, 90)?))
            }
            "/before.jpg" => {
                let number = self.named(query)?;
                let path = read(&self.results).before.get(&number).cloned().ok_or(Refusal::NotFound)?;
                let picture = self.decoded(&path, working(self.photos[number].size));
                Ok(owned("image/jpeg", jpeg(&picture.map_err(|_| Refusal::NotFound)?, 90)?))
            }
            "/after.jpg" => Ok(owned("image/jpeg", self.after(self.named(query)?)?)),
            "/thumb.jpg" => Ok(owned("image/jpeg", self.thumbnail(self.named(query)?)?)),
            "/overlay.png" => {
                let small = field(query, "small").is_some();
                Ok(owned("image/png", self.overlaid(self.named(query)?, small)?))
            }
            _ => Err(Refusal::NotFound),
        }
    }

    fn posts(&self) -> bool {
        true
    }

    fn post(&self, path: &str, body: &[u8]) -> Result<Answer<'_>, Refused> {
        fn parsed<'a, T: Deserialize<'a>>(body: &'a [u8]) -> Result<T, Refused> {
            serde_json::from_slice(body)
                .map_err(|error| (Refusal::BadRequest, format!("not what is meant here: {error}")))
        }
        match path {
            "/api/marks" => {
                let Marked { view, marks } = parsed(body)?;
                let number = self
                    .number(&view)
                    .ok_or_else(|| (Refusal::NotFound, format!("no photograph is called {view:?}")))?;
                self.mark(number, marks)?;
            }
            "/api/remove" => self.remove(parsed::<Removed>(body)?.despite)?,
            "/api/stop" => {
                parsed::<serde_json::Map<String, serde_json::Value>>(body)?;
                self.stop();
            }
            _ => return Err((Refusal::NotFound, "there is nothing of this name".into())),
        }
        Ok(owned("application/json", self.status().into_bytes()))
    }
}
