//! Writes checkpoints beside training: one at a time, on a thread of its own.

use std::path::PathBuf;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::checkpoint::{Checkpoint, CheckpointError};
use crate::config::LearnerConfig;
use crate::metrics::LearnerMetrics;

pub(super) struct Checkpoints {
    folder: PathBuf,
    every: Duration,
    kept: usize,
    last: Instant,
    writing: Option<JoinHandle<Result<(), CheckpointError>>>,
    metrics: LearnerMetrics,
}

impl Checkpoints {
    pub(super) fn new(folder: PathBuf, config: &LearnerConfig, metrics: LearnerMetrics) -> Self {
        let every = Duration::from_secs_f64(config.checkpoint_seconds);
        Self { folder, every, kept: config.checkpoints_kept, last: Instant::now(), writing: None, metrics }
    }

    /// Whether it is time for the next, and the one before is written.
    pub(super) fn due(&self) -> bool {
        self.last.elapsed() >= self.every && self.writing.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Writes `checkpoint`, after the one before it. A failure is logged, and told by [`Checkpoints::finish`].
    pub(super) fn write(&mut self, checkpoint: Checkpoint) {
        if let Err(error) = self.finish() {
            tracing::error!(%error, "a checkpoint was not written");
        }
        self.last = Instant::now();
        let (folder, kept, metrics) = (self.folder.clone(), self.kept, self.metrics.clone());
        let write = move || {
            let started = Instant::now();
            let path = checkpoint.save(&folder, kept)?;
            metrics.checkpoints.inc();
            metrics.checkpoint_seconds.observe(started.elapsed().as_secs_f64());
            tracing::debug!(path = %path.display(), "checkpoint written");
            Ok(())
        };
        self.writing = Some(std::thread::spawn(write));
    }

    /// Waits for the one that is being written.
    pub(super) fn finish(&mut self) -> Result<(), CheckpointError> {
        match self.writing.take().map(JoinHandle::join) {
            None => Ok(()),
            Some(Ok(result)) => result,
            Some(Err(panic)) => std::panic::resume_unwind(panic),
        }
    }
}

impl Drop for Checkpoints {
    fn drop(&mut self) {
        if let Err(error) = self.finish() {
            tracing::error!(%error, "a checkpoint was not written");
        }
    }
}
