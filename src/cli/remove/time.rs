//! The time of a whole removal: `--minutes N` counts from Remove, or from the command, to the files.
//!
//! The number of views tells what a part takes ([`COSTS`], after captures of 24, 60 and 96 views), and as soon as the masks are
//! there, so does the pace that was measured. Training has what the others leave ([`crate::cli::minutes`]).

use std::cell::Cell;
use std::path::Path;
use std::time::Instant;

use anyhow::bail;

use crate::cli::minutes::{Reserve, least};
use crate::model::config::Form;
use crate::prepare::record;

/// The processors' time for a part, in seconds: of itself, and for each view.
struct Cost {
    part: &'static str,
    once: f64,
    view: f64,
}

const fn cost(part: &'static str, once: f64, view: f64) -> Cost {
    Cost { part, once, view }
}

/// The parts in their order, with the fit and the files of the usual steps. Training's is the least worth the name.
const COSTS: [Cost; 9] = [
    cost("poses", 0.3, 0.02),
    cost("fit", 6.0, 1.0),
    cost("masks", 1.0, 0.7),
    cost("shadow", 1.0, 0.15),
    cost("depth", 0.3, 0.1),
    cost("reference", 5.0, 1.8),
    cost("points", 4.0, 0.6),
    cost("train", 8.0, 0.1),
    cost("export", 45.0, 0.8),
];
/// Cores that are busy on the mean, of those there are.
const BUSY: f64 = 0.8;
/// A removal is refused once this share of what is left, as it is told before, does not fit any more: it may go faster.
const SURE: f64 = 0.5;
/// Steps of training that the files take for each step of their refinement, for baking and measuring them, and seconds besides.
const REFINED: f64 = 0.6;
const BAKED: f64 = 200.0;
const WRITTEN: f64 = 3.0;
/// Training has this part of the time, even if it is over: by so much `--minutes` may be missed, and without it all was in vain.
const LATE: f64 = 0.1;

/// The size of a removal.
#[derive(Clone, Copy, Default)]
pub struct Work {
    /// Views.
    pub views: usize,
    /// Steps of the fit in the usual number.
    pub fit: f64,
    /// Steps of the refinement of the files in the usual number.
    pub files: f64,
    /// Photographs are replaced by a splat, which is fit and points itself.
    pub splat: bool,
    /// The form of what is trained: anchors are baked into the files.
    pub form: Form,
}

/// The time that a removal has, and where it is in it.
pub struct Time {
    minutes: Option<f64>,
    work: Work,
    /// When the work began, if it has.
    began: Cell<Option<Instant>>,
    /// The part that is going on, and since when.
    part: Cell<Option<(usize, Instant)>>,
    /// The first part that has not begun.
    next: Cell<usize>,
    /// Seconds that parts took, and the processors' time by [`COSTS`].
    measured: Cell<[f64; 2]>,
    /// Parts that are there already.
    there: Cell<[bool; COSTS.len()]>,
}

impl Time {
    /// Of a removal that has not begun.
    pub fn new(minutes: Option<f64>, work: Work) -> Self {
        Self {
            minutes,
            work,
            began: Cell::default(),
            part: Cell::default(),
            next: Cell::default(),
            measured: Cell::default(),
            there: Cell::default(),
        }
    }

    /// The work began then; what there is of the scene at `path` need not be made. Says what takes how long, where there is a
    /// limit.
    ///
    /// # Errors
    /// One sentence, where it cannot be done in that time.
    pub fn start(&self, began: Instant, scene: &Path) -> anyhow::Result<()> {
        self.began.set(Some(began));
        let ended = record::ended(scene);
        self.next.set(0);
        self.there.set(COSTS.each_ref().map(|cost| ended.contains_key(cost.part)));
        let Some(minutes) = self.minutes else { return Ok(()) };
        if let Some(refused) = self.refusal(self.gone(), 0) {
            bail!(refused);
        }
        eprintln!("{}", self.described(minutes));
        Ok(())
    }

