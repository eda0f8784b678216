//! Which choices are worth having: none other is both as accurate and as fast.

use super::statistics::Spread;

/// Errors within this factor of each other count as equal: rounding in another order moves them so far.
pub const SAME_ERROR: f64 = 1.1;

/// A choice with its cost and its errors, the smaller the better.
#[derive(Clone, Debug)]
pub struct Choice {
    /// Time.
    pub time: Spread,
    /// Errors, each by itself; 0 is exact.
    pub errors: Vec<f64>,
}

/// True where `a` makes `b` superfluous: it is in nothing worse, and in something better by more than the spread.
/// Times whose quartiles overlap, and errors within [`SAME_ERROR`], count as equal.
pub fn dominates(a: &Choice, b: &Choice) -> bool {
    let (faster, slower) = (a.time.upper < b.time.lower, b.time.upper < a.time.lower);
    let better = |x: &f64, y: &f64| x * SAME_ERROR < *y;
    let pairs = || a.errors.iter().zip(&b.errors);
    let worse = pairs().any(|(x, y)| better(y, x));
    !slower && !worse && (faster || pairs().any(|(x, y)| better(x, y)))
}

/// For each choice the first one that makes it superfluous. Among equals none is.
pub fn dominated(choices: &[Choice]) -> Vec<Option<usize>> {
    choices.iter().map(|b| choices.iter().position(|a| dominates(a, b))).collect()
}

/// Which points of (cost, gain) lie on the Pareto front: no other costs at most as much and gains at least as much, one of
/// the two strictly. Points that are not finite never do.
pub fn front(points: &[(f64, f64)]) -> Vec<bool> {
    let beats = |a: &(f64, f64), b: &(f64, f64)| a.0 <= b.0 && a.1 >= b.1 && (a.0 < b.0 || a.1 > b.1);
    let finite = |p: &(f64, f64)| p.0.is_finite() && p.1.is_finite();
    points.iter().map(|p| finite(p) && !points.iter().any(|q| finite(q) && beats(q, p))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn choice(times: &[f64], errors: &[f64]) -> Choice {
        Choice { time: Spread::of(times), errors: errors.to_vec() }
    }

    #[test]
    fn superfluous_choices() {
        let exact = choice(&[1.0, 1.1, 1.2], &[1e-7, 0.0]);
        let fast = choice(&[0.5, 0.6, 0.7], &[1e-3, 0.0]);
        let slow = choice(&[2.0, 2.1, 2.2], &[1e-7, 0.0]);
        let rough = choice(&[1.0, 1.1, 1.2], &[1e-5, 0.0]);
        assert_eq!(dominated(&[exact.clone(), fast.clone(), slow, rough]), [None, None, Some(0), Some(0)]);
        // Within the spread of time and error nothing is better.
        let alike = choice(&[1.05, 1.15, 1.25], &[1.05e-7, 0.0]);
        assert_eq!(dominated(&[exact.clone(), alike]), [None, None]);
        // Exact in the one and worse in the other: both stay.
        let other = choice(&[1.0, 1.1, 1.2], &[0.0, 1e-6]);
        assert_eq!(dominated(&[exact.clone(), other]), [None, None]);
        // 0 beats everything.
        let zero = choice(&[1.0, 1.1, 1.2], &[0.0, 0.0]);
        assert!(dominates(&zero, &exact) && !dominates(&exact, &zero) && !dominates(&zero, &zero));
        assert!(!dominates(&fast, &exact));
    }

    #[test]
    fn the_front_of_points() {
        let points =
            [(1.0, 20.0), (2.0, 25.0), (3.0, 24.0), (2.0, 22.0), (4.0, 26.0), (f64::NAN, 30.0), (0.5, f64::NAN)];
        assert_eq!(front(&points), [true, true, false, false, true, false, false]);
        assert_eq!(front(&[(1.0, 1.0), (1.0, 1.0)]), [true, true], "twins do not beat each other");
        assert!(front(&[]).is_empty());
    }
}
