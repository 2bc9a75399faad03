//! The task behind a [`RemoteSource`](super::RemoteSource): it fetches minibatches ahead, stream after stream.

use std::sync::mpsc::SyncSender;

use getup_proto::v1::replay_client::ReplayClient;
use getup_proto::{MAX_MESSAGE_BYTES, v1};
use getup_telemetry::Backoff;
use getup_transport::{Channel, Endpoint};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

use super::bell::Bell;
use super::calls::{ask, channel, in_time};
use super::{Reason, RemoteOptions, lock};
use crate::gate::REASON_TICK;
use crate::minibatch::{Minibatch, SampleOptions};
use crate::source::SampleError;

/// Messages of credits that are enough for all that is fetched ahead.
const CREDITS_AHEAD: u32 = 4;

/// The task of a [`RemoteSource`](super::RemoteSource).
pub(super) struct Fetching {
    endpoint: Endpoint,
    options: RemoteOptions,
    /// Minibatches ahead, from 1.
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
    /// Whether the replay has let it in before.
    admitted: bool,
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
    /// Fetches into `queue`; `told` of what was taken from it, and of priorities to send.
    pub(super) fn new(
        endpoint: Endpoint,
        options: RemoteOptions,
        queue: SyncSender<Result<Minibatch, SampleError>>,
        told: (mpsc::UnboundedReceiver<()>, mpsc::Receiver<Vec<(u64, f32)>>),
        reason: Reason,
        bell: Option<Bell>,
    ) -> Self {
        let prefetch = options.prefetch.max(1);
        let (consumed, updates) = told;
        Self {
            endpoint,
            options,
            prefetch,
            queue,
            consumed,
            updates,
            queued: 0,
            reason,
            explained: false,
            bell,
            streams: 0,
            admitted: false,
        }
    }

    pub(super) async fn run(mut self) {
        let mut backoff = Backoff::new();
        loop {
            self.explain(format!("a connection to replay at {}", self.endpoint.address));
            match self.stream(&mut backoff).await {
                End::Dropped => return,
                End::Gone(why) => {
                    self.explain(format!("replay at {} is gone ({why})", self.endpoint.address));
                    tracing::debug!("replay at {} is gone: {why}", self.endpoint.address);
                    tokio::time::sleep(backoff.next()).await;
                }
                End::Refused(reason) => {
                    let endpoint = self.endpoint.address.clone();
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
        let channel = match channel(&self.endpoint) {
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
            Err(status) => return self.end(&status),
        };
        self.admitted = true;
        // Taken since credits were last given.
        let mut free = 0;
        let mut asked_why = tokio::time::interval(REASON_TICK);
        loop {
            tokio::select! {
                message = inbound.message() => match message {
                    Ok(Some(reply)) => {
                        backoff.reset();
                        asked_why.reset();
                        if let Err(end) = self.received(reply) {
                            return end;
                        }
                    }
                    Ok(None) => return End::Gone("it ended the stream".to_owned()),
                    Err(status) => return self.end(&status),
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
                Some(priorities) = self.updates.recv() => self.send_priorities(client.clone(), priorities),
                _ = asked_why.tick(), if self.queued == 0 => {
                    self.ask_why(ReplayClient::new(channel.clone())).await;
                },
            }
        }
    }

    fn received(&mut self, reply: v1::SampleReply) -> Result<(), End> {
        // What was waited for has come.
        if std::mem::take(&mut self.explained) {
            self.explain(self.awaited());
            self.explained = false;
        }
        self.enqueue(reply)
    }

    /// Beside the stream, which must not wait for it. One that fails is found anew at the next draw.
    fn send_priorities(&self, mut client: ReplayClient<Channel>, priorities: Vec<(u64, f32)>) {
        let (keys, priorities) = priorities.into_iter().unzip();
        let table = self.options.table.clone();
        let request = v1::UpdatePrioritiesRequest { keys, priorities, table };
        tokio::spawn(async move {
            if let Err(status) = in_time(client.update_priorities(request)).await {
                tracing::debug!("priorities were lost: {}", status.message());
            }
        });
    }

    /// Asks what the service waits for.
    async fn ask_why(&mut self, client: ReplayClient<Channel>) {
        if let Ok(described) = ask(client, &self.options.table).await {
            let waiting = described.limiter.map(|limiter| limiter.waiting).unwrap_or_default();
            self.explain(if waiting.is_empty() { self.awaited() } else { waiting });
        }
    }

    fn end(&self, status: &Status) -> End {
        let reason = getup_transport::reason(status);
        if getup_transport::is_final(status, self.admitted) {
            End::Refused(reason)
        } else {
            End::Gone(reason)
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
        format!("minibatches from replay at {}", self.endpoint.address)
    }
}

fn credits_message(credits: u32) -> v1::sample_request::Message {
    v1::sample_request::Message::Credits(credits)
}
