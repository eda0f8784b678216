//! Which view each step sees.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64;

use super::config::ViewOrder;

/// Views without replacement: every view once per round, in an order of its own. The order of a round depends on the
/// seed and the round alone, so that any step's view is known without the steps before it.
#[derive(Clone, Debug)]
pub struct Order {
    views: usize,
    seed: u64,
    order: ViewOrder,
    round: Option<(u32, Vec<usize>)>,
}

impl Order {
    /// For so many views.
    ///
    /// # Panics
    /// Without a view.
    pub fn new(views: usize, seed: u64, order: ViewOrder) -> Self {
        assert!(views > 0, "a scene has at least one training view");
        Self { views, seed, order, round: None }
    }

    /// The view of `step` (counted from 1).
    pub fn view(&mut self, step: u32) -> usize {
        let index = (step - 1) as usize;
        let (round, place) = ((index / self.views) as u32, index % self.views);
        if self.order == ViewOrder::Sequential {
            return place;
        }
        if self.round.as_ref().is_none_or(|(r, _)| *r != round) {
            let mut views: Vec<usize> = (0..self.views).collect();
            views.shuffle(&mut random(self.seed, Stream::Views, round));
            self.round = Some((round, views));
        }
        self.round.as_ref().map_or(place, |(_, views)| views[place])
    }
}

/// Uses of random numbers, each with a stream of its own: one more draw in one changes nothing in the others.
#[derive(Clone, Copy, Debug)]
pub enum Stream {
    /// View order, by round.
    Views = 1,
    /// Patches of the attention, by step.
    Patch = 2,
    /// Rectangles of the depth weight, by step.
    Rectangle = 3,
}

/// The generator of a stream at a round or step.
pub fn random(seed: u64, stream: Stream, index: u32) -> Pcg64 {
    let mut bytes = [0; 32];
    bytes[..8].copy_from_slice(&seed.to_le_bytes());
    bytes[8..12].copy_from_slice(&(stream as u32).to_le_bytes());
    bytes[12..16].copy_from_slice(&index.to_le_bytes());
    let hash = blake3::hash(&bytes);
    Pcg64::from_seed(*hash.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_round_has_every_view_once() {
        for views in [1, 2, 7, 60] {
            let mut order = Order::new(views, 5, ViewOrder::Shuffled);
            let rounds: Vec<Vec<usize>> =
                (0..3).map(|r| (0..views).map(|i| order.view((r * views + i) as u32 + 1)).collect()).collect();
            for round in &rounds {
                let mut sorted = round.clone();
                sorted.sort_unstable();
                assert_eq!(sorted, (0..views).collect::<Vec<_>>());
            }
            assert!(views < 7 || rounds[0] != rounds[1], "rounds differ");
            assert_eq!(Order::new(views, 5, ViewOrder::Shuffled).view(2 * views as u32 + 1), rounds[2][0]);
        }
    }

    #[test]
    fn seeds_and_streams_differ() {
        let first = |seed, stream| rand::RngExt::random::<u64>(&mut random(seed, stream, 0));
        assert_ne!(first(1, Stream::Views), first(2, Stream::Views));
        assert_ne!(first(1, Stream::Views), first(1, Stream::Patch));
        assert_eq!(first(1, Stream::Views), first(1, Stream::Views));
    }
}
