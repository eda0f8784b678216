//! The page over HTTP: what is asked for, and what is said.

use std::fs::File;
use std::io::Cursor;
use std::path::Path;
use std::sync::{Arc, PoisonError};

use image::{GrayImage, ImageFormat, Rgba, RgbaImage};
use serde::Deserialize;
use serde_json::json;

use super::list::Change;
use super::{Left, Origin, Own, Phase, Photo, Refused, Session, Shown, State, THIN, View, read};
use crate::prepare::click::{Mark, working};
use crate::scene::{self, resample};
use crate::view::server::{Answer, Body, Refusal, Resource, Site};

const PAGE: &str = include_str!("page.html");
const STYLE: &str = include_str!("page.css");
const PROGRAM: &str = include_str!("page.js");
const REPAINT: &str = include_str!("repaint.js");
const COMPARE: &str = include_str!("compare.js");
/// Width of a thumbnail, pixels.
const THUMB: u32 = 240;
/// Colours of a mask's inside and rim.
type Paint = [[u8; 4]; 2];
/// Of the mask of an object that is alone: of one that was marked, and of one that was carried.
const ALONE: [Paint; 2] = [[[255, 80, 60, 105], [255, 240, 235, 255]], [[255, 170, 30, 95], [255, 235, 190, 235]]];
/// Colours of several objects, by number, over and over.
const COLORS: [[u8; 3]; 8] = [
    [255, 80, 60],
    [50, 130, 255],
    [40, 185, 90],
    [250, 180, 20],
    [170, 90, 250],
    [0, 190, 200],
    [250, 90, 180],
    [150, 115, 70],
];

/// The body of a POST to `/api/marks`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Marked {
    #[serde(default = "first")]
    object: usize,
    view: String,
    marks: Vec<Mark>,
}

