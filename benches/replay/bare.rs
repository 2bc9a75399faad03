//! The limit of sampling: a tonic stream of messages as large, parsed no further.

use std::pin::Pin;

use anyhow::Result;
use getup_proto::v1::replay_server::{Replay, ReplayServer};
use getup_proto::{MAX_MESSAGE_BYTES, v1};
use tokio::runtime::Runtime;
use tokio_stream::Stream;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status, Streaming};

use crate::PREFETCH;
use crate::services::listen;

/// Sends the same message without end, as large as those of a sampling stream.
struct Bare(v1::SampleReply);

pub(crate) fn serve_bare(batch: usize) -> Result<()> {
    let column = |name: &str, width: usize| v1::MinibatchColumn {
        name: name.to_owned(),
        width: width as u32,
        data: vec![1u8; batch * width * 4].into(),
    };
    let columns = [
        ("observation", 68),
        ("action", 21),
        ("reward", 1),
        ("beta", 1),
        ("next_observation", 68),
        ("discount", 1),
    ];
    let columns: Vec<_> = columns.map(|(name, width)| column(name, width)).into();
    let counters = Some(v1::ReplayCounters::default());
    let minibatch = v1::Minibatch { columns, counters, ..v1::Minibatch::default() };
    // As many as a message of the service holds.
    let count = ((4 << 20) / (batch * 160 * 4)).clamp(1, PREFETCH / 4);
    let reply = v1::SampleReply { minibatches: vec![minibatch; count] };
    Runtime::new()?.block_on(async {
        let incoming = TcpListenerStream::new(listen().await?);
        let service = ReplayServer::new(Bare(reply)).max_encoding_message_size(MAX_MESSAGE_BYTES);
        tonic::transport::Server::builder().add_service(service).serve_with_incoming(incoming).await?;
        Ok(())
    })
}

#[tonic::async_trait]
impl Replay for Bare {
    type AppendStream = tokio_stream::Empty<Result<v1::AppendReply, Status>>;
    type SampleStream = Pin<Box<dyn Stream<Item = Result<v1::SampleReply, Status>> + Send>>;

    async fn append(
        &self,
        _: Request<Streaming<v1::AppendRequest>>,
    ) -> Result<Response<Self::AppendStream>, Status> {
        Err(Status::unimplemented("it only sends"))
    }

    async fn sample(
        &self,
        _: Request<Streaming<v1::SampleRequest>>,
    ) -> Result<Response<Self::SampleStream>, Status> {
        let reply = self.0.clone();
        Ok(Response::new(Box::pin(tokio_stream::iter(std::iter::repeat_with(move || Ok(reply.clone()))))))
    }

    async fn describe(&self, _: Request<v1::DescribeRequest>) -> Result<Response<v1::DescribeReply>, Status> {
        Err(Status::unimplemented("it only sends"))
    }

    async fn update_priorities(
        &self,
        _: Request<v1::UpdatePrioritiesRequest>,
    ) -> Result<Response<v1::UpdatePrioritiesReply>, Status> {
        Err(Status::unimplemented("it only sends"))
    }

    async fn snapshot(&self, _: Request<v1::SnapshotRequest>) -> Result<Response<v1::SnapshotReply>, Status> {
        Err(Status::unimplemented("it only sends"))
    }
}
