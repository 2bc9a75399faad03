//! Segments that are followed and were in no minibatch yet: [`Undrawn`], beside the ring.
//!
//! In memory alone, for a restart forgets traces. A minibatch costs a comparison where there are none, and the search for each
//! drawn row's segment where there are some.

use getup_proto::TraceContext;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

/// Segments that are remembered; beyond, the oldest is forgotten.
const MOST: usize = 1024;

/// By their numbers in the ring.
#[derive(Debug, Default)]
pub(crate) struct Undrawn {
    by_number: Mutex<BTreeMap<u64, Followed>>,
    /// How many there are.
    count: AtomicUsize,
}

/// A segment in the ring that is followed.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Followed {
    /// What a span of its draw hangs under.
    pub(crate) context: TraceContext,
    /// Since when it can be drawn.
    pub(crate) since: SystemTime,
}

impl Undrawn {
    /// Remembers the newest of the segments that a ring holds, by their numbers.
    pub(crate) fn insert(&self, numbers: Range<u64>, context: TraceContext, since: SystemTime) {
        let mut followed = self.lock();
        while let Some(oldest) = followed.first_entry()
            && *oldest.key() < numbers.start
        {
            oldest.remove();
        }
        followed.insert(numbers.end - 1, Followed { context, since });
        if followed.len() > MOST {
            followed.pop_first();
        }
        self.count.store(followed.len(), Ordering::Relaxed);
    }

    /// Those of the segments that are followed and were drawn, given the number of each row's; they are forgotten.
    pub(crate) fn take(&self, drawn: impl Iterator<Item = u64>) -> Vec<Followed> {
        if self.count.load(Ordering::Relaxed) == 0 {
            return Vec::new();
        }
        let mut followed = self.lock();
        let taken = drawn.filter_map(|number| followed.remove(&number)).collect();
        self.count.store(followed.len(), Ordering::Relaxed);
        taken
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<u64, Followed>> {
        self.by_number.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::ReplayConfig;
    use crate::fixtures;
    use crate::remover::Remover;
    use crate::ring::Ring;
    use crate::selector::ItemSelector;

    fn insert(undrawn: &Undrawn, numbers: Range<u64>) {
        let context = TraceContext { trace_id: 1, span_id: numbers.end - 1 };
        undrawn.insert(numbers, context, SystemTime::UNIX_EPOCH);
    }

    fn taken(undrawn: &Undrawn, drawn: &[u64]) -> Vec<u64> {
        undrawn.take(drawn.iter().copied()).iter().map(|followed| followed.context.span_id).collect()
    }

    #[test]
    fn a_segment_is_found_by_its_first_draw_and_by_no_other() {
        let undrawn = Undrawn::default();
        assert!(undrawn.take(std::iter::once_with(|| panic!("nothing is followed"))).is_empty());
        insert(&undrawn, 0..2);
        insert(&undrawn, 0..4);
        assert!(taken(&undrawn, &[0, 2]).is_empty());
        assert_eq!(taken(&undrawn, &[2, 3, 3]), [3]);
        assert_eq!(taken(&undrawn, &[3, 1, 0]), [1]);
        assert!(taken(&undrawn, &[0, 1, 2, 3]).is_empty(), "each is followed to its first minibatch");
    }

    #[test]
    fn what_left_the_ring_is_forgotten_and_so_is_the_oldest_of_too_many() {
        let undrawn = Undrawn::default();
        (1..=1090).for_each(|end| insert(&undrawn, 0..end));
        assert_eq!(undrawn.lock().len(), MOST);
        assert_eq!(taken(&undrawn, &[65, 66]), [66]);
        insert(&undrawn, 1089..1091);
        assert_eq!(undrawn.lock().len(), 2, "of the others nothing is left");
        assert_eq!(taken(&undrawn, &(0..1100).collect::<Vec<_>>()), [1089, 1090]);
    }

    #[test]
    fn a_ring_numbers_its_segments_in_the_order_in_which_they_came_and_knows_which_a_row_belongs_to() {
        let spec = fixtures::spec(8);
        let prioritized = ItemSelector::Prioritized { exponent: 1.0 };
        for (sampler, remover) in
            [(ItemSelector::Uniform, Remover::Fifo), (prioritized, Remover::LowestPriority { window: 2 })]
        {
            let config = ReplayConfig { capacity: 30, sampler, remover, ..ReplayConfig::default() };
            let mut ring = Ring::new(&spec, &config);
            for number in 0..40 {
                ring.push(&fixtures::segment(&spec, 1, number + 1, 3));
                assert_eq!(ring.numbers().end, number + 1);
                // The key of the newest segment's second transition.
                let slot = ring.slot_of(number * 3 + 1).unwrap();
                assert_eq!(ring.number_of(slot), number, "{remover:?}");
            }
            assert_eq!(ring.numbers().start, 30);
        }
    }
}
