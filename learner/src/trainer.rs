//! Training: a minibatch in, an update out; and what an update brings with it.
//!
//! [`Trainer::tick`] is the whole of training on one minibatch: update, broadcast, offer an evaluation when one is
//! due, take what was reported, let the curriculum decide, write a checkpoint. [`Trainer::run`] feeds it from a
//! [`MinibatchSource`]; the deterministic mode of `getup train` feeds it step by step. Nothing here knows whether
//! replay and actors are in the same process.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use getup_proto::{PolicyVersion, TraceContext, columns, v1};
use getup_replay::{Minibatch, MinibatchSource, ReplayCounters, SampleError};
use getup_telemetry::traces::{KeyValue, SpanKind};
use getup_telemetry::{Registry, Shutdown, Traces};

use crate::beginning::Beginning;
use crate::checkpoint::{Checkpoint, CheckpointError, Progress};
use crate::config::{ConfigError, CurriculumConfig, EvaluationConfig, LearnerConfig, SacConfig};
use crate::curriculum::{Curriculum, Outcome};
use crate::hub::{Hub, Standing};
use crate::metrics::LearnerMetrics;
use crate::run_folder::{FolderError, RunFolder, write_atomically};
use crate::sac::{Batch, NonFiniteLoss, Sac, TaskShape};

mod broadcast;
mod checkpoints;
mod evaluations;
mod pace;
mod refill;

use checkpoints::Checkpoints;
use pace::Pace;
use refill::Refill;

/// How long the end of training waits for evaluations that are still out.
const LAST_REPORTS: Duration = Duration::from_secs(120);

/// A learner that gets no minibatch looks after its evaluations this often.
const STARVED: Duration = Duration::from_millis(500);

/// Why training stopped.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A setting.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The run's folder.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A checkpoint.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// A model file.
    #[error(transparent)]
    Model(#[from] getup_policy::ModelError),
    /// The loss.
    #[error("training stopped")]
    Loss(#[from] NonFiniteLoss),
    /// The replay.
    #[error("cannot sample from the replay")]
    Sample(#[from] SampleError),
    /// A minibatch lacks a column.
    #[error(
        "the replay's minibatches have no column {0:?}: do replay and learner run the same configuration?"
    )]
    Column(&'static str),
}

/// Everything that training a run depends on.
#[derive(Clone, Debug)]
pub struct TrainerConfig {
    /// The run's name, in models' metadata.
    pub run: String,
    /// The character, in models' metadata.
    pub character: String,
    /// Physics steps a second, likewise.
    pub physics_hz: u32,
    /// The run's seed.
    pub seed: u64,
    /// Replays that the run's transitions are in.
    pub replays: usize,
    /// Env steps after which training ends; none for the curriculum's end alone.
    pub steps: Option<u64>,
    /// What SAC must know of the task.
    pub shape: TaskShape,
    /// SAC.
    pub sac: SacConfig,
    /// The curriculum.
    pub curriculum: CurriculumConfig,
    /// Evaluations.
    pub evaluation: EvaluationConfig,
    /// The process.
    pub learner: LearnerConfig,
}

/// How training ended, or that it goes on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ending {
    /// The curriculum is over.
    Curriculum(Outcome),
    /// The run reached the env steps it was given.
    Steps(u64),
    /// It was asked to stop; the checkpoint resumes it.
    Shutdown,
}

/// What training starts from.
#[derive(Clone, Copy, Debug)]
pub enum Start<'a> {
    /// Networks drawn from the seed.
    Untrained,
    /// Another run's actor, and its critics where they are there and have the configured shape. Curriculum and counters
    /// begin anew.
    From(&'a Beginning),
    /// Where the run's newest checkpoint stands, if it has one.
    Newest,
}

/// The state of a training run.
pub struct Trainer {
    config: TrainerConfig,
    sac: Sac,
    curriculum: Curriculum,
    progress: Progress,
    hub: Arc<Hub>,
    folder: RunFolder,
    checkpoints: Checkpoints,
    metrics: LearnerMetrics,
    pace: Pace,
    refill: Refill,
    version: PolicyVersion,
    evaluation: Option<v1::EvaluationSummary>,
    /// Updates behind the policy that was offered for evaluation last.
    evaluated_updates: u64,
    ending: Option<Ending>,
    traces: Traces,
}

