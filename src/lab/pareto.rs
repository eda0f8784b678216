//! Which choices are worth having: none other is both as accurate and as fast.

use super::statistics::Spread;

/// Errors within this factor of each other count as equal: rounding in another order moves them so far.
pub const SAME_ERROR: f64 = 1.1;

/// A choice with its cost and its errors, the smaller the better.
#[derive(Clone, Debug)]
pub struct Choice {
    /// Times of the rounds, of all choices in the same order: what disturbs a round disturbs all of them alike.
    pub times: Vec<f64>,
    /// Errors, each by itself; 0 is exact.
    pub errors: Vec<f64>,
}

/// Median times within this factor of each other count as equal even where the rounds agree on the faster one.
pub const SAME_TIME: f64 = 1.02;

/// How long `a` takes in terms of `b`, round by round.
///
/// # Panics
/// Unless both have the same number of rounds.
pub fn ratio(a: &[f64], b: &[f64]) -> Spread {
    assert_eq!(a.len(), b.len(), "all choices have a turn in every round");
    Spread::of(&a.iter().zip(b).map(|(a, b)| if a == b { 1.0 } else { a / b }).collect::<Vec<f64>>())
}

/// True where the ratio is of a longer time: in its median, and in three quarters of the rounds.
pub fn is_longer(ratio: &Spread) -> bool {
    ratio.median > SAME_TIME && ratio.lower > 1.0
}

/// Likewise of a shorter one.
pub fn is_shorter(ratio: &Spread) -> bool {
    ratio.median * SAME_TIME < 1.0 && ratio.upper < 1.0
}

/// True where `a` makes `b` superfluous: it is in nothing worse, and in something better. Errors within [`SAME_ERROR`]
/// count as equal, and so do times that most rounds do not agree about.
pub fn dominates(a: &Choice, b: &Choice) -> bool {
    let ratio = ratio(&a.times, &b.times);
    let better = |x: &f64, y: &f64| x * SAME_ERROR < *y;
    let pairs = || a.errors.iter().zip(&b.errors);
    let worse = pairs().any(|(x, y)| better(y, x));
    let slower = ratio.median > SAME_TIME;
    !slower && !worse && (is_shorter(&ratio) || pairs().any(|(x, y)| better(x, y)))
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
        Choice { times: times.to_vec(), errors: errors.to_vec() }
    }

    #[test]
    fn superfluous_choices() {
        let exact = choice(&[1.0, 1.1, 1.2], &[1e-7, 0.0]);
        let fast = choice(&[0.5, 0.6, 0.7], &[1e-3, 0.0]);
        let slow = choice(&[2.0, 2.1, 2.2], &[1e-7, 0.0]);
        let rough = choice(&[1.0, 1.1, 1.2], &[1e-5, 0.0]);
        assert_eq!(dominated(&[exact.clone(), fast.clone(), slow, rough]), [None, None, Some(0), Some(0)]);
        // Neither the rounds nor the errors tell them apart.
        let alike = choice(&[1.05, 1.05, 1.25], &[1.05e-7, 0.0]);
        assert_eq!(dominated(&[exact.clone(), alike]), [None, None]);
        // Exact in the one and worse in the other: both stay.
        let other = choice(&[1.0, 1.1, 1.2], &[0.0, 1e-6]);
        assert_eq!(dominated(&[exact.clone(), other]), [None, None]);
        // 0 beats everything.
        let zero = choice(&[1.0, 1.1, 1.2], &[0.0, 0.0]);
        assert!(dominates(&zero, &exact) && !dominates(&exact, &zero) && !dominates(&zero, &zero));
        assert!(!dominates(&fast, &exact));
        // What disturbs both alike hides nothing: every round is a tenth faster.
        let (even, faster) = (choice(&[1.0, 3.0, 9.0], &[0.0]), choice(&[0.9, 2.7, 8.1], &[0.0]));
        assert_eq!(dominated(&[even, faster]), [Some(1), None]);
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
