use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::shared::DeviceArgs;
use super::{next, signals};
use crate::folder::Lock;
use crate::prepare::click::MOST_POINTS;
use crate::prepare::hole::repaint::{Repaint, Wish};
use crate::prepare::shadow::Answer;
use crate::prepare::{self, Evidence, Object, Request, Step, Watch, video};
use crate::signal::Signal;

/// Make a scene of photographs and one mask: cameras, masks for all views, depth, a reference view without the object
///
/// PHOTOS is a folder of photographs, alone or with what is known of their cameras: a COLMAP model in sparse/ (photographs
/// in images/), or nerfstudio's transforms.json. For photographs alone the program colmap is asked, where it is installed.
/// PHOTOS may be a video, too: its sharpest frames of even spacing, which the program ffmpeg takes, are the photographs.
/// The scene gets the plain layout, which `train` takes.
///
/// The steps are poses, fit, masks, shadow, depth, reference and repaint. A step whose inputs have not changed is skipped, a file that was
/// changed or put there by hand stays, and a mask corrected by hand counts as one that was given. prepare.json says what
/// every file was made from, prepare/provenance.png where each pixel of the reference is from.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk prepare photos --out scene --mask IMG_0012=box.png
  gscream-vk prepare photos --out scene --box IMG_0012=310,220,540,470
  gscream-vk prepare clip.mp4 --out scene --box frame_0001=310,220,540,470
  gscream-vk prepare photos --out scene --click IMG_0012=430,340 --not IMG_0012=520,460
  gscream-vk prepare photos --out scene --mask IMG_0012=a.png --mask IMG_0040=b.png --reference IMG_0025
  gscream-vk prepare photos --out scene --object pot --mask IMG_0012=a.png --object ball --box IMG_0005=310,220,540,470
  gscream-vk prepare photos --out scene --only masks --mask IMG_0012=better.png
  gscream-vk prepare photos --out scene --repaint IMG_0012=wrong.png@-80,0")]
pub(super) struct Args {
    /// Folder of photographs, or a video
    #[arg(value_name = "PHOTOS")]
    photographs: PathBuf,
    /// Folder of the scene; may be PHOTOS itself
    #[arg(long, value_name = "SCENE")]
    out: PathBuf,
    #[command(flatten)]
    video: VideoArgs,
    #[command(flatten)]
    object: ObjectArgs,
    /// View to become the reference [default: the one whose hole is seen best by others]
    #[arg(long, value_name = "NAME")]
    reference: Option<String>,
    #[command(flatten)]
    repaint: RepaintArgs,
    /// Run this step alone, with what those before it left; may be given many times
    #[arg(long, value_name = "STEP", value_parser = step)]
    only: Vec<Step>,
    #[command(flatten)]
    poses: PosesArgs,
    #[command(flatten)]
    shadow: ShadowArgs,
    /// Make no depth priors; otherwise they are the fit's own depth, nothing (NaN) where views disagree
    ///
    /// A scene that has priors of its own in depth/ or disparity/ keeps those alone.
    #[arg(long)]
    no_depth: bool,
    /// Network that fills what no photograph shows: LaMa as ONNX file
    ///
    /// It takes the picture [1, 3, H, W], RGB from 0 to 1, and the hole [1, 1, H, W], 1 in it, and gives the picture, from 0
    /// to 1 or to 255. H and W are the file's, or 512.
    #[arg(long, value_name = "FILE")]
    inpaint_model: Option<PathBuf>,
    /// Network whose maps become the depth priors, instead of the fit's own depth: Depth Anything V2 and others as ONNX file
    ///
    /// It takes the picture [1, 3, H, W] with ImageNet's mean and deviation and gives [1, H, W]. H and W are the file's, or
    /// 518 for the shorter side. Depth or disparity: what the sparse points follow.
    #[arg(long, value_name = "FILE", conflicts_with = "no_depth")]
    depth_model: Option<PathBuf>,
    /// Steps of the fit
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..))]
    fit_steps: u32,
    /// Longer side of the pictures that the fit is made with, pixels
    #[arg(long, value_name = "PIXELS", default_value_t = 256, value_parser = clap::value_parser!(u32).range(32..))]
    fit_side: u32,
    /// Seed of every random choice
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u32,
    #[command(flatten)]
    device: DeviceArgs,
}

