//! A sampler's stream: credits in, minibatches out.

use super::{named, shutting_down};
use crate::minibatch::SampleOptions;
use crate::source::{LocalSource, MinibatchSource, SampleError};
use crate::store::Store;
use getup_proto::{columns, v1};
use getup_telemetry::Shutdown;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tonic::{Status, Streaming};

type Replies = mpsc::Sender<Result<v1::SampleReply, Status>>;

/// Credits messages that may be queued.
const CREDITS: usize = 64;
/// Bytes of a message, at most (and never less than one minibatch).
const MESSAGE_BYTES: usize = 4 << 20;
/// Messages that a client's credits are spread over.
const MESSAGES_AHEAD: u64 = 4;

/// The source that serves a stream.
pub(super) fn source(
    store: &Arc<Store>,
    hello: v1::SampleHello,
    shutdown: Shutdown,
) -> Result<LocalSource, Status> {
    let options = SampleOptions {
        batch: hello.batch as usize,
        n_step: hello.n_step as usize,
        gamma: hello.gamma,
        seed: hello.seed,
        segments: hello.segments,
    };
    let name = named(hello.name, || "a sampler".to_owned());
    LocalSource::new(store.clone(), options, &name, shutdown).map_err(status)
}

/// Serves the stream: a task reads its credits, and a thread gathers its minibatches.
pub(super) fn start(
    source: LocalSource,
    mut inbound: Streaming<v1::SampleRequest>,
    replies: Replies,
    shutdown: Shutdown,
) {
    let (sender, credits) = mpsc::channel(CREDITS);
    let refusals = replies.clone();
    tokio::spawn(async move {
        let reading = async {
            while let Some(request) = inbound.message().await? {
                let Some(v1::sample_request::Message::Credits(credits)) = request.message else {
                    return Err(Status::invalid_argument(
                        "a stream has one hello, and then credits: send credits",
                    ));
                };
                if sender.send(credits).await.is_err() {
                    break;
                }
            }
            Ok(())
        };
        let end = tokio::select! {
            end = reading => end,
            () = shutdown.wait() => Err(shutting_down()),
        };
        if let Err(status) = end {
            // Where the client has gone there is nobody to tell.
            let _ = refusals.send(Err(status)).await;
        }
    });
    tokio::task::spawn_blocking(move || {
        if let Err(error) = gather(source, credits, &replies) {
            // As above.
            let _ = replies.blocking_send(Err(status(error)));
        }
    });
}

/// Sends minibatches as far as the credits go, until the client has gone.
fn gather(
    mut source: LocalSource,
    mut credits: mpsc::Receiver<u32>,
    replies: &Replies,
) -> Result<(), SampleError> {
    let mut owed: u64 = 0;
    while !replies.is_closed() {
        while let Ok(more) = credits.try_recv() {
            owed += u64::from(more);
        }
        if owed == 0 {
            match credits.blocking_recv() {
                Some(more) => owed += u64::from(more),
                None => return Ok(()),
            }
            continue;
        }
        let Some(minibatch) = source.poll_unless(Duration::MAX, || replies.is_closed())? else {
            return Ok(());
        };
        let bytes: usize =
            minibatch.columns.iter().map(|column| column.data.len() * columns::VALUE_BYTES).sum();
        // A part of what is owed: while the client takes that in, the next is gathered.
        let share = owed.div_ceil(MESSAGES_AHEAD) as usize;
        let most = (MESSAGE_BYTES / bytes.max(1)).clamp(1, share);
        let mut minibatches = vec![minibatch.into_wire()];
        while minibatches.len() < most
            && let Some(minibatch) = source.poll(Duration::ZERO)?
        {
            minibatches.push(minibatch.into_wire());
        }
        owed -= minibatches.len() as u64;
        if replies.blocking_send(Ok(v1::SampleReply { minibatches })).is_err() {
            return Ok(());
        }
    }
    Ok(())
}

fn status(error: SampleError) -> Status {
    match error {
        SampleError::Shutdown => shutting_down(),
        SampleError::Options(error) => Status::invalid_argument(error.to_string()),
        other => Status::unavailable(other.to_string()),
    }
}
