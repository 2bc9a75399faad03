//! Spreads segments over several replays.
//!
//! An episode's segments stay together, so that n-step returns join them, for as long as their replay takes them. Each
//! replay may have its share of the queue unacknowledged, and no more: one that is away keeps what it may have stored,
//! which nobody else must store again, and all else goes to the others.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use getup_proto::Segment;
use getup_telemetry::Traces;
use getup_telemetry::prometheus::Histogram;
use tokio::sync::{Notify, mpsc};
use tokio::task::JoinSet;

use crate::error::ActorError;
use crate::link::SegmentWriter;
use crate::queue::{Acknowledgements, QueueOutput};
use crate::sending::Sending;

/// Takes segments from `queue` until its inputs are gone, and appends each by one of `writers`; tasks of `tasks` do it.
/// Those that are followed are, as those of the actor of this name.
pub(crate) fn spread<W: SegmentWriter>(
    writers: Vec<W>,
    queue: QueueOutput,
    append_seconds: &Histogram,
    (traces, actor): (Traces, &str),
    tasks: &mut JoinSet<Result<(), ActorError>>,
) {
    let freed = Arc::new(Notify::new());
    let shares = Shares::new(queue.capacity().div_ceil(writers.len()), writers.len());
    let mut desks = Vec::new();
    for link in writers {
        let (segments, inbox) = mpsc::unbounded_channel();
        let unacknowledged = Arc::new(AtomicUsize::new(0));
        desks.push(Desk { segments, unacknowledged: unacknowledged.clone() });
        tasks.spawn(append(Appending {
            link,
            inbox,
            unacknowledged,
            freed: freed.clone(),
            acknowledgements: queue.acknowledgements(),
            append_seconds: append_seconds.clone(),
            traces: traces.clone(),
            actor: actor.to_owned(),
        }));
    }
    tasks.spawn(distribute(queue, shares, desks, freed));
}

/// A replay, as the one who distributes sees it.
struct Desk {
    segments: mpsc::UnboundedSender<Segment>,
    unacknowledged: Arc<AtomicUsize>,
}

async fn distribute(
    mut queue: QueueOutput,
    mut shares: Shares,
    desks: Vec<Desk>,
    freed: Arc<Notify>,
) -> Result<(), ActorError> {
    loop {
        let segments = queue.take().await;
        if segments.is_empty() {
            return Ok(());
        }
        for segment in segments {
            let desk = loop {
                let load = |desk: &Desk| desk.unacknowledged.load(Ordering::Acquire);
                let loads: Vec<usize> = desks.iter().map(load).collect();
                match shares.choose(segment.lane, segment.episode, &loads) {
                    Some(index) => break &desks[index],
                    None => freed.notified().await,
                }
            };
            desk.unacknowledged.fetch_add(1, Ordering::AcqRel);
            // One that has ended has failed, and with it the actor.
            let _ = desk.segments.send(segment);
        }
    }
}

/// What appends to one replay.
struct Appending<W> {
    link: W,
    inbox: mpsc::UnboundedReceiver<Segment>,
    unacknowledged: Arc<AtomicUsize>,
    freed: Arc<Notify>,
    acknowledgements: Acknowledgements,
    append_seconds: Histogram,
    traces: Traces,
    /// The actor's name.
    actor: String,
}

/// Numbers the segments and appends them, all that are there at a time.
async fn append<W: SegmentWriter>(mut to: Appending<W>) -> Result<(), ActorError> {
    let mut sequence = 0;
    loop {
        let mut segments = Vec::new();
        let count = to.inbox.recv_many(&mut segments, usize::MAX).await;
        if count == 0 {
            return Ok(());
        }
        for segment in &mut segments {
            sequence += 1;
            (segment.writer, segment.sequence) = (to.link.writer(), sequence);
        }
        let sending = Sending::begin(&to.traces, &to.actor, &mut segments);
        let timer = to.append_seconds.start_timer();
        to.link.append(segments).await.map_err(ActorError::Refused)?;
        timer.observe_duration();
        sending.acknowledged();
        to.unacknowledged.fetch_sub(count, Ordering::AcqRel);
        to.freed.notify_one();
        to.acknowledgements.acknowledge(count);
    }
}

/// Who gets the next segment.
#[derive(Debug)]
struct Shares {
    /// Segments of a replay that may be unacknowledged.
    share: usize,
    /// Segments that each replay was given.
    given: Vec<u64>,
    /// The episode of each lane, and where its segments go.
    lanes: HashMap<u32, (u64, usize)>,
}

impl Shares {
    fn new(share: usize, replays: usize) -> Self {
        Self { share, given: vec![0; replays], lanes: HashMap::new() }
    }

    /// The replay for a segment, given how many of each are unacknowledged: that of its episode, or where that has its
    /// share, or for a new episode, the one with the fewest; of several with as few (replays that keep up have none) the
    /// one that was given least. None where all have their share.
    fn choose(&mut self, lane: u32, episode: u64, unacknowledged: &[usize]) -> Option<usize> {
        let has_room = |index: usize| unacknowledged[index] < self.share;
        let same = self.lanes.get(&lane).filter(|&&(of, index)| of == episode && has_room(index));
        let load = |&index: &usize| (unacknowledged[index], self.given[index]);
        let fewest = || (0..unacknowledged.len()).min_by_key(load);
        let chosen = same.map(|&(_, index)| index).or_else(fewest).filter(|&index| has_room(index))?;
        self.given[chosen] += 1;
        self.lanes.insert(lane, (episode, chosen));
        Some(chosen)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_episode_stays_where_it_began() {
        let mut shares = Shares::new(4, 2);
        assert_eq!(shares.choose(0, 1, &[0, 0]), Some(0));
        assert_eq!(shares.choose(1, 1, &[1, 0]), Some(1));
        assert_eq!(shares.choose(0, 1, &[3, 0]), Some(0), "though the other has fewer");
        assert_eq!(shares.choose(0, 2, &[3, 0]), Some(1), "the next episode is free to go");
    }

    #[test]
    fn replays_that_keep_up_get_as_much_each() {
        let mut shares = Shares::new(8, 3);
        for episode in 0..100 {
            for lane in 0..16 {
                for _segment in 0..4 {
                    shares.choose(lane, episode, &[0; 3]).expect("all have room");
                }
            }
        }
        let most = shares.given.iter().max().unwrap();
        assert!(shares.given.iter().all(|given| most - given <= 4), "{:?}", shares.given);
    }

    #[test]
    fn one_that_is_away_gets_its_share_and_no_more() {
        let mut shares = Shares::new(2, 2);
        let mut unacknowledged = [0, 0];
        let mut given = [0, 0];
        for step in 0..40 {
            let lane = step % 5;
            let index =
                shares.choose(lane, u64::from(step / 20), &unacknowledged).expect("the other takes all");
            given[index] += 1;
            // The second acknowledges at once, the first never.
            unacknowledged[0] += usize::from(index == 0);
        }
        assert_eq!(given, [2, 38]);
        assert_eq!(shares.choose(0, 9, &[2, 2]), None);
    }
}
