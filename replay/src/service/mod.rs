//! The gRPC service around stores, its tables: [`serve`].
//!
//! - [`append`]: a writer's stream
//! - [`sample`]: a sampler's stream
//! - [`committer`]: the one task that appends to a table, for all streams together

mod append;
mod blocking;
mod committer;
mod sample;
mod visit;

use crate::config::DEFAULT_TABLE;
use crate::error::StoreError;
use crate::log::SNAPSHOTS;
use crate::metrics::ReplayMetrics;
use crate::store::Store;
use crate::tables::Tables;
use append::AppendStream;
use blocking::blocking;
use committer::Job;
use getup_proto::v1::replay_server::{Replay, ReplayServer};
use getup_proto::{MAX_MESSAGE_BYTES, RunSpec, SpecError, v1};
use getup_telemetry::{Registry, Shutdown, health};
use getup_transport::{Credentials, Limits, Listener, Metrics, Server, Window};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio_stream::wrappers::ReceiverStream;
use tonic::service::Routes;
use tonic::{Request, Response, Status, Streaming};

/// How long streams may take to end after the shutdown has begun.
const GRACE: Duration = Duration::from_secs(3);
/// How long a client may take to say hello.
const HELLO_PATIENCE: Duration = Duration::from_secs(10);
/// Bytes of a stream that may be on their way to a server that is not reading: some tens of segments.
const STREAM_WINDOW_BYTES: u32 = 1 << 20;
/// Priorities of a request: they are given under a lock that appends and samples wait for.
const MOST_PRIORITIES: usize = 1 << 17;
/// Replies that may wait for a client that is not reading.
const REPLIES: usize = 2;

/// Why the service ended other than by shutdown.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The store takes no more segments.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The network refuses.
    #[error("the replay service cannot go on: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// A task of the service panicked.
    #[error("the replay service broke: {0}")]
    Panicked(#[from] tokio::task::JoinError),
}

/// As [`serve_at`], at a port that is open to all.
///
/// # Errors
/// As [`serve_at`].
pub async fn serve(
    listener: impl Listener,
    tables: impl Into<Tables>,
    shutdown: Shutdown,
) -> Result<(), ServeError> {
    let port = Server::new(Credentials::default(), limits(), Metrics::new(&Registry::new()));
    serve_at(port, listener, tables, shutdown).await
}

/// What the service's port lets its peers take.
pub fn limits() -> Limits {
    let window = Window::Fixed { stream: STREAM_WINDOW_BYTES, connection: 4 * STREAM_WINDOW_BYTES };
    Limits { window, ..Limits::default() }
}

/// Serves the tables and the gRPC health service until `shutdown`: then takes no more segments, acknowledges those
/// that came, ends all streams with UNAVAILABLE, and returns. A store alone is the table `default`.
///
/// # Errors
/// [`ServeError`], when a store or the network fails.
pub async fn serve_at(
    port: Server,
    listener: impl Listener,
    tables: impl Into<Tables>,
    shutdown: Shutdown,
) -> Result<(), ServeError> {
    let mut committing = JoinSet::new();
    let mut begin = |(name, store): (String, Arc<Store>)| {
        let (jobs, queue) = mpsc::channel(committer::queue_length(store.spec()));
        committing.spawn(committer::run(store.clone(), queue, shutdown.clone()));
        (name, Table { store, jobs })
    };
    let tables: BTreeMap<String, Table> = tables.into().into_stores().into_iter().map(&mut begin).collect();
    let service = ReplayServer::new(Service { tables, shutdown: shutdown.clone() })
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES);
    let routes = Routes::new(health(shutdown.clone())).add_service(service);
    tokio::select! {
        served = port.serve(listener, routes, shutdown) => served?,
        // While its queue has a sender, a committer ends only when its store does, or finds the disk full at the end.
        Some(committed) = committing.join_next() => committed??,
    }
    // A committer ends once it has worked off its queue and all streams, which hold the other end, are gone.
    let ended = async {
        while let Some(committed) = committing.join_next().await {
            committed??;
        }
        Ok(())
    };
    tokio::time::timeout(GRACE, ended).await.unwrap_or_else(|_| {
        tracing::warn!("replay ends before its committer: a stream or the disk holds it up");
        Ok(())
    })
}

/// What all streams share.
struct Service {
    tables: BTreeMap<String, Table>,
    shutdown: Shutdown,
}

/// A store, and the way to the task that appends to it.
struct Table {
    store: Arc<Store>,
    jobs: mpsc::Sender<Job>,
}

impl Service {
    /// The table of this name; of none, the default.
    fn table(&self, name: &str) -> Result<&Table, Status> {
        let asked = if name.is_empty() { DEFAULT_TABLE } else { name };
        self.tables.get(asked).ok_or_else(|| {
            let there_are = self.tables.keys().map(String::as_str).collect::<Vec<_>>().join(", ");
            Status::not_found(format!("there is no table `{asked}` here, but {there_are}"))
        })
    }

    fn store(&self, name: &str) -> Result<Arc<Store>, Status> {
        Ok(self.table(name)?.store.clone())
    }

    /// Counts a stream that has not come as far as to name its table.
    fn refuse(&self, reason: &str) {
        if let Some(table) = self.tables.get(DEFAULT_TABLE) {
            table.store.metrics().reject(reason);
        }
    }
}

#[tonic::async_trait]
impl Replay for Service {
    type AppendStream = ReceiverStream<Result<v1::AppendReply, Status>>;
    type SampleStream = ReceiverStream<Result<v1::SampleReply, Status>>;

