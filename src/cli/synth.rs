use std::path::PathBuf;

use super::next;
use crate::scene::synthetic;

/// Write a synthetic scene: a textured room, an object to remove, and everything known about it
///
/// The folder gets photographs, masks, depth priors, an inpainted reference view, test views without the object and a
/// COLMAP model, in the plain layout that the README describes. The same options give the same files.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  gscream-vk synth scene
  gscream-vk synth big --width 640 --height 480 --train-views 60 --points 40000")]
pub(super) struct Args {
    /// Folder to write, new or empty
    dir: PathBuf,
    /// Seed of textures, cameras, points and noise
    #[arg(long, value_name = "N", default_value_t = synthetic::Options::default().seed)]
    seed: u64,
    /// Width of the pictures, pixels
    #[arg(long, value_name = "PIXELS", default_value_t = synthetic::Options::default().width,
        value_parser = clap::value_parser!(u32).range(16..=16384))]
    width: u32,
    /// Height of the pictures, pixels
    #[arg(long, value_name = "PIXELS", default_value_t = synthetic::Options::default().height,
        value_parser = clap::value_parser!(u32).range(16..=16384))]
    height: u32,
    /// Views with the object; the middle one is the reference view
    #[arg(long, value_name = "N", default_value_t = synthetic::Options::default().train_views,
        value_parser = clap::value_parser!(u32).range(1..))]
    train_views: u32,
    /// Views without the object
    #[arg(long, value_name = "N", default_value_t = synthetic::Options::default().test_views)]
    test_views: u32,
    /// Points of the sparse model
    #[arg(long, value_name = "N", default_value_t = synthetic::Options::default().points,
        value_parser = clap::value_parser!(u32).range(1..))]
    points: u32,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let Args { ref dir, seed, width, height, train_views, test_views, points } = *args;
    synthetic::write(dir, &synthetic::Options { seed, width, height, train_views, test_views, points })?;
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
