//! Which segment leaves a full ring: [`Remover`], and the order in which priorities make them leave, [`Lowest`].
//!
//! Reverb's removers, over segments: FIFO, and lowest priority. What leaves is always a whole segment: what is left of
//! one would save no row that its other transitions do not need.

use serde::{Deserialize, Serialize};
use std::collections::{BTreeSet, HashMap};

/// The greatest window.
pub(crate) const MAX_WINDOW: u32 = 64;

/// Which segment leaves when a store is full.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Remover {
    /// The oldest.
    #[default]
    Fifo,
    /// The one whose greatest priority, of those of its transitions that can still be drawn, is lowest; of equals, the
    /// oldest. Priorities begin anew at a restart: the store then holds the newest transitions of its log.
    LowestPriority {
        /// How many times the capacity the log keeps, 1 to 64: a segment leaves at the latest when so many transitions
        /// have come since it began. Of 1 all leave by age.
        #[serde(default = "default_window")]
        window: u32,
    },
}

fn default_window() -> u32 {
    4
}

impl Remover {
    /// How many times the capacity the log keeps.
    pub(crate) fn window(self) -> u32 {
        match self {
            Self::Fifo => 1,
            Self::LowestPriority { window } => window,
        }
    }
}

/// Segments, by the greatest weight of their transitions, and of equals by age. A change takes O(log n).
#[derive(Clone, Debug, Default)]
pub(crate) struct Lowest {
    /// The bits of the weight, and the segment's number.
    order: BTreeSet<(u64, u64)>,
    /// By number.
    weights: HashMap<u64, u64>,
}

impl Lowest {
    /// Gives the segment `number`, known or new, a weight, from 0. Older segments have smaller numbers.
    pub(crate) fn set(&mut self, number: u64, weight: f64) {
        debug_assert!(weight >= 0.0);
        // Numbers from 0 have the order of their bits.
        let weight = weight.to_bits();
        if self.weights.get(&number) != Some(&weight) {
            self.remove(number);
            self.weights.insert(number, weight);
            self.order.insert((weight, number));
        }
    }

    /// Forgets a segment.
    pub(crate) fn remove(&mut self, number: u64) {
        if let Some(weight) = self.weights.remove(&number) {
            self.order.remove(&(weight, number));
        }
    }

    /// The one that leaves first.
    pub(crate) fn first(&self) -> Option<u64> {
        self.order.first().map(|&(_, number)| number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_first_is_the_oldest_of_the_lowest(
            changes in prop::collection::vec((0u64..12, prop::option::of(0u8..5)), 0..150),
        ) {
            let (mut lowest, mut list) = (Lowest::default(), [None; 12]);
            for (number, weight) in changes {
                let weight = weight.map(|weight| [0.0, f64::MIN_POSITIVE, 0.7, 1.0, 1e200][usize::from(weight)]);
                match weight {
                    Some(weight) => lowest.set(number, weight),
                    None => lowest.remove(number),
                }
                list[number as usize] = weight;
                let there = || (0..).zip(list).filter_map(|(number, weight)| Some((number, weight?)));
                // The first of equals.
                let expected = there().min_by(|a, b| a.1.total_cmp(&b.1)).map(|(number, _)| number);
                prop_assert_eq!(lowest.first(), expected);
                prop_assert_eq!(lowest.weights.len(), there().count());
            }
        }
    }

    #[test]
    fn a_table_names_it_as_it_names_its_sampler() {
        #[derive(Deserialize)]
        struct Table {
            remover: Remover,
        }
        let parse = |text: &str| serde_json::from_str::<Table>(text).map(|table| table.remover);
        assert_eq!(parse(r#"{"remover": "fifo"}"#).unwrap(), Remover::Fifo);
        let lowest = |window| Remover::LowestPriority { window };
        assert_eq!(parse(r#"{"remover": {"lowest_priority": {}}}"#).unwrap(), lowest(4));
        assert_eq!(parse(r#"{"remover": {"lowest_priority": {"window": 9}}}"#).unwrap(), lowest(9));
        assert!(parse(r#"{"remover": {"lowest_priority": {"windows": 9}}}"#).is_err());
    }
}
