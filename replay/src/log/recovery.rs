//! Reading a log back, and finding out whether it is whole: [`Recovered`].

use super::files;
use super::index::Content;
use super::record::{self, Records, State};
use super::{Held, Writers};
use crate::error::StoreError;
use getup_proto::{RunSpec, Segment};
use std::collections::VecDeque;
use std::path::Path;

/// What a log was found to hold.
#[derive(Debug, Default)]
pub(super) struct Recovered {
    /// Oldest first.
    pub(super) files: VecDeque<Held>,
    pub(super) state: State,
    pub(super) writers: Writers,
    /// Bytes of the newest file that are whole.
    pub(super) end: u64,
}

impl Recovered {
    /// Reads all files, passes their segments to `replay`, and checks that they are all there: without a gap, as
    /// the files' headers count them, and at least as many as were `acknowledged`.
    ///
    /// What a kill leaves behind is no damage: a last commit that is cut off, which nobody was told of, and a file
    /// that the index knows to be dropped.
    pub(super) fn read(
        dir: &Path,
        spec: &RunSpec,
        acknowledged: u64,
        index: Content,
        mut replay: impl FnMut(&Segment),
    ) -> Result<Self, StoreError> {
        let mut recovered = Self::default();
        for (writer, mark) in index.marks {
            recovered.writers.restore(writer, mark);
        }
        recovered.state.oldest = index.oldest;
        let firsts = files::list(dir)?;
        for &first in firsts.iter().filter(|&&first| first < index.oldest) {
            files::remove(dir, first)?;
        }
        let kept: Vec<u64> = firsts.into_iter().filter(|&first| first >= index.oldest).collect();
        for (place, &first) in kept.iter().enumerate() {
            let newest = place + 1 == kept.len();
            recovered.read_file(dir, first, newest, acknowledged, spec, &mut replay)?;
        }
        if recovered.state.segments < acknowledged {
            let segments = recovered.state.segments;
            return Err(StoreError::damaged(
                dir,
                format!(
                    "it acknowledged {acknowledged} segments and holds the first {segments} (a power loss does \
                     this too, unless replay.sync is \"data\")"
                ),
            ));
        }
        Ok(recovered)
    }

    fn read_file(
        &mut self,
        dir: &Path,
        first: u64,
        newest: bool,
        acknowledged: u64,
        spec: &RunSpec,
        replay: &mut impl FnMut(&Segment),
    ) -> Result<(), StoreError> {
        let name = || files::path(dir, first).file_name().unwrap_or_default().display().to_string();
        let damaged = |what: String| StoreError::damaged(dir, format!("{}: {what}", name()));
        let content = files::read(dir, first)?;
        let Some(before) = record::header(&content) else {
            if newest && first >= acknowledged && content.len() < record::HEADER_BYTES {
                // Killed while it was begun.
                return files::remove(dir, first);
            }
            return Err(damaged("its header cannot be read".to_owned()));
        };
        let expected =
            if self.files.is_empty() { State { oldest: self.state.oldest, ..before } } else { self.state };
        if self.files.is_empty() && first > self.state.oldest {
            return Err(damaged(format!("the file of segment {} should come before it", self.state.oldest)));
        }
        if first != before.segments || (State { oldest: expected.oldest, ..before }) != expected {
            return Err(damaged(format!(
                "it begins after {} segments and {} transitions, and what comes before has {} and {}",
                before.segments, before.transitions, expected.segments, expected.transitions
            )));
        }
        self.state = expected;
        let mut transitions = 0;
        let mut records = Records::new(content);
        let mut whole = records.position();
        while let Some(record) = records.next() {
            let number = self.state.segments;
            let record = match record {
                Ok(record) => record,
                // Cut off while it was written: nobody was told of it, nor of what may follow.
                Err(_) if newest && number >= acknowledged => break,
                Err(torn) => {
                    return Err(damaged(format!(
                        "bytes {} to {} are no whole segment (it should be segment {number})",
                        torn.bytes.start, torn.bytes.end
                    )));
                }
            };
            if record.number != number {
                return Err(damaged(format!("segment {number} is missing: {} follows", record.number)));
            }
            let segment = record
                .segment(spec)
                .map_err(|error| damaged(format!("segment {number} cannot be read ({error})")))?;
            self.writers.advance(segment.writer, segment.sequence, number);
            self.state.add(&segment);
            transitions += segment.steps as u64;
            whole = records.position();
            replay(&segment);
        }
        self.files.push_back(Held { first, transitions });
        self.end = whole as u64;
        Ok(())
    }
}
