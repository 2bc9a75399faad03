//! One update of SAC on minibatches divided over threads.

use std::ops::Range;

use getup_policy::{Body, ObservationStatistics, PolicyShape};
use rayon::ThreadPool;
use rayon::prelude::*;

use super::kernels::{self, AdamStep, LANES, Motor};
use super::layout;
use super::memory::{Buffer, Memory};
use super::network::{Network, Trace, Ways};
use super::operand::Weights;
use super::product::Format;
use super::step::{Flat, cut, take};
use crate::sac::Batch;

/// Networks laid out for products, and the memory of an update.
pub(crate) struct CpuUpdate {
    /// None for one thread, which is the caller's.
    pool: Option<ThreadPool>,
    threads: usize,
    actor: Network,
    critic: Network,
    actor_weights: Vec<Weights>,
    /// A list for each critic.
    critic_weights: Vec<Vec<Weights>>,
    target_weights: Vec<Vec<Weights>>,
    workers: Vec<Worker>,
    /// Transitions that the workers are laid out for.
    batch: usize,
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
        let mut lay_out = |values: &[f32], differentiated| {
            let networks = values.chunks_exact(critic.length);
            networks.map(|one| critic.weights(one, differentiated, &mut memory)).collect()
        };
        let pool = (threads > 1).then(|| {
            let name = |index| format!("update-{index}");
            rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(name).build().ok()
        });
        Some(Self {
            threads: if matches!(pool, Some(Some(_))) { threads } else { 1 },
            pool: pool.flatten(),
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
        let Self { pool, actor, critic, actor_weights, critic_weights, target_weights, workers, .. } = self;
        let networks = Networks { actor, critic, actor_weights, critic_weights, target_weights, values };
        run(pool, workers, |worker| work(worker, &networks));
        workers.iter().fold(Phase::default(), |sum, worker| sum.plus(&worker.phase))
    }

    /// A step of AdamW along the critics' gradients, and of Polyak averaging for their targets.
    pub(crate) fn critics_step(&mut self, critics: Flat<'_>, targets: &mut [f32], step: AdamStep, tau: f32) {
        let mut gradients: Vec<&mut [f32]> =
            self.workers.iter_mut().map(|worker| &mut worker.critics_gradient[..]).collect();
        let mut pieces = Vec::new();
        let length = self.critic.length;
        let networks = critics.values.chunks_exact_mut(length).zip(critics.first.chunks_exact_mut(length));
        let networks = networks.zip(critics.second.chunks_exact_mut(length));
        let networks = networks.zip(targets.chunks_exact_mut(length));
        let weights = self.critic_weights.iter_mut().zip(&mut self.target_weights);
        for ((((values, first), second), targets), (weights, target_weights)) in networks.zip(weights) {
            let flat = Flat { values, first, second };
            let own: Vec<&mut [f32]> = gradients.iter_mut().map(|rest| take(rest, length)).collect();
            let target = Some((targets, target_weights));
            cut(&self.critic, flat, own, weights, target, &mut pieces);
        }
        run(&self.pool, &mut pieces, |piece| piece.step(step, tau));
    }

    /// A step of AdamW along the actor's gradient.
    pub(crate) fn actor_step(&mut self, actor: Flat<'_>, step: AdamStep) {
        let gradients = self.workers.iter_mut().map(|worker| &mut worker.actor_gradient[..]).collect();
        let mut pieces = Vec::new();
        cut(&self.actor, actor, gradients, &mut self.actor_weights, None, &mut pieces);
        run(&self.pool, &mut pieces, |piece| piece.step(step, 0.0));
    }

    /// Euclidean norms of the last update's gradients: of all critics, of the actor.
    pub(crate) fn gradient_norms(&self) -> [f64; 2] {
        // A step leaves the sum of all workers' gradients with the first.
        let norm = |gradient: fn(&Worker) -> &[f32]| {
            let squares =
                |worker| gradient(worker).iter().map(|&value| f64::from(value).powi(2)).sum::<f64>();
            self.workers.first().map_or(0.0, squares).sqrt()
        };
        [norm(|worker| &worker.critics_gradient), norm(|worker| &worker.actor_gradient)]
    }

    /// The matrix products of one update on `batch` transitions and nothing else: its limit on this processor.
    pub(crate) fn multiply(&mut self, batch: usize) {
        self.lay_out(batch);
        let Self { pool, actor, critic, actor_weights, critic_weights, target_weights, workers, .. } = self;
        let first = Some(actor.inputs);
        run(pool, workers, |worker| {
            let gradients = worker.critics_gradient.chunks_exact_mut(critic.length);
            for ((index, trace), gradient) in worker.critics.iter_mut().enumerate().zip(gradients) {
                // Q'(s', a'); Q(s, a) and back to the weights; Q(s, a ~ π) and back to the actions.
                let once = Ways { forward: 1, weights: 0, inputs: 0, first: None };
                critic.multiply(&target_weights[index], trace, once, gradient);
                let learn = Ways { forward: 1, weights: 1, inputs: 1, first: None };
                critic.multiply(&critic_weights[index], trace, learn, gradient);
                let ask = Ways { forward: 1, weights: 0, inputs: 1, first };
                critic.multiply(&critic_weights[index], trace, ask, gradient);
            }
            // π(s'); π(s) and back to the weights.
            let ways = Ways { forward: 2, weights: 1, inputs: 1, first: None };
            actor.multiply(actor_weights, &mut worker.actor, ways, &mut worker.actor_gradient);
        });
    }

    /// Divides `batch` transitions over the workers, in whole vectors.
    fn lay_out(&mut self, batch: usize) {
        if self.batch == batch {
            return;
        }
        self.batch = batch;
        let share = batch.div_ceil(self.threads).next_multiple_of(LANES);
        let critics = self.critic_weights.len();
        let mut memory = Memory::default();
        let mut worker = |first: usize| {
            let rows = first..batch.min(first + share);
            Worker::new(rows, &self.actor, &self.critic, critics, &mut memory)
        };
        self.workers = (0..batch).step_by(share).map(&mut worker).collect();
    }
}

/// Runs `work` on every item, on the pool where there is one.
fn run<T: Send>(pool: &Option<ThreadPool>, items: &mut [T], work: impl Fn(&mut T) + Send + Sync) {
    match pool {
        Some(pool) => pool.install(|| items.par_iter_mut().with_max_len(1).for_each(&work)),
        None => items.iter_mut().for_each(work),
    }
}

impl Phase {
    fn plus(self, other: &Self) -> Self {
        Self { loss: self.loss + other.loss, value: self.value + other.value }
    }
}

/// The networks as every worker reads them.
struct Networks<'a> {
    actor: &'a Network,
    critic: &'a Network,
    actor_weights: &'a [Weights],
    critic_weights: &'a [Vec<Weights>],
    target_weights: &'a [Vec<Weights>],
    values: Values<'a>,
}

