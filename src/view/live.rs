//! A training under way in the browser: pictures that the trainer renders from where a visitor looks, the loss, the time
//! left.
//!
//! The training's thread and the server's meet at a [`Board`]. A visitor leaves a camera on it, one at a time; between two
//! steps the trainer looks at a flag, and where it is up it renders that camera and lays the picture down ([`Host`]).
//! Nothing is rendered unasked. A picture that took a while is followed by a pause so long that pictures take
//! [`SHARE`] of the time at most, however many visitors there are. JPEG is made of it by the visitor's thread.
//!
//! Rendering changes nothing of the model, and what fails is said to the visitor alone: the trained bytes are the same with
//! visitors and without.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use glam::DVec3;
use image::codecs::jpeg::JpegEncoder;
use serde::Serialize;
use serde_json::json;

use super::server::{Answer, Refusal, Site};
use crate::evaluate::Report;
use crate::gpu;
use crate::render::view::Rendered;
use crate::scene::{Camera, Scene, path};
use crate::train::run::Progress;

/// Part of the time that pictures for visitors may take.
pub const SHARE: f64 = 0.04;
/// How long a visitor waits for a picture before it is told to come again: evaluations take their time.
const PATIENCE: Duration = Duration::from_secs(20);
/// Sides of a picture, pixels.
const SIDES: std::ops::RangeInclusive<u32> = 16..=1280;
/// JPEG's.
const QUALITY: u8 = 88;
/// Most points of the loss curve; when there are more, each two become one.
const POINTS: usize = 400;
const PAGE: &str = include_str!("live.html");

/// A training view to look from.
#[derive(Debug, Clone, Serialize)]
struct Pose {
    name: String,
    center: [f64; 3],
    /// Right, down and ahead.
    rotation: [[f32; 3]; 3],
    /// Focal lengths in widths of the picture.
    focal: [f64; 2],
    /// Height per width.
    aspect: f64,
}

/// Where one waiting visitor's camera lies.
#[derive(Default)]
enum Slot {
    #[default]
    Free,
    Asked(Camera),
    Drawing,
    Drawn(Option<Rendered>),
}

/// Means of the loss over equally many steps each.
struct Curve {
    /// Steps of a point.
    each: u32,
    /// Last step and mean loss.
    points: Vec<(u32, f32)>,
    /// Sum and number since.
    rest: (f64, u32),
}

impl Default for Curve {
    fn default() -> Self {
        Self { each: 1, points: vec![], rest: (0.0, 0) }
    }
}

impl Curve {
    fn push(&mut self, step: u32, loss: f32) {
        self.rest = (self.rest.0 + f64::from(loss), self.rest.1 + 1);
        if self.rest.1 < self.each {
            return;
        }
        self.points.push((step, (self.rest.0 / f64::from(self.rest.1)) as f32));
        self.rest = (0.0, 0);
        if self.points.len() > POINTS {
            self.points = self.points.chunks(2).map(|pair| (pair[pair.len() - 1].0, mean(pair))).collect();
            self.each *= 2;
        }
    }
}

fn mean(points: &[(u32, f32)]) -> f32 {
    points.iter().map(|point| point.1).sum::<f32>() / points.len() as f32
}

/// What the two sides know of each other.
#[derive(Default)]
struct State {
    slot: Slot,
    curve: Curve,
    progress: Progress,
    /// Step, PSNR and masked PSNR of every evaluation.
    figures: Vec<(u32, f64, Option<f64>)>,
    /// Behind this the trainer takes no camera.
    ended: bool,
    /// Seconds per pixel of the last picture.
    cost: f64,
    /// Step and time that this session began with.
    began: Option<(u32, Instant)>,
}

/// Where visitors and the trainer meet.
pub struct Board {
    title: String,
    iterations: u32,
    /// Up in the world, roughly, and what the training cameras look at.
    up: [f64; 3],
    focus: [f64; 3],
    poses: Vec<Pose>,
    /// Centres farther away than this are refused.
    reach: f64,
    state: Mutex<State>,
    /// The slot has changed.
    turned: Condvar,
    /// Whether a camera waits, for the trainer to look at between steps.
    asked: AtomicBool,
}

