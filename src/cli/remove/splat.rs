//! A splat in place of photographs: its own pictures are the photographs, it is the fit itself, and of its file only the
//! object's Gaussians go and the hole's come.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context as _, bail};
use serde::Serialize;

use super::Args;
use super::work::{Audience, Job, Places, Source};
use crate::cli::export::{Cameras, FIGURES, STEM};
use crate::cli::folders::MODEL;
use crate::config::{Settings, SettingsArgs};
use crate::export;
use crate::formats::{gltf, ply, spz};
use crate::gpu::Gpu;
use crate::model::gaussians::{Cloud, sigmoid};
use crate::model::stored::Stored;
use crate::prepare::fit::{Fit, Ready};
use crate::prepare::record::{self, Inputs};
use crate::scene::Camera;
use crate::splat::cameras::{self, Posed};
use crate::splat::frame::Place;
use crate::splat::read::{self, Container, Splat, append};
use crate::splat::views::{self, Seen};
use crate::splat::{Error, chosen, fill};

/// The pictures' folder within what is made.
const VIEWS: &str = "views";
/// What the training of the fill begins with.
const START: &str = "start.ply";
/// The Gaussians that were taken out.
const OBJECT: &str = "object.ply";
/// Which they were.
const CHANGES: &str = "changes.json";
/// Steps of the fill's training unless asked for otherwise.
const STEPS: u32 = 600;
/// Share of them that look at the reference, which was chosen because most of its hole is seen.
const REFERENCE_SHARE: f64 = 0.5;
/// Longer side of the pictures that the hole is begun at, pixels.
const SIDE: u32 = 256;
/// Gaussians of the fill that are fainter than this at the end are left out.
const FAINT: f64 = 0.02;

/// The contents of `changes.json`: rows by number, as first and one past the last.
#[derive(Serialize)]
struct Changes {
    note: &'static str,
    before: usize,
    kept: usize,
    removed: usize,
    added: usize,
    /// Rows of the file that was given.
    removed_ranges: Vec<[usize; 2]>,
    /// Rows of the file that was made.
    added_range: [usize; 2],
}

const NOTE: &str = "removed_ranges: rows of the splat that was given, added_range: rows of the one that was made; all others \
                    are the same bytes in the same order";

/// Reads the splat, and draws its pictures unless they are there.
pub fn open(args: &Args, places: &Places) -> anyhow::Result<Source> {
    let path = &args.photographs;
    let made = ["ply", "spz", "glb"].map(|extension| format!("{STEM}.{extension}")).into_iter().chain([OBJECT.into()]);
    let source = path.canonicalize().ok();
    if source.is_some() && made.into_iter().any(|name| places.root.join(name).canonicalize().ok() == source) {
        bail!("{}: what is made would be written over it: choose another --out", path.display());
    }
    let splat = read::read(path)?;
    let folder = places.root.join(VIEWS);
    let hash = record::hash(path)?;
    let (posed, made_of) = match args.cameras.clone().or_else(|| cameras::beside(path)) {
        Some(from) => {
            let posed = given(args, &splat, &from)?;
            let made_of: String = Inputs::default().with(hash).with(format!("{posed:?}")).finish();
            (posed, made_of)
        }
        None => {
            let made_of: String = Inputs::default().with(hash).with(format!("chosen: {}", args.views)).finish();
            let kept =
                if views::are_of(&folder, &made_of) { cameras::read(&folder.join("sparse/0")).ok() } else { None };
            let posed = match kept {
                Some(posed) => posed,
                None => chosen(args, &splat)?,
            };
            eprintln!(
                "splat: no cameras are beside it; {} views were chosen from where it looks right (--cameras names others)",
                posed.len()
            );
            (posed, made_of)
        }
    };
    let all: Vec<Camera> = posed.iter().map(|posed| posed.camera).collect();
    let render = views::config(views::depth(&splat, &all)?);
    let seen = Seen::by(&splat, &all, render.near);
    eprintln!(
        "splat: {} Gaussians of degree {}, of which {} views see {}",
        splat.len(),
        splat.cloud.degree,
        posed.len(),
        seen.cloud.len()
    );
    args.device.with_gpu(|gpu| {
        super::signals::listen()?;
        views::fits(gpu, seen.cloud.len())?;
        let bar = indicatif::ProgressBar::new(posed.len() as u64).with_prefix("views");
        views::write(gpu, &splat, &posed, &folder, &made_of, &mut |done| {
            bar.set_position(done);
            go_on()
        })?;
        bar.finish_and_clear();
        Ok(())
    })?;
    let settings = Settings { render, ..Settings::default() };
    let model = Stored::Gaussians(seen.plain().cloud);
    let ready = Arc::new(Ready { fit: Fit { model, settings }, made_of });
    Ok(Source { splat, seen, ready, views: folder })
}

