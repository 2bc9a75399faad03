//! Where the rows of a ring lie in its buffer: [`Slots`].
//!
//! Where the oldest segments leave first, rows follow one another around the end of the buffer, and nothing more needs to
//! be known. Where any segment may leave, a new one takes slots that others left, wherever they are: each slot names the
//! next row's, and the segment it belongs to. So nothing is ever moved, and no room is lost between segments.

use std::iter;

/// The slots of a buffer, each of which has room for a row.
#[derive(Debug)]
pub(crate) enum Slots {
    /// Segments leave in the order in which they came.
    InOrder(InOrder),
    /// They leave in any order.
    Linked(Linked),
}

/// Rows one after another, around the end of the buffer.
#[derive(Debug)]
pub(crate) struct InOrder {
    slots: usize,
    /// Slot of the oldest row.
    first: usize,
    rows: usize,
}

/// Rows wherever there is room.
#[derive(Debug)]
pub(crate) struct Linked {
    /// Slot of the row after the one in a slot; of a free slot, the next free one.
    next: Vec<u32>,
    /// Number of the segment that a row belongs to.
    segments: Vec<u64>,
    /// The first free slot, or one past the last where there is none.
    free: usize,
    rows: usize,
}

impl Slots {
    /// So many, for segments that leave in the order in which they came, or else in any; all are free.
    pub(crate) fn new(slots: usize, in_order: bool) -> Self {
        if in_order {
            Self::InOrder(InOrder { slots, first: 0, rows: 0 })
        } else {
            // A ring has at most 2^31 transitions, and an eighth more of rows.
            let next = (1..=slots as u32).collect();
            Self::Linked(Linked { next, segments: vec![0; slots], free: 0, rows: 0 })
        }
    }

    /// All there are, free or not.
    #[cfg(test)]
    pub(crate) fn count(&self) -> usize {
        match self {
            Self::InOrder(order) => order.slots,
            Self::Linked(linked) => linked.next.len(),
        }
    }

    /// Rows that take one.
    #[inline]
    pub(crate) fn rows(&self) -> usize {
        match self {
            Self::InOrder(order) => order.rows,
            Self::Linked(linked) => linked.rows,
        }
    }

    /// Slots that are free.
    pub(crate) fn free(&self) -> usize {
        match self {
            Self::InOrder(order) => order.slots - order.rows,
            Self::Linked(linked) => linked.next.len() - linked.rows,
        }
    }

    /// Takes slots for the rows of the segment `number`, at most as many as are free; returns the first.
    pub(crate) fn take(&mut self, rows: usize, number: u64) -> usize {
        match self {
            Self::InOrder(order) => {
                order.rows += rows;
                order.nth(order.rows - rows)
            }
            Self::Linked(linked) => {
                let first = linked.free;
                for _ in 0..rows {
                    linked.segments[linked.free] = number;
                    linked.free = linked.next[linked.free] as usize;
                }
                linked.rows += rows;
                first
            }
        }
    }

    /// Gives back those of a segment that begins at `first`; the oldest, where segments leave in order.
    pub(crate) fn give_back(&mut self, first: usize, rows: usize) {
        let last = self.ahead(first, rows - 1);
        match self {
            Self::InOrder(order) => {
                debug_assert_eq!(order.first, first);
                order.first = order.nth(rows);
                order.rows -= rows;
            }
            Self::Linked(linked) => {
                linked.next[last] = linked.free as u32;
                linked.free = first;
                linked.rows -= rows;
            }
        }
    }

    /// The slot of the row after the one in `slot`, in the same segment.
    #[inline]
    pub(crate) fn after(&self, slot: usize) -> usize {
        match self {
            Self::InOrder(order) => {
                if slot + 1 == order.slots {
                    0
                } else {
                    slot + 1
                }
            }
            Self::Linked(linked) => linked.next[slot] as usize,
        }
    }

    /// The slots of so many rows of one segment, from the one in `slot` on.
    pub(crate) fn walk(&self, slot: usize, rows: usize) -> impl Iterator<Item = usize> {
        iter::successors(Some(slot), |&slot| Some(self.after(slot))).take(rows)
    }

    /// The slot of the row so many steps after the one in `slot`, in the same segment.
    pub(crate) fn ahead(&self, slot: usize, steps: usize) -> usize {
        match self {
            Self::InOrder(order) => order.wrapped(slot + steps),
            Self::Linked(_) => (0..steps).fold(slot, |slot, _| self.after(slot)),
        }
    }

    /// The slot of the `n`th row from the oldest, where rows are in order; else the slot `n`.
    #[inline]
    pub(crate) fn nth(&self, n: usize) -> usize {
        match self {
            Self::InOrder(order) => order.nth(n),
            Self::Linked(_) => n,
        }
    }
}

impl InOrder {
    #[inline]
    fn nth(&self, n: usize) -> usize {
        self.wrapped(self.first + n)
    }

    /// How many rows are older than the one in `slot`.
    #[inline]
    pub(crate) fn age(&self, slot: usize) -> usize {
        if slot < self.first { slot + self.slots - self.first } else { slot - self.first }
    }

    #[inline]
    fn wrapped(&self, slot: usize) -> usize {
        if slot < self.slots { slot } else { slot - self.slots }
    }
}

impl Linked {
    /// Number of the segment that the row in `slot` belongs to.
    pub(crate) fn segment(&self, slot: usize) -> u64 {
        self.segments[slot]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::HashSet;

    proptest! {
        #[test]
        fn every_segment_has_its_own_slots_for_as_long_as_it_is_there(
            in_order: bool,
            steps in prop::collection::vec((1usize..9, any::<prop::sample::Index>()), 1..200),
        ) {
            let count = 40;
            let mut slots = Slots::new(count, in_order);
            let mut there: Vec<(u64, usize, Vec<usize>)> = Vec::new();
            for (number, (rows, leaves)) in (100..).zip(steps) {
                while slots.free() < rows {
                    let place = if in_order { 0 } else { leaves.index(there.len()) };
                    let (_, first, taken) = there.remove(place);
                    slots.give_back(first, taken.len());
                }
                let first = slots.take(rows, number);
                there.push((number, first, slots.walk(first, rows).collect()));

                let mut seen = HashSet::new();
                for (number, first, taken) in &there {
                    prop_assert_eq!(&slots.walk(*first, taken.len()).collect::<Vec<_>>(), taken);
                    for (step, &slot) in taken.iter().enumerate() {
                        prop_assert!(slot < count && seen.insert(slot), "slot {} of {:?}", slot, &there);
                        prop_assert_eq!(slots.ahead(*first, step), slot);
                        match &slots {
                            Slots::InOrder(order) => {
                                prop_assert_eq!(order.age(slot), seen.len() - 1);
                                prop_assert_eq!(slots.nth(seen.len() - 1), slot);
                            }
                            Slots::Linked(linked) => prop_assert_eq!(linked.segment(slot), *number),
                        }
                    }
                }
                prop_assert_eq!((slots.rows(), slots.free()), (seen.len(), count - seen.len()));
            }
        }
    }
}
