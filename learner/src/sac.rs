//! Soft actor-critic (Haarnoja et al. 2018) as *Learning to Get Up* runs it (App. D, Table 1).
//!
//! [`Sac::update`] reads top to bottom like the paper: target, critic loss, actor loss, temperature loss, Polyak.

use getup_policy::Policy;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use tch::{Device, Kind, Tensor};

use crate::adam::{Adam, ScalarAdam, polyak};
use crate::config::SacConfig;
use crate::cpu::{CpuUpdate, Flat, Inputs, Values};
use crate::networks::{Actor, Critics};
use crate::parameters::{as_slice_mut, to_vec};
use crate::statistics::RunningStatistics;

mod policies;
mod reports;

pub use policies::ActorMismatch;
use reports::{Lap, PolicyLoss};
pub use reports::{Losses, NonFiniteLoss, Norms, Phases};

/// What SAC must know of the task.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TaskShape {
    /// Numbers in an observation.
    pub observation: usize,
    /// Numbers in an action.
    pub action: usize,
    /// Observed numbers that are never normalised, by index: β̂.
    pub unnormalized: Vec<usize>,
}

/// `B` transitions, row after row, on the host.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    /// `[B, observation]`.
    pub observation: Vec<f32>,
    /// `[B, action]`, in `[-β̂, β̂]`.
    pub action: Vec<f32>,
    /// `[B]`: Σ γ^k r over the n steps.
    pub reward: Vec<f32>,
    /// `[B, observation]`: the state after the n steps.
    pub next_observation: Vec<f32>,
    /// `[B]`: γ^n, and 0 where a terminal state was reached.
    pub discount: Vec<f32>,
    /// `[B]`: the episode's β̂.
    pub beta: Vec<f32>,
    /// `[B]`: what each transition's error counts for in the critics' losses; empty where all count alike.
    pub weight: Vec<f32>,
}

impl Batch {
    /// B.
    pub fn rows(&self) -> usize {
        self.reward.len()
    }

    /// Of one transition's error.
    pub(crate) fn weight(&self, row: usize) -> f32 {
        self.weight.get(row).copied().unwrap_or(1.0)
    }
}

/// The learner's networks with everything that training them needs.
pub struct Sac {
    pub(crate) config: SacConfig,
    target_entropy: f64,
    device: Device,
    threads: usize,
    pub(crate) actor: Actor,
    pub(crate) actor_adam: Adam,
    /// `[n]`: the average of the actor's weights over its updates, where the run evaluates that.
    pub(crate) average: Option<Tensor>,
    pub(crate) critics: Critics,
    pub(crate) critics_adam: Adam,
    pub(crate) targets: Critics,
    pub(crate) log_temperature: f64,
    pub(crate) temperature_adam: ScalarAdam,
    pub(crate) statistics: RunningStatistics,
    pub(crate) rng: ChaCha8Rng,
    pub(crate) updates: u64,
    /// Whether the actor is another run's.
    pub(crate) began_trained: bool,
    /// See [`Sac::td_errors`].
    td_errors: Vec<f32>,
    /// Of the actor's last update.
    policy: PolicyLoss,
    /// See [`Sac::phases`].
    phases: Phases,
    /// `[n]` each, of the last update by autograd: of the critics, of the actor.
    gradients: [Option<Tensor>; 2],
    /// The update for processors, laid out at the first one; see [`Sac::changed`].
    cpu: OnCpu,
}

/// Whether there is an update for this processor.
enum OnCpu {
    /// Not asked since the parameters were changed from outside.
    Unknown,
    /// Laid out.
    Ready(Box<CpuUpdate>),
    /// None: another device, or a processor without the products.
    Absent,
}

