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

/// The groups of parameters that share a rate, by name.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Schedule {
    /// Steps over which the rates fall.
    pub steps: u32,
    /// Name and rate, in the order of the passes.
    pub groups: Vec<(&'static str, Rate)>,
}

impl Schedule {
    /// The rates of the GScream release for SPIn-NeRF scenes; `radius` is 1.1 times the largest distance of a camera
    /// from the mean camera, scene units.
    pub fn gscream(radius: f64, steps: u32) -> Self {
        let groups = vec![
            ("position", Rate::constant(0.0)),
            ("feature", Rate::constant(0.0075)),
            ("offset", Rate::falling(0.01, 0.0001).scaled(radius)),
            ("log_scaling", Rate::constant(0.007)),
            ("mlp_opacity", Rate::falling(0.002, 0.00002)),
            ("mlp_cov", Rate::constant(0.004)),
            ("mlp_color", Rate::falling(0.008, 0.00005)),
            ("attention", Rate::falling(0.002, 0.00002)),
        ];
        Self { steps, groups }
    }

    /// A group's rate at a step; `None` for a name that is not in the table.
    pub fn at(&self, group: &str, step: u32) -> Option<f64> {
        self.groups.iter().find(|(name, _)| *name == group).map(|(_, rate)| rate.at(step, self.steps))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_of_all_groups() {
        let schedule = Schedule::gscream(2.5, 30_000);
        let mut table = format!("{:<12}", "step");
        for (name, _) in &schedule.groups {
            table += &format!(" {name:>16}");
        }
        for step in [0, 1, 1500, 15_000, 30_000, 40_000] {
            table += &format!("\n{step:<12}");
            for (_, rate) in &schedule.groups {
                table += &format!(" {:>16.10e}", rate.at(step, schedule.steps));
            }
        }
        insta::assert_snapshot!(table);
    }

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
        assert_eq!(Schedule::gscream(1.0, 10).at("nobody", 3), None);
    }
}
