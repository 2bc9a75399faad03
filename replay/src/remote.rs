//! Sampling a replay service: [`RemoteSource`], and [`describe`].

use crate::gate::Waiting;
use crate::minibatch::{Minibatch, OptionsError, SampleOptions};
use crate::source::{MinibatchSource, SampleError};
use getup_proto::v1::replay_client::ReplayClient;
use getup_proto::{MAX_MESSAGE_BYTES, RunSpec, v1};
use getup_telemetry::{Backoff, Shutdown, Waits};
use getup_transport::{AddressError, Channel, ChannelOptions, Endpoint, Window};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::runtime::Handle;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status};

/// How often a wait looks whether it was cancelled.
const CANCEL_TICK: Duration = Duration::from_millis(50);
/// How often a wait's reason is brought up to date.
pub(crate) const REASON_TICK: Duration = Duration::from_secs(1);
/// How long a connection or a short call may take.
const CALL_PATIENCE: Duration = Duration::from_secs(5);
/// A service that does not answer pings for this long is gone.
const PING_EVERY: Duration = Duration::from_secs(10);
/// Priorities of a message, at least: until there are so many, the service draws by older ones.
const PRIORITIES_AT_ONCE: usize = 1024;
/// Messages of priorities that wait for a connection; beyond, they are dropped.
const PRIORITY_MESSAGES: usize = 16;
/// Messages of credits that are enough for all that is fetched ahead.
const CREDITS_AHEAD: u32 = 4;
/// Bytes of a stream that may be on their way to a client that is not reading.
const STREAM_WINDOW_BYTES: u32 = 8 << 20;

/// Samples a replay service. A task of its own fetches minibatches ahead, and connects again when the service is
/// gone; the minibatches that are queued meanwhile are still given out.
#[derive(Debug)]
pub struct RemoteSource {
    queue: Receiver<Result<Minibatch, SampleError>>,
    /// Tells the task that a minibatch was taken from the queue.
    taken: mpsc::UnboundedSender<()>,
    /// Priorities for the task to send.
    priorities: mpsc::Sender<Vec<(u64, f32)>>,
    /// Some that are not worth a message yet.
    gathered: Vec<(u64, f32)>,
    /// Why there is none.
    reason: Reason,
    waits: Waits,
    /// Since the last minibatch.
    wait: Waiting,
    shutdown: Shutdown,
}

/// What a [`RemoteSource`] asks for, and where.
#[derive(Clone, Debug)]
pub struct RemoteOptions {
    /// Where the service is.
    pub endpoint: Endpoint,
    /// The table that is sampled; empty for the default.
    pub table: String,
    /// The table's spec: a service with another refuses.
    pub spec: RunSpec,
    /// What minibatches are made of.
    pub sample: SampleOptions,
    /// Who samples, for logs and `status`.
    pub name: String,
    /// Minibatches that are fetched ahead, from 1.
    pub prefetch: usize,
}

/// A reason that the task writes and the one who waits reads.
type Reason = Arc<Mutex<String>>;

/// Rings when something has come, for one who waits for several.
#[derive(Clone, Debug, Default)]
pub(crate) struct Bell(Arc<(Mutex<bool>, Condvar)>);

impl Bell {
    fn ring(&self) {
        *self.0.0.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.0.1.notify_one();
    }

    /// Returns when it has rung since the last wait, or `patience` is over; whether it has.
    pub(crate) fn wait(&self, patience: Duration) -> bool {
        let rung = self.0.0.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.0.1.wait_timeout_while(rung, patience, |rung| !*rung);
        std::mem::take(&mut *waited.unwrap_or_else(PoisonError::into_inner).0)
    }
}

impl RemoteSource {
    /// Starts the task on `runtime`; it ends with the source.
    pub fn new(options: RemoteOptions, runtime: &Handle, waits: Waits, shutdown: Shutdown) -> Self {
        Self::with_bell(options, runtime, waits, shutdown, None)
    }

    /// As [`RemoteSource::new`]; the bell rings when something has come into the queue.
    pub(crate) fn with_bell(
        options: RemoteOptions,
        runtime: &Handle,
        waits: Waits,
        shutdown: Shutdown,
        bell: Option<Bell>,
    ) -> Self {
        let prefetch = options.prefetch.max(1);
        // One place more, for the error that ends it.
        let (sender, queue) = sync_channel(prefetch + 1);
        let (taken, consumed) = mpsc::unbounded_channel();
        let (priorities, updates) = mpsc::channel(PRIORITY_MESSAGES);
        let reason = Reason::default();
        let fetching = Fetching {
            options,
            prefetch,
            queue: sender,
            consumed,
            updates,
            queued: 0,
            reason: reason.clone(),
            explained: false,
            bell,
            streams: 0,
        };
        runtime.spawn(fetching.run());
        Self { queue, taken, priorities, gathered: Vec::new(), reason, waits, wait: None, shutdown }
    }

