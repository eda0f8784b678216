//! One record against an older one.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Device, Record, digits};
use crate::lab::report::SceneFacts;
use crate::lab::statistics::Spread;

/// Why two records cannot be compared.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: std::io::Error,
    },
    /// Not one of ours.
    #[error("{}: is no record of `bench` ({what}): name the bench.json of an earlier run", path.display())]
    Form {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// Not the same subject.
    #[error(
        "{}: was measured {theirs}, this run is {ours}: times of the two say nothing about each other; {hint}",
        path.display()
    )]
    Other {
        /// The file.
        path: PathBuf,
        /// Its own.
        theirs: String,
        /// This run's.
        ours: String,
        /// What to do.
        hint: &'static str,
    },
}

/// Reads a record.
///
/// # Errors
/// A file that cannot be read, or is none.
pub fn read(path: &Path) -> Result<Record, Error> {
    let text = std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
    serde_json::from_str(&text).map_err(|error| Error::Form { path: path.to_owned(), what: error.to_string() })
}

/// What a run will measure.
#[derive(Clone, Copy, Debug)]
pub struct Subject<'a> {
    /// On which device.
    pub device: &'a Device,
    /// On which scene.
    pub scene: &'a SceneFacts,
    /// With which settings.
    pub settings: &'a Value,
    /// Behind how many steps.
    pub warm_up: u32,
    /// The step.
    pub step: u32,
}

/// The first setting that both have and that differs: its name and the two values.
fn different(old: &Value, new: &Value, name: &str) -> Option<(String, String, String)> {
    match (old, new) {
        (Value::Object(old), Value::Object(new)) => old.iter().find_map(|(key, old)| {
            let name = if name.is_empty() { key.clone() } else { format!("{name}.{key}") };
            different(old, new.get(key)?, &name)
        }),
        _ if old == new => None,
        // A file's 1e-15 may be read as its neighbour.
        _ => match (old.as_f64(), new.as_f64()) {
            (Some(a), Some(b)) if (a - b).abs() <= 1e-12 * a.abs() => None,
            _ => Some((name.to_owned(), old.to_string(), new.to_string())),
        },
    }
}

/// Settings that one of the two does not have: another version of the program.
fn missing(old: &Value, new: &Value, name: &str, found: &mut Vec<String>) {
    let (Value::Object(a), Value::Object(b)) = (old, new) else { return };
    let named = |key: &str| if name.is_empty() { key.to_owned() } else { format!("{name}.{key}") };
    for (key, value) in a {
        match b.get(key) {
            Some(other) => missing(value, other, &named(key), found),
            None => found.push(named(key)),
        }
    }
    found.extend(b.keys().filter(|key| !a.contains_key(*key)).map(|key| named(key)));
}

/// Refuses a record of another device, scene, state or of other settings; says what differs without mattering.
///
/// # Errors
/// [`Error::Other`].
pub fn ensure_comparable(path: &Path, old: &Record, new: Subject<'_>) -> Result<Vec<String>, Error> {
    let other = |theirs: String, ours: String, hint| Err(Error::Other { path: path.to_owned(), theirs, ours, hint });
    if old.device.name != new.device.name {
        let hint = "choose the same with --device";
        return other(format!("on {}", old.device.name), format!("on {}", new.device.name), hint);
    }
    let scene = |s: &SceneFacts| {
        format!(
            "on {} ({} x {}, {} views, {} points, {} masks, {} priors)",
            s.name, s.size[0], s.size[1], s.train_views, s.points, s.masks, s.priors
        )
    };
    let (theirs, ours) = (scene(&old.scene), scene(new.scene));
    if theirs != ours {
        return other(theirs, ours, "measure the same scene");
    }
    if let Some((name, theirs, ours)) = different(&old.settings, new.settings, "") {
        let hint = "give the same settings, or measure again with these";
        return other(format!("with {name} = {theirs}"), format!("with {name} = {ours}"), hint);
    }
    let state = |warm_up: u32, step: u32| format!("at step {step} behind {warm_up} steps of warm-up");
    let (theirs, ours) = (state(old.warm_up, old.step.step), state(new.warm_up, new.step));
    if theirs != ours {
        return other(theirs, ours, "give the same --warm-up and --step");
    }
    let mut notes = vec![];
    if old.device.driver != new.device.driver {
        notes.push(format!("the driver was {}, and is {} now", old.device.driver, new.device.driver));
    }
    let mut names = vec![];
    missing(&old.settings, new.settings, "", &mut names);
    if !names.is_empty() {
        notes.push(format!("settings that only one of the two has: {}", names.join(", ")));
    }
    Ok(notes)
}

