//! `gscream-vk ablate`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use crate::atomic::AtomicWriteFile;
use anyhow::{Context as _, bail, ensure};
use serde::{Deserialize, Serialize};

use super::eval::JudgeArgs;
use super::folders::{RECORD, Record};
use super::report::last_part;
use super::shared::{DeviceArgs, SYNTHETIC, SceneArgs, add_dense, load_scene, with_gpu};
use super::train::{Manner, Trained, default_folder, is_begun, train};
use super::{index, next, signals};
use crate::config::{Settings, SettingsArgs};
use crate::evaluate::{Judge, Mean, Metrics, PUBLISHED_ROWS, Published, Region, decibel};
use crate::folder::{self, Lock};
use crate::gpu::Gpu;
use crate::lab::pace::Pace;
use crate::lab::statistics::{Moments, Paired};
use crate::scene::Scene;

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

/// A run.
#[derive(Clone, Serialize, Deserialize)]
struct Row {
    variant: String,
    scene: String,
    seed: u64,
    seconds: f64,
    steps_per_second: f64,
    anchors: u32,
    metrics: Metrics,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    residue: Option<f64>,
    /// Every figure by its name.
    figures: BTreeMap<String, Figure>,
    /// What the figures follow.
    protocol: String,
}

/// A number, of which PSNR may be infinite.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
struct Figure(#[serde(with = "decibel")] f64);

/// A column: the figure's name in JSON, its title, digits.
type Column = (&'static str, &'static str, usize);

const COLUMNS: [Column; 23] = [
    ("psnr", "PSNR", 2),
    ("masked_psnr", "masked PSNR", 2),
    ("ssim", "SSIM", 4),
    ("masked_ssim", "masked SSIM", 4),
    ("fitted_psnr", "PSNR, exposure fitted", 2),
    ("flip", "FLIP", 4),
    ("masked_flip", "masked FLIP", 4),
    ("outside_seen_psnr", "outside, seen: PSNR", 2),
    ("outside_seen_ssim", "SSIM", 4),
    ("rim_psnr", "rim PSNR", 2),
    ("depth_error", "depth error in the mask %", 2),
    ("completeness", "complete %", 1),
    ("residue", "object left", 3),
    ("lpips_vgg", "LPIPS VGG", 4),
    ("masked_lpips_vgg", "masked", 4),
    ("lpips_vgg_unit", "LPIPS VGG [0, 1]", 4),
    ("masked_lpips_vgg_unit", "masked", 4),
    ("lpips_alex", "LPIPS Alex", 4),
    ("masked_lpips_alex", "masked", 4),
    ("fid", "FID", 2),
    ("anchors", "anchors", 0),
    ("steps_per_second", "steps/s", 2),
    ("seconds", "seconds", 0),
];

/// Figures of which differences are printed; comparison.json has all.
const COMPARED: [&str; 4] = ["psnr", "masked_psnr", "masked_ssim", "outside_seen_psnr"];

impl Row {
    fn new(variant: &Variant, scene: &str, seed: u64, trained: &Trained, judge: &Judge) -> anyhow::Result<Self> {
        let summary = &trained.summary;
        let mean = trained.report.as_ref().and_then(|r| r.mean).context("there are no test views")?;
        let steps_per_second = f64::from(summary.steps) / summary.seconds;
        let mut figures = figures(&mean);
        figures.extend([
            ("anchors", f64::from(summary.anchors)),
            ("steps_per_second", steps_per_second),
            ("seconds", summary.seconds),
        ]);
        Ok(Self {
            variant: variant.name.clone(),
            scene: scene.to_owned(),
            seed,
            seconds: summary.seconds,
            steps_per_second,
            anchors: summary.anchors,
            metrics: mean.metrics,
            residue: mean.residue,
            figures: figures.into_iter().map(|(name, value)| (name.to_owned(), Figure(value))).collect(),
            protocol: judge.protocol.describe().to_owned(),
        })
    }
}

/// What was measured, by name.
fn figures(mean: &Mean) -> BTreeMap<&'static str, f64> {
    let metrics = &mean.metrics;
    let region = |region, seen| metrics.of(region, seen);
    let (mask, seen) = (region(Region::Mask, false), region(Region::Outside, true));
    let lpips = metrics.lpips.unwrap_or_default();
    let all = [
        ("psnr", Some(metrics.full.psnr)),
        ("masked_psnr", mask.map(|m| m.psnr)),
        ("ssim", Some(metrics.full.ssim)),
        ("masked_ssim", mask.map(|m| m.ssim)),
        ("fitted_psnr", metrics.fitted.map(|m| m.psnr)),
        ("flip", Some(metrics.full.flip)),
        ("masked_flip", mask.map(|m| m.flip)),
        ("outside_seen_psnr", seen.map(|m| m.psnr)),
        ("outside_seen_ssim", seen.map(|m| m.ssim)),
        ("rim_psnr", region(Region::Rim, false).map(|m| m.psnr)),
        ("depth_error", metrics.geometry.and_then(|g| g.relative_error).map(|error| 100.0 * error)),
        ("completeness", metrics.geometry.map(|g| 100.0 * g.completeness)),
        ("residue", mean.residue),
        ("lpips_vgg", lpips.vgg.map(|d| d.full)),
        ("masked_lpips_vgg", lpips.vgg.and_then(|d| d.mask)),
        ("lpips_vgg_unit", lpips.vgg_unit.map(|d| d.full)),
        ("masked_lpips_vgg_unit", lpips.vgg_unit.and_then(|d| d.mask)),
        ("lpips_alex", lpips.alex.map(|d| d.full)),
        ("masked_lpips_alex", lpips.alex.and_then(|d| d.mask)),
        ("fid", mean.fid.map(|f| f.full)),
    ];
    all.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
}

