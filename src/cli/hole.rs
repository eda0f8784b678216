//! `gscream-vk bench --hole`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context as _, ensure};

use super::folders::{MODEL, Record, last_part};
use super::prepare::Bars;
use super::shared::{DeviceArgs, SceneArgs};
use super::train::{self, Manner, go_on_without, is_begun};
use super::{next, pictures, preset, signals};
use crate::atomic;
use crate::config::{Settings, SettingsArgs};
use crate::evaluate::Judge;
use crate::folder::{self, Lock};
use crate::gpu::Gpu;
use crate::lab::ablation::Figure;
use crate::lab::hole::judge::{Trained, judge};
use crate::lab::hole::record::{Known, RUNS, Row, TABLE};
use crate::lab::hole::truth::{self, Truth};
use crate::lab::hole::{self, SCENE};
use crate::lab::pace::Pace;
use crate::train::checkpoint;
use crate::work::{Loaded, Ready};

/// How holes are judged.
#[derive(Debug, Clone, Default, clap::Args)]
#[command(next_help_heading = "Holes")]
pub(super) struct HoleArgs {
    /// Judge removals: composed scenes, folders that `synth --into` or `synth --bare` has made
    ///
    /// Of each the photographs and the model are copied, prepared from one mask and trained with every seed for
    /// --iterations steps [default: 1000], the preset's schedule fitted to them. The model is compared with the photographs
    /// without the object inside the true masks: seen pixels, whose true surface another photograph shows, and unseen ones
    /// apart. --out gets hole.json (every run), hole.md (the table) and for each run a picture, SCENE/seed-N.png. The same
    /// command goes on where it was stopped, and only adds what is missing.
    #[arg(long, value_name = "SET", num_args = 1..,
        conflicts_with_all = ["scene", "predict", "against", "overwrite"])]
    pub hole: Vec<PathBuf>,
    /// Masks that are given to `prepare` [default: 1, or 2 from opposite sides where cameras stand all around]
    #[arg(long, value_name = "N", requires = "hole", value_parser = clap::value_parser!(u32).range(1..))]
    masks: Option<u32>,
    /// Runs per composed scene, with seeds train.seed, train.seed + 1, ...
    #[arg(long, value_name = "N", default_value_t = 1, requires = "hole", hide_default_value = true,
        value_parser = clap::value_parser!(u32).range(1..=1000))]
    seeds: u32,
}

/// Steps of a training that are not asked for.
const STEPS: u32 = 1000;

pub(super) fn run(
    args: &HoleArgs,
    settings: &SettingsArgs,
    device: &DeviceArgs,
    out: Option<&Path>,
) -> anyhow::Result<()> {
    let out = out.map_or_else(|| PathBuf::from("runs/hole"), Path::to_owned);
    let first = settings.resolve()?.train.seed;
    let names: Vec<String> = args.hole.iter().map(|set| name(set)).collect::<anyhow::Result<_>>()?;
    for (i, name) in names.iter().enumerate() {
        ensure!(!names[..i].contains(name), "--hole {}: two composed scenes are called {name}", args.hole[i].display());
    }
    let seeds: Vec<u64> = (first..first.saturating_add(args.seeds.into())).collect();
    signals::listen()?;
    let _lock = Lock::take(&out)?;
    folder::sweep(&out, |name| [RUNS, TABLE].contains(&name));
    let mut known = Known::read(&out, &program()?)?;
    let mut pace = Pace::new(names.len() * seeds.len());
    let mut done = 0;
    device.with_gpu(|gpu| {
        for (set, name) in args.hole.iter().zip(&names) {
            // The preparation, which all seeds share, once one of them needs it.
            let folder = out.join(name);
            let mut shared = None;
            for seed in &seeds {
                let work = Work { gpu, set, name, seed: *seed, folder: &folder, settings, device };
                let hash = work.hash()?;
                if known.find(name, *seed, &hash)?.is_some() {
                    pace.skip();
                } else {
                    signals::check(how)?;
                    eprintln!("{}", format!("== {name}, seed {seed} {}", pace.next(done)).trim_end());
                    let (truth, prepared) = match &shared {
                        Some(shared) => shared,
                        None => {
                            let truth = Truth::of(gpu, set)?;
                            let masks = args.masks.map(|n| n as usize);
                            let prepared = hole::prepared(gpu, set, &folder, &truth, masks, &mut Bars::default())?;
                            shared.insert((truth, prepared))
                        }
                    };
                    known.add(work.run(truth, prepared, hash)?)?;
                }
                done += 1;
            }
        }
        Ok(())
    })?;
    print!("{}", known.table());
    println!("{RUNS} and {TABLE} are in {}", out.display());
    let picture = out.join(&names[0]).join(format!("seed-{first}.png"));
    next::say(&[(
        next::typed(&picture.to_string_lossy()),
        "shows the object, the truth and what came in its place; every run has its own",
    )]);
    Ok(())
}

