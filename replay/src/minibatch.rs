//! What sampling gives: [`Minibatch`], and how it is asked for: [`SampleOptions`].

use getup_proto::{TraceContext, columns, v1};

/// What a stream of minibatches is made of.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct SampleOptions {
    /// Transitions a minibatch, from 1.
    pub batch: usize,
    /// Rewards are summed over this many steps of one episode, from 1; fewer at its end.
    pub n_step: usize,
    /// The discount γ a step, in [0, 1].
    pub gamma: f32,
    /// Seeds the sampler.
    pub seed: u64,
    /// Whether each draw gives the whole segment of the transition that was drawn; `n_step` and `gamma` do not count
    /// then. A draw counts as one sample for the limiter, whatever it gives.
    pub segments: bool,
}

/// Totals over a store's life; they survive restarts.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct ReplayCounters {
    /// Names the store: a new one, or one that was cleared, has another.
    pub store: u64,
    /// Env steps ever stored; limp steps do not count.
    pub env_steps: u64,
    /// Transitions ever stored, limp ones included.
    pub transitions: u64,
    /// Episodes whose end was stored.
    pub episodes: u64,
    /// Transitions handed out in minibatches.
    pub sampled: u64,
    /// Transitions that can be sampled now.
    pub held: u64,
}

/// `batch` transitions, as contiguous columns; or `batch` whole segments.
///
/// The columns of the run's spec come in its order: of a column with a row a step or T + 1 rows the row where the
/// transition begins, of one with a row an episode that row. `reward` is the n-step sum Σ γᵏ·rₖ. Then, for every
/// column of T + 1 rows, `next_<name>`: its row where the transition ends. Last comes `discount`: γ to the number
/// of steps the transition spans, or 0 if it ends in a terminal state. A truncated episode's value goes on.
///
/// Of whole segments there are the spec's columns alone, each with the rows of all segments, one segment after another.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Minibatch {
    /// Each of `batch` × its width values.
    pub columns: Vec<MinibatchColumn>,
    /// What was drawn, transition by transition; empty where the store draws uniformly, without a limit.
    pub items: Vec<Item>,
    /// What the segments are, where whole ones were asked for.
    pub segments: Vec<SampledSegment>,
    /// The store's totals, this minibatch included.
    pub counters: ReplayCounters,
    /// Where segments are followed of which this is the first minibatch.
    pub traces: Vec<TraceContext>,
}

/// A transition that was drawn from a store whose sampler is not plainly uniform.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Item {
    /// Names it for as long as it is stored, also after a restart: the transitions ever stored before it.
    pub key: u64,
    /// With which it was drawn; 1 where the sampler does not draw lots.
    pub probability: f32,
}

/// A segment that was drawn: which it is, and how it ends.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct SampledSegment {
    /// Who wrote it, and in which of its lanes.
    pub writer: u64,
    /// See `writer`.
    pub lane: u32,
    /// Counts the episodes of the lane.
    pub episode: u64,
    /// Index in the episode of its first step.
    pub first_step: u32,
    /// Its length.
    pub steps: u32,
    /// Whether its last step ended the episode in a terminal state, or at its time limit.
    pub terminal: bool,
    /// See `terminal`.
    pub truncated: bool,
}

/// One column, row after row.
#[derive(Clone, PartialEq, Debug)]
pub struct MinibatchColumn {
    /// See [`Minibatch`].
    pub name: String,
    /// Values a row.
    pub width: usize,
    /// `batch` × `width` values; of whole segments as many rows as they have together.
    pub data: Vec<f32>,
}

/// Why what was asked for, or what came, is refused.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
pub enum OptionsError {
    /// An empty or enormous batch.
    #[error("a batch of {batch} cannot be sampled: it must lie in 1..={max}, so that a message holds it")]
    Batch {
        /// As asked for.
        batch: usize,
        /// What a message holds.
        max: usize,
    },
    /// A batch for which the store might never have the draws.
    #[error(
        "a batch of {batch} might wait forever: with replay.capacity {capacity} a store that was full is sure to hold {held} \
         transitions, and replay.max_times_sampled is {times}; take {max} or less, or raise either setting"
    )]
    Draws {
        /// As asked for.
        batch: usize,
        /// The largest that always comes.
        max: usize,
        /// Transitions that a store which was full holds at least.
        held: usize,
        /// As configured.
        times: u32,
        /// As configured.
        capacity: usize,
    },
    /// A batch that the limiter's band has no room for.
    #[error(
        "a batch of {batch} would never be let through: replay.error_buffer is {error_buffer}; raise it to the batch"
    )]
    Buffer {
        /// As asked for.
        batch: usize,
        /// Half the width of the band.
        error_buffer: f64,
    },
    /// No steps, or more than [`MAX_N_STEP`].
    #[error("n_step is {0}: it must lie in 1..={MAX_N_STEP}")]
    NStep(usize),
    /// Not a priority.
    #[error("the priority of transition {key} is {priority}: it must be finite, and 0 or more")]
    Priority {
        /// Of the transition.
        key: u64,
        /// As given.
        priority: f32,
    },
    /// Not a discount.
    #[error("gamma is {0}: it must lie in [0, 1]")]
    Gamma(f32),
}

