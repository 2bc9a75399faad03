//! The learner's gRPC service: the hub, on the wire.

use std::future::ready;
use std::pin::Pin;
use std::sync::Arc;

use futures::{Stream, StreamExt};
use getup_proto::v1::learner_server::{Learner, LearnerServer};
use getup_proto::{MAX_MESSAGE_BYTES, RunSpec, SpecError, v1};
use getup_telemetry::Shutdown;
use tokio::time::Instant;
use tokio_stream::wrappers::WatchStream;
use tonic::{Request, Response, Status};

use crate::hub::{Hub, HubError};
use crate::leases::LeaseError;

struct Service {
    hub: Arc<Hub>,
    shutdown: Shutdown,
}

/// The service, ready to be added to a tonic server. Its streams end at `shutdown`.
pub fn service(hub: Arc<Hub>, shutdown: Shutdown) -> LearnerServer<impl Learner> {
    LearnerServer::new(Service { hub, shutdown })
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES)
}

impl From<HubError> for Status {
    fn from(error: HubError) -> Self {
        match error {
            HubError::Spec(error) => error.into(),
            HubError::Lease(LeaseError::NotHeld(_)) => Status::failed_precondition(error.to_string()),
            HubError::Lease(LeaseError::Episodes { .. }) | HubError::Malformed(_) => {
                Status::invalid_argument(error.to_string())
            }
        }
    }
}

#[tonic::async_trait]
impl Learner for Service {
    type SubscribeStream = Pin<Box<dyn Stream<Item = Result<v1::PolicyUpdate, Status>> + Send>>;

    async fn subscribe(
        &self,
        request: Request<v1::SubscribeRequest>,
    ) -> Result<Response<Self::SubscribeStream>, Status> {
        let request = request.into_inner();
        let spec = request.spec.ok_or(SpecError::Missing).and_then(RunSpec::parse)?;
        let policies = WatchStream::new(self.hub.subscribe(&spec)?);
        tracing::info!(actor = request.actor, "actor subscribed");
        let updates = policies
            // The state before the first policy is not a policy.
            .filter(|policy| ready(!policy.networks.is_empty()))
            .map(|policy| Ok(v1::PolicyUpdate::clone(&policy)));
        let shutdown = self.shutdown.clone();
        let until_shutdown = updates.take_until(async move { shutdown.wait().await });
        Ok(Response::new(Box::pin(until_shutdown)))
    }

    async fn heartbeat(
        &self,
        request: Request<v1::HeartbeatRequest>,
    ) -> Result<Response<v1::HeartbeatReply>, Status> {
        let mut request = request.into_inner();
        if let Some(spec) = request.spec.take() {
            self.hub.check(&RunSpec::parse(spec)?)?;
        }
        Ok(Response::new(self.hub.heartbeat(request, now())?))
    }

    async fn report(
        &self,
        request: Request<v1::EvaluationReport>,
    ) -> Result<Response<v1::ReportReply>, Status> {
        self.hub.report(request.into_inner())?;
        Ok(Response::new(v1::ReportReply {}))
    }

    async fn status(&self, _: Request<v1::StatusRequest>) -> Result<Response<v1::StatusReply>, Status> {
        Ok(Response::new(self.hub.status(now())))
    }
}

/// By the clock of the runtime, which a simulation moves.
fn now() -> std::time::Instant {
    Instant::now().into_std()
}
