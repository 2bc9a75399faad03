//! What connects an actor to its replay and its learner: two traits, and the typed values that pass.
//!
//! In a cluster both are gRPC clients ([`crate::grpc`]); in one process they are injected by whoever holds the
//! store and the learner. [`PolicyUpdate::parse`] and [`Lease::parse`] are the door: what is malformed stops there.

use std::collections::BTreeMap;
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use getup_policy::{ModelError, Policy};
use getup_proto::names::{
    BETA_FLOOR_VALUE, BETA_STD_VALUE, BETA_VALUE, FALLS_SCENARIO, HIGH_STARTS_VALUE, POLICY_NETWORK,
};
use getup_proto::{PolicyVersion, Segment, v1};
use thiserror::Error;
use tokio::sync::watch;

/// Everything an actor needs to act.
#[derive(Clone, PartialEq, Debug)]
pub struct PolicyUpdate {
    /// Which policy it is.
    pub version: PolicyVersion,
    /// The network, with its observation statistics.
    pub policy: Arc<Policy>,
    /// The curriculum's torque limit β^i, over 0.
    pub beta: f64,
    /// The share of training's episodes that begin high, in [0, 1].
    pub high_starts: f64,
    /// All named values of the curriculum, β^i among them.
    pub values: BTreeMap<String, f64>,
    /// The curriculum's stage.
    pub stage: u32,
    /// Env steps of the run when it was broadcast.
    pub env_steps: u64,
    /// Actions are drawn uniformly, not from the network.
    pub uniform: bool,
    /// Training is over, and this is the final policy.
    pub finished: bool,
}

/// An evaluation to play, reported once under the lease's id.
#[derive(Clone, PartialEq, Debug)]
pub struct Lease {
    /// Names the lease, from 1.
    pub id: u64,
    /// The policy to evaluate.
    pub update: Arc<PolicyUpdate>,
    /// One an episode.
    pub seeds: Vec<u64>,
}

/// Why a policy update or a lease from the wire cannot be used.
#[derive(Debug, Error)]
pub enum UpdateError {
    /// A message without its version.
    #[error("a policy update names no version")]
    NoVersion,
    /// A lease without the policy to evaluate.
    #[error("lease {0} names no policy to evaluate")]
    NoPolicy(u64),
    /// The network is missing.
    #[error("policy {0} has no network named {POLICY_NETWORK:?}: the learner is of another version of getup")]
    NoNetwork(PolicyVersion),
    /// The network is malformed.
    #[error("policy {version}: {source}")]
    Model {
        /// Of the update.
        version: PolicyVersion,
        /// What is wrong.
        source: ModelError,
    },
    /// β^i is missing, or not a torque limit.
    #[error("policy {version} has {BETA_VALUE} {beta:?}: it must be a finite number over 0")]
    Beta {
        /// Of the update.
        version: PolicyVersion,
        /// The value, where there is one.
        beta: Option<f64>,
    },
    /// How β̂ is drawn makes no sense.
    #[error("policy {version} has {name} {value}: it must be a finite number, at least 0")]
    BetaDraw {
        /// Of the update.
        version: PolicyVersion,
        /// [`BETA_STD_VALUE`] or [`BETA_FLOOR_VALUE`].
        name: &'static str,
        /// As it came.
        value: f64,
    },
    /// The share of high starts is none.
    #[error("policy {version} has {HIGH_STARTS_VALUE} {high_starts}: it must be from 0 to 1")]
    HighStarts {
        /// Of the update.
        version: PolicyVersion,
        /// As it came.
        high_starts: f64,
    },
    /// A lease for something else than falls.
    #[error("lease {id} asks for {scenario:?}: this version of getup evaluates {FALLS_SCENARIO:?}")]
    Scenario {
        /// Of the lease.
        id: u64,
        /// As it came.
        scenario: String,
    },
    /// A lease with id 0 or an endless or negative keep-alive.
    #[error(
        "lease {id} with a keep-alive of {keep_alive_seconds} s: an id counts from 1, a keep-alive is over 0"
    )]
    Lease {
        /// Of the lease.
        id: u64,
        /// As it came.
        keep_alive_seconds: f64,
    },
}

