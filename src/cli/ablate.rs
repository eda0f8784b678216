//! `gscream-vk ablate`.

use std::path::{Path, PathBuf};

use crate::atomic;
use anyhow::{Context as _, bail, ensure};
use serde::Serialize;

use super::eval::JudgeArgs;
use super::folders::{RECORD, Record, last_part};
use super::shared::{DeviceArgs, SceneArgs, with_gpu};
use super::train::{Manner, default_folder, is_begun, train};
use super::{index, next, signals};
use crate::config::{Settings, SettingsArgs};
use crate::evaluate::Judge;
use crate::folder::{self, Lock};
use crate::gpu::Gpu;
use crate::lab::ablation::{Row, compare, differences, published, table};
use crate::lab::pace::Pace;
use crate::work::{Loaded, Ready, SYNTHETIC};

/// Train scenes with and without each part of the method, and compare (the ablation of the paper)
///
/// Variants: `neither` depth nor attention; `depth`; `depth-attention`, both; `depth-write-back`, with the release's
/// attention, which changes the features in place, beside the paper's, through which gradients flow; and with both parts
/// one `priors-NAME` for every other folder of depth priors and one `reference-NAME` for every other inpainted picture.
///
/// A variant has its parts whatever the preset or the settings say of them. One run after the other, each in a folder of its
/// own; `--resume` goes on with an ablation that was stopped, and no run is replaced without `--overwrite`. With several
/// seeds, figures are means and standard deviations over the seeds, and every two variants are compared over the same seeds
/// by a paired t-test. With several scenes, a seed's figure is its mean over the scenes, as the paper's tables have it.
/// Prints tables, and writes ablation.json (every run) and comparison.json (means, differences, and the published figures).
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk ablate synthetic --preset demo --seeds 3
  gscream-vk ablate garden --preset lavapipe --iterations 1000 --out runs/ablation --only depth,depth-attention
  gscream-vk ablate spin/1 spin/2 --preset lavapipe --priors metric=priors/metric --reference lama=lama/104425.png")]
pub(super) struct Args {
    /// Folders of the scenes, or the word `synthetic` for the built-in one
    #[arg(value_name = "SCENE", required = true)]
    scenes: Vec<PathBuf>,
    #[command(flatten)]
    settings: SettingsArgs,
    /// Runs per variant and scene, with seeds train.seed, train.seed + 1, ...
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    seeds: u32,
    /// Also train with the depth priors of this folder; may be given many times
    ///
    /// Files are named after the views; the folder's name says `disparity`, or it is depth. reference/VIEW.* in it is the
    /// prior of the inpainted picture. A folder that is not absolute is looked for in each scene first.
    #[arg(long, value_name = "NAME=FOLDER")]
    priors: Vec<String>,
    /// Also train with this inpainted picture as the reference; may be given many times
    ///
    /// It is that of the train view whose name it has, or else of the delivered reference's. A file that is not absolute
    /// is looked for in each scene first.
    #[arg(long, value_name = "NAME=FILE")]
    reference: Vec<String>,
    /// Train these variants only
    #[arg(long, value_name = "VARIANT,...", value_delimiter = ',')]
    only: Vec<String>,
    /// Folder for the runs [default: runs/SCENE-ablation]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Leave runs alone that the folder holds complete, and go on with one that was cut short
    ///
    /// Scenes and settings must be those that the runs began with. Other variants may be asked for, and more seeds where
    /// there were several.
    #[arg(long)]
    resume: bool,
    /// Replace the runs of these variants, scenes and seeds that the folder holds already
    #[arg(long, conflicts_with = "resume")]
    overwrite: bool,
    #[command(flatten)]
    judge: JudgeArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

/// What a variant has.
#[derive(Clone, Debug, PartialEq)]
struct Variant {
    name: String,
    depth: bool,
    attention: bool,
    write_back: bool,
    /// In place of the scene's own.
    priors: Option<PathBuf>,
    reference: Option<PathBuf>,
}

impl Variant {
    fn new(name: &str, depth: bool, attention: bool, write_back: bool) -> Self {
        Self { name: name.to_owned(), depth, attention, write_back, priors: None, reference: None }
    }

