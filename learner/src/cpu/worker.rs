//! One thread's share of an update: its transitions forward and back through every network.

use std::ops::Range;

use getup_policy::ObservationStatistics;

use super::factors::Purpose;
use super::kernels::{self, Motor};
use super::layout::LANES;
use super::memory::{Buffer, Memory};
use super::network::Network;
use super::trace::{Scratch, Trace};
use super::transpose;
use super::update::{Inputs, Phase, Values};
use super::weights::Weights;

/// The networks as every worker reads them.
pub(super) struct Networks<'a> {
    pub(super) actor: &'a Network,
    pub(super) critic: &'a Network,
    pub(super) actor_weights: &'a [Weights],
    /// A list for each critic.
    pub(super) critic_weights: &'a [Vec<Weights>],
    pub(super) target_weights: &'a [Vec<Weights>],
    pub(super) values: Values<'a>,
}

/// A thread's transitions, feature by feature. The padding up to whole vectors weighs nothing.
pub(super) struct Worker {
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
    pub(super) actor: Trace,
    pub(super) critics: Vec<Trace>,
    pub(super) scratch: Scratch,
    /// Of biases and norms, where they lie among the parameters; the rest serves only [`super::update::CpuUpdate::multiply`].
    pub(super) actor_gradient: Buffer<f32>,
    pub(super) critics_gradient: Buffer<f32>,
    /// |Q − y| of each transition, mean over the critics.
    pub(super) td_errors: Vec<f32>,
    pub(super) phase: Phase,
}

impl Worker {
    pub(super) fn new(
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
            scratch: Scratch::new([actor, critic], padded, memory),
            actor_gradient: memory.zeros(actor.length),
            critics_gradient: memory.zeros(critics * critic.length),
            td_errors: vec![0.0; rows.len()],
            phase: Phase::default(),
            rows,
        }
    }

    /// The critics' losses and gradients: see [`super::CpuUpdate`].
    pub(super) fn critics_backward(&mut self, networks: &Networks<'_>, inputs: &Inputs<'_>) {
        let Networks { actor, critic, .. } = networks;
        let (rows, padded, batch) = (self.rows.clone(), self.padded, inputs.batch);
        let (observation, action) = (actor.inputs, critic.inputs - actor.inputs);
        let split = observation * padded;
        let staging = &mut self.staging;
        let mut load = |from: &[f32], width: usize, to: &mut [f32]| {
            staging[..rows.len() * width].copy_from_slice(&from[rows.start * width..rows.end * width]);
            staging[rows.len() * width..padded * width].fill(0.0);
            let words: &[u32] = bytemuck::cast_slice(&staging[..padded * width]);
            transpose::transpose(words, padded, width, bytemuck::cast_slice_mut(to), padded);
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
        let (trace, scratch) = (&mut self.actor, &mut self.scratch);
        let (values, weights) = (networks.values.actor, networks.actor_weights);
        actor.forward(values, weights, observations, trace, scratch, Purpose::Results);
        sample(&self.actor, &self.noise, &self.beta, actions, &mut self.log_prob);
        let targets = networks.values.targets.chunks_exact(critic.length).zip(networks.target_weights);
        minimum(critic, targets, &self.next, (&mut self.critics, scratch), Purpose::Results, &mut self.value);
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
            critic.forward(values, weights, &self.now, trace, scratch, Purpose::Learning);
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
            critic.backward(values, weights, trace, scratch, Some(gradient), None);
        }
    }

    /// The actor's loss and gradient, on the transitions of the last [`Worker::critics_backward`].
    pub(super) fn actor_backward(&mut self, networks: &Networks<'_>, inputs: &Inputs<'_>) {
        let Networks { actor, critic, .. } = networks;
        let (rows, padded) = (self.rows.clone(), self.padded);
        let (observation, action) = (actor.inputs, critic.inputs - actor.inputs);
        let split = observation * padded;
        let noise = &inputs.noise[rows.start * action..rows.end * action];
        self.staging[..noise.len()].copy_from_slice(noise);
        self.staging[noise.len()..action * padded].fill(0.0);
        let words: &[u32] = bytemuck::cast_slice(&self.staging[..action * padded]);
        transpose::transpose(words, padded, action, bytemuck::cast_slice_mut(&mut self.noise), padded);

        let (observations, actions) = self.now.split_at_mut(split);
        let (trace, scratch) = (&mut self.actor, &mut self.scratch);
        let (values, weights) = (networks.values.actor, networks.actor_weights);
        actor.forward(values, weights, observations, trace, scratch, Purpose::Learning);
        sample(&self.actor, &self.noise, &self.beta, actions, &mut self.log_prob);
        let critics = || networks.values.critics.chunks_exact(critic.length).zip(networks.critic_weights);
        let traces = (&mut self.critics[..], &mut *scratch);
        minimum(critic, critics(), &self.now, traces, Purpose::InputGradient, &mut self.value);

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
            let actions = Some((observation, &mut self.action_gradient[..]));
            critic.backward(values, weights, trace, scratch, None, actions);
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
        let (values, weights) = (networks.values.actor, networks.actor_weights);
        actor.backward(values, weights, &mut self.actor, scratch, gradient, None);
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
    (traces, scratch): (&mut [Trace], &mut Scratch),
    purpose: Purpose,
    value: &mut [f32],
) {
    for (index, ((values, weights), trace)) in critics.zip(traces).enumerate() {
        critic.forward(values, weights, input, trace, scratch, purpose);
        for (value, q) in value.iter_mut().zip(&trace.outputs[0][..]) {
            // NaN counts as the minimum, so that it is noticed.
            *value = if index > 0 && (value.is_nan() || *q >= *value) { *value } else { *q };
        }
    }
}
