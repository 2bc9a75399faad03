//! What leaves the training: policies to whoever acts, and what their files say of them.

use std::sync::Arc;

use getup_policy::Policy;
use getup_proto::names::{BETA_FLOOR_VALUE, BETA_STD_VALUE, BETA_VALUE, HIGH_STARTS_VALUE, POLICY_NETWORK};
use getup_proto::v1;

use super::{Ending, TrainError, Trainer};
use crate::hub::Evaluation;

impl Trainer {
    /// Broadcasts the actor as it is now, under a new version (but the first).
    pub(super) fn publish(&mut self) -> Arc<v1::PolicyUpdate> {
        let policy = self.describe(self.sac.policy(), self.curriculum.beta());
        self.broadcast(&policy, false)
    }

    /// Broadcasts the policy that training ends with: the snapshot of the last stage that passed, or the newest.
    pub(super) fn publish_final(&mut self) -> Result<(), TrainError> {
        let best = self.folder.model("best");
        let policy = match self.ending {
            Some(Ending::Curriculum(_)) if best.exists() => Policy::load(best)?,
            _ => self.describe(self.sac.evaluated_policy(), self.curriculum.beta()),
        };
        self.broadcast(&policy, true);
        Ok(())
    }

    fn broadcast(&mut self, policy: &Policy, finished: bool) -> Arc<v1::PolicyUpdate> {
        let update = Arc::new(v1::PolicyUpdate {
            version: Some(self.version.into()),
            networks: vec![v1::NamedNetwork { name: POLICY_NETWORK.into(), model: policy.to_bytes().into() }],
            values: [
                (BETA_VALUE.to_owned(), self.curriculum.beta()),
                (BETA_STD_VALUE.to_owned(), self.config.curriculum.beta_std),
                (BETA_FLOOR_VALUE.to_owned(), self.config.curriculum.beta_floor),
                (HIGH_STARTS_VALUE.to_owned(), self.curriculum.high_starts()),
            ]
            .into(),
            stage: self.curriculum.stage(),
            env_steps: self.progress.env_steps,
            uniform: self.progress.env_steps < self.config.sac.uniform_steps && !self.sac.is_trained(),
            finished,
        });
        self.metrics.policy_version.set(self.version.counter as i64);
        self.version.counter += 1;
        self.hub.publish(Arc::clone(&update));
        update
    }

    /// Offers the policy that was just published for evaluation, or the average in its place.
    pub(super) fn offer(&mut self, mut policy: Arc<v1::PolicyUpdate>) {
        if self.sac.average.is_some() {
            let average = self.describe(self.sac.evaluated_policy(), self.curriculum.beta());
            Arc::make_mut(&mut policy).networks[0].model = average.to_bytes().into();
        }
        self.evaluated_updates = self.sac.updates();
        self.progress.evaluation_owed = true;
        self.hub.offer(Evaluation { policy, updates: self.sac.updates() });
    }

    /// Adds what a model file says of itself.
    pub(super) fn describe(&self, mut policy: Policy, beta: f64) -> Policy {
        for (key, value) in [
            ("beta", beta.to_string()),
            ("stage", self.curriculum.stage().to_string()),
            ("task", "getup".to_owned()),
            ("character", self.config.character.clone()),
            ("physics_hz", self.config.physics_hz.to_string()),
            ("run", self.config.run.clone()),
            ("seed", self.config.seed.to_string()),
            ("env_steps", self.progress.env_steps.to_string()),
            ("updates", self.sac.updates().to_string()),
        ] {
            policy.metadata.insert(key.to_owned(), value);
        }
        policy
    }
}