    /// The paper's, and those asked for.
    fn all(args: &Args) -> anyhow::Result<Vec<Self>> {
        let mut all = vec![
            Self::new("neither", false, false, false),
            Self::new("depth", true, false, false),
            Self::new("depth-attention", true, true, false),
            Self::new("depth-write-back", true, true, true),
        ];
        for text in &args.priors {
            let (name, path) = named("--priors", text)?;
            all.push(Self { priors: Some(path), ..Self::new(&format!("priors-{name}"), true, true, false) });
        }
        for text in &args.reference {
            let (name, path) = named("--reference", text)?;
            all.push(Self { reference: Some(path), ..Self::new(&format!("reference-{name}"), true, true, false) });
        }
        for (i, variant) in all.iter().enumerate() {
            ensure!(!all[..i].iter().any(|v| v.name == variant.name), "two variants are called {}", variant.name);
        }
        if let Some(unknown) = args.only.iter().find(|only| !all.iter().any(|v| v.name == **only)) {
            let names: Vec<&str> = all.iter().map(|v| v.name.as_str()).collect();
            bail!("--only {unknown}: no variant has this name; there are {}", names.join(", "));
        }
        all.retain(|v| args.only.is_empty() || args.only.contains(&v.name));
        Ok(all)
    }

    fn settings(&self, base: &Settings, scene: &Path, seed: u64) -> Settings {
        let mut settings = base.clone();
        settings.train.seed = seed;
        // A preset may leave a part out, as the one for CPUs does with attention: here it is asked for.
        settings.losses.depth.enabled = self.depth;
        settings.model.attention.enabled = self.attention;
        settings.model.attention.write_back = self.write_back;
        let place = |path: &PathBuf| {
            let inside = scene.join(path);
            let path = if inside.exists() { &inside } else { path };
            std::path::absolute(path).unwrap_or_else(|_| path.clone()).to_string_lossy().into_owned()
        };
        if let Some(priors) = &self.priors {
            settings.scene.prior_folder = place(priors);
        }
        if let Some(reference) = &self.reference {
            settings.scene.reference_file = place(reference);
        }
        settings
    }
}

/// NAME=PATH, where the name can be a folder's.
fn named(flag: &str, text: &str) -> anyhow::Result<(String, PathBuf)> {
    let plain = |name: &str| !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c));
    match text.split_once('=') {
        Some((name, path)) if plain(name) && !path.is_empty() => Ok((name.to_owned(), path.into())),
        _ => bail!("{flag} {text}: write it as NAME=PATH, the name of letters, digits, `-`, `_` and `.`"),
    }
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let variants = Variant::all(args)?;
    let judge = args.judge.judge()?;
    let scenes: Vec<SceneArgs> =
        args.scenes.iter().map(|scene| SceneArgs { scene: scene.clone(), settings: args.settings.clone() }).collect();
    let names: Vec<String> = scenes.iter().map(SceneArgs::name).collect();
    let labels = labels(&names);
    let out = args.out.clone().unwrap_or_else(|| {
        let mut folder = default_folder(&names[0]).into_os_string();
        folder.push("-ablation");
        folder.into()
    });
    let seeds = seeds(args.settings.resolve()?.train.seed, args.seeds)?;
    let _lock = Lock::take(&out)?;
    folder::sweep(&out, |name| [RUNS, COMPARISON].contains(&name));
    let mut known = Known::new(&out.join(RUNS), scenes.len() * seeds.len() * variants.len())?;
    if !args.resume && !args.overwrite {
        for (label, seed) in labels.iter().flat_map(|label| seeds.iter().map(move |seed| (label, *seed))) {
            for variant in &variants {
                let folder = folder(args, &out, label, &variant.name, seed);
                ensure!(
                    !folder.join(RECORD).exists() && !known.has(&variant.name, label, seed),
                    "{}: holds a run already: choose another --out, go on with the ablation by --resume, or replace its \
                     runs by --overwrite",
                    folder.display()
                );
            }
        }
    }
    let rows = with_gpu(&args.device.options(), |gpu| {
        let mut rows = vec![];
        for ((scene, name), label) in scenes.iter().zip(&names).zip(&labels) {
            let base = scene.resolve()?;
            for seed in &seeds {
                let place = (&*scene.scene, name.as_str(), label.as_str());
                rows.extend(of_scene(gpu, args, &variants, &base, &judge, place, (*seed, &out, &mut known))?);
            }
        }
        Ok(rows)
    })?;
    let last = rows.last().map(|row| folder(args, &out, &row.scene, &row.variant, row.seed));
    let names: Vec<String> = variants.iter().map(|variant| variant.name.clone()).collect();
    let comparison = compare(&names, &rows, labels, seeds, &judge);
    write(&out.join(COMPARISON), &comparison)?;
    print!("{}", table(&comparison.variants));
    print!("{}", differences(&comparison.differences));
    if args.scenes.iter().any(|scene| scene != Path::new(SYNTHETIC)) {
        print!("{}", published());
    }
    println!("wrote {} runs, {RUNS} and {COMPARISON} in {}", rows.len(), out.display());
    if let Some(last) = last {
        next::say(&[
            (next::typed(&last.join(index::INDEX).to_string_lossy()), "is one run as a page; every run has its own"),
            (next::command(&["export"], &last), "writes that run's scene for viewers"),
        ]);
    }
    Ok(())
}

