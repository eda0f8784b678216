//! What repetitions say: the median and how far they spread; means over seeds, and whether two of them differ.

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

/// Mean of a figure over seeds, and how far the seeds lie apart.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Moments {
    /// Arithmetic mean. JSON has the string `"inf"` for an infinite PSNR.
    #[serde(with = "crate::evaluate::decibel")]
    pub mean: f64,
    /// Standard deviation of a single seed (n - 1 in the denominator); absent for one.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub deviation: Option<f64>,
    /// Number of seeds.
    pub seeds: usize,
}

impl Moments {
    /// Of one value per seed; `None` without any.
    pub fn of(values: &[f64]) -> Option<Self> {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let square: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
        let deviation = (values.len() > 1).then(|| (square / (n - 1.0)).sqrt());
        (!values.is_empty()).then_some(Self { mean, deviation, seeds: values.len() })
    }

    /// `mean +- deviation` with so many digits, or the mean alone.
    pub fn text(&self, digits: usize) -> String {
        let deviation = self.deviation.map_or(String::new(), |deviation| format!(" ± {deviation:.digits$}"));
        format!("{:.digits$}{deviation}", self.mean)
    }
}

/// The difference of two choices over the same seeds, by Student's paired t-test.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Paired {
    /// Mean of the seeds' differences.
    pub difference: f64,
    /// Standard error of that mean.
    pub standard_error: f64,
    /// How probable a mean at least as far from 0 is where the choices do not differ (two-sided, differences normal).
    pub p: f64,
    /// Number of seeds.
    pub seeds: usize,
}

impl Paired {
    /// Of `b - a`, seed by seed; `None` with fewer than two seeds, or where a figure is infinite: there is no difference.
    ///
    /// # Panics
    /// Unless both have equally many.
    pub fn of(a: &[f64], b: &[f64]) -> Option<Self> {
        assert_eq!(a.len(), b.len(), "the same seeds");
        let differences: Vec<f64> = a.iter().zip(b).map(|(a, b)| b - a).collect();
        let Moments { mean, deviation, seeds } =
            Moments::of(&differences).filter(|moments| moments.mean.is_finite())?;
        let standard_error = deviation? / (seeds as f64).sqrt();
        // Seeds that all differ alike: certainly different, or the same.
        let p = match (standard_error > 0.0, mean == 0.0) {
            (true, _) => two_sided(mean / standard_error, seeds as u32 - 1),
            (false, same) => f64::from(u8::from(same)),
        };
        Some(Self { difference: mean, standard_error, p, seeds })
    }
}

/// Probability that Student's t of so many degrees of freedom lies at least as far from 0 as `t`: for whole degrees a
/// finite sum (Abramowitz and Stegun 26.7.3 and 26.7.4).
fn two_sided(t: f64, degrees: u32) -> f64 {
    let theta = (t.abs() / f64::from(degrees).sqrt()).atan();
    let (sine, cosine) = theta.sin_cos();
    let odd = degrees % 2 == 1;
    let (mut term, mut sum) = (if odd { cosine } else { 1.0 }, 0.0);
    // Powers of the cosine below the degrees, every other one.
    for power in (u32::from(odd)..degrees.saturating_sub(1)).step_by(2) {
        sum += term;
        term *= cosine * cosine * f64::from(power + 1) / f64::from(power + 2);
    }
    let within = if odd { (theta + sine * sum) / std::f64::consts::FRAC_PI_2 } else { sine * sum };
    (1.0 - within).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn students_t_has_its_tables_values() {
        // Two-sided 5 % points of t, to the four digits that tables print: the slope there is below 0.06 per unit.
        let tables =
            [(1, 12.7062), (2, 4.3027), (3, 3.1824), (4, 2.7764), (5, 2.5706), (6, 2.4469), (9, 2.2622), (30, 2.0423)];
        for (degrees, t) in tables {
            assert!((two_sided(t, degrees) - 0.05).abs() < 1e-5, "{degrees}: {}", two_sided(t, degrees));
            assert!((two_sided(-t, degrees) - 0.05).abs() < 1e-5);
            assert_eq!(two_sided(0.0, degrees), 1.0);
        }
        // One degree is Cauchy's distribution: half of it lies within 1.
        assert!((two_sided(1.0, 1) - 0.5).abs() < 1e-15);
    }

    #[test]
    fn means_and_differences_over_seeds() {
        let moments = Moments::of(&[1.0, 2.0, 6.0]).expect("three");
        assert_eq!((moments.mean, moments.deviation, moments.seeds), (3.0, Some(7f64.sqrt()), 3));
        assert_eq!((Moments::of(&[]), Moments::of(&[2.0]).expect("one").deviation), (None, None));
        assert_eq!((moments.text(2), Moments::of(&[2.0]).expect("one").text(1)), ("3.00 ± 2.65".into(), "2.0".into()));
        // Differences 1, 2, 3: mean 2, deviation 1, t = 2 sqrt 3 at two degrees: p = 1 - t / sqrt(t^2 + 2).
        let paired = Paired::of(&[10.0, 20.0, 30.0], &[11.0, 22.0, 33.0]).expect("three");
        assert!((paired.difference - 2.0).abs() < 1e-15 && (paired.standard_error - 1.0 / 3f64.sqrt()).abs() < 1e-15);
        assert!((paired.p - (1.0 - (12.0f64 / 14.0).sqrt())).abs() < 1e-14, "{paired:?}");
        assert_eq!(Paired::of(&[1.0], &[2.0]), None);
        assert_eq!(Paired::of(&[1.0, 2.0], &[2.0, 3.0]).expect("two").p, 0.0);
        assert_eq!(Paired::of(&[1.0, 2.0], &[1.0, 2.0]).expect("two").p, 1.0);
    }

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
