//! One update of SAC on minibatches divided over threads.

use std::sync::{Mutex, PoisonError};

use getup_policy::{Body, ObservationStatistics, PolicyShape};

use super::layout::LANES;
use super::memory::Memory;
use super::network::{Network, Ways};
use super::optimizer::AdamStep;
use super::product::Format;
use super::step::{Flat, Gradients, Piece, Room, cut};
use super::team::Team;
use super::weights::Weights;
use super::worker::{Networks, Worker};
use crate::sac::Batch;

/// Networks laid out for products, and the memory of an update.
pub(crate) struct CpuUpdate {
    team: Team,
    actor: Network,
    critic: Network,
    actor_weights: Vec<Weights>,
    /// A list for each critic.
    critic_weights: Vec<Vec<Weights>>,
    target_weights: Vec<Vec<Weights>>,
    workers: Vec<Worker>,
    /// Transitions that the workers are laid out for.
    batch: usize,
    /// What each thread needs for a step.
    rooms: Vec<Mutex<Room>>,
    /// Euclidean norms of the last update's gradients: of all critics, of the actor.
    gradient_norms: [f64; 2],
}

/// What a phase reads besides the minibatch.
#[derive(Clone, Copy)]
pub(crate) struct Inputs<'a> {
    pub(crate) batch: &'a Batch,
    pub(crate) statistics: Option<&'a ObservationStatistics>,
    /// `[B, action]`, standard normal.
    pub(crate) next_noise: &'a [f32],
    /// `[B, action]`, standard normal.
    pub(crate) noise: &'a [f32],
    pub(crate) temperature: f32,
}

/// The networks' flat parameters.
#[derive(Clone, Copy)]
pub(crate) struct Values<'a> {
    pub(crate) actor: &'a [f32],
    /// One after another.
    pub(crate) critics: &'a [f32],
    pub(crate) targets: &'a [f32],
}

/// Sums over the minibatch that a phase found, divided by its size.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Phase {
    /// Of the critics: Σ over critics of (Q − y)². Of the actor: α log π − min Q.
    pub(crate) loss: f64,
    /// Of the critics: Q of the minibatch's actions. Of the actor: −log π.
    pub(crate) value: f64,
}

impl CpuUpdate {
    /// Lays out networks for `threads` threads; None where this processor has no kernel for the products.
    pub(crate) fn new(
        shape: &PolicyShape,
        critic: &Body,
        bf16: bool,
        threads: usize,
        values: Values<'_>,
    ) -> Option<Self> {
        let format = if bf16 { Format::Bf16 } else { Format::F32 };
        if !(format.works() && Format::F32.works()) {
            return None;
        }
        let actor_network = Network::new(&shape.body, shape.observation, &[shape.action; 2], format);
        let critic = Network::new(critic, shape.observation + shape.action, &[1], format);
        let mut memory = Memory::default();
        let actor_weights = actor_network.weights(values.actor, true, &mut memory);
        let room = |_| Room::new([&actor_network, &critic], &mut memory).into();
        let rooms = (0..threads.max(1)).map(room).collect();
        let mut lay_out = |values: &[f32], differentiated| {
            let networks = values.chunks_exact(critic.length);
            networks.map(|one| critic.weights(one, differentiated, &mut memory)).collect()
        };
        Some(Self {
            rooms,
            gradient_norms: [0.0; 2],
            team: Team::new(threads),
            actor_weights,
            critic_weights: lay_out(values.critics, true),
            target_weights: lay_out(values.targets, false),
            actor: actor_network,
            critic,
            workers: Vec::new(),
            batch: 0,
        })
    }

    /// Critics' losses and gradients: y = r + γ (min Q'(s', a') − α log π(a'|s')), mean w (Q(s, a) − y)².
    pub(crate) fn critics_backward(&mut self, inputs: &Inputs<'_>, values: Values<'_>) -> Phase {
        self.lay_out(inputs.batch.rows());
        self.backward(values, |worker, networks| worker.critics_backward(networks, inputs))
    }

    /// |Q − y| of the last [`CpuUpdate::critics_backward`], mean over the critics, row after row.
    pub(crate) fn td_errors(&self, errors: &mut Vec<f32>) {
        errors.clear();
        for worker in &self.workers {
            errors.extend_from_slice(&worker.td_errors);
        }
    }

    /// The actor's loss and gradients: mean (α log π(a|s) − min Q(s, a)), a ~ π(s). The minibatch is that of the last
    /// [`CpuUpdate::critics_backward`].
    pub(crate) fn actor_backward(&mut self, inputs: &Inputs<'_>, values: Values<'_>) -> Phase {
        self.backward(values, |worker, networks| worker.actor_backward(networks, inputs))
    }

