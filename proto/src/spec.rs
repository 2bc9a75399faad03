//! What the transitions of a run look like: [`RunSpec`].

use crate::{OLDEST_PROTOCOL, PROTOCOL, columns, v1};
use serde::{Deserialize, Serialize};
use std::collections::HashSet;

/// How many rows a column has in a segment of T steps.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rows {
    /// T rows, one a step.
    Steps,
    /// T + 1 rows: the state before each step and the one after the last.
    StepsPlusOne,
    /// One row, the same in every segment of an episode.
    Once,
}

impl Rows {
    /// Rows of a segment of `steps` steps.
    pub fn count(self, steps: usize) -> usize {
        match self {
            Self::Steps => steps,
            Self::StepsPlusOne => steps + 1,
            Self::Once => 1,
        }
    }
}

/// One column: its rows have `width` values of `f32`.
#[derive(Clone, PartialEq, Eq, Debug, Serialize, Deserialize)]
pub struct ColumnSpec {
    /// Unique in its spec; lower-case letters, digits and `_`.
    pub name: String,
    /// Values a row, from 1.
    pub width: usize,
    /// Rows a segment.
    pub rows: Rows,
}

/// What the transitions of a run look like. Everything that is stored or sampled follows it.
#[derive(Clone, PartialEq, Eq, Debug, Serialize, Deserialize)]
pub struct RunSpec {
    /// The run's name.
    pub run: String,
    /// Who produces the columns: the task and what of it shapes a transition, each after a `/`.
    pub task: String,
    /// The columns of a segment, in this order.
    pub columns: Vec<ColumnSpec>,
    /// The longest segment that is accepted, in steps, from 1.
    pub max_segment_steps: usize,
}

/// Why a spec is refused.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
pub enum SpecError {
    /// The message has no spec.
    #[error("the message carries no run spec: fill in its `spec`")]
    Missing,
    /// The run or the task has no name.
    #[error("the spec's {0} has no name: name it")]
    Unnamed(&'static str),
    /// Nothing to store.
    #[error("the spec has no columns: name at least one")]
    NoColumns,
    /// The name of a column is not lower-case letters, digits and `_`.
    #[error("`{0}` cannot name a column: use lower-case letters, digits and `_`")]
    Name(String),
    /// The name belongs to a column that sampling adds.
    #[error("column `{0}` has a name that minibatches use: rename it (`discount` and `next_…` are taken)")]
    Reserved(String),
    /// Two columns share a name.
    #[error("two columns are named `{0}`: rename one")]
    Duplicate(String),
    /// The rows of a column are not specified.
    #[error("column `{0}` does not say how many rows it has: set `rows`")]
    Rows(String),
    /// A width out of range.
    #[error("column `{name}` has width {width}: it must lie in 1..={MAX_WIDTH}")]
    Width {
        /// The column.
        name: String,
        /// Its width.
        width: usize,
    },
    /// Rewards are summed over steps, and so are one number a step.
    #[error("column `reward` must have one value a step (width 1, rows `steps`): rename it if it is none")]
    Reward,
    /// A segment limit out of range.
    #[error("max_segment_steps is {0}: it must lie in 1..={MAX_SEGMENT_STEPS}")]
    SegmentSteps(usize),
    /// A segment would not fit into a message.
    #[error(
        "a segment of max_segment_steps would have {bytes} bytes, and {MAX_SEGMENT_BYTES} fit into a message: \
         lower max_segment_steps"
    )]
    SegmentBytes {
        /// Of its columns.
        bytes: usize,
    },
    /// The peer speaks another version of the protocol.
    #[error(
        "the sender speaks version {theirs} of the protocol, the receiver {OLDEST_PROTOCOL} to {PROTOCOL}: upgrade the \
         {older}"
    )]
    Protocol {
        /// As it says; 0 is from before there were versions.
        theirs: u32,
        /// Whose getup is too old; both sides read this.
        older: &'static str,
    },
    /// Two specs that should be the same are not.
    #[error(
        "another run's spec: {what} is {theirs} and should be {ours}. Give every role the same configuration, \
         or start a new run"
    )]
    Differs {
        /// The first field that differs.
        what: String,
        /// As it should be.
        ours: String,
        /// As it came.
        theirs: String,
    },
}

/// A peer of another run, or of another version, is not at fault by itself: what it asks for has no place here.
impl From<SpecError> for tonic::Status {
    fn from(error: SpecError) -> Self {
        match error {
            SpecError::Protocol { .. } | SpecError::Differs { .. } => {
                Self::failed_precondition(error.to_string())
            }
            malformed => Self::invalid_argument(malformed.to_string()),
        }
    }
}

