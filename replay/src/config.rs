//! The settings of a replay: [`ReplayConfig`].

use crate::remover::{MAX_WINDOW, Remover};
use crate::selector::ItemSelector;
use getup_proto::RunSpec;
use serde::{Deserialize, Serialize};

/// The table of a stream that names none.
pub const DEFAULT_TABLE: &str = "default";

/// What an acknowledged segment survives.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SyncMode {
    /// The process being killed: the kernel has the data.
    #[default]
    Process,
    /// Also a power loss: the disk has the data (`fsync` before every acknowledgement).
    Data,
}

/// The settings of a replay.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReplayConfig {
    /// Transitions that can be sampled at once.
    pub capacity: usize,
    /// Env steps that must have come before the first sample; limp steps do not count.
    pub min_size: u64,
    /// Transitions sampled per env step inserted, kept within a band: whoever is ahead waits. One update of batch
    /// 256 a step is 256. Without it, nobody waits once `min_size` is reached.
    pub samples_per_insert: Option<f64>,
    /// Half the width of that band, in sampled transitions. Without it: a tenth of `min_size` ×
    /// `samples_per_insert`, and at least what two of the longest segments allow.
    pub error_buffer: Option<f64>,
    /// What an acknowledged segment survives.
    pub sync: SyncMode,
    /// How transitions are drawn.
    pub sampler: ItemSelector,
    /// How often a transition may be drawn, from 1; without it, any number of times. Counts begin anew at a restart.
    /// With 1 and `fifo` the store is a queue.
    pub max_times_sampled: Option<u32>,
    /// Which segments leave when there are more.
    pub remover: Remover,
}

impl Default for ReplayConfig {
    fn default() -> Self {
        Self {
            capacity: 1_000_000,
            min_size: 1_000,
            samples_per_insert: None,
            error_buffer: None,
            sync: SyncMode::Process,
            sampler: ItemSelector::Uniform,
            max_times_sampled: None,
            remover: Remover::Fifo,
        }
    }
}

/// Why a configuration is refused.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
pub enum ConfigError {
    /// `min_size` out of range.
    #[error("replay.min_size is {min_size}: it must lie in 1..=replay.capacity ({capacity})")]
    MinSize {
        /// As configured.
        min_size: u64,
        /// As configured.
        capacity: usize,
    },
    /// `capacity` out of range.
    #[error(
        "replay.capacity is {capacity}: it must lie in {min}..={max} (two of the longest segments, and 2^31)"
    )]
    Capacity {
        /// As configured.
        capacity: usize,
        /// Two of the longest segments.
        min: usize,
        /// [`MAX_CAPACITY`].
        max: usize,
    },
    /// `samples_per_insert` is not a positive number.
    #[error("replay.samples_per_insert is {0}: it must be positive; leave it out for no limit")]
    SamplesPerInsert(f64),
    /// The exponent of priorities is no number from 0.
    #[error("replay.sampler.prioritized.exponent is {0}: it must lie in 0..=10 (0.6 is usual)")]
    Exponent(f64),
    /// `remover` goes by priorities, and there are none.
    #[error(
        "replay.remover is lowest_priority, and transitions have no priorities to go by: draw them by priority, with an \
         exponent above 0 (a table's sampler.prioritized.exponent, or a run's replay.priority_exponent), or leave \
         replay.remover out"
    )]
    NoPriorities,
    /// The window of `remover` is out of range.
    #[error(
        "replay.remover.lowest_priority.window is {0}: it must lie in 1..={MAX_WINDOW}, how many times the capacity the log keeps"
    )]
    Window(u32),
    /// Nothing could ever be drawn.
    #[error("replay.max_times_sampled is 0: it must be 1 or more; leave it out for no limit")]
    MaxTimesSampled,
    /// Transitions would run out.
    #[error(
        "replay.samples_per_insert is {samples_per_insert}, and replay.max_times_sampled {max_times_sampled}: \
         transitions would run out and all would wait; raise max_times_sampled"
    )]
    RunsOut {
        /// As configured.
        samples_per_insert: f64,
        /// As configured.
        max_times_sampled: u32,
    },
    /// `error_buffer` is so narrow that writers and samplers would wait for each other.
    #[error(
        "replay.error_buffer is {error_buffer}: it must be at least {min}, samples_per_insert times the longest \
         segment, or one segment would overshoot the band; raise it, or leave it out"
    )]
    ErrorBuffer {
        /// As configured.
        error_buffer: f64,
        /// The least that works.
        min: f64,
    },
}

/// The largest capacity, in transitions.
pub const MAX_CAPACITY: usize = 1 << 31;

