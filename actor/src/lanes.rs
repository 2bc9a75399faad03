//! Lanes stepped together: one forward pass serves all that are in their control phase.
//!
//! A [`LaneGroup`] knows no thread, no runtime and no network: whoever holds it calls [`LaneGroup::step`] and sends
//! the segments that come out, and gives it a newer policy between two steps. The same seed, policies and steps give
//! the same segments.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use getup_policy::{Forward, PolicyShape};
use getup_proto::{PolicyVersion, RunSpec, Segment};
use getup_sim::{Diverged, Lane, Phase, Step, Task};
use getup_telemetry::Traces;
use rand::{Rng, RngCore};
use rand_chacha::ChaCha8Rng;
use thiserror::Error;

use crate::config::ActorConfig;
use crate::divergence::DivergenceLog;
use crate::explore::{BetaDraw, Noise, sample_action, uniform_action};
use crate::identity::Identity;
use crate::link::PolicyUpdate;
use crate::metrics::ActorMetrics;
use crate::pool::FallPool;
use crate::segments::{LayoutError, SegmentBuilder, StepEnd, StepRecord};

/// A policy of another shape than the task.
#[derive(Clone, PartialEq, Eq, Debug, Error)]
#[error(
    "policy {version} maps {policy_observation} numbers to {policy_action}, the task {observation} to {action}: \
     the learner trains another character or task"
)]
pub struct ShapeError {
    version: PolicyVersion,
    policy_observation: usize,
    policy_action: usize,
    observation: usize,
    action: usize,
}

/// What the lanes of an actor have in common.
#[derive(Clone)]
pub struct LaneSettings {
    /// What they play.
    pub task: Arc<dyn Task>,
    /// How they play it.
    pub config: ActorConfig,
    /// What their segments look like.
    pub spec: RunSpec,
    /// Who plays.
    pub identity: Identity,
    /// How β̂ is drawn.
    pub beta: BetaDraw,
    /// Where the states of diverged episodes are kept.
    pub diverged_folder: PathBuf,
    /// What is counted.
    pub metrics: ActorMetrics,
    /// What follows some of the segments.
    pub traces: Traces,
}

/// Lanes that are stepped together.
pub struct LaneGroup {
    settings: LaneSettings,
    update: Arc<PolicyUpdate>,
    forward: Forward,
    players: Vec<Player>,
    /// `[lanes in control, observation]`.
    batch: Vec<f32>,
    divergences: DivergenceLog,
    pool: FallPool,
}

impl LaneGroup {
    /// Lanes `first_lane..first_lane + lanes` of an actor, under their first policy.
    ///
    /// # Errors
    /// [`GroupError`] when the spec or the policy does not fit the task.
    pub fn new(
        settings: LaneSettings,
        first_lane: u32,
        lanes: usize,
        update: Arc<PolicyUpdate>,
    ) -> Result<Self, GroupError> {
        check_shape(&*settings.task, &update)?;
        let last_lane = first_lane + lanes as u32;
        let players = (first_lane..last_lane).map(|lane| Player::new(&settings, lane));
        let mut players = players.collect::<Result<Vec<_>, _>>()?;
        let mut pool = FallPool::new(settings.config.fall_pool, settings.config.fall_renewal);
        players.iter_mut().for_each(|player| player.begin(0, &settings, &update, &mut pool));
        Ok(Self {
            forward: Forward::new(&update.policy, lanes),
            batch: Vec::with_capacity(lanes * settings.task.observation_width()),
            divergences: DivergenceLog::new(settings.diverged_folder.clone()),
            pool,
            players,
            update,
            settings,
        })
    }

    /// Acts by another policy from the next step on. β̂ of an episode under way stays.
    ///
    /// # Errors
    /// [`ShapeError`] when it does not fit the task; the group is then as it was.
    pub fn set_policy(&mut self, update: Arc<PolicyUpdate>) -> Result<(), ShapeError> {
        check_shape(&*self.settings.task, &update)?;
        self.forward = Forward::new(&update.policy, self.players.len());
        self.update = update;
        Ok(())
    }

    /// The policy that acts.
    pub fn policy(&self) -> &Arc<PolicyUpdate> {
        &self.update
    }

    /// Plays one control step on every lane; the segments that it completes are added to `out`.
    pub fn step(&mut self, out: &mut Vec<Segment>) {
        let start = Instant::now();
        self.batch.clear();
        for player in self.players.iter().filter(|player| player.acts()) {
            self.batch.extend_from_slice(&player.observation);
        }
        // Uniform actions need no network.
        let rows = if self.update.uniform { &[][..] } else { &self.batch[..] };
        let heads = self.forward.run(rows);
        let forward_done = Instant::now();

        let width = self.settings.task.action_width();
        let mut rows = heads.mean.chunks_exact(width).zip(heads.log_std.chunks_exact(width));
        for player in &mut self.players {
            if player.delay > 0 {
                player.delay -= 1;
                continue;
            }
            let row = if player.acts() { rows.next() } else { None };
            player.choose(row);
            match player.play(&self.update, &self.settings.metrics, &mut self.pool) {
                Ok(segment) => out.extend(segment),
                Err(diverged) => {
                    self.settings.metrics.diverged_episodes.inc();
                    self.divergences.keep(&self.settings.identity, player.index, player.episode, &diverged);
                    player.over = true;
                }
            }
            if player.over {
                player.begin(player.episode + 1, &self.settings, &self.update, &mut self.pool);
            }
        }
        let metrics = &self.settings.metrics;
        metrics.forward_seconds.inc_by((forward_done - start).as_secs_f64());
        metrics.physics_seconds.inc_by(forward_done.elapsed().as_secs_f64());
    }
}

