//! A training under way in the browser: pictures that the trainer renders from where a visitor looks, the loss, the time
//! left.
//!
//! The training's thread and the server's meet at a [`Board`]. A visitor leaves a camera on it, one at a time; between two
//! steps the trainer looks at a flag, and where it is up it renders that camera and lays the picture down ([`Host`]).
//! Nothing is rendered unasked. A picture that took a while is followed by a pause so long that pictures take
//! [`SHARE`] of the time at most, however many visitors there are. JPEG is made of it by the visitor's thread, and all text
//! by visitors' threads, once for everybody: the trainer waits for no visitor.
//!
//! Rendering changes nothing of the model, and what fails is said to the visitor alone: the trained bytes are the same with
//! visitors and without.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use glam::DVec3;
use serde::Serialize;
use serde_json::json;

use super::server::{Answer, Body, Refusal, Site};
use crate::evaluate::Report;
use crate::gpu;
use crate::render::view::Rendered;
use crate::scene::{self, Camera, Scene, path};
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
/// The page's program.
const PROGRAM: &str = include_str!("live.js");
/// Visitors that wait for a picture; more are told to come again.
const MOST_WAITING: usize = 8;
/// How old what is said of the training may be: visitors that ask without pause get the same text.
const FRESH: Duration = Duration::from_millis(50);

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
    /// Counts the changes of what is said of the training.
    changes: u64,
    /// Visitors in [`Board::picture`].
    waiting: usize,
}

/// What was last said of the training.
struct Said {
    text: Arc<str>,
    made: Instant,
    /// [`State::changes`] then.
    changes: u64,
}