/// A variant over the seeds.
#[derive(Serialize)]
struct Summary {
    variant: String,
    /// By figure: of the seeds' means over the scenes.
    figures: BTreeMap<&'static str, Moments>,
}

/// The second variant less the first, over the same seeds.
#[derive(Serialize)]
struct Difference {
    from: String,
    to: String,
    figures: BTreeMap<&'static str, Paired>,
}

#[derive(Serialize)]
struct Comparison {
    scenes: Vec<String>,
    seeds: Vec<u64>,
    protocol: &'static str,
    variants: Vec<Summary>,
    differences: Vec<Difference>,
    /// Ten scenes at full size, as printed by their papers.
    published: &'static [Published],
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let variants = Variant::all(args)?;
    let base = args.settings.resolve()?;
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
    let seeds = seeds(base.train.seed, args.seeds)?;
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
            for seed in &seeds {
                let place = (&*scene.scene, name.as_str(), label.as_str());
                rows.extend(of_scene(gpu, args, &variants, &base, &judge, place, (*seed, &out, &mut known))?);
            }
        }
        Ok(rows)
    })?;
    let last = rows.last().map(|row| folder(args, &out, &row.scene, &row.variant, row.seed));
    let comparison = compare(&variants, &rows, labels, seeds, &judge);
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
    let mut read: Option<(Settings, Vec<String>, Scene)> = None;
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
        if !read.as_ref().is_some_and(|(other, _, _)| alike(other)) {
            let mut scene = load_scene(path, &settings)?;
            let mut without = settings.clone();
            add_dense(gpu, path, &mut scene, &mut without)?;
            read = Some((settings.clone(), without.scene.leave_out, scene));
        }
        let Some((_, leave_out, scene)) = &read else { unreachable!("it was just read") };
        settings.scene.leave_out.clone_from(leave_out);
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
        let row = Row::new(variant, label, seed, &trained, judge)?;
        known.add(&row)?;
        rows.push(row);
    }
    Ok(rows)
}