    async fn append(
        &self,
        request: Request<Streaming<v1::AppendRequest>>,
    ) -> Result<Response<Self::AppendStream>, Status> {
        let mut inbound = request.into_inner();
        let first = first_message(&mut inbound).await.and_then(|message| match message.message {
            Some(v1::append_request::Message::Hello(hello)) => Ok(hello),
            _ => Err(no_hello()),
        });
        let hello = first.inspect_err(|_| self.refuse("hello"))?;
        let Table { store, jobs } = self.table(&hello.table).inspect_err(|_| self.refuse("table"))?;
        check_spec(store.spec(), hello.spec, store.metrics())?;
        let name = named(hello.name, || format!("writer {}", hello.writer));
        let (replies, outbound) = mpsc::channel(REPLIES);
        let stream = AppendStream::new(jobs.clone(), hello.writer, name).await?;
        tokio::spawn(stream.run(inbound, replies, self.shutdown.clone()));
        Ok(Response::new(ReceiverStream::new(outbound)))
    }

    async fn sample(
        &self,
        request: Request<Streaming<v1::SampleRequest>>,
    ) -> Result<Response<Self::SampleStream>, Status> {
        let mut inbound = request.into_inner();
        let first = first_message(&mut inbound).await.and_then(|message| match message.message {
            Some(v1::sample_request::Message::Hello(hello)) => Ok(hello),
            _ => Err(no_hello()),
        });
        let mut hello = first.inspect_err(|_| self.refuse("hello"))?;
        let store = self.store(&hello.table).inspect_err(|_| self.refuse("table"))?;
        let metrics = store.metrics();
        check_spec(store.spec(), hello.spec.take(), metrics)?;
        let source = sample::source(&store, hello, self.shutdown.clone())
            .inspect_err(|_| metrics.reject("options"))?;
        let (replies, outbound) = mpsc::channel(REPLIES);
        sample::start(source, inbound, replies, self.shutdown.clone());
        Ok(Response::new(ReceiverStream::new(outbound)))
    }

    async fn describe(
        &self,
        request: Request<v1::DescribeRequest>,
    ) -> Result<Response<v1::DescribeReply>, Status> {
        let store = self.store(&request.into_inner().table)?;
        let described = blocking(|| store.describe()).await;
        let tables = self.tables.keys().cloned().collect();
        Ok(Response::new(v1::DescribeReply { tables, ..described }))
    }

    async fn update_priorities(
        &self,
        request: Request<v1::UpdatePrioritiesRequest>,
    ) -> Result<Response<v1::UpdatePrioritiesReply>, Status> {
        let v1::UpdatePrioritiesRequest { keys, priorities, table } = request.into_inner();
        if keys.len() > MOST_PRIORITIES {
            let keys = keys.len();
            return Err(Status::invalid_argument(format!(
                "{keys} priorities came at once: send {MOST_PRIORITIES} at most"
            )));
        }
        if keys.len() != priorities.len() {
            let (keys, priorities) = (keys.len(), priorities.len());
            return Err(Status::invalid_argument(format!(
                "{keys} keys came with {priorities} priorities: pair them"
            )));
        }
        let store = self.store(&table)?;
        let priorities: Vec<(u64, f32)> = keys.into_iter().zip(priorities).collect();
        match blocking(|| store.update_priorities(&priorities)).await {
            Ok(updated) => Ok(Response::new(v1::UpdatePrioritiesReply { updated })),
            Err(error) => Err(Status::invalid_argument(error.to_string())),
        }
    }

    async fn snapshot(
        &self,
        request: Request<v1::SnapshotRequest>,
    ) -> Result<Response<v1::SnapshotReply>, Status> {
        let v1::SnapshotRequest { name, table } = request.into_inner();
        let allowed = |character: char| character.is_ascii_alphanumeric() || "-_.".contains(character);
        if name.is_empty() || name.len() > 100 || name.starts_with('.') || !name.chars().all(allowed) {
            return Err(Status::invalid_argument(format!(
                "{name:?} is no snapshot's name: take up to 100 letters, digits, `-`, `_` and `.`, and no `.` first"
            )));
        }
        let store = self.store(&table)?;
        let taken = blocking(|| {
            let started = Instant::now();
            let path = store.dir().join(SNAPSHOTS).join(&name);
            let (paused, counters) = store.snapshot(&path)?;
            Ok::<_, StoreError>(v1::SnapshotReply {
                path: path.display().to_string(),
                paused_seconds: paused.as_secs_f64(),
                seconds: started.elapsed().as_secs_f64(),
                counters: Some(counters.into()),
            })
        });
        match taken.await {
            Ok(reply) => Ok(Response::new(reply)),
            Err(error) => Err(Status::failed_precondition(error.to_string())),
        }
    }
}

async fn first_message<T>(inbound: &mut Streaming<T>) -> Result<T, Status> {
    match tokio::time::timeout(HELLO_PATIENCE, inbound.message()).await {
        Ok(message) => message?.ok_or_else(no_hello),
        Err(_) => Err(Status::deadline_exceeded("no hello came in time: connect again")),
    }
}

fn no_hello() -> Status {
    Status::invalid_argument("the first message of a stream must be its hello: send it first")
}

fn check_spec(ours: &RunSpec, theirs: Option<v1::RunSpec>, metrics: &ReplayMetrics) -> Result<(), Status> {
    let theirs = theirs.ok_or(SpecError::Missing).and_then(RunSpec::parse);
    theirs.and_then(|theirs| ours.check_same(&theirs)).map_err(|error| {
        metrics.reject("spec");
        error.into()
    })
}

fn named(name: String, otherwise: impl FnOnce() -> String) -> String {
    if name.is_empty() { otherwise() } else { name }
}

fn failed() -> Status {
    Status::unavailable("the replay store has failed: see its log")
}

fn shutting_down() -> Status {
    Status::unavailable("replay is shutting down: connect again when it is back")
}