/// The object of those who know of one.
fn first() -> usize {
    1
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

/// A JPEG picture in another size.
fn reduced(whole: &[u8], size: [u32; 2]) -> Result<Vec<u8>, Refusal> {
    let picture = image::load_from_memory(whole).map_err(|_| Refusal::NotFound)?;
    jpeg(&resample::photograph(&picture.to_rgb8(), size), 80)
}

/// A mask as a picture to lay over its photograph.
fn painted(mask: &GrayImage, [inside, rim]: Paint) -> RgbaImage {
    let (w, h) = mask.dimensions();
    let on = |x: i64, y: i64| {
        let there = x >= 0 && y >= 0 && x < i64::from(w) && y < i64::from(h);
        !there || mask.get_pixel(x as u32, y as u32).0[0] != 0
    };
    RgbaImage::from_fn(w, h, |x, y| {
        let (x, y) = (i64::from(x), i64::from(y));
        if !on(x, y) {
            return Rgba([0; 4]);
        }
        // The rim of a large picture is two pixels wide.
        let reach = 1 + i64::from(w.max(h) > 600);
        let inner = on(x - reach, y) && on(x + reach, y) && on(x, y - reach) && on(x, y + reach);
        Rgba(if inner { inside } else { rim })
    })
}

/// What is least transparent of either picture.
fn laid_over(mut below: RgbaImage, above: &RgbaImage) -> RgbaImage {
    let pixels = below.pixels_mut().zip(above.pixels()).filter(|(below, above)| above.0[3] > below.0[3]);
    pixels.for_each(|(below, above)| *below = *above);
    below
}

fn png(picture: &RgbaImage) -> Result<Vec<u8>, Refusal> {
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

    /// What is carried to it, where it has no mask of its own.
    fn unmarked(&self) -> Option<&Shown> {
        self.carried.as_deref().filter(|_| self.mask.is_none())
    }

    /// As the page reads it.
    fn status(&self) -> serde_json::Value {
        let carried = self.unmarked();
        let share = carried.map(|c| c.share).or(self.mask.is_some().then_some(self.share));
        json!({ "marks": self.marks, "origin": self.origin, "doubt": carried.map(|c| c.doubt), "share": share })
    }

    /// Changes with what is shown of it; nothing where there is nothing.
    fn key(&self) -> Option<String> {
        let carried = self.unmarked().map_or(0, |c| c.revision);
        self.shown().map(|_| format!("{}-{carried}", self.drawn))
    }
}

impl Own {
    fn color(&self) -> [u8; 3] {
        COLORS[(self.entry.number - 1) % COLORS.len()]
    }

    /// The colours of its masks that were marked and carried, where it is one of several: of one that stays only rims are seen.
    fn paint(&self) -> [Paint; 2] {
        let color = self.color();
        let with = |[r, g, b]: [u8; 3], alpha: u8| [r, g, b, alpha];
        let light = |by: u16| color.map(|v| (u16::from(v) + (255 - u16::from(v)) * by / 100) as u8);
        match self.entry.remove {
            true => [[with(color, 115), with(light(80), 255)], [with(color, 80), with(light(35), 235)]],
            false => [[[0; 4], with(light(40), 200)], [[0; 4], with(color, 150)]],
        }
    }

    /// As the page reads it.
    fn status(&self) -> serde_json::Value {
        let [r, g, b] = self.color();
        json!({
            "number": self.entry.number, "name": self.entry.name, "remove": self.entry.remove,
            "color": format!("#{r:02x}{g:02x}{b:02x}"),
            "marked": self.views.iter().filter(|view| view.origin != Origin::None).count(),
        })
    }
}

/// What the page is told of the views.
pub(super) struct Views {
    /// JSON of all of them.
    text: String,
    /// How many have a mask of their own.
    marked: usize,
    /// The one that is worth a look most, the object for which it is, and how much of this is not known there.
    next: Option<(f64, String, usize)>,
}

impl Views {
    fn of(photos: &[Photo], state: &State) -> Self {
        let of = |number: usize| state.objects.iter().map(move |own| &own.views[number]);
        let is_marked = |number: &usize| of(*number).any(|view| view.origin != Origin::None);
        let doubts = |number: usize| {
            state.ticked().filter_map(move |own| Some((own.views[number].unmarked()?.doubt, own.entry.number)))
        };
        let most = |number: usize| doubts(number).max_by(|a, b| a.0.total_cmp(&b.0));
        let status = |(number, photo): (usize, &Photo)| {
            // Of several objects all that changes their picture.
            let keys = state.objects.iter().filter_map(|own| {
                let key = own.views[number].key()?;
                let several = || format!("{}.{key}.{}", own.entry.number, u8::from(own.entry.remove));
                Some(if state.objects.len() > 1 { several() } else { key })
            });
            let keys: Vec<String> = keys.collect();
            json!({
                "name": photo.name, "size": photo.size, "busy": of(number).any(|view| view.version != view.drawn),
                "overlay": (!keys.is_empty()).then(|| keys.join("_")), "marked": is_marked(&number),
                "doubt": most(number).map(|(doubt, _)| doubt), "objects": of(number).map(View::status).collect::<Vec<_>>(),
            })
        };
        let all: Vec<_> = photos.iter().enumerate().map(status).collect();
        let unsure = |(number, photo): (usize, &Photo)| {
            let (doubt, object) = most(number).filter(|(doubt, _)| *doubt > THIN)?;
            Some((doubt, photo.name.clone(), object))
        };
        Self {
            text: serde_json::Value::from(all).to_string(),
            marked: (0..photos.len()).filter(is_marked).count(),
            next: photos.iter().enumerate().filter_map(unsure).max_by(|a, b| a.0.total_cmp(&b.0)),
        }
    }
}

impl Session {
    /// The photograph that a query names.
    fn named(&self, query: &str) -> Result<usize, Refusal> {
        field(query, "view").and_then(|name| self.number(&name)).ok_or(Refusal::NotFound)
    }

    /// The photograph of this name.
    pub(super) fn view(&self, name: &str) -> Result<usize, Refused> {
        self.number(name).ok_or_else(|| (Refusal::NotFound, format!("no photograph is called {name:?}")))
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
        let size = thumb(self.photos[number].size);
        let layers: Vec<(GrayImage, Paint)> = {
            let state = self.lock();
            let several = state.objects.len() > 1;
            let layer = |own: &Own| {
                let (mask, kind) = own.views[number].shown()?;
                let paint = if several { own.paint() } else { ALONE };
                Some((if small { resample::mask(mask, size) } else { mask.clone() }, paint[kind]))
            };
            state.objects.iter().filter_map(layer).collect()
        };
        let painted = layers.iter().map(|(mask, paint)| painted(mask, *paint));
        png(&painted.reduce(|below, above| laid_over(below, &above)).ok_or(Refusal::NotFound)?)
    }

    /// The state as the page reads it. That of the views is made when it changes, not when it is asked for.
    pub(super) fn status(&self) -> String {
        let (files, compare, filled, left): (Vec<_>, Vec<_>, Vec<_>, _) = {
            let results = read(&self.results);
            let size = |path: &Path| std::fs::metadata(path).map_or(0, |file| file.len());
            let files = results.files.iter().map(|(name, path)| json!({ "name": name, "bytes": size(path) })).collect();
            let name = |number: &usize| self.photos[*number].name.as_str();
            let filled = results.filled.iter().flat_map(|(_, views)| views).map(name);
            let left = results.left().map(
                |Left { view, most, mean, of }| json!({ "most": most, "view": name(&view), "mean": mean, "of": of }),
            );
            (files, results.before.keys().map(name).collect(), filled.collect(), left)
        };
        let steps = read(&self.live).as_ref().map(|board| board.steps().map(u64::from));
        let (views, status) = {
            let mut state = self.lock();
            let views = match &state.said {
                Some(said) => said.clone(),
                None => Arc::new(Views::of(&self.photos, &state)),
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
                "objects": state.objects.iter().map(Own::status).collect::<Vec<_>>(),
                "deleted": state.deleted.as_ref().map(|deleted| &deleted.own.entry.name),
                "next": views.next.as_ref().map(|(_, name, _)| name), "doubt": views.next.as_ref().map(|(doubt, ..)| doubt),
                "of": views.next.as_ref().map(|(.., object)| object),
                "problems": state.problems, "error": state.error,
                "live": steps.is_some() && state.phase == Phase::Working, "files": files,
                "compare": compare, "removals": state.removals, "filled": filled, "left": left, "painting": state.painting(),
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
            "/repaint.js" => Ok(text("text/javascript", REPAINT)),
            "/compare.js" => Ok(text("text/javascript", COMPARE)),
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
            "/filled.jpg" => {
                let filled = self.filled(self.named(query)?).ok_or(Refusal::NotFound)?;
                Ok(owned("image/jpeg", jpeg(&filled, 92)?))
            }
            "/after.jpg" => {
                let number = self.named(query)?;
                let whole = self.after(number)?;
                let small = field(query, "small").is_some();
                Ok(owned("image/jpeg", if small { reduced(&whole, thumb(self.photos[number].size))? } else { whole }))
            }
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
                let Marked { object, view, marks } = parsed(body)?;
                self.mark(object, self.view(&view)?, marks)?;
            }
            "/api/objects" => self.change(parsed::<Change>(body)?)?,
            "/api/repaint" => self.repaint(parsed(body)?)?,
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
