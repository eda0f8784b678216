//! Which view each step sees.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_pcg::Pcg64;

use super::config::{Config, ViewOrder};
use crate::scene::Scene;

/// Views that are visited more often than the others, in turn.
#[derive(Clone, Debug, PartialEq)]
pub struct Favorites {
    /// Which, ascending.
    pub views: Vec<usize>,
    /// Their share of all steps together, from 0 (like the others) to below 1.
    pub share: f64,
}

/// Views without replacement: every view once per round, in an order of its own. The order of a round depends on the
/// seed and the round alone, so that any step's view is known without the steps before it. Favourites have steps of
/// their own, evenly spread; the rounds of the others fill those between.
#[derive(Clone, Debug)]
pub struct Order {
    /// Of the rounds: all views that are no favourites.
    views: Vec<usize>,
    favorites: Option<Favorites>,
    /// Where between two of their steps the favourites' first one lies.
    phase: f64,
    seed: u64,
    order: ViewOrder,
    round: Option<(u32, Vec<usize>)>,
}

impl Order {
    /// For so many views.
    ///
    /// # Panics
    /// Without a view.
    pub fn new(views: usize, favorites: Option<Favorites>, seed: u64, order: ViewOrder) -> Self {
        assert!(views > 0, "a scene has at least one training view");
        let favorites = favorites.filter(|f| f.share > 0.0 && !f.views.is_empty() && f.views.len() < views);
        let phase = rand::RngExt::random::<f64>(&mut random(seed, Stream::Favorite, 0));
        let others = (0..views).filter(|v| favorites.as_ref().is_none_or(|f| !f.views.contains(v))).collect();
        Self { views: others, favorites, phase, seed, order, round: None }
    }

    /// Of a scene's views, the references among them. These are visited no less than the others.
    pub fn of(scene: &Scene, config: &Config) -> Self {
        let views: Vec<usize> = scene.references.iter().map(|r| r.view).collect();
        let alike = views.len() as f64 / scene.train.len() as f64;
        let share = if config.reference_share > 0.0 { config.reference_share.max(alike) } else { 0.0 };
        Self::new(scene.train.len(), Some(Favorites { views, share }), config.seed, config.view_order)
    }

    /// The view of `step` (counted from 1).
    pub fn view(&mut self, step: u32) -> usize {
        let index = u64::from(step - 1);
        let Some(Favorites { views, share }) = &self.favorites else { return self.in_round(index) };
        let visits = |steps: u64| (steps as f64 * share + self.phase).floor() as u64;
        let before = visits(index);
        if visits(index + 1) > before {
            return views[(before % views.len() as u64) as usize];
        }
        self.in_round(index - before)
    }

    fn in_round(&mut self, index: u64) -> usize {
        let views = self.views.len() as u64;
        let (round, place) = ((index / views) as u32, (index % views) as usize);
        if self.order == ViewOrder::Sequential {
            return self.views[place];
        }
        if self.round.as_ref().is_none_or(|(r, _)| *r != round) {
            let mut order: Vec<usize> = (0..self.views.len()).collect();
            order.shuffle(&mut random(self.seed, Stream::Views, round));
            self.round = Some((round, order));
        }
        self.views[self.round.as_ref().map_or(place, |(_, order)| order[place])]
    }
}

/// Uses of random numbers, each with a stream of its own: one more draw in one changes nothing in the others.
#[derive(Clone, Copy, Debug)]
pub enum Stream {
    /// View order, by round.
    Views = 1,
    /// Patches of the attention, by step.
    Patch = 2,
    /// Where a favourite view's steps lie.
    Favorite = 4,
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
            let mut order = Order::new(views, None, 5, ViewOrder::Shuffled);
            let rounds: Vec<Vec<usize>> =
                (0..3).map(|r| (0..views).map(|i| order.view((r * views + i) as u32 + 1)).collect()).collect();
            for round in &rounds {
                let mut sorted = round.clone();
                sorted.sort_unstable();
                assert_eq!(sorted, (0..views).collect::<Vec<_>>());
            }
            assert!(views < 7 || rounds[0] != rounds[1], "rounds differ");
            assert_eq!(Order::new(views, None, 5, ViewOrder::Shuffled).view(2 * views as u32 + 1), rounds[2][0]);
        }
    }

    #[test]
    fn a_favorite_has_its_share_and_the_others_their_rounds() {
        for (views, view, share) in [(2, 0, 0.5), (7, 6, 0.18), (60, 29, 0.18), (60, 0, 0.9), (5, 2, 1e-3)] {
            let favorite = Some(Favorites { views: vec![view], share });
            let mut order = Order::new(views, favorite.clone(), 3, ViewOrder::Shuffled);
            let steps = 40 * views as u32;
            let all: Vec<usize> = (1..=steps).map(|s| order.view(s)).collect();
            let visits: Vec<usize> = (0..all.len()).filter(|i| all[*i] == view).collect();
            assert!((visits.len() as f64 - share * f64::from(steps)).abs() <= 1.0, "{visits:?}");
            // Evenly: gaps differ by one at most.
            let gaps: Vec<usize> = visits.windows(2).map(|w| w[1] - w[0]).collect();
            assert!(gaps.iter().max().zip(gaps.iter().min()).is_none_or(|(a, b)| a - b <= 1), "{gaps:?}");
            let others: Vec<usize> = all.iter().copied().filter(|v| *v != view).collect();
            for round in others.chunks_exact(views - 1) {
                let mut sorted = round.to_vec();
                sorted.sort_unstable();
                assert_eq!(sorted, (0..views).filter(|v| *v != view).collect::<Vec<_>>());
            }
            assert_eq!(Order::new(views, favorite, 3, ViewOrder::Shuffled).view(steps), all[all.len() - 1]);
        }
        // Nobody else is there, or it has no share of its own.
        assert_eq!(Order::new(1, Some(Favorites { views: vec![0], share: 0.5 }), 0, ViewOrder::Shuffled).view(3), 0);
        let none = Some(Favorites { views: vec![1], share: 0.0 });
        let mut plain = Order::new(4, None, 1, ViewOrder::Shuffled);
        let mut same = Order::new(4, none, 1, ViewOrder::Shuffled);
        assert!((1..30).all(|s| plain.view(s) == same.view(s)));
    }

    #[test]
    fn several_favorites_take_turns() {
        let favorites = Favorites { views: vec![1, 4, 5], share: 0.25 };
        let mut order = Order::new(9, Some(favorites.clone()), 3, ViewOrder::Shuffled);
        let all: Vec<usize> = (1..=240).map(|s| order.view(s)).collect();
        let visits: Vec<usize> = all.iter().copied().filter(|v| favorites.views.contains(v)).collect();
        assert_eq!(visits, [1, 4, 5].repeat(20));
        let others: Vec<usize> = all.into_iter().filter(|v| !favorites.views.contains(v)).collect();
        for round in others.chunks_exact(6) {
            let mut sorted = round.to_vec();
            sorted.sort_unstable();
            assert_eq!(sorted, [0, 2, 3, 6, 7, 8]);
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
