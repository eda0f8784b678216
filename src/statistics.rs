//! Medians and quantiles, defined once for every count of values.

use glam::DVec3;

/// The middle of the values; of an even count the mean of the two in the middle. `None` of no values. A NaN counts as
/// the largest.
pub fn median(values: impl IntoIterator<Item = impl Into<f64>>) -> Option<f64> {
    let mut values: Vec<f64> = values.into_iter().map(Into::into).collect();
    let middle = values.len() / 2;
    let even = values.len().is_multiple_of(2);
    let last = values.len().checked_sub(1)?;
    let (below, upper, _) = values.select_nth_unstable_by(middle.min(last), f64::total_cmp);
    let lower = below.iter().copied().max_by(f64::total_cmp).filter(|_| even);
    Some(lower.map_or(*upper, |lower| 0.5 * (lower + *upper)))
}

/// The medians of positions along each axis; nothing of none.
pub fn middle(points: &[DVec3]) -> Option<DVec3> {
    let along = |axis: usize| median(points.iter().map(|p| p[axis]));
    Some(DVec3::new(along(0)?, along(1)?, along(2)?))
}

/// The value at place `floor(share (n - 1))` of the n values in ascending order: always one of the values, so that a
/// single outlier beyond that place has no part in it. `None` of no values. A NaN counts as the largest.
///
/// # Panics
/// Unless `share` is from 0 to 1.
pub fn quantile(values: impl IntoIterator<Item = impl Into<f64>>, share: f64) -> Option<f64> {
    assert!((0.0..=1.0).contains(&share), "a share of the values: {share}");
    let mut values: Vec<f64> = values.into_iter().map(Into::into).collect();
    let place = (values.len().checked_sub(1)? as f64 * share).floor() as usize;
    Some(*values.select_nth_unstable_by(place, f64::total_cmp).1)
}

/// The standard deviation of normally distributed residuals whose absolute values have this median (Huber and Ronchetti
/// 2009, chapter 5). `None` of no values.
pub fn deviation(absolute_residuals: impl IntoIterator<Item = impl Into<f64>>) -> Option<f64> {
    median(absolute_residuals).map(|median| 1.4826 * median)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_of_an_even_count_is_the_mean_of_both_in_the_middle() {
        assert_eq!(median([0.0_f64; 0]), None);
        assert_eq!(median([3_u32]), Some(3.0));
        assert_eq!(median([9.0, 1.0]), Some(5.0));
        assert_eq!(median([9.0_f32, 1.0, 2.0]), Some(2.0));
        assert_eq!(median([7, 1, 100, 3]), Some(5.0));
        assert_eq!(median([f64::NAN, 1.0, 2.0]), Some(2.0));
    }

    #[test]
    fn a_quantile_is_one_of_the_values() {
        let values = [5.0, 1.0, 1000.0, 3.0, 2.0, 4.0, 6.0, 7.0, 8.0, 9.0];
        assert_eq!(quantile(values, 0.0), Some(1.0));
        assert_eq!(quantile(values, 0.5), Some(5.0));
        // Place 8.1 of 0 to 9: the outlier in place 9 has no part in it.
        assert_eq!(quantile(values, 0.9), Some(9.0));
        assert_eq!(quantile(values, 1.0), Some(1000.0));
        assert_eq!(quantile([0.0_f64; 0], 0.5), None);
    }
}
