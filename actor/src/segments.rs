//! Cuts the episodes of a lane into segments.
//!
//! A segment is full at its longest length, and ends where its episode ends or its fall does: its steps are all
//! limp or all env steps, so that env steps are counted exactly.

use std::collections::BTreeMap;
use std::time::SystemTime;

use bytes::Bytes;
use getup_proto::columns::{self, ACTION, BETA, OBSERVATION, REWARD};
use getup_proto::{EpisodeEnd, PolicyVersion, Rows, RunSpec, Segment, SegmentTrace};
use getup_telemetry::Traces;
use getup_telemetry::traces::SpanKind;
use thiserror::Error;

/// A run's spec asks for something that the actor or its task does not produce.
#[derive(Clone, PartialEq, Eq, Debug, Error)]
pub enum LayoutError {
    /// An unknown column.
    #[error(
        "the run's spec has a column {0:?}: an actor produces {OBSERVATION}, {ACTION}, {REWARD} and {BETA}"
    )]
    Unknown(String),
    /// A column of another width or with other rows than the task's.
    #[error(
        "column {name} of the run's spec has width {width} and rows {rows:?}, the task's {ours} and {our_rows:?}"
    )]
    Shape {
        /// The column.
        name: String,
        /// Width in the spec.
        width: usize,
        /// Rows in the spec.
        rows: Rows,
        /// Width that the task gives.
        ours: usize,
        /// Rows that an actor writes.
        our_rows: Rows,
    },
    /// Segments longer than the run accepts.
    #[error("actor.segment_steps is {steps}, the run accepts up to {limit}: lower it")]
    SegmentSteps {
        /// The actor's setting.
        steps: usize,
        /// The spec's limit.
        limit: usize,
    },
}

/// What a step does to its episode.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum StepEnd {
    /// The phase goes on.
    Continues,
    /// The fall is over: the next step is an env step.
    Landed,
    /// The episode ended in a terminal state.
    Terminal,
    /// The episode reached its time limit.
    TimeLimit,
}

/// One step, as it is stored.
#[derive(Clone, Copy, Debug)]
pub struct StepRecord<'a> {
    /// What was seen before the step.
    pub observation: &'a [f32],
    /// What was done.
    pub action: &'a [f32],
    /// The reward for the state that it led to.
    pub reward: f32,
    /// What was seen after the step.
    pub next_observation: &'a [f32],
    /// Whether it is an env step; a limp one is none.
    pub env_step: bool,
    /// The policy that acted, or was there to act.
    pub version: PolicyVersion,
    /// What the step does to its episode.
    pub end: StepEnd,
}

/// The columns that an actor can fill.
#[derive(Clone, Copy, Debug)]
enum Column {
    Observation,
    Action,
    Reward,
    Beta,
}

/// Collects the steps of one lane, episode after episode.
#[derive(Debug)]
pub struct SegmentBuilder {
    layout: Vec<Column>,
    segment_steps: usize,
    writer: u64,
    lane: u32,
    // Of the episode.
    episode: u64,
    stage: u32,
    beta: f32,
    steps_before: u32,
    env_steps: u32,
    episode_return: f64,
    // Of the segment under way.
    rewards: Vec<f32>,
    actions: Vec<f32>,
    /// One row a step; the last is added when the segment is cut.
    observations: Vec<f32>,
    segment_env_steps: u32,
    first_version: PolicyVersion,
    /// Where it is followed.
    trace: Option<SegmentTrace>,
    traces: Traces,
}

impl SegmentBuilder {
    /// A builder for `lane` of `writer`, whose segments follow `spec` and have up to `segment_steps` steps.
    ///
    /// # Errors
    /// [`LayoutError`] when the spec asks for what a task with these widths does not give.
    pub fn new(
        spec: &RunSpec,
        observation: usize,
        action: usize,
        segment_steps: usize,
        writer: u64,
        lane: u32,
    ) -> Result<Self, LayoutError> {
        if segment_steps > spec.max_segment_steps {
            return Err(LayoutError::SegmentSteps { steps: segment_steps, limit: spec.max_segment_steps });
        }
        Ok(Self {
            layout: layout(spec, observation, action)?,
            segment_steps,
            writer,
            lane,
            episode: 0,
            stage: 0,
            beta: 0.0,
            steps_before: 0,
            env_steps: 0,
            episode_return: 0.0,
            rewards: Vec::with_capacity(segment_steps),
            actions: Vec::with_capacity(segment_steps * action),
            observations: Vec::with_capacity((segment_steps + 1) * observation),
            segment_env_steps: 0,
            first_version: PolicyVersion::default(),
            trace: None,
            traces: Traces::default(),
        })
    }