impl OptionsError {
    /// Whether all of these can be priorities of the transitions whose keys stand before them.
    ///
    /// # Errors
    /// [`OptionsError::Priority`] with the first that is negative or not finite.
    pub(crate) fn check_priorities(priorities: &[(u64, f32)]) -> Result<(), Self> {
        let wrong = priorities.iter().find(|(_, priority)| !(priority.is_finite() && *priority >= 0.0));
        wrong.map_or(Ok(()), |&(key, priority)| Err(Self::Priority { key, priority }))
    }
}

/// The most steps a transition may span.
pub const MAX_N_STEP: usize = 1024;

impl Minibatch {
    /// The column of this name.
    pub fn column(&self, name: &str) -> Option<&MinibatchColumn> {
        self.columns.iter().find(|column| column.name == name)
    }

    /// The weights that make up for priorities: (N · P(i))^−exponent over the greatest of them (Schaul et al. 2016,
    /// §3.4), one a transition. `exponent` is β, from 0 (no correction) to 1.
    pub fn importance_weights(&self, exponent: f32) -> Vec<f32> {
        // N, and all that the weights have in common, cancels.
        let least = self.items.iter().map(|item| item.probability).fold(f32::INFINITY, f32::min);
        self.items.iter().map(|item| (item.probability / least).powf(-exponent)).collect()
    }

    pub(crate) fn into_wire(self) -> v1::Minibatch {
        let column = |column: MinibatchColumn| v1::MinibatchColumn {
            name: column.name,
            width: column.width as u32,
            data: columns::into_bytes(column.data),
        };
        v1::Minibatch {
            columns: self.columns.into_iter().map(column).collect(),
            counters: Some(self.counters.into()),
            keys: self.items.iter().map(|item| item.key).collect(),
            probabilities: self.items.iter().map(|item| item.probability).collect(),
            segments: self.segments.into_iter().map(SampledSegment::into_wire).collect(),
            traceparents: self.traces.iter().map(TraceContext::to_string).collect(),
        }
    }

    /// Parses a message; None unless every column has `batch` rows, or those of `batch` segments, and the counters are there.
    pub(crate) fn parse(wire: v1::Minibatch, batch: usize) -> Option<Self> {
        let segments: Vec<_> = wire.segments.into_iter().map(SampledSegment::parse).collect();
        let steps: usize = segments.iter().map(|segment| segment.steps as usize).sum();
        [0, batch].contains(&segments.len()).then_some(())?;
        // A row a segment, a step, or a step and its end.
        let rows = if segments.is_empty() { vec![batch] } else { vec![batch, steps, steps + batch] };
        let columns = wire.columns.into_iter().map(|column| MinibatchColumn::parse(column, &rows));
        let items = wire.keys.iter().zip(&wire.probabilities);
        let whole = wire.keys.len() == wire.probabilities.len() && [0, batch].contains(&wire.keys.len());
        whole.then_some(())?;
        Some(Self {
            columns: columns.collect::<Option<_>>()?,
            items: items.map(|(&key, &probability)| Item { key, probability }).collect(),
            segments,
            counters: wire.counters?.into(),
            // What is none concerns whoever looks at traces, and not training.
            traces: wire.traceparents.iter().take(batch).filter_map(|text| text.parse().ok()).collect(),
        })
    }
}

impl SampledSegment {
    fn into_wire(self) -> v1::SampledSegment {
        let Self { writer, lane, episode, first_step, steps, terminal, truncated } = self;
        v1::SampledSegment { writer, lane, episode, first_step, steps, terminal, truncated }
    }

    fn parse(wire: v1::SampledSegment) -> Self {
        let v1::SampledSegment { writer, lane, episode, first_step, steps, terminal, truncated } = wire;
        Self { writer, lane, episode, first_step, steps, terminal, truncated }
    }
}

impl MinibatchColumn {
    fn parse(wire: v1::MinibatchColumn, rows: &[usize]) -> Option<Self> {
        let v1::MinibatchColumn { name, width, data } = wire;
        let width = width as usize;
        let whole = |rows: &usize| {
            let bytes = width.checked_mul(*rows).and_then(|values| values.checked_mul(columns::VALUE_BYTES));
            bytes == Some(data.len())
        };
        rows.iter().any(whole).then(|| Self { name, width, data: columns::iter(&data).collect() })
    }
}

impl From<v1::ReplayCounters> for ReplayCounters {
    fn from(wire: v1::ReplayCounters) -> Self {
        let v1::ReplayCounters { store, env_steps, transitions, episodes, sampled, held } = wire;
        Self { store, env_steps, transitions, episodes, sampled, held }
    }
}

impl From<ReplayCounters> for v1::ReplayCounters {
    fn from(counters: ReplayCounters) -> Self {
        let ReplayCounters { store, env_steps, transitions, episodes, sampled, held } = counters;
        Self { store, env_steps, transitions, episodes, sampled, held }
    }
}