impl Trainer {
    /// Training from `start`; publishes its policy at once and, on a new run, offers it for evaluation.
    pub fn new(
        config: TrainerConfig,
        folder: RunFolder,
        hub: Arc<Hub>,
        incarnation: u64,
        start: Start<'_>,
        device: tch::Device,
        registry: &Registry,
    ) -> Result<Self, TrainError> {
        folder.create()?;
        let mut sac =
            Sac::new(&config.shape, &config.sac, config.seed, device, config.learner.effective_threads());
        let mut curriculum = Curriculum::new(config.curriculum.clone());
        let mut progress = Progress { next_evaluation: config.evaluation.every, ..Progress::default() };
        let resumed = match start {
            Start::Untrained => None,
            Start::From(beginning) => {
                beginning.begin(&mut sac)?;
                None
            }
            Start::Newest => Checkpoint::newest(&folder.checkpoints())?,
        };
        let is_resumed = resumed.is_some();
        if !is_resumed && !sac.is_trained() {
            config.sac.validate_untrained()?;
        }
        if let Some(checkpoint) = resumed {
            checkpoint.restore(&mut sac)?;
            curriculum = checkpoint.curriculum.with_config(config.curriculum.clone());
            progress = checkpoint.progress;
            tracing::info!(env_steps = progress.env_steps, updates = sac.updates(), "training resumes");
        }
        let metrics = LearnerMetrics::new(registry);
        let mut trainer = Self {
            checkpoints: Checkpoints::new(folder.checkpoints(), &config.learner, metrics.clone()),
            pace: Pace::new(sac.updates()),
            refill: Refill::new(config.sac.refill_steps, config.replays, hub.waits()),
            version: PolicyVersion { incarnation, counter: 0 },
            ending: curriculum.outcome().map(Ending::Curriculum).or(already_past(&config, &progress)),
            evaluation: None,
            evaluated_updates: 0,
            traces: Traces::default(),
            config,
            sac,
            curriculum,
            progress,
            hub,
            folder,
            metrics,
        };
        if matches!(trainer.ending, Some(Ending::Curriculum(_))) {
            trainer.publish_final()?;
        } else {
            let policy = trainer.publish();
            if !is_resumed || trainer.progress.evaluation_owed {
                trainer.offer(policy);
            }
        }
        if matches!(start, Start::From(_)) {
            // On disk before the run is one that can be resumed.
            trainer.checkpoint();
            trainer.checkpoints.finish()?;
        }
        trainer.show();
        Ok(trainer)
    }

    /// Ends the traces of segments that are followed with the update that each is first used in.
    pub fn followed_by(self, traces: Traces) -> Self {
        Self { traces, ..self }
    }

    /// How training ended; none while it goes on.
    pub fn ending(&self) -> Option<Ending> {
        self.ending
    }

    /// Trains on minibatches of `source` until the curriculum's end, the last env step, or `shutdown`, and leaves
    /// a checkpoint; also where the replay refuses to go on, which is not training's fault.
    pub fn run(
        &mut self,
        source: &mut dyn MinibatchSource,
        shutdown: &Shutdown,
    ) -> Result<Ending, TrainError> {
        let ended = self.train(source, shutdown).and_then(|()| self.finish());
        let refused = matches!(ended, Err(TrainError::Sample(_) | TrainError::Column(_)));
        if refused && self.sac.updates() > 0 {
            self.checkpoint();
            if let Err(error) = self.checkpoints.finish() {
                tracing::error!(%error, "the last checkpoint was not written");
            }
        }
        ended
    }

    fn train(&mut self, source: &mut dyn MinibatchSource, shutdown: &Shutdown) -> Result<(), TrainError> {
        let mut asked = Instant::now();
        while self.ending.is_none() && !shutdown.is_triggered() {
            match source.poll(STARVED) {
                Ok(Some(minibatch)) => {
                    self.metrics.wait_seconds.observe(asked.elapsed().as_secs_f64());
                    let priorities = self.tick(minibatch).inspect_err(|_| self.show_stopped())?;
                    if !priorities.is_empty() {
                        source.update_priorities(priorities)?;
                    }
                    asked = Instant::now();
                }
                Ok(None) => {
                    self.take_reports()?;
                    if self.pace.is_time_to_show() {
                        self.show();
                    }
                }
                Err(SampleError::Shutdown) => break,
                Err(error) => return Err(error.into()),
            }
        }
        if matches!(self.ending, Some(Ending::Steps(_))) {
            self.await_last_reports(shutdown)?;
        }
        Ok(())
    }

