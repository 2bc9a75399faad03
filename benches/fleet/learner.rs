//! The process `learner`: hub, service, broadcasts and sampling as they are, at a fixed pace, without gradients.

use std::hint::black_box;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::Result;
use getup_learner::hub::Hub;
use getup_learner::service::service;
use getup_policy::{Body, ObservationStatistics, Policy, PolicyShape};
use getup_proto::names::{BETA_VALUE, HIGH_STARTS_VALUE, POLICY_NETWORK};
use getup_proto::{PolicyVersion, v1};
use getup_replay::{MinibatchSource, RemoteOptions, SampleError, SampleOptions, ShardedSource};
use getup_telemetry::{Registry, Shutdown, Waits, health};
use getup_transport::{Limits, Window};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use tonic::service::Routes;

use crate::fixtures::get_up_spec;
use crate::processes::{answer, listen, port, unix_seconds, work_until};

const BATCH: usize = 128;
/// Minibatches ahead, as a learner has them.
const PREFETCH: usize = 8;
/// The value of an update that says when it was published, in seconds since 1970.
pub(crate) const PUBLISHED: &str = "published";

pub(crate) fn run(replay: &str, broadcasts: f64, minibatches: f64) -> Result<()> {
    let shutdown = Shutdown::new();
    work_until(&shutdown, async {
        let hub = Arc::new(hub());
        let listener = listen().await?;
        let routes =
            Routes::new(health(shutdown.clone())).add_service(service(Arc::clone(&hub), shutdown.clone()));
        let sampled = Arc::new(AtomicU64::new(0));
        let source = source(replay, &shutdown);
        let (count, ended) = (Arc::clone(&sampled), shutdown.clone());
        thread::spawn(move || publish(&hub, broadcasts, &ended));
        let ended = shutdown.clone();
        thread::spawn(move || sample(source, minibatches, &count, &ended));
        let limits = Limits { window: Window::Adaptive, ..Limits::default() };
        let serving = port(limits).serve(listener, routes, shutdown.clone());
        let mut since = Instant::now();
        let counts = || {
            let minibatches = sampled.swap(0, Ordering::Relaxed) as f64 / since.elapsed().as_secs_f64();
            since = Instant::now();
            json!({ "minibatches": minibatches })
        };
        tokio::select! {
            served = serving => Ok(served?),
            answered = answer(counts) => answered,
        }
    })
}

pub(crate) fn hub() -> Hub {
    let seeds = (0..10).collect();
    Hub::new(get_up_spec(), seeds, Duration::from_secs(30), 1, Waits::new(&Registry::new()))
}

/// A policy of the size that preset `laptop` broadcasts.
pub(crate) fn policy() -> Policy {
    let body = Body::Simba { width: 128, blocks: 1 };
    let shape = PolicyShape { observation: 68, action: 21, body };
    let mut policy = Policy::init(shape, &mut ChaCha8Rng::seed_from_u64(1));
    policy.statistics = Some(ObservationStatistics { mean: vec![0.0; 68], std: vec![1.0; 68], clip: 5.0 });
    policy.metadata = [("beta", "1"), ("task", "getup"), ("run", "fleet"), ("updates", "100000")]
        .map(|(key, value)| (key.to_owned(), value.to_owned()))
        .into();
    policy
}

/// Broadcasts at a fixed pace, as a trainer does: each time the policy becomes a model file.
fn publish(hub: &Hub, per_second: f64, shutdown: &Shutdown) {
    let policy = policy();
    let mut pace = Pace::new(per_second);
    for counter in 0.. {
        pace.wait();
        if shutdown.is_triggered() {
            return;
        }
        let model = policy.to_bytes().into();
        let values = [(BETA_VALUE, 1.0), (HIGH_STARTS_VALUE, 0.0), (PUBLISHED, unix_seconds())];
        hub.publish(Arc::new(v1::PolicyUpdate {
            version: Some(PolicyVersion { incarnation: 1, counter }.into()),
            networks: vec![v1::NamedNetwork { name: POLICY_NETWORK.to_owned(), model }],
            values: values.map(|(name, value)| (name.to_owned(), value)).into(),
            ..v1::PolicyUpdate::default()
        }));
    }
}

fn source(replay: &str, shutdown: &Shutdown) -> ShardedSource {
    let options = RemoteOptions {
        spec: get_up_spec(),
        sample: SampleOptions { batch: BATCH, n_step: 5, gamma: 0.97, seed: 1, segments: false },
        name: "learner".to_owned(),
        table: String::new(),
        prefetch: PREFETCH,
    };
    let runtime = tokio::runtime::Handle::current();
    let waits = Waits::new(&Registry::new());
    ShardedSource::new(&[replay.into()], &options, &runtime, waits, shutdown.clone())
}

/// Takes minibatches at a fixed pace.
fn sample(mut source: ShardedSource, per_second: f64, count: &AtomicU64, shutdown: &Shutdown) {
    let mut pace = Pace::new(per_second);
    while !shutdown.is_triggered() {
        pace.wait();
        match source.next() {
            Ok(minibatch) => drop(black_box(minibatch)),
            Err(SampleError::Shutdown) => return,
            Err(error) => return eprintln!("the learner samples no more: {error}"),
        }
        count.fetch_add(1, Ordering::Relaxed);
    }
}

/// So many times a second; what was missed by more than a second is not made up for.
struct Pace {
    due: Instant,
    every: Duration,
}

impl Pace {
    fn new(per_second: f64) -> Self {
        Self { due: Instant::now(), every: Duration::from_secs_f64(1.0 / per_second) }
    }

    fn wait(&mut self) {
        let now = Instant::now();
        thread::sleep(self.due.saturating_duration_since(now));
        let earliest = now.checked_sub(Duration::from_secs(1)).unwrap_or(now);
        self.due = (self.due + self.every).max(earliest);
    }
}