    /// When the work began; now, where it has not.
    pub fn began(&self) -> Instant {
        self.began.get().unwrap_or_else(Instant::now)
    }

    fn gone(&self) -> f64 {
        self.began().elapsed().as_secs_f64()
    }

    fn described(&self, minutes: f64) -> String {
        let sum = |parts: std::ops::Range<usize>| parts.map(|part| self.forecast(part)).sum::<f64>() / 60.0;
        let [prepare, points, files] = [sum(0..6), sum(6..7), sum(8..9)];
        let left = (minutes - prepare - points - files).max(0.0);
        format!(
            "plan: of {minutes} min prepare has about {prepare:.1}, stereo {points:.1} and the files {files:.1}, a guess until it \
             is measured, and training what is left, {left:.1}"
        )
    }

    /// Seconds of a part, as far as is known; none where it is there.
    fn forecast(&self, part: usize) -> f64 {
        if self.there.get()[part] { 0.0 } else { self.pace() * self.told(part) }
    }

    /// The processors' time for a part by [`COSTS`].
    fn told(&self, part: usize) -> f64 {
        let Work { views, fit, files, splat, form } = self.work;
        let Cost { part: name, once, view } = COSTS[part];
        let share = match name {
            "fit" | "points" if splat => 0.0,
            "fit" => fit,
            "export" if splat || form == Form::Gaussians => 0.1,
            "export" => 0.3 + 0.7 * files,
            _ => 1.0,
        };
        share * (once + view * views as f64)
    }

    /// Measured time over that of [`COSTS`]; by the number of cores, as long as nothing was measured.
    fn pace(&self) -> f64 {
        let [took, told] = self.measured.get();
        let cores = std::thread::available_parallelism().map_or(2, std::num::NonZero::get);
        if told > 0.0 { took / told } else { 1.0 / (BUSY * cores as f64) }
    }

    /// A part begins.
    pub fn begin(&self, name: &str) {
        let part = COSTS.iter().position(|cost| cost.part == name);
        self.part.set(part.map(|part| (part, Instant::now())));
        self.next.set(part.map_or(self.next.get(), |part| part + 1));
    }

    /// The part has ended.
    pub fn end(&self) {
        if let Some((part, since)) = self.part.take() {
            self.took(part, since.elapsed().as_secs_f64());
        }
    }

    fn took(&self, part: usize, seconds: f64) {
        // Other programs' work, and what goes with the scene's points more than with its views.
        if ["poses", "fit"].contains(&COSTS[part].part) {
            return;
        }
        let [took, told] = self.measured.get();
        self.measured.set([took + seconds, told + self.told(part)]);
    }

    /// Why it is in vain to go on, if it is.
    pub fn in_vain(&self) -> Option<String> {
        self.began.get()?;
        self.refusal(self.gone(), self.next.get())
    }

    /// Whether what is left, from the part `next` on, is too much at `now` seconds after the beginning.
    fn refusal(&self, now: f64, next: usize) -> Option<String> {
        let minutes = self.minutes?;
        let rest: f64 = (next..COSTS.len()).map(|part| self.forecast(part)).sum();
        let gone = format!(", of which {:.1} have gone", now / 60.0);
        let [gone, stays] = if now < 6.0 { ["", ""] } else { [gone.as_str(), "; what is made stays"] };
        let least = least(now + rest);
        (now + SURE * rest > 60.0 * minutes).then(|| {
            format!(
                "--minutes {minutes}: about {least:.1} min are the least from Remove to the files{gone}: give more time, or fewer \
                 photographs{stays}"
            )
        })
    }

