//! How long a row of like pieces of work will still take.

use std::time::{Duration, Instant};

/// Pieces of work of about one length, the first of which begins now.
#[derive(Debug)]
pub struct Pace {
    began: Instant,
    all: usize,
    /// Of those done, how many took no time.
    skipped: usize,
}

impl Pace {
    /// So many pieces.
    pub fn new(all: usize) -> Self {
        Self { began: Instant::now(), all, skipped: 0 }
    }

    /// One piece was done before; it counts among those done, and says nothing of the time.
    pub fn skip(&mut self) {
        self.skipped += 1;
    }

    /// `2 of 8, about 12 min left`, when so many pieces are done and the next begins; without the time before the first
    /// is done, and empty where there is only one.
    pub fn next(&self, done: usize) -> String {
        place(done, self.all, self.skipped, self.began.elapsed())
    }
}

fn place(done: usize, all: usize, skipped: usize, passed: Duration) -> String {
    if all < 2 {
        return String::new();
    }
    let place = format!("{} of {all}", done + 1);
    let taken = done.saturating_sub(skipped);
    if taken == 0 {
        return place;
    }
    let left = passed.as_secs_f64() / taken as f64 * all.saturating_sub(done) as f64;
    format!("{place}, about {} left", duration(left))
}

/// Seconds, minutes or hours in words, such as `12 min`.
pub fn duration(seconds: f64) -> String {
    match seconds {
        s if s < 90.0 => format!("{s:.0} s"),
        s if s < 5400.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_left_follows_what_is_done() {
        let after = |done, all, seconds| place(done, all, 0, Duration::from_secs(seconds));
        assert_eq!(place(5, 9, 5, Duration::from_secs(1)), "6 of 9");
        assert_eq!(place(6, 9, 5, Duration::from_secs(10)), "7 of 9, about 30 s left");
        assert_eq!(after(0, 1, 0), "");
        assert_eq!(after(0, 4, 0), "1 of 4");
        assert_eq!(after(1, 4, 10), "2 of 4, about 30 s left");
        assert_eq!(after(2, 4, 1200), "3 of 4, about 20 min left");
        assert_eq!(after(1, 4, 7200), "2 of 4, about 6.0 h left");
    }
}
