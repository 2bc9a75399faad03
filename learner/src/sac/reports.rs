//! What updates report: losses, where their time went, norms, and the loss that ends training.

use std::time::Instant;

/// What one update found, for metrics.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// Mean squared error of the critics, by the transitions' weights, summed over them.
    pub critic: f64,
    /// Mean of α·log π − Q, of the last update that the actor learned by; not a number before the first.
    pub actor: f64,
    /// α after the update.
    pub temperature: f64,
    /// Mean of −log π, in nats, of the same update.
    pub entropy: f64,
    /// Mean Q of the batch's own actions.
    pub q: f64,
}

/// What an update of the actor found; see [`Losses`].
#[derive(Clone, Copy, Debug)]
pub(super) struct PolicyLoss {
    pub(super) actor: f64,
    pub(super) entropy: f64,
}

impl PolicyLoss {
    /// Of an actor that has not learned yet.
    pub(super) const NONE: Self = Self { actor: f64::NAN, entropy: f64::NAN };
}

/// Where the time of updates went, in seconds since this process began. On a GPU, whose work is waited for at each loss, it
/// is the time until then.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Phases {
    /// The critics' targets, losses and gradients.
    pub critics: f64,
    /// The actor's loss and gradient.
    pub actor: f64,
    /// Steps of AdamW and of Polyak averaging; on a processor the weights' gradients, too, which a step makes as it goes.
    pub optimizer: f64,
}

/// Euclidean norms of what an update works with.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Norms {
    /// Of the actor's weights, and of its gradient at its last step.
    pub actor: [f64; 2],
    /// Of all critics' weights, and of their gradient at their last step.
    pub critics: [f64; 2],
}

/// Adds the time since it was last asked.
pub(super) struct Lap(Instant);

impl Lap {
    pub(super) fn start() -> Self {
        Self(Instant::now())
    }

    pub(super) fn add_to(&mut self, phase: &mut f64) {
        let now = Instant::now();
        *phase += now.duration_since(self.0).as_secs_f64();
        self.0 = now;
    }
}

/// A loss, or a gradient's norm, that is not a number any more. Nothing of the update that found it was published or saved:
/// the last checkpoint is good.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the {name} is {value} at update {update}; lower its learning rate, or resume the last checkpoint")]
pub struct NonFiniteLoss {
    /// Of what: a loss, or a gradient.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// Updates before this one.
    pub update: u64,
}
