//! The actor as a role: threads of lanes, the segment queue, heartbeats and reports, until shutdown.

use std::future::pending;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use getup_proto::RunSpec;
use getup_sim::{GetUp, SimError, TaskConfig};
use getup_telemetry::{Registry, Shutdown, Traces, Waits};
use tokio::runtime::Handle;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;

use crate::config::ActorConfig;
use crate::error::ActorError;
use crate::explore::BetaDraw;
use crate::identity::Identity;
use crate::lane_thread::{EvaluationDesk, LaneThread};
use crate::lanes::LaneSettings;
use crate::link::{EpisodeResult, LearnerLink, Lease, PolicyUpdate, SegmentWriter};
use crate::metrics::ActorMetrics;
use crate::office::Office;
use crate::queue::{QueueInput, queue};
use crate::spread::spread;

/// Everything that an actor is made from.
#[derive(Clone, Debug)]
pub struct ActorSetup {
    /// How it plays and sends.
    pub config: ActorConfig,
    /// What it plays.
    pub task: TaskConfig,
    /// What its segments look like.
    pub spec: RunSpec,
    /// Who it is.
    pub identity: Identity,
    /// How β̂ is drawn; its ceiling is also the actuators' clamp, where it is above 1.
    pub beta: BetaDraw,
    /// Where the states of diverged episodes are kept.
    pub diverged_folder: PathBuf,
    /// What follows some of its segments.
    pub traces: Traces,
}

impl ActorSetup {
    /// What its lanes have in common, counted by `metrics`.
    ///
    /// # Errors
    /// [`SimError`] where the task or its character cannot be made.
    pub fn lane_settings(&self, metrics: ActorMetrics) -> Result<LaneSettings, SimError> {
        Ok(LaneSettings {
            task: Arc::new(GetUp::new(&self.task, self.control_limit())?),
            config: self.config.clone(),
            spec: self.spec.clone(),
            identity: self.identity.clone(),
            beta: self.beta,
            diverged_folder: self.diverged_folder.clone(),
            metrics,
            traces: self.traces.clone(),
        })
    }

    /// The actuators' clamp, over their own: for a start that is stronger than the character.
    fn control_limit(&self) -> f64 {
        self.beta.ceiling.max(1.0)
    }
}

/// Runs an actor until `shutdown`, which then takes up to `drain_seconds`. Its segments are spread over `writers`, each
/// the way to one replay.
///
/// It waits for its first policy, and goes on waiting after the last: an actor ends by shutdown alone.
///
/// # Errors
/// [`ActorError`] when it cannot go on; everything it started has ended then.
///
/// # Panics
/// When `registry` has an actor's metrics already, or there are no writers.
pub async fn run<W: SegmentWriter, L: LearnerLink>(
    setup: ActorSetup,
    writers: Vec<W>,
    link: L,
    waits: Waits,
    shutdown: Shutdown,
    registry: &Registry,
) -> Result<(), ActorError> {
    run_with(&setup, writers, link, waits, shutdown, registry, |playing| playing.start(&setup)).await
}

/// As [`run`], with whatever `play` starts in the place of lanes of simulated characters: all else of an actor is the same.
///
/// # Errors
/// As [`run`], and what `play` returns.
///
/// # Panics
/// As [`run`].
pub async fn run_with<W: SegmentWriter, L: LearnerLink>(
    setup: &ActorSetup,
    writers: Vec<W>,
    link: L,
    waits: Waits,
    shutdown: Shutdown,
    registry: &Registry,
    play: impl FnOnce(Playing) -> Result<JoinSet<Result<(), ActorError>>, ActorError>,
) -> Result<(), ActorError> {
    assert!(!writers.is_empty(), "an actor writes somewhere");
    setup.config.validate()?;
    let metrics = ActorMetrics::new(registry, &setup.identity.name);
    let stop = StopOnDrop(Shutdown::new());
    let (slot, updates) = watch::channel(None);
    let (queue, output) = queue(setup.config.queue_segments, metrics.clone());
    let (lease_sender, leases) = mpsc::channel(1);
    let (reports, report_receiver) = mpsc::unbounded_channel();
    let mut threads = play(Playing {
        updates: updates.clone(),
        queue,
        leases,
        reports,
        waits: waits.clone(),
        stop: stop.0.clone(),
        metrics: metrics.clone(),
    })?;
    let mut writing = JoinSet::new();
    let follow = (setup.traces.clone(), setup.identity.name.as_str());
    spread(writers, output, &metrics.append_seconds, follow, &mut writing);
    let office = Office::new(&setup.identity.name, &link, updates, waits, metrics.clone());

    let result = tokio::select! {
        () = shutdown.wait() => Ok(()),
        result = first_error(&mut threads) => result,
        result = first_error(&mut writing) => result,
        result = subscribe(&link, slot) => result,
        () = office.send_heartbeats(lease_sender) => Ok(()),
        () = office.send_reports(report_receiver) => Ok(()),
    };
    stop.0.trigger();
    let result = result.and(first_error_of_all(&mut threads).await);
    if result.is_ok() {
        office.leave().await;
        drain(&mut writing, &setup.config, &metrics).await?;
    }
    let (segments, acknowledged) = (metrics.segments.get(), metrics.segments_acknowledged.get());
    tracing::info!(env_steps = metrics.env_steps.get(), segments, acknowledged, "actor ended");
    result
}

