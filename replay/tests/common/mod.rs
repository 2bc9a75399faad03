//! Stores, services and writers for tests.

#![allow(dead_code, unreachable_pub, reason = "each test uses a part of it")]

use getup_proto::v1::replay_client::ReplayClient;
use getup_proto::{RunSpec, Segment, v1};
use getup_replay::{
    RemoteOptions, RemoteSource, ReplayConfig, ReplayMetrics, SampleOptions, ServeError, Store, StoreError,
    describe, serve,
};
use getup_telemetry::{Registry, Shutdown, Waits};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tempfile::TempDir;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Channel;
use tonic::{Status, Streaming};

pub const PATIENCE: Duration = Duration::from_secs(20);

pub fn config() -> ReplayConfig {
    ReplayConfig { capacity: 10_000, min_size: 1, ..ReplayConfig::default() }
}

pub fn options(batch: usize) -> SampleOptions {
    SampleOptions { batch, n_step: 1, gamma: 0.99, seed: 5, segments: false }
}

pub fn open(dir: &Path, spec: &RunSpec, config: &ReplayConfig) -> Result<Store, StoreError> {
    let registry = Registry::new();
    Store::open(dir, spec, config, ReplayMetrics::new(&registry), Waits::new(&registry))
}

/// Says what is not checked, past the test harness, which keeps to itself what a test that passes prints.
pub fn skip(what: impl std::fmt::Display) {
    use std::io::Write;
    let _ = writeln!(std::io::stderr(), "skipped: {what}");
}

/// Waits until `condition` holds.
pub fn eventually(what: &str, mut condition: impl FnMut() -> bool) {
    let started = Instant::now();
    while !condition() {
        assert!(started.elapsed() < PATIENCE, "{what}: not within {PATIENCE:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A store in a folder of its own, served on a port of its own.
pub struct Replay {
    pub spec: RunSpec,
    pub store: Arc<Store>,
    pub registry: Registry,
    pub waits: Waits,
    pub endpoint: String,
    pub shutdown: Shutdown,
    pub runtime: Runtime,
    serving: JoinHandle<Result<(), ServeError>>,
    /// Removed with it, where it is its own.
    _dir: Option<TempDir>,
}

impl Replay {
    pub fn start(spec: RunSpec, config: &ReplayConfig) -> Self {
        let dir = TempDir::new().unwrap();
        let replay = Self::start_in(dir.path(), spec, config);
        Self { _dir: Some(dir), ..replay }
    }

    pub fn start_in(dir: &Path, spec: RunSpec, config: &ReplayConfig) -> Self {
        let registry = Registry::new();
        let waits = Waits::new(&registry);
        let metrics = ReplayMetrics::new(&registry);
        let store = Arc::new(Store::open(dir, &spec, config, metrics, waits.clone()).unwrap());
        let runtime = Runtime::new().unwrap();
        let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
        let endpoint = listener.local_addr().unwrap().to_string();
        let shutdown = Shutdown::new();
        let serving = runtime.spawn(serve(listener, store.clone(), shutdown.clone()));
        Self { spec, store, registry, waits, endpoint, shutdown, runtime, serving, _dir: None }
    }

    /// Ends the service, and returns how it ended and how long that took.
    pub fn stop(self) -> (Result<(), ServeError>, Duration) {
        let started = Instant::now();
        self.shutdown.trigger();
        (self.runtime.block_on(self.serving).unwrap(), started.elapsed())
    }

    /// A source of the default table.
    pub fn source(&self, sample: SampleOptions, prefetch: usize) -> RemoteSource {
        let options = RemoteOptions {
            spec: self.spec.clone(),
            sample,
            name: "learner".to_owned(),
            table: String::new(),
            prefetch,
        };
        let (waits, shutdown) = (self.waits.clone(), self.shutdown.clone());
        RemoteSource::new(&self.endpoint, options, self.runtime.handle(), waits, shutdown)
    }

    /// What the default table's longest wait waits for; empty where nobody waits.
    pub fn waiting(&self) -> String {
        self.runtime.block_on(describe(&self.endpoint)).unwrap().limiter.unwrap().waiting
    }

    pub fn client(&self) -> ReplayClient<Channel> {
        self.runtime.block_on(ReplayClient::connect(format!("http://{}", self.endpoint))).unwrap()
    }

    pub fn writer(&self, writer: u64) -> Writer {
        self.runtime.block_on(Writer::connect(&self.endpoint, &self.spec, writer)).unwrap()
    }

    /// What a stream of these messages is answered with in the end.
    pub fn outcome(&self, messages: Vec<v1::append_request::Message>) -> Result<u64, Status> {
        let mut client = self.client();
        self.runtime.block_on(async {
            let requests = messages
                .into_iter()
                .map(|message| v1::AppendRequest { message: Some(message), ..Default::default() });
            let mut replies =
                client.append(tokio_stream::iter(requests.collect::<Vec<_>>())).await?.into_inner();
            let mut durable = 0;
            while let Some(reply) = replies.message().await? {
                durable = reply.durable_sequence;
            }
            Ok(durable)
        })
    }
}

pub fn hello(spec: &RunSpec, writer: u64) -> v1::append_request::Message {
    let name = format!("actor-{writer}");
    v1::append_request::Message::Hello(v1::AppendHello {
        spec: Some(spec.to_wire()),
        writer,
        name,
        table: String::new(),
    })
}

pub fn message(segment: &Segment) -> v1::append_request::Message {
    v1::append_request::Message::Segment(segment.to_wire())
}

/// A writer's stream.
pub struct Writer {
    pub requests: mpsc::Sender<v1::AppendRequest>,
    pub replies: Streaming<v1::AppendReply>,
    /// As the service said at the hello.
    pub durable: u64,
}

impl Writer {
    pub async fn connect(endpoint: &str, spec: &RunSpec, writer: u64) -> Result<Self, Status> {
        let client = ReplayClient::connect(format!("http://{endpoint}")).await;
        let mut client = client.map_err(|error| Status::unavailable(error.to_string()))?;
        let (requests, outbound) = mpsc::channel(32);
        let _ = requests
            .send(v1::AppendRequest { message: Some(hello(spec, writer)), ..Default::default() })
            .await;
        let mut replies = client.append(ReceiverStream::new(outbound)).await?.into_inner();
        let durable = next(&mut replies).await?;
        Ok(Self { requests, replies, durable })
    }

    /// Sends a segment; an error if the service has gone.
    pub async fn send(&self, segment: &Segment) -> Result<(), Status> {
        let sent = self
            .requests
            .send(v1::AppendRequest { message: Some(message(segment)), ..Default::default() })
            .await;
        sent.map_err(|_| Status::unavailable("the stream has ended"))
    }

    /// Waits for the acknowledgement of `sequence`.
    pub async fn acknowledged(&mut self, sequence: u64) -> Result<(), Status> {
        while next(&mut self.replies).await? < sequence {}
        Ok(())
    }
}

pub async fn next(replies: &mut Streaming<v1::AppendReply>) -> Result<u64, Status> {
    let reply = replies.message().await?.ok_or_else(|| Status::unavailable("the stream has ended"))?;
    Ok(reply.durable_sequence)
}
