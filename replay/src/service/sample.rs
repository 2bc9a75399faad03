//! A sampler's stream: credits in, minibatches out.

use super::blocking::blocking;
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

/// Serves the stream: a task reads its credits, and another gathers its minibatches.
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
    tokio::spawn(async move {
        if let Err(error) = gather(source, credits, &replies).await {
            // As above.
            let _ = replies.send(Err(status(error))).await;
        }
    });
}

/// Sends minibatches as far as the credits go, until the client has gone.
async fn gather(
    mut source: LocalSource,
    mut credits: mpsc::Receiver<u32>,
    replies: &Replies,
) -> Result<(), SampleError> {
    let mut owed: u64 = 0;
    loop {
        while let Ok(more) = credits.try_recv() {
            owed += u64::from(more);
        }
        if owed == 0 {
            match credits.recv().await {
                Some(more) => owed += u64::from(more),
                None => return Ok(()),
            }
            continue;
        }
        tokio::select! {
            () = source.ready() => {}
            () = replies.closed() => return Ok(()),
        }
        // A part of what is owed: while the client takes that in, the next is gathered.
        let share = owed.div_ceil(MESSAGES_AHEAD) as usize;
        let minibatches = blocking(|| message(&mut source, share)).await?;
        owed -= minibatches.len() as u64;
        // None where another sampler was quicker.
        if !minibatches.is_empty() && replies.send(Ok(v1::SampleReply { minibatches })).await.is_err() {
            return Ok(());
        }
    }
}

/// Up to `share` minibatches that need not wait, and no more than a message holds.
fn message(source: &mut LocalSource, share: usize) -> Result<Vec<v1::Minibatch>, SampleError> {
    let mut minibatches = Vec::new();
    let mut most = share;
    while minibatches.len() < most
        && let Some(minibatch) = source.poll(Duration::ZERO)?
    {
        let bytes: usize =
            minibatch.columns.iter().map(|column| column.data.len() * columns::VALUE_BYTES).sum();
        most = (MESSAGE_BYTES / bytes.max(1)).clamp(1, share);
        minibatches.push(minibatch.into_wire());
    }
    Ok(minibatches)
}

fn status(error: SampleError) -> Status {
    match error {
        SampleError::Shutdown => shutting_down(),
        SampleError::Options(error) => Status::invalid_argument(error.to_string()),
        other => Status::unavailable(other.to_string()),
    }
}