/// A thread's transitions, feature by feature. The padding up to whole vectors weighs nothing.
struct Worker {
    /// Its transitions in the minibatch.
    rows: Range<usize>,
    /// R: their number, padded.
    padded: usize,
    /// `[observation + action, R]`: (s, a) of the minibatch, then (s, a ~ π(s)).
    now: Buffer<f32>,
    /// `[observation + action, R]`: (s', a' ~ π(s')).
    next: Buffer<f32>,
    /// `[action, R]`.
    noise: Buffer<f32>,
    /// `[R]` each.
    beta: Buffer<f32>,
    log_prob: Buffer<f32>,
    value: Buffer<f32>,
    /// Transitions whose smallest Q a critic has answered for.
    taken: Vec<bool>,
    share: Buffer<f32>,
    /// `[action, R]`: the gradient of the actor's loss by the actions, as far as it goes through the critics.
    action_gradient: Buffer<f32>,
    /// Rows as they come, padded.
    staging: Buffer<f32>,
    actor: Trace,
    critics: Vec<Trace>,
    actor_gradient: Buffer<f32>,
    critics_gradient: Buffer<f32>,
    /// |Q − y| of each transition, mean over the critics.
    td_errors: Vec<f32>,
    phase: Phase,
}

impl Worker {
    fn new(
        rows: Range<usize>,
        actor: &Network,
        critic: &Network,
        critics: usize,
        memory: &mut Memory,
    ) -> Self {
        let padded = rows.len().next_multiple_of(LANES);
        let action = critic.inputs - actor.inputs;
        Self {
            padded,
            now: memory.zeros(critic.inputs * padded),
            next: memory.zeros(critic.inputs * padded),
            noise: memory.zeros(action * padded),
            beta: memory.zeros(padded),
            log_prob: memory.zeros(padded),
            value: memory.zeros(padded),
            taken: vec![false; rows.len()],
            share: memory.zeros(padded),
            action_gradient: memory.zeros(action * padded),
            staging: memory.zeros(critic.inputs * padded),
            actor: Trace::new(actor, padded, memory),
            critics: (0..critics).map(|_| Trace::new(critic, padded, memory)).collect(),
            actor_gradient: memory.zeros(actor.length),
            critics_gradient: memory.zeros(critics * critic.length),
            td_errors: vec![0.0; rows.len()],
            phase: Phase::default(),
            rows,
        }
    }