impl PolicyUpdate {
    /// Parses a message: afterwards there is a network with finite weights, and a β^i.
    ///
    /// # Errors
    /// [`UpdateError`] with the first thing that is wrong.
    pub fn parse(wire: v1::PolicyUpdate) -> Result<Self, UpdateError> {
        let version: PolicyVersion = wire.version.ok_or(UpdateError::NoVersion)?.into();
        let network = wire.networks.iter().find(|network| network.name == POLICY_NETWORK);
        let network = network.ok_or(UpdateError::NoNetwork(version))?;
        let policy =
            Policy::from_bytes(&network.model).map_err(|source| UpdateError::Model { version, source })?;
        let beta = wire.values.get(BETA_VALUE).copied();
        let beta = match beta {
            Some(value) if value.is_finite() && value > 0.0 => value,
            _ => return Err(UpdateError::Beta { version, beta }),
        };
        for name in [BETA_STD_VALUE, BETA_FLOOR_VALUE] {
            if let Some(&value) = wire.values.get(name)
                && !(value.is_finite() && value >= 0.0)
            {
                return Err(UpdateError::BetaDraw { version, name, value });
            }
        }
        let high_starts = wire.values.get(HIGH_STARTS_VALUE).copied().unwrap_or(0.0);
        if !(0.0..=1.0).contains(&high_starts) {
            return Err(UpdateError::HighStarts { version, high_starts });
        }
        Ok(Self {
            version,
            policy: Arc::new(policy),
            beta,
            high_starts,
            values: wire.values.into_iter().collect(),
            stage: wire.stage,
            env_steps: wire.env_steps,
            uniform: wire.uniform,
            finished: wire.finished,
        })
    }

    /// The update as a message.
    pub fn to_wire(&self) -> v1::PolicyUpdate {
        v1::PolicyUpdate {
            version: Some(self.version.into()),
            networks: vec![v1::NamedNetwork {
                name: POLICY_NETWORK.to_owned(),
                model: self.policy.to_bytes().into(),
            }],
            values: self.values.iter().map(|(name, value)| (name.clone(), *value)).collect(),
            stage: self.stage,
            env_steps: self.env_steps,
            uniform: self.uniform,
            finished: self.finished,
        }
    }
}

impl Lease {
    /// Parses a message.
    ///
    /// # Errors
    /// [`UpdateError`] with the first thing that is wrong.
    pub fn parse(wire: v1::EvaluationLease) -> Result<Self, UpdateError> {
        let (id, keep_alive_seconds) = (wire.id, wire.keep_alive_seconds);
        let keeps_alive = Duration::try_from_secs_f64(keep_alive_seconds).is_ok_and(|time| !time.is_zero());
        if id == 0 || !keeps_alive {
            return Err(UpdateError::Lease { id, keep_alive_seconds });
        }
        if wire.scenario != FALLS_SCENARIO {
            return Err(UpdateError::Scenario { id, scenario: wire.scenario });
        }
        let policy = wire.policy.ok_or(UpdateError::NoPolicy(id))?;
        let update = Arc::new(PolicyUpdate::parse(policy)?);
        Ok(Self { id, update, seeds: wire.seeds })
    }
}

/// What an actor says of itself about once a second.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct Heartbeat {
    /// Its name.
    pub actor: String,
    /// The lease it works on; 0 for none.
    pub lease: u64,
    /// The policy it acts by.
    pub version: PolicyVersion,
    /// Env steps since its start.
    pub env_steps: u64,
    /// Why it does not step; empty while it does.
    pub waiting: String,
    /// Whether this is its last.
    pub leaving: bool,
}

impl From<Heartbeat> for v1::HeartbeatRequest {
    fn from(beat: Heartbeat) -> Self {
        Self {
            actor: beat.actor,
            lease: beat.lease,
            idle: beat.lease == 0 && !beat.leaving,
            version: Some(beat.version.into()),
            env_steps: beat.env_steps,
            waiting: beat.waiting,
            leaving: beat.leaving,
            spec: None,
        }
    }
}

/// One episode of an evaluation, as it is reported.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct EpisodeResult {
    /// Sum of the rewards.
    pub episode_return: f64,
    /// The highest that the head was after a control step, in metres.
    pub max_head_height: f64,
    /// Where the head was at the end, in metres.
    pub final_head_height: f64,
    /// Whether the head was up at any step: see [`crate::evaluate::EvaluatedEpisode::rises`].
    pub rises: bool,
    /// Whether it was up through the last steps: see [`crate::evaluate::EvaluatedEpisode::stands`].
    pub stands: bool,
}

impl From<EpisodeResult> for v1::EpisodeResult {
    fn from(result: EpisodeResult) -> Self {
        Self {
            episode_return: result.episode_return,
            max_head_height: result.max_head_height,
            final_head_height: result.final_head_height,
            rises: result.rises,
            stands: result.stands,
        }
    }
}

/// What became of a report.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Reported {
    /// It counts.
    Accepted,
    /// The lease had gone to somebody else: the report is dropped.
    LeaseLost,
}

/// Why the other side did not do what was asked.
#[derive(Clone, PartialEq, Eq, Debug, Error)]
pub enum LinkError {
    /// It refuses, and would refuse again: the actor ends.
    #[error("{0}")]
    Refused(String),
    /// It is not there, or fails for now: worth another attempt.
    #[error("{0}")]
    Unavailable(String),
}

