use std::path::PathBuf;

use super::shared::DeviceArgs;
use super::{next, signals};
use crate::compose::{self, Kind};
use crate::scene::{room360, synthetic};

/// Made scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Made {
    /// A textured room seen from one side, as `train synthetic` has it
    Room,
    /// A bare room seen from all around: few points on walls and floor, a railing, exposure that may drift
    Room360,
}

/// Write a synthetic scene: a textured room, an object to remove, and everything known about it
///
/// The folder gets photographs, masks, depth priors, an inpainted reference view, test views without the object and a
/// COLMAP model, in the plain layout that the README describes. The same options give the same files.
///
/// With --into, a made object stands in a real scene instead: on the surface that a pixel of one photograph shows, drawn into
/// every photograph behind whatever is before it there. Its masks are exact and its test views are the photographs as they
/// were, so that removing it can be measured. Depth is measured between the photographs, on a device as for training.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk synth scene
  gscream-vk synth big --width 640 --height 480 --train-views 60 --points 40000
  gscream-vk synth around --scene room360 --exposure-drift 0.05
  gscream-vk synth truth --into garden --stand IMG_0012=2010,1650 --object box --size 0.25 --shadow
  gscream-vk synth truth --into garden --stand IMG_0012=2010,1650 --test-every 8 --truth-reference IMG_0012")]
pub(super) struct Args {
    /// Folder to write, new or empty
    dir: PathBuf,
    /// Which made scene
    #[arg(long, value_name = "SCENE", value_enum, default_value_t = Made::Room, conflicts_with = "into")]
    scene: Made,
    /// Seed of textures, cameras, points and noise, or of the object's shape, texture, turn and light
    #[arg(long, value_name = "N", default_value_t = synthetic::Options::default().seed)]
    seed: u64,
    /// Width of the pictures, pixels [default: 160, of room360 240]
    #[arg(long, value_name = "PIXELS", conflicts_with = "into", value_parser = clap::value_parser!(u32).range(16..=16384))]
    width: Option<u32>,
    /// Height of the pictures, pixels [default: 120, of room360 180]
    #[arg(long, value_name = "PIXELS", conflicts_with = "into", value_parser = clap::value_parser!(u32).range(16..=16384))]
    height: Option<u32>,
    /// Views with the object; the middle one is the reference view [default: 24, of room360 70]
    #[arg(long, value_name = "N", conflicts_with = "into", value_parser = clap::value_parser!(u32).range(1..))]
    train_views: Option<u32>,
    /// Views without the object [default: 6, of room360 14]
    #[arg(long, value_name = "N", conflicts_with = "into")]
    test_views: Option<u32>,
    /// Points of the sparse model [default: 4000, of room360 1500]
    #[arg(long, value_name = "N", conflicts_with = "into", value_parser = clap::value_parser!(u32).range(1..))]
    points: Option<u32>,
    /// Largest change of a train view's brightness in room360, as a share; 0.05 is a few per cent
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, conflicts_with = "into", value_parser = drift)]
    exposure_drift: f64,
    /// Also write what the train views would show without the object, as test views of their names: for bench --hole
    #[arg(long, conflicts_with = "into")]
    bare: bool,

    /// Scene to stand an object in: a folder as `train` reads it; masks are not needed
    #[arg(long, value_name = "SCENE", requires = "stand", help_heading = "An object in a real scene")]
    into: Option<PathBuf>,
    /// Photograph and pixel at which its foot stands
    ///
    /// It stands upright on the plane around that place, or upright as the cameras are where that plane is steeper than 45
    /// degrees.
    #[arg(long, value_name = "VIEW=x,y", requires = "into", value_parser = stand, help_heading = "An object in a real scene")]
    stand: Option<(String, [f64; 2])>,
    /// What stands there
    #[arg(long, value_enum, default_value_t = Kind::Box, requires = "into", help_heading = "An object in a real scene")]
    object: Kind,
    /// Its height where it stands, as a share of the photograph's height
    #[arg(long, value_name = "SHARE", default_value_t = 0.25, requires = "into", value_parser = size,
        help_heading = "An object in a real scene")]
    size: f64,
    /// Let it cast a soft shadow from a lamp obliquely above; shadows/ says how bright each pixel still is, of 255
    #[arg(long, requires = "into", help_heading = "An object in a real scene")]
    shadow: bool,
    /// Photograph that becomes the reference as it was, without the object [default: none]
    #[arg(long, value_name = "VIEW", requires = "into", help_heading = "An object in a real scene")]
    truth_reference: Option<String>,
    /// The first of every so many photographs is a test view alone [default: 0, every photograph is trained on with the object
    /// and tested without it]
    #[arg(
        long,
        value_name = "N",
        default_value_t = 0,
        hide_default_value = true,
        requires = "into",
        help_heading = "An object in a real scene"
    )]
    test_every: u32,
    #[command(flatten)]
    device: DeviceArgs,
}

