//! What an actor says to its learner besides playing: heartbeats, and reports of leased evaluations.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use getup_telemetry::{Backoff, Waits};
use tokio::sync::{mpsc, watch};

use crate::link::{EpisodeResult, Heartbeat, LearnerLink, Lease, LinkError, PolicyUpdate, Reported};
use crate::metrics::ActorMetrics;

/// From one heartbeat to the next, on average. The pauses are drawn from half of it to half more, so that actors whose
/// learner was away, or that were started together, do not go on in step.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// How long the last one may take.
const FAREWELL: Duration = Duration::from_secs(1);

/// The correspondence of one actor. It holds at most one lease.
pub(crate) struct Office<'a, L> {
    name: &'a str,
    link: &'a L,
    updates: watch::Receiver<Option<Arc<PolicyUpdate>>>,
    waits: Waits,
    metrics: ActorMetrics,
    /// The lease at work; 0 for none.
    lease: AtomicU64,
}

impl<'a, L: LearnerLink> Office<'a, L> {
    pub(crate) fn new(
        name: &'a str,
        link: &'a L,
        updates: watch::Receiver<Option<Arc<PolicyUpdate>>>,
        waits: Waits,
        metrics: ActorMetrics,
    ) -> Self {
        Self { name, link, updates, waits, metrics, lease: AtomicU64::new(0) }
    }

    /// Sends a heartbeat about once a second, for ever; a lease that comes back goes to `leases`.
    pub(crate) async fn send_heartbeats(&self, leases: mpsc::Sender<Lease>) {
        let mut newest = (None, Instant::now());
        let mut last_error = None;
        loop {
            let update = self.updates.borrow().clone();
            let version = update.map(|update| update.version);
            if newest.0 != version {
                newest = (version, Instant::now());
            }
            if let Some(version) = version {
                self.metrics.policy_version.set(version.counter as i64);
                self.metrics.policy_age.set(newest.1.elapsed().as_secs_f64());
            }
            match self.link.heartbeat(self.beat()).await {
                Ok(lease) => {
                    last_error = None;
                    if let Some(lease) = lease {
                        self.take(lease, &leases);
                    }
                }
                Err(error) if last_error.as_ref() == Some(&error) => {}
                Err(error) => {
                    tracing::warn!("a heartbeat was not heard: {error}");
                    last_error = Some(error);
                }
            }
            tokio::time::sleep(HEARTBEAT.mul_f64(rand::random_range(0.5..=1.5))).await;
        }
    }

    fn beat(&self) -> Heartbeat {
        let update = self.updates.borrow().clone();
        Heartbeat {
            actor: self.name.to_owned(),
            lease: self.lease.load(Ordering::Relaxed),
            version: update.map(|update| update.version).unwrap_or_default(),
            env_steps: self.metrics.env_steps.get(),
            waiting: self.waiting(),
            leaving: false,
        }
    }

    /// Says that the actor ends: nobody need miss it, and its lease is free. A learner that is away does not hear it.
    pub(crate) async fn leave(&self) {
        let last = self.link.heartbeat(Heartbeat { leaving: true, ..self.beat() });
        if !matches!(tokio::time::timeout(FAREWELL, last).await, Ok(Ok(_))) {
            tracing::debug!("the learner did not hear that this actor ends");
        }
    }

    fn waiting(&self) -> String {
        let waits = self.waits.current();
        let ours = waits.into_iter().filter(|wait| wait.what.starts_with("actor"));
        // Threads mostly wait for the same.
        let reasons: BTreeSet<String> = ours.map(|wait| wait.reason).collect();
        reasons.into_iter().collect::<Vec<_>>().join("; ")
    }

    fn take(&self, lease: Lease, leases: &mpsc::Sender<Lease>) {
        let (id, version) = (lease.id, lease.update.version);
        if self.lease.load(Ordering::Relaxed) == 0 && leases.try_send(lease).is_ok() {
            tracing::debug!(lease = id, "evaluating policy {version}");
            self.lease.store(id, Ordering::Relaxed);
        }
    }

    /// Sends every report until it is heard, for ever.
    pub(crate) async fn send_reports(&self, mut reports: mpsc::UnboundedReceiver<(u64, Vec<EpisodeResult>)>) {
        while let Some((lease, episodes)) = reports.recv().await {
            self.send_report(lease, episodes).await;
            self.lease.store(0, Ordering::Relaxed);
        }
        // The lane threads have ended: whoever waits for them ends this too.
        std::future::pending().await
    }

    async fn send_report(&self, lease: u64, episodes: Vec<EpisodeResult>) {
        let mut backoff = Backoff::new();
        let mut waiting = self.waits.waiting("actor_report");
        loop {
            match self.link.report(lease, episodes.clone()).await {
                Ok(Reported::Accepted) => return,
                Ok(Reported::LeaseLost) => {
                    tracing::info!(lease, "the lease of an evaluation was lost; its report is dropped");
                    return;
                }
                Err(LinkError::Refused(reason)) => {
                    tracing::warn!(lease, "the report of an evaluation was refused: {reason}");
                    return;
                }
                Err(LinkError::Unavailable(reason)) => {
                    waiting.because(reason);
                    tokio::time::sleep(backoff.next()).await;
                }
            }
        }
    }
}