fn how() -> String {
    "the same command goes on".into()
}

/// The last part of a composed scene's folder.
///
/// # Errors
/// A folder that is none.
fn name(set: &Path) -> anyhow::Result<String> {
    let absolute = std::path::absolute(set).unwrap_or_else(|_| set.to_owned());
    ensure!(set.is_dir(), "--hole {}: there is no such folder", set.display());
    truth::check(set)?;
    Ok(last_part(&absolute.to_string_lossy()).to_owned())
}

/// Hash of the program's own file, which tells one build from another.
fn program() -> anyhow::Result<String> {
    let path = std::env::current_exe().context("the program's own file is not known")?;
    let bytes = std::fs::read(&path).with_context(|| format!("{}: cannot be read", path.display()))?;
    Ok(blake3::hash(&bytes).to_hex()[..16].to_owned())
}

/// One run.
struct Work<'a> {
    gpu: &'a Gpu,
    set: &'a Path,
    name: &'a str,
    seed: u64,
    /// Folder of all that is made of this composed scene.
    folder: &'a Path,
    settings: &'a SettingsArgs,
    device: &'a DeviceArgs,
}

impl Work<'_> {
    /// The scene that is trained, and what its settings are asked for with.
    fn given(&self, scene: PathBuf) -> SceneArgs {
        let mut settings = self.settings.clone();
        settings.iterations = None;
        settings.set.push(format!("train.seed={}", self.seed));
        settings.seed = None;
        SceneArgs { scene, settings }
    }

    /// The settings with their schedule fitted to the steps.
    fn fitted(&self, settings: &Settings) -> Settings {
        settings.rescheduled(self.settings.iterations.unwrap_or(STEPS))
    }

    /// Hash of all settings but the seed.
    fn hash(&self) -> anyhow::Result<String> {
        let given = preset::chosen(&self.given(self.set.to_owned()), self.device)?;
        let mut settings = self.fitted(&given.resolve()?);
        settings.train.seed = 0;
        Ok(blake3::hash(settings.to_toml().as_bytes()).to_hex()[..16].to_owned())
    }

    fn run(&self, truth: &Truth, prepared: &hole::Prepared, hash: String) -> anyhow::Result<Row> {
        let run = self.folder.join(format!("seed-{}", self.seed));
        let began = Instant::now();
        let Ready { scene, settings } = self.train(&run)?;
        let train_seconds = began.elapsed().as_secs_f64();
        let model = run.join(MODEL);
        let evened = !scene.gains.is_empty();
        let trained = Trained { model: &model, settings: &settings, unit: scene.unit, evened };
        let go_on = || -> anyhow::Result<()> { Ok(signals::check(how)?) };
        let judged = judge(self.gpu, self.set, truth, prepared, trained, &go_on)?;
        let picture = run.with_extension("png");
        pictures::write_rgb8(&picture, &judged.picture)?;
        let views = run.with_extension("json");
        atomic::write_json(&views, &judged.views).with_context(|| format!("{}: cannot be written", views.display()))?;
        let mut figures: BTreeMap<String, Figure> = judged.figures;
        let more = [
            ("iou", prepared.iou[0]),
            ("iou_worst", prepared.iou[1]),
            ("seen_share", 100.0 * truth.seen_share),
            ("prepare_seconds", prepared.seconds.values().sum()),
            ("train_seconds", train_seconds),
        ];
        figures.extend(more.map(|(name, value)| (name.to_owned(), Figure(value))));
        let (scene, views) = (self.name.to_owned(), judged.views.len());
        Ok(Row { scene, seed: self.seed, settings: hash, steps: settings.train.iterations, views, figures })
    }

    /// Trains what the preparation left into a run folder, or goes on with what is there; the scene and the settings as they
    /// were trained with.
    fn train(&self, run: &Path) -> anyhow::Result<Ready> {
        let given = preset::chosen(&self.given(self.folder.join(SCENE)), self.device)?;
        let scene_name = given.name();
        let settings = self.fitted(&given.resolve()?);
        let _lock = Lock::take(run)?;
        let begun = is_begun(run, &scene_name, &settings)?;
        let mut loaded = Loaded::read(&given.scene, settings)?;
        if begun {
            go_on_without(run, &mut loaded)?;
        }
        if begun && Record::read(run)?.complete.is_some() {
            return loaded.to_go_on(self.gpu);
        }
        let goes_on = begun && !checkpoint::list(run).is_empty();
        let ready = if goes_on { loaded.to_go_on(self.gpu)? } else { loaded.ready(self.gpu)? };
        let manner = Manner { go_on: begun, ..Manner::default() };
        train::train(self.gpu, &ready.scene, &ready.settings, &scene_name, run, &manner, &Judge::default())?;
        Ok(ready)
    }
}