/// Whatever way [`run`] ends, its threads do.
struct StopOnDrop(Shutdown);

impl Drop for StopOnDrop {
    fn drop(&mut self) {
        self.0.trigger();
    }
}

/// What those who play hear from the rest of the actor, and where they put what they played.
#[derive(Debug)]
pub struct Playing {
    /// The newest policy.
    pub updates: watch::Receiver<Option<Arc<PolicyUpdate>>>,
    /// For segments.
    pub queue: QueueInput,
    /// Evaluations to play, one at a time.
    pub leases: mpsc::Receiver<Lease>,
    /// For their results, under their leases' ids.
    pub reports: mpsc::UnboundedSender<(u64, Vec<EpisodeResult>)>,
    /// Where a wait is explained.
    pub waits: Waits,
    /// When to stop.
    pub stop: Shutdown,
    /// What is counted.
    pub metrics: ActorMetrics,
}

impl Playing {
    /// Starts the threads of lanes.
    fn start(self, setup: &ActorSetup) -> Result<JoinSet<Result<(), ActorError>>, ActorError> {
        let settings = setup.lane_settings(self.metrics)?;
        let desk = EvaluationDesk {
            task: setup.task.clone(),
            control_limit: setup.control_limit(),
            leases: self.leases,
            reports: self.reports,
            evaluator: None,
        };
        let mut desk = Some(desk);
        let mut threads = JoinSet::new();
        for share in shares(setup.config.lanes, setup.config.threads) {
            let thread = LaneThread {
                settings: settings.clone(),
                first_lane: share.start as u32,
                lanes: share.len(),
                updates: self.updates.clone(),
                queue: self.queue.clone(),
                desk: desk.take(),
                waits: self.waits.clone(),
                stop: self.stop.clone(),
            };
            threads.spawn_blocking(move || thread.run(&Handle::current()));
        }
        Ok(threads)
    }
}

/// Divides lanes over threads as evenly as they go.
fn shares(lanes: usize, threads: usize) -> impl Iterator<Item = Range<usize>> {
    (0..threads).map(move |thread| lanes * thread / threads..lanes * (thread + 1) / threads)
}

/// Returns with the first task that fails; never, where none does.
async fn first_error(tasks: &mut JoinSet<Result<(), ActorError>>) -> Result<(), ActorError> {
    while let Some(ended) = tasks.join_next().await {
        ended??;
    }
    pending().await
}

/// Waits for all tasks, and returns the first failure among them.
async fn first_error_of_all(tasks: &mut JoinSet<Result<(), ActorError>>) -> Result<(), ActorError> {
    let mut result = Ok(());
    while let Some(ended) = tasks.join_next().await {
        result = result.and(ended.map_err(ActorError::from).flatten());
    }
    result
}

async fn subscribe(link: &impl LearnerLink, slot: crate::link::PolicySlot) -> Result<(), ActorError> {
    link.subscribe(slot).await.map_err(ActorError::Refused)?;
    pending().await
}

/// Gives the writers their time to send what the lanes left.
async fn drain(
    writing: &mut JoinSet<Result<(), ActorError>>,
    config: &ActorConfig,
    metrics: &ActorMetrics,
) -> Result<(), ActorError> {
    let limit = Duration::from_secs_f64(config.drain_seconds);
    match tokio::time::timeout(limit, first_error_of_all(writing)).await {
        Ok(result) => result,
        Err(_) => {
            let left = metrics.unacknowledged_segments.get();
            tracing::warn!("{left} segments are lost: the replay did not take them within {limit:?}");
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_lane_belongs_to_one_thread_and_no_thread_is_without(threads in 1usize..20, more in 0usize..50) {
            let lanes = threads + more;
            let shares: Vec<_> = shares(lanes, threads).collect();
            prop_assert!(shares.iter().all(|share| !share.is_empty()));
            prop_assert_eq!(shares.into_iter().flatten().collect::<Vec<_>>(), (0..lanes).collect::<Vec<_>>());
        }
    }
}
