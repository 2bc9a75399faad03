//! Appends segments to a replay over gRPC.

use getup_proto::v1::append_request::Message;
use getup_proto::v1::replay_client::ReplayClient;
use getup_proto::v1::{AppendHello, AppendReply, AppendRequest};
use getup_proto::{MAX_MESSAGE_BYTES, RunSpec, Segment};
use getup_telemetry::{Backoff, Waits};
use getup_transport::{AddressError, Channel, ChannelOptions, Endpoint};
use tokio::sync::mpsc;
use tokio_stream::wrappers::UnboundedReceiverStream;
use tonic::{Status, Streaming};

use super::link_error;
use crate::identity::Identity;
use crate::link::{LinkError, SegmentWriter};

/// A [`SegmentWriter`] that reconnects with back-off and sends again what was not acknowledged.
pub struct GrpcReplay {
    client: ReplayClient<Channel>,
    peer: String,
    spec: RunSpec,
    identity: Identity,
    table: String,
    waits: Waits,
    backoff: Backoff,
    stream: Option<AppendStream>,
    /// Whether the replay has let it in before.
    admitted: bool,
}

/// An append stream that has said hello.
struct AppendStream {
    /// Unbounded: what is in it is bounded by what one call of `append` gives.
    requests: mpsc::UnboundedSender<AppendRequest>,
    replies: Streaming<AppendReply>,
    /// The last sequence number that the replay has called durable.
    durable: u64,
}

impl GrpcReplay {
    /// A writer to the replay at `endpoint`. It connects when it first appends.
    ///
    /// # Errors
    /// [`AddressError`] when the address is none.
    pub fn new(
        endpoint: impl Into<Endpoint>,
        spec: RunSpec,
        identity: Identity,
        waits: Waits,
    ) -> Result<Self, AddressError> {
        let endpoint = endpoint.into();
        let client = ReplayClient::new(endpoint.channel(ChannelOptions::default())?)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        let peer = format!("replay at {}", endpoint.address);
        // Where a run's transitions go.
        let table = String::new();
        Ok(Self {
            client,
            peer,
            spec,
            identity,
            table,
            waits,
            backoff: Backoff::new(),
            stream: None,
            admitted: false,
        })
    }

    /// Appends to this table instead of the default one.
    pub fn in_table(self, table: &str) -> Self {
        Self { table: table.to_owned(), ..self }
    }

    /// Sends what is not durable of `segments`, and returns when all of it is.
    async fn attempt(&mut self, segments: &[Segment]) -> Result<(), Status> {
        let mut stream = match self.stream.take() {
            Some(stream) => stream,
            None => self.connect().await?,
        };
        let last = segments.last().map_or(0, |segment| segment.sequence);
        for segment in segments.iter().filter(|segment| segment.sequence > stream.durable) {
            // A stream that has ended says why in its replies.
            let traceparent =
                segment.trace.as_ref().map_or_else(String::new, |trace| trace.context.to_string());
            let message = Some(Message::Segment(segment.to_wire()));
            let _ = stream.requests.send(AppendRequest { message, traceparent });
        }
        while stream.durable < last {
            stream.hear().await?;
        }
        self.stream = Some(stream);
        Ok(())
    }

    async fn connect(&mut self) -> Result<AppendStream, Status> {
        let (requests, receiver) = mpsc::unbounded_channel();
        let hello = AppendHello {
            spec: Some(self.spec.to_wire()),
            writer: self.identity.writer,
            name: self.identity.name.clone(),
            table: self.table.clone(),
        };
        let message = Some(Message::Hello(hello));
        let _ = requests.send(AppendRequest { message, ..AppendRequest::default() });
        let replies = self.client.append(UnboundedReceiverStream::new(receiver)).await?.into_inner();
        let mut stream = AppendStream { requests, replies, durable: 0 };
        stream.hear().await?;
        self.admitted = true;
        tracing::info!(durable_sequence = stream.durable, "connected to the {}", self.peer);
        Ok(stream)
    }
}

impl AppendStream {
    async fn hear(&mut self) -> Result<(), Status> {
        let reply = self.replies.message().await?;
        let reply = reply.ok_or_else(|| Status::unavailable("it ended the stream"))?;
        self.durable = reply.durable_sequence;
        Ok(())
    }
}

impl SegmentWriter for GrpcReplay {
    fn writer(&self) -> u64 {
        self.identity.writer
    }

    async fn append(&mut self, segments: Vec<Segment>) -> Result<(), LinkError> {
        let mut waiting = self.waits.waiting("actor_writer");
        loop {
            let error = match self.attempt(&segments).await {
                Ok(()) => {
                    self.backoff.reset();
                    return Ok(());
                }
                Err(status) => link_error(&self.peer, &status, self.admitted),
            };
            let LinkError::Unavailable(reason) = error else { return Err(error) };
            tracing::debug!("cannot append to the {reason}");
            waiting.because(reason);
            tokio::time::sleep(self.backoff.next()).await;
        }
    }
}