/// The last parts of the scenes' names; numbered where two are alike.
fn labels(names: &[String]) -> Vec<String> {
    let of = |i: usize| {
        let part = last_part(&names[i]);
        let alike = names.iter().filter(|name| last_part(name) == part).count();
        if alike > 1 { format!("{part}-{}", i + 1) } else { part.to_owned() }
    };
    (0..names.len()).map(of).collect()
}

/// The folder of a run.
fn folder(args: &Args, out: &Path, label: &str, variant: &str, seed: u64) -> PathBuf {
    let mut folder = out.to_owned();
    if args.scenes.len() > 1 {
        folder.push(label);
    }
    folder.push(variant);
    if args.seeds > 1 {
        folder.push(format!("seed-{seed}"));
    }
    folder
}

/// So many seeds from the first on.
fn seeds(first: u64, count: u32) -> anyhow::Result<Vec<u64>> {
    // Settings are written as TOML, whose numbers have a sign.
    let last = first.checked_add(u64::from(count) - 1).filter(|last| i64::try_from(*last).is_ok());
    let last = last.with_context(|| {
        format!(
            "--seeds {count}: the last seed after train.seed = {first} would be above {}: choose a smaller one",
            i64::MAX
        )
    })?;
    Ok((first..=last).collect())
}

/// Every run's figures.
const RUNS: &str = "ablation.json";
/// Means and differences over them.
const COMPARISON: &str = "comparison.json";

/// The runs that are complete, kept in a file as they come.
struct Known {
    path: PathBuf,
    rows: Vec<Row>,
    pace: Pace,
    /// Of this ablation, in this call or before it.
    done: usize,
}

impl Known {
    /// Those of ablations in this folder before.
    fn new(path: &Path, all: usize) -> anyhow::Result<Self> {
        let rows = if path.exists() {
            let text = std::fs::read_to_string(path).with_context(|| format!("{}: cannot be read", path.display()))?;
            serde_json::from_str(&text).with_context(|| {
                format!("{}: holds no runs of an ablation: move it away, or choose another --out", path.display())
            })?
        } else {
            vec![]
        };
        Ok(Self { path: path.to_owned(), rows, pace: Pace::new(all), done: 0 })
    }

    fn has(&self, variant: &str, scene: &str, seed: u64) -> bool {
        self.rows.iter().any(|row| (&*row.variant, &*row.scene, row.seed) == (variant, scene, seed))
    }

    /// A run is about to be replaced.
    fn forget(&mut self, variant: &str, scene: &str, seed: u64) -> anyhow::Result<()> {
        if self.has(variant, scene, seed) {
            self.rows.retain(|row| (&*row.variant, &*row.scene, row.seed) != (variant, scene, seed));
            write(&self.path, &self.rows)?;
        }
        Ok(())
    }