/// The widest column, in values.
const MAX_WIDTH: usize = 1 << 20;
/// The longest segment, in steps.
const MAX_SEGMENT_STEPS: usize = 1 << 16;
/// The largest segment, in bytes of its columns: a message holds it with room to spare.
const MAX_SEGMENT_BYTES: usize = crate::MAX_MESSAGE_BYTES / 2;

impl RunSpec {
    /// Parses the spec of a message.
    ///
    /// # Errors
    /// [`SpecError`] if it is malformed.
    pub fn parse(wire: v1::RunSpec) -> Result<Self, SpecError> {
        match wire.protocol {
            theirs if theirs < OLDEST_PROTOCOL => {
                return Err(SpecError::Protocol { theirs, older: "sender" });
            }
            theirs if theirs > PROTOCOL => return Err(SpecError::Protocol { theirs, older: "receiver" }),
            _ => {}
        }
        let columns = wire.columns.into_iter().map(ColumnSpec::parse).collect::<Result<_, _>>()?;
        let spec = Self {
            run: wire.run,
            task: wire.task,
            columns,
            max_segment_steps: wire.max_segment_steps as usize,
        };
        spec.validate()?;
        Ok(spec)
    }

    /// Checks a spec that was put together by hand, as [`RunSpec::parse`] does.
    ///
    /// # Errors
    /// [`SpecError`] if it is malformed.
    pub fn validate(&self) -> Result<(), SpecError> {
        if self.run.is_empty() {
            return Err(SpecError::Unnamed("run"));
        }
        if self.task.is_empty() {
            return Err(SpecError::Unnamed("task"));
        }
        if self.columns.is_empty() {
            return Err(SpecError::NoColumns);
        }
        let mut names = HashSet::new();
        for column in &self.columns {
            column.validate()?;
            if !names.insert(&column.name) {
                return Err(SpecError::Duplicate(column.name.clone()));
            }
        }
        if !(1..=MAX_SEGMENT_STEPS).contains(&self.max_segment_steps) {
            return Err(SpecError::SegmentSteps(self.max_segment_steps));
        }
        let bytes = self.columns.iter().map(|c| c.bytes(self.max_segment_steps)).sum();
        if bytes > MAX_SEGMENT_BYTES {
            return Err(SpecError::SegmentBytes { bytes });
        }
        Ok(())
    }

    /// The spec as a message.
    pub fn to_wire(&self) -> v1::RunSpec {
        v1::RunSpec {
            run: self.run.clone(),
            task: self.task.clone(),
            columns: self.columns.iter().map(ColumnSpec::to_wire).collect(),
            max_segment_steps: self.max_segment_steps as u32,
            protocol: PROTOCOL,
        }
    }

    /// Index of the column of this name.
    pub fn column(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|column| column.name == name)
    }

    /// Whether `other` is this very spec.
    ///
    /// # Errors
    /// [`SpecError::Differs`] with the first field that differs; `other` is "theirs".
    pub fn check_same(&self, other: &Self) -> Result<(), SpecError> {
        let differs = |what: &str, ours: String, theirs: String| {
            Err(SpecError::Differs { what: what.to_owned(), ours, theirs })
        };
        if self.run != other.run {
            return differs("the run", format!("`{}`", self.run), format!("`{}`", other.run));
        }
        if self.task != other.task {
            return differs("the task", format!("`{}`", self.task), format!("`{}`", other.task));
        }
        if self.columns.len() != other.columns.len() {
            let count = |spec: &Self| spec.columns.len().to_string();
            return differs("the number of columns", count(self), count(other));
        }
        for (ours, theirs) in self.columns.iter().zip(&other.columns) {
            if ours != theirs {
                return differs(&format!("column `{}`", ours.name), ours.describe(), theirs.describe());
            }
        }
        if self.max_segment_steps != other.max_segment_steps {
            let steps = |spec: &Self| spec.max_segment_steps.to_string();
            return differs("max_segment_steps", steps(self), steps(other));
        }
        Ok(())
    }
}

impl ColumnSpec {
    /// Bytes of this column in a segment of `steps` steps.
    pub fn bytes(&self, steps: usize) -> usize {
        self.rows.count(steps) * self.width * columns::VALUE_BYTES
    }

    fn parse(wire: v1::ColumnSpec) -> Result<Self, SpecError> {
        let rows = match wire.rows() {
            v1::Rows::Unspecified => return Err(SpecError::Rows(wire.name)),
            v1::Rows::Steps => Rows::Steps,
            v1::Rows::StepsPlusOne => Rows::StepsPlusOne,
            v1::Rows::Once => Rows::Once,
        };
        Ok(Self { name: wire.name, width: wire.width as usize, rows })
    }

    fn to_wire(&self) -> v1::ColumnSpec {
        let rows = match self.rows {
            Rows::Steps => v1::Rows::Steps,
            Rows::StepsPlusOne => v1::Rows::StepsPlusOne,
            Rows::Once => v1::Rows::Once,
        };
        v1::ColumnSpec { name: self.name.clone(), width: self.width as u32, rows: rows.into() }
    }

