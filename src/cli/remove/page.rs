//! The page's side of `remove`: the fit as soon as the page is open, masks carried to all views whenever one has changed, and
//! the work when the user presses the button.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use image::GrayImage;

use super::work::{Audience, Job, Places};
use super::{open_browser, signals};
use crate::cli::export::{Cameras, FIGURES};
use crate::cli::folders::Origin;
use crate::cli::train::{self, Stop};
use crate::cli::{shared, view};
use crate::evaluate::hole;
use crate::gpu::Gpu;
use crate::model::stored::Stored;
use crate::prepare::depth::DepthMap;
use crate::prepare::fit::Fit;
use crate::prepare::hole::repaint;
use crate::prepare::masks::{self, Shares, Votes};
use crate::prepare::poses::Capture;
use crate::prepare::splats::Splats;
use crate::prepare::{self, Fitted, Request, Silent, Step};
use crate::remove::repaint::Repainting;
use crate::remove::{After, Masked, Results, Session, Wish, objects};
use crate::render::view::Renderer;
use crate::scene::doctor::{Finding, Report, Severity};
use crate::scene::{self, Scene};
use crate::view::live::Board;
use crate::view::server::{self, Secret};

/// How long the worker waits before it looks whether a signal has come.
const PATIENCE: Duration = Duration::from_millis(200);

/// JPEG's, of views without the object.
const QUALITY: u8 = 92;

/// The session as the work's audience.
struct Visitors<'a>(&'a Session);

impl Audience for Visitors<'_> {
    fn begin(&self, part: &str, units: u64) {
        self.0.begin(part, units);
    }
    fn at(&self, units: u64) {
        self.0.at(units);
    }
    fn board(&self, board: &Arc<Board>) {
        self.0.show(board.clone());
    }
    fn examined(&self, report: &Report) {
        let problems = report.findings.iter().filter(|finding| finding.severity == Severity::Problem);
        self.0.found(problems.map(Finding::text).collect());
    }
    fn stop(&self) -> Stop {
        self.0.stopping()
    }
    fn looks(&self) -> bool {
        true
    }
}

pub fn run(job: &Job<'_>, capture: &Capture) -> anyhow::Result<()> {
    let given = delivered(capture)?;
    let name = job.args.photographs.canonicalize().unwrap_or_else(|_| job.args.photographs.clone());
    let title = name.file_name().map_or_else(|| "photographs".into(), |name| name.to_string_lossy());
    let session = Session::open(&title, &capture.photographs, &job.places.objects, &given)?;
    let address = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), job.args.port);
    job.args.device.with_gpu(|gpu| {
        let listener = view::bind(address, "--port 0")?;
        let secret = Secret::random();
        let url = secret.url(listener.local_addr().unwrap_or(address));
        println!("{url} (Ctrl-C ends it; the same command goes on)");
        let site = session.clone();
        std::thread::spawn(move || server::serve(&listener, &site, &secret));
        if !job.args.no_open
            && let Err(error) = open_browser(&url)
        {
            log::info!("no browser was opened: {error:#}");
        }
        signals::listen()?;
        attend(job, gpu, &session, capture)
    })
}

/// Masks that came with the photographs.
fn delivered(capture: &Capture) -> Result<BTreeMap<String, GrayImage>, scene::Error> {
    let mut all = BTreeMap::new();
    for (name, (path, inverted)) in &capture.masks {
        let Some(photograph) = capture.photographs.get(name) else { continue };
        let mut mask = scene::mask(path, 1)?;
        if *inverted {
            mask.iter_mut().for_each(|v| *v = 255 - *v);
        }
        if scene::dimensions(photograph)? == [mask.width(), mask.height()] {
            all.insert(name.clone(), mask);
        }
    }
    Ok(all)
}

fn check(job: &Job<'_>) -> Result<(), signals::Stopped> {
    signals::check(|| format!("what was marked lies in {}, and the same command goes on", job.places.objects.display()))
}

