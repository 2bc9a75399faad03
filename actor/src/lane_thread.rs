//! A thread of lanes: takes over policies, plays evaluations and steps, and waits only between steps.

use std::collections::VecDeque;
use std::future::pending;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

use getup_proto::Segment;
use getup_sim::TaskConfig;
use getup_telemetry::{Shutdown, Waits};
use tokio::runtime::Handle;
use tokio::sync::{mpsc, watch};

use crate::error::ActorError;
use crate::evaluate::{EvaluateError, Evaluator};
use crate::lanes::{LaneGroup, LaneSettings};
use crate::link::{EpisodeResult, Lease, PolicyUpdate};
use crate::queue::QueueInput;

/// One thread of an actor, before it runs.
pub(crate) struct LaneThread {
    pub(crate) settings: LaneSettings,
    pub(crate) first_lane: u32,
    pub(crate) lanes: usize,
    /// The newest policy.
    pub(crate) updates: watch::Receiver<Option<Arc<PolicyUpdate>>>,
    pub(crate) queue: QueueInput,
    /// Of the first thread alone.
    pub(crate) desk: Option<EvaluationDesk>,
    pub(crate) waits: Waits,
    pub(crate) stop: Shutdown,
}

/// Where leased evaluations come in and go out; played between steps.
pub(crate) struct EvaluationDesk {
    pub(crate) task: TaskConfig,
    pub(crate) control_limit: f64,
    pub(crate) leases: mpsc::Receiver<Lease>,
    pub(crate) reports: mpsc::UnboundedSender<(u64, Vec<EpisodeResult>)>,
    /// Made for the first lease.
    pub(crate) evaluator: Option<Evaluator>,
}

impl LaneThread {
    /// Runs until it is stopped, or cannot go on. Blocks: it is to have a thread of its own.
    pub(crate) fn run(mut self, runtime: &Handle) -> Result<(), ActorError> {
        let mut pending = VecDeque::new();
        let ended = self.play(runtime, &mut pending);
        self.queue.finish_with(pending);
        ended
    }

    /// What of its segments did not fit into the queue at the end is left in `pending`.
    fn play(&mut self, runtime: &Handle, pending: &mut VecDeque<Segment>) -> Result<(), ActorError> {
        let mut group: Option<LaneGroup> = None;
        let mut segments = Vec::new();
        let mut lease = None;
        let mut waiting = self.waits.waiting("actor");
        while !self.stop.is_triggered() {
            self.take_policy(&mut group)?;
            let desk_lease = self.desk.as_mut().and_then(|desk| desk.leases.try_recv().ok());
            if let Some(lease) = lease.take().or(desk_lease) {
                self.evaluate(&lease)?;
                continue;
            }
            let obstacle = self.obstacle(group.as_ref(), pending);
            match (obstacle, &mut group) {
                (None, Some(group)) => {
                    waiting.over();
                    group.step(&mut segments);
                    pending.extend(segments.drain(..));
                }
                (obstacle, _) => {
                    waiting.because(obstacle.unwrap_or_else(|| "no policy from the learner yet".to_owned()));
                    lease = runtime.block_on(self.change(!pending.is_empty()));
                }
            }
        }
        Ok(())
    }

    /// Gives the lanes the newest policy; the first one brings them into being.
    fn take_policy(&mut self, group: &mut Option<LaneGroup>) -> Result<(), ActorError> {
        let Some(update) = self.updates.borrow_and_update().clone() else { return Ok(()) };
        match group {
            Some(group) if Arc::ptr_eq(group.policy(), &update) => {}
            Some(group) => group.set_policy(update).map_err(|error| ActorError::Group(error.into()))?,
            None => {
                *group = Some(LaneGroup::new(self.settings.clone(), self.first_lane, self.lanes, update)?);
            }
        }
        Ok(())
    }

    /// Why no step can be played now. What was played before goes into the queue first.
    fn obstacle(&self, group: Option<&LaneGroup>, pending: &mut VecDeque<Segment>) -> Option<String> {
        self.queue.fill_from(pending);
        if !pending.is_empty() {
            return Some(format!("replay has not acknowledged {} segments", self.queue.capacity()));
        }
        let finished = group.is_some_and(|group| group.policy().finished);
        finished.then(|| "training has finished".to_owned())
    }

    /// Returns when something may have changed; a lease that came is returned.
    async fn change(&mut self, queue_is_full: bool) -> Option<Lease> {
        let (updates, desk) = (&mut self.updates, &mut self.desk);
        let update = async move {
            if updates.changed().await.is_err() {
                // No newer one will ever come.
                pending::<()>().await;
            }
        };
        let lease = async move {
            match desk {
                Some(desk) => match desk.leases.recv().await {
                    Some(lease) => lease,
                    None => pending().await,
                },
                None => pending().await,
            }
        };
        tokio::select! {
            () = self.stop.wait() => None,
            () = update => None,
            () = self.queue.room(), if queue_is_full => None,
            lease = lease => Some(lease),
        }
    }

    /// Plays a leased evaluation; its report leaves through the desk.
    fn evaluate(&mut self, lease: &Lease) -> Result<(), ActorError> {
        let Some(desk) = &mut self.desk else { return Ok(()) };
        let start = Instant::now();
        let evaluator = match &mut desk.evaluator {
            Some(evaluator) => evaluator,
            none => none.insert(Evaluator::new(&desk.task, desk.control_limit, self.lanes)?),
        };
        let go_on = |_| {
            if self.stop.is_triggered() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        let update = &lease.update;
        let episodes = match evaluator.evaluate(&update.policy, update.beta, &lease.seeds, go_on) {
            Ok(episodes) => episodes,
            Err(EvaluateError::Ended) => return Ok(()),
            Err(error) => return Err(error.into()),
        };
        self.settings.metrics.evaluations.inc();
        self.settings.metrics.evaluation_seconds.inc_by(start.elapsed().as_secs_f64());
        let results = episodes.iter().map(|episode| episode.result()).collect();
        // Without a receiver the actor is about to end, and the lease goes to somebody else.
        let _ = desk.reports.send((lease.id, results));
        Ok(())
    }
}