    /// Follows some of the segments by `traces`.
    pub fn followed_by(self, traces: Traces) -> Self {
        Self { traces, ..self }
    }

    /// Begins an episode, and forgets what is left of one that was abandoned.
    pub fn begin(&mut self, episode: u64, stage: u32, beta: f32) {
        (self.episode, self.stage, self.beta) = (episode, stage, beta);
        (self.steps_before, self.env_steps, self.episode_return) = (0, 0, 0.0);
        self.clear();
    }

    /// Passes over a step that is not stored: it still has its place in the episode.
    pub fn skip(&mut self) {
        self.steps_before += 1;
    }

    /// Adds a step; the segment that it completes is returned, with sequence number 0.
    pub fn push(&mut self, step: &StepRecord<'_>) -> Option<Segment> {
        if self.rewards.is_empty() {
            self.first_version = step.version;
            let (lane, step) = (self.lane.into(), self.steps_before.into());
            self.trace = self.traces.begin([self.writer, lane, self.episode, step]);
        }
        self.observations.extend_from_slice(step.observation);
        self.actions.extend_from_slice(step.action);
        self.rewards.push(step.reward);
        if step.env_step {
            self.segment_env_steps += 1;
            self.env_steps += 1;
            self.episode_return += f64::from(step.reward);
        }
        let full = self.rewards.len() == self.segment_steps;
        (full || step.end != StepEnd::Continues).then(|| self.cut(step))
    }

    fn cut(&mut self, last: &StepRecord<'_>) -> Segment {
        self.observations.extend_from_slice(last.next_observation);
        let segment = Segment {
            writer: self.writer,
            sequence: 0,
            lane: self.lane,
            episode: self.episode,
            first_step: self.steps_before,
            steps: self.rewards.len(),
            env_steps: self.segment_env_steps,
            terminal: last.end == StepEnd::Terminal,
            truncated: last.end == StepEnd::TimeLimit,
            stage: self.stage,
            first_version: self.first_version,
            last_version: last.version,
            columns: self.layout.iter().map(|column| self.encode(*column)).collect(),
            end: self.end(last.end),
            trace: self.simulated().map(Box::new),
        };
        self.steps_before += segment.steps as u32;
        self.clear();
        segment
    }

    /// The segment's trace, its time in the lane over.
    fn simulated(&self) -> Option<SegmentTrace> {
        let trace = self.trace?;
        let since = SystemTime::now();
        self.traces.child(trace.context, ("simulate", SpanKind::Internal), trace.begun, since, Vec::new());
        Some(SegmentTrace { since, ..trace })
    }

    fn encode(&self, column: Column) -> Bytes {
        columns::encode(match column {
            Column::Observation => &self.observations,
            Column::Action => &self.actions,
            Column::Reward => &self.rewards,
            Column::Beta => std::slice::from_ref(&self.beta),
        })
    }

    fn end(&self, end: StepEnd) -> Option<EpisodeEnd> {
        let reason = match end {
            StepEnd::Continues | StepEnd::Landed => return None,
            StepEnd::Terminal => "terminal",
            StepEnd::TimeLimit => "time_limit",
        };
        Some(EpisodeEnd {
            episode_return: self.episode_return as f32,
            env_steps: self.env_steps,
            reason: reason.to_owned(),
            tags: BTreeMap::new(),
        })
    }

    fn clear(&mut self) {
        self.rewards.clear();
        self.actions.clear();
        self.observations.clear();
        self.segment_env_steps = 0;
        self.trace = None;
    }
}

fn layout(spec: &RunSpec, observation: usize, action: usize) -> Result<Vec<Column>, LayoutError> {
    let known = |name: &str| match name {
        OBSERVATION => Some((Column::Observation, observation, Rows::StepsPlusOne)),
        ACTION => Some((Column::Action, action, Rows::Steps)),
        REWARD => Some((Column::Reward, 1, Rows::Steps)),
        BETA => Some((Column::Beta, 1, Rows::Once)),
        _ => None,
    };
    let columns = spec.columns.iter().map(|column| {
        let (kind, ours, our_rows) =
            known(&column.name).ok_or_else(|| LayoutError::Unknown(column.name.clone()))?;
        if (column.width, column.rows) != (ours, our_rows) {
            let (name, width, rows) = (column.name.clone(), column.width, column.rows);
            return Err(LayoutError::Shape { name, width, rows, ours, our_rows });
        }
        Ok(kind)
    });
    columns.collect()
}

#[cfg(test)]
#[path = "segments_tests.rs"]
mod tests;
