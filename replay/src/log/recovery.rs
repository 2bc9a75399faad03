//! Reading a log back, and finding out whether it is whole: [`Recovered`].

use super::record::{self, Key, Mark, State};
use super::{Generation, TREE_PREFIX, Writers, open_sled};
use crate::error::StoreError;
use getup_proto::{RunSpec, Segment};
use std::collections::VecDeque;
use std::ops::Range;
use std::path::Path;

/// sled keeps in memory what was read from it, whatever its cache's capacity: after so many bytes it is closed and
/// opened again.
const MOST_BYTES_READ: usize = 64 << 20;

/// What a log was found to hold.
#[derive(Debug, Default)]
pub(crate) struct Recovered {
    /// Oldest first.
    pub(super) generations: VecDeque<Generation>,
    pub(super) state: State,
    pub(super) writers: Writers,
    /// Numbers of the segments found; None before the first.
    found: Option<Range<u64>>,
    /// Since sled was opened.
    bytes_read: usize,
}

/// A segment whose pieces are being read.
struct Partial {
    number: u64,
    pieces: u16,
    message: Vec<u8>,
}

fn generation_number(tree_name: &[u8]) -> Option<u64> {
    u64::from_str_radix(str::from_utf8(tree_name).ok()?.strip_prefix(TREE_PREFIX)?, 16).ok()
}

impl Recovered {
    /// Opens sled, reads all generations, passes their segments to `replay`, and checks that they are all there:
    /// without a gap, as many as the totals say, and at least as many as were `acknowledged`.
    pub(super) fn read(
        dir: &Path,
        spec: &RunSpec,
        acknowledged: u64,
        mut replay: impl FnMut(&Segment),
    ) -> Result<(sled::Db, Self), StoreError> {
        let mut db = open_sled(dir)?;
        let mut numbers: Vec<u64> =
            db.tree_names().iter().filter_map(|name| generation_number(name)).collect();
        numbers.sort_unstable();
        let mut recovered = Self::default();
        for number in numbers {
            let mut generation =
                Generation { number, first_segment: recovered.state.segments, transitions: 0 };
            let tree = db.open_tree(generation.tree_name()).map_err(StoreError::sled(dir))?;
            let found = recovered.read_generation(&tree, spec, &mut replay).map_err(|error| match error {
                Unreadable::Sled(error) => StoreError::sled(dir)(error),
                Unreadable::Damaged(what) => StoreError::damaged(dir, what),
            })?;
            if let Some(transitions) = found {
                generation.transitions = transitions;
                recovered.generations.push_back(generation);
            } else {
                // Killed between the creation of the tree and its first commit.
                db.drop_tree(generation.tree_name()).map_err(StoreError::sled(dir))?;
            }
            if recovered.bytes_read > MOST_BYTES_READ {
                recovered.bytes_read = 0;
                drop((tree, db));
                db = open_sled(dir)?;
            }
        }
        if let (Some(oldest), Some(found)) = (recovered.generations.front_mut(), &recovered.found) {
            oldest.first_segment = found.start;
        }
        recovered.check_whole(acknowledged).map_err(|what| StoreError::damaged(dir, what))?;
        Ok((db, recovered))
    }

    fn check_whole(&self, acknowledged: u64) -> Result<(), String> {
        let State { segments, oldest, .. } = self.state;
        if segments < acknowledged {
            return Err(format!(
                "it acknowledged {acknowledged} segments and holds the first {segments} (a power loss does this \
                 too, unless replay.sync is \"data\")"
            ));
        }
        match &self.found {
            Some(found) if found.start > oldest => {
                Err(format!("it should begin with segment {oldest} and begins with {}", found.start))
            }
            _ => Ok(()),
        }
    }

    /// Reads a generation and returns its transitions; None if it is empty.
    fn read_generation(
        &mut self,
        tree: &sled::Tree,
        spec: &RunSpec,
        replay: &mut impl FnMut(&Segment),
    ) -> Result<Option<u64>, Unreadable> {
        let mut state = None;
        let mut transitions = 0;
        let mut partial: Option<Partial> = None;
        for entry in tree.iter() {
            let (key, value) = entry.map_err(Unreadable::Sled)?;
            self.bytes_read += value.len();
            let decoded = Key::decode(&key).zip(record::unseal(&key, &value));
            let (key, payload) = decoded.ok_or_else(|| damaged("a record fails its checksum"))?;
            match key {
                Key::State => {
                    state = Some(State::decode(payload).ok_or_else(|| damaged("its totals cannot be read"))?);
                }
                Key::Piece { segment, piece } => {
                    if partial.as_ref().is_some_and(|partial| partial.number != segment) {
                        transitions += self.finish(partial.take(), spec, replay)?;
                    }
                    let partial =
                        partial.get_or_insert(Partial { number: segment, pieces: 0, message: Vec::new() });
                    if piece != partial.pieces {
                        return Err(damaged(format!("segment {segment} lacks a piece")));
                    }
                    partial.pieces += 1;
                    partial.message.extend_from_slice(payload);
                }
                Key::Writer(writer) => {
                    let mark =
                        Mark::decode(payload).ok_or_else(|| damaged("a writer's mark cannot be read"))?;
                    self.writers.restore(writer, mark);
                }
            }
        }
        transitions += self.finish(partial, spec, replay)?;
        match (state, &self.found) {
            (None, _) if transitions == 0 => Ok(None),
            (Some(state), Some(found)) if state.segments == found.end && transitions > 0 => {
                self.state = state;
                Ok(Some(transitions))
            }
            _ => Err(damaged("its totals and its segments disagree")),
        }
    }

    /// Hands on a segment whose pieces have all come, and returns its transitions.
    fn finish(
        &mut self,
        partial: Option<Partial>,
        spec: &RunSpec,
        replay: &mut impl FnMut(&Segment),
    ) -> Result<u64, Unreadable> {
        let Some(Partial { number, message, .. }) = partial else { return Ok(0) };
        let found = self.found.get_or_insert(number..number);
        if found.end != number {
            return Err(damaged(format!("segment {} is missing", found.end)));
        }
        found.end += 1;
        let segment = record::segment_from(message, spec)
            .map_err(|error| damaged(format!("segment {number} cannot be read ({error})")))?;
        replay(&segment);
        Ok(segment.steps as u64)
    }
}

/// Why a generation cannot be read.
enum Unreadable {
    Sled(sled::Error),
    Damaged(String),
}

fn damaged(what: impl Into<String>) -> Unreadable {
    Unreadable::Damaged(what.into())
}
