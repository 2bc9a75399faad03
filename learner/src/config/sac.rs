//! How soft actor-critic learns: the `[sac]` table.

use documented::DocumentedFieldsOpt;
use getup_policy::{Body, PolicyShape};
use getup_proto::MAX_MESSAGE_BYTES;
use serde::{Deserialize, Serialize};

use super::{ConfigError, check};

/// Soft actor-critic (App. D, Table 1).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, DocumentedFieldsOpt)]
#[serde(default, deny_unknown_fields)]
pub struct SacConfig {
    /// What the networks are made of: `mlp`, or `simba`, residual blocks behind layer norms.
    pub network: NetworkKind,
    /// `mlp`: widths of the hidden layers of the actor and of every critic.
    pub hidden: Vec<usize>,
    /// `simba`: width of the actor's residual stream.
    pub actor_width: usize,
    /// `simba`: the actor's residual blocks.
    pub actor_blocks: usize,
    /// `simba`: width of every critic's residual stream.
    pub critic_width: usize,
    /// `simba`: every critic's residual blocks.
    pub critic_blocks: usize,
    /// Number of critics; the target is the minimum over them.
    pub critics: usize,
    /// Transitions of a minibatch.
    pub batch: usize,
    /// Discount a step, γ.
    pub gamma: f64,
    /// Steps whose rewards are summed before the critic is asked.
    pub n_step: usize,
    /// Share of the new weights in the target critics at every update, τ.
    pub tau: f64,
    /// Adam's learning rate of the actor.
    pub actor_lr: f64,
    /// Adam's learning rate of the critics.
    pub critic_lr: f64,
    /// What the learning rates of actor and critics fall to, as a share of themselves, over `lr_steps`.
    pub lr_final: f64,
    /// Env steps over which they fall, linearly; 0 for constant ones.
    pub lr_steps: u64,
    /// Share of every weight that decays with a step, in units of the learning rate (AdamW); 0 for Adam.
    pub weight_decay: f64,
    /// Adam's learning rate of the temperature's logarithm.
    pub temperature_lr: f64,
    /// The temperature at the start, α.
    pub initial_temperature: f64,
    /// The temperature never goes under it.
    pub temperature_floor: f64,
    /// The entropy that the temperature is steered to, in nats; `auto` is −(numbers in an action).
    pub target_entropy: TargetEntropy,
    /// Where the replay draws by priority: how far the critics' losses make up for it, from 0 to 1 (β of Schaul et al.
    /// 2016, §3.4).
    pub importance_exponent: f64,
    /// Updates for every env step; the rate limiter keeps it.
    pub updates_per_step: f64,
    /// Env steps of uniform actions before the first update; where the run begins with trained networks, of theirs.
    pub uniform_steps: u64,
    /// Transitions that the replay holds before the updates of a trained actor go on: where a run begins with another's
    /// (`--from`), resumes without its replay, or loses it. No more than the run has made, and at most half of `replay.capacity`.
    pub refill_steps: u64,
    /// The actor and the temperature learn by every so many updates, the critics by each (TD3: Fujimoto et al. 2018).
    pub policy_delay: u64,
    /// Updates at the start that leave the actor as it is: for one that begins trained, with critics that do not.
    pub critics_first: u64,
    /// Share of the new weights in an average of the actor's at every update of it; 0 for none. With it, the average is what is
    /// evaluated and kept as a model, while the actor itself goes on exploring: one that sways from update to update is
    /// better on average than at any one.
    pub actor_average: f64,
    /// Precision of the hidden layers' matrix products: `fp32`, `bf16`, or `auto`, whichever this processor multiplies
    /// faster. Weights, heads and losses are always float32.
    pub precision: Precision,
    /// Whether observations are normalised by running statistics: those of the minibatches, in which early env steps count
    /// more than late ones.
    pub normalize_observations: bool,
    /// Env steps after which those statistics no longer change.
    pub normalize_until: u64,
}

/// See [`SacConfig::network`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NetworkKind {
    /// Fully connected layers with a ReLU after each (App. D).
    Mlp,
    /// Residual blocks behind layer norms (SimBa: Lee et al. 2025).
    Simba,
}

/// See [`SacConfig::precision`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// On a processor whichever it multiplies faster, found by multiplying: bfloat16 with AMX and on AMD's processors with
    /// AVX512-BF16, float32 elsewhere. bfloat16 on a GPU.
    Auto,
    /// float32.
    Fp32,
    /// bfloat16, which is slow where the processor does not multiply it faster.
    Bf16,
}

