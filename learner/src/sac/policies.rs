//! Policies out of the learner's actor, and into it.

use getup_policy::Policy;
use tch::Tensor;

use super::Sac;
use crate::networks::Actor;
use crate::parameters::to_vec;

/// A model or a checkpoint whose actor a run cannot go on with.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "the {of}'s {what}: {found}; the configuration's: {wanted}: take another {of}, or set [sac] as its run did"
)]
pub struct ActorMismatch {
    of: &'static str,
    what: &'static str,
    found: String,
    wanted: String,
}

impl Sac {
    /// The actor as it is now, with the statistics that its observations are normalised by.
    pub fn policy(&self) -> Policy {
        self.policy_of(self.actor.parameters.flat())
    }

    /// The actor that is evaluated and kept: the average over its updates, where the run has one.
    pub fn evaluated_policy(&self) -> Policy {
        self.policy_of(self.average.as_ref().unwrap_or(self.actor.parameters.flat()))
    }

    fn policy_of(&self, flat: &Tensor) -> Policy {
        let values = to_vec(flat);
        let mut rest = &values[..];
        let tensors = self.actor.shape.tensors().into_iter().map(|(name, shape)| {
            let (values, others) = rest.split_at(shape.iter().product());
            rest = others;
            (name, values.to_vec())
        });
        Policy {
            tensors: tensors.collect(),
            shape: self.actor.shape.clone(),
            statistics: self.config.normalize_observations.then(|| self.statistics.snapshot()),
            metadata: Default::default(),
        }
    }

    /// Puts another run's actor in the place of the untrained one, with the statistics that it learned under.
    pub(crate) fn begin_with(&mut self, policy: &Policy) -> Result<(), ActorMismatch> {
        if policy.shape != self.actor.shape {
            let [found, wanted] = [&policy.shape, &self.actor.shape].map(ToString::to_string);
            return Err(ActorMismatch { of: "model", what: "shape", found, wanted });
        }
        self.check_normalizes("model", policy.statistics.is_some())?;
        self.actor = Actor::new(policy, self.config.precision.kind(self.device), self.device);
        if let Some(statistics) = &policy.statistics {
            self.statistics.begin_with(statistics);
        }
        self.began_trained = true;
        self.changed();
        Ok(())
    }

    /// Refuses networks that learned to read observations otherwise than this run gives them.
    pub(crate) fn check_normalizes(&self, of: &'static str, found: bool) -> Result<(), ActorMismatch> {
        let wanted = self.config.normalize_observations;
        if found == wanted {
            return Ok(());
        }
        let [found, wanted] =
            [found, wanted].map(|does| if does { "normalised" } else { "as they are" }.to_owned());
        Err(ActorMismatch { of, what: "observations", found, wanted })
    }
}
