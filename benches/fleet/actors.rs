//! The process `load`: the actors, without physics.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use getup_actor::link::{LearnerLink, SegmentWriter};
use getup_actor::{GrpcLearner, GrpcReplay, Heartbeat, Identity, LinkError, PolicyUpdate};
use getup_proto::Segment;
use getup_telemetry::{Registry, Shutdown, Waits};
use serde_json::{Value, json};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;

use crate::fixtures::get_up_spec;
use crate::learner::PUBLISHED;
use crate::load::{episode, percentiles};
use crate::processes::{answer, say, unix_seconds, work_until};

/// Env steps a second of an actor.
pub(crate) const ENV_STEPS: f64 = 400.0;
const STEPS: usize = 64;
/// How long all actors may take to connect.
const PATIENCE: Duration = Duration::from_secs(30);

/// What the actors have seen, all together; times in seconds.
#[derive(Default)]
struct Seen {
    lags: Vec<f64>,
    appends: Vec<f64>,
    heartbeats: Vec<f64>,
    env_steps: usize,
}

/// What the tasks of an actor share.
#[derive(Clone)]
struct Actor {
    name: String,
    /// Its place among the actors, in [0, 1): they do not act in step.
    phase: f64,
    seen: Arc<Mutex<Seen>>,
    /// Told when the first segment is acknowledged, and when the first policy is there.
    arrived: mpsc::UnboundedSender<()>,
}

pub(crate) fn run(replay: &str, learner: &str, actors: u64) -> Result<()> {
    let shutdown = Shutdown::new();
    work_until(&shutdown, async {
        let seen = Arc::new(Mutex::new(Seen::default()));
        let segments: Arc<[Segment]> = (0..8).flat_map(|number| episode(&get_up_spec(), number)).collect();
        let (arrived, mut arrivals) = mpsc::unbounded_channel();
        let mut tasks = JoinSet::new();
        for number in 0..actors {
            let actor = Actor {
                name: format!("actor-{number}"),
                phase: number as f64 / actors as f64,
                seen: Arc::clone(&seen),
                arrived: arrived.clone(),
            };
            let waits = Waits::new(&Registry::new());
            let identity = Identity { name: actor.name.clone(), run_seed: 0, writer: number + 1 };
            let to_replay = GrpcReplay::new(replay, get_up_spec(), identity, waits.clone())?;
            let to_learner = GrpcLearner::new(learner, get_up_spec(), &actor.name, waits)?;
            let (slot, updates) = watch::channel(None);
            tasks.spawn(append(to_replay, Arc::clone(&segments), actor.clone()));
            tasks.spawn(hear(updates.clone(), actor.clone()));
            tasks.spawn(async move {
                // Both by one connection, as an actor does.
                tokio::select! {
                    ended = to_learner.subscribe(slot) => Ok(ended?),
                    ended = send_heartbeats(&to_learner, updates, actor) => ended,
                }
            });
        }
        let all_arrive = async {
            for _ in 0..2 * actors {
                arrivals.recv().await;
            }
        };
        let mut since = Instant::now();
        let counts = || {
            let seen = std::mem::take(&mut *lock(&seen));
            let seconds = since.elapsed().as_secs_f64();
            since = Instant::now();
            seen.summary(seconds)
        };
        let work = async {
            let arrive = tokio::time::timeout(PATIENCE, all_arrive).await;
            arrive.map_err(|_| anyhow::anyhow!("not all actors were connected within {PATIENCE:?}"))?;
            say("ready")?;
            answer(counts).await
        };
        tokio::select! {
            worked = work => worked,
            Some(ended) = tasks.join_next() => ended?.and_then(|()| bail!("an actor has ended")),
        }
    })
}

/// Appends segments as they become due, all that are there at a time.
async fn append(mut link: GrpcReplay, segments: Arc<[Segment]>, actor: Actor) -> Result<()> {
    let (writer, mut sequence, mut first) = (link.writer(), 0, true);
    let mut next = segments.iter().cycle().skip(writer as usize % segments.len());
    let mut due =
        tokio::time::Instant::now() + Duration::from_secs_f64(actor.phase * STEPS as f64 / ENV_STEPS);
    loop {
        tokio::time::sleep_until(due).await;
        let now = tokio::time::Instant::now();
        let (mut group, mut env_steps) = (Vec::new(), 0);
        while due <= now
            && let Some(segment) = next.next()
        {
            sequence += 1;
            group.push(Segment { writer, sequence, ..segment.clone() });
            env_steps += segment.steps;
            due += Duration::from_secs_f64(segment.steps as f64 / ENV_STEPS);
        }
        let began = Instant::now();
        link.append(group).await?;
        let took = began.elapsed().as_secs_f64();
        if std::mem::take(&mut first) {
            // Whoever counts may have ended.
            let _ = actor.arrived.send(());
        }
        let mut seen = lock(&actor.seen);
        seen.appends.push(took);
        seen.env_steps += env_steps;
    }
}

/// Notes when each policy comes.
async fn hear(mut updates: watch::Receiver<Option<Arc<PolicyUpdate>>>, actor: Actor) -> Result<()> {
    let mut first = true;
    while updates.changed().await.is_ok() {
        let Some(update) = updates.borrow_and_update().clone() else { continue };
        let published = update.values.get(PUBLISHED).context("an update says when it was published")?;
        lock(&actor.seen).lags.push(unix_seconds() - published);
        if std::mem::take(&mut first) {
            let _ = actor.arrived.send(());
        }
    }
    bail!("{} hears no policies any more", actor.name)
}

async fn send_heartbeats(
    link: &GrpcLearner,
    updates: watch::Receiver<Option<Arc<PolicyUpdate>>>,
    actor: Actor,
) -> Result<()> {
    let start = tokio::time::Instant::now() + Duration::from_secs_f64(actor.phase);
    let mut ticks = tokio::time::interval_at(start, Duration::from_secs(1));
    loop {
        ticks.tick().await;
        let version = updates.borrow().as_ref().map(|update| update.version).unwrap_or_default();
        let beat = Heartbeat { actor: actor.name.clone(), version, ..Heartbeat::default() };
        let began = Instant::now();
        // One that is late is noted as such, as by an actor.
        if let Err(error @ LinkError::Refused(_)) = link.heartbeat(beat).await {
            return Err(error.into());
        }
        lock(&actor.seen).heartbeats.push(began.elapsed().as_secs_f64());
    }
}

impl Seen {
    fn summary(self, seconds: f64) -> Value {
        let policies = self.lags.len() as f64 / seconds;
        let [lag, append, heartbeat] =
            [self.lags, self.appends, self.heartbeats].map(|times| percentiles(times, [0.5, 0.99]));
        json!({
            "lag_p50": lag[0],
            "lag_p99": lag[1],
            "append_p50": append[0],
            "append_p99": append[1],
            "heartbeat_p50": heartbeat[0],
            "heartbeat_p99": heartbeat[1],
            "policies": policies,
            "env_steps": self.env_steps as f64 / seconds,
        })
    }
}

fn lock(seen: &Mutex<Seen>) -> MutexGuard<'_, Seen> {
    seen.lock().unwrap_or_else(PoisonError::into_inner)
}
