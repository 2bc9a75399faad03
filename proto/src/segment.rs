//! A stretch of one episode: [`Segment`], the unit that is written, stored and evicted.

use crate::{PolicyVersion, RunSpec, SegmentTrace, columns, v1};
use bytes::Bytes;
use std::collections::BTreeMap;

/// Up to [`RunSpec::max_segment_steps`] consecutive steps of one episode of one lane, as columns.
#[derive(Clone, PartialEq, Debug)]
pub struct Segment {
    /// Who wrote it.
    pub writer: u64,
    /// Its place in the order of that writer, from 1: with `writer`, what makes an append idempotent.
    pub sequence: u64,
    /// Of the writer's lanes, the one that played it.
    pub lane: u32,
    /// Counts the episodes of the lane.
    pub episode: u64,
    /// Index in the episode of the first step, limp steps included.
    pub first_step: u32,
    /// Steps, from 1.
    pub steps: usize,
    /// Of the steps, how many are env steps: limp ones are stored and do not count.
    pub env_steps: u32,
    /// The last step ended the episode in a terminal state, which is worth nothing more.
    pub terminal: bool,
    /// The last step ended the episode at its time limit: its value goes on.
    pub truncated: bool,
    /// The curriculum's stage.
    pub stage: u32,
    /// The policy that chose the first action.
    pub first_version: PolicyVersion,
    /// The policy that chose the last action.
    pub last_version: PolicyVersion,
    /// One entry a column of the spec, in its order: rows × width little-endian `f32` (see [`columns`]).
    pub columns: Vec<Bytes>,
    /// Set on the episode's last segment alone.
    pub end: Option<EpisodeEnd>,
    /// Where it is followed, by what; no part of its message, and never stored.
    pub trace: Option<Box<SegmentTrace>>,
}

/// How an episode ended.
#[derive(Clone, PartialEq, Debug)]
pub struct EpisodeEnd {
    /// Sum of the rewards of its env steps.
    pub episode_return: f32,
    /// Env steps of the episode.
    pub env_steps: u32,
    /// `time_limit`, `terminal`.
    pub reason: String,
    /// Whatever the task wants told of an episode, such as the fall's kind.
    pub tags: BTreeMap<String, String>,
}

/// What an episode's end may say in words, in bytes.
const MAX_END_BYTES: usize = 4096;

/// Why a segment is refused.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
pub enum SegmentError {
    /// Sequences count from 1.
    #[error("a segment has sequence number 0: count from 1")]
    Sequence,
    /// No steps, or more than the spec allows.
    #[error("a segment has {steps} steps: the run's spec allows 1..={limit}; cut it")]
    Steps {
        /// Of the segment.
        steps: usize,
        /// Of the spec.
        limit: usize,
    },
    /// More env steps than steps, or an index that overflows.
    #[error(
        "a segment of {steps} steps from step {first_step} counts {env_steps} env steps: counts disagree"
    )]
    Counts {
        /// Of the segment.
        steps: usize,
        /// Of the segment.
        first_step: u32,
        /// Of the segment.
        env_steps: u32,
    },
    /// Terminal, truncated and the episode's end do not fit together.
    #[error(
        "a segment's end is inconsistent (terminal {terminal}, truncated {truncated}, end {end}): an episode's \
         last segment is either terminal or truncated and carries its end, any other is neither and carries none"
    )]
    End {
        /// Of the segment.
        terminal: bool,
        /// Of the segment.
        truncated: bool,
        /// Whether the end is there.
        end: bool,
    },
    /// A policy version is missing.
    #[error("a segment does not say which policies chose its actions: fill in both versions")]
    Version,
    /// Another number of columns than the spec.
    #[error("a segment has {columns} columns: the run's spec has {expected}")]
    Columns {
        /// Of the segment.
        columns: usize,
        /// Of the spec.
        expected: usize,
    },
    /// A column of another size than the spec and the steps demand.
    #[error(
        "column `{column}` of a segment of {steps} steps has {bytes} bytes: the run's spec says {expected}"
    )]
    Dimensions {
        /// Its name.
        column: String,
        /// Of the segment.
        steps: usize,
        /// Of the column.
        bytes: usize,
        /// Rows × width × 4.
        expected: usize,
    },
    /// Damaged on its way.
    #[error(
        "a segment's checksum is {computed:08x} and should be {carried:08x}: its bytes are damaged; send it again"
    )]
    Checksum {
        /// Of the bytes that came.
        computed: u32,
        /// The one that came with them.
        carried: u32,
    },
    /// NaN or infinity in a column.
    #[error(
        "column `{column}` holds {value} in row {row}, place {place}: drop the episode, its simulation diverged"
    )]
    NonFinite {
        /// Its name.
        column: String,
        /// From 0.
        row: usize,
        /// In the row, from 0.
        place: usize,
        /// NaN or an infinity.
        value: f32,
    },
    /// More to say of an episode's end than anybody has.
    #[error("an episode's end has {bytes} bytes of reason and tags: at most {MAX_END_BYTES} are taken")]
    EndBytes {
        /// Of both together.
        bytes: usize,
    },
    /// NaN or infinity as an episode's return.
    #[error("an episode's return is {0}: drop the episode, its simulation diverged")]
    Return(f32),
}

impl SegmentError {
    /// What is wrong, in one word, for a metric's label.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Sequence | Self::Counts { .. } | Self::End { .. } | Self::Version => "inconsistent",
            Self::Steps { .. } | Self::EndBytes { .. } => "length",
            Self::Columns { .. } | Self::Dimensions { .. } => "dimensions",
            Self::Checksum { .. } => "checksum",
            Self::NonFinite { .. } | Self::Return(_) => "non_finite",
        }
    }
}