impl Sac {
    /// Untrained networks, drawn from `seed`, updated by `threads` threads on a processor.
    pub fn new(shape: &TaskShape, config: &SacConfig, seed: u64, device: Device, threads: usize) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let products = config.precision.kind(device);
        let policy = Policy::init(config.policy_shape(shape.observation, shape.action), &mut rng);
        let inputs = shape.observation + shape.action;
        let critics = Critics::new(config.critics, config.critic_body(), inputs, &mut rng, products, device);
        let actor = Actor::new(&policy, products, device);
        Self {
            target_entropy: config.target_entropy.nats(shape.action),
            device,
            threads,
            actor_adam: Adam::new(&actor.parameters, config.actor_lr, config.weight_decay),
            critics_adam: Adam::new(&critics.parameters, config.critic_lr, config.weight_decay),
            targets: critics.duplicate(),
            log_temperature: config.initial_temperature.ln(),
            temperature_adam: ScalarAdam::new(config.temperature_lr),
            statistics: RunningStatistics::new(shape.observation, shape.unnormalized.clone()),
            config: config.clone(),
            average: (config.actor_average > 0.0).then(|| actor.parameters.flat().copy()),
            actor,
            critics,
            rng,
            updates: 0,
            began_trained: false,
            td_errors: Vec::new(),
            policy: PolicyLoss::NONE,
            phases: Phases::default(),
            gradients: [None, None],
            cpu: OnCpu::Unknown,
        }
    }

    /// The parameters were changed from outside: whatever was derived from them is made again.
    pub(crate) fn changed(&mut self) {
        self.average = self.average.take().map(|_| self.actor.parameters.flat().copy());
        self.cpu = OnCpu::Unknown;
    }

    /// Updates made so far.
    pub fn updates(&self) -> u64 {
        self.updates
    }

    /// Whether any update was made, by this run or by the one whose networks it begins with.
    pub fn is_trained(&self) -> bool {
        // Checkpoints from before `began_trained` count its actor's steps.
        self.updates > 0 || self.began_trained || self.actor_adam.steps > 0
    }

    /// Sets the learning rates of actor and critics for `env_steps` of the run.
    pub fn anneal(&mut self, env_steps: u64) {
        let scale = self.config.lr_scale(env_steps);
        self.actor_adam.learning_rate = self.config.actor_lr * scale;
        self.critics_adam.learning_rate = self.config.critic_lr * scale;
    }

    /// Merges a batch's observations into the statistics that normalise them, where the run normalises.
    pub fn merge_statistics(&mut self, batch: &Batch) {
        if self.config.normalize_observations {
            self.statistics.merge(&batch.observation);
        }
    }

    /// `[B]`: |Q − y| of the last update's transitions, mean over the critics: their priorities.
    pub fn td_errors(&self) -> &[f32] {
        &self.td_errors
    }

    /// Where the time of all updates went.
    pub fn phases(&self) -> Phases {
        self.phases
    }

    /// Norms of weights and gradients as they are now.
    pub fn norms(&self) -> Norms {
        let norm = |tensor: &Tensor| tensor.norm().double_value(&[]);
        let [critics, actor] = match &self.cpu {
            OnCpu::Ready(cpu) => cpu.gradient_norms(),
            _ => self.gradients.each_ref().map(|gradient| gradient.as_ref().map_or(0.0, norm)),
        };
        Norms {
            actor: [norm(self.actor.parameters.flat()), actor],
            critics: [norm(self.critics.parameters.flat()), critics],
        }
    }

    /// One update of critics, actor, temperature and targets.
    pub fn update(&mut self, batch: &Batch) -> Result<Losses, NonFiniteLoss> {
        let (count, learns) = (batch.action.len(), self.actor_learns());
        let mut draw = |count| (0..count).map(|_| self.rng.sample(StandardNormal)).collect::<Vec<f32>>();
        let (next_noise, noise) = (draw(count), draw(if learns { count } else { 0 }));
        self.update_with_noise(batch, &next_noise, &noise)
    }

    /// [`Sac::update`] with the standard normal draws of the next actions and of the actions, `[B, action]` each; the latter
    /// are looked at where the actor learns.
    pub(crate) fn update_with_noise(
        &mut self,
        batch: &Batch,
        next_noise: &[f32],
        noise: &[f32],
    ) -> Result<Losses, NonFiniteLoss> {
        self.lay_out();
        match std::mem::replace(&mut self.cpu, OnCpu::Absent) {
            OnCpu::Ready(mut cpu) => {
                let losses = self.update_on_cpu(&mut cpu, batch, next_noise, noise);
                self.cpu = OnCpu::Ready(cpu);
                losses
            }
            OnCpu::Unknown | OnCpu::Absent => self.update_by_autograd(batch, next_noise, noise),
        }
    }

    /// The update as the paper's equations: for every device, and what the faster one is tested against.
    pub(crate) fn update_by_autograd(
        &mut self,
        batch: &Batch,
        next_noise: &[f32],
        noise: &[f32],
    ) -> Result<Losses, NonFiniteLoss> {
        let mut lap = Lap::start();
        let rows = batch.rows() as i64;
        let matrix = |values: &[f32]| Tensor::from_slice(values).view([rows, -1]).to_device(self.device);
        let column = |values: &[f32]| Tensor::from_slice(values).to_device(self.device);
        let (action, beta) = (matrix(&batch.action), matrix(&batch.beta));
        let (reward, discount) = (column(&batch.reward), column(&batch.discount));
        let next_noise = matrix(next_noise);
        let observation = self.normalize(&matrix(&batch.observation));
        let next_observation = self.normalize(&matrix(&batch.next_observation));
        let temperature = self.log_temperature.exp();

        // y = r + γ (min Q'(s', a') − α log π(a'|s')), a' ~ π(s')
        let target = tch::no_grad(|| {
            let next = self.actor.forward(&next_observation).sample(&beta, &next_noise);
            let next_q = self.targets.minimum(&next_observation, &next.action);
            reward + discount * (next_q - next.log_prob * temperature)
        });

        // Σ over critics of mean w (Q − y)²
        let q = self.critics.forward(&observation, &action);
        let error = &q - target;
        let weights: Vec<f32> = (0..batch.rows()).map(|row| batch.weight(row)).collect();
        let squares = error.square() * column(&weights);
        let critic_loss = squares.mean_dim(&[1i64][..], false, Kind::Float).sum(Kind::Float);
        let errors = error.abs().mean_dim(&[0i64][..], false, Kind::Float).to_device(Device::Cpu);
        self.td_errors = Vec::try_from(&errors).expect("errors are numbers");
        let critics_gradient = self.critics.parameters.gradient(&critic_loss);
        let [critic, norm] = numbers([&critic_loss, &critics_gradient.norm()]);
        self.finite("critic loss", critic)?;
        self.finite("critic gradient", norm)?;
        lap.add_to(&mut self.phases.critics);
        self.critics_adam.step(&mut self.critics.parameters, &critics_gradient);
        lap.add_to(&mut self.phases.optimizer);

        self.gradients[0] = Some(critics_gradient);

        if self.actor_learns() {
            // mean (α log π(a|s) − min Q(s, a)), a ~ π(s)
            let sample = self.actor.forward(&observation).sample(&beta, &matrix(noise));
            let value = self.critics.minimum(&observation, &sample.action);
            let loss = (&sample.log_prob * temperature - value).mean(Kind::Float);
            let gradient = self.actor.parameters.gradient(&loss);
            let [actor, norm] = numbers([&loss, &gradient.norm()]);
            self.finite("actor loss", actor)?;
            self.finite("actor gradient", norm)?;
            lap.add_to(&mut self.phases.actor);
            self.actor_adam.step(&mut self.actor.parameters, &gradient);
            self.gradients[1] = Some(gradient);
            self.actor_learned(actor, -sample.log_prob.mean(Kind::Float).double_value(&[]));
        }

        polyak(&mut self.targets.parameters, &self.critics.parameters, self.config.tau);
        let q = q.mean(Kind::Float).double_value(&[]);
        lap.add_to(&mut self.phases.optimizer);
        Ok(self.end_update(critic, q))
    }

    /// The same, written out: see [`crate::cpu`].
    fn update_on_cpu(
        &mut self,
        cpu: &mut CpuUpdate,
        batch: &Batch,
        next_noise: &[f32],
        noise: &[f32],
    ) -> Result<Losses, NonFiniteLoss> {
        let mut lap = Lap::start();
        let statistics = self.config.normalize_observations.then(|| self.statistics.snapshot());
        let [mut actor, mut critics, mut targets] =
            [&self.actor.parameters, &self.critics.parameters, &self.targets.parameters]
                .map(|parameters| parameters.flat().shallow_clone());
        let (actor, critics) = (as_slice_mut(&mut actor), as_slice_mut(&mut critics));
        let targets = as_slice_mut(&mut targets);
        let temperature = self.log_temperature.exp() as f32;
        let inputs = Inputs { batch, statistics: statistics.as_ref(), next_noise, noise, temperature };

        let critic = cpu.critics_backward(&inputs, Values { actor, critics, targets });
        let critic_loss = self.finite("critic loss", critic.loss)?;
        cpu.td_errors(&mut self.td_errors);
        lap.add_to(&mut self.phases.critics);
        let step = self.critics_adam.begin_step();
        let (first, second) = self.critics_adam.moments();
        cpu.critics_step(Flat { values: critics, first, second }, targets, step, self.config.tau as f32);
        self.finite("critic gradient", cpu.gradient_norms()[0])?;

        lap.add_to(&mut self.phases.optimizer);
        if self.actor_learns() {
            let policy = cpu.actor_backward(&inputs, Values { actor, critics, targets });
            let loss = self.finite("actor loss", policy.loss)?;
            lap.add_to(&mut self.phases.actor);
            let step = self.actor_adam.begin_step();
            let (first, second) = self.actor_adam.moments();
            cpu.actor_step(Flat { values: actor, first, second }, step);
            self.finite("actor gradient", cpu.gradient_norms()[1])?;
            self.actor_learned(loss, policy.value);
            lap.add_to(&mut self.phases.optimizer);
        }
        Ok(self.end_update(critic_loss, critic.value))
    }

    /// Whether the actor learns by the next update: the critics have had theirs alone, and it is the actor's turn.
    fn actor_learns(&self) -> bool {
        let SacConfig { critics_first, policy_delay, .. } = self.config;
        self.updates >= critics_first && self.updates.is_multiple_of(policy_delay)
    }

    /// What follows a step of the actor: its average, and the temperature's step along the gradient of mean α (−log π − H̄)
    /// by log α.
    fn actor_learned(&mut self, loss: f64, entropy: f64) {
        self.policy = PolicyLoss { actor: loss, entropy };
        if let Some(average) = &mut self.average {
            let _ = tch::no_grad(|| average.lerp_(self.actor.parameters.flat(), self.config.actor_average));
        }
        let gradient = self.log_temperature.exp() * (entropy - self.target_entropy);
        let floor = self.config.temperature_floor.ln();
        self.log_temperature = self.temperature_adam.step(self.log_temperature, gradient).max(floor);
    }

    /// Counts an update.
    fn end_update(&mut self, critic: f64, q: f64) -> Losses {
        self.updates += 1;
        let PolicyLoss { actor, entropy } = self.policy;
        Losses { critic, actor, temperature: self.log_temperature.exp(), entropy, q }
    }

    /// The matrix products of one update on `rows` transitions, at its shapes and in its precision, and nothing else:
    /// what a benchmark holds [`Sac::update`] against. False where the update goes through autograd.
    pub fn multiply(&mut self, rows: usize) -> bool {
        self.lay_out();
        match &mut self.cpu {
            OnCpu::Ready(cpu) => {
                cpu.multiply(rows);
                true
            }
            OnCpu::Unknown | OnCpu::Absent => false,
        }
    }

    /// Lays out the update for processors, where that was not tried yet.
    fn lay_out(&mut self) {
        if !matches!(self.cpu, OnCpu::Unknown) {
            return;
        }
        if self.device != Device::Cpu {
            self.cpu = OnCpu::Absent;
            return;
        }
        let [actor, critics, targets] =
            [&self.actor.parameters, &self.critics.parameters, &self.targets.parameters]
                .map(|parameters| to_vec(parameters.flat()));
        let values = Values { actor: &actor, critics: &critics, targets: &targets };
        let bf16 = self.config.precision.is_bf16();
        let update = CpuUpdate::new(&self.actor.shape, &self.critics.body, bf16, self.threads, values);
        let precision = if bf16 { "bfloat16" } else { "float32" };
        match &update {
            Some(_) => tracing::info!("updates multiply in {precision}"),
            None => tracing::warn!(
                "libtorch has no {precision} products for this processor: updates go through autograd, many times slower; \
                 sac.precision = \"auto\" multiplies in what there is"
            ),
        }
        self.cpu = update.map_or(OnCpu::Absent, |update| OnCpu::Ready(Box::new(update)));
    }

    fn normalize(&self, observation: &Tensor) -> Tensor {
        if !self.config.normalize_observations {
            return observation.shallow_clone();
        }
        let statistics = self.statistics.snapshot();
        let row = |values: &[f32]| Tensor::from_slice(values).to_device(self.device);
        let clip = f64::from(statistics.clip);
        ((observation - row(&statistics.mean)) / row(&statistics.std)).clamp(-clip, clip)
    }

    fn finite(&self, name: &'static str, value: f64) -> Result<f64, NonFiniteLoss> {
        if value.is_finite() { Ok(value) } else { Err(NonFiniteLoss { name, value, update: self.updates }) }
    }
}

/// Single numbers of a device, brought here at once.
fn numbers<const N: usize>(tensors: [&Tensor; N]) -> [f64; N] {
    let together = Tensor::stack(&tensors, 0).to_device(Device::Cpu);
    std::array::from_fn(|index| together.double_value(&[index as i64]))
}

#[cfg(test)]
mod tests;