/// The cameras of a file or a model, in the splat's frame.
fn given(args: &Args, splat: &Splat, from: &Path) -> anyhow::Result<Vec<Posed>> {
    let mut posed = cameras::read(from)?;
    match views::align(splat, from, &mut posed) {
        Place::Own => {}
        Place::Elsewhere(_) => {
            eprintln!("splat: it was moved, scaled or turned against {}, and its cameras are, too", from.display());
        }
        Place::Unknown => eprintln!(
            "splat: the points of {} are not where the splat is: what is drawn from its cameras may show nothing that was photographed",
            from.display()
        ),
    }
    Ok(some(posed, args))
}

/// Cameras for a splat that comes with none.
fn chosen(args: &Args, splat: &Splat) -> anyhow::Result<Vec<Posed>> {
    args.device.with_gpu(|gpu| {
        super::signals::listen()?;
        let bar = indicatif::ProgressBar::new_spinner().with_prefix("cameras");
        let posed = chosen::cameras(gpu, splat, args.views as usize, &mut |done| {
            bar.set_position(done);
            go_on()
        })?;
        bar.finish_and_clear();
        Ok(posed)
    })
}

/// An error once the program is to end.
fn go_on() -> Result<(), Error> {
    match crate::cli::train::ends(&Default::default()) {
        Some(signal) => Err(crate::prepare::Error::Interrupted { signal }.into()),
        None => Ok(()),
    }
}

/// Cameras enough, evenly spread, and those that the user names.
fn some(all: Vec<Posed>, args: &Args) -> Vec<Posed> {
    let named: Vec<&String> = args.object.views().chain(&args.reference).collect();
    let is_named = |posed: &Posed| named.iter().any(|name| crate::scene::stem(name) == posed.name);
    let most = args.views as usize;
    let count = all.len();
    let taken = |i: usize| count <= most || (i * most) / count != ((i + 1) * most) / count;
    all.into_iter().enumerate().filter(|(i, posed)| taken(*i) || is_named(posed)).map(|(_, posed)| posed).collect()
}