impl Segment {
    /// Parses a message: afterwards the segment follows `spec`, is finite and undamaged.
    ///
    /// # Errors
    /// [`SegmentError`] with the first thing that is wrong.
    pub fn parse(wire: v1::Segment, spec: &RunSpec) -> Result<Self, SegmentError> {
        let carried = wire.crc32;
        let segment = Self::from_wire(wire)?;
        segment.check_counts(spec)?;
        segment.check_dimensions(spec)?;
        let computed = checksum(&segment.columns);
        if computed != carried {
            return Err(SegmentError::Checksum { computed, carried });
        }
        segment.check_values(spec)?;
        Ok(segment)
    }

    /// Checks a segment that was put together by hand, as [`Segment::parse`] does.
    ///
    /// # Errors
    /// [`SegmentError`] with the first thing that is wrong.
    pub fn check(&self, spec: &RunSpec) -> Result<(), SegmentError> {
        self.check_counts(spec)?;
        self.check_dimensions(spec)?;
        self.check_values(spec)
    }

    fn from_wire(wire: v1::Segment) -> Result<Self, SegmentError> {
        let (Some(first_version), Some(last_version)) = (wire.first_version, wire.last_version) else {
            return Err(SegmentError::Version);
        };
        Ok(Self {
            writer: wire.writer,
            sequence: wire.sequence,
            lane: wire.lane,
            episode: wire.episode,
            first_step: wire.first_step,
            steps: wire.steps as usize,
            env_steps: wire.env_steps,
            terminal: wire.terminal,
            truncated: wire.truncated,
            stage: wire.stage,
            first_version: first_version.into(),
            last_version: last_version.into(),
            columns: wire.columns,
            end: wire.end.map(EpisodeEnd::from),
            trace: None,
        })
    }

    /// The segment as a message, with its checksum and without its trace. Columns are shared, not copied.
    pub fn to_wire(&self) -> v1::Segment {
        v1::Segment {
            writer: self.writer,
            sequence: self.sequence,
            lane: self.lane,
            episode: self.episode,
            first_step: self.first_step,
            steps: self.steps as u32,
            env_steps: self.env_steps,
            terminal: self.terminal,
            truncated: self.truncated,
            stage: self.stage,
            first_version: Some(self.first_version.into()),
            last_version: Some(self.last_version.into()),
            crc32: checksum(&self.columns),
            columns: self.columns.clone(),
            end: self.end.clone().map(v1::EpisodeEnd::from),
        }
    }

    fn check_counts(&self, spec: &RunSpec) -> Result<(), SegmentError> {
        let Self { steps, first_step, env_steps, .. } = *self;
        if self.sequence == 0 {
            return Err(SegmentError::Sequence);
        }
        if !(1..=spec.max_segment_steps).contains(&steps) {
            return Err(SegmentError::Steps { steps, limit: spec.max_segment_steps });
        }
        // A spec's limit fits into 32 bits, and so does `steps`.
        if env_steps as usize > steps || first_step.checked_add(steps as u32).is_none() {
            return Err(SegmentError::Counts { steps, first_step, env_steps });
        }
        let ends = self.terminal || self.truncated;
        if ends != self.end.is_some() || (self.terminal && self.truncated) {
            let (terminal, truncated, end) = (self.terminal, self.truncated, self.end.is_some());
            return Err(SegmentError::End { terminal, truncated, end });
        }
        Ok(())
    }

    fn check_dimensions(&self, spec: &RunSpec) -> Result<(), SegmentError> {
        if self.columns.len() != spec.columns.len() {
            return Err(SegmentError::Columns { columns: self.columns.len(), expected: spec.columns.len() });
        }
        for (column, bytes) in spec.columns.iter().zip(&self.columns) {
            let expected = column.bytes(self.steps);
            if bytes.len() != expected {
                let column = column.name.clone();
                return Err(SegmentError::Dimensions {
                    column,
                    steps: self.steps,
                    bytes: bytes.len(),
                    expected,
                });
            }
        }
        Ok(())
    }

    fn check_values(&self, spec: &RunSpec) -> Result<(), SegmentError> {
        for (column, bytes) in spec.columns.iter().zip(&self.columns) {
            if let Some(index) = columns::first_non_finite(bytes) {
                let value = columns::iter(bytes).nth(index).unwrap_or(f32::NAN);
                let (row, place) = (index / column.width, index % column.width);
                return Err(SegmentError::NonFinite { column: column.name.clone(), row, place, value });
            }
        }
        let Some(end) = &self.end else { return Ok(()) };
        if !end.episode_return.is_finite() {
            return Err(SegmentError::Return(end.episode_return));
        }
        let tags = end.tags.iter().map(|(name, value)| name.len() + value.len()).sum::<usize>();
        let bytes = end.reason.len() + tags;
        if bytes > MAX_END_BYTES { Err(SegmentError::EndBytes { bytes }) } else { Ok(()) }
    }
}

impl From<v1::EpisodeEnd> for EpisodeEnd {
    fn from(wire: v1::EpisodeEnd) -> Self {
        Self {
            episode_return: wire.episode_return,
            env_steps: wire.env_steps,
            reason: wire.reason,
            tags: wire.tags.into_iter().collect(),
        }
    }
}

impl From<EpisodeEnd> for v1::EpisodeEnd {
    fn from(end: EpisodeEnd) -> Self {
        Self {
            episode_return: end.episode_return,
            env_steps: end.env_steps,
            reason: end.reason,
            tags: end.tags.into_iter().collect(),
        }
    }
}

/// CRC-32 (IEEE) over the columns, in order.
fn checksum(columns: &[Bytes]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    for column in columns {
        hasher.update(column);
    }
    hasher.finalize()
}

#[cfg(test)]
#[path = "segment_tests.rs"]
mod tests;