/// Objects, by files and numbers: the one without a name first.
#[derive(Debug, Clone, Default)]
pub(super) struct ObjectArgs(pub Vec<Object>);

/// See [`ObjectArgs`].
#[derive(Debug, clap::Args)]
struct Marks {
    /// Name of another object, which the marks behind it are of, up to the next --object; those before the first are one object
    ///
    /// Each object is looked for by itself in the photographs where it has no mark, and all are removed.
    #[arg(long, value_name = "OBJECT", value_parser = object_name)]
    object: Vec<String>,
    /// Mask of one view: a picture that is not black on the object; may be given many times
    #[arg(long, value_name = "NAME=FILE", value_parser = mask)]
    mask: Vec<(String, Evidence)>,
    /// Box around the object in one view, in pixels of the photograph: x0,y0 and one past x1,y1; may be given many times
    #[arg(long = "box", value_name = "NAME=x0,y0,x1,y1", value_parser = bounds)]
    bounds: Vec<(String, Evidence)>,
    /// Picture of strokes on one view: white or green on the object, black or red beside it, else grey or transparent
    ///
    /// With a --box of the same view they count within it alone: for one leaf of many.
    #[arg(long, value_name = "NAME=FILE", value_parser = strokes)]
    strokes: Vec<(String, Evidence)>,
    /// Rough line around the object in one view, in pixels of the photograph; it closes itself. As good as a box, for any shape
    #[arg(long, value_name = "NAME=x,y,x,y,...", value_parser = lasso)]
    lasso: Vec<(String, Evidence)>,
    /// Pixel of the object in one view; may be given many times
    ///
    /// Marks of one view count together: boxes and lassos, then --click, then --not.
    #[arg(long, value_name = "NAME=x,y", value_parser = click)]
    click: Vec<(String, Evidence)>,
    /// Pixel that is not of the object, where another mark of the view takes too much; may be given many times
    #[arg(long, value_name = "NAME=x,y", value_parser = not)]
    not: Vec<(String, Evidence)>,
}

/// Options to repaint by hand.
#[derive(Debug, Clone, Default, clap::Args)]
pub(super) struct RepaintArgs {
    /// Part of a hole to be filled anew, in this view and all others: a picture that is not black there, and where a patch for it lies
    ///
    /// The picture is as large as the photograph. Behind @ stands how far right and down of the part the patch lies, in pixels of
    /// the photograph; without, what is around the part fills it. May be given many times. Repaints are kept in the scene and are made
    /// again with the hole; those that are the last ones already are not added. A scene that is there needs no mask for it.
    #[arg(long, value_name = "NAME=FILE[@dx,dy]", value_parser = repaint)]
    repaint: Vec<Repaint>,
    /// Take the last repaint back
    #[arg(long, conflicts_with = "repaint")]
    undo_repaint: bool,
}

impl RepaintArgs {
    /// For the request.
    pub fn wish(&self) -> Wish {
        if self.undo_repaint { Wish::Undo } else { Wish::With(self.repaint.clone()) }
    }
}

/// How photographs are taken out of a video.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(super) struct VideoArgs {
    /// Frames of a video at most, the sharpest of pieces of one length
    #[arg(long, value_name = "N", default_value_t = 120, value_parser = clap::value_parser!(u32).range(3..=1000))]
    frames: u32,
}

impl VideoArgs {
    /// The folder of the photographs: `given`, or that of its frames below `out`, where it is a video.
    pub fn photographs(self, given: &Path, out: &Path) -> anyhow::Result<PathBuf> {
        if !video::is_video(given) {
            return Ok(given.to_owned());
        }
        signals::listen()?;
        Ok(video::frames(given, self.frames, out, &mut Bars::default())?)
    }
}

/// What happens to the object's shadow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
enum Shadow {
    /// Where one is found on the surface that the object stands on, training sees the photographs without it
    #[default]
    Remove,
    /// Left as it is
    Keep,
}

/// See [`PosesArgs`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
enum Poses {
    /// Once there are masks they are judged by what is around the object: parts of a model that the object has folded, for it looks
    /// alike from two sides, are turned about it where what it stands on proves it
    #[default]
    Again,
    /// They stay as the model has them
    Given,
}

