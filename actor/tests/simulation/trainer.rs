//! What stands in for training: it takes minibatches and makes no gradients of them. Broadcasts, evaluations, the
//! curriculum and checkpoints come in the order in which the trainer has them.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use getup_learner::config::CurriculumConfig;
use getup_learner::curriculum::{Curriculum, Decision, StageResult};
use getup_learner::hub::{Evaluation, Hub};
use getup_learner::run_folder::{RunFolder, write_atomically};
use getup_policy::{Body, Policy, PolicyShape};
use getup_proto::{PolicyVersion, v1};
use getup_replay::{MinibatchSource, RemoteOptions, RemoteSource, ReplayCounters, SampleOptions};
use getup_telemetry::{Shutdown, Waits};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde::{Deserialize, Serialize};
use tokio::runtime::Handle;

use crate::machine::Machine;
use crate::network::endpoint;
use crate::roles::{Run, replay_name, spec};

/// Transitions of a minibatch.
const BATCH: usize = 16;
/// Minibatches of a turn, at most, from each replay.
const MOST: usize = 6;
const PUBLISH_EVERY: u64 = 20;
const EVALUATE_EVERY: u64 = 150;
const CHECKPOINT_EVERY: u64 = 35;

/// What a restart goes on from.
#[derive(Serialize, Deserialize)]
struct State {
    curriculum: Curriculum,
    updates: u64,
    env_steps: u64,
    /// What of them was counted in which store.
    stores: BTreeMap<u64, u64>,
    next_evaluation: u64,
    evaluation_owed: bool,
}

pub(crate) struct Trainer {
    run: Arc<Run>,
    machine: Arc<Machine>,
    folder: RunFolder,
    hub: Arc<Hub>,
    sources: Vec<RemoteSource>,
    model: Vec<u8>,
    state: State,
    version: PolicyVersion,
}

impl Trainer {
    pub(crate) fn new(
        run: &Arc<Run>,
        machine: &Arc<Machine>,
        folder: RunFolder,
        hub: Arc<Hub>,
        incarnation: u64,
        waits: &Waits,
        shutdown: &Shutdown,
    ) -> turmoil::Result<Self> {
        let source = |index: usize| {
            let options = RemoteOptions {
                table: String::new(),
                spec: spec(),
                sample: SampleOptions {
                    batch: BATCH,
                    n_step: 1,
                    gamma: 0.97,
                    seed: incarnation << 32 | index as u64,
                    segments: false,
                },
                name: machine.name.clone(),
                prefetch: 4,
            };
            RemoteSource::new(
                endpoint(&replay_name(index), machine),
                options,
                &Handle::current(),
                waits.clone(),
                shutdown.clone(),
            )
        };
        let sources = (0..run.replays).map(source).collect();
        let shape = PolicyShape { observation: 2, action: 1, body: Body::Mlp { hidden: vec![2] } };
        let model = Policy::init(shape, &mut ChaCha8Rng::seed_from_u64(0)).to_bytes();
        let saved = std::fs::read(folder.checkpoints().join("checkpoint.json"));
        let resumed = saved.is_ok();
        let state = match saved {
            Ok(bytes) => serde_json::from_slice(&bytes)?,
            Err(_) => State {
                curriculum: Curriculum::new(CurriculumConfig {
                    beta_floor: 0.05,
                    decay: 0.9,
                    n_min: 1_000_000,
                    n_max: 1_000_000,
                    ..CurriculumConfig::default()
                }),
                updates: 0,
                env_steps: 0,
                stores: BTreeMap::new(),
                next_evaluation: EVALUATE_EVERY,
                evaluation_owed: false,
            },
        };
        let version = PolicyVersion { incarnation, counter: 0 };
        let (run, machine) = (run.clone(), machine.clone());
        let mut trainer = Self { run, machine, folder, hub, sources, model, state, version };
        let policy = trainer.publish();
        if !resumed || trainer.state.evaluation_owed {
            trainer.offer(policy);
        }
        Ok(trainer)
    }

    /// Takes what minibatches there are, and what was reported.
    pub(crate) fn turn(&mut self) -> turmoil::Result {
        for index in 0..self.sources.len() {
            for _ in 0..MOST {
                let Some(minibatch) = self.sources[index].poll(Duration::ZERO)? else { break };
                self.run.ledger.sampled(&self.machine, minibatch.counters);
                self.learn(minibatch.counters)?;
            }
        }
        self.take_reports()
    }

    fn learn(&mut self, counters: ReplayCounters) -> turmoil::Result {
        let state = &mut self.state;
        let seen = state.stores.entry(counters.store).or_default();
        state.env_steps += counters.env_steps.saturating_sub(*seen);
        *seen = counters.env_steps.max(*seen);
        state.updates += 1;
        self.run.ledger.env_steps(&self.machine, state.env_steps);
        self.take_reports()?;
        if self.state.env_steps >= self.state.next_evaluation {
            self.state.next_evaluation = (self.state.env_steps / EVALUATE_EVERY + 1) * EVALUATE_EVERY;
            let policy = self.publish();
            self.offer(policy);
        } else if self.state.updates == 1 || self.state.updates.is_multiple_of(PUBLISH_EVERY) {
            self.publish();
        }
        if self.state.updates.is_multiple_of(CHECKPOINT_EVERY) {
            self.checkpoint()?;
        }
        Ok(())
    }

    fn take_reports(&mut self) -> turmoil::Result {
        while let Some((evaluation, episodes)) = self.hub.take_reported() {
            self.state.evaluation_owed = self.hub.outstanding() > 0;
            let version: PolicyVersion = evaluation.policy.version.unwrap_or_default().into();
            self.run.ledger.counted(&self.machine, version, episodes[0].max_head_height as u64);
            let returns = || episodes.iter().map(|episode| episode.episode_return);
            let result = StageResult {
                stage: evaluation.policy.stage,
                env_steps: evaluation.policy.env_steps,
                min_return: returns().fold(f64::INFINITY, f64::min),
                mean_return: returns().sum::<f64>() / episodes.len() as f64,
                stand_rate: 0.0,
            };
            if let Decision::Promote { .. } = self.state.curriculum.report(result, self.state.env_steps) {
                // On disk before anybody hears of the next stage.
                self.checkpoint()?;
                self.publish();
            }
        }
        Ok(())
    }

    fn publish(&mut self) -> Arc<v1::PolicyUpdate> {
        let State { curriculum, env_steps, .. } = &self.state;
        let update = Arc::new(v1::PolicyUpdate {
            version: Some(self.version.into()),
            networks: vec![v1::NamedNetwork { name: "policy".into(), model: self.model.clone().into() }],
            values: [("beta".to_owned(), curriculum.beta())].into(),
            stage: curriculum.stage(),
            env_steps: *env_steps,
            uniform: false,
            finished: false,
        });
        self.run.ledger.broadcast(&self.machine, self.version, curriculum.stage(), curriculum.beta());
        self.version.counter += 1;
        self.hub.publish(update.clone());
        update
    }

    fn offer(&mut self, policy: Arc<v1::PolicyUpdate>) {
        self.state.evaluation_owed = true;
        self.hub.offer(Evaluation { policy, updates: self.state.updates });
    }

    fn checkpoint(&self) -> turmoil::Result {
        let path = self.folder.checkpoints().join("checkpoint.json");
        Ok(write_atomically(&path, &serde_json::to_vec(&self.state)?)?)
    }
}
