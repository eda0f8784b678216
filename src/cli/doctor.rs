use std::path::{Path, PathBuf};

use crate::atomic;
use anyhow::{Context as _, bail};

use super::{next, pictures};
use crate::prepare::hole::PROVENANCE;
use crate::prepare::{record, unfold};
use crate::scene::doctor::{self, Finding, Report, Severity};
use crate::scene::{Camera, Scene, map, sheet};
use crate::work;

/// Look over a scene before training: masks, names, sizes, poses, depth, reference, exposure
///
/// Problems and notes go to stdout, the worst first. A contact sheet of all views with their masks, as PNG and as a page,
/// goes into the folder that --sheet names; of a scene that prepare made it shows what no view sees of the hole. The page has a map
/// of the cameras from above: parts of the model that share hardly a point have colours of their own, what was left out is hollow.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk doctor scene
  gscream-vk doctor scene --sheet sheet
  gscream-vk doctor scene --json | jq .findings
  gscream-vk doctor carried --masks truth/masks

Exit codes: 0 no problem was found, 1 problems, 2 the arguments make no sense.")]
pub(super) struct Args {
    /// Folder of the scene
    #[arg(value_name = "SCENE")]
    scene: PathBuf,
    /// Print the findings and the figures of every view as JSON
    #[arg(long)]
    json: bool,
    /// Folder for sheet.png and sheet.html
    #[arg(long, value_name = "DIR")]
    sheet: Option<PathBuf>,
    /// Folder of other masks to compare the scene's with: intersection over union
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let (mut report, scene) = examined(&args.scene, args.masks.as_deref())?;
    let (spots, parts) = scene.as_ref().map(|scene| unfold::standing(&args.scene, scene)).unwrap_or_default();
    let is_masked = scene.as_ref().is_some_and(|scene| scene.train.iter().any(|view| view.mask.is_some()));
    if let Some([largest, second, ..]) = parts.as_deref().filter(|_| is_masked) {
        let what = format!(
            "the model is in parts, of {largest} and {second} photographs, that share nothing but the object; where the object looks alike \
             from several sides, one may stand on the wrong side of it: look where they stand in the map of --sheet; prepare turns them \
             back where what the object stands on proves it"
        );
        report.add(Severity::Note, "poses", None, what);
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print!("{}", text(&report));
    }
    if let (Some(folder), Some(scene)) = (&args.sheet, &scene) {
        // A picture that is not there, or not readable, leaves its cell out.
        let provenance = crate::scene::decode(&args.scene.join(PROVENANCE)).ok().map(image::DynamicImage::into_rgb8);
        let sheet = sheet::draw(scene, provenance.as_ref());
        let rgb: Vec<[f32; 3]> = sheet.picture.pixels().map(|p| p.0.map(|v| f32::from(v) / 255.0)).collect();
        pictures::write_png(&folder.join(sheet::PICTURE), [sheet.picture.width(), sheet.picture.height()], &rgb)?;
        let page = folder.join(sheet::PAGE);
        let cameras: Vec<Camera> = scene.train.iter().map(|view| view.camera).collect();
        let map = map::draw(&cameras, &spots, &scene.points);
        atomic::write(&page, sheet::page(&args.scene.display().to_string(), &sheet, &map, &report))
            .with_context(|| format!("{}: cannot be written", page.display()))?;
        eprintln!("wrote {} and {} in {}", sheet::PICTURE, sheet::PAGE, folder.display());
    }
    match report.problems() {
        0 => {
            next::say(&[(next::command(&["train"], &args.scene), "trains it")]);
            Ok(())
        }
        1 => bail!("{}: 1 problem", args.scene.display()),
        count => bail!("{}: {count} problems", args.scene.display()),
    }
}

/// The findings of [`doctor::examine`], and the notes that `prepare` left when it made the scene.
pub(super) fn examined(folder: &Path, masks: Option<&Path>) -> anyhow::Result<(Report, Option<Scene>)> {
    let (mut report, scene) = doctor::examine(folder, masks)?;
    if scene.is_some() {
        record::notes(folder).into_iter().for_each(|note| report.add(Severity::Note, "prepare", None, note));
    }
    Ok((report, scene))
}

/// The findings as lines, the worst first.
pub(super) fn text(report: &Report) -> String {
    text_of(report, |_| true)
}

/// As [`text`], without the notes of the scene in `folder` that were said already.
pub(super) fn new_text(report: &Report, folder: &Path) -> String {
    text_of(report, |finding| {
        let new = work::is_new(folder, &finding.text());
        new || finding.severity == Severity::Problem
    })
}

fn text_of(report: &Report, is_said: impl Fn(&Finding) -> bool) -> String {
    let mut text = String::new();
    for finding in report.findings.iter().filter(|finding| is_said(finding)) {
        let kind = if finding.severity == Severity::Problem { "problem" } else { "note" };
        text += &format!("{kind:<8} {:<10} {}\n", finding.check, finding.text());
    }
    if let Some([mean, least]) = report.iou {
        let views = report.views.iter().filter(|view| view.iou.is_some()).count();
        text += &format!("masks agree with the others: mean IoU {mean:.3}, least {least:.3}, {views} views\n");
    }
    if report.problems() == 0 {
        text += "nothing wrong was found\n";
    }
    text
}