#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub(super) struct PosesArgs {
    /// Whether the cameras' poses are judged again
    #[arg(long, value_name = "WHAT", value_enum, default_value_t = Poses::Again)]
    poses: Poses,
}

impl PosesArgs {
    /// For the request.
    pub fn again(self) -> bool {
        self.poses == Poses::Again
    }
}

#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub(super) struct ShadowArgs {
    /// What to do about the shadow that the object casts on the surface it stands on
    #[arg(long, value_name = "WHAT", value_enum, default_value_t = Shadow::Remove)]
    shadow: Shadow,
}

impl ShadowArgs {
    /// For the request.
    pub fn answer(self) -> Answer {
        match self.shadow {
            Shadow::Remove => Answer::Remove,
            Shadow::Keep => Answer::Keep,
        }
    }
}

impl ObjectArgs {
    /// Whether nothing is marked.
    pub fn is_empty(&self) -> bool {
        self.0.iter().all(|object| object.evidence.is_empty())
    }

    /// Names of the views that have a mark.
    pub fn views(&self) -> impl Iterator<Item = &String> {
        self.0.iter().flat_map(|object| object.evidence.iter().map(|(view, _)| view))
    }
}

impl clap::Args for ObjectArgs {
    fn augment_args(command: clap::Command) -> clap::Command {
        Marks::augment_args(command)
    }
    fn augment_args_for_update(command: clap::Command) -> clap::Command {
        Marks::augment_args_for_update(command)
    }
}

