//! Claims of views to know what is behind the object at a site, and the votes that these have.

/// Sum of the weights of the views that must claim a depth behind the object.
pub const ENOUGH: f64 = 2.0;
/// Weights of claims: of a view that is solved, which is enough; of a depth that another view confirms; of one that none does.
const WEIGHTS: [f64; 3] = [ENOUGH, 1.0, 0.5];

/// Depth z that another view claims at a site.
#[derive(Clone, Copy)]
pub struct Claim {
    pub depth: f64,
    pub view: usize,
    /// Which of [`WEIGHTS`] is its.
    pub class: usize,
    /// Whether the view's photograph shows it.
    pub photographed: bool,
    /// Number of the view's plane that it lies on, if on one.
    pub surface: u8,
}

/// Votes of the views that have claims in a cluster: the weightiest of each view counts.
pub struct Votes {
    /// `[view][class]` how many of its claims there are.
    counts: Vec<[u32; 3]>,
    /// The sum.
    pub weight: f64,
}

impl Votes {
    pub fn of(views: usize) -> Self {
        Self { counts: vec![[0; 3]; views], weight: 0.0 }
    }

    /// The weight of a view's weightiest claim.
    fn own(&self, view: usize) -> f64 {
        self.counts[view].iter().position(|count| *count > 0).map_or(0.0, |class| WEIGHTS[class])
    }

    fn count(&mut self, claim: &Claim, change: impl Fn(&mut u32)) {
        let before = self.own(claim.view);
        change(&mut self.counts[claim.view][claim.class]);
        // Halves and wholes: the sum is exact.
        self.weight += self.own(claim.view) - before;
    }

    pub fn come(&mut self, claim: &Claim) {
        self.count(claim, |count| *count += 1);
    }

    pub fn go(&mut self, claim: &Claim) {
        self.count(claim, |count| *count -= 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The weightiest claim of a view counts alone, as claims come and go.
    #[test]
    fn a_view_has_one_vote() {
        let claim = |view, class| Claim { depth: 1.0, view, class, photographed: true, surface: 0 };
        let mut votes = Votes::of(2);
        for (claim, weight) in [(claim(0, 2), 0.5), (claim(0, 1), 1.0), (claim(1, 2), 1.5), (claim(0, 1), 1.5)] {
            votes.come(&claim);
            assert_eq!(votes.weight, weight);
        }
        for (claim, weight) in [(claim(0, 1), 1.5), (claim(0, 1), 1.0), (claim(1, 2), 0.5), (claim(0, 2), 0.0)] {
            votes.go(&claim);
            assert_eq!(votes.weight, weight);
        }
    }
}