impl Board {
    /// The board of a training of so many steps.
    pub fn new(title: impl Into<String>, scene: &Scene, iterations: u32) -> Arc<Self> {
        let cameras: Vec<Camera> = scene.train.iter().map(|view| view.camera).collect();
        let focus = path::focus(&cameras, &scene.points).unwrap_or_default();
        let down: DVec3 = cameras.iter().map(|camera| DVec3::from_array(camera.rotation[1].map(f64::from))).sum();
        let up = (-down).try_normalize().unwrap_or(DVec3::NEG_Y).to_array();
        let pose = |view: &crate::scene::View| {
            let Camera { rotation, focal, size, .. } = view.camera;
            let width = f64::from(size[0]);
            Pose {
                name: view.name.clone(),
                center: view.camera.center(),
                rotation,
                focal: focal.map(|f| f64::from(f) / width),
                aspect: f64::from(size[1]) / width,
            }
        };
        let far = cameras.iter().map(|c| DVec3::from_array(c.center()).distance(DVec3::from_array(focus)));
        Arc::new(Self {
            title: title.into(),
            iterations,
            up,
            focus,
            poses: scene.train.iter().map(pose).collect(),
            reach: 100.0 * far.fold(1.0, f64::max),
            state: Mutex::default(),
            turned: Condvar::new(),
            asked: AtomicBool::new(false),
        })
    }

    /// A thread that panicked has left nothing half done that matters here.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A picture from there, when the trainer has time.
    fn picture(&self, camera: Camera) -> Result<Rendered, Refusal> {
        let deadline = Instant::now() + PATIENCE;
        let wait = |state| {
            let left = deadline.saturating_duration_since(Instant::now());
            let (state, _) = self.turned.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner);
            (state, Instant::now() >= deadline)
        };
        let mut state = self.lock();
        while !matches!(state.slot, Slot::Free) {
            let late;
            (state, late) = wait(state);
            if late {
                return Err(Refusal::Busy);
            }
        }
        if state.ended {
            return Err(Refusal::Gone);
        }
        state.slot = Slot::Asked(camera);
        self.asked.store(true, Ordering::Release);
        loop {
            let late;
            (state, late) = wait(state);
            match std::mem::take(&mut state.slot) {
                Slot::Drawn(picture) => {
                    self.turned.notify_all();
                    return picture.ok_or(Refusal::Busy);
                }
                Slot::Asked(_) if late || state.ended => {
                    self.asked.store(false, Ordering::Release);
                    self.turned.notify_all();
                    return Err(if state.ended { Refusal::Gone } else { Refusal::Busy });
                }
                // What is being drawn comes soon.
                other => state.slot = other,
            }
        }
    }

    /// The camera of a query: `c` its centre, `r` right, down and ahead, `f` focal lengths in widths, `s` width and height.
    fn camera(&self, query: &str) -> Option<Camera> {
        let fields: BTreeMap<&str, &str> = query.split('&').filter_map(|field| field.split_once('=')).collect();
        let center: [f64; 3] = numbers(fields.get("c")?)?;
        let axes: [f64; 9] = numbers(fields.get("r")?)?;
        let focal: [f64; 2] = numbers(fields.get("f")?)?;
        let sides: [f64; 2] = numbers(fields.get("s")?)?;
        let size = sides.map(|side| side as u32);
        let [right, down, ahead]: [DVec3; 3] = std::array::from_fn(|i| DVec3::from_slice(&axes[3 * i..3 * i + 3]));
        let near = |a: f64, b: f64| (a - b).abs() < 1e-3;
        let turned = near(right.length(), 1.0) && near(ahead.length(), 1.0) && near(right.cross(down).dot(ahead), 1.0);
        let there = DVec3::from_array(center).distance(DVec3::from_array(self.focus)) <= self.reach;
        let sound = size.iter().all(|side| SIDES.contains(side)) && focal.iter().all(|f| (0.1..=20.0).contains(f));
        if !(turned && near(down.length(), 1.0) && there && sound) {
            return None;
        }
        let rotation = [right, down, ahead].map(|axis| axis.to_array().map(|v| v as f32));
        let width = f64::from(size[0]);
        Some(Camera {
            rotation,
            translation: Camera::translation_to(&rotation, center),
            focal: focal.map(|f| (f * width) as f32),
            principal: size.map(|side| side as f32 / 2.0),
            distortion: [0.0; 4],
            size,
        })
    }

    fn status(&self) -> String {
        let state = self.lock();
        let Progress { step, seconds, ref view, loss, ref losses, anchors, gaussians, .. } = state.progress;
        let left = state.began.filter(|(first, _)| step > *first).map(|(first, began)| {
            began.elapsed().as_secs_f64() / f64::from(step - first) * f64::from(self.iterations.saturating_sub(step))
        });
        let losses: BTreeMap<&str, f32> = losses.iter().filter(|(_, value)| *value != 0.0).copied().collect();
        json!({
            "step": step, "iterations": self.iterations, "seconds": seconds, "left": left, "view": view, "loss": loss,
            "losses": losses, "anchors": anchors, "gaussians": gaussians, "curve": state.curve.points,
            "figures": state.figures, "cost": state.cost, "ended": state.ended,
        })
        .to_string()
    }
}