impl clap::FromArgMatches for ObjectArgs {
    /// A mark is of the object that was named last before it.
    fn from_arg_matches(matches: &clap::ArgMatches) -> Result<Self, clap::Error> {
        let places = |id: &str| matches.indices_of(id).into_iter().flatten();
        let begins: Vec<usize> = places("object").collect();
        let last = |place: usize| begins.iter().filter(|begin| **begin < place).count();
        let Marks { object, mask, bounds, strokes, lasso, click, not } = Marks::from_arg_matches(matches)?;
        let mut all = vec![Object::default()];
        for name in &object {
            if all[1..].iter().all(|other| other.name != *name) {
                all.push(Object { name: name.clone(), delivered: false, ..Object::default() });
            }
        }
        let kinds = [("mask", mask), ("bounds", bounds), ("strokes", strokes), ("lasso", lasso), ("click", click)];
        for (id, marks) in kinds.into_iter().chain([("not", not)]) {
            for (place, mark) in places(id).zip(marks) {
                let name = last(place).checked_sub(1).map_or("", |number| &object[number]);
                all.iter_mut().filter(|object| object.name == name).for_each(|own| own.evidence.push(mark.clone()));
            }
        }
        if let Some(bare) = all[1..].iter().find(|object| object.evidence.is_empty()) {
            let why =
                format!("--object {:?}: nothing marks it; put --mask, --box or another mark behind it\n", bare.name);
            return Err(clap::Error::raw(clap::error::ErrorKind::ValueValidation, why));
        }
        Ok(Self(all))
    }
    fn update_from_arg_matches(&mut self, matches: &clap::ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

fn object_name(text: &str) -> Result<String, String> {
    let name = Object::checked_name(text).ok_or("a name is one line of 1 to 40 characters")?;
    Ok(name.to_owned())
}

fn named(text: &str) -> Result<(String, String), String> {
    let (name, value) = text.split_once('=').ok_or("must be NAME=..., where NAME is a photograph's")?;
    if name.is_empty() || value.is_empty() {
        return Err("must be NAME=..., where NAME is a photograph's".into());
    }
    Ok((name.to_owned(), value.to_owned()))
}

/// A name and a file: of the places where the text may be parted, for a name may have a = in it, the first one behind which the
/// name of a file stands.
fn named_file(text: &str) -> Result<(String, PathBuf), String> {
    let parts = text.match_indices('=').map(|(at, _)| (&text[..at], &text[at + 1..]));
    let found = parts.into_iter().find(|(name, file)| !name.is_empty() && Path::new(file).is_file());
    let found = found.map(|(name, file)| (name.to_owned(), PathBuf::from(file)));
    found.map_or_else(|| named(text).map(|(name, file)| (name, file.into())), Ok)
}

fn mask(text: &str) -> Result<(String, Evidence), String> {
    named_file(text).map(|(name, file)| (name, Evidence::Mask(file)))
}

fn strokes(text: &str) -> Result<(String, Evidence), String> {
    named_file(text).map(|(name, file)| (name, Evidence::Strokes(file)))
}

/// A view's name, a file, and behind an @ that is not of the file's name how far a patch lies from it.
fn repaint(text: &str) -> Result<Repaint, String> {
    let (view, file) = named_file(text)?;
    let numbers = text.rsplit_once('@').filter(|_| !file.is_file());
    let number = |word: &str| word.trim().parse::<i32>().ok();
    let offset = |(_, by): (&str, &str)| by.split_once(',').and_then(|(x, y)| Some([number(x)?, number(y)?]));
    let Some((before, offset)) = numbers.map(|numbers| (numbers.0, offset(numbers))) else {
        return Ok(Repaint { view, brush: file, offset: None });
    };
    let offset =
        offset.ok_or("behind @ stands how far the patch lies right and down, two whole numbers: FILE@-40,0")?;
    named_file(before).map(|(view, brush)| Repaint { view, brush, offset: Some(offset) })
}

/// A view's name and whole numbers of pixels.
fn pixels(text: &str) -> Result<(String, Vec<u32>), String> {
    let (name, numbers) = match text.rsplit_once('=') {
        Some((name, numbers)) if !name.is_empty() && !numbers.is_empty() => (name.to_owned(), numbers.to_owned()),
        _ => named(text)?,
    };
    let number = |word: &str| word.trim().parse().map_err(|_| format!("'{word}' is no whole number of pixels"));
    let numbers = numbers.split(',').map(number).collect::<Result<_, _>>()?;
    Ok((name, numbers))
}

fn bounds(text: &str) -> Result<(String, Evidence), String> {
    let (name, numbers) = pixels(text)?;
    let bounds = numbers.try_into().map_err(|_| "a box is four numbers: x0,y0,x1,y1")?;
    Ok((name, Evidence::Box(bounds)))
}

fn lasso(text: &str) -> Result<(String, Evidence), String> {
    let (name, numbers) = pixels(text)?;
    let (points, rest) = numbers.as_chunks::<2>();
    if !rest.is_empty() || !(3..=MOST_POINTS).contains(&points.len()) {
        return Err(format!("a lasso is x and y of 3 to {MOST_POINTS} corners: x,y,x,y,x,y,..."));
    }
    Ok((name, Evidence::Lasso(points.to_vec())))
}

/// A view's name and one of its pixels.
fn pixel(text: &str) -> Result<(String, [u32; 2]), String> {
    let (name, numbers) = pixels(text)?;
    Ok((name, numbers.try_into().map_err(|_| "a pixel is two numbers: x,y")?))
}

fn click(text: &str) -> Result<(String, Evidence), String> {
    pixel(text).map(|(name, at)| (name, Evidence::Click(at)))
}

fn not(text: &str) -> Result<(String, Evidence), String> {
    pixel(text).map(|(name, at)| (name, Evidence::Not(at)))
}

fn step(text: &str) -> Result<Step, String> {
    let names: Vec<&str> = Step::ALL.iter().map(|step| step.name()).collect();
    Step::ALL.into_iter().find(|step| step.name() == text).ok_or(format!("the steps are {}", names.join(", ")))
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let began = Instant::now();
    let photographs = if video::is_video(&args.photographs) {
        let _lock = Lock::take(&args.out)?;
        args.video.photographs(&args.photographs, &args.out.join(MADE))?
    } else {
        args.photographs.clone()
    };
    let request = Request {
        objects: args.object.0.clone(),
        reference: args.reference.clone(),
        repaint: args.repaint.wish(),
        only: args.only.clone(),
        depth: !args.no_depth,
        again: args.poses.again(),
        shadow: args.shadow.answer(),
        inpaint_model: args.inpaint_model.clone(),
        depth_model: args.depth_model.clone(),
        fit_steps: args.fit_steps,
        fit_side: args.fit_side,
        seed: args.seed.into(),
        ..Request::new(photographs, &args.out)
    };
    args.device.with_gpu(|gpu| {
        signals::listen()?;
        Ok(prepare::prepare(gpu, &request, &mut Bars::default())?)
    })?;
    println!("{}: ready after {:.0} s", args.out.display(), began.elapsed().as_secs_f64());
    next::say(&[
        (next::command(&["doctor"], &args.out), "looks it over; --sheet DIR draws all masks"),
        (next::command(&["train"], &args.out), "trains it without its object"),
    ]);
    Ok(())
}

/// Where a scene has what `prepare` made for itself.
const MADE: &str = "prepare";

/// A bar for each step.
#[derive(Default)]
pub(super) struct Bars {
    bar: Option<ProgressBar>,
    step: Option<(Step, Instant)>,
}

impl Drop for Bars {
    /// A step that failed has not ended its bar.
    fn drop(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
    }
}

impl Watch for Bars {
    fn begin(&mut self, step: Step, units: u64) {
        let style = ProgressStyle::with_template("{msg:>9} {wide_bar} {pos}/{len}, {eta} left")
            .unwrap_or_else(|_| ProgressStyle::default_bar());
        let bar = ProgressBar::new(units).with_style(style).with_message(step.name());
        bar.enable_steady_tick(Duration::from_millis(250));
        (self.bar, self.step) = (Some(bar), Some((step, Instant::now())));
    }

    fn at(&mut self, unit: u64) {
        if let Some(bar) = &self.bar {
            bar.set_position(unit);
        }
    }

    fn end(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
        if let Some((step, began)) = self.step.take() {
            eprintln!("{}: {:.1} s", step.name(), began.elapsed().as_secs_f64());
        }
    }

    fn say(&mut self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{line}")),
            None => eprintln!("{line}"),
        }
    }

    fn interrupted(&mut self) -> Option<Signal> {
        signals::caught()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A photograph may be called `x=y`, and a mask's file, too.
    #[test]
    fn names_may_have_an_equals_sign() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let file = folder.path().join("a=b.png");
        std::fs::write(&file, "").expect("writable");
        let path = file.display();
        assert_eq!(mask(&format!("x=y={path}")), Ok(("x=y".into(), Evidence::Mask(file.clone()))));
        assert_eq!(mask(&format!("x={path}")), Ok(("x".into(), Evidence::Mask(file.clone()))));
        assert_eq!(mask("x=not/there.png"), Ok(("x".into(), Evidence::Mask("not/there.png".into()))));
        assert_eq!(pixels("x=y=1,2"), Ok(("x=y".into(), vec![1, 2])));
        assert!(mask("x").is_err() && mask("=a.png").is_err() && pixels("x=").is_err());
    }

    /// Marks of every kind are, however often an object is named.
    #[test]
    fn a_mark_is_of_the_object_named_last_before_it() {
        #[derive(clap::Parser)]
        struct Line {
            #[command(flatten)]
            object: ObjectArgs,
        }
        let of = |line: &str| {
            let parsed = <Line as clap::Parser>::try_parse_from(line.split(' '));
            parsed.map(|line| {
                line.object.0.into_iter().map(|own| (own.name, own.evidence.len(), own.delivered)).collect()
            })
        };
        let objects = |all: &[(&str, usize)]| -> Vec<(String, usize, bool)> {
            all.iter().map(|(name, marks)| ((*name).to_owned(), *marks, name.is_empty())).collect()
        };
        let read = |line: &str| -> Vec<(String, usize, bool)> { of(line).expect(line) };
        assert_eq!(read("prepare --click a=1,2 --mask a:b=c.png"), objects(&[("", 2)]));
        let line = "prepare --click a=1,2 --object pot --box b=1,2,3,4 --click b=2,3 --object=ball --click=a=3,4";
        assert_eq!(read(line), objects(&[("", 1), ("pot", 2), ("ball", 1)]));
        let again = format!("{line} --object pot --not b=1,1");
        assert_eq!(read(&again), objects(&[("", 1), ("pot", 3), ("ball", 1)]));
        let why = of("prepare --object pot --object ball --click a=1,2").unwrap_err().to_string();
        assert!(why.contains("--object \"pot\": nothing marks it"), "{why}");
        assert!(of("prepare --object= --click a=1,2").is_err());
    }
}
