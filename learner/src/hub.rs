//! What actors see of the learner: the newest policy, evaluations on lease, and a place to be counted.
//!
//! The training thread publishes and offers; actors subscribe, send heartbeats and report, over gRPC
//! ([`crate::service`]) or in the same process. Both ways use the messages of the wire.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use getup_proto::names::FALLS_SCENARIO;
use getup_proto::{RunSpec, SpecError, v1};
use getup_telemetry::Waits;
use tokio::sync::watch;

use crate::leases::{LeaseCounts, LeaseError, Leases};

/// A heartbeat older than this says that its actor is lost.
pub(crate) const ACTOR_LOST: Duration = Duration::from_secs(60);
/// One that is lost for so long is forgotten.
const ACTOR_FORGOTTEN: Duration = Duration::from_secs(600);
/// How often those are looked for: not at every heartbeat, or the work would grow with the square of their number.
const SWEEP: Duration = Duration::from_secs(1);
/// Policies of which it is known when they were published: fewer of them the longer ago it is.
const PUBLISHED: usize = 1024;

/// Why a message of an actor is refused; nothing was changed.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// The actor belongs to another run, task or shape.
    #[error("this learner serves another run: {0}")]
    Spec(#[from] SpecError),
    /// The report's lease.
    #[error(transparent)]
    Lease(#[from] LeaseError),
    /// A message that no actor of ours sends.
    #[error("{0}")]
    Malformed(String),
}

/// An evaluation: a policy, and where the run stood when it was made.
#[derive(Clone, Debug)]
pub struct Evaluation {
    /// The policy, as it was broadcast.
    pub policy: Arc<v1::PolicyUpdate>,
    /// Updates behind it.
    pub updates: u64,
}

/// What the training thread tells of itself.
#[derive(Clone, Debug, Default)]
pub struct Standing {
    /// "waiting", "filling" (the replay, before the updates of a trained actor go on), "training", "finished", "stopped" (by an
    /// update that failed).
    pub state: &'static str,
    /// Env steps of the run.
    pub env_steps: u64,
    /// Updates of the run.
    pub updates: u64,
    /// Over the last seconds.
    pub updates_per_second: f64,
    /// Stage, its β, its env steps, and its limit (0 for none).
    pub stage: u32,
    /// See `stage`.
    pub beta: f64,
    /// See `stage`.
    pub stage_env_steps: u64,
    /// See `stage`.
    pub stage_limit: u64,
    /// The newest evaluation.
    pub evaluation: Option<v1::EvaluationSummary>,
}

struct ActorEntry {
    heartbeat: v1::HeartbeatRequest,
    seen: Instant,
}

struct State {
    leases: Leases<Evaluation, Vec<v1::EpisodeResult>>,
    actors: BTreeMap<String, ActorEntry>,
    standing: Standing,
    /// Counters of the newest policies, oldest first, and when they came.
    published: VecDeque<(u64, Instant)>,
    /// When forgotten actors were last looked for.
    swept: Instant,
}

/// What the learner knows of an actor, as of its last heartbeat.
#[derive(Clone, PartialEq, Debug)]
pub struct ActorView {
    /// Its name.
    pub name: String,
    /// Since its last heartbeat.
    pub silent: Duration,
    /// Policies published since the one it acts by.
    pub versions_behind: u64,
    /// For how long it has been without the policy that followed its own.
    pub lag: Duration,
}

/// The meeting place of one learner and its actors.
pub struct Hub {
    spec: RunSpec,
    seeds: Vec<u64>,
    keep_alive: Duration,
    waits: Waits,
    policy: watch::Sender<Arc<v1::PolicyUpdate>>,
    state: Mutex<State>,
    reported: Condvar,
    incarnation: u64,
    /// Lease numbers on the wire are these plus the table's: those of an earlier learner stay unknown.
    lease_base: u64,
}

impl Hub {
    /// A hub whose evaluations start from `seeds` and whose leases last `keep_alive`. `incarnation` numbers the
    /// learner's starts on this run.
    pub fn new(spec: RunSpec, seeds: Vec<u64>, keep_alive: Duration, incarnation: u64, waits: Waits) -> Self {
        let state = State {
            leases: Leases::new(keep_alive),
            actors: BTreeMap::new(),
            standing: Standing::default(),
            published: VecDeque::new(),
            swept: Instant::now(),
        };
        Self {
            spec,
            seeds,
            keep_alive,
            waits,
            policy: watch::Sender::new(Arc::default()),
            state: Mutex::new(state),
            reported: Condvar::new(),
            incarnation,
            lease_base: incarnation << 32,
        }
    }

    /// Where the learner is waiting, and for what.
    pub fn waits(&self) -> &Waits {
        &self.waits
    }

    /// The newest policy, now and later. Before the first is published it is empty (no networks).
    pub fn subscribe(&self, spec: &RunSpec) -> Result<watch::Receiver<Arc<v1::PolicyUpdate>>, HubError> {
        self.check(spec)?;
        Ok(self.policy.subscribe())
    }

    /// Refuses whoever simulates something else than this run.
    pub fn check(&self, spec: &RunSpec) -> Result<(), HubError> {
        Ok(self.spec.check_same(spec)?)
    }

    /// Broadcasts a policy; whoever has not taken the one before it never sees that one.
    pub fn publish(&self, policy: Arc<v1::PolicyUpdate>) {
        if let Some(version) = policy.version {
            let published = &mut self.lock().published;
            if published.len() == PUBLISHED {
                // Every second one: the first stays, which is what an actor that hears nothing is behind.
                let mut stays = false;
                published.retain(|_| {
                    stays = !stays;
                    stays
                });
            }
            published.push_back((version.counter, Instant::now()));
        }
        self.policy.send_replace(policy);
    }

    /// Offers an evaluation for lease.
    pub fn offer(&self, evaluation: Evaluation) {
        self.lock().leases.offer(evaluation);
    }

    /// Evaluations that are not reported yet.
    pub fn outstanding(&self) -> usize {
        self.lock().leases.len()
    }

    /// The next evaluation with its results, in the order of the offers.
    pub fn take_reported(&self) -> Option<(Evaluation, Vec<v1::EpisodeResult>)> {
        self.lock().leases.take_reported()
    }

    /// Blocks until something is reported, at most `timeout`.
    pub fn wait_for_report(&self, timeout: Duration) {
        let guard = self.lock();
        let _unused =
            self.reported.wait_timeout(guard, timeout).unwrap_or_else(|poisoned| poisoned.into_inner());
    }

    /// Counts an actor in, keeps its lease, and gives it one where it is idle and there is one.
    pub fn heartbeat(
        &self,
        request: v1::HeartbeatRequest,
        now: Instant,
    ) -> Result<v1::HeartbeatReply, HubError> {
        if request.actor.is_empty() || request.actor.len() > 256 {
            return Err(HubError::Malformed("an actor's name has 1 to 256 bytes".into()));
        }
        let mut state = self.lock();
        let name = request.actor.clone();
        if let Some(lease) = request.lease.checked_sub(self.lease_base) {
            state.leases.keep_alive(lease, &name, now);
        }
        if request.leaving {
            state.leases.release(&name);
            state.actors.remove(&name);
            return Ok(v1::HeartbeatReply { lease: None });
        }
        let lease = if request.idle { self.lease(&mut state, &name, now) } else { None };
        state.actors.insert(name, ActorEntry { heartbeat: request, seen: now });
        if now.duration_since(state.swept) >= SWEEP {
            state.actors.retain(|_, actor| now.duration_since(actor.seen) < ACTOR_FORGOTTEN);
            state.swept = now;
        }
        Ok(v1::HeartbeatReply { lease })
    }

    fn lease(&self, state: &mut State, actor: &str, now: Instant) -> Option<v1::EvaluationLease> {
        let (id, evaluation) = state.leases.acquire(actor, now)?;
        Some(v1::EvaluationLease {
            id: self.lease_base + id,
            policy: Some(v1::PolicyUpdate::clone(&evaluation.policy)),
            scenario: FALLS_SCENARIO.into(),
            seeds: self.seeds.clone(),
            keep_alive_seconds: self.keep_alive.as_secs_f64(),
        })
    }

    /// Takes the report of a lease.
    pub fn report(&self, report: v1::EvaluationReport) -> Result<(), HubError> {
        let wanted = self.seeds.len();
        if report.episodes.len() != wanted {
            let (lease, got) = (report.lease, report.episodes.len());
            return Err(LeaseError::Episodes { lease, wanted, got }.into());
        }
        if let Some(index) = report.episodes.iter().position(|episode| !episode.episode_return.is_finite()) {
            let value = report.episodes[index].episode_return;
            return Err(HubError::Malformed(format!("the return of episode {index} is {value}, not finite")));
        }
        let lease = report.lease.checked_sub(self.lease_base).ok_or(LeaseError::NotHeld(report.lease))?;
        self.lock().leases.report(lease, report.episodes).map_err(|_| LeaseError::NotHeld(report.lease))?;
        self.reported.notify_all();
        Ok(())
    }

    /// Every actor that was heard from within the last minutes and has not said that it ends.
    pub fn actors(&self, now: Instant) -> Vec<ActorView> {
        let state = self.lock();
        let view = |(name, actor): (&String, &ActorEntry)| {
            let silent = now.duration_since(actor.seen);
            let version = actor.heartbeat.version.unwrap_or_default();
            // A policy of an earlier learner is older than all of this one.
            let counter = (version.incarnation == self.incarnation).then_some(version.counter);
            let newer = |published: &&(u64, Instant)| counter.is_none_or(|counter| published.0 > counter);
            let next = state.published.iter().find(newer);
            let newest = state.published.back().map_or(0, |(counter, _)| *counter);
            ActorView {
                name: name.clone(),
                silent,
                versions_behind: counter.map_or(newest + 1, |counter| newest.saturating_sub(counter)),
                lag: next.map_or(Duration::ZERO, |(_, since)| actor.seen.saturating_duration_since(*since)),
            }
        };
        state
            .actors
            .iter()
            .filter(|(_, actor)| now.duration_since(actor.seen) < ACTOR_FORGOTTEN)
            .map(view)
            .collect()
    }

    /// Evaluations on offer and on lease, and what became of others.
    pub fn lease_counts(&self) -> LeaseCounts {
        self.lock().leases.counts()
    }

    /// Takes what the training thread tells of itself.
    pub fn set_standing(&self, standing: Standing) {
        self.lock().standing = standing;
    }

    /// Where the training stands.
    pub fn standing(&self) -> Standing {
        self.lock().standing.clone()
    }

    /// How training stands, for `getup status`.
    pub fn status(&self, now: Instant) -> v1::StatusReply {
        let waiting: Vec<String> = self.waits.current().into_iter().map(|wait| wait.to_string()).collect();
        let state = self.lock();
        let actors = state.actors.iter().map(|(name, actor)| v1::ActorState {
            name: name.clone(),
            version: actor.heartbeat.version,
            env_steps: actor.heartbeat.env_steps,
            silent_seconds: now.duration_since(actor.seen).as_secs_f64(),
            lease: actor.heartbeat.lease,
            waiting: actor.heartbeat.waiting.clone(),
        });
        let standing = &state.standing;
        v1::StatusReply {
            run: self.spec.run.clone(),
            state: standing.state.into(),
            waiting: waiting.join("; "),
            env_steps: standing.env_steps,
            updates: standing.updates,
            updates_per_second: standing.updates_per_second,
            stage: standing.stage,
            beta: standing.beta,
            stage_env_steps: standing.stage_env_steps,
            stage_limit: standing.stage_limit,
            version: self.policy.borrow().version,
            actors: actors.collect(),
            evaluation: standing.evaluation,
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // A panic elsewhere leaves the tables whole: every change to them is one call.
        self.state.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }
}
