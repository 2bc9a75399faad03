//! The bounded queue between lanes and the segment writer.
//!
//! Its bound counts every segment that the replay has not acknowledged, whether it waits here or is on its way: so an
//! actor's memory, and what its death costs, is bounded by one setting.

use std::collections::VecDeque;
use std::sync::Arc;

use getup_proto::Segment;
use tokio::sync::{Semaphore, mpsc};

use crate::metrics::ActorMetrics;

/// A queue of up to `capacity` unacknowledged segments.
pub(crate) fn queue(capacity: usize, metrics: ActorMetrics) -> (QueueInput, QueueOutput) {
    let (sender, receiver) = mpsc::unbounded_channel();
    let room = Arc::new(Semaphore::new(capacity));
    let input = QueueInput { sender, room: room.clone(), capacity, metrics: metrics.clone() };
    let acknowledgements = Acknowledgements { room, metrics };
    (input, QueueOutput { receiver, acknowledgements, capacity })
}

/// Where lanes put segments.
#[derive(Clone, Debug)]
pub struct QueueInput {
    sender: mpsc::UnboundedSender<Segment>,
    /// One permit a segment that still fits.
    room: Arc<Semaphore>,
    capacity: usize,
    metrics: ActorMetrics,
}

impl QueueInput {
    /// Moves segments from the front of `pending` into the queue, as many as fit.
    pub fn fill_from(&self, pending: &mut VecDeque<Segment>) {
        while !pending.is_empty()
            && let Ok(permit) = self.room.try_acquire()
            && let Some(segment) = pending.pop_front()
        {
            permit.forget();
            self.put(segment);
        }
    }

    /// Moves the last segments into the queue, whether they fit or not: no others follow.
    pub fn finish_with(self, pending: VecDeque<Segment>) {
        pending.into_iter().for_each(|segment| self.put(segment));
    }

    fn put(&self, segment: Segment) {
        self.metrics.segments.inc();
        self.metrics.unacknowledged_segments.inc();
        // Without a receiver the actor is about to end, and the segment is among those nobody acknowledges.
        let _ = self.sender.send(segment);
    }

    /// Returns when a segment would fit.
    pub async fn room(&self) {
        let _ = self.room.acquire().await;
    }

    /// Segments that may be unacknowledged.
    pub fn capacity(&self) -> usize {
        self.capacity
    }
}

/// Where those who write take them.
pub(crate) struct QueueOutput {
    receiver: mpsc::UnboundedReceiver<Segment>,
    acknowledgements: Acknowledgements,
    capacity: usize,
}

impl QueueOutput {
    /// Waits for a segment and takes all there are, in order; none when all inputs are gone.
    pub(crate) async fn take(&mut self) -> Vec<Segment> {
        let mut segments = Vec::new();
        self.receiver.recv_many(&mut segments, usize::MAX).await;
        segments
    }

    /// Where those who append them say so.
    pub(crate) fn acknowledgements(&self) -> Acknowledgements {
        self.acknowledgements.clone()
    }

    /// Segments that may be unacknowledged.
    pub(crate) fn capacity(&self) -> usize {
        self.capacity
    }
}

/// Makes room for segments that a replay has.
#[derive(Clone)]
pub(crate) struct Acknowledgements {
    room: Arc<Semaphore>,
    metrics: ActorMetrics,
}

impl Acknowledgements {
    /// Makes room for as many: the replay has them.
    pub(crate) fn acknowledge(&self, segments: usize) {
        self.room.add_permits(segments);
        self.metrics.segments_acknowledged.inc_by(segments as u64);
        self.metrics.unacknowledged_segments.sub(segments as i64);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use getup_proto::PolicyVersion;
    use getup_telemetry::Registry;

    fn segment(episode: u64) -> Segment {
        Segment {
            writer: 1,
            sequence: 0,
            lane: 0,
            episode,
            first_step: 0,
            steps: 1,
            env_steps: 1,
            terminal: false,
            truncated: false,
            stage: 0,
            first_version: PolicyVersion::default(),
            last_version: PolicyVersion::default(),
            columns: Vec::new(),
            end: None,
            trace: None,
        }
    }

    #[tokio::test]
    async fn what_is_taken_makes_no_room_until_it_is_acknowledged() {
        let metrics = ActorMetrics::new(&Registry::new(), "actor");
        let (input, mut output) = queue(3, metrics.clone());
        let mut pending: VecDeque<Segment> = (0..5).map(segment).collect();
        input.fill_from(&mut pending);
        assert_eq!(pending.len(), 2);
        let taken = output.take().await;
        assert_eq!(taken.iter().map(|segment| segment.episode).collect::<Vec<_>>(), [0, 1, 2]);
        input.fill_from(&mut pending);
        assert_eq!((pending.len(), metrics.unacknowledged_segments.get()), (2, 3));

        output.acknowledgements().acknowledge(3);
        input.room().await;
        input.fill_from(&mut pending);
        assert!(pending.is_empty());
        drop(input);
        assert_eq!(output.take().await.len(), 2);
        assert!(output.take().await.is_empty(), "all inputs are gone");
        assert_eq!((metrics.segments.get(), metrics.segments_acknowledged.get()), (5, 3));
    }
}