/// Does what the page asks for, until a signal ends it.
fn attend(job: &Job<'_>, gpu: &Gpu, session: &Arc<Session>, capture: &Capture) -> anyhow::Result<()> {
    let mut carrier = loop {
        match Carrier::new(job, gpu, session) {
            Ok(carrier) => break carrier,
            Err(error) => {
                check(job)?;
                // The page says it, too; without cameras there is nothing to do but to look into it.
                eprintln!("{}", crate::cli::message(&error));
                session.fail(format!("{error:#}"));
                loop {
                    check(job)?;
                    if let Wish::Remove(_) = session.wish(PATIENCE) {
                        break;
                    }
                }
            }
        }
    };
    let mut trained = None;
    loop {
        check(job)?;
        match session.wish(PATIENCE) {
            Wish::Nothing => {}
            Wish::Draw(number) => {
                let drawn = draw(job, gpu, session, number, &mut trained);
                if let Err(error) = &drawn {
                    eprintln!("{}: {error:#}", session.photos()[number].name);
                }
                session.drew(number, drawn.ok());
            }
            Wish::Repaint(what) => {
                let refused = repaint(job, gpu, session, what).err().map(|error| format!("{error:#}"));
                refused.iter().for_each(|why| eprintln!("repaint: {why}"));
                session.repainted(refused);
            }
            Wish::Carry(revision, given) => carrier.carry(session, revision, &given)?,
            Wish::Remove(despite) => {
                trained = None;
                let result = remove(job, gpu, session, capture, despite);
                check(job)?;
                if let Err(error) = result {
                    if train::ends(&session.stopping()).is_some() {
                        eprintln!("stopped on the page; it can be gone on with there");
                        session.stopped();
                    } else if !despite && session.has_problems() {
                        // The page lists them, and asks.
                        eprintln!("{}", crate::cli::message(&error));
                        session.stopped();
                    } else {
                        eprintln!("{}", crate::cli::message(&error));
                        session.fail(format!("{error:#}"));
                    }
                }
            }
        }
    }
}

fn remove(job: &Job<'_>, gpu: &Gpu, session: &Session, capture: &Capture, despite: bool) -> anyhow::Result<()> {
    let began = Instant::now();
    session.begin("masks", 0);
    let objects = objects::wanted(&job.places.objects, capture.photographs.iter())?;
    let names = job.names(&objects);
    job.work(gpu, objects, despite, &Visitors(session), began)?;
    session.begin("page", 0);
    let page = view::page_of(&job.places.root).context("the object is gone, but it cannot be shown")?;
    let Places { scene, .. } = &job.places;
    let before = before(job, session)?;
    let has_hole = |number: &usize| repaint::has_hole(scene, &session.photos()[*number].name);
    let filled = before.keys().copied().filter(has_hole).collect();
    session.done(Results::new(page.resources(), job.places.files(), before).filled(scene.clone(), filled));
    job.say(&names);
    Ok(())
}

/// Repaints a part of the scene's holes, or takes the last one back.
fn repaint(job: &Job<'_>, gpu: &Gpu, session: &Session, what: Repainting) -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let repaint = match what {
        Repainting::Undo => repaint::Wish::Undo,
        Repainting::Paint(number, mask, offset) => {
            let (view, brush) = (session.photos()[number].name.clone(), folder.path().join("brush.png"));
            mask.save(&brush)?;
            repaint::Wish::Another(repaint::Repaint { view, brush, offset })
        }
    };
    let request = Request { only: vec![Step::Repaint], repaint, ..job.request(vec![]) };
    Ok(prepare::prepare(gpu, &request, &mut Silent)?)
}

/// The scene's photographs of the views that the trained model can be drawn at; none where nothing was trained.
fn before(job: &Job<'_>, session: &Session) -> anyhow::Result<BTreeMap<usize, PathBuf>> {
    let Places { root, scene, run, .. } = &job.places;
    if Origin::find(run).is_err() {
        return Ok(BTreeMap::new());
    }
    let figures = std::fs::read(root.join(FIGURES)).context(FIGURES)?;
    let cameras: Cameras = serde_json::from_slice(&figures).context(FIGURES)?;
    let files = scene::train_files(scene)?;
    let view = |name: &str| Some((session.number(name)?, files.get(name)?.clone()));
    Ok(cameras.cameras.iter().filter_map(|pose| view(&pose.name)).collect())
}

/// The trained model on the device, and its scene.
type Trained = (Renderer, Scene);

/// A view without the object.
fn draw(
    job: &Job<'_>,
    gpu: &Gpu,
    session: &Session,
    number: usize,
    trained: &mut Option<Trained>,
) -> anyhow::Result<After> {
    let (renderer, scene) = match trained {
        Some(trained) => trained,
        None => {
            let origin = Origin::find(&job.places.run)?;
            let mut settings = origin.settings(vec![])?;
            let scene = shared::load_scene_of_model(&job.places.scene, &mut settings)?;
            let renderer = Renderer::of(gpu, &Stored::load(&origin.model())?, &settings.render)?;
            trained.insert((renderer, scene))
        }
    };
    let name = &session.photos()[number].name;
    let at = scene.train.iter().position(|view| view.name == *name).context("the scene has no such view any more")?;
    let view = &scene.train[at];
    let picture = renderer.render(&view.camera)?.to_rgb8();
    let residue = match (&view.mask, scene.references.iter().find(|reference| reference.view == at)) {
        (Some(mask), Some(filled)) => {
            let background: Vec<_> = filled.image.pixels().map(|p| Some(p.0.map(|v| f64::from(v) / 255.0))).collect();
            hole::residue(&picture, &view.image, &background, mask)
        }
        _ => None,
    };
    Ok(After { jpeg: scene::jpeg(&picture, QUALITY)?, residue })
}