/// So many finite numbers between commas.
fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let all: Option<Vec<f64>> = text.split(',').map(|word| word.parse().ok().filter(|v: &f64| v.is_finite())).collect();
    all?.try_into().ok()
}

impl Site for Board {
    fn get(&self, path: &str, query: &str) -> Result<Answer<'_>, Refusal> {
        let owned = |kind, bytes: Vec<u8>| Ok(Answer { kind, gzip: false, bytes: Cow::Owned(bytes) });
        match path {
            "/" => Ok(Answer { kind: "text/html; charset=utf-8", gzip: false, bytes: Cow::Borrowed(PAGE.as_bytes()) }),
            "/scene.json" => {
                let Self { title, up, focus, poses, .. } = self;
                let scene = json!({ "title": title, "up": up, "focus": focus, "cameras": poses });
                owned("application/json", scene.to_string().into_bytes())
            }
            "/state.json" => owned("application/json", self.status().into_bytes()),
            "/picture.jpg" => {
                let camera = self.camera(query).ok_or(Refusal::BadRequest)?;
                let picture = self.picture(camera)?.to_rgb8();
                let mut jpeg = vec![];
                let encoder = JpegEncoder::new_with_quality(&mut jpeg, QUALITY);
                picture.write_with_encoder(encoder).map_err(|_| Refusal::Busy)?;
                owned("image/jpeg", jpeg)
            }
            _ => Err(Refusal::NotFound),
        }
    }
}

/// The trainer's side of a board.
pub struct Host {
    board: Arc<Board>,
    /// No picture before then.
    rest: Instant,
}

impl Host {
    /// The trainer's side of this board.
    pub fn new(board: &Arc<Board>) -> Self {
        Self { board: board.clone(), rest: Instant::now() }
    }

    /// Notes a step.
    pub fn step(&self, progress: &Progress) {
        let mut state = self.board.lock();
        // A resumed run's first steps are not this session's.
        state.began.get_or_insert_with(|| (progress.step, Instant::now()));
        state.curve.push(progress.step, progress.loss);
        state.progress = progress.clone();
    }

    /// Notes an evaluation.
    pub fn evaluated(&self, progress: &Progress, report: &Report) {
        if let Some(mean) = report.mean.as_ref().map(|mean| &mean.metrics) {
            let masked = mean.mask.as_ref().map(|figures| figures.psnr);
            self.board.lock().figures.push((progress.step, mean.full.psnr, masked));
        }
    }

    /// Whether a camera waits and pictures have not had their share of the time.
    pub fn visited(&self) -> bool {
        self.board.asked.load(Ordering::Acquire) && Instant::now() >= self.rest
    }