    /// One update and everything that follows from it.
    ///
    /// Returns the priorities of its transitions by their keys, where the replay draws by priority.
    pub fn tick(&mut self, minibatch: Minibatch) -> Result<Vec<(u64, f32)>, TrainError> {
        let keys: Vec<u64> = minibatch.items.iter().map(|item| item.key).collect();
        let before = self.sac.updates();
        self.learn(minibatch)?;
        if self.sac.updates() == before {
            return Ok(Vec::new());
        }
        Ok(keys.into_iter().zip(self.sac.td_errors().iter().copied()).collect())
    }

    fn learn(&mut self, mut minibatch: Minibatch) -> Result<(), TrainError> {
        let started = Instant::now();
        let followed = std::mem::take(&mut minibatch.traces);
        let began = (!followed.is_empty()).then(SystemTime::now);
        let env_steps = self.progress.env_steps;
        self.progress.count(&minibatch.counters);
        let refills = self.refill.goes_on(&minibatch.counters, self.made());
        if refills || self.sac.updates() < self.config.sac.critics_first {
            // The policy stays as it is.
            self.curriculum.pause(self.progress.env_steps - env_steps);
        }
        if refills {
            if self.pace.is_time_to_show() {
                self.show();
            }
            return self.take_reports();
        }
        let mut batch = Batch::from_minibatch(&mut minibatch)?;
        batch.weight = minibatch.importance_weights(self.config.sac.importance_exponent as f32);
        // The first minibatch comes at some env steps more than the uniform ones: of it, statistics are made in any case.
        if self.progress.env_steps < self.config.sac.normalize_until || !self.sac.is_trained() {
            self.sac.merge_statistics(&batch);
        }
        self.sac.anneal(self.progress.env_steps);
        let (batch_seconds, before) = (started.elapsed().as_secs_f64(), self.sac.phases());
        let losses = self.sac.update(&batch).inspect_err(|_| self.metrics.loss_not_finite.set(1))?;
        self.metrics.phases(batch_seconds, before, self.sac.phases());
        self.metrics.updates.inc();
        self.metrics.update_seconds.observe(started.elapsed().as_secs_f64());
        if let Some(began) = began {
            self.updated(&followed, began);
        }
        if self.pace.count() {
            self.metrics.losses(&losses);
            self.metrics.norms(&self.sac.norms());
            self.show();
        }
        self.take_reports()?;
        if self.ending.is_some() {
            return Ok(());
        }
        if self.progress.env_steps >= self.progress.next_evaluation {
            let every = self.config.evaluation.every;
            self.progress.next_evaluation = (self.progress.env_steps / every + 1) * every;
            let policy = self.publish();
            self.offer(policy);
        } else if self.sac.updates() == 1
            || self.sac.updates().is_multiple_of(self.config.learner.publish_every)
        {
            // The first update ends the uniform actions.
            self.publish();
        }
        if self.config.steps.is_some_and(|steps| self.progress.env_steps >= steps) {
            if self.evaluated_updates < self.sac.updates() {
                let policy = self.publish();
                self.offer(policy);
            }
            self.ending = Some(Ending::Steps(self.progress.env_steps));
        } else if self.checkpoints.due() {
            self.checkpoint();
        }
        Ok(())
    }

    /// Records an update, now over, for each segment that is followed to it.
    fn updated(&self, followed: &[TraceContext], began: SystemTime) {
        let now = SystemTime::now();
        for sampled in followed {
            let attributes = vec![
                KeyValue::new("getup.update", self.sac.updates() as i64),
                KeyValue::new("getup.policy_version", self.version.to_string()),
                KeyValue::new("getup.stage", i64::from(self.curriculum.stage())),
            ];
            self.traces.child(*sampled, ("update", SpanKind::Consumer), began, now, attributes);
        }
    }

    /// Takes every evaluation that was reported, in order, and lets the curriculum decide.
    pub fn take_reports(&mut self) -> Result<(), TrainError> {
        while let Some((evaluation, episodes)) = self.hub.take_reported() {
            self.progress.evaluation_owed = self.hub.outstanding() > 0;
            self.evaluated(&evaluation, &episodes)?;
        }
        Ok(())
    }

