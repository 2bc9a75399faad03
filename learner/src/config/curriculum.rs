//! What is asked of a policy, and when: the `[curriculum]` and `[evaluation]` tables.

use documented::DocumentedFieldsOpt;
use serde::{Deserialize, Serialize};

use super::{ConfigError, check};

/// The strong-to-weak torque curriculum (§5, Algorithm 1).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, DocumentedFieldsOpt)]
#[serde(default, deny_unknown_fields)]
pub struct CurriculumConfig {
    /// β of stage 0; where above 1, also the upper clip of β̂ and the actuators' clamp, which else are 1.
    pub beta_start: f64,
    /// β never goes under it.
    pub beta_floor: f64,
    /// β stays at `beta_start` (in a run that is resumed, at what it has come to): no evaluation promotes, and `best` is the
    /// one with the most falls that end standing.
    pub fixed: bool,
    /// Env steps without a better evaluation that end the training of a fixed β; 0 for no end.
    pub patience: u64,
    /// β^{i+1} / β^i.
    pub decay: f64,
    /// The same while β^i is over 1; β = 1 is never skipped.
    pub decay_above_one: f64,
    /// Standard deviation of an episode's β̂ around β^i.
    pub beta_std: f64,
    /// An evaluation whose minimum return exceeds it passes the stage, ω.
    pub omega: f64,
    /// In a stage with β over 1, an evaluation whose mean return exceeds it passes too; no return exceeds the
    /// default.
    pub omega_above_one: f64,
    /// Share of the episodes that begin high until the first promotion at a β of 1 or less: standing, collapsing.
    pub high_starts: f64,
    /// By how much every such promotion lowers that share.
    pub high_starts_fade: f64,
    /// Env steps that a stage after the discovery may last at least: N_min. The limit is 1.5 × what the one before took.
    pub n_min: u64,
    /// The most that it may last: N_max.
    pub n_max: u64,
}

impl Default for CurriculumConfig {
    fn default() -> Self {
        Self {
            beta_start: 1.0,
            beta_floor: 0.4,
            fixed: false,
            patience: 0,
            decay: 0.95,
            decay_above_one: 0.95,
            beta_std: 0.04,
            omega: 60.0,
            omega_above_one: 1e9,
            high_starts: 0.0,
            high_starts_fade: 0.1,
            n_min: 300_000,
            n_max: 800_000,
        }
    }
}

impl CurriculumConfig {
    /// Refuses settings under which the curriculum has no meaning.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let floor = self.beta_floor;
        check(floor > 0.0 && floor <= 1.0, "curriculum.beta_floor", &floor, "over 0, at most 1")?;
        let start = self.beta_start;
        let good = start >= floor && start <= 4.0;
        check(good, "curriculum.beta_start", &start, "from curriculum.beta_floor to 4")?;
        for (key, decay) in
            [("curriculum.decay", self.decay), ("curriculum.decay_above_one", self.decay_above_one)]
        {
            check(decay > 0.0 && decay < 1.0, key, &decay, "between 0 and 1")?;
        }
        check((0.0..=1.0).contains(&self.beta_std), "curriculum.beta_std", &self.beta_std, "from 0 to 1")?;
        check(self.omega.is_finite(), "curriculum.omega", &self.omega, "a number")?;
        let above_one = self.omega_above_one;
        check(above_one.is_finite(), "curriculum.omega_above_one", &above_one, "a number")?;
        for (key, share) in [
            ("curriculum.high_starts", self.high_starts),
            ("curriculum.high_starts_fade", self.high_starts_fade),
        ] {
            check((0.0..=1.0).contains(&share), key, &share, "from 0 to 1")?;
        }
        check(self.n_min > 0, "curriculum.n_min", &self.n_min, "at least 1")?;
        check(self.n_min <= self.n_max, "curriculum.n_min", &self.n_min, "at most curriculum.n_max")
    }
}

/// When and how policies are evaluated.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, DocumentedFieldsOpt)]
#[serde(default, deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Env steps from one evaluation to the next.
    pub every: u64,
    /// Fallen states of an evaluation, drawn once from the run's seed.
    pub episodes: usize,
    /// A lease whose holder is silent this long goes to another actor, in seconds.
    pub lease_seconds: f64,
}

impl Default for EvaluationConfig {
    fn default() -> Self {
        Self { every: 20_000, episodes: 10, lease_seconds: 10.0 }
    }
}

impl EvaluationConfig {
    /// Refuses settings under which nothing would be evaluated.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check(self.every > 0, "evaluation.every", &self.every, "at least 1")?;
        check(
            (1..=10_000).contains(&self.episodes),
            "evaluation.episodes",
            &self.episodes,
            "from 1 to 10000",
        )?;
        let seconds = self.lease_seconds;
        // Heartbeats come up to a second and a half apart, and may take some seconds to be heard.
        check((5.0..=3600.0).contains(&seconds), "evaluation.lease_seconds", &seconds, "from 5 to 3600")
    }
}