    fn critics_backward(&mut self, networks: &Networks<'_>, inputs: &Inputs<'_>) {
        let Networks { actor, critic, .. } = networks;
        let (rows, padded, batch) = (self.rows.clone(), self.padded, inputs.batch);
        let (observation, action) = (actor.inputs, critic.inputs - actor.inputs);
        let split = observation * padded;
        let staging = &mut self.staging;
        let mut load = |from: &[f32], width: usize, to: &mut [f32]| {
            staging[..rows.len() * width].copy_from_slice(&from[rows.start * width..rows.end * width]);
            staging[rows.len() * width..padded * width].fill(0.0);
            let words: &[u32] = bytemuck::cast_slice(&staging[..padded * width]);
            layout::transpose(words, padded, width, bytemuck::cast_slice_mut(to), padded);
        };
        load(&batch.observation, observation, &mut self.now[..split]);
        load(&batch.action, action, &mut self.now[split..]);
        load(&batch.next_observation, observation, &mut self.next[..split]);
        if let Some(ObservationStatistics { mean, std, clip }) = inputs.statistics {
            kernels::normalize(&mut self.now[..split], padded, mean, std, *clip);
            kernels::normalize(&mut self.next[..split], padded, mean, std, *clip);
        }
        load(inputs.next_noise, action, &mut self.noise);
        self.beta.fill(1.0);
        self.beta[..rows.len()].copy_from_slice(&batch.beta[rows.clone()]);

        let (observations, actions) = self.next.split_at_mut(split);
        actor.forward(networks.values.actor, networks.actor_weights, observations, &mut self.actor);
        sample(&self.actor, &self.noise, &self.beta, actions, &mut self.log_prob);
        let targets = networks.values.targets.chunks_exact(critic.length).zip(networks.target_weights);
        minimum(critic, targets, &self.next, &mut self.critics, &mut self.value);
        for (row, index) in rows.clone().enumerate() {
            let next = self.value[row] - inputs.temperature * self.log_prob[row];
            self.value[row] = batch.reward[index] + batch.discount[index] * next;
        }

        self.phase = Phase::default();
        self.td_errors.fill(0.0);
        let scale = 1.0 / batch.rows() as f64;
        let share = 1.0 / networks.critic_weights.len() as f32;
        let critics = networks.values.critics.chunks_exact(critic.length).zip(networks.critic_weights);
        let gradients = self.critics_gradient.chunks_exact_mut(critic.length);
        for (((values, weights), gradient), trace) in critics.zip(gradients).zip(&mut self.critics) {
            critic.forward(values, weights, &self.now, trace);
            trace.output_gradients[0].fill(0.0);
            for (row, index) in rows.clone().enumerate() {
                let q = trace.outputs[0][row];
                let error = q - self.value[row];
                let weighted = batch.weight(index) * error;
                trace.output_gradients[0][row] = 2.0 * weighted * scale as f32;
                self.td_errors[row] += share * error.abs();
                self.phase.loss += f64::from(weighted) * f64::from(error) * scale;
                self.phase.value += f64::from(q) * scale / networks.critic_weights.len() as f64;
            }
            critic.backward(values, weights, trace, Some(gradient), None);
        }
    }

