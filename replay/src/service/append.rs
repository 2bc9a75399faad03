//! A writer's stream: segments in, acknowledgements out.

use super::committer::Job;
use super::visit::Visit;
use super::{failed, shutting_down};
use getup_proto::{Segment, SegmentError, SegmentTrace, v1};
use getup_telemetry::Shutdown;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::SystemTime;
use tokio::sync::{mpsc, oneshot, watch};
use tonic::{Status, Streaming};

type Replies = mpsc::Sender<Result<v1::AppendReply, Status>>;

/// A writer that has said hello.
pub(super) struct AppendStream {
    visit: Visit,
    jobs: mpsc::Sender<Job>,
    /// Durable before this stream.
    durable: u64,
}

impl AppendStream {
    /// Introduces the writer.
    pub(super) async fn new(jobs: mpsc::Sender<Job>, writer: u64, name: String) -> Result<Self, Status> {
        let (introduced, answer) = oneshot::channel();
        jobs.send(Job::Introduce { writer, name, introduced }).await.map_err(|_| failed())?;
        let (visit, durable) = answer.await.map_err(|_| failed())?;
        Ok(Self { visit, jobs, durable })
    }

    /// Takes segments until the stream ends, breaks, sends something wrong, or `shutdown`; then acknowledges what
    /// was taken, and says why there is no more.
    pub(super) async fn run(
        self,
        inbound: Streaming<v1::AppendRequest>,
        replies: Replies,
        shutdown: Shutdown,
    ) {
        if acknowledge(&replies, self.durable).await.is_none() {
            return;
        }
        let taken = AtomicU64::new(self.durable);
        let (durable, mut progress) = watch::channel(self.durable);
        let end = {
            let reading = self.read(inbound, &taken, durable);
            tokio::pin!(reading);
            // To be acknowledged. A client that does not read it must not hold up `reading`: that may have its turn at the
            // limiter.
            let mut newest = None;
            loop {
                tokio::select! {
                    end = &mut reading => break end,
                    () = shutdown.wait() => break Err(shutting_down()),
                    // What waits for the limiter is not acknowledged: it comes again on another stream.
                    () = replies.closed() => return,
                    // With `reading`, a sender of it lives.
                    Ok(()) = progress.changed() => newest = Some(*progress.borrow_and_update()),
                    Ok(place) = replies.reserve(), if newest.is_some() => {
                        place.send(Ok(v1::AppendReply { durable_sequence: newest.take().unwrap_or_default() }));
                    }
                }
            }
        };
        // An error here means that the committer gave up, and the store with it.
        let taken = taken.into_inner();
        let durable = progress.wait_for(|sequence| *sequence >= taken).await.map(|sequence| *sequence);
        let end = match durable {
            Ok(sequence) => acknowledge(&replies, sequence).await.map_or(Ok(()), |()| end),
            Err(_) => Err(failed()),
        };
        if let Err(status) = end {
            // Where the client has gone there is nobody to tell.
            let _ = replies.send(Err(status)).await;
        }
    }

    /// Passes segments on to the committer, at the limiter's pace. `taken` is the newest that was.
    async fn read(
        &self,
        mut inbound: Streaming<v1::AppendRequest>,
        taken: &AtomicU64,
        durable: watch::Sender<u64>,
    ) -> Result<(), Status> {
        let mut newest = 0;
        while let Some(request) = inbound.message().await? {
            let mut segment = self.parse(request, newest)?;
            newest = segment.sequence;
            let store = &self.visit.store;
            store.gate().heard_writer(self.visit.writer);
            if segment.sequence <= self.durable {
                continue;
            }
            let permit = store.gate().admit_task(u64::from(segment.env_steps)).await;
            if let Some(trace) = &mut segment.trace {
                trace.since = SystemTime::now();
            }
            let job = Job::Append { segment, permit, durable: durable.clone() };
            self.jobs.send(job).await.map_err(|_| failed())?;
            taken.store(newest, Ordering::Relaxed);
        }
        Ok(())
    }

    /// The segment of a request; `newest` is the sequence number before it on this stream.
    fn parse(&self, request: v1::AppendRequest, newest: u64) -> Result<Segment, Status> {
        let metrics = self.visit.store.metrics();
        let refused = |reason: &str, text: String| {
            metrics.reject(reason);
            Status::invalid_argument(text)
        };
        let Some(v1::append_request::Message::Segment(segment)) = request.message else {
            return Err(refused(
                "hello",
                "a stream has one hello, and then segments: send a segment".to_owned(),
            ));
        };
        let mut segment = Segment::parse(segment, self.visit.store.spec()).map_err(|error| {
            let status = refused(error.kind(), error.to_string());
            match error {
                // Worth another attempt, unlike the rest.
                SegmentError::Checksum { .. } => Status::data_loss(status.message()),
                _ => status,
            }
        })?;
        if segment.writer != self.visit.writer {
            let (theirs, ours) = (segment.writer, self.visit.writer);
            let text =
                format!("a segment of writer {theirs} came on the stream of writer {ours}: open another");
            return Err(refused("writer", text));
        }
        if segment.sequence <= newest {
            let text = format!(
                "segment {} came after segment {newest}: a writer's sequence numbers increase",
                segment.sequence
            );
            return Err(refused("sequence", text));
        }
        // What is none concerns whoever looks at traces, and not the segment.
        segment.trace = request.traceparent.parse().ok().map(SegmentTrace::arrived).map(Box::new);
        Ok(segment)
    }
}

/// Tells the client; None if it has gone.
async fn acknowledge(replies: &Replies, durable_sequence: u64) -> Option<()> {
    replies.send(Ok(v1::AppendReply { durable_sequence })).await.ok()
}