#[cfg(feature = "torch")]
impl Precision {
    /// Whether the products are in bfloat16 on this processor.
    pub(crate) fn is_bf16(self) -> bool {
        match self {
            Self::Fp32 => false,
            Self::Bf16 => true,
            Self::Auto => crate::cpu::bf16_is_faster(),
        }
    }

    pub(crate) fn kind(self, device: tch::Device) -> tch::Kind {
        let bf16 = if device.is_cuda() { self != Self::Fp32 } else { self.is_bf16() };
        if bf16 { tch::Kind::BFloat16 } else { tch::Kind::Float }
    }
}

/// See [`SacConfig::target_entropy`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum TargetEntropy {
    /// In nats.
    Nats(f64),
    /// −(numbers in an action).
    Auto(Auto),
}

/// The word `auto` in a configuration file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Auto {
    /// Chosen by the program.
    Auto,
}

impl TargetEntropy {
    /// The entropy for actions of `width` numbers.
    pub fn nats(self, width: usize) -> f64 {
        match self {
            Self::Nats(nats) => nats,
            Self::Auto(_) => -(width as f64),
        }
    }
}

impl Default for SacConfig {
    fn default() -> Self {
        Self {
            network: NetworkKind::Mlp,
            hidden: vec![1024, 1024],
            actor_width: 128,
            actor_blocks: 1,
            critic_width: 128,
            critic_blocks: 2,
            critics: 2,
            batch: 1024,
            gamma: 0.97,
            n_step: 1,
            tau: 0.005,
            actor_lr: 1e-5,
            critic_lr: 1e-4,
            lr_final: 1.0,
            lr_steps: 0,
            weight_decay: 0.0,
            temperature_lr: 1e-4,
            initial_temperature: 0.1,
            temperature_floor: 0.0,
            target_entropy: TargetEntropy::Auto(Auto::Auto),
            importance_exponent: 0.4,
            updates_per_step: 1.0,
            uniform_steps: 10_000,
            refill_steps: 150_000,
            policy_delay: 1,
            critics_first: 0,
            actor_average: 0.0,
            precision: Precision::Fp32,
            normalize_observations: false,
            normalize_until: 300_000,
        }
    }
}

/// No task has longer observations or actions.
const WIDEST: (usize, usize) = (256, 64);