    fn find(&self, variant: &str, scene: &str, seed: u64, protocol: &str) -> Option<&Row> {
        let alike =
            |row: &&Row| (&*row.variant, &*row.scene, row.seed, &*row.protocol) == (variant, scene, seed, protocol);
        self.rows.iter().find(alike)
    }

    fn add(&mut self, row: &Row) -> anyhow::Result<()> {
        self.rows.retain(|other| (&other.variant, &other.scene, other.seed) != (&row.variant, &row.scene, row.seed));
        self.rows.push(row.clone());
        self.done += 1;
        write(&self.path, &self.rows)
    }
}

/// All variants of one scene under one seed.
fn of_scene(
    gpu: &Gpu,
    args: &Args,
    variants: &[Variant],
    base: &Settings,
    judge: &Judge,
    (path, name, label): (&Path, &str, &str),
    (seed, out, known): (u64, &Path, &mut Known),
) -> anyhow::Result<Vec<Row>> {
    let mut rows = vec![];
    // Read once for all variants that read it alike.
    let mut read: Option<(Settings, Ready)> = None;
    for variant in variants {
        let mut settings = variant.settings(base, path, seed);
        let folder = folder(args, out, label, &variant.name, seed);
        let begun = args.resume && is_begun(&folder, name, &settings)?;
        let complete = begun && Record::read(&folder)?.complete.is_some();
        if let Some(row) = known.find(&variant.name, label, seed, judge.protocol.describe()).filter(|_| complete) {
            rows.push(row.clone());
            known.done += 1;
            known.pace.skip();
            continue;
        }
        // The seed is that of the built-in scene, too.
        let alike = |other: &Settings| other.scene == settings.scene && other.train.seed == settings.train.seed;
        if !read.as_ref().is_some_and(|(other, _)| alike(other)) {
            read = Some((settings.clone(), Loaded::read(path, settings.clone())?.ready(gpu)?));
        }
        let Some((_, Ready { scene, settings: without })) = &read else { unreachable!("it was just read") };
        settings.scene.leave_out.clone_from(&without.scene.leave_out);
        if scene.test.is_empty() {
            bail!(
                "{}: the scene has no test views to compare on: set scene.test_every to hold some out",
                path.display()
            );
        }
        let mut which = variant.name.clone();
        if args.scenes.len() > 1 {
            which = format!("{label}, {which}");
        }
        if args.seeds > 1 {
            which = format!("{which}, seed {seed}");
        }
        signals::check(|| "the same command with --resume goes on".into())?;
        eprintln!("{}", format!("== {which} {}", known.pace.next(known.done)).trim_end());
        if complete && known.has(&variant.name, label, seed) {
            bail!(
                "{}: its figures follow another protocol than this one: choose another --out, or train again by --overwrite",
                folder.display()
            );
        }
        let _lock = Lock::take(&folder)?;
        known.forget(&variant.name, label, seed)?;
        let manner = Manner { go_on: begun, ..Manner::default() };
        let trained = train(gpu, scene, &settings, name, &folder, &manner, judge)?;
        let mean = trained.report.as_ref().and_then(|report| report.mean).context("there are no test views")?;
        let row = Row::new([&variant.name, label], seed, &trained.summary, &mean, judge);
        known.add(&row)?;
        rows.push(row);
    }
    Ok(rows)
}

