//! Hears policies from a learner over gRPC, and says heartbeats and reports.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use getup_proto::v1::learner_client::LearnerClient;
use getup_proto::v1::{self, SubscribeRequest};
use getup_proto::{MAX_MESSAGE_BYTES, RunSpec};
use getup_telemetry::{Backoff, Waiting, Waits};
use getup_transport::{AddressError, Channel, ChannelOptions, Endpoint};
use tonic::{Code, Status};

use super::{PATIENCE, link_error};
use crate::link::{
    EpisodeResult, Heartbeat, LearnerLink, Lease, LinkError, PolicySlot, PolicyUpdate, Reported,
};

/// A [`LearnerLink`] that subscribes again, with back-off, whenever the learner went away.
pub struct GrpcLearner {
    client: LearnerClient<Channel>,
    peer: String,
    spec: RunSpec,
    name: String,
    waits: Waits,
    /// Whether the learner has let it in before.
    admitted: AtomicBool,
}

impl GrpcLearner {
    /// A link of the actor `name` to the learner at `endpoint`. It connects when it is
    /// first used.
    ///
    /// # Errors
    /// [`AddressError`] when the address is none.
    pub fn new(
        endpoint: impl Into<Endpoint>,
        spec: RunSpec,
        name: &str,
        waits: Waits,
    ) -> Result<Self, AddressError> {
        let endpoint = endpoint.into();
        let client = LearnerClient::new(endpoint.channel(ChannelOptions::default())?)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        let peer = format!("learner at {}", endpoint.address);
        Ok(Self { client, peer, spec, name: name.to_owned(), waits, admitted: AtomicBool::new(false) })
    }

    /// One subscription, until it ends; every update ends the wait and the back-off.
    async fn hear(
        &self,
        slot: &PolicySlot,
        backoff: &mut Backoff,
        waiting: &mut Waiting,
    ) -> Result<(), LinkError> {
        let error = |status: Status| self.error(&status);
        let request = SubscribeRequest { spec: Some(self.spec.to_wire()), actor: self.name.clone() };
        let mut updates = self.client.clone().subscribe(request).await.map_err(error)?.into_inner();
        self.admitted.store(true, Ordering::Relaxed);
        tracing::info!("subscribed to the {}", self.peer);
        while let Some(wire) = updates.message().await.map_err(error)? {
            let update = PolicyUpdate::parse(wire)
                .map_err(|error| LinkError::Refused(format!("{}: {error}", self.peer)))?;
            slot.send_replace(Some(Arc::new(update)));
            backoff.reset();
            waiting.over();
        }
        Err(LinkError::Unavailable(format!("{}: it ended the stream", self.peer)))
    }

    fn error(&self, status: &Status) -> LinkError {
        link_error(&self.peer, status, self.admitted.load(Ordering::Relaxed))
    }

    async fn answer<T>(
        &self,
        call: impl Future<Output = Result<tonic::Response<T>, Status>>,
    ) -> Result<T, Status> {
        let answer = tokio::time::timeout(PATIENCE, call).await;
        let late = |_| Status::deadline_exceeded(format!("no answer within {PATIENCE:?}"));
        Ok(answer.map_err(late)??.into_inner())
    }
}

impl LearnerLink for GrpcLearner {
    async fn subscribe(&self, slot: PolicySlot) -> Result<(), LinkError> {
        let mut backoff = Backoff::new();
        let mut waiting = self.waits.waiting("actor_link");
        loop {
            let error = match self.hear(&slot, &mut backoff, &mut waiting).await {
                Err(LinkError::Unavailable(reason)) => reason,
                ended => return ended,
            };
            tracing::debug!("no policies from the {error}");
            waiting.because(error);
            tokio::time::sleep(backoff.next()).await;
        }
    }

    async fn heartbeat(&self, beat: Heartbeat) -> Result<Option<Lease>, LinkError> {
        let mut client = self.client.clone();
        let spec = Some(self.spec.to_wire());
        let call = client.heartbeat(v1::HeartbeatRequest { spec, ..v1::HeartbeatRequest::from(beat) });
        let reply = self.answer(call).await.map_err(|status| self.error(&status))?;
        let lease = reply.lease.map(Lease::parse).transpose();
        lease.map_err(|error| LinkError::Refused(format!("{}: {error}", self.peer)))
    }

    async fn report(&self, lease: u64, episodes: Vec<EpisodeResult>) -> Result<Reported, LinkError> {
        let episodes = episodes.into_iter().map(v1::EpisodeResult::from).collect();
        let report = v1::EvaluationReport { lease, actor: self.name.clone(), episodes };
        let mut client = self.client.clone();
        match self.answer(client.report(report)).await {
            Ok(_) => Ok(Reported::Accepted),
            Err(status) if status.code() == Code::FailedPrecondition => Ok(Reported::LeaseLost),
            Err(status) => Err(self.error(&status)),
        }
    }
}