impl ReplayConfig {
    /// Checks what can be checked without a spec.
    ///
    /// # Errors
    /// [`ConfigError`] with the first setting that is out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.check(1)
    }

    /// Checks everything, for a run of this spec.
    ///
    /// # Errors
    /// [`ConfigError`] with the first setting that is out of range.
    pub fn validate_for(&self, spec: &RunSpec) -> Result<(), ConfigError> {
        self.check(spec.max_segment_steps)
    }

    /// Transitions that the log keeps.
    pub(crate) fn kept(&self) -> u64 {
        self.capacity as u64 * u64::from(self.remover.window())
    }

    fn check(&self, max_segment_steps: usize) -> Result<(), ConfigError> {
        let min = 2 * max_segment_steps;
        if !(min..=MAX_CAPACITY).contains(&self.capacity) {
            return Err(ConfigError::Capacity { capacity: self.capacity, min, max: MAX_CAPACITY });
        }
        if !(1..=self.capacity as u64).contains(&self.min_size) {
            return Err(ConfigError::MinSize { min_size: self.min_size, capacity: self.capacity });
        }
        if let ItemSelector::Prioritized { exponent } = self.sampler
            && !(0.0..=10.0).contains(&exponent)
        {
            return Err(ConfigError::Exponent(exponent));
        }
        if let Remover::LowestPriority { window } = self.remover {
            if !(1..=MAX_WINDOW).contains(&window) {
                return Err(ConfigError::Window(window));
            }
            if !matches!(self.sampler, ItemSelector::Prioritized { exponent } if exponent > 0.0) {
                return Err(ConfigError::NoPriorities);
            }
        }
        if self.max_times_sampled == Some(0) {
            return Err(ConfigError::MaxTimesSampled);
        }
        let Some(samples_per_insert) = self.samples_per_insert else { return Ok(()) };
        if !(samples_per_insert.is_finite() && samples_per_insert > 0.0) {
            return Err(ConfigError::SamplesPerInsert(samples_per_insert));
        }
        if let Some(max_times_sampled) = self.max_times_sampled
            && samples_per_insert > f64::from(max_times_sampled)
        {
            return Err(ConfigError::RunsOut { samples_per_insert, max_times_sampled });
        }
        let min = samples_per_insert * max_segment_steps as f64;
        match self.error_buffer {
            Some(error_buffer) if !(error_buffer.is_finite() && error_buffer >= min) => {
                Err(ConfigError::ErrorBuffer { error_buffer, min })
            }
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_setting_out_of_range_is_refused_by_name() {
        let refused = |change: &dyn Fn(&mut ReplayConfig)| {
            let mut config = ReplayConfig::default();
            change(&mut config);
            config.check(64).expect_err("a setting is out of range").to_string()
        };
        assert!(ReplayConfig::default().check(64).is_ok());
        assert!(refused(&|c| c.capacity = 127).contains("replay.capacity is 127"));
        assert!(refused(&|c| c.min_size = 0).contains("replay.min_size is 0"));
        assert!(refused(&|c| c.min_size = 1_000_001).contains("replay.min_size is 1000001"));
        assert!(refused(&|c| c.samples_per_insert = Some(-1.0)).contains("samples_per_insert is -1"));
        assert!(refused(&|c| c.max_times_sampled = Some(0)).contains("max_times_sampled is 0"));
        let steep = refused(&|c| c.sampler = ItemSelector::Prioritized { exponent: f64::NAN });
        assert!(steep.contains("exponent is NaN"), "{steep}");
        let lowest = |window| Remover::LowestPriority { window };
        for sampler in
            [ItemSelector::Uniform, ItemSelector::Fifo, ItemSelector::Prioritized { exponent: 0.0 }]
        {
            let nothing = refused(&|c| (c.remover, c.sampler) = (lowest(4), sampler));
            assert!(nothing.contains("no priorities to go by: draw them by priority"), "{nothing}");
        }
        for window in [0, 65] {
            let far = refused(&|c| c.remover = lowest(window));
            assert!(far.contains(&format!("lowest_priority.window is {window}")), "{far}");
        }
        let runs_out = refused(&|c| {
            c.samples_per_insert = Some(2.0);
            c.max_times_sampled = Some(1);
        });
        assert!(runs_out.contains("transitions would run out"), "{runs_out}");
        let narrow = refused(&|c| {
            c.samples_per_insert = Some(256.0);
            c.error_buffer = Some(1000.0);
        });
        assert!(narrow.contains("error_buffer is 1000") && narrow.contains("at least 16384"), "{narrow}");
    }
}
