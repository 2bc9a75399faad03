//! The settings of an actor: the `[actor]` table of a run's configuration.

use documented::DocumentedFieldsOpt;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// How an actor plays and how it sends what it played. The default is the paper's where the paper has a say.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize, DocumentedFieldsOpt)]
#[serde(deny_unknown_fields, default)]
pub struct ActorConfig {
    /// Names this actor in logs, metrics and `getup status`; part of what its random draws derive from.
    pub name: String,
    /// Episodes played at once, over all threads.
    pub lanes: usize,
    /// Threads that the lanes are divided over; each evaluates the policy on its own lanes.
    pub threads: usize,
    /// Longest segment, in steps: shorter ones reach the replay sooner, longer ones cost less each step.
    pub segment_steps: usize,
    /// Segments that may wait for the replay's acknowledgement; then the lanes wait.
    pub queue_segments: usize,
    /// Whether the limp steps of falls are stored too (Table 1). They never count as env steps.
    pub store_limp: bool,
    /// Fallen states that each thread keeps to begin episodes from, instead of playing a fall for each; 0 for none.
    pub fall_pool: usize,
    /// Share of the draws from the pool that play a fall after all, and renew a state of it.
    pub fall_renewal: f64,
    /// The noise of the actions is held for a number of steps k drawn with probability ∝ 1/k² up to this many
    /// (FlashSAC); 1 draws it anew in every step.
    pub noise_hold: usize,
    /// How long a shutdown may take to send what is queued, in seconds.
    pub drain_seconds: f64,
}

impl Default for ActorConfig {
    fn default() -> Self {
        Self {
            name: "actor".to_owned(),
            lanes: 16,
            threads: 1,
            segment_steps: 64,
            queue_segments: 16,
            store_limp: true,
            fall_pool: 0,
            fall_renewal: 0.1,
            noise_hold: 1,
            drain_seconds: 5.0,
        }
    }
}

/// The longest name of an actor.
const MAX_NAME_BYTES: usize = 256;

/// A setting that is out of range.
#[derive(Clone, PartialEq, Debug, Error)]
pub enum ConfigError {
    /// The actor has no name.
    #[error("actor.name is empty: name the actor, for example \"actor-1\"")]
    Name,
    /// A name that no learner takes.
    #[error("actor.name has {0} bytes: it must have at most {MAX_NAME_BYTES}")]
    LongName(usize),
    /// A number that must be at least 1.
    #[error("actor.{0} is 0: it must be at least 1")]
    Zero(&'static str),
    /// A number beyond what makes sense.
    #[error("actor.{name} is {value}: it must be at most {most}")]
    TooMany {
        /// Which.
        name: &'static str,
        /// Its value.
        value: usize,
        /// The most it may be.
        most: usize,
    },
    /// A thread without a lane.
    #[error("actor.threads is {threads} and actor.lanes is {lanes}: every thread needs a lane")]
    Threads {
        /// Threads asked for.
        threads: usize,
        /// Lanes to divide over them.
        lanes: usize,
    },
    /// Not a share, or a pool that would never change.
    #[error("actor.fall_renewal is {0}: it must be over 0 and at most 1")]
    Renewal(f64),
    /// Not a duration.
    #[error(
        "actor.drain_seconds is {0}: it must be between 0 and 8, for a shutdown takes ten seconds at most"
    )]
    Drain(f64),
}

impl ActorConfig {
    /// Checks every setting.
    ///
    /// # Errors
    /// The first setting out of range, with its value and the way out.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if self.name.is_empty() {
            return Err(ConfigError::Name);
        }
        if self.name.len() > MAX_NAME_BYTES {
            return Err(ConfigError::LongName(self.name.len()));
        }
        let counts = [
            ("lanes", self.lanes),
            ("threads", self.threads),
            ("segment_steps", self.segment_steps),
            ("queue_segments", self.queue_segments),
            ("noise_hold", self.noise_hold),
        ];
        if let Some((name, _)) = counts.into_iter().find(|(_, count)| *count == 0) {
            return Err(ConfigError::Zero(name));
        }
        let bounded = [
            ("lanes", self.lanes, 65_536),
            ("threads", self.threads, 256),
            ("queue_segments", self.queue_segments, 1_000_000),
            ("fall_pool", self.fall_pool, 100_000),
            ("noise_hold", self.noise_hold, 1_000),
        ];
        if let Some((name, value, most)) = bounded.into_iter().find(|(_, value, most)| value > most) {
            return Err(ConfigError::TooMany { name, value, most });
        }
        if self.threads > self.lanes {
            return Err(ConfigError::Threads { threads: self.threads, lanes: self.lanes });
        }
        if !(self.fall_renewal > 0.0 && self.fall_renewal <= 1.0) {
            return Err(ConfigError::Renewal(self.fall_renewal));
        }
        if !(0.0..=8.0).contains(&self.drain_seconds) {
            return Err(ConfigError::Drain(self.drain_seconds));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_valid_and_a_setting_out_of_range_is_named() {
        let refused = |change: &dyn Fn(&mut ActorConfig)| {
            let mut config = ActorConfig::default();
            change(&mut config);
            config.validate().unwrap_err().to_string()
        };
        assert_eq!(ActorConfig::default().validate(), Ok(()));
        assert!(refused(&|c| c.name.clear()).contains("actor.name"));
        assert!(refused(&|c| c.lanes = 0).contains("actor.lanes is 0"));
        assert!(refused(&|c| c.threads = 17).contains("actor.threads is 17 and actor.lanes is 16"));
        assert!(refused(&|c| c.drain_seconds = f64::NAN).contains("actor.drain_seconds is NaN"));
        assert!(refused(&|c| c.fall_pool = usize::MAX).contains("it must be at most 100000"));
        assert!(refused(&|c| c.name = "a".repeat(257)).contains("actor.name has 257 bytes"));
        assert!(refused(&|c| (c.lanes, c.threads) = (1000, 1000)).contains("actor.threads is 1000"));
        assert!(refused(&|c| c.queue_segments = usize::MAX).contains("it must be at most 1000000"));
        assert!(refused(&|c| c.noise_hold = 0).contains("actor.noise_hold is 0"));
        assert!(refused(&|c| c.fall_renewal = 0.0).contains("actor.fall_renewal is 0"));
    }
}
