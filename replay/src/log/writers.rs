//! How far each writer's segments are durable: [`Writers`], what makes appends idempotent.
//!
//! The sequence numbers of a writer increase. One that is not above the writer's mark was stored before, be it
//! that its segment has been evicted since, and is not stored again. Gaps are allowed: a writer may drop a segment
//! it could not send, and goes on where it was when it meets a new store.

use super::record::Mark;
use std::collections::HashMap;

/// More writers than a cluster has: beyond, the one that was silent for longest is forgotten.
const MOST_WRITERS: usize = 16_384;

/// The mark of every writer.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub(crate) struct Writers {
    marks: HashMap<u64, Mark>,
}

impl Writers {
    /// The greatest sequence number of the writer that is durable; 0 if none is.
    pub(crate) fn durable(&self, writer: u64) -> u64 {
        self.marks.get(&writer).map_or(0, |mark| mark.sequence)
    }

    /// Notes that the log's `segment` came from this writer. False, and no change, if it was stored before.
    pub(crate) fn advance(&mut self, writer: u64, sequence: u64, segment: u64) -> bool {
        let new = sequence > self.durable(writer);
        if new {
            self.marks.insert(writer, Mark { sequence, segment });
        }
        new
    }

    /// What these marks become by a commit that may yet fail; [`Writers::accept`] when it has not.
    pub(crate) fn pending(&self) -> Pending<'_> {
        Pending { writers: self, moved: Self::default() }
    }

    /// Takes over the marks that a commit has moved.
    pub(crate) fn accept(&mut self, moved: Self) {
        self.marks.extend(moved.marks);
    }

    /// Takes over a mark that was stored.
    pub(crate) fn restore(&mut self, writer: u64, mark: Mark) {
        let known = self.marks.entry(writer).or_insert(mark);
        if mark.sequence > known.sequence {
            *known = mark;
        }
    }

    /// All marks, in no order.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (u64, Mark)> {
        self.marks.iter().map(|(&writer, &mark)| (writer, mark))
    }

    /// Forgets the longest-silent writers beyond [`MOST_WRITERS`], and returns them.
    pub(crate) fn forget_excess(&mut self) -> Vec<u64> {
        if self.marks.len() <= MOST_WRITERS {
            return Vec::new();
        }
        let mut ages: Vec<u64> = self.marks.values().map(|mark| mark.segment).collect();
        let excess = ages.len() - MOST_WRITERS;
        let (_, &mut oldest_kept, _) = ages.select_nth_unstable(excess);
        self.marks.extract_if(|_, mark| mark.segment < oldest_kept).map(|(writer, _)| writer).collect()
    }
}

/// Marks before a commit, and those that it moves.
#[derive(Debug)]
pub(crate) struct Pending<'a> {
    writers: &'a Writers,
    moved: Writers,
}

impl Pending<'_> {
    /// As [`Writers::advance`].
    pub(crate) fn advance(&mut self, writer: u64, sequence: u64, segment: u64) -> bool {
        sequence > self.writers.durable(writer) && self.moved.advance(writer, sequence, segment)
    }

    /// The marks that have moved.
    pub(crate) fn moved(self) -> Writers {
        self.moved
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::HashSet;

    proptest! {
        #[test]
        fn each_sequence_number_of_a_writer_is_taken_once_and_only_upwards(
            appends in prop::collection::vec((0u64..3, 1u64..20), 0..200),
        ) {
            let mut writers = Writers::default();
            let mut taken = HashSet::new();
            for (segment, (writer, sequence)) in (0..).zip(appends) {
                let before = writers.durable(writer);
                let new = writers.advance(writer, sequence, segment);
                prop_assert_eq!(new, sequence > before);
                prop_assert!(!new || taken.insert((writer, sequence)));
                prop_assert_eq!(writers.durable(writer), before.max(sequence));
            }
        }
    }

    #[test]
    fn beyond_the_limit_the_longest_silent_writers_are_forgotten() {
        let mut writers = Writers::default();
        for writer in 0..MOST_WRITERS as u64 + 10 {
            writers.advance(writer, 1, writer);
        }
        writers.advance(0, 2, 1 << 40);
        let mut forgotten = writers.forget_excess();
        forgotten.sort_unstable();
        assert_eq!(forgotten, (1..=10).collect::<Vec<_>>());
        assert_eq!(writers.marks.len(), MOST_WRITERS);
        assert_eq!((writers.durable(0), writers.durable(10), writers.durable(11)), (2, 0, 1));
    }
}