    /// The end of training: the last models and a checkpoint on disk, the final policy broadcast.
    pub fn finish(&mut self) -> Result<Ending, TrainError> {
        self.take_reports()?;
        let ending = self.ending.unwrap_or(Ending::Shutdown);
        // First what the run goes on from, whatever becomes of the rest.
        self.checkpoint();
        let last = self.describe(self.sac.evaluated_policy(), self.curriculum.stage_beta());
        write_atomically(&self.folder.model("last"), &last.to_bytes())?;
        if ending != Ending::Shutdown {
            self.publish_final()?;
        }
        self.checkpoints.finish()?;
        self.show();
        Ok(ending)
    }

    fn await_last_reports(&mut self, shutdown: &Shutdown) -> Result<(), TrainError> {
        let hub = Arc::clone(&self.hub);
        let wait = hub.waits().begin("learner", "the last evaluation is not reported yet".into());
        let until = Instant::now() + LAST_REPORTS;
        while hub.outstanding() > 0 && Instant::now() < until && !shutdown.is_triggered() {
            hub.wait_for_report(Duration::from_millis(200));
            self.take_reports()?;
        }
        drop(wait);
        Ok(())
    }

    /// What a replay that is new to this learner should hold, at most: see [`Refill::goes_on`].
    fn made(&self) -> u64 {
        match (self.sac.is_trained(), self.sac.updates()) {
            (false, _) => 0,
            (true, 0) => u64::MAX,
            (true, _) => self.progress.env_steps,
        }
    }

    fn checkpoint(&mut self) {
        let checkpoint = Checkpoint::take(&self.sac, &self.curriculum, &self.progress);
        self.checkpoints.write(checkpoint);
    }

    /// Tells hub and metrics where the training stands.
    fn show(&self) {
        let state = match self.ending {
            Some(_) => "finished",
            None if self.refill.is_going_on() => "filling",
            None if self.sac.updates() == 0 => "waiting",
            None => "training",
        };
        self.show_as(state, self.pace.per_second());
    }

    /// The same, once an update has failed and no other will follow.
    fn show_stopped(&self) {
        self.show_as("stopped", 0.0);
    }

    fn show_as(&self, state: &'static str, updates_per_second: f64) {
        let (stage, env_steps) = (self.curriculum.stage(), self.progress.env_steps);
        let stage_env_steps = self.curriculum.stage_steps(env_steps);
        let stage_limit = self.curriculum.stage_limit().unwrap_or(0);
        self.metrics.env_steps.set(env_steps as i64);
        self.metrics.beta.set(self.curriculum.beta());
        self.metrics.stage.set(i64::from(stage));
        self.metrics.stage_env_steps.set(stage_env_steps as i64);
        self.metrics.stage_limit_env_steps.set(stage_limit as i64);
        self.metrics.evaluations_outstanding.set(self.hub.outstanding() as i64);
        self.metrics.filling.set(i64::from(self.refill.is_going_on()));
        self.metrics.finished.set(i64::from(self.ending.is_some()));
        self.hub.set_standing(Standing {
            state,
            env_steps,
            updates: self.sac.updates(),
            updates_per_second,
            stage,
            beta: self.curriculum.beta(),
            stage_env_steps,
            stage_limit,
            evaluation: self.evaluation,
        });
    }
}

/// A resumed run may have made its steps already.
fn already_past(config: &TrainerConfig, progress: &Progress) -> Option<Ending> {
    config.steps.filter(|steps| progress.env_steps >= *steps).map(|_| Ending::Steps(progress.env_steps))
}

impl Progress {
    /// Takes a replay's counters: env steps of the run go on through a resumed checkpoint and through a new store, and
    /// several replays add up.
    fn count(&mut self, counters: &ReplayCounters) {
        let seen = self.stores.entry(counters.store).or_default();
        self.env_steps += counters.env_steps.saturating_sub(*seen);
        *seen = counters.env_steps.max(*seen);
    }
}

impl Batch {
    /// Takes the columns out of a minibatch.
    pub fn from_minibatch(minibatch: &mut Minibatch) -> Result<Self, TrainError> {
        let mut column = |name: &'static str| {
            let column = minibatch.columns.iter_mut().find(|column| column.name == name);
            column.map(|column| std::mem::take(&mut column.data)).ok_or(TrainError::Column(name))
        };
        Ok(Self {
            observation: column(columns::OBSERVATION)?,
            action: column(columns::ACTION)?,
            reward: column(columns::REWARD)?,
            next_observation: column("next_observation")?,
            discount: column(columns::DISCOUNT)?,
            beta: column(columns::BETA)?,
            weight: Vec::new(),
        })
    }
}