/// Means over the scenes by seed, in the order of seeds; `None` where a run lacks the figure.
fn by_seed(rows: &[Row], variant: &str, figure: &str, seeds: &[u64]) -> Option<Vec<f64>> {
    let mean = |seed: &u64| {
        let runs = rows.iter().filter(|row| row.variant == variant && row.seed == *seed);
        let values: Vec<f64> = runs.map(|row| Some(row.figures.get(figure)?.0)).collect::<Option<_>>()?;
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    seeds.iter().map(mean).collect()
}

fn compare(variants: &[Variant], rows: &[Row], scenes: Vec<String>, seeds: Vec<u64>, judge: &Judge) -> Comparison {
    let figure = |variant: &Variant, name| by_seed(rows, &variant.name, name, &seeds);
    let summary = |variant: &Variant| Summary {
        variant: variant.name.clone(),
        figures: COLUMNS.iter().filter_map(|(name, ..)| Some((*name, Moments::of(&figure(variant, name)?)?))).collect(),
    };
    let difference = |from: &Variant, to: &Variant| Difference {
        from: from.name.clone(),
        to: to.name.clone(),
        figures: COLUMNS
            .iter()
            .filter_map(|(name, ..)| Some((*name, Paired::of(&figure(from, name)?, &figure(to, name)?)?)))
            .collect(),
    };
    let pairs = (0..variants.len()).flat_map(|j| (0..j).map(move |i| (i, j)));
    let differences = pairs.map(|(i, j)| difference(&variants[i], &variants[j]));
    Comparison {
        variants: variants.iter().map(summary).collect(),
        differences: differences.filter(|d| !d.figures.is_empty()).collect(),
        scenes,
        protocol: judge.protocol.describe(),
        seeds,
        published: &PUBLISHED_ROWS,
    }
}

fn write(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    let write = || {
        let mut file = AtomicWriteFile::open(path)?;
        file.write_all((serde_json::to_string_pretty(value)? + "\n").as_bytes())?;
        file.commit()
    };
    write().with_context(|| format!("{}: cannot be written", path.display()))
}

/// A Markdown table of cells, the first row its head.
fn markdown(rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut text = String::new();
    for (i, row) in rows.into_iter().enumerate() {
        writeln!(text, "| {} |", row.join(" | ")).expect("a string takes everything");
        if i == 0 {
            writeln!(text, "|{}", " --- |".repeat(row.len())).expect("a string takes everything");
        }
    }
    text
}

fn table(variants: &[Summary]) -> String {
    let present = |(name, ..): &&Column| variants.iter().any(|v| v.figures.contains_key(name));
    let columns: Vec<&Column> = COLUMNS.iter().filter(present).collect();
    let head = std::iter::once("variant".to_owned()).chain(columns.iter().map(|(_, title, _)| (*title).to_owned()));
    let row = |v: &Summary| {
        let cell = |(name, _, digits): &&Column| v.figures.get(name).map_or("-".to_owned(), |m| m.text(*digits));
        std::iter::once(v.variant.clone()).chain(columns.iter().map(cell)).collect()
    };
    let seeds = variants.first().and_then(|v| v.figures.get("psnr")).map_or(0, |m| m.seeds);
    let note = if seeds > 1 { format!("mean ± standard deviation of a seed, {seeds} seeds\n") } else { String::new() };
    markdown(std::iter::once(head.collect()).chain(variants.iter().map(row))) + &note
}

/// Empty where there is one seed.
fn differences(all: &[Difference]) -> String {
    if all.is_empty() {
        return String::new();
    }
    let title = |name: &str| COLUMNS.iter().find(|(key, ..)| *key == name).map_or("", |(_, title, _)| title);
    let compared: Vec<&str> =
        COMPARED.into_iter().filter(|name| all.iter().any(|d| d.figures.contains_key(name))).collect();
    let head = std::iter::once("difference".to_owned()).chain(compared.iter().map(|name| title(name).to_owned()));
    let row = |d: &Difference| {
        let cell = |name: &&str| {
            d.figures.get(name).map_or("-".to_owned(), |paired| {
                let Paired { difference, standard_error, p, .. } = paired;
                let digits = if name.ends_with("psnr") { 2 } else { 4 };
                format!("{difference:+.digits$} ± {standard_error:.digits$} (p {p:.3})")
            })
        };
        std::iter::once(format!("{} - {}", d.to, d.from)).chain(compared.iter().map(cell)).collect()
    };
    let table = markdown(std::iter::once(head.collect()).chain(all.iter().map(row)));
    format!("\n{table}mean difference over the same seeds ± its standard error, p of a paired t-test\n")
}

/// The published rows.
fn published() -> String {
    let head = ["published", "PSNR", "masked PSNR", "SSIM", "masked SSIM", "LPIPS", "masked LPIPS", "FID", "time"];
    let row = |p: &Published| {
        let numbers = [p.psnr[0], p.psnr[1], p.ssim[0], p.ssim[1], p.lpips[0], p.lpips[1]].map(|v| format!("{v:.2}"));
        let fid = p.fid.map_or("-".to_owned(), |fid| format!("{fid:.2}"));
        let rest = [fid, p.time.unwrap_or("-").to_owned()];
        std::iter::once(p.method.to_owned()).chain(numbers).chain(rest).collect()
    };
    let rows = std::iter::once(head.map(str::to_owned).to_vec()).chain(PUBLISHED_ROWS.iter().map(row));
    format!(
        "\n{}published figures: means over SPIn-NeRF's ten scenes at full size, as the papers print them\n",
        markdown(rows)
    )
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;
    use crate::evaluate::Figures;

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
        let variants = [Variant::new("depth", true, false, false)];
        let compared = compare(&variants, &read.rows, vec!["a".into()], vec![3], &Judge::default());
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

    /// Two variants, two scenes, three seeds: figures are means over scenes by seed.
    #[test]
    fn figures_are_means_over_scenes_and_then_over_seeds() {
        let row = |variant: &str, scene: &str, seed: u64, psnr: f64| Row {
            variant: variant.into(),
            scene: scene.into(),
            seed,
            seconds: 1.0,
            steps_per_second: 1.0,
            anchors: 1,
            metrics: Metrics::new(Figures { psnr, ssim: 0.5, flip: 0.5 }),
            residue: None,
            figures: [("psnr".to_owned(), Figure(psnr))].into(),
            protocol: String::new(),
        };
        let mut rows = vec![];
        for (seed, gain) in [(0, 1.0), (1, 2.0), (2, 3.0)] {
            for (scene, base) in [("a", 20.0), ("b", 30.0)] {
                rows.push(row("neither", scene, seed, base));
                rows.push(row("depth", scene, seed, base + gain));
            }
        }
        let variants = [Variant::new("neither", false, false, false), Variant::new("depth", true, false, false)];
        let found = compare(&variants, &rows, vec!["a".into(), "b".into()], vec![0, 1, 2], &Judge::default());
        let moments = &found.variants[1].figures["psnr"];
        assert_eq!((moments.mean, moments.deviation, moments.seeds), (27.0, Some(1.0), 3));
        let difference = &found.differences[0];
        assert_eq!((difference.from.as_str(), difference.to.as_str()), ("neither", "depth"));
        assert_eq!(difference.figures["psnr"], Paired::of(&[0.0; 3], &[1.0, 2.0, 3.0]).expect("three"));
        insta::assert_snapshot!(table(&found.variants) + &differences(&found.differences) + &published());
        // One seed: neither deviations nor differences.
        let one: Vec<Row> = rows.into_iter().filter(|row| row.seed == 0).collect();
        let found = compare(&variants, &one, vec!["a".into(), "b".into()], vec![0], &Judge::default());
        assert!(found.differences.is_empty() && differences(&found.differences).is_empty());
        assert_eq!(
            table(&found.variants),
            "| variant | PSNR |\n| --- | --- |\n| neither | 25.00 |\n| depth | 26.00 |\n"
        );
    }
}