    fn actor_backward(&mut self, networks: &Networks<'_>, inputs: &Inputs<'_>) {
        let Networks { actor, critic, .. } = networks;
        let (rows, padded) = (self.rows.clone(), self.padded);
        let (observation, action) = (actor.inputs, critic.inputs - actor.inputs);
        let split = observation * padded;
        let noise = &inputs.noise[rows.start * action..rows.end * action];
        self.staging[..noise.len()].copy_from_slice(noise);
        self.staging[noise.len()..action * padded].fill(0.0);
        let words: &[u32] = bytemuck::cast_slice(&self.staging[..action * padded]);
        layout::transpose(words, padded, action, bytemuck::cast_slice_mut(&mut self.noise), padded);

        let (observations, actions) = self.now.split_at_mut(split);
        actor.forward(networks.values.actor, networks.actor_weights, observations, &mut self.actor);
        sample(&self.actor, &self.noise, &self.beta, actions, &mut self.log_prob);
        let critics = || networks.values.critics.chunks_exact(critic.length).zip(networks.critic_weights);
        minimum(critic, critics(), &self.now, &mut self.critics, &mut self.value);

        let scale = 1.0 / inputs.batch.rows() as f32;
        self.action_gradient.fill(0.0);
        self.taken.fill(false);
        for ((values, weights), trace) in critics().zip(&mut self.critics) {
            trace.output_gradients[0].fill(0.0);
            for (row, taken) in self.taken.iter_mut().enumerate() {
                // The first critic that gives the minimum answers for it.
                if !*taken && trace.outputs[0][row] == self.value[row] {
                    trace.output_gradients[0][row] = -scale;
                    *taken = true;
                }
            }
            critic.backward(values, weights, trace, None, Some((observation, &mut self.action_gradient)));
        }

        self.phase = Phase::default();
        self.share[..rows.len()].fill(inputs.temperature * scale);
        for row in 0..rows.len() {
            let (log_prob, value) = (f64::from(self.log_prob[row]), f64::from(self.value[row]));
            self.phase.loss += (f64::from(inputs.temperature) * log_prob - value) * f64::from(scale);
            self.phase.value -= log_prob * f64::from(scale);
        }
        let Trace { outputs, output_gradients, .. } = &mut self.actor;
        let [mean_gradient, log_std_gradient] = &mut output_gradients[..] else {
            unreachable!("an actor has two heads")
        };
        for index in 0..action {
            let part = index * padded..(index + 1) * padded;
            kernels::sample_gradient(
                &motor(outputs, &self.noise, &self.beta, part.clone()),
                &self.action_gradient[part.clone()],
                &self.share,
                &mut mean_gradient[part.clone()],
                &mut log_std_gradient[part],
            );
        }
        let gradient = Some(&mut self.actor_gradient[..]);
        actor.backward(networks.values.actor, networks.actor_weights, &mut self.actor, gradient, None);
    }
}

fn motor<'a>(outputs: &'a [Buffer<f32>], noise: &'a [f32], beta: &'a [f32], part: Range<usize>) -> Motor<'a> {
    Motor {
        mean: &outputs[0][part.clone()],
        raw_log_std: &outputs[1][part.clone()],
        noise: &noise[part],
        beta,
    }
}

/// Actions, `[action, R]`, and their log-probabilities, `[R]`, from an actor's pass.
fn sample(trace: &Trace, noise: &[f32], beta: &[f32], actions: &mut [f32], log_prob: &mut [f32]) {
    let motors = actions.len() / beta.len();
    for (log_prob, beta) in log_prob.iter_mut().zip(beta) {
        *log_prob = -(motors as f32) * beta.ln();
    }
    for (index, action) in actions.chunks_exact_mut(beta.len()).enumerate() {
        let part = index * beta.len()..(index + 1) * beta.len();
        kernels::sample(&motor(&trace.outputs, noise, beta, part), action, log_prob);
    }
}

/// Evaluates every critic; `value`, `[R]`, receives the minimum.
fn minimum<'a>(
    critic: &Network,
    critics: impl Iterator<Item = (&'a [f32], &'a Vec<Weights>)>,
    input: &[f32],
    traces: &mut [Trace],
    value: &mut [f32],
) {
    for (index, ((values, weights), trace)) in critics.zip(traces).enumerate() {
        critic.forward(values, weights, input, trace);
        for (value, q) in value.iter_mut().zip(&trace.outputs[0][..]) {
            // NaN counts as the minimum, so that it is noticed.
            *value = if index > 0 && (value.is_nan() || *q >= *value) { *value } else { *q };
        }
    }
}