impl Job<'_> {
    /// The last part: the object's Gaussians out, the fill trained and put in, the files written.
    pub(super) fn splice(&self, gpu: &Gpu, source: &Source, audience: &dyn Audience) -> anyhow::Result<()> {
        let Places { root, scene: folder, run, .. } = &self.places;
        let scene = fill::load(folder, SIDE)?;
        let fit = &source.ready.fit;
        let go_on = || match crate::cli::train::ends(&audience.stop()) {
            Some(signal) => Err(Error::from(crate::prepare::Error::Interrupted { signal })),
            None => Ok(()),
        };
        audience.begin("object", scene.train.len() as u64);
        let mut done = 0;
        let object = fill::object(gpu, &scene, fit, &mut || {
            done += 1;
            audience.at(done);
            go_on()
        })?;
        let gone = fill::in_file(&source.seen, &object, source.splat.len());
        let removed = gone.iter().filter(|gone| **gone).count();
        if removed == 0 {
            bail!("no Gaussian of the splat is the object by these masks; do they show it where the splat has it?");
        }
        let stays: Vec<bool> = object.iter().map(|object| !object).collect();
        let mut rest = source.seen.cloud.clone();
        rest.retain(&stays);
        let begun = fill::begin(gpu, &scene, folder, &rest, fit)?;
        eprintln!("splat: {removed} Gaussians are the object; {} begin in the hole", begun.len());
        let added = if begun.is_empty() { Cloud::default() } else { self.filled(gpu, rest, &begun, audience)? };
        let kept: Vec<bool> = gone.iter().map(|gone| !gone).collect();
        let count = source.splat.len() - removed;
        let changes = Changes {
            note: NOTE,
            before: source.splat.len(),
            kept: count,
            removed,
            added: added.len(),
            removed_ranges: fill::ranges(&gone),
            added_range: [count, count + added.len()],
        };
        let joined = source.splat.joined(&kept, &added);
        let cameras = Cameras::of(&scene);
        let mut files = vec![
            (root.join(format!("{STEM}.ply")), source.splat.spliced(&kept, &added)),
            (root.join(OBJECT), source.splat.spliced(&gone, &Cloud::default())),
            (root.join(CHANGES), serde_json::to_vec_pretty(&changes)?),
            (root.join(FIGURES), serde_json::to_vec_pretty(&cameras)?),
            (root.join(format!("{STEM}.glb")), gltf::encode(&joined).map_err(export::Error::Format)?),
        ];
        match spz::encode(&joined, spz::Version::default()) {
            Ok(bytes) => files.push((root.join(format!("{STEM}.spz")), bytes)),
            Err(error) => eprintln!("splat: {STEM}.spz is left out: {error}"),
        }
        let named: Vec<(PathBuf, &[u8])> = files.iter().map(|(path, bytes)| (path.clone(), bytes.as_slice())).collect();
        export::write(&named)?;
        if source.splat.container != Container::Ply {
            eprintln!("splat: {STEM}.ply has a row per Gaussian with its numbers as they were read");
        }
        println!("kept {count} Gaussians as they were, removed {removed}, added {}; {}", added.len(), run.display());
        Ok(())
    }

    /// Trains Gaussians in the hole with all others as they are; returns them.
    fn filled(&self, gpu: &Gpu, rest: Cloud, begun: &Cloud, audience: &dyn Audience) -> anyhow::Result<Cloud> {
        let Places { root, run, .. } = &self.places;
        let frozen = rest.len();
        // As many coefficients as one array of the device holds of all of them.
        let fits = |degree: &u32| frozen + begun.len() <= crate::model::gaussians::Static::most(gpu, *degree) as usize;
        let degree = (0..=rest.degree).rev().find(fits).unwrap_or(0);
        if degree < rest.degree {
            eprintln!(
                "splat: {frozen} Gaussians are too many for one array of the device: trained with degree {degree}"
            );
        }
        let mut start = rest;
        append(&mut start, begun);
        let path = std::path::absolute(root.join(START)).context("no current folder")?;
        export::write(&[(path.clone(), &ply::encode(&start))])?;
        drop(start);
        let mut settings: SettingsArgs = self.args.settings.clone();
        let own = [
            format!("train.iterations={STEPS}"),
            format!("train.reference_share={REFERENCE_SHARE}"),
            "densify.enabled=false".to_owned(),
            "scene.dense=false".to_owned(),
            // Drawn pictures have one exposure: what differs is the splat's own.
            "scene.even_exposures=false".to_owned(),
            "model.form=gaussians".to_owned(),
            "model.attention.enabled=false".to_owned(),
            format!("model.degree={degree}"),
            format!("model.from={}", toml::Value::String(path.to_string_lossy().into_owned())),
            format!("model.frozen={frozen}"),
        ];
        settings.set.splice(0..0, own);
        self.train(gpu, audience, &settings)?;
        let Stored::Gaussians(cloud) = Stored::load(&run.join(MODEL))? else {
            bail!("{}: holds no plain Gaussians; were settings of the form changed?", run.display());
        };
        let mut cloud = cloud;
        let keep: Vec<bool> = (0..cloud.len()).map(|i| i >= frozen && sigmoid(cloud.logit[i]) >= FAINT).collect();
        cloud.retain(&keep);
        Ok(cloud)
    }
}