    /// Why there is no minibatch.
    pub(crate) fn reason(&self) -> String {
        lock(&self.reason).clone()
    }
}

impl MinibatchSource for RemoteSource {
    fn poll(&mut self, patience: Duration) -> Result<Option<Minibatch>, SampleError> {
        let started = Instant::now();
        loop {
            if self.shutdown.is_triggered() {
                return Err(SampleError::Shutdown);
            }
            let left = patience.saturating_sub(started.elapsed());
            match self.queue.recv_timeout(left.min(CANCEL_TICK)) {
                Ok(minibatch) => {
                    // The task may just have ended with an error, which is then next in the queue.
                    let _ = self.taken.send(());
                    self.wait = None;
                    return minibatch.map(Some);
                }
                // At a shutdown the task may end between the question above and here.
                Err(RecvTimeoutError::Disconnected) if self.shutdown.is_triggered() => {
                    return Err(SampleError::Shutdown);
                }
                Err(RecvTimeoutError::Disconnected) => return Err(SampleError::Ended),
                Err(RecvTimeoutError::Timeout) if left.is_zero() => return Ok(None),
                Err(RecvTimeoutError::Timeout) => {}
            }
            match &mut self.wait {
                None => self.wait = Some((self.waits.begin("learner", self.reason()), Instant::now())),
                Some((guard, explained)) if explained.elapsed() >= REASON_TICK => {
                    guard.set_reason(lock(&self.reason).clone());
                    *explained = Instant::now();
                }
                Some(_) => {}
            }
        }
    }

    fn update_priorities(&mut self, priorities: Vec<(u64, f32)>) -> Result<(), SampleError> {
        if let Some(&(key, priority)) =
            priorities.iter().find(|(_, priority)| !(priority.is_finite() && *priority >= 0.0))
        {
            return Err(OptionsError::Priority { key, priority }.into());
        }
        self.gathered.extend(priorities);
        if self.gathered.len() >= PRIORITIES_AT_ONCE {
            // Without a connection they wait, and then they are too old to matter.
            let _ = self.priorities.try_send(std::mem::take(&mut self.gathered));
        }
        Ok(())
    }
}

/// What the service says of its default table.
///
/// # Errors
/// UNAVAILABLE if the service is not there, DEADLINE_EXCEEDED if it does not answer.
pub async fn describe(endpoint: impl Into<Endpoint>) -> Result<v1::DescribeReply, Status> {
    describe_table(endpoint, "").await
}

/// What the service says of one of its tables.
///
/// # Errors
/// As [`describe`]; NOT_FOUND if it has no such table.
pub async fn describe_table(endpoint: impl Into<Endpoint>, table: &str) -> Result<v1::DescribeReply, Status> {
    ask(client(&endpoint.into())?, table).await
}

/// Gives transitions of a service's table (empty for the default) priorities, by their keys; returns how many were still there.
///
/// # Errors
/// As [`describe`]; INVALID_ARGUMENT if one is negative or not finite, and then none is given.
pub async fn update_priorities(
    endpoint: impl Into<Endpoint>,
    table: &str,
    priorities: &[(u64, f32)],
) -> Result<u64, Status> {
    let (keys, priorities) = priorities.iter().copied().unzip();
    let reply = client(&endpoint.into())?
        .update_priorities(v1::UpdatePrioritiesRequest { keys, priorities, table: table.to_owned() })
        .await?;
    Ok(reply.into_inner().updated)
}

/// Has the service copy the store of a table (empty for the default) to `snapshots/NAME` in its folder.
///
/// # Errors
/// As [`describe`]; INVALID_ARGUMENT if the name is none, FAILED_PRECONDITION if the copy cannot be made.
pub async fn take_snapshot(
    endpoint: impl Into<Endpoint>,
    table: &str,
    name: &str,
) -> Result<v1::SnapshotReply, Status> {
    let request = v1::SnapshotRequest { name: name.to_owned(), table: table.to_owned() };
    client(&endpoint.into())?.snapshot(request).await.map(tonic::Response::into_inner)
}

