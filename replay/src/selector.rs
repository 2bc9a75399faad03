//! Which transitions of a ring are drawn: [`Selector`], and what it knows of each.
//!
//! Reverb's selectors, over transitions: uniform, prioritized, FIFO, LIFO. A uniform selector that may draw a transition
//! any number of times needs to know nothing of it, and costs nothing; for the others each row of the ring has a weight
//! in a [`SumTree`].

use crate::sum_tree::SumTree;
use rand::Rng;
use serde::{Deserialize, Serialize};

/// How transitions are drawn from a store.
#[derive(Clone, Copy, PartialEq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ItemSelector {
    /// Each with the same probability, with replacement.
    #[default]
    Uniform,
    /// With a probability in proportion to its priority to this power, with replacement (Schaul et al. 2016, "Prioritized
    /// experience replay", eq. 1). A new transition has the greatest priority that any was ever given, 1 at first.
    Prioritized {
        /// α, from 0 (uniform).
        exponent: f64,
    },
    /// The oldest that can still be drawn.
    Fifo,
    /// The newest that can still be drawn.
    Lifo,
}

/// The greatest weight: a sum of as many as there can be is still a number.
const GREATEST_WEIGHT: f64 = 1e200;

/// What is known of the transitions in a ring, by the slots of their rows.
#[derive(Clone, Debug)]
pub(crate) struct Selector {
    selection: ItemSelector,
    /// Of transitions that can be drawn; 0 elsewhere.
    weights: SumTree,
    /// How often each may still be drawn; empty where there is no limit.
    left: Vec<u32>,
    max_times: u32,
    /// Sum of `left`.
    available: u64,
    /// The weight of a new transition.
    newest: f64,
}

impl Selector {
    /// For a ring of so many slots; None where the ring's rows are enough.
    pub(crate) fn new(selection: ItemSelector, max_times_sampled: Option<u32>, slots: usize) -> Option<Self> {
        if selection == ItemSelector::Uniform && max_times_sampled.is_none() {
            return None;
        }
        Some(Self {
            selection,
            weights: SumTree::new(slots),
            left: max_times_sampled.map_or_else(Vec::new, |_| vec![0; slots]),
            max_times: max_times_sampled.unwrap_or(0),
            available: 0,
            newest: 1.0,
        })
    }

    /// A transition has come.
    pub(crate) fn insert(&mut self, slot: usize) {
        if let Some(left) = self.left.get_mut(slot) {
            *left = self.max_times;
            self.available += u64::from(self.max_times);
        }
        self.weights.set(slot, self.newest);
    }

    /// A transition has gone.
    pub(crate) fn remove(&mut self, slot: usize) {
        self.weights.set(slot, 0.0);
        if let Some(left) = self.left.get_mut(slot) {
            self.available -= u64::from(std::mem::take(left));
        }
    }

    /// With what weight a transition is drawn: 0 where it cannot be.
    pub(crate) fn weight(&self, slot: usize) -> f64 {
        self.weights.weight(slot)
    }

    /// How many draws are left before transitions must come; None where there is no limit.
    pub(crate) fn available(&self) -> Option<u64> {
        (!self.left.is_empty()).then_some(self.available)
    }

    /// Draws a transition, and the probability that it had. `oldest` is the slot of the ring's oldest row.
    ///
    /// # Panics
    /// If there is none.
    pub(crate) fn draw(&mut self, rng: &mut impl Rng, oldest: usize) -> (usize, f64) {
        let total = self.weights.total();
        let slot = match self.selection {
            ItemSelector::Uniform | ItemSelector::Prioritized { .. } => {
                self.weights.find(rng.random::<f64>() * total)
            }
            // The ring wraps around before its oldest row.
            ItemSelector::Fifo => self.weights.first_from(oldest).or_else(|| self.weights.first_from(0)),
            ItemSelector::Lifo => {
                let before = oldest.checked_sub(1).and_then(|place| self.weights.last_to(place));
                before.or_else(|| self.weights.last_to(self.weights.last()))
            }
        };
        let slot = slot.expect("there is a transition that can be drawn");
        let probability = match self.selection {
            ItemSelector::Uniform | ItemSelector::Prioritized { .. } => self.weights.weight(slot) / total,
            ItemSelector::Fifo | ItemSelector::Lifo => 1.0,
        };
        if let Some(left) = self.left.get_mut(slot) {
            *left -= 1;
            self.available -= 1;
            if *left == 0 {
                self.weights.set(slot, 0.0);
            }
        }
        (slot, probability)
    }

