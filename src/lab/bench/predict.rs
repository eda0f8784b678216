//! What a step would take on devices that are not at hand, on paper: what every pass has to do, as it was counted here,
//! at the peaks that are published for them.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::ceilings::Rates;
use super::digits;
use super::step::{Bound, StepFigures, floor};

/// The list that comes with the program, by this word.
pub const PUBLISHED: &str = "published";

/// Why there are no peaks to predict from.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file.
    #[error("{}: cannot be read: {source}; `{PUBLISHED}` names the list that comes with the program", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's words.
        source: std::io::Error,
    },
    /// What stands in it.
    #[error("{}: {what}; src/lab/bench/peaks.toml of the sources shows the form", path.display())]
    Form {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
}

/// What is published for a device, and what is assumed of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Peak {
    /// What it is called.
    pub name: String,
    /// 1e9 bytes per second of its memory.
    pub bandwidth: f64,
    /// 1e9 fused multiply-adds of float32 per second.
    pub multiply_adds: f64,
    /// 1e9 exponentials per second.
    pub exponentials: f64,
    /// Microseconds of a dispatch.
    pub dispatch: f64,
    /// Microseconds of a barrier.
    pub barrier: f64,
    /// Share of these rates that kernels reach, at least and at most, above 0 and up to 1.
    pub reached: [f64; 2],
}

impl Peak {
    /// Where kernels reach this share of the peaks.
    fn rates(&self, reached: f64) -> Rates {
        Rates {
            bandwidth: reached * self.bandwidth,
            operations: reached * self.multiply_adds,
            exponentials: reached * self.exponentials,
            dispatch: 1e-3 * self.dispatch,
        }
    }

    fn validate(&self) -> Result<(), String> {
        let Self { name, bandwidth, multiply_adds, exponentials, dispatch, barrier, reached } = self;
        let above = [("bandwidth", bandwidth), ("multiply_adds", multiply_adds), ("exponentials", exponentials)];
        if let Some((key, value)) = above.into_iter().find(|(_, v)| !(v.is_finite() && **v > 0.0)) {
            return Err(format!("{name}: {key} = {value} must be above 0"));
        }
        let times = [("dispatch", dispatch), ("barrier", barrier)];
        if let Some((key, value)) = times.into_iter().find(|(_, v)| !(v.is_finite() && **v >= 0.0)) {
            return Err(format!("{name}: {key} = {value} must be 0 or more"));
        }
        let [least, most] = *reached;
        if !(least > 0.0 && least <= most && most <= 1.0) {
            return Err(format!("{name}: reached = [{least}, {most}] must be above 0, at most 1 and in order"));
        }
        Ok(())
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Peaks {
    gpu: Vec<Peak>,
}

/// Reads a list of peaks: `[[gpu]]` with the fields of [`Peak`]. The word [`PUBLISHED`] is the program's own list.
///
/// # Errors
/// A file that cannot be read, or that holds something else.
pub fn read(path: &Path) -> Result<Vec<Peak>, Error> {
    let text = if path == Path::new(PUBLISHED) {
        include_str!("peaks.toml").to_owned()
    } else {
        std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.to_owned(), source })?
    };
    let form = |what: String| Error::Form { path: path.to_owned(), what };
    let peaks: Peaks = toml::from_str(&text).map_err(|error| form(error.to_string().trim_end().replace('\n', " ")))?;
    if peaks.gpu.is_empty() {
        return Err(form("no device is in it".into()));
    }
    peaks.gpu.iter().try_for_each(Peak::validate).map_err(form)?;
    Ok(peaks.gpu)
}

/// A step on a device that is not at hand.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Prediction {
    /// What it is predicted from.
    pub peak: Peak,
    /// Each pass with a formula, in the record's order: milliseconds per step at least, and what they go by.
    pub passes: Vec<(String, f64, Bound)>,
    /// Passes without a formula, of which nothing is known.
    pub unknown: Vec<String>,
    /// Milliseconds of the barriers of a step.
    pub barriers: f64,
    /// Milliseconds of a step, at least and at most.
    pub step: [f64; 2],
    /// Steps of the training that is meant.
    pub steps: u32,
    /// Minutes of so many steps like this one, at least and at most.
    pub minutes: [f64; 2],
}

/// Predicts a training of `steps` steps that are all like the one measured.
pub fn predict(figures: &StepFigures, steps: u32, peak: &Peak) -> Prediction {
    let [least, most] = peak.reached.map(|reached| peak.rates(reached));
    let barriers = 1e-3 * peak.barrier * figures.barriers;
    let (mut passes, mut unknown, mut step) = (vec![], vec![], [barriers; 2]);
    for pass in &figures.passes {
        match &pass.work {
            Some(work) => {
                let (milliseconds, bound) = floor(work, pass.dispatches, &most);
                step[0] += milliseconds;
                step[1] += floor(work, pass.dispatches, &least).0;
                passes.push((pass.pass.clone(), milliseconds, bound));
            }
            None => unknown.push(pass.pass.clone()),
        }
    }
    let minutes = step.map(|step| step * f64::from(steps) / 60e3);
    Prediction { peak: peak.clone(), passes, unknown, barriers, step, steps, minutes }
}

