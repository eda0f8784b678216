//! `gscream-vk remove`: point at it, and it is gone.

mod page;
mod splat;
mod time;
mod work;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;

use super::prepare::{ObjectArgs, PosesArgs, RepaintArgs, ShadowArgs, VideoArgs};
use super::shared::{DeviceArgs, SceneArgs};
use super::{next, preset, signals, train};
use crate::config::SettingsArgs;
use crate::export;
use crate::folder::Lock;
use crate::prepare::Object;
use crate::prepare::hole::repaint::Wish;
use crate::prepare::poses::{self, Capture};
use crate::remove::objects;
use crate::scene::stem;
use crate::splat::read;
use time::{Time, Work};
use work::{Job, Places};

/// Remove an object from photographs: point at it in the browser, and it is gone
///
/// Does what prepare, doctor, train and export do, one after the other. Without --mask, --box or another mark and without
/// --yes it opens a page with the photographs: draw around the object, look at what was understood in the other photographs,
/// press Remove. With any of them it needs no browser and asks nothing.
///
/// PHOTOS is what prepare takes: a folder of photographs, alone or with a COLMAP model or a transforms.json, or a video. Everything goes
/// into one folder: the masks that were clicked (objects/NAME.png), the scene (scene/), the run (run/), and the files for
/// viewers. The same command again goes on where it was cut off, and makes again only what has changed.
///
/// Several objects are listed on the page, each with its name and colour, and what is ticked is removed: at once, or one by one, with
/// Remove pressed again. Their masks lie in objects/, objects-2/ and so on, the list in objects.json. Without a browser --object
/// begins another one.
///
/// A splat of any program (PLY of 3D Gaussian Splatting, SuperSplat's compressed PLY, SPZ, SOG, .splat, or
/// GLB with KHR_gaussian_splatting) stands for photographs as well: it is drawn from its cameras, the object's Gaussians are taken out,
/// new ones are trained in the hole, and every other Gaussian stays as it is.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk remove photos
  gscream-vk remove photos --minutes 20
  gscream-vk remove clip.mp4 --frames 80
  gscream-vk remove scene.ply --cameras sparse/0 --mask IMG_0012=mask.png --yes
  gscream-vk remove photos --out garden --mask IMG_0012=mask.png
  gscream-vk remove photos --out garden --box IMG_0012=310,220,540,470 --yes
  gscream-vk remove photos --out garden --click IMG_0012=430,340 --yes
  gscream-vk remove photos --out garden --object pot --click IMG_0012=430,340 --object ball --click IMG_0005=90,80 --yes
  gscream-vk remove photos --out garden --yes      # with the masks in garden/objects")]
pub(super) struct Args {
    /// Folder of photographs, a video, or a splat (PLY, SPZ, SOG, .splat or GLB)
    #[arg(value_name = "PHOTOS")]
    photographs: PathBuf,
    #[command(flatten)]
    video: VideoArgs,
    /// Folder for all that is made [default: PHOTOS-removed, here]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    object: ObjectArgs,
    /// Cameras to look at a splat from: a cameras.json, an export.json, or the folder of a COLMAP model [default: the file beside it;
    /// where there is none, from where it looks right]
    #[arg(long, value_name = "PATH")]
    cameras: Option<PathBuf>,
    /// Views of a splat at most, evenly spread over the cameras
    #[arg(long, value_name = "N", default_value_t = 60, value_parser = clap::value_parser!(u32).range(3..))]
    views: u32,
    /// No page and no questions: take the masks that are there, and go on whatever doctor finds
    #[arg(long)]
    yes: bool,
    /// Do not open a browser; the address of the page is printed either way
    #[arg(long)]
    no_open: bool,
    /// Port of the page on this machine; 0 is any free one
    #[arg(long, value_name = "N", default_value_t = 8644)]
    port: u16,
    /// View to become the reference [default: the one whose hole is seen best by others]
    #[arg(long, value_name = "NAME")]
    reference: Option<String>,
    #[command(flatten)]
    repaint: RepaintArgs,
    #[command(flatten)]
    poses: PosesArgs,
    #[command(flatten)]
    shadow: ShadowArgs,
    /// Be done after about so many minutes, from Remove (or the command with --yes) to the files: training has what the rest leaves
    ///
    /// The plan is said first. What cannot be done in that time is refused as soon as that is known, with the least time that it
    /// takes; what was made until then stays. The same command again has the whole time for what is left.
    #[arg(long, value_name = "N", conflicts_with = "iterations", value_parser = train::positive)]
    minutes: Option<f64>,
    /// Steps of the fit that masks, depth and reference are made with
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..))]
    fit_steps: u32,
    /// Steps by which the exported files are refined
    #[arg(long, value_name = "N", default_value_t = export::Options::default().steps)]
    export_steps: u32,
    #[command(flatten)]
    settings: SettingsArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

impl Args {
    /// The work that so many photographs are, with what is made in the folder `root`.
    fn work(&self, views: usize, root: &Path) -> anyhow::Result<Work> {
        let given = SceneArgs { scene: root.to_owned(), settings: self.settings.clone() };
        let settings = preset::chosen(&given, &self.device)?.resolve()?;
        Ok(Work {
            form: settings.model.form,
            views,
            fit: f64::from(self.fit_steps) / 200.0,
            files: f64::from(self.export_steps) / f64::from(export::Options::default().steps),
            splat: read::is_splat(&self.photographs),
        })
    }