    /// Steps and seconds that the files take, and what training has before them even where the time is over.
    pub fn files(&self) -> Reserve {
        let baked = 1000.0 * self.work.files * REFINED + BAKED;
        Reserve {
            steps: if self.work.form == Form::Anchors { baked } else { 0.0 },
            seconds: WRITTEN,
            training: self.minutes.map_or(0.0, |minutes| LATE * 60.0 * minutes),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn work(views: usize) -> Work {
        Work { views, fit: 1.0, files: 1.0, splat: false, form: Form::Anchors }
    }

    /// A removal of so many views that has begun, on a machine that takes as long as is told.
    fn begun(minutes: f64, views: usize) -> Time {
        let time = Time::new(Some(minutes), work(views));
        time.began.set(Some(Instant::now()));
        time.measured.set([10.0, 10.0]);
        time
    }

    fn all(time: &Time, from: usize) -> f64 {
        (from..COSTS.len()).map(|part| time.forecast(part)).sum()
    }

    #[test]
    fn parts_are_those_of_the_work() {
        let steps = crate::prepare::Step::ALL.map(|step| step.name());
        assert_eq!(COSTS.each_ref().map(|cost| cost.part)[..6], steps[..6]);
    }

    /// The least that a refusal names is enough, and what is surely too little is refused at any time.
    #[test]
    fn what_is_refused_names_what_is_enough() {
        for (views, gone, next) in [(24, 0.0, 0), (185, 0.0, 0), (185, 60.0, 2), (60, 300.0, 7)] {
            let refused = |minutes: f64| begun(minutes, views).refusal(gone, next);
            let why = refused(0.01).expect("hundredths of a minute are too little");
            let words: Vec<&str> = why.split_whitespace().collect();
            assert!(
                words[..3] == ["--minutes", "0.01:", "about"] && !why.contains('\n') && !why.contains(". "),
                "{why}"
            );
            let least: f64 = words[3].parse().expect("a number");
            assert_eq!(refused(least), None, "{views} views");
            let rest = all(&begun(1.0, views), next);
            assert!(60.0 * least >= gone + rest && 60.0 * least < gone + rest + 6.1, "{why}");
            assert!(refused((gone + 0.4 * rest) / 60.0).is_some(), "{views} views");
        }
    }

    /// A machine that is three times as slow takes three times as long; parts that are there take no time.
    #[test]
    fn what_is_measured_counts() {
        let time = begun(4.0, 50);
        let told = all(&time, 2);
        let [took, as_told] = time.measured.get();
        time.measured.set([3.0 * took, as_told]);
        assert!((all(&time, 2) / told - 3.0).abs() < 1e-9);
        time.took(2, 3.0 * (COSTS[2].once + 50.0 * COSTS[2].view));
        assert!((time.pace() - 3.0).abs() < 1e-9, "{}", time.pace());
        let before = all(&time, 0);
        time.there.set([true, true, false, false, false, false, false, false, false]);
        assert!(all(&time, 0) < before && all(&time, 0) == all(&time, 2));
    }

    /// Before Remove is pressed, and without a limit, there is no hurry.
    #[test]
    fn nothing_is_in_vain_without_a_limit() {
        let work = work(500);
        let time = Time::new(Some(0.001), work);
        assert_eq!(time.in_vain(), None);
        time.began.set(Some(Instant::now()));
        assert!(time.in_vain().is_some());
        let time = Time::new(None, work);
        time.began.set(Some(Instant::now()));
        assert_eq!(time.in_vain(), None);
        time.start(Instant::now(), Path::new("nowhere")).expect("there is no limit");
    }

    /// Of a splat there is nothing to fit, and of plain Gaussians nothing to refine.
    #[test]
    fn a_splat_takes_less() {
        let photographs = begun(4.0, 60);
        let of = |work: Work| {
            let time = Time::new(Some(4.0), work);
            time.measured.set(photographs.measured.get());
            time
        };
        let gaussians = of(Work { form: Form::Gaussians, ..photographs.work });
        let splat = of(Work { splat: true, ..photographs.work });
        assert!(all(&gaussians, 0) < all(&photographs, 0) && all(&splat, 0) < all(&gaussians, 0));
        assert!(photographs.files().steps > 0.0 && gaussians.files().steps == 0.0);
    }
}