async fn ask(mut client: ReplayClient<Channel>, table: &str) -> Result<v1::DescribeReply, Status> {
    let request = v1::DescribeRequest { table: table.to_owned() };
    let answer = tokio::time::timeout(CALL_PATIENCE, client.describe(request)).await;
    answer.map_err(|_| Status::deadline_exceeded("replay does not answer"))?.map(tonic::Response::into_inner)
}

/// A client whose calls say when the service is not there.
fn client(endpoint: &Endpoint) -> Result<ReplayClient<Channel>, Status> {
    let channel = channel(endpoint).map_err(|error| Status::invalid_argument(error.to_string()))?;
    Ok(ReplayClient::new(channel).max_encoding_message_size(MAX_MESSAGE_BYTES))
}

fn channel(endpoint: &Endpoint) -> Result<Channel, AddressError> {
    endpoint.channel(ChannelOptions {
        connect_timeout: CALL_PATIENCE,
        keep_alive_interval: PING_EVERY,
        keep_alive_timeout: PING_EVERY,
        keep_alive_while_idle: false,
        window: Window::Fixed { stream: STREAM_WINDOW_BYTES, connection: STREAM_WINDOW_BYTES },
        ..ChannelOptions::default()
    })
}

/// The task of a [`RemoteSource`].
struct Fetching {
    options: RemoteOptions,
    prefetch: usize,
    queue: SyncSender<Result<Minibatch, SampleError>>,
    consumed: mpsc::UnboundedReceiver<()>,
    updates: mpsc::Receiver<Vec<(u64, f32)>>,
    /// Minibatches in the queue.
    queued: usize,
    reason: Reason,
    /// Whether the reason is one in particular.
    explained: bool,
    bell: Option<Bell>,
    /// Streams opened so far.
    streams: u64,
}

/// Why a stream ended.
enum End {
    /// The source was dropped.
    Dropped,
    /// The service is not there, or went: worth another attempt.
    Gone(String),
    /// The service would refuse again.
    Refused(String),
}

impl Fetching {
    async fn run(mut self) {
        let mut backoff = Backoff::new();
        loop {
            self.explain(format!("a connection to replay at {}", self.options.endpoint.address));
            match self.stream(&mut backoff).await {
                End::Dropped => return,
                End::Gone(why) => {
                    self.explain(format!("replay at {} is gone ({why})", self.options.endpoint.address));
                    tracing::debug!("replay at {} is gone: {why}", self.options.endpoint.address);
                    tokio::time::sleep(backoff.next()).await;
                }
                End::Refused(reason) => {
                    let endpoint = self.options.endpoint.address.clone();
                    // There is a place for it; a source that was dropped needs it no more.
                    let _ = self.queue.try_send(Err(SampleError::Refused { endpoint, reason }));
                    self.ring();
                    return;
                }
            }
            if self.queue_is_abandoned() {
                return;
            }
        }
    }