    /// Gives a transition a priority; nothing happens where it cannot be drawn any more, or priorities do not count.
    pub(crate) fn set_priority(&mut self, slot: usize, priority: f32) -> bool {
        let ItemSelector::Prioritized { exponent } = self.selection else { return false };
        let weight = f64::from(priority).powf(exponent);
        if self.weights.weight(slot) == 0.0 {
            return false;
        }
        // What is 0 is gone: a transition of no priority keeps the least weight there is.
        let weight = weight.clamp(f64::MIN_POSITIVE, GREATEST_WEIGHT);
        self.weights.set(slot, weight);
        self.newest = self.newest.max(weight);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn selector(selection: ItemSelector, max_times: Option<u32>) -> Selector {
        let mut selector = Selector::new(selection, max_times, 10).unwrap();
        // A ring that has wrapped: slots 6 to 9 are older than 0 to 3; between segments a row begins nothing.
        for slot in [6, 7, 9, 0, 1, 3] {
            selector.insert(slot);
        }
        selector
    }

    fn drawn(selector: &mut Selector, count: usize) -> Vec<usize> {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        (0..count).map(|_| selector.draw(&mut rng, 6).0).collect()
    }

    #[test]
    fn fifo_and_lifo_go_through_the_ring_in_its_order() {
        assert_eq!(drawn(&mut selector(ItemSelector::Fifo, Some(1)), 6), [6, 7, 9, 0, 1, 3]);
        assert_eq!(drawn(&mut selector(ItemSelector::Lifo, Some(1)), 6), [3, 1, 0, 9, 7, 6]);
        assert_eq!(drawn(&mut selector(ItemSelector::Fifo, Some(2)), 5), [6, 6, 7, 7, 9]);
        assert_eq!(drawn(&mut selector(ItemSelector::Fifo, None), 3), [6, 6, 6]);
        assert_eq!(drawn(&mut selector(ItemSelector::Lifo, None), 2), [3, 3]);
    }

    #[test]
    fn nothing_is_drawn_more_often_than_it_may() {
        for selection in [ItemSelector::Uniform, ItemSelector::Prioritized { exponent: 0.6 }] {
            let mut selector = selector(selection, Some(3));
            assert_eq!(selector.available(), Some(18));
            let mut counts = [0; 10];
            drawn(&mut selector, 18).into_iter().for_each(|slot| counts[slot] += 1);
            assert_eq!(counts, [3, 3, 0, 3, 0, 0, 3, 3, 0, 3]);
            assert_eq!(selector.available(), Some(0));
            selector.insert(4);
            assert_eq!((selector.available(), drawn(&mut selector, 3)), (Some(3), vec![4, 4, 4]));
        }
    }

    #[test]
    fn the_draws_follow_the_priorities() {
        let exponent = 0.5;
        let mut selector = selector(ItemSelector::Prioritized { exponent }, None);
        let priorities = [(6, 1.0_f32), (7, 4.0), (9, 0.25), (0, 9.0), (1, 0.0), (3, 2.0)];
        for (slot, priority) in priorities {
            assert!(selector.set_priority(slot, priority));
        }
        assert!(!selector.set_priority(2, 1.0), "there is no transition");
        let total: f64 = priorities.iter().map(|(_, priority)| f64::from(*priority).sqrt()).sum();
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut counts = [0.0; 10];
        let draws = 100_000;
        for _ in 0..draws {
            let (slot, probability) = selector.draw(&mut rng, 6);
            let (_, priority) = priorities.into_iter().find(|(place, _)| *place == slot).unwrap();
            assert!((probability - f64::from(priority).sqrt() / total).abs() < 1e-6);
            counts[slot] += 1.0;
        }
        // Pearson's chi-square; the transition of no priority is not drawn.
        assert_eq!(counts[1], 0.0);
        let chi_square: f64 = priorities
            .iter()
            .filter(|(_, priority)| *priority > 0.0)
            .map(|(slot, priority)| {
                let expected = f64::from(draws) * f64::from(*priority).sqrt() / total;
                (counts[*slot] - expected).powi(2) / expected
            })
            .sum();
        // Four degrees of freedom: above 23.5 once in ten thousand seeds.
        assert!(chi_square < 23.5, "{chi_square}");
        // However great one is, the sums stay numbers.
        let mut steep = self::selector(ItemSelector::Prioritized { exponent: 10.0 }, None);
        assert!(steep.set_priority(6, f32::MAX) && steep.set_priority(7, f32::MAX));
        assert!([6, 7].contains(&steep.draw(&mut rng, 6).0));
        // A new one has the greatest priority there was.
        selector.insert(5);
        assert!((selector.weights.weight(5) - 3.0).abs() < 1e-9);
    }
}
