//! A learner's service that broadcasts what a test gives it.

use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex};

use getup_actor::PolicyUpdate;
use getup_proto::v1::learner_server::{Learner, LearnerServer};
use getup_proto::v1::{
    self, EvaluationLease, EvaluationReport, HeartbeatReply, HeartbeatRequest, ReportReply, StatusReply,
    StatusRequest, SubscribeRequest,
};
use getup_proto::{MAX_MESSAGE_BYTES, RunSpec};
use tokio::sync::watch;
use tokio_stream::wrappers::WatchStream;
use tokio_stream::{Stream, StreamExt};
use tonic::{Request, Response, Status};

use super::{Server, spec};

#[derive(Clone)]
pub(crate) struct Broadcast {
    pub(crate) updates: Arc<watch::Sender<Option<v1::PolicyUpdate>>>,
    state: Arc<Mutex<State>>,
}

#[derive(Default)]
pub(crate) struct State {
    pub(crate) heartbeats: Vec<HeartbeatRequest>,
    /// Given to the next actor that is idle.
    pub(crate) lease: Option<EvaluationLease>,
    pub(crate) reports: Vec<EvaluationReport>,
    /// Whether reports come too late.
    pub(crate) lease_lost: bool,
}

impl Broadcast {
    pub(crate) fn new() -> Self {
        Self { updates: Arc::new(watch::channel(None).0), state: Arc::default() }
    }

    pub(crate) fn send(&self, update: &PolicyUpdate) {
        self.updates.send_replace(Some(update.to_wire()));
    }

    pub(crate) fn with<T>(&self, f: impl FnOnce(&mut State) -> T) -> T {
        f(&mut self.state.lock().unwrap())
    }

    pub(crate) fn serve(&self, address: SocketAddr) -> Server {
        let service = LearnerServer::new(self.clone()).max_encoding_message_size(MAX_MESSAGE_BYTES);
        Server::start(address, tonic::transport::Server::builder().add_service(service))
    }
}

#[tonic::async_trait]
impl Learner for Broadcast {
    type SubscribeStream = Pin<Box<dyn Stream<Item = Result<v1::PolicyUpdate, Status>> + Send>>;

    async fn subscribe(
        &self,
        request: Request<SubscribeRequest>,
    ) -> Result<Response<Self::SubscribeStream>, Status> {
        let theirs = RunSpec::parse(request.into_inner().spec.unwrap_or_default())
            .map_err(|error| Status::invalid_argument(error.to_string()))?;
        spec().check_same(&theirs).map_err(|error| Status::failed_precondition(error.to_string()))?;
        let updates = WatchStream::new(self.updates.subscribe()).filter_map(|update| update.map(Ok));
        Ok(Response::new(Box::pin(updates)))
    }

    async fn heartbeat(
        &self,
        request: Request<HeartbeatRequest>,
    ) -> Result<Response<HeartbeatReply>, Status> {
        let beat = request.into_inner();
        let lease = self.with(|state| {
            let lease = if beat.idle { state.lease.take() } else { None };
            state.heartbeats.push(beat);
            lease
        });
        Ok(Response::new(HeartbeatReply { lease }))
    }

    async fn report(&self, request: Request<EvaluationReport>) -> Result<Response<ReportReply>, Status> {
        self.with(|state| {
            if state.lease_lost {
                return Err(Status::failed_precondition("the lease is another's"));
            }
            state.reports.push(request.into_inner());
            Ok(Response::new(ReportReply {}))
        })
    }

    async fn status(&self, _: Request<StatusRequest>) -> Result<Response<StatusReply>, Status> {
        Err(Status::unimplemented("this learner only broadcasts"))
    }
}
