//! Milliseconds per pass from timestamp queries.

use std::collections::BTreeMap;

/// One pass of one submission.
#[derive(Clone, Copy, Debug)]
pub struct Timing {
    /// The pass.
    pub name: &'static str,
    /// Start, nanoseconds on the device's clock.
    pub start: f64,
    /// Duration in nanoseconds.
    pub duration: f64,
}

/// Sums of pass durations over many submissions.
#[derive(Clone, Debug, Default)]
pub struct Timings {
    passes: BTreeMap<&'static str, (u64, f64)>,
    submissions: u64,
}

impl Timings {
    /// Adds one submission's passes.
    pub fn add(&mut self, timings: &[Timing]) {
        self.submissions += 1;
        for t in timings {
            let entry = self.passes.entry(t.name).or_default();
            entry.0 += 1;
            entry.1 += t.duration;
        }
    }

    /// `(pass, calls, milliseconds per submission)`, the costliest first.
    pub fn per_submission(&self) -> Vec<(&'static str, u64, f64)> {
        let n = self.submissions.max(1) as f64;
        let mut rows: Vec<_> = self.passes.iter().map(|(name, (calls, ns))| (*name, *calls, ns / n / 1e6)).collect();
        rows.sort_by(|a, b| b.2.total_cmp(&a.2));
        rows
    }

    /// The rows as an aligned table.
    pub fn table(&self) -> String {
        let rows = self.per_submission();
        let total: f64 = rows.iter().map(|r| r.2).sum();
        let mut text = format!("{:<40} {:>10} {:>10} {:>7}\n", "pass", "calls", "ms/step", "share");
        for (name, calls, ms) in rows {
            let share = if total > 0.0 { 100.0 * ms / total } else { 0.0 };
            text.push_str(&format!("{name:<40} {calls:>10} {ms:>10.3} {share:>6.1}%\n"));
        }
        text.push_str(&format!("{:<40} {:>10} {total:>10.3}\n", "sum", self.submissions));
        text
    }
}
