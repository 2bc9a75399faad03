//! The learner as a process: the `[learner]` table.

use documented::DocumentedFieldsOpt;
use serde::{Deserialize, Serialize};

use super::{ConfigError, check};

/// The learner as a process.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, DocumentedFieldsOpt)]
#[serde(default, deny_unknown_fields)]
pub struct LearnerConfig {
    /// `cpu`, or `cuda` for the first NVIDIA device.
    pub device: Device,
    /// Threads of the update; 0 takes both of two cores (the actor fits beside them: 1.2 × the updates of one thread),
    /// and leaves one of more to the rest.
    pub threads: usize,
    /// Updates from one broadcast of the policy to the next.
    pub publish_every: u64,
    /// Seconds from one checkpoint to the next; one is also written at every promotion and at the end.
    pub checkpoint_seconds: f64,
    /// Checkpoints that are kept.
    pub checkpoints_kept: usize,
}

/// Where the networks live.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Device {
    /// The processor.
    Cpu,
    /// The first NVIDIA device.
    Cuda,
}

impl Default for LearnerConfig {
    fn default() -> Self {
        Self {
            device: Device::Cpu,
            threads: 0,
            publish_every: 20,
            checkpoint_seconds: 60.0,
            checkpoints_kept: 3,
        }
    }
}

impl LearnerConfig {
    /// Refuses settings that cannot run.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check(self.threads <= 1024, "learner.threads", &self.threads, "from 0 (automatic) to 1024")?;
        check(self.publish_every > 0, "learner.publish_every", &self.publish_every, "at least 1")?;
        let seconds = self.checkpoint_seconds;
        check(
            seconds > 0.0 && seconds <= 1e6,
            "learner.checkpoint_seconds",
            &seconds,
            "over 0, at most 1000000",
        )?;
        check(self.checkpoints_kept > 0, "learner.checkpoints_kept", &self.checkpoints_kept, "at least 1")
    }

    /// Threads of the matrix products on this machine.
    pub fn effective_threads(&self) -> usize {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        if self.threads > 0 { self.threads } else { cores.min(2).max(cores.saturating_sub(1)) }
    }
}