fn write(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    atomic::write_json(path, value).with_context(|| format!("{}: cannot be written", path.display()))
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;
    use crate::evaluate::{Figures, Metrics};
    use crate::lab::ablation::Figure;
    use crate::lab::statistics::Paired;

    #[derive(clap::Parser)]
    struct Probe {
        #[command(flatten)]
        args: Args,
    }

    fn args(words: &[&str]) -> Args {
        Probe::try_parse_from([&["probe"], words].concat()).expect("these arguments parse").args
    }

    fn names(words: &[&str]) -> Vec<String> {
        Variant::all(&args(words)).expect("variants").into_iter().map(|v| v.name).collect()
    }

    #[test]
    fn variants_are_the_papers_and_those_asked_for() {
        assert_eq!(names(&["s"]), ["neither", "depth", "depth-attention", "depth-write-back"]);
        let more = ["s", "--priors", "metric=a/b", "--priors", "other=c", "--reference", "lama=x.png"];
        assert_eq!(names(&more)[4..], ["priors-metric", "priors-other", "reference-lama"]);
        let only = [&more[..], &["--only", "depth,reference-lama"]].concat();
        assert_eq!(names(&only), ["depth", "reference-lama"]);
        let refused = |words: &[&str]| Variant::all(&args(words)).expect_err("refused").to_string();
        assert_eq!(
            refused(&["s", "--only", "all"]),
            "--only all: no variant has this name; there are neither, depth, depth-attention, depth-write-back"
        );
        assert!(refused(&["s", "--priors", "folder"]).contains("write it as NAME=PATH"));
        assert!(refused(&["s", "--priors", "a/b=folder"]).contains("write it as NAME=PATH"));
        assert_eq!(refused(&["s", "--priors", "a=b", "--priors", "a=c"]), "two variants are called priors-a");
        assert!(Probe::try_parse_from(["probe"]).is_err(), "a scene is needed");
    }

    /// Presets for CPUs have no attention: an ablation of it would compare a variant with itself.
    #[test]
    fn a_variant_has_its_parts_whatever_the_preset_says() {
        let args = args(&["s", "--preset", "lavapipe"]);
        let base = args.settings.resolve().expect("a preset");
        assert!(!base.model.attention.enabled, "the preset has none");
        let parts = |v: Variant| {
            let settings = v.settings(&base, Path::new("s"), 0);
            (settings.losses.depth.enabled, settings.model.attention.enabled, settings.model.attention.write_back)
        };
        let all: Vec<_> = Variant::all(&args).expect("variants").into_iter().map(parts).collect();
        assert_eq!(all, [(false, false, false), (true, false, false), (true, true, false), (true, true, true)]);
    }

    #[test]
    fn scenes_of_one_name_are_numbered() {
        let names = ["/x/1", "/y/1", "/y/2"].map(str::to_owned);
        assert_eq!(labels(&names), ["1-1", "1-2", "2"]);
    }

    /// A picture that is the photograph to the bit has an infinite PSNR, which JSON's numbers are not.
    #[test]
    fn an_infinite_figure_is_known_again() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join(RUNS);
        let mut known = Known::new(&path, 1).expect("no file is no run");
        let row = Row {
            variant: "depth".into(),
            scene: "a".into(),
            seed: 3,
            seconds: 1.0,
            steps_per_second: 1.0,
            anchors: 1,
            metrics: Metrics::new(Figures { psnr: f64::INFINITY, ssim: 1.0, flip: 0.0 }),
            residue: None,
            figures: [("psnr".to_owned(), Figure(f64::INFINITY)), ("ssim".to_owned(), Figure(1.0))].into(),
            protocol: "p".into(),
        };
        known.add(&row).expect("writable");
        let read = Known::new(&path, 1).expect("its own file");
        let found = read.find("depth", "a", 3, "p").expect("the run");
        assert_eq!((found.figures["psnr"], found.figures["ssim"]), (Figure(f64::INFINITY), Figure(1.0)));
        let compared = compare(&["depth".to_owned()], &read.rows, vec!["a".into()], vec![3], &Judge::default());
        let json = serde_json::to_value(&compared).expect("JSON");
        assert_eq!(json["variants"][0]["figures"]["psnr"]["mean"], "inf");
        assert!(Paired::of(&[1.0, f64::INFINITY], &[f64::INFINITY; 2]).is_none(), "no difference of infinities");
    }

    #[test]
    fn seeds_beyond_what_settings_hold_are_refused() {
        let most = i64::MAX as u64;
        assert_eq!(seeds(most - 1, 2).expect("the last two"), [most - 1, most]);
        assert_eq!(seeds(7, 1).expect("one"), [7]);
        for (first, count) in [(most, 2), (u64::MAX, 2)] {
            let error = seeds(first, count).expect_err("too large").to_string();
            assert!(error.contains("would be above 9223372036854775807"), "{error}");
        }
    }
}