/// The votes of an object's masks.
#[derive(Default)]
struct Ballot {
    /// By photograph: those of its mask, and the mask's version.
    votes: BTreeMap<usize, (u64, Votes)>,
    /// Whether they were carried to all views.
    carried: bool,
}

/// Carries masks to all views, by the fit.
struct Carrier {
    scene: Scene,
    fit: Fit,
    splats: Splats,
    colors: Vec<[f32; 3]>,
    /// Numbers of the scene's views among the photographs.
    numbers: Vec<Option<usize>>,
    /// By object: the photographs' votes.
    votes: BTreeMap<usize, Ballot>,
}

impl Carrier {
    fn new(job: &Job<'_>, gpu: &Gpu, session: &Session) -> anyhow::Result<Self> {
        session.begin("poses", 0);
        let Fitted { scene, fit, grids } = job.fitted(gpu, &Visitors(session))?;
        let mut splats = Splats::new(gpu, &fit.model, &fit.settings.render)?;
        session.begin("shape", scene.train.len() as u64);
        let colors = masks::colors(&mut splats, &scene.train)?;
        let numbers: Vec<Option<usize>> = scene.train.iter().map(|view| session.number(&view.name)).collect();
        for (i, ((view, grid), number)) in scene.train.iter().zip(&grids).zip(&numbers).enumerate() {
            check(job)?;
            if let Some(number) = number {
                let depths = [DepthMap::of(&mut splats, &view.camera)?, DepthMap::confirmed(grid, &view.camera)];
                session.knows(*number, depths);
            }
            session.at(i as u64 + 1);
        }
        session.again();
        session.ready();
        session.end();
        Ok(Self { scene, fit, splats, colors, numbers, votes: BTreeMap::new() })
    }

    /// Until they change or something else is to be done, object by object: those whose masks have changed.
    fn carry(&mut self, session: &Session, revision: u64, given: &BTreeMap<usize, Vec<Masked>>) -> anyhow::Result<()> {
        self.votes.retain(|object, _| given.contains_key(object));
        for (object, given) in given {
            self.count(*object, given)?;
        }
        let stale: Vec<usize> = self.votes.iter().filter(|(_, own)| !own.carried).map(|(object, _)| *object).collect();
        session.begin("carry", (stale.len() * self.scene.train.len()) as u64);
        for (turn, object) in stale.iter().enumerate() {
            if !self.carry_one(session, revision, *object, turn * self.scene.train.len())? {
                session.end();
                return Ok(());
            }
        }
        session.carried(revision);
        session.end();
        Ok(())
    }

    /// The votes of an object's masks, those that are there already excepted.
    fn count(&mut self, object: usize, given: &[Masked]) -> anyhow::Result<()> {
        let own = self.votes.entry(object).or_default();
        let before = own.votes.len();
        own.votes.retain(|of, (version, _)| given.iter().any(|(number, v, _)| number == of && v == version));
        own.carried &= own.votes.len() == before;
        for (number, version, mask) in given {
            let view = self.numbers.iter().position(|own| *own == Some(*number)).map(|i| &self.scene.train[i]);
            let Some(view) = view.filter(|_| !own.votes.contains_key(number)) else { continue };
            let mut votes = Votes::new(&self.splats);
            votes.add(&mut self.splats, &view.camera, &masks::parts(mask, view.camera.size))?;
            own.votes.insert(*number, (*version, votes));
            own.carried = false;
        }
        Ok(())
    }

    /// Carries an object to all views; whether it came to the end.
    fn carry_one(&mut self, session: &Session, revision: u64, object: usize, done: usize) -> anyhow::Result<bool> {
        let Some(own) = self.votes.get_mut(&object).filter(|own| !own.votes.is_empty()) else { return Ok(true) };
        let count = |without: Option<usize>| {
            let mut sum = Votes::new(&self.splats);
            let others = own.votes.iter().filter(|(number, _)| Some(**number) != without);
            others.for_each(|(_, (_, votes))| sum.join(votes));
            sum.count(self.fit.positions(), &self.colors)
        };
        let all = count(None);
        // What is marked in a view is no evidence of what others say of it.
        let others: BTreeMap<usize, Shares> = match own.votes.len() {
            1 => BTreeMap::new(),
            _ => own.votes.keys().map(|number| (*number, count(Some(*number)))).collect(),
        };
        for (i, number) in self.numbers.iter().enumerate() {
            let Some(number) = number else { continue };
            if session.is_stale(revision) || signals::caught().is_some() {
                return Ok(false);
            }
            let camera = self.scene.train[i].camera;
            let of_others = others.get(number);
            if of_others.is_some() || !own.votes.contains_key(number) {
                let carried = of_others.unwrap_or(&all).carry(&mut self.splats, &camera)?;
                if !session.carry(revision, object, *number, carried, camera.size) {
                    return Ok(false);
                }
            }
            session.at((done + i + 1) as u64);
        }
        own.carried = true;
        Ok(true)
    }
}
