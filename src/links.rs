//! The roles in one process: the actor's links to replay and learner, without the network in between.
//!
//! What passes is what would pass on the wire, through the same doors: the hub's messages are parsed as those of a
//! stream are, and the store takes segments as its service does.

use std::sync::Arc;
use std::time::Instant;

use getup_actor::identity::Identity;
use getup_actor::link::{
    EpisodeResult, Heartbeat, LearnerLink, Lease, LinkError, PolicySlot, PolicyUpdate, Reported,
    SegmentWriter,
};
use getup_learner::hub::{Hub, HubError};
use getup_learner::leases::LeaseError;
use getup_proto::{RunSpec, Segment, v1};
use getup_replay::{Store, StoreError};
use getup_telemetry::Shutdown;

/// Appends to a store in this process.
pub(crate) struct StoreWriter {
    store: Arc<Store>,
    writer: u64,
    shutdown: Shutdown,
}

impl StoreWriter {
    /// A writer with the id that its segments carry, under the name that `status` shows.
    pub(crate) fn new(store: Arc<Store>, identity: &Identity, shutdown: Shutdown) -> Self {
        store.introduce(identity.writer, &identity.name);
        Self { store, writer: identity.writer, shutdown }
    }
}

impl Drop for StoreWriter {
    fn drop(&mut self) {
        self.store.farewell(self.writer);
    }
}

impl SegmentWriter for StoreWriter {
    fn writer(&self) -> u64 {
        self.writer
    }

    async fn append(&mut self, segments: Vec<Segment>) -> Result<(), LinkError> {
        let (store, shutdown) = (Arc::clone(&self.store), self.shutdown.clone());
        let append = move || {
            // At the end the limiter is not asked: what was simulated is kept. What it let in already is not
            // stored again.
            if shutdown.is_triggered() || !store.append_when_due(segments.clone(), &shutdown)? {
                store.append(segments)?;
            }
            Ok::<(), StoreError>(())
        };
        let appended = tokio::task::spawn_blocking(append).await;
        appended
            .map_err(|error| LinkError::Refused(error.to_string()))?
            .map_err(|error| LinkError::Refused(error.to_string()))
    }
}

/// The hub of a learner in this process.
pub(crate) struct HubLink {
    pub(crate) hub: Arc<Hub>,
    pub(crate) spec: RunSpec,
    /// The actor's name.
    pub(crate) name: String,
}

fn refused(error: impl ToString) -> LinkError {
    LinkError::Refused(error.to_string())
}

impl LearnerLink for HubLink {
    async fn subscribe(&self, slot: PolicySlot) -> Result<(), LinkError> {
        let mut policies = self.hub.subscribe(&self.spec).map_err(refused)?;
        loop {
            let policy = Arc::clone(&policies.borrow_and_update());
            if !policy.networks.is_empty() {
                let update = PolicyUpdate::parse(v1::PolicyUpdate::clone(&policy)).map_err(refused)?;
                slot.send_replace(Some(Arc::new(update)));
            }
            if policies.changed().await.is_err() {
                return Ok(());
            }
        }
    }

    async fn heartbeat(&self, beat: Heartbeat) -> Result<Option<Lease>, LinkError> {
        let reply = self.hub.heartbeat(beat.into(), Instant::now()).map_err(refused)?;
        reply.lease.map(Lease::parse).transpose().map_err(refused)
    }

    async fn report(&self, lease: u64, episodes: Vec<EpisodeResult>) -> Result<Reported, LinkError> {
        let episodes = episodes.into_iter().map(v1::EpisodeResult::from).collect();
        let report = v1::EvaluationReport { lease, actor: self.name.clone(), episodes };
        match self.hub.report(report) {
            Ok(()) => Ok(Reported::Accepted),
            Err(HubError::Lease(LeaseError::NotHeld(_))) => Ok(Reported::LeaseLost),
            Err(error) => Err(refused(error)),
        }
    }
}