/// A time then and now.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Change {
    /// A ceiling, a pass, or the whole.
    pub name: String,
    /// Median then; absent for what is new.
    pub old: Option<f64>,
    /// Median now; absent for what is gone.
    pub new: Option<f64>,
    /// Now in terms of then.
    pub ratio: Option<f64>,
    /// The ratio if then's upper and now's lower quartile were the medians, and the other way round.
    pub range: Option<[f64; 2]>,
}

impl Change {
    fn of(name: &str, old: Option<&Spread>, new: Option<&Spread>) -> Self {
        let both = old.zip(new).filter(|(old, _)| old.median > 0.0 && old.lower > 0.0);
        Self {
            name: name.to_owned(),
            old: old.map(|s| s.median),
            new: new.map(|s| s.median),
            ratio: both.map(|(old, new)| new.median / old.median),
            range: both.map(|(old, new)| [new.lower / old.upper, new.upper / old.lower]),
        }
    }
}

/// Everything that both records have: ceilings, passes by how much they cost then or now, the whole step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// What differs between the two runs without making them incomparable.
    pub notes: Vec<String>,
    /// The device, then and now: what else the machine did shows here.
    pub ceilings: Vec<Change>,
    /// Milliseconds of the step's passes.
    pub passes: Vec<Change>,
    /// Milliseconds of the whole step, and of the host's part.
    pub whole: Vec<Change>,
}

/// Compares two records that [`ensure_comparable`] lets through.
pub fn compare(old: &Record, new: &Record, notes: Vec<String>) -> Comparison {
    let (then, now) = (old.ceilings.rows(), new.ceilings.rows());
    let ceilings = then
        .iter()
        .zip(&now)
        .map(|((name, unit, old), (.., new))| Change::of(&format!("{name}, {unit}"), Some(old), Some(new)));
    let (old, new) = (&old.step, &new.step);
    let then = |name: &str| old.passes.iter().find(|p| p.pass == name).map(|p| &p.milliseconds);
    let now = |name: &str| new.passes.iter().find(|p| p.pass == name).map(|p| &p.milliseconds);
    let mut names: Vec<&str> = new.passes.iter().map(|p| p.pass.as_str()).collect();
    names.extend(old.passes.iter().map(|p| p.pass.as_str()).filter(|name| now(name).is_none()));
    let mut passes: Vec<Change> = names.into_iter().map(|name| Change::of(name, then(name), now(name))).collect();
    let most = |c: &Change| c.old.unwrap_or(0.0).max(c.new.unwrap_or(0.0));
    passes.sort_by(|a, b| most(b).total_cmp(&most(a)));
    let whole = vec![
        Change::of("between passes: barriers", Some(&old.between), Some(&new.between)),
        Change::of("total", Some(&old.total), Some(&new.total)),
        Change::of("host: recording", Some(&old.host.recording), Some(&new.host.recording)),
        Change::of("host: submission", Some(&old.host.submission), Some(&new.host.submission)),
        Change::of("host: waiting", Some(&old.host.waiting), Some(&new.host.waiting)),
    ];
    Comparison { notes, ceilings: ceilings.collect(), passes, whole }
}

impl std::fmt::Display for Comparison {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for note in &self.notes {
            writeln!(f, "note: {note}")?;
        }
        writeln!(
            f,
            "{:<42} {:>10} {:>10} {:>8}  range by quartiles",
            "against the older record", "then", "now", "ratio"
        )?;
        for change in self.ceilings.iter().chain(&self.passes).chain(&self.whole) {
            let or = |value: Option<f64>| value.map_or("-".to_owned(), digits);
            let range = change.range.map_or(String::new(), |[low, high]| format!("{}..{}", digits(low), digits(high)));
            let line = format!(
                "{:<42} {:>10} {:>10} {:>8}  {range}",
                change.name,
                or(change.old),
                or(change.new),
                or(change.ratio)
            );
            writeln!(f, "{}", line.trim_end())?;
        }
        Ok(())
    }
}
