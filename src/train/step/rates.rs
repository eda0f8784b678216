//! Learning rates of a step.

use crate::config::Settings;
use crate::model::parameter::Parameter;
use crate::optimizer::schedule::Rate;
use crate::optimizer::{Group, adam};

/// Learning rates of one step, by group.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates([f64; Group::ALL.len()]);

impl Rates {
    /// The rates of `step` (counted from 1) for a scene of this radius.
    pub fn at(settings: &Settings, radius: f64, step: u32) -> Self {
        let config = &settings.optimizer;
        let length = settings.train.iterations;
        Self(Group::ALL.map(|group| {
            let factor = if group.goes_with_radius() { radius } else { 1.0 };
            let [initial, last] = config.learning_rate.of(group).map(|rate| rate * factor);
            Rate { initial, last }.at(step, length)
        }))
    }

    /// The rate of a group.
    pub fn of(&self, group: Group) -> f64 {
        self.0[group as usize]
    }

    /// The rates of a parameter's parts; `None` where all are zero.
    ///
    /// # Panics
    /// When the parameter has no group.
    pub(super) fn of_parts(&self, parameter: &Parameter) -> Option<adam::Rates> {
        let parts = &parameter.parts;
        let part = |i: usize| parts.get(i).or(parts.last()).expect("what a step trains belongs to a group");
        let rate = std::array::from_fn(|i| self.of(part(i).group));
        let parts = std::array::from_fn(|i| parts.get(i + 1).map_or(u32::MAX, |part| part.first));
        (rate != [0.0; 3]).then_some(adam::Rates { rate, parts })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// GScream's published rates, for a scene of radius 2.5.
    #[test]
    fn rates_of_all_groups() {
        let settings = Settings::default();
        let mut table = String::from("step");
        for group in Group::ALL {
            table += &format!(" {:>16}", group.name());
        }
        for step in [0, 1, 1500, 15_000, 30_000, 40_000] {
            let rates = Rates::at(&settings, 2.5, step);
            table += &format!("\n{step}");
            for group in Group::ALL {
                table += &format!(" {:>16.10e}", rates.of(group));
            }
        }
        insta::assert_snapshot!(table);
    }
}