/// The predictions of one record beside each other: what is at least 2 % of a step somewhere, the rest together.
pub fn text(predictions: &[Prediction]) -> String {
    const SHOWN: f64 = 0.02;
    let Some(first) = predictions.first() else { return String::new() };
    let mut text = String::from(
        "predicted from published peaks, not measured; milliseconds per step at least and what they go by\n",
    );
    let mut row = |name: &str, cells: Vec<(String, &str)>| {
        write!(text, "{name:<42}").expect("a string takes everything");
        for (value, by) in cells {
            write!(text, " {value:>12} {by:<10}").expect("a string takes everything");
        }
        text.truncate(text.trim_end().len());
        text.push('\n');
    };
    let shown: Vec<usize> =
        (0..first.passes.len()).filter(|&i| predictions.iter().any(|p| p.passes[i].1 >= SHOWN * p.step[0])).collect();
    for &i in &shown {
        row(&first.passes[i].0, predictions.iter().map(|p| (digits(p.passes[i].1), p.passes[i].2.name())).collect());
    }
    let rest = |p: &Prediction| {
        p.passes.iter().enumerate().filter(|(i, _)| !shown.contains(i)).map(|(_, pass)| pass.1).sum::<f64>()
    };
    let range = |[least, most]: [f64; 2]| format!("{}..{}", digits(least), digits(most));
    let others = first.passes.len() - shown.len();
    if others > 0 {
        row(&format!("{others} others"), predictions.iter().map(|p| (digits(rest(p)), "")).collect());
    }
    row("barriers", predictions.iter().map(|p| (digits(p.barriers), "")).collect());
    row("step", predictions.iter().map(|p| (range(p.step), "")).collect());
    row(&format!("{} steps, minutes", first.steps), predictions.iter().map(|p| (range(p.minutes), "")).collect());
    let mut heading = format!("{:<42}", "pass");
    for prediction in predictions {
        write!(heading, " {:>12} {:<10}", prediction.peak.name, "").expect("a string takes everything");
    }
    let at = text.find('\n').map_or(0, |at| at + 1);
    text.insert_str(at, &format!("{}\n", heading.trim_end()));
    if !first.unknown.is_empty() {
        writeln!(text, "not counted: {}", first.unknown.join(", ")).expect("a string takes everything");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn peak() -> Peak {
        let name = "a device".into();
        Peak {
            name,
            bandwidth: 8.0,
            multiply_adds: 1.0,
            exponentials: 1.0,
            dispatch: 100.0,
            barrier: 250.0,
            reached: [0.25, 0.5],
        }
    }

    #[test]
    fn a_step_is_the_sum_of_its_passes_and_barriers() {
        let record = super::super::tests::record();
        let prediction = predict(&record.step, 3000, &peak());
        // 8 MB at 4 GB/s, 1 M operations at 0.5 G/s: 2 ms each, or twice that, and 0.1 ms of a dispatch; two barriers of 0.25 ms.
        let close = |got: f64, want: f64| assert!((got - want).abs() < 1e-12 * want, "{got}, not {want}");
        assert_eq!(prediction.passes.len(), 2);
        prediction.passes.iter().for_each(|(_, ms, _)| close(*ms, 2.1));
        close(prediction.barriers, 0.5);
        close(prediction.step[0], 4.7);
        close(prediction.step[1], 8.7);
        close(prediction.minutes[1], 8.7 * 3000.0 / 60e3);
        assert_eq!(prediction.unknown, ["render/unheard_of"]);
        insta::assert_snapshot!(text(&[prediction.clone(), prediction]));
    }

    #[test]
    fn lists_of_peaks_are_read_or_refused() {
        let published = read(Path::new(PUBLISHED)).expect("our own");
        assert_eq!(published.len(), 5);
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("peaks.toml");
        let says = |text: &str| {
            std::fs::write(&path, text).expect("writable");
            read(&path).expect_err(text).to_string()
        };
        let good = toml::to_string(&peak()).expect("TOML");
        let with = |from: &str, to: &str| says(&format!("[[gpu]]\n{}", good.replace(from, to)));
        let refused =
            |says: String, what: &str| assert!(says.contains("peaks.toml: ") && says.contains(what), "{says}");
        refused(says("gpu = []"), "no device is in it");
        refused(says(""), "missing field `gpu`");
        refused(with("bandwidth = 8.0", "bandwidth = 0"), "a device: bandwidth = 0 must be above 0");
        refused(with("barrier = 250.0", "barrier = nan"), "a device: barrier = NaN must be 0 or more");
        let reached = |from: &str| with("reached = [0.25, 0.5]", from);
        refused(reached("reached = [0.25, 1.5]"), "a device: reached = [0.25, 1.5] must be above 0, at most 1");
        refused(reached("reached = [0.75, 0.5]"), "a device: reached = [0.75, 0.5] must be");
        refused(with("dispatch", "despatch"), "unknown field `despatch`");
        let missing = read(&folder.path().join("none.toml")).expect_err("no file").to_string();
        assert!(missing.contains("none.toml: cannot be read: ") && missing.contains("`published`"), "{missing}");
    }
}
