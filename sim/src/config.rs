//! The settings of the get-up task: the `[task]` table of a run's configuration.

use documented::DocumentedFieldsOpt;
use serde::{Deserialize, Serialize};

use crate::character::Character;
use crate::error::ConfigError;

/// More control steps than a phase may have: room for all of them is made at once.
const MOST_STEPS: usize = 1_000_000;

/// What is simulated and how an episode runs. The default is the paper's (§7) as `evaluation` plays it.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize, DocumentedFieldsOpt)]
#[serde(deny_unknown_fields, default)]
pub struct TaskConfig {
    /// The task: `getup`.
    pub name: String,
    /// The body: `standard`, `cast` or `one_arm`.
    pub character: Character,
    /// Physics steps a second: 200 in the discover and weaker stages, 800 in the slower stage.
    pub physics_hz: u32,
    /// Limp control steps at the start of a fall, at 40 Hz: 80 are two seconds.
    pub ragdoll_steps: usize,
    /// Standard deviation of a limp step's actions. The paper's text says 0.1, its released code 0.
    pub ragdoll_std: f64,
    /// Control steps in the get-up phase; reaching the last is a time limit, not a terminal state.
    pub episode_steps: usize,
    /// The shape of the reward's `stand` term in training: `long_tail`, as the paper's results have it and evaluations
    /// always do, or `gaussian`, as its text has it.
    pub stand: Stand,
    /// Whether falling ends a training episode for good: a head that was over 1.4 m sinks under 1 m. Without, a fall
    /// costs no more than the second that it takes to rise again.
    pub fall_ends: bool,
    /// Share of the `stand` term that a head under `crouch_height` costs in training, from 0 to 1. Without, a crouch pays
    /// nearly as much as standing, and a little dip from it is under the 1.4 m of an evaluation. A run that goes on may
    /// change both; what its replay holds was paid as it was then. An actor that is a process of its own goes by its own
    /// settings: they are to be the same for all.
    pub crouch_cost: f64,
    /// The head's height at which half of that is due, in metres: the middle of a step 0.02 m wide.
    pub crouch_height: f64,
}

/// The shape of the reward's `stand` term (App. B.1).
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stand {
    /// What the paper's curves come from: margin 1.55 / 4 m, 0.2 at the margin, a long tail. Lying pays 0.0185.
    #[default]
    LongTail,
    /// What the paper's text says: margin 0.37 m, 0.1 at the margin, a Gaussian. Lying pays 1e-14.
    Gaussian,
}

impl Default for TaskConfig {
    fn default() -> TaskConfig {
        TaskConfig {
            name: "getup".to_owned(),
            character: Character::Standard,
            physics_hz: 200,
            ragdoll_steps: 80,
            ragdoll_std: 0.1,
            episode_steps: 250,
            stand: Stand::LongTail,
            fall_ends: false,
            crouch_cost: 0.0,
            crouch_height: 1.43,
        }
    }
}

impl TaskConfig {
    /// Checks every setting.
    ///
    /// # Errors
    /// The first setting out of range, with its value and the way out.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if self.name != "getup" {
            return Err(ConfigError::Name(self.name.clone()));
        }
        if !matches!(self.physics_hz, 200 | 800) {
            return Err(ConfigError::PhysicsHz(self.physics_hz));
        }
        if !(self.ragdoll_std.is_finite() && self.ragdoll_std >= 0.0) {
            return Err(ConfigError::RagdollStd(self.ragdoll_std));
        }
        if !(0.0..=1.0).contains(&self.crouch_cost) {
            return Err(ConfigError::CrouchCost(self.crouch_cost));
        }
        if !(self.crouch_height > 0.0 && self.crouch_height.is_finite()) {
            return Err(ConfigError::CrouchHeight(self.crouch_height));
        }
        if self.episode_steps == 0 {
            return Err(ConfigError::EpisodeSteps);
        }
        for (name, steps) in [("ragdoll_steps", self.ragdoll_steps), ("episode_steps", self.episode_steps)] {
            if steps > MOST_STEPS {
                return Err(ConfigError::TooManySteps { name, steps, most: MOST_STEPS });
            }
        }
        Ok(())
    }

    /// The task an evaluation plays: falls, reward and length are the paper's whatever training uses. The body
    /// and its physics rate stay, for they are what the policy was trained in.
    pub fn evaluation(&self) -> TaskConfig {
        TaskConfig { character: self.character, physics_hz: self.physics_hz, ..TaskConfig::default() }
    }
}