    /// One connection, from hello to its end.
    async fn stream(&mut self, backoff: &mut Backoff) -> End {
        let channel = match channel(&self.options.endpoint) {
            Ok(channel) => channel,
            Err(error) => return End::Refused(error.to_string()),
        };
        let mut client = ReplayClient::new(channel.clone())
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        let (requests, outbound) = mpsc::channel(self.prefetch + 2);
        let credits = (self.prefetch - self.queued) as u32;
        for message in [v1::sample_request::Message::Hello(self.hello()), credits_message(credits)] {
            // The channel has room, and its receiver is here.
            let _ = requests.try_send(v1::SampleRequest { message: Some(message) });
        }
        let mut inbound = match client.sample(ReceiverStream::new(outbound)).await {
            Ok(response) => response.into_inner(),
            Err(status) => return End::from(status),
        };
        // Taken since credits were last given.
        let mut free = 0;
        let mut asked_why = tokio::time::interval(REASON_TICK);
        loop {
            tokio::select! {
                message = inbound.message() => match message {
                    Ok(Some(reply)) => {
                        backoff.reset();
                        asked_why.reset();
                        // What was waited for has come.
                        if std::mem::take(&mut self.explained) {
                            self.explain(self.awaited());
                            self.explained = false;
                        }
                        if let Err(end) = self.enqueue(reply) {
                            return end;
                        }
                    }
                    Ok(None) => return End::Gone("it ended the stream".to_owned()),
                    Err(status) => return End::from(status),
                },
                taken = self.consumed.recv() => {
                    if taken.is_none() {
                        return End::Dropped;
                    }
                    self.queued -= 1;
                    free += 1;
                    // A message of credits for some minibatches, and not for each.
                    if free >= (self.prefetch as u32).div_ceil(CREDITS_AHEAD) {
                        let message = Some(credits_message(std::mem::take(&mut free)));
                        if requests.send(v1::SampleRequest { message }).await.is_err() {
                            return End::Gone("it ended the stream".to_owned());
                        }
                    }
                },
                Some(priorities) = self.updates.recv() => {
                    let (keys, priorities) = priorities.into_iter().unzip();
                    let table = self.options.table.clone();
                    let request = v1::UpdatePrioritiesRequest { keys, priorities, table };
                    let mut client = client.clone();
                    // Beside the stream, which must not wait for it. One that fails is found anew at the next draw.
                    tokio::spawn(async move {
                        let sent = tokio::time::timeout(CALL_PATIENCE, client.update_priorities(request)).await;
                        match sent {
                            Ok(Ok(_)) => {}
                            Ok(Err(status)) => tracing::debug!("priorities were lost: {}", status.message()),
                            Err(_) => tracing::debug!("priorities were lost: replay does not answer"),
                        }
                    });
                },
                _ = asked_why.tick(), if self.queued == 0 => {
                    if let Ok(described) = ask(ReplayClient::new(channel.clone()), &self.options.table).await {
                        let waiting = described.limiter.map(|limiter| limiter.waiting).unwrap_or_default();
                        self.explain(if waiting.is_empty() { self.awaited() } else { waiting });
                    }
                },
            }
        }
    }

    fn hello(&mut self) -> v1::SampleHello {
        let SampleOptions { batch, n_step, gamma, seed, segments } = self.options.sample;
        self.streams += 1;
        v1::SampleHello {
            spec: Some(self.options.spec.to_wire()),
            batch: batch as u32,
            n_step: n_step as u32,
            gamma,
            // A stream that replaces another must not draw the same again.
            seed: seed.wrapping_add((self.streams - 1).wrapping_mul(0x9e37_79b9_7f4a_7c15)),
            name: self.options.name.clone(),
            table: self.options.table.clone(),
            segments,
        }
    }

    fn enqueue(&mut self, reply: v1::SampleReply) -> Result<(), End> {
        for minibatch in reply.minibatches {
            let Some(minibatch) = Minibatch::parse(minibatch, self.options.sample.batch) else {
                return Err(End::Refused(
                    "it sends malformed minibatches: are both of one version?".to_owned(),
                ));
            };
            if self.queued == self.prefetch {
                return Err(End::Refused("it sends more than it was asked for".to_owned()));
            }
            if self.queue.try_send(Ok(minibatch)).is_err() {
                return Err(End::Dropped);
            }
            self.queued += 1;
        }
        self.ring();
        Ok(())
    }

    fn ring(&self) {
        if let Some(bell) = &self.bell {
            bell.ring();
        }
    }

    /// Counts what was taken while there was no stream; true if nobody will take any more.
    fn queue_is_abandoned(&mut self) -> bool {
        loop {
            match self.consumed.try_recv() {
                Ok(()) => self.queued -= 1,
                Err(mpsc::error::TryRecvError::Empty) => return false,
                Err(mpsc::error::TryRecvError::Disconnected) => return true,
            }
        }
    }

    fn explain(&mut self, reason: String) {
        *lock(&self.reason) = reason;
        self.explained = true;
    }

    /// The reason where there is none in particular.
    fn awaited(&self) -> String {
        format!("minibatches from replay at {}", self.options.endpoint.address)
    }
}

impl From<Status> for End {
    fn from(status: Status) -> Self {
        let reason = status.message().to_owned();
        match status.code() {
            Code::InvalidArgument
            | Code::FailedPrecondition
            | Code::NotFound
            | Code::Unimplemented
            | Code::Unauthenticated
            | Code::PermissionDenied
            | Code::OutOfRange => Self::Refused(reason),
            _ => Self::Gone(reason),
        }
    }
}

fn credits_message(credits: u32) -> v1::sample_request::Message {
    v1::sample_request::Message::Credits(credits)
}

fn lock(reason: &Reason) -> std::sync::MutexGuard<'_, String> {
    reason.lock().unwrap_or_else(PoisonError::into_inner)
}