    fn places(&self) -> Places {
        Places::new(self.out.clone().unwrap_or_else(|| default_folder(&self.photographs)))
    }
}

/// The last part of the photographs' folder, and `-removed`.
fn default_folder(photographs: &Path) -> PathBuf {
    let absolute = photographs.canonicalize().unwrap_or_else(|_| photographs.to_owned());
    let own = if absolute.is_file() { absolute.file_stem() } else { absolute.file_name() };
    let mut name = own.map_or_else(|| "photos".into(), std::ffi::OsStr::to_owned);
    name.push("-removed");
    name.into()
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let began = Instant::now();
    // A mistake in the settings is said before anything is made.
    args.settings.resolve()?;
    let places = args.places();
    let is_splat = read::is_splat(&args.photographs);
    if args.cameras.is_some() && !is_splat {
        anyhow::bail!("--cameras: are a splat's; photographs bring theirs (see prepare)");
    }
    let found = if args.photographs.is_file() { None } else { Some(poses::find(&args.photographs)?) };
    let _lock = Lock::take(&places.root)?;
    let splat = if is_splat { Some(splat::open(args, &places)?) } else { None };
    let photographs = match &splat {
        Some(splat) => splat.views.clone(),
        None => args.video.photographs(&args.photographs, &places.root)?,
    };
    let capture = found.map_or_else(|| poses::find(&photographs), Ok)?;
    let time = Time::new(args.minutes, args.work(capture.photographs.len(), &places.root)?);
    let job = Job { args, places, photographs, splat, time };
    if args.object.is_empty() && !args.yes && args.repaint.wish() == Wish::default() {
        return page::run(&job, &capture);
    }
    let objects = job.objects(&capture)?;
    let names = job.names(&objects);
    args.device.with_gpu(|gpu| {
        signals::listen()?;
        job.work(gpu, objects, args.yes, &work::Nobody, began)
    })?;
    job.say(&names);
    Ok(())
}

impl Job<'_> {
    /// The objects of the command, and what was marked of those before in photographs where they have no mark here: what has no
    /// name here is the first one of the list, unless that is to stay.
    fn objects(&self, capture: &Capture) -> anyhow::Result<Vec<Object>> {
        let folder = &self.places.objects;
        let mut all = self.args.object.0.clone();
        let mut kept = 0;
        let listed = objects::wanted(folder, capture.photographs.iter())?;
        let first = listed.iter().any(|object| object.delivered);
        for object in listed {
            let same = all.iter().position(|own| own.name == object.name || own.name.is_empty() && object.delivered);
            let at = same.unwrap_or(all.len());
            if same.is_none() {
                all.push(Object { name: object.name.clone(), evidence: vec![], delivered: object.delivered });
            }
            let own = &mut all[at];
            own.name = object.name;
            let named: Vec<String> = own.evidence.iter().map(|(name, _)| stem(name).to_owned()).collect();
            let more = object.evidence.into_iter().filter(|(name, _)| !named.iter().any(|named| named == stem(name)));
            let before = own.evidence.len();
            own.evidence.extend(more);
            kept += own.evidence.len() - before;
        }
        if kept > 0 {
            eprintln!("objects: {kept} masks in {} count as well", folder.display());
        }
        all[0].delivered &= first || !all[0].evidence.is_empty();
        Ok(all)
    }

    /// Names of the marked objects, as the subject of a sentence.
    fn names(&self, objects: &[Object]) -> String {
        let marked: Vec<&str> =
            objects.iter().filter(|object| !object.evidence.is_empty()).map(|object| object.name.as_str()).collect();
        match marked.as_slice() {
            [rest @ .., last] if !rest.is_empty() => format!("{} and {last} are", rest.join(", ")),
            _ => "the object is".into(),
        }
    }

    /// Says what there is now, and what can be done with it.
    fn say(&self, names: &str) {
        let Places { root, run, .. } = &self.places;
        println!("{}: {names} gone", root.display());
        for (name, path) in self.places.files() {
            let bytes = std::fs::metadata(&path).map_or(0, |file| file.len());
            println!("  {name:10} {:8.1} MB", bytes as f64 / 1e6);
        }
        let page = run.join(super::index::INDEX);
        next::say(&[
            (next::command(&["view"], root), "shows it in the browser; --html FILE makes a page to send"),
            (next::typed(&page.to_string_lossy()), "is the training as a page, for a browser"),
        ]);
    }
}

/// Opens the page in the user's browser, where there is one to ask.
fn open_browser(url: &str) -> anyhow::Result<()> {
    let (program, arguments): (&str, &[&str]) = if cfg!(target_os = "macos") {
        ("open", &[])
    } else if cfg!(windows) {
        ("cmd", &["/C", "start", ""])
    } else {
        ("xdg-open", &[])
    };
    let mut command = std::process::Command::new(program);
    command.args(arguments).arg(url);
    let quiet = std::process::Stdio::null;
    let mut child = command.stdin(quiet()).stdout(quiet()).stderr(quiet()).spawn().context(program.to_owned())?;
    // It may stay for as long as the browser does.
    std::thread::spawn(move || child.wait());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_folder_is_named_after_the_photographs() {
        assert_eq!(default_folder(Path::new("nowhere/garden")), Path::new("garden-removed"));
        let here = std::env::current_dir().expect("a folder");
        let name = here.file_name().expect("a name").to_string_lossy().into_owned();
        assert_eq!(default_folder(Path::new(".")), PathBuf::from(format!("{name}-removed")));
    }
}
