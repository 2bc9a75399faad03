//! Why an actor ends other than by shutdown: [`ActorError`].

use getup_sim::SimError;
use thiserror::Error;
use tokio::task::JoinError;

use crate::config::ConfigError;
use crate::evaluate::EvaluateError;
use crate::lanes::GroupError;
use crate::link::LinkError;

/// Why an actor cannot go on.
#[derive(Debug, Error)]
pub enum ActorError {
    /// A setting of the actor.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A setting of the task.
    #[error(transparent)]
    Sim(#[from] SimError),
    /// The spec or the policy does not fit the task.
    #[error(transparent)]
    Group(#[from] GroupError),
    /// A leased evaluation cannot be played here.
    #[error("cannot play a leased evaluation: {0}")]
    Evaluate(#[from] EvaluateError),
    /// The replay or the learner refuses this actor.
    #[error("refused by the {0}")]
    Refused(LinkError),
    /// A defect of this program.
    #[error("a thread of the actor panicked: {0}")]
    Panicked(#[from] JoinError),
}