/// Why a group of lanes cannot be made.
#[derive(Debug, Error)]
pub enum GroupError {
    /// The policy does not fit the task.
    #[error(transparent)]
    Shape(#[from] ShapeError),
    /// The spec does not.
    #[error(transparent)]
    Layout(#[from] LayoutError),
}

fn check_shape(task: &dyn Task, update: &PolicyUpdate) -> Result<(), ShapeError> {
    let (observation, action) = (task.observation_width(), task.action_width());
    let PolicyShape { observation: policy_observation, action: policy_action, .. } = update.policy.shape;
    if (policy_observation, policy_action) == (observation, action) {
        return Ok(());
    }
    Err(ShapeError { version: update.version, policy_observation, policy_action, observation, action })
}

/// One lane with what an actor adds to it.
struct Player {
    lane: Lane,
    index: u32,
    /// Steps that it still sits out: the lanes begin one after another, so that their falls do not coincide for good.
    delay: usize,
    episode: u64,
    over: bool,
    /// Whether the episode began with a fall, whose landing the pool takes.
    falls: bool,
    beta: f32,
    rng: ChaCha8Rng,
    builder: SegmentBuilder,
    store_limp: bool,
    observation: Vec<f32>,
    next_observation: Vec<f32>,
    action: Vec<f32>,
    noise: Noise,
}

impl Player {
    fn new(settings: &LaneSettings, index: u32) -> Result<Self, LayoutError> {
        let LaneSettings { task, config, spec, identity, .. } = settings;
        let (observation, action) = (task.observation_width(), task.action_width());
        let episode_steps = task.episode_steps() + task.resets().longest();
        Ok(Self {
            lane: Lane::new(task.clone()),
            index,
            delay: index as usize * episode_steps / config.lanes,
            episode: 0,
            over: false,
            falls: false,
            beta: 0.0,
            rng: identity.episode_rng(index, 0),
            builder: SegmentBuilder::new(
                spec,
                observation,
                action,
                config.segment_steps,
                identity.writer,
                index,
            )?
            .followed_by(settings.traces.clone()),
            store_limp: config.store_limp,
            observation: vec![0.0; observation],
            next_observation: vec![0.0; observation],
            action: vec![0.0; action],
            noise: Noise::new(action, config.noise_hold),
        })
    }

    fn begin(&mut self, episode: u64, settings: &LaneSettings, update: &PolicyUpdate, pool: &mut FallPool) {
        self.episode = episode;
        self.over = false;
        self.rng = settings.identity.episode_rng(self.index, episode);
        let seed = self.rng.next_u64();
        self.beta = settings.beta.told_by(&update.values).draw(update.beta, &mut self.rng);
        self.noise.release();
        // Nothing is drawn where nothing is chosen: a run without these settings keeps its episodes.
        let high = update.high_starts > 0.0 && self.rng.random_bool(update.high_starts);
        if high {
            self.lane.begin_standing(seed, self.beta.into());
        } else if let Some((qpos, qvel)) = pool.draw(&mut self.rng) {
            let begun = self.lane.begin_at(qpos, qvel, self.beta.into());
            begun.expect("a landed state is one of this character's");
        } else {
            self.lane.begin(seed, self.beta.into());
        }
        self.falls = !high && self.lane.phase() == Phase::Limp;
        self.lane.observe(&mut self.observation);
        self.builder.begin(episode, update.stage, self.beta);
    }

    /// Whether the policy acts next.
    fn acts(&self) -> bool {
        self.delay == 0 && self.lane.phase() == Phase::Control
    }

    /// Chooses the next action: from the heads' row, uniformly where there is none, or limp.
    fn choose(&mut self, row: Option<(&[f32], &[f32])>) {
        match (self.lane.phase(), row) {
            (Phase::Limp, _) => self.lane.limp_action(&mut self.action),
            (Phase::Control, Some((mean, log_std))) => {
                let noise = self.noise.next(&mut self.rng);
                sample_action(mean, log_std, noise, self.beta, &mut self.action);
            }
            (Phase::Control, None) => uniform_action(self.beta, &mut self.rng, &mut self.action),
        }
    }

    /// Plays the chosen action.
    fn play(
        &mut self,
        update: &PolicyUpdate,
        metrics: &ActorMetrics,
        pool: &mut FallPool,
    ) -> Result<Option<Segment>, Diverged> {
        let env_step = self.lane.phase() == Phase::Control;
        let step = self.lane.step(&self.action)?;
        if step.landed && self.falls {
            let (qpos, qvel) = self.lane.phase_start();
            pool.put(qpos, qvel, &mut self.rng);
        }
        self.lane.observe(&mut self.next_observation);
        let segment = if env_step || self.store_limp {
            self.builder.push(&StepRecord {
                observation: &self.observation,
                action: &self.action,
                reward: step.reward,
                next_observation: &self.next_observation,
                env_step,
                version: update.version,
                end: end_of(&step),
            })
        } else {
            self.builder.skip();
            None
        };
        std::mem::swap(&mut self.observation, &mut self.next_observation);
        self.over = step.terminal || step.truncated;
        if env_step {
            metrics.env_steps.inc();
        } else {
            metrics.limp_steps.inc();
        }
        if let Some(end) = segment.as_ref().and_then(|segment| segment.end.as_ref()) {
            metrics.episode_return.observe(end.episode_return.into());
        }
        Ok(segment)
    }
}

fn end_of(step: &Step) -> StepEnd {
    match step {
        Step { terminal: true, .. } => StepEnd::Terminal,
        Step { truncated: true, .. } => StepEnd::TimeLimit,
        Step { landed: true, .. } => StepEnd::Landed,
        _ => StepEnd::Continues,
    }
}