impl SacConfig {
    /// Refuses settings that cannot train.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let sizes = !self.hidden.is_empty() && self.hidden.iter().all(|width| (1..=16_384).contains(width));
        check(sizes, "sac.hidden", &format!("{:?}", self.hidden), "one or more widths from 1 to 16384")?;
        for (key, width) in [("sac.actor_width", self.actor_width), ("sac.critic_width", self.critic_width)] {
            check((1..=4096).contains(&width), key, &width, "from 1 to 4096")?;
        }
        for (key, blocks) in
            [("sac.actor_blocks", self.actor_blocks), ("sac.critic_blocks", self.critic_blocks)]
        {
            check(blocks <= 64, key, &blocks, "from 0 to 64")?;
        }
        self.check_policy()?;
        check((1..=16).contains(&self.critics), "sac.critics", &self.critics, "from 1 to 16")?;
        check((1..=65_536).contains(&self.batch), "sac.batch", &self.batch, "from 1 to 65536")?;
        check((0.0..1.0).contains(&self.gamma), "sac.gamma", &self.gamma, "at least 0 and under 1")?;
        check((1..=64).contains(&self.n_step), "sac.n_step", &self.n_step, "from 1 to 64")?;
        check(self.tau > 0.0 && self.tau <= 1.0, "sac.tau", &self.tau, "over 0, at most 1")?;
        for (key, rate) in [
            ("sac.actor_lr", self.actor_lr),
            ("sac.critic_lr", self.critic_lr),
            ("sac.temperature_lr", self.temperature_lr),
            ("sac.lr_final", self.lr_final),
            ("sac.weight_decay", self.weight_decay),
            ("sac.actor_average", self.actor_average),
        ] {
            check((0.0..=1.0).contains(&rate), key, &rate, "from 0 to 1")?;
        }
        check((1..=64).contains(&self.policy_delay), "sac.policy_delay", &self.policy_delay, "from 1 to 64")?;
        let alpha = self.initial_temperature;
        check(alpha > 0.0 && alpha.is_finite(), "sac.initial_temperature", &alpha, "over 0")?;
        let floor = self.temperature_floor;
        check(
            (0.0..=alpha).contains(&floor),
            "sac.temperature_floor",
            &floor,
            "from 0 to sac.initial_temperature",
        )?;
        let entropy = self.target_entropy.nats(1);
        check(entropy.is_finite(), "sac.target_entropy", &entropy, "a number of nats, or \"auto\"")?;
        let exponent = self.importance_exponent;
        check((0.0..=1.0).contains(&exponent), "sac.importance_exponent", &exponent, "from 0 to 1")?;
        let rate = self.updates_per_step;
        check(rate > 0.0 && rate <= 100.0, "sac.updates_per_step", &rate, "over 0, at most 100")
    }

    /// Refuses a policy that no actor would take: more layers than a model has, or more bytes than a message.
    fn check_policy(&self) -> Result<(), ConfigError> {
        let key = match self.network {
            NetworkKind::Mlp => "sac.hidden",
            NetworkKind::Simba => "sac.actor_width",
        };
        let shape = self.policy_shape(WIDEST.0, WIDEST.1);
        if let Some(fault) = shape.fault() {
            return check(false, key, &fault, "a policy that its file can hold");
        }
        let numbers: usize = shape.tensors().iter().map(|(_, sizes)| sizes.iter().product::<usize>()).sum();
        // What else an update says takes less than the last megabyte.
        let bytes = numbers * size_of::<f32>() + (1 << 20);
        let value = format!("a policy of {} MB", bytes >> 20);
        check(bytes <= MAX_MESSAGE_BYTES, key, &value, "one that a message to the actors holds, under 64 MB")
    }

    /// Refuses settings under which nothing is learned by networks that begin untrained: minibatches, of which statistics
    /// are made, come after the uniform steps.
    pub fn validate_untrained(&self) -> Result<(), ConfigError> {
        let known = !self.normalize_observations || self.normalize_until > self.uniform_steps;
        let wanted =
            "over sac.uniform_steps, unless the run begins with another's networks and statistics (--from)";
        check(known, "sac.normalize_until", &self.normalize_until, wanted)
    }

    /// What the learning rates of actor and critics are multiplied with at `env_steps` of the run.
    pub fn lr_scale(&self, env_steps: u64) -> f64 {
        if self.lr_steps == 0 {
            return 1.0;
        }
        let done = (env_steps as f64 / self.lr_steps as f64).min(1.0);
        1.0 + (self.lr_final - 1.0) * done
    }

    /// The actor's shape for a task.
    pub fn policy_shape(&self, observation: usize, action: usize) -> PolicyShape {
        PolicyShape { observation, action, body: self.body(self.actor_width, self.actor_blocks) }
    }

    /// The body of every critic.
    pub fn critic_body(&self) -> Body {
        self.body(self.critic_width, self.critic_blocks)
    }

    fn body(&self, width: usize, blocks: usize) -> Body {
        match self.network {
            NetworkKind::Mlp => Body::Mlp { hidden: self.hidden.clone() },
            NetworkKind::Simba => Body::Simba { width, blocks },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn observations_are_normalised_by_minibatches_which_come_after_the_uniform_steps() {
        let config = |normalize_until| SacConfig {
            normalize_observations: true,
            uniform_steps: 5_000,
            normalize_until,
            ..SacConfig::default()
        };
        assert!(config(5_001).validate_untrained().is_ok());
        let error = config(5_000).validate_untrained().unwrap_err().to_string();
        assert!(error.contains("sac.normalize_until = 5000: over sac.uniform_steps"), "{error}");
    }

    #[test]
    fn a_policy_that_actors_cannot_be_sent_is_refused_by_the_setting_that_makes_it() {
        let error = |hidden| SacConfig { hidden, ..SacConfig::default() }.validate().unwrap_err().to_string();
        let large = error(vec![4096, 4096]);
        assert!(large.contains("sac.hidden = a policy of 71 MB"), "{large}");
        let deep = error(vec![8; 65]);
        assert!(deep.contains("65 layers or blocks, more than 64"), "{deep}");
        let network = NetworkKind::Simba;
        let wide = SacConfig { network, actor_width: 2048, ..SacConfig::default() }.validate().unwrap_err();
        assert!(wide.to_string().contains("sac.actor_width"), "{wide}");
    }

    #[test]
    fn learning_rates_fall_linearly_and_stay_where_they_fell_to() {
        let config = SacConfig { lr_final: 0.1, lr_steps: 1000, ..SacConfig::default() };
        for (env_steps, scale) in [(0, 1.0), (500, 0.55), (1000, 0.1), (9000, 0.1)] {
            assert!((config.lr_scale(env_steps) - scale).abs() < 1e-12, "{env_steps}");
        }
        assert_eq!(SacConfig::default().lr_scale(9000), 1.0);
    }
}
