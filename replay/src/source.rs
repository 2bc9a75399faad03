//! Where a learner gets its minibatches from: [`MinibatchSource`].
//!
//! [`LocalSource`] reads a store of the same process. [`crate::RemoteSource`] asks a replay service. A learner
//! cannot tell which it has.

use crate::error::StoreError;
use crate::minibatch::{Minibatch, OptionsError, SampleOptions};
use crate::store::Store;
use getup_telemetry::{Shutdown, Waiting};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Gives minibatches, one after another.
pub trait MinibatchSource: Send {
    /// The next minibatch, or None if there is none within `patience`.
    ///
    /// # Errors
    /// [`SampleError`]; [`SampleError::Shutdown`] when the wait is cancelled.
    fn poll(&mut self, patience: Duration) -> Result<Option<Minibatch>, SampleError>;

    /// The next minibatch. Waits for it, with a reason that logs, metrics and `status` show.
    ///
    /// # Errors
    /// As [`MinibatchSource::poll`].
    fn next(&mut self) -> Result<Minibatch, SampleError> {
        loop {
            if let Some(minibatch) = self.poll(Duration::MAX)? {
                return Ok(minibatch);
            }
        }
    }

    /// Gives transitions of earlier minibatches priorities, by their keys; those that are gone by now are left out.
    /// They count sooner or later, and may be lost with a connection: the next draw of a transition finds it anew.
    ///
    /// # Errors
    /// [`SampleError::Options`] if one is negative or not finite.
    fn update_priorities(&mut self, priorities: Vec<(u64, f32)>) -> Result<(), SampleError>;
}

/// Why there is no next minibatch.
#[derive(Debug, thiserror::Error)]
pub enum SampleError {
    /// The process is shutting down.
    #[error("sampling ended: the process is shutting down")]
    Shutdown,
    /// The options cannot be served.
    #[error(transparent)]
    Options(#[from] OptionsError),
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A defect of this program.
    #[error("the task that fetches minibatches has ended: see the log")]
    Ended,
    /// The service refuses, and would again.
    #[error("replay at {endpoint} refuses to be sampled: {reason}")]
    Refused {
        /// Where it listens.
        endpoint: String,
        /// Its words.
        reason: String,
    },
}

/// Samples a store of the same process.
#[derive(Debug)]
pub struct LocalSource {
    store: Arc<Store>,
    rng: ChaCha8Rng,
    options: SampleOptions,
    shutdown: Shutdown,
    /// Among the samplers at the gate.
    id: u64,
    /// Since the last minibatch.
    wait: Waiting,
}

impl LocalSource {
    /// A source of minibatches from `store`, for a sampler that others see as `name`.
    ///
    /// # Errors
    /// [`SampleError::Options`] if the store cannot serve them.
    pub fn new(
        store: Arc<Store>,
        options: SampleOptions,
        name: &str,
        shutdown: Shutdown,
    ) -> Result<Self, SampleError> {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        store.check_options(&options)?;
        let id = NEXT.fetch_add(1, Ordering::Relaxed);
        store.gate().sampler_came(id, name);
        let (rng, wait) = (ChaCha8Rng::seed_from_u64(options.seed), store.gate().sampler_waiting());
        Ok(Self { store, rng, options, shutdown, id, wait })
    }

    /// Returns when there might be a minibatch, or at the shutdown.
    pub(crate) async fn ready(&mut self) {
        let gate = self.store.gate();
        gate.heard_sampler(self.id);
        tokio::select! {
            () = gate.wait_to_sample_task(self.options.batch as u64, &mut self.wait) => {}
            () = self.shutdown.wait() => {}
        }
    }
}

impl MinibatchSource for LocalSource {
    fn poll(&mut self, patience: Duration) -> Result<Option<Minibatch>, SampleError> {
        let gate = self.store.gate();
        gate.heard_sampler(self.id);
        loop {
            if self.shutdown.is_triggered() {
                return Err(SampleError::Shutdown);
            }
            if let Some(minibatch) = self.store.try_sample(&mut self.rng, &self.options)? {
                self.wait.over();
                return Ok(Some(minibatch));
            }
            // Another sampler may be quicker than this one after the wait.
            let cancelled = || self.shutdown.is_triggered();
            if !gate.wait_to_sample(self.options.batch as u64, patience, &mut self.wait, cancelled) {
                return if self.shutdown.is_triggered() { Err(SampleError::Shutdown) } else { Ok(None) };
            }
        }
    }

    fn update_priorities(&mut self, priorities: Vec<(u64, f32)>) -> Result<(), SampleError> {
        self.store.update_priorities(&priorities)?;
        Ok(())
    }
}

impl Drop for LocalSource {
    fn drop(&mut self) {
        self.store.gate().sampler_went(self.id);
    }
}
