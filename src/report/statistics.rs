//! What repetitions say: the median and how far they spread.

use serde::{Deserialize, Serialize};

/// Order statistics of repeated measurements.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Middle value.
    pub median: f64,
    /// First quartile.
    pub lower: f64,
    /// Third quartile.
    pub upper: f64,
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// Number of measurements.
    pub repetitions: usize,
}

impl Spread {
    /// Of measurements in any order; quantiles lie linearly between neighbours (Hyndman and Fan's type 7).
    ///
    /// # Panics
    /// Without a measurement, or with one that is not a number.
    pub fn of(values: &[f64]) -> Self {
        assert!(!values.is_empty() && values.iter().all(|v| !v.is_nan()), "measurements are numbers: {values:?}");
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let quantile = |share: f64| {
            let place = share * (sorted.len() - 1) as f64;
            let (below, above) = (sorted[place.floor() as usize], sorted[place.ceil() as usize]);
            below + (above - below) * place.fract()
        };
        Self {
            median: quantile(0.5),
            lower: quantile(0.25),
            upper: quantile(0.75),
            min: sorted[0],
            max: sorted[sorted.len() - 1],
            repetitions: sorted.len(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quartiles() {
        let spread = Spread::of(&[5.0, 1.0, 4.0, 2.0, 3.0]);
        assert_eq!((spread.min, spread.lower, spread.median, spread.upper, spread.max), (1.0, 2.0, 3.0, 4.0, 5.0));
        let spread = Spread::of(&[4.0, 1.0]);
        assert_eq!((spread.lower, spread.median, spread.upper, spread.repetitions), (1.75, 2.5, 3.25, 2));
        let one = Spread::of(&[7.0]);
        assert_eq!((one.min, one.lower, one.median, one.upper, one.max), (7.0, 7.0, 7.0, 7.0, 7.0));
    }

    #[test]
    #[should_panic(expected = "measurements are numbers")]
    fn not_a_number_is_no_measurement() {
        Spread::of(&[1.0, f64::NAN]);
    }
}
