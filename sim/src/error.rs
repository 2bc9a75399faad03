//! What can go wrong outside a step: a bad setting, a bad state, a model that MuJoCo refuses.
//! What goes wrong inside one is [`Divergence`](crate::Divergence).

use crate::character::Character;

/// Why a world, a task or a lane could not be made or set.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
pub enum SimError {
    /// A setting of the task is out of range.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// MuJoCo refused the model.
    #[error("MuJoCo refused the model of character {character}: {reason}")]
    Model {
        /// The character.
        character: Character,
        /// MuJoCo's message.
        reason: String,
    },
    /// The model has no body of this name.
    #[error("the model of character {character} has no body {body:?}")]
    NoBody {
        /// The character.
        character: Character,
        /// The name looked for.
        body: String,
    },
    /// A vector of the wrong length.
    #[error("{field} has {got} numbers; character {character} needs {wanted}")]
    Length {
        /// `qpos` or `qvel`.
        field: &'static str,
        /// The character.
        character: Character,
        /// Numbers given.
        got: usize,
        /// Numbers the model has.
        wanted: usize,
    },
    /// A number that is NaN, infinite, or beyond what MuJoCo accepts (1e10).
    #[error("{field}[{index}] is {got}; it must be finite and within ±1e10")]
    NotFinite {
        /// `qpos` or `qvel`.
        field: &'static str,
        /// Its place.
        index: usize,
        /// The number.
        got: f64,
    },
}

/// A setting of the task that is out of range.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
pub enum ConfigError {
    /// No such task.
    #[error("task.name is {0:?}; the only task is \"getup\"")]
    Name(String),
    /// A physics rate that is neither of the two.
    #[error("task.physics_hz is {0}; use 200 (discover, weaker) or 800 (slower)")]
    PhysicsHz(u32),
    /// An action noise that is negative or not a number.
    #[error(
        "task.ragdoll_std is {0}; it must be finite and at least 0 (0 falls limp, the paper's text uses 0.1)"
    )]
    RagdollStd(f64),
    /// A crouch that costs less than nothing or more than everything.
    #[error("task.crouch_cost is {0}; it must be from 0 (the paper's) to 1")]
    CrouchCost(f64),
    /// A height at which nobody crouches.
    #[error("task.crouch_height is {0}; it must be over 0 and finite (a head that is up is at 1.4 m)")]
    CrouchHeight(f64),
    /// Episodes without a step.
    #[error("task.episode_steps is 0; it must be at least 1 (the paper's is 250)")]
    EpisodeSteps,
    /// Phases for which no memory is.
    #[error("task.{name} is {steps}; it must be at most {most}")]
    TooManySteps {
        /// Which.
        name: &'static str,
        /// How many.
        steps: usize,
        /// The most that there may be.
        most: usize,
    },
    /// Weights of reset sources that no draw can follow.
    #[error("the resets' weights are {0:?}; they must be finite and at least 0, and one must be above 0")]
    Resets(Vec<f64>),
    /// A control limit that is no clamp.
    #[error(
        "the control limit is {0}; it must be finite and at least 1, the torque limit of the paper's Table 2"
    )]
    ControlLimit(f64),
}