fn stand(text: &str) -> Result<(String, [f64; 2]), String> {
    let wrong = "must be VIEW=x,y, where VIEW is a photograph's name and x,y a pixel of it";
    let (view, place) = text.rsplit_once('=').filter(|(view, _)| !view.is_empty()).ok_or(wrong)?;
    let (x, y) = place.split_once(',').ok_or(wrong)?;
    let number = |text: &str| text.trim().parse::<f64>().ok().filter(|v| v.is_finite()).ok_or(wrong);
    Ok((view.to_owned(), [number(x)?, number(y)?]))
}

fn within(text: &str, least: f64, most: f64) -> Result<f64, String> {
    let value = text.parse::<f64>().ok().filter(|v| (least..=most).contains(v));
    value.ok_or_else(|| format!("must be a number from {least} to {most}"))
}

fn size(text: &str) -> Result<f64, String> {
    within(text, 0.01, 1.0)
}

fn drift(text: &str) -> Result<f64, String> {
    within(text, 0.0, 0.5)
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let dir = &args.dir;
    if let (Some(into), Some(stand)) = (&args.into, &args.stand) {
        return in_scene(args, into, stand);
    }
    let [width, height, train_views, test_views, points] = match args.scene {
        Made::Room => {
            let synthetic::Options { width, height, train_views, test_views, points, .. } = Default::default();
            [width, height, train_views, test_views, points]
        }
        Made::Room360 => {
            let room360::Options { width, height, train_views, test_views, points, .. } = Default::default();
            [width, height, train_views, test_views, points]
        }
    };
    let [width, height] = [args.width.unwrap_or(width), args.height.unwrap_or(height)];
    let train_views = args.train_views.unwrap_or(train_views);
    let [test_views, points] = [args.test_views.unwrap_or(test_views), args.points.unwrap_or(points)];
    let (seed, exposure_drift) = (args.seed, args.exposure_drift);
    match args.scene {
        Made::Room => {
            let options = synthetic::Options { seed, width, height, train_views, test_views, points };
            synthetic::write(dir, &options)?;
            if args.bare {
                synthetic::write_bare(dir, &options)?;
            }
        }
        Made::Room360 => {
            let options = room360::Options { seed, width, height, train_views, test_views, points, exposure_drift };
            room360::write(dir, &options)?;
            if args.bare {
                room360::write_bare(dir, &options)?;
            }
        }
    }
    println!(
        "{}: {train_views} train views with the object and {test_views} test views without it, {width}x{height}; {points} points",
        dir.display()
    );
    next::say(&[
        (next::command(&["doctor"], dir), "looks it over"),
        (next::command(&["train"], dir), "trains it without its object"),
    ]);
    Ok(())
}

fn in_scene(args: &Args, into: &std::path::Path, (view, pixel): &(String, [f64; 2])) -> anyhow::Result<()> {
    let request = compose::Request {
        into: into.to_owned(),
        out: args.dir.clone(),
        view: view.clone(),
        pixel: *pixel,
        size: args.size,
        kind: args.object,
        seed: args.seed,
        shadow: args.shadow,
        reference: args.truth_reference.clone(),
        test_every: args.test_every,
    };
    signals::listen()?;
    let outcome = args.device.with_gpu(|gpu| {
        let composed = compose::compose(gpu, &request, &|| signals::caught().is_none());
        if matches!(composed, Err(compose::Error::Stopped)) {
            signals::check(|| "nothing was written".into())?;
        }
        Ok(composed?)
    })?;
    let compose::Outcome { train, test, seen, covered, agreed, standing, stand, seconds: [measured, drawn] } = outcome;
    let shadow = if args.shadow { " and its shadow" } else { "" };
    println!(
        "{}: {train} train views with a {}{shadow} and {test} test views without; {seen} photographs show it, on {:.1} % of \
         their pixels",
        args.dir.display(),
        args.object.name(),
        100.0 * covered
    );
    eprintln!("depth: {measured:.1} s, photographs agree on {:.0} % of it; drawing: {drawn:.1} s", 100.0 * agreed);
    let [there, past] = standing;
    if 4 * past > there {
        eprintln!(
            "{past} photographs look past the place where {there} show a surface: in these it floats; the poses do not fit \
             together, or the pixel shows something thin"
        );
    }
    if stand.steep {
        eprintln!("the surface there is steep: it stands upright as the cameras are");
    }
    next::say(&[
        (next::command(&["doctor"], &args.dir), "looks it over"),
        (next::command(&["train"], &args.dir), "trains it without the object"),
    ]);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_read() {
        assert_eq!(stand("a=b/IMG 1=10,20.5"), Ok(("a=b/IMG 1".into(), [10.0, 20.5])));
        for wrong in ["IMG", "=1,2", "IMG=1", "IMG=1,x", "IMG=1,inf", "IMG=1,2,3"] {
            assert!(stand(wrong).is_err(), "{wrong}");
        }
        assert!(size("0").is_err() && size("2").is_err() && size("nan").is_err() && size("0.3") == Ok(0.3));
    }
}