/// The way of segments to the replay.
pub trait SegmentWriter: Send + Sync + 'static {
    /// The id under which the replay knows this writer: that of every segment appended here.
    fn writer(&self) -> u64;

    /// Stores segments, whose sequence numbers go on where the last call's ended, and returns when all are durable.
    ///
    /// It retries for as long as the replay is not there. A call that is dropped has stored any number of them.
    ///
    /// # Errors
    /// Only when the replay refuses them for good.
    fn append(&mut self, segments: Vec<Segment>) -> impl Future<Output = Result<(), LinkError>> + Send;
}

/// The newest policy, where there is one: latest wins, for only the last value is kept.
pub type PolicySlot = watch::Sender<Option<Arc<PolicyUpdate>>>;

/// The way to the learner and back.
pub trait LearnerLink: Send + Sync + 'static {
    /// Puts the newest policy into `slot`, now and whenever there is a newer one, for as long as it is polled.
    ///
    /// Returns where no newer one will ever come.
    ///
    /// # Errors
    /// Only when the learner refuses this actor for good.
    fn subscribe(&self, slot: PolicySlot) -> impl Future<Output = Result<(), LinkError>> + Send;

    /// Says that the actor is there; the answer may be a lease. One attempt.
    ///
    /// # Errors
    /// When the learner is not there: the next heartbeat may find it.
    fn heartbeat(&self, beat: Heartbeat) -> impl Future<Output = Result<Option<Lease>, LinkError>> + Send;

    /// Reports a leased evaluation, one result a seed in their order. One attempt.
    ///
    /// # Errors
    /// [`LinkError::Unavailable`] is worth another attempt.
    fn report(
        &self,
        lease: u64,
        episodes: Vec<EpisodeResult>,
    ) -> impl Future<Output = Result<Reported, LinkError>> + Send;
}

#[cfg(test)]
mod tests {
    use super::*;
    use getup_policy::{Body, PolicyShape};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn update() -> PolicyUpdate {
        let shape = PolicyShape { observation: 3, action: 2, body: Body::Mlp { hidden: vec![4] } };
        PolicyUpdate {
            version: PolicyVersion { incarnation: 2, counter: 7 },
            policy: Arc::new(Policy::init(shape, &mut ChaCha8Rng::seed_from_u64(0))),
            beta: 0.95,
            high_starts: 0.0,
            values: [(BETA_VALUE.to_owned(), 0.95)].into(),
            stage: 1,
            env_steps: 20_000,
            uniform: false,
            finished: true,
        }
    }

    #[test]
    fn an_update_survives_the_wire() {
        assert_eq!(PolicyUpdate::parse(update().to_wire()).unwrap(), update());
    }

    #[test]
    fn a_malformed_update_is_refused_with_its_reason() {
        let refused = |change: &dyn Fn(&mut v1::PolicyUpdate)| {
            let mut wire = update().to_wire();
            change(&mut wire);
            PolicyUpdate::parse(wire).unwrap_err().to_string()
        };
        assert!(refused(&|wire| wire.version = None).contains("names no version"));
        let spread = refused(&|wire| _ = wire.values.insert(BETA_STD_VALUE.into(), f64::NAN));
        assert!(spread.contains("has beta_std NaN"), "{spread}");
        assert!(refused(&|wire| wire.networks.clear()).contains("policy 2.7 has no network"));
        assert!(refused(&|wire| wire.networks[0].model.clear()).contains("not a getup model"));
        assert!(refused(&|wire| wire.values.clear()).contains("has beta None"));
        assert!(refused(&|wire| *wire.values.get_mut("beta").unwrap() = f64::NAN).contains("NaN"));
    }

    #[test]
    fn a_lease_needs_an_id_a_policy_a_keep_alive_and_the_scenario_of_falls() {
        let wire = v1::EvaluationLease {
            id: 3,
            policy: Some(update().to_wire()),
            scenario: FALLS_SCENARIO.to_owned(),
            seeds: vec![1, 2],
            keep_alive_seconds: 10.0,
        };
        let lease = Lease::parse(wire.clone()).unwrap();
        assert_eq!((lease.id, lease.seeds), (3, vec![1, 2]));
        let other = v1::EvaluationLease { scenario: "walks".into(), ..wire.clone() };
        assert!(Lease::parse(other).unwrap_err().to_string().contains("asks for \"walks\""));
        assert!(Lease::parse(v1::EvaluationLease { id: 0, ..wire.clone() }).is_err());
        assert!(Lease::parse(v1::EvaluationLease { policy: None, ..wire.clone() }).is_err());
        for keep_alive_seconds in [-1.0, 0.0, f64::NAN] {
            assert!(Lease::parse(v1::EvaluationLease { keep_alive_seconds, ..wire.clone() }).is_err());
        }
    }
}