    fn backward(
        &mut self,
        values: Values<'_>,
        work: impl Fn(&mut Worker, &Networks<'_>) + Send + Sync,
    ) -> Phase {
        let Self { team, actor, critic, actor_weights, critic_weights, target_weights, workers, .. } = self;
        let networks = Networks { actor, critic, actor_weights, critic_weights, target_weights, values };
        team.each(workers, |_, worker| work(worker, &networks));
        workers.iter().fold(Phase::default(), |sum, worker| sum.plus(&worker.phase))
    }

    /// A step of AdamW along the critics' gradients, and of Polyak averaging for their targets.
    pub(crate) fn critics_step(&mut self, critics: Flat<'_>, targets: &mut [f32], step: AdamStep, tau: f32) {
        let Self { critic, critic_weights, target_weights, workers, .. } = self;
        let gradients = |index: usize| Gradients {
            traces: workers.iter().map(|worker| &worker.critics[index]).collect(),
            vectors: workers.iter().map(|worker| &worker.critics_gradient[index * critic.length..]).collect(),
        };
        let gradients: Vec<_> = (0..critic_weights.len()).map(gradients).collect();
        let length = critic.length;
        let networks = critics.values.chunks_exact_mut(length).zip(critics.first.chunks_exact_mut(length));
        let networks = networks.zip(critics.second.chunks_exact_mut(length));
        let networks = networks.zip(targets.chunks_exact_mut(length)).zip(&gradients);
        let weights = critic_weights.iter_mut().zip(target_weights);
        let mut pieces = Vec::new();
        for (((((values, first), second), targets), gradients), (weights, target_weights)) in
            networks.zip(weights)
        {
            let flat = Flat { values, first, second };
            let target = Some((targets, target_weights));
            cut(critic, flat, gradients, weights, target, &mut pieces);
        }
        self.gradient_norms[0] = take_steps(&mut self.team, &self.rooms, &mut pieces, step, tau);
    }

    /// A step of AdamW along the actor's gradient.
    pub(crate) fn actor_step(&mut self, actor: Flat<'_>, step: AdamStep) {
        let gradients = Gradients {
            traces: self.workers.iter().map(|worker| &worker.actor).collect(),
            vectors: self.workers.iter().map(|worker| &worker.actor_gradient[..]).collect(),
        };
        let mut pieces = Vec::new();
        cut(&self.actor, actor, &gradients, &mut self.actor_weights, None, &mut pieces);
        self.gradient_norms[1] = take_steps(&mut self.team, &self.rooms, &mut pieces, step, 0.0);
    }

    /// Euclidean norms of the last update's gradients: of all critics, of the actor.
    pub(crate) fn gradient_norms(&self) -> [f64; 2] {
        self.gradient_norms
    }

    /// The matrix products of one update on `batch` transitions and nothing else: its limit on this processor.
    pub(crate) fn multiply(&mut self, batch: usize) {
        self.lay_out(batch);
        let Self { team, actor, critic, actor_weights, critic_weights, target_weights, workers, .. } = self;
        let first = Some(actor.inputs);
        team.each(workers, |_, worker| {
            let Worker { actor: actor_trace, critics, scratch, critics_gradient, actor_gradient, .. } =
                worker;
            let gradients = critics_gradient.chunks_exact_mut(critic.length);
            for ((index, trace), gradient) in critics.iter_mut().enumerate().zip(gradients) {
                let mut multiply =
                    |weights: &[Weights], ways| critic.multiply(weights, trace, scratch, ways, gradient);
                // Q'(s', a'); Q(s, a) and back to the weights; Q(s, a ~ π) and back to the actions.
                multiply(&target_weights[index], Ways { forward: 1, weights: 0, inputs: 0, first: None });
                multiply(&critic_weights[index], Ways { forward: 1, weights: 1, inputs: 1, first: None });
                multiply(&critic_weights[index], Ways { forward: 1, weights: 0, inputs: 1, first });
            }
            // π(s'); π(s) and back to the weights.
            let ways = Ways { forward: 2, weights: 1, inputs: 1, first: None };
            actor.multiply(actor_weights, actor_trace, scratch, ways, actor_gradient);
        });
    }

    /// Divides `batch` transitions over the workers, in whole vectors.
    fn lay_out(&mut self, batch: usize) {
        if self.batch == batch {
            return;
        }
        self.batch = batch;
        let share = batch.div_ceil(self.team.threads()).next_multiple_of(LANES);
        let critics = self.critic_weights.len();
        let mut memory = Memory::default();
        let mut worker = |first: usize| {
            let rows = first..batch.min(first + share);
            Worker::new(rows, &self.actor, &self.critic, critics, &mut memory)
        };
        self.workers = (0..batch).step_by(share).map(&mut worker).collect();
    }
}

/// A step of every piece; the Euclidean norm of their gradient.
fn take_steps(
    team: &mut Team,
    rooms: &[Mutex<Room>],
    pieces: &mut [Piece<'_>],
    step: AdamStep,
    tau: f32,
) -> f64 {
    team.each(pieces, |thread, piece| {
        piece.step(&mut rooms[thread].lock().unwrap_or_else(PoisonError::into_inner), step, tau);
    });
    pieces.iter().map(Piece::squares).sum::<f64>().sqrt()
}

impl Phase {
    fn plus(self, other: &Self) -> Self {
        Self { loss: self.loss + other.loss, value: self.value + other.value }
    }
}