/// Where visitors and the trainer meet.
pub struct Board {
    iterations: u32,
    /// What the training cameras look at.
    focus: [f64; 3],
    /// The scene as a visitor gets it.
    scene: String,
    /// Centres farther away than this are refused.
    reach: f64,
    state: Mutex<State>,
    /// Never taken by the trainer, which would wait for JSON.
    said: Mutex<Option<Said>>,
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
        let poses: Vec<Pose> = scene.train.iter().map(pose).collect();
        let title: String = title.into();
        Arc::new(Self {
            iterations,
            focus,
            scene: json!({ "title": title, "up": up, "focus": focus, "cameras": poses }).to_string(),
            reach: 100.0 * far.fold(1.0, f64::max),
            state: Mutex::default(),
            said: Mutex::default(),
            turned: Condvar::new(),
            asked: AtomicBool::new(false),
        })
    }

    /// Steps that are done, and all of them.
    pub fn steps(&self) -> [u32; 2] {
        [self.lock().progress.step, self.iterations]
    }

    /// A thread that panicked has left nothing half done that matters here.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A picture from there, when the trainer has time.
    fn picture(&self, camera: Camera) -> Result<Rendered, Refusal> {
        self.picture_within(camera, PATIENCE)
    }

    fn picture_within(&self, camera: Camera, patience: Duration) -> Result<Rendered, Refusal> {
        let mut state = self.lock();
        if state.waiting >= MOST_WAITING {
            return Err(Refusal::Busy);
        }
        state.waiting += 1;
        let (mut state, picture) = self.picture_in_turn(state, camera, patience);
        state.waiting -= 1;
        picture
    }

    fn picture_in_turn<'a>(
        &'a self,
        mut state: MutexGuard<'a, State>,
        camera: Camera,
        patience: Duration,
    ) -> (MutexGuard<'a, State>, Result<Rendered, Refusal>) {
        let deadline = Instant::now() + patience;
        let left = || deadline.saturating_duration_since(Instant::now());
        let wait = |state| self.turned.wait_timeout(state, left()).unwrap_or_else(PoisonError::into_inner).0;
        while !matches!(state.slot, Slot::Free) {
            if left().is_zero() {
                return (state, Err(Refusal::Busy));
            }
            state = wait(state);
        }
        if state.ended {
            return (state, Err(Refusal::Gone));
        }
        state.slot = Slot::Asked(camera);
        self.asked.store(true, Ordering::Release);
        loop {
            match std::mem::take(&mut state.slot) {
                Slot::Drawn(picture) => {
                    self.turned.notify_all();
                    return (state, picture.ok_or(Refusal::Busy));
                }
                Slot::Asked(_) if state.ended || left().is_zero() => {
                    self.asked.store(false, Ordering::Release);
                    self.turned.notify_all();
                    let refusal = if state.ended { Refusal::Gone } else { Refusal::Busy };
                    return (state, Err(refusal));
                }
                Slot::Asked(camera) => {
                    state.slot = Slot::Asked(camera);
                    state = wait(state);
                }
                // What is being drawn comes, however long it takes ([`Drawing`]).
                other => {
                    state.slot = other;
                    state = self.turned.wait(state).unwrap_or_else(PoisonError::into_inner);
                }
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

    /// What is known of the training, as JSON.
    fn status(&self) -> Arc<str> {
        // Whoever asks meanwhile waits for the same text.
        let mut said = self.said.lock().unwrap_or_else(PoisonError::into_inner);
        let state = self.lock();
        if let Some(said) = &*said
            && (said.changes == state.changes || said.made.elapsed() < FRESH && !state.ended)
        {
            return said.text.clone();
        }
        let State { ended, cost, began, changes, .. } = *state;
        let (progress, curve, figures) = (state.progress.clone(), state.curve.points.clone(), state.figures.clone());
        drop(state);
        let Progress { step, seconds, view, loss, losses, anchors, gaussians, .. } = progress;
        let left = began.filter(|(first, _)| step > *first).map(|(first, began)| {
            began.elapsed().as_secs_f64() / f64::from(step - first) * f64::from(self.iterations.saturating_sub(step))
        });
        let losses: BTreeMap<&str, f32> = losses.into_iter().filter(|(_, value)| *value != 0.0).collect();
        let text = json!({
            "step": step, "iterations": self.iterations, "seconds": seconds, "left": left, "view": view, "loss": loss,
            "losses": losses, "anchors": anchors, "gaussians": gaussians, "curve": curve,
            "figures": figures, "cost": cost, "ended": ended,
        });
        let text: Arc<str> = text.to_string().into();
        *said = Some(Said { text: text.clone(), made: Instant::now(), changes });
        text
    }
}

/// So many finite numbers between commas.
fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let all: Option<Vec<f64>> = text.split(',').map(|word| word.parse().ok().filter(|v: &f64| v.is_finite())).collect();
    all?.try_into().ok()
}

impl Site for Board {
    fn get(&self, path: &str, query: &str) -> Result<Answer<'_>, Refusal> {
        fn borrowed<'a>(kind: &'static str, text: &'a str) -> Result<Answer<'a>, Refusal> {
            Ok(Answer { kind, gzip: false, bytes: Body::Borrowed(text.as_bytes()) })
        }
        let owned = |kind, bytes: Vec<u8>| Ok(Answer { kind, gzip: false, bytes: Body::Owned(bytes) });
        match path {
            "/" => borrowed("text/html; charset=utf-8", PAGE),
            "/live.js" => borrowed("text/javascript", PROGRAM),
            "/scene.json" => borrowed("application/json", &self.scene),
            "/state.json" => owned("application/json", self.status().as_bytes().to_vec()),
            "/picture.jpg" => {
                let camera = self.camera(query).ok_or(Refusal::BadRequest)?;
                let picture = self.picture(camera)?.to_rgb8();
                owned("image/jpeg", scene::jpeg(&picture, QUALITY).map_err(|_| Refusal::Busy)?)
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
        state.progress.clone_from(progress);
        state.changes += 1;
    }

    /// Notes an evaluation.
    pub fn evaluated(&self, progress: &Progress, report: &Report) {
        if let Some(mean) = report.mean.as_ref().map(|mean| &mean.metrics) {
            let masked = mean.mask.as_ref().map(|figures| figures.psnr);
            let mut state = self.board.lock();
            state.figures.push((progress.step, mean.full.psnr, masked));
            state.changes += 1;
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
        let mut drawing = Drawing { board: &self.board, picture: None };
        let began = Instant::now();
        // A device that is lost is so for the next step, too, which says it.
        drawing.picture = draw(&camera).unwrap_or_else(|error| {
            log::info!("a visitor's picture: {error}");
            None
        });
        let took = began.elapsed();
        self.rest = Instant::now() + took.mul_f64(1.0 / SHARE - 1.0);
        let mut state = self.board.lock();
        state.cost = took.as_secs_f64() / f64::from(camera.size[0] * camera.size[1]);
        state.changes += 1;
    }
}

/// A picture that is being drawn. Its visitor gets it when this is gone, or nothing where drawing has panicked.
struct Drawing<'a> {
    board: &'a Board,
    picture: Option<Rendered>,
}

impl Drop for Drawing<'_> {
    fn drop(&mut self) {
        self.board.lock().slot = Slot::Drawn(self.picture.take());
        self.board.turned.notify_all();
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        let mut state = self.board.lock();
        state.ended = true;
        state.changes += 1;
        drop(state);
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
                std::thread::spawn(move || {
                    let answer = board.get("/picture.jpg", QUERY)?;
                    let Body::Owned(jpeg) = answer.bytes else { panic!("a picture is made for its visitor") };
                    Ok(jpeg)
                })
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

    /// A device may panic, as everything may.
    #[test]
    fn a_visitor_of_what_panics_is_told_to_come_again() {
        let board = board();
        let mut host = Host::new(&board);
        let visitor = {
            let board = board.clone();
            std::thread::spawn(move || board.get("/picture.jpg", QUERY).err())
        };
        while !host.visited() {
            std::thread::sleep(Duration::from_millis(1));
        }
        let panicked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| host.look(&mut |_| panic!("a fault"))));
        assert!(panicked.is_err());
        assert_eq!(visitor.join().unwrap(), Some(Refusal::Busy));
        drop(host);
        assert_eq!(board.get("/picture.jpg", QUERY).unwrap_err(), Refusal::Gone);
    }

    /// Of the processor of this thread: waiting costs none.
    #[cfg(target_os = "linux")]
    fn ticks(thread: &str) -> u64 {
        let stat = std::fs::read_to_string(format!("/proc/self/task/{thread}/stat")).unwrap();
        let fields: Vec<&str> = stat.rsplit_once(") ").unwrap().1.split(' ').collect();
        fields[11..13].iter().map(|field| field.parse::<u64>().unwrap()).sum()
    }

    /// Also behind the visitor's own deadline, which is brought forward here.
    #[cfg(target_os = "linux")]
    #[test]
    fn a_visitor_of_a_slow_picture_sleeps() {
        let board = board();
        let mut host = Host::new(&board);
        let (send, thread) = std::sync::mpsc::channel();
        let visitor = {
            let board = board.clone();
            std::thread::spawn(move || {
                let link = std::fs::read_link("/proc/thread-self").unwrap();
                send.send(link.file_name().unwrap().to_string_lossy().into_owned()).unwrap();
                let camera = board.camera(QUERY).unwrap();
                board.picture_within(camera, Duration::from_secs(2)).is_ok()
            })
        };
        let thread = thread.recv().unwrap();
        while !host.visited() {
            std::thread::sleep(Duration::from_millis(1));
        }
        host.look(&mut |camera| {
            std::thread::sleep(Duration::from_millis(2200));
            let before = ticks(&thread);
            std::thread::sleep(Duration::from_millis(1000));
            // A tick is 10 ms: a thread that spins has some hundred.
            assert!(ticks(&thread) - before < 20, "the visitor spins");
            Ok(Some(rendered(camera)))
        });
        assert!(visitor.join().unwrap(), "what is being drawn is worth waiting for");
    }

    #[test]
    fn visitors_that_nobody_draws_for_are_told_to_come_again() {
        let board = board();
        let _host = Host::new(&board);
        let camera = board.camera(QUERY).unwrap();
        let began = Instant::now();
        let ask = || board.picture_within(camera, Duration::from_millis(200)).err();
        std::thread::scope(|scope| {
            let visitors: Vec<_> = (0..3).map(|_| scope.spawn(ask)).collect();
            for visitor in visitors {
                assert_eq!(visitor.join().unwrap(), Some(Refusal::Busy));
            }
        });
        assert!(began.elapsed() < PATIENCE, "{:?}", began.elapsed());
        // More than may wait are not let in at all.
        board.lock().waiting = MOST_WAITING;
        assert_eq!(board.picture_within(camera, PATIENCE).err(), Some(Refusal::Busy));
        assert!(began.elapsed() < PATIENCE, "{:?}", began.elapsed());
    }

    #[test]
    fn the_text_of_a_step_is_made_once() {
        let board = board();
        let host = Host::new(&board);
        let step = |step| host.step(&Progress { step, loss: 1.0, ..Progress::default() });
        let said = || board.status();
        step(1);
        let first = said();
        assert!(first.contains("\"step\":1,"), "{first}");
        std::thread::sleep(2 * FRESH);
        assert!(Arc::ptr_eq(&first, &said()), "nothing has changed");
        step(2);
        let second = said();
        assert!(second.contains("\"step\":2,"), "{second}");
        // Steps that follow quickly share a text.
        step(3);
        let third = said();
        assert!(Arc::ptr_eq(&second, &third) || third.contains("\"step\":3,"), "{third}");
        drop(host);
        assert!(said().contains("\"ended\":true"), "the end is said at once");
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
