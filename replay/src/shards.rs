//! Sampling several replay services at once: [`ShardedSource`].

use crate::gate::CANCEL_TICK;
use crate::minibatch::Minibatch;
use crate::remote::{Bell, RemoteOptions, RemoteSource};
use crate::source::{MinibatchSource, SampleError};
use getup_telemetry::{Shutdown, Waiting, Waits};
use getup_transport::Endpoint;
use std::time::{Duration, Instant};
use tokio::runtime::Handle;

/// How long one whose turn it is may take while others are ready: a few round trips.
const PATIENCE: Duration = Duration::from_millis(5);

/// Samples replay services in proportion to what they hold: each minibatch comes from one of them, and the counters in it
/// are that one's. One that is away, or waits for transitions, holds nobody up: the others are sampled meanwhile.
///
/// A transition's key is made the source's own: [`MinibatchSource::update_priorities`] brings priorities back to where the
/// transition lies.
#[derive(Debug)]
pub struct ShardedSource {
    shards: Vec<Shard>,
    arrivals: Bell,
    /// Since the last minibatch.
    wait: Waiting,
    shutdown: Shutdown,
}

/// One of the services.
#[derive(Debug)]
struct Shard {
    source: RemoteSource,
    /// Its next minibatch, where it has come.
    next: Option<Minibatch>,
    /// Transitions, at its last minibatch.
    held: f64,
    /// By which it is behind its share.
    turn: f64,
    /// Whether its turn came and it did not.
    late: bool,
}

impl ShardedSource {
    /// Samples the services at `endpoints`, each with `options`.
    ///
    /// # Panics
    /// If there are no endpoints.
    pub fn new(
        endpoints: &[Endpoint],
        options: &RemoteOptions,
        runtime: &Handle,
        waits: Waits,
        shutdown: Shutdown,
    ) -> Self {
        assert!(!endpoints.is_empty(), "a source samples somewhere");
        let arrivals = Bell::default();
        let shard = |(index, endpoint): (usize, &Endpoint)| {
            let mut options = options.clone();
            // No two draw alike.
            options.sample.seed = options.sample.seed.wrapping_add((index as u64) << 48);
            let (waits, shutdown) = (waits.clone(), shutdown.clone());
            let (endpoint, bell) = (endpoint.clone(), Some(arrivals.clone()));
            let source = RemoteSource::with_bell(endpoint, options, runtime, waits, shutdown, bell);
            Shard { source, next: None, held: 1.0, turn: 0.0, late: true }
        };
        let shards = endpoints.iter().enumerate().map(shard).collect();
        Self { shards, arrivals, wait: waits.waiting("learner"), shutdown }
    }

    /// The minibatch whose turn it is; None where it has not come, and its service is not late yet.
    fn take(&mut self) -> Result<Option<Minibatch>, SampleError> {
        for shard in self.shards.iter_mut().filter(|shard| shard.next.is_none()) {
            shard.next = shard.source.poll(Duration::ZERO)?;
            if let Some(next) = &shard.next {
                (shard.held, shard.late) = (next.counters.held.max(1) as f64, false);
            }
        }
        let Some(index) = turn_of(&self.shards) else { return Ok(None) };
        let Some(mut minibatch) = self.shards[index].next.take() else { return Ok(None) };
        let all: f64 = self.shards.iter().filter(|shard| !shard.late).map(|shard| shard.held).sum();
        for shard in self.shards.iter_mut().filter(|shard| !shard.late) {
            shard.turn += shard.held;
        }
        self.shards[index].turn -= all;
        let count = self.shards.len() as u64;
        minibatch.items.iter_mut().for_each(|item| item.key = item.key * count + index as u64);
        Ok(Some(minibatch))
    }

    /// Nobody waits any more for the one whose turn it is, until it comes.
    fn pass_over(&mut self) {
        if self.shards.iter().any(|shard| shard.next.is_some())
            && let Some(index) = turn_of(&self.shards)
        {
            self.shards[index].late = true;
        }
    }
}

/// Why none of them has a minibatch.
fn reason(shards: &[Shard]) -> String {
    let mut reasons: Vec<String> = shards.iter().map(|shard| shard.source.reason()).collect();
    reasons.dedup();
    reasons.join("; ")
}

/// Smooth weighted round-robin: all move on by what they hold, the one that is furthest is next and goes back by what all
/// hold. Those that are late are not counted.
fn turn_of(shards: &[Shard]) -> Option<usize> {
    let here = shards.iter().enumerate().filter(|(_, shard)| !shard.late);
    let furthest = here.max_by(|(_, a), (_, b)| (a.turn + a.held).total_cmp(&(b.turn + b.held)));
    furthest.map(|(index, _)| index)
}

impl MinibatchSource for ShardedSource {
    fn poll(&mut self, patience: Duration) -> Result<Option<Minibatch>, SampleError> {
        let started = Instant::now();
        loop {
            if let Some(minibatch) = self.take()? {
                self.wait.over();
                return Ok(Some(minibatch));
            }
            if self.shutdown.is_triggered() {
                return Err(SampleError::Shutdown);
            }
            let left = patience.saturating_sub(started.elapsed());
            if left.is_zero() {
                return Ok(None);
            }
            if self.shards.iter().any(|shard| shard.next.is_some()) {
                // Another is there: the one whose turn it is has this long, and is passed over then.
                if !self.arrivals.wait(left.min(PATIENCE)) {
                    self.pass_over();
                }
                continue;
            }
            self.arrivals.wait(left.min(CANCEL_TICK));
            self.wait.because_with(|| reason(&self.shards));
        }
    }

    fn update_priorities(&mut self, priorities: Vec<(u64, f32)>) -> Result<(), SampleError> {
        let count = self.shards.len() as u64;
        let mut by_shard = vec![Vec::new(); self.shards.len()];
        for (key, priority) in priorities {
            by_shard[(key % count) as usize].push((key / count, priority));
        }
        for (shard, priorities) in self.shards.iter_mut().zip(by_shard) {
            if !priorities.is_empty() {
                shard.source.update_priorities(priorities)?;
            }
        }
        Ok(())
    }
}
