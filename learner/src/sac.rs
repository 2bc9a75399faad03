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
use crate::networks::{Actor, Critics};
use crate::parameters::to_vec;
use crate::statistics::RunningStatistics;

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

/// `B` transitions, float32 on the host.
#[derive(Debug)]
pub struct Batch {
    /// `[B, observation]`.
    pub observation: Tensor,
    /// `[B, action]`, in `[-β̂, β̂]`.
    pub action: Tensor,
    /// `[B]`: Σ γ^k r over the n steps.
    pub reward: Tensor,
    /// `[B, observation]`: the state after the n steps.
    pub next_observation: Tensor,
    /// `[B]`: γ^n, and 0 where a terminal state was reached.
    pub discount: Tensor,
    /// `[B, 1]`: the episode's β̂.
    pub beta: Tensor,
}

/// What one update found, for metrics.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// Mean squared error of the critics, summed over them.
    pub critic: f64,
    /// Mean of α·log π − Q.
    pub actor: f64,
    /// α after the update.
    pub temperature: f64,
    /// Mean of −log π, in nats.
    pub entropy: f64,
    /// Mean Q of the batch's own actions.
    pub q: f64,
}

/// A loss that is not a number any more. The networks are those of before the update that found it, or differ
/// from them by finite steps: the last checkpoint is good.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "the {name} loss is {value} at update {update}; lower its learning rate, or resume the last checkpoint"
)]
pub struct NonFiniteLoss {
    /// Which loss.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// Updates before this one.
    pub update: u64,
}

/// The learner's networks with everything that training them needs.
pub struct Sac {
    pub(crate) config: SacConfig,
    target_entropy: f64,
    device: Device,
    pub(crate) actor: Actor,
    pub(crate) actor_adam: Adam,
    pub(crate) critics: Critics,
    pub(crate) critics_adam: Adam,
    pub(crate) targets: Critics,
    pub(crate) log_temperature: f64,
    pub(crate) temperature_adam: ScalarAdam,
    pub(crate) statistics: RunningStatistics,
    pub(crate) rng: ChaCha8Rng,
    pub(crate) updates: u64,
}

impl Sac {
    /// Untrained networks, drawn from `seed`.
    pub fn new(shape: &TaskShape, config: &SacConfig, seed: u64, device: Device) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let products = config.precision.kind(device);
        let policy = Policy::init(config.policy_shape(shape.observation, shape.action), &mut rng);
        let critics = Critics::new(config.critics, &policy.shape, &mut rng, products, device);
        let actor = Actor::new(&policy, products, device);
        Self {
            target_entropy: config.target_entropy.nats(shape.action),
            device,
            actor_adam: Adam::new(&actor.parameters, config.actor_lr),
            critics_adam: Adam::new(&critics.parameters, config.critic_lr),
            targets: critics.duplicate(),
            log_temperature: config.initial_temperature.ln(),
            temperature_adam: ScalarAdam::new(config.temperature_lr),
            statistics: RunningStatistics::new(shape.observation, shape.unnormalized.clone()),
            config: config.clone(),
            actor,
            critics,
            rng,
            updates: 0,
        }
    }

    /// Updates made so far.
    pub fn updates(&self) -> u64 {
        self.updates
    }

    /// Merges a batch's observations into the statistics that normalise them, where the run normalises.
    pub fn merge_statistics(&mut self, batch: &Batch) {
        if self.config.normalize_observations {
            self.statistics.merge(&to_vec(&batch.observation));
        }
    }

    /// One update of critics, actor, temperature and targets.
    pub fn update(&mut self, batch: &Batch) -> Result<Losses, NonFiniteLoss> {
        let size = batch.action.size();
        let next_noise = self.noise(&size);
        let noise = self.noise(&size);
        self.update_with_noise(batch, &next_noise, &noise)
    }

    /// [`Sac::update`] with the standard normal draws of the next actions and of the actions, `[B, action]` each.
    pub(crate) fn update_with_noise(
        &mut self,
        batch: &Batch,
        next_noise: &Tensor,
        noise: &Tensor,
    ) -> Result<Losses, NonFiniteLoss> {
        let to = |tensor: &Tensor| tensor.to_device(self.device);
        let (action, beta) = (to(&batch.action), to(&batch.beta));
        let (reward, discount) = (to(&batch.reward), to(&batch.discount));
        let observation = self.normalize(&to(&batch.observation));
        let next_observation = self.normalize(&to(&batch.next_observation));
        let temperature = self.log_temperature.exp();

        // y = r + γ (min Q'(s', a') − α log π(a'|s')), a' ~ π(s')
        let target = tch::no_grad(|| {
            let next = self.actor.forward(&next_observation).sample(&beta, next_noise);
            let next_q = self.targets.minimum(&next_observation, &next.action);
            reward + discount * (next_q - next.log_prob * temperature)
        });

        // Σ over critics of mean (Q − y)²
        let q = self.critics.forward(&observation, &action);
        let critic_loss = (&q - target).square().mean_dim(&[1i64][..], false, Kind::Float).sum(Kind::Float);
        let critic = self.finite("critic", &critic_loss)?;
        let mut gradient = self.critics.parameters.gradient(&critic_loss);
        self.critics_adam.step(&mut self.critics.parameters, &mut gradient);

        // mean (α log π(a|s) − min Q(s, a)), a ~ π(s)
        let sample = self.actor.forward(&observation).sample(&beta, noise);
        let value = self.critics.minimum(&observation, &sample.action);
        let actor_loss = (&sample.log_prob * temperature - value).mean(Kind::Float);
        let actor = self.finite("actor", &actor_loss)?;
        let mut gradient = self.actor.parameters.gradient(&actor_loss);
        self.actor_adam.step(&mut self.actor.parameters, &mut gradient);

        // mean α (−log π − H̄), by log α
        let entropy = -sample.log_prob.mean(Kind::Float).double_value(&[]);
        let gradient = temperature * (entropy - self.target_entropy);
        self.log_temperature = self.temperature_adam.step(self.log_temperature, gradient);

        polyak(&mut self.targets.parameters, &self.critics.parameters, self.config.tau);
        self.updates += 1;
        let q = q.mean(Kind::Float).double_value(&[]);
        Ok(Losses { critic, actor, temperature: self.log_temperature.exp(), entropy, q })
    }

    /// The actor as it is now, with the statistics that its observations are normalised by.
    pub fn policy(&self) -> Policy {
        let values = self.actor.parameters.to_values().into_iter();
        Policy {
            shape: self.actor.shape.clone(),
            tensors: values.map(|(name, _, values)| (name, values)).collect(),
            statistics: self.config.normalize_observations.then(|| self.statistics.snapshot()),
            metadata: Default::default(),
        }
    }

    fn noise(&mut self, size: &[i64]) -> Tensor {
        let count = size.iter().product::<i64>() as usize;
        let values: Vec<f32> = (0..count).map(|_| self.rng.sample(StandardNormal)).collect();
        Tensor::from_slice(&values).view(size).to_device(self.device)
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

    fn finite(&self, name: &'static str, loss: &Tensor) -> Result<f64, NonFiniteLoss> {
        let value = loss.double_value(&[]);
        if value.is_finite() { Ok(value) } else { Err(NonFiniteLoss { name, value, update: self.updates }) }
    }
}

#[cfg(test)]
mod tests;
