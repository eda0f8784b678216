//! Learning rates over the steps.

/// A learning rate that falls (or rises) log-linearly.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate {
    /// At step 0.
    pub initial: f64,
    /// At the last step and after it.
    pub last: f64,
}

impl Rate {
    /// The same rate at every step.
    pub fn constant(rate: f64) -> Self {
        Self { initial: rate, last: rate }
    }

    /// From `initial` to `last`.
    pub fn falling(initial: f64, last: f64) -> Self {
        Self { initial, last }
    }

    /// Both ends times `factor`.
    pub fn scaled(self, factor: f64) -> Self {
        Self { initial: self.initial * factor, last: self.last * factor }
    }

    /// The rate at `step` of `steps`.
    pub fn at(self, step: u32, steps: u32) -> f64 {
        learning_rate(step, self.initial, self.last, steps)
    }
}

/// `exp(lerp(ln initial, ln last, step / steps))`, the share clamped to 0..1; zero where both ends are zero.
///
/// One end alone at zero gives the other end's side of the limit: `last` exactly at the end, `initial` exactly at the
/// start, zero between. No steps at all means the end.
pub fn learning_rate(step: u32, initial: f64, last: f64, steps: u32) -> f64 {
    if initial == last {
        return initial;
    }
    let t = if step >= steps { 1.0 } else { f64::from(step) / f64::from(steps) };
    if t == 0.0 {
        initial
    } else if t == 1.0 {
        last
    } else {
        (initial.ln() * (1.0 - t) + last.ln() * t).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_are_exact() {
        let rate = Rate::falling(0.01, 0.0001);
        assert_eq!(rate.at(0, 100), 0.01);
        assert_eq!(rate.at(100, 100), 0.0001);
        assert_eq!(rate.at(1000, 100), 0.0001);
        assert!((rate.at(50, 100) - 0.001).abs() < 1e-18);
        assert_eq!(Rate::constant(0.0).at(3, 100), 0.0);
        assert_eq!(Rate::falling(0.1, 0.0).at(50, 100), 0.0);
        assert_eq!(rate.at(0, 0), 0.0001);
    }
}