    /// Renders the camera that waits, if one does.
    pub fn look(&mut self, draw: &mut dyn FnMut(&Camera) -> Result<Option<Rendered>, gpu::Error>) {
        self.board.asked.store(false, Ordering::Release);
        let camera = {
            let mut state = self.board.lock();
            let Slot::Asked(camera) = state.slot else { return };
            state.slot = Slot::Drawing;
            camera
        };
        let began = Instant::now();
        // A device that is lost is so for the next step, too, which says it.
        let picture = draw(&camera).unwrap_or_else(|error| {
            log::info!("a visitor's picture: {error}");
            None
        });
        let took = began.elapsed();
        self.rest = Instant::now() + took.mul_f64(1.0 / SHARE - 1.0);
        let mut state = self.board.lock();
        state.cost = took.as_secs_f64() / f64::from(camera.size[0] * camera.size[1]);
        state.slot = Slot::Drawn(picture);
        drop(state);
        self.board.turned.notify_all();
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        self.board.lock().ended = true;
        self.board.turned.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn board() -> Arc<Board> {
        let options = crate::scene::synthetic::Options {
            width: 40,
            height: 30,
            train_views: 4,
            test_views: 0,
            points: 200,
            ..Default::default()
        };
        let folder = tempfile::tempdir().unwrap();
        crate::scene::synthetic::write(&folder.path().join("scene"), &options).unwrap();
        let scene = crate::scene::load(&folder.path().join("scene"), &Default::default()).unwrap();
        Board::new("a scene", &scene, 100)
    }

    fn rendered(camera: &Camera) -> Rendered {
        let pixels = (camera.size[0] * camera.size[1]) as usize;
        Rendered {
            size: camera.size,
            rgb: vec![[0.5; 3]; pixels],
            depth: vec![1.0; pixels],
            transmittance: vec![0.0; pixels],
        }
    }

    const QUERY: &str = "c=0,0,0&r=1,0,0,0,1,0,0,0,1&f=1,1&s=32,24";

    #[test]
    fn cameras_are_read_and_nonsense_is_not() {
        let board = board();
        let camera = board.camera(QUERY).unwrap();
        assert_eq!((camera.size, camera.focal, camera.principal), ([32, 24], [32.0; 2], [16.0, 12.0]));
        for (from, to) in [
            ("c=0,0,0", "c=0,0"),
            ("c=0,0,0", "c=0,0,NaN"),
            ("c=0,0,0", "c=0,0,1e30"),
            ("c=0,0,0", "c=0,0,inf"),
            ("r=1,0,0", "r=2,0,0"),
            ("r=1,0,0", "r=-1,0,0"),
            ("r=1,0,0,0,1,0,0,0,1", "r=1,0,0,1,0,0,0,0,1"),
            ("f=1,1", "f=0,1"),
            ("f=1,1", "f=1"),
            ("s=32,24", "s=32,99999"),
            ("s=32,24", "s=0,24"),
            ("s=32,24", "s=-5,24"),
            ("&s=32,24", ""),
        ] {
            assert!(board.camera(&QUERY.replace(from, to)).is_none(), "{to}");
        }
        assert_eq!(board.get("/picture.jpg", "").unwrap_err(), Refusal::BadRequest);
        assert_eq!(board.get("/picture.png", QUERY).unwrap_err(), Refusal::NotFound);
    }

    #[test]
    fn visitors_take_turns_and_the_end_is_told() {
        let board = board();
        let mut host = Host::new(&board);
        assert!(!host.visited(), "nobody has come");
        let visitors: Vec<_> = (0..3)
            .map(|_| {
                let board = board.clone();
                std::thread::spawn(move || board.get("/picture.jpg", QUERY).map(|answer| answer.bytes.into_owned()))
            })
            .collect();
        let mut drawn = 0;
        while drawn < 2 {
            if host.visited() {
                host.look(&mut |camera| Ok(Some(rendered(camera))));
                drawn += 1;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        drop(host);
        let answers: Vec<_> = visitors.into_iter().map(|visitor| visitor.join().unwrap()).collect();
        let whole = |answer: &&Result<Vec<u8>, Refusal>| answer.as_ref().is_ok_and(|b| b.starts_with(&[0xff, 0xd8]));
        assert_eq!(answers.iter().filter(whole).count(), 2);
        assert!(answers.contains(&Err(Refusal::Gone)));
        assert_eq!(board.get("/picture.jpg", QUERY).unwrap_err(), Refusal::Gone);
    }

    /// A picture that took 20 ms is followed by 480 of training.
    #[test]
    fn pictures_take_their_share_and_no_more() {
        let board = board();
        let mut host = Host::new(&board);
        let visitor = {
            let board = board.clone();
            std::thread::spawn(move || (0..2).map(|_| board.get("/picture.jpg", QUERY).is_ok()).collect::<Vec<_>>())
        };
        let mut ends = vec![];
        while ends.len() < 2 {
            if host.visited() {
                host.look(&mut |camera| {
                    std::thread::sleep(Duration::from_millis(20));
                    Ok(Some(rendered(camera)))
                });
                ends.push(Instant::now());
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        let between = (ends[1] - ends[0]).as_secs_f64();
        assert!(between >= 0.02 / SHARE, "{between}");
        assert_eq!(visitor.join().unwrap(), [true, true]);
    }

    #[test]
    fn what_cannot_be_drawn_is_the_visitors_alone() {
        let board = board();
        let mut host = Host::new(&board);
        let visitor = {
            let board = board.clone();
            std::thread::spawn(move || board.get("/picture.jpg", QUERY).err())
        };
        while !host.visited() {
            std::thread::sleep(Duration::from_millis(1));
        }
        host.look(&mut |_| Ok(None));
        assert_eq!(visitor.join().unwrap(), Some(Refusal::Busy));
        assert!(!host.visited());
    }

    #[test]
    fn long_curves_stay_short_and_keep_their_mean() {
        let mut curve = Curve::default();
        for step in 1..=100_000 {
            curve.push(step, step as f32);
        }
        assert!(curve.points.len() <= POINTS + 1 && curve.points.len() > POINTS / 2);
        let (last, value) = curve.points[10];
        // The mean of the steps of this point.
        assert!((value - (last as f32 - (curve.each - 1) as f32 / 2.0)).abs() < 1.0, "{last} {value}");
    }
}