    fn validate(&self) -> Result<(), SpecError> {
        let name = self.name.as_str();
        let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        if name.is_empty() || !name.chars().all(allowed) {
            return Err(SpecError::Name(name.to_owned()));
        }
        if name == columns::DISCOUNT || name.starts_with(columns::NEXT_PREFIX) {
            return Err(SpecError::Reserved(name.to_owned()));
        }
        if !(1..=MAX_WIDTH).contains(&self.width) {
            return Err(SpecError::Width { name: name.to_owned(), width: self.width });
        }
        if name == columns::REWARD && (self.width != 1 || self.rows != Rows::Steps) {
            return Err(SpecError::Reward);
        }
        Ok(())
    }

    fn describe(&self) -> String {
        let rows = match self.rows {
            Rows::Steps => "a step",
            Rows::StepsPlusOne => "a step and one more",
            Rows::Once => "once an episode",
        };
        format!("`{}` ({} values {rows})", self.name, self.width)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec() -> RunSpec {
        let column = |name: &str, width, rows| ColumnSpec { name: name.to_owned(), width, rows };
        RunSpec {
            run: "first".to_owned(),
            task: "get_up/standard".to_owned(),
            columns: vec![
                column("observation", 68, Rows::StepsPlusOne),
                column("action", 21, Rows::Steps),
                column("reward", 1, Rows::Steps),
                column("beta", 1, Rows::Once),
            ],
            max_segment_steps: 64,
        }
    }

    #[test]
    fn a_spec_survives_the_wire() {
        assert_eq!(RunSpec::parse(spec().to_wire()), Ok(spec()));
        assert_eq!(spec().column("reward"), Some(2));
        assert_eq!(spec().column("torque"), None);
    }

    #[test]
    fn another_protocol_is_refused_by_who_has_to_upgrade() {
        let of =
            |protocol| RunSpec::parse(v1::RunSpec { protocol, ..spec().to_wire() }).unwrap_err().to_string();
        assert!(of(OLDEST_PROTOCOL - 1).ends_with("upgrade the sender"));
        assert!(of(PROTOCOL + 1).ends_with("upgrade the receiver"));
    }

    #[test]
    fn a_malformed_spec_is_refused_with_its_reason() {
        let refused = |change: &dyn Fn(&mut RunSpec)| {
            let mut spec = spec();
            change(&mut spec);
            RunSpec::parse(spec.to_wire()).expect_err("the spec is malformed")
        };
        assert_eq!(refused(&|s| s.run.clear()), SpecError::Unnamed("run"));
        assert_eq!(refused(&|s| s.task.clear()), SpecError::Unnamed("task"));
        assert_eq!(refused(&|s| s.columns.clear()), SpecError::NoColumns);
        assert_eq!(refused(&|s| s.columns[0].name = "A b".into()), SpecError::Name("A b".into()));
        assert_eq!(refused(&|s| s.columns[0].name = "next_x".into()), SpecError::Reserved("next_x".into()));
        assert_eq!(refused(&|s| s.columns[0].name = "action".into()), SpecError::Duplicate("action".into()));
        let zero = SpecError::Width { name: "action".into(), width: 0 };
        assert_eq!(refused(&|s| s.columns[1].width = 0), zero);
        assert_eq!(refused(&|s| s.columns[2].width = 2), SpecError::Reward);
        assert_eq!(refused(&|s| s.max_segment_steps = 0), SpecError::SegmentSteps(0));
        assert!(matches!(refused(&|s| s.columns[0].width = 1 << 20), SpecError::SegmentBytes { .. }));

        let mut wire = spec().to_wire();
        wire.columns[3].rows = 9;
        assert_eq!(RunSpec::parse(wire), Err(SpecError::Rows("beta".into())));
    }

    #[test]
    fn the_first_difference_between_two_specs_is_named() {
        let difference = |change: &dyn Fn(&mut RunSpec)| {
            let mut other = spec();
            change(&mut other);
            spec().check_same(&other).expect_err("the specs differ").to_string()
        };
        assert_eq!(spec().check_same(&spec()), Ok(()));
        assert!(
            difference(&|s| s.run = "second".into()).contains("the run is `second` and should be `first`")
        );
        assert!(difference(&|s| s.task = "walk".into()).contains("the task is `walk`"));
        assert!(difference(&|s| s.columns.truncate(3)).contains("number of columns is 3 and should be 4"));
        assert!(
            difference(&|s| s.columns[1].width = 20)
                .contains("column `action` is `action` (20 values a step)")
        );
        assert!(difference(&|s| s.max_segment_steps = 32).contains("max_segment_steps is 32"));
    }
}
