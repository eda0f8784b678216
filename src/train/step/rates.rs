//! Learning rates of a step.

use crate::config::Settings;
use crate::optimizer::schedule::Rate;

/// Learning rates of one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Anchor features.
    pub feature: f64,
    /// Offsets, the scene's radius included.
    pub offset: f64,
    /// Log-scales.
    pub log_scaling: f64,
    /// Opacity, colour and covariance decoder.
    pub decoders: [f64; 3],
    /// Attention's projections.
    pub attention: f64,
}

impl Rates {
    /// The rates of `step` (counted from 1) for a scene of this radius.
    pub fn at(settings: &Settings, radius: f64, step: u32) -> Self {
        let config = &settings.optimizer;
        let length = if config.schedule_length == 0 { settings.train.iterations } else { config.schedule_length };
        let at = |[initial, last]: [f64; 2]| Rate { initial, last }.at(step, length);
        let rates = &config.learning_rate;
        Self {
            feature: at(rates.feature),
            offset: at(rates.offset.map(|r| r * radius)),
            log_scaling: at(rates.log_scaling),
            decoders: [at(rates.mlp_opacity), at(rates.mlp_color), at(rates.mlp_cov)],
            attention: at(rates.attention),
        }
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
        for name in ["feature", "offset", "log_scaling", "mlp_opacity", "mlp_color", "mlp_cov", "attention"] {
            table += &format!(" {name:>16}");
        }
        for step in [0, 1, 1500, 15_000, 30_000, 40_000] {
            let Rates { feature, offset, log_scaling, decoders: [opacity, color, cov], attention } =
                Rates::at(&settings, 2.5, step);
            table += &format!("\n{step}");
            for rate in [feature, offset, log_scaling, opacity, color, cov, attention] {
                table += &format!(" {rate:>16.10e}");
            }
        }
        insta::assert_snapshot!(table);
    }
}
