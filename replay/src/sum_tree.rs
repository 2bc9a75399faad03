//! Weights of places, and the place that a sum leads to: [`SumTree`].

/// Weights of the places 0 to n − 1, each at least 0; all begin at 0. Every operation takes O(log n).
#[derive(Clone, Debug)]
pub(crate) struct SumTree {
    /// Places, rounded up to a power of two.
    leaves: usize,
    /// The root at 1; the children of i at 2i and 2i + 1; the places at the end.
    sums: Vec<f64>,
}

impl SumTree {
    pub(crate) fn new(places: usize) -> Self {
        let leaves = places.next_power_of_two();
        Self { leaves, sums: vec![0.0; 2 * leaves] }
    }

    /// The last place.
    pub(crate) fn last(&self) -> usize {
        self.leaves - 1
    }

    /// The weight of a place.
    pub(crate) fn weight(&self, place: usize) -> f64 {
        self.sums[self.leaves + place]
    }

    /// Of all weights.
    pub(crate) fn total(&self) -> f64 {
        self.sums[1]
    }

    pub(crate) fn set(&mut self, place: usize, weight: f64) {
        debug_assert!(weight >= 0.0 && weight.is_finite());
        let mut node = self.leaves + place;
        self.sums[node] = weight;
        // Summed anew and not corrected by the difference: nothing accumulates, and what is empty is exactly 0.
        while node > 1 {
            node /= 2;
            self.sums[node] = self.sums[2 * node] + self.sums[2 * node + 1];
        }
    }

    /// The first place up to which the weights sum to more than `sum`; None unless that is below the total. Its own
    /// weight is positive.
    pub(crate) fn find(&self, mut sum: f64) -> Option<usize> {
        if sum.is_nan() || sum >= self.total() {
            return None;
        }
        let mut node = 1;
        while node < self.leaves {
            let left = self.sums[2 * node];
            // Rounding may leave a little more than the right side holds: what is empty is not entered for that.
            if sum < left || self.sums[2 * node + 1] == 0.0 {
                node *= 2;
            } else {
                sum -= left;
                node = 2 * node + 1;
            }
        }
        Some(node - self.leaves)
    }

    /// The first place of some weight that is not before `place`.
    pub(crate) fn first_from(&self, place: usize) -> Option<usize> {
        self.nearest(place, 0)
    }

    /// The last place of some weight that is not behind `place`.
    pub(crate) fn last_to(&self, place: usize) -> Option<usize> {
        self.nearest(place, 1)
    }

    /// Goes up until there is weight on the far side, and then down along its near edge; `near` is 0 where the near
    /// side is the left one.
    fn nearest(&self, place: usize, near: usize) -> Option<usize> {
        let mut node = self.leaves + place;
        if self.sums[node] == 0.0 {
            while node % 2 != near || self.sums[node ^ 1] == 0.0 {
                node /= 2;
                if node <= 1 {
                    return None;
                }
            }
            node ^= 1;
        }
        while node < self.leaves {
            node = 2 * node + near;
            if self.sums[node] == 0.0 {
                node ^= 1;
            }
        }
        Some(node - self.leaves)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn it_finds_what_a_list_finds(
            changes in prop::collection::vec((0usize..37, prop_oneof![Just(0.0), 0.0f64..9.0]), 0..120),
            share in 0.0f64..1.0,
            place in 0usize..37,
        ) {
            let (mut tree, mut list) = (SumTree::new(37), [0.0; 37]);
            for (place, weight) in changes {
                tree.set(place, weight);
                list[place] = weight;
            }
            let total: f64 = list.iter().sum();
            prop_assert!((tree.total() - total).abs() < 1e-9);
            prop_assert_eq!(tree.total() == 0.0, list.iter().all(|&weight| weight == 0.0));
            if let Some(found) = tree.find(share * tree.total()) {
                let before: f64 = list[..found].iter().sum();
                prop_assert!(list[found] > 0.0);
                prop_assert!(before <= share * total + 1e-9 && before + list[found] >= share * total - 1e-9);
            } else {
                prop_assert_eq!(total, 0.0);
            }
            prop_assert_eq!(tree.first_from(place), (place..37).find(|&place| list[place] > 0.0));
            prop_assert_eq!(tree.last_to(place), (0..=place).rev().find(|&place| list[place] > 0.0));
        }
    }
}
