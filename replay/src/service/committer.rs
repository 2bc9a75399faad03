//! The one task that appends: it takes what the streams have queued and commits it together.
//!
//! While the disk takes one group, the next gathers in the queue: the busier the service, the larger its commits.

use super::blocking::blocking;
use super::visit::Visit;
use crate::error::StoreError;
use crate::gate::Permit;
use crate::store::Store;
use getup_proto::{RunSpec, Segment};
use getup_telemetry::Shutdown;
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot, watch};

/// Segments of a commit, and of the queue, at most.
const MOST_SEGMENTS: usize = 128;
/// Their bytes, at most (and never less than one segment).
const MOST_BYTES: usize = 32 << 20;

/// What a stream asks for.
pub(super) enum Job {
    /// Says how far the writer's segments are durable. What it sends again of those that are queued is stored once.
    Introduce { writer: u64, name: String, introduced: oneshot::Sender<(Visit, u64)> },
    /// Appends a segment, and raises `durable` to its sequence number.
    Append { segment: Segment, permit: Permit, durable: watch::Sender<u64> },
}

/// How many jobs may be queued.
pub(super) fn queue_length(spec: &RunSpec) -> usize {
    let longest: usize = spec.columns.iter().map(|column| column.bytes(spec.max_segment_steps)).sum();
    (MOST_BYTES / longest).clamp(1, MOST_SEGMENTS)
}

/// Works until all senders of the queue are gone, an append fails, or `shutdown` finds the disk full.
pub(super) async fn run(
    store: Arc<Store>,
    mut queue: mpsc::Receiver<Job>,
    shutdown: Shutdown,
) -> Result<(), StoreError> {
    let most = queue_length(store.spec());
    let mut jobs = Vec::with_capacity(most);
    while queue.recv_many(&mut jobs, most).await > 0 {
        let mut segments = Vec::with_capacity(jobs.len());
        let mut acknowledgements = Vec::with_capacity(jobs.len());
        for job in jobs.drain(..) {
            match job {
                Job::Introduce { writer, name, introduced } => {
                    let visit = blocking(|| Visit::begin(store.clone(), writer, &name)).await;
                    // Where its stream has gone meanwhile, the visit ends with this.
                    let _ = introduced.send(visit);
                }
                Job::Append { segment, permit, durable } => {
                    acknowledgements.push((segment.sequence, permit, durable));
                    segments.push(segment);
                }
            }
        }
        if !blocking(|| store.append_when_there_is_room(&segments, &shutdown)).await? {
            tracing::warn!("replay ends with {} segments that a full disk did not take", segments.len());
            return Ok(());
        }
        for (sequence, permit, durable) in acknowledgements {
            drop(permit);
            durable.send_if_modified(|newest| {
                let newer = sequence > *newest;
                *newest = sequence.max(*newest);
                newer
            });
        }
    }
    Ok(())
}
