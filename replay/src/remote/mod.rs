//! Sampling a replay service: [`RemoteSource`], and the short calls such as [`describe`].

mod bell;
mod calls;
mod fetching;

use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use getup_proto::RunSpec;
use getup_telemetry::{Shutdown, Waiting, Waits};
use getup_transport::Endpoint;
use tokio::runtime::Handle;
use tokio::sync::mpsc;

pub(crate) use bell::Bell;
pub use calls::{describe, describe_table, take_snapshot, update_priorities};
use fetching::Fetching;

use crate::gate::CANCEL_TICK;
use crate::minibatch::{Minibatch, OptionsError, SampleOptions};
use crate::source::{MinibatchSource, SampleError};

/// Priorities of a message, at least: until there are so many, the service draws by older ones.
const PRIORITIES_AT_ONCE: usize = 1024;
/// Messages of priorities that wait for a connection; beyond, they are dropped.
const PRIORITY_MESSAGES: usize = 16;

/// Samples a replay service. A task of its own fetches minibatches ahead, and connects again when the service is
/// gone; the minibatches that are queued meanwhile are still given out.
#[derive(Debug)]
pub struct RemoteSource {
    queue: Receiver<Result<Minibatch, SampleError>>,
    /// Tells the task that a minibatch was taken from the queue.
    taken: mpsc::UnboundedSender<()>,
    /// Priorities for the task to send.
    priorities: mpsc::Sender<Vec<(u64, f32)>>,
    /// Some that are not worth a message yet.
    gathered: Vec<(u64, f32)>,
    /// Why there is none.
    reason: Reason,
    /// Since the last minibatch.
    wait: Waiting,
    shutdown: Shutdown,
}

/// What a [`RemoteSource`] asks for.
#[derive(Clone, Debug)]
pub struct RemoteOptions {
    /// The table that is sampled; empty for the default.
    pub table: String,
    /// The table's spec: a service with another refuses.
    pub spec: RunSpec,
    /// What minibatches are made of.
    pub sample: SampleOptions,
    /// Who samples, for logs and `status`.
    pub name: String,
    /// Minibatches that are fetched ahead, from 1.
    pub prefetch: usize,
}

/// A reason that the task writes and the one who waits reads.
type Reason = Arc<Mutex<String>>;

impl RemoteSource {
    /// Samples the service at `endpoint`, by a task on `runtime` that ends with the source.
    pub fn new(
        endpoint: impl Into<Endpoint>,
        options: RemoteOptions,
        runtime: &Handle,
        waits: Waits,
        shutdown: Shutdown,
    ) -> Self {
        Self::with_bell(endpoint.into(), options, runtime, waits, shutdown, None)
    }

    /// As [`RemoteSource::new`]; the bell rings when something has come into the queue.
    pub(crate) fn with_bell(
        endpoint: Endpoint,
        options: RemoteOptions,
        runtime: &Handle,
        waits: Waits,
        shutdown: Shutdown,
        bell: Option<Bell>,
    ) -> Self {
        let prefetch = options.prefetch.max(1);
        // One place more, for the error that ends it.
        let (sender, queue) = sync_channel(prefetch + 1);
        let (taken, consumed) = mpsc::unbounded_channel();
        let (priorities, updates) = mpsc::channel(PRIORITY_MESSAGES);
        let reason = Reason::default();
        let fetching =
            Fetching::new(endpoint, options, sender, (consumed, updates), Arc::clone(&reason), bell);
        runtime.spawn(fetching.run());
        Self {
            queue,
            taken,
            priorities,
            gathered: Vec::new(),
            reason,
            wait: waits.waiting("learner"),
            shutdown,
        }
    }

    /// Why there is no minibatch.
    pub(crate) fn reason(&self) -> String {
        lock(&self.reason).clone()
    }
}

impl MinibatchSource for RemoteSource {
    fn poll(&mut self, patience: Duration) -> Result<Option<Minibatch>, SampleError> {
        let started = Instant::now();
        loop {
            if self.shutdown.is_triggered() {
                return Err(SampleError::Shutdown);
            }
            let left = patience.saturating_sub(started.elapsed());
            match self.queue.recv_timeout(left.min(CANCEL_TICK)) {
                Ok(minibatch) => {
                    // The task may just have ended with an error, which is then next in the queue.
                    let _ = self.taken.send(());
                    self.wait.over();
                    return minibatch.map(Some);
                }
                // At a shutdown the task may end between the question above and here.
                Err(RecvTimeoutError::Disconnected) if self.shutdown.is_triggered() => {
                    return Err(SampleError::Shutdown);
                }
                Err(RecvTimeoutError::Disconnected) => return Err(SampleError::Ended),
                Err(RecvTimeoutError::Timeout) if left.is_zero() => return Ok(None),
                Err(RecvTimeoutError::Timeout) => {}
            }
            self.wait.because_with(|| lock(&self.reason).clone());
        }
    }

    fn update_priorities(&mut self, priorities: Vec<(u64, f32)>) -> Result<(), SampleError> {
        OptionsError::check_priorities(&priorities)?;
        self.gathered.extend(priorities);
        if self.gathered.len() >= PRIORITIES_AT_ONCE {
            // Without a connection they wait, and then they are too old to matter.
            let _ = self.priorities.try_send(std::mem::take(&mut self.gathered));
        }
        Ok(())
    }
}

fn lock(reason: &Reason) -> std::sync::MutexGuard<'_, String> {
    reason.lock().unwrap_or_else(PoisonError::into_inner)
}
