//! A replay's append service over a list in memory, which can be told to fail as a replay may.

use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex};

use getup_proto::v1::append_request::Message;
use getup_proto::v1::replay_server::{Replay, ReplayServer};
use getup_proto::v1::{
    AppendReply, AppendRequest, DescribeReply, DescribeRequest, SampleReply, SampleRequest, SnapshotReply,
    SnapshotRequest, UpdatePrioritiesReply, UpdatePrioritiesRequest,
};
use getup_proto::{MAX_MESSAGE_BYTES, RunSpec, Segment};
use tokio_stream::{Stream, StreamExt};
use tonic::{Request, Response, Status, Streaming};

use super::{Server, spec};

/// What the service stores and how it behaves; outlives the servers that serve it.
#[derive(Clone, Default)]
pub(crate) struct Store(Arc<Mutex<State>>);

#[derive(Default)]
pub(crate) struct State {
    /// Stored in this order; each of them is durable.
    pub(crate) segments: Vec<Segment>,
    /// How often a segment came that was stored already.
    pub(crate) repeated: usize,
    pub(crate) streams: usize,
    /// Stores segments without saying so.
    pub(crate) silent: bool,
    /// Ends a stream, without an acknowledgement, after it stored this many segments.
    pub(crate) cut_after: Option<usize>,
}

impl Store {
    pub(crate) fn with<T>(&self, f: impl FnOnce(&mut State) -> T) -> T {
        f(&mut self.0.lock().unwrap())
    }

    pub(crate) fn len(&self) -> usize {
        self.with(|state| state.segments.len())
    }

    pub(crate) fn serve(&self, address: SocketAddr) -> Server {
        let service = ReplayServer::new(self.clone()).max_decoding_message_size(MAX_MESSAGE_BYTES);
        Server::start(address, tonic::transport::Server::builder().add_service(service))
    }

    fn durable(&self) -> AppendReply {
        let durable_sequence = self.with(|s| s.segments.last().map_or(0, |segment| segment.sequence));
        AppendReply { durable_sequence }
    }

    /// Stores a segment; none is returned where nothing is to be said about it.
    fn store(&self, segment: Segment, stored: &mut usize) -> Option<Result<AppendReply, Status>> {
        self.with(|state| {
            let durable = state.segments.last().map_or(0, |segment| segment.sequence);
            if segment.sequence <= durable {
                state.repeated += 1;
                return None;
            }
            assert_eq!(segment.sequence, durable + 1, "segments come without a gap");
            state.segments.push(segment);
            *stored += 1;
            if state.cut_after.is_some_and(|limit| *stored >= limit) {
                return Some(Err(Status::unavailable("the stream is cut")));
            }
            let durable_sequence = durable + 1;
            (!state.silent).then_some(Ok(AppendReply { durable_sequence }))
        })
    }
}

type Replies<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

#[tonic::async_trait]
impl Replay for Store {
    type AppendStream = Replies<AppendReply>;
    type SampleStream = Replies<SampleReply>;

    async fn append(
        &self,
        request: Request<Streaming<AppendRequest>>,
    ) -> Result<Response<Self::AppendStream>, Status> {
        let mut requests = request.into_inner();
        let Some(AppendRequest { message: Some(Message::Hello(hello)), .. }) = requests.message().await?
        else {
            return Err(Status::invalid_argument("the first message is no hello"));
        };
        let theirs = RunSpec::parse(hello.spec.unwrap_or_default())
            .map_err(|error| Status::invalid_argument(error.to_string()))?;
        spec().check_same(&theirs).map_err(|error| Status::failed_precondition(error.to_string()))?;
        self.with(|state| state.streams += 1);
        let store = self.clone();
        let mut stored = 0;
        let replies = requests.filter_map(move |request| match request {
            Ok(AppendRequest { message: Some(Message::Segment(wire)), .. }) => {
                match Segment::parse(wire, &spec()) {
                    Ok(segment) => store.store(segment, &mut stored),
                    Err(error) => Some(Err(Status::invalid_argument(error.to_string()))),
                }
            }
            Ok(_) => Some(Err(Status::invalid_argument("no segment"))),
            Err(status) => Some(Err(status)),
        });
        let first = tokio_stream::once(Ok(self.durable()));
        Ok(Response::new(Box::pin(first.chain(replies))))
    }

    async fn sample(
        &self,
        _: Request<Streaming<SampleRequest>>,
    ) -> Result<Response<Self::SampleStream>, Status> {
        Err(Status::unimplemented("this replay only stores"))
    }

    async fn describe(&self, _: Request<DescribeRequest>) -> Result<Response<DescribeReply>, Status> {
        Err(Status::unimplemented("this replay only stores"))
    }

    async fn update_priorities(
        &self,
        _: Request<UpdatePrioritiesRequest>,
    ) -> Result<Response<UpdatePrioritiesReply>, Status> {
        Err(Status::unimplemented("this replay only stores"))
    }

    async fn snapshot(&self, _: Request<SnapshotRequest>) -> Result<Response<SnapshotReply>, Status> {
        Err(Status::unimplemented("this replay only stores"))
    }
}
