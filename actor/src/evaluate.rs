//! Evaluations: episodes from falls that their seeds alone determine, under the mean action at β̂ = β^i exactly.
//!
//! The result does not depend on who plays it or on how many lanes: the landed states come from the seeds, the task is
//! the paper's whatever training uses ([`TaskConfig::evaluation`]), and every row of a forward pass has the same
//! arithmetic in any batch.

use std::collections::HashMap;
use std::ops::ControlFlow;
use std::sync::Arc;

use getup_policy::{Forward, Policy, squash};
use getup_sim::rollout::{DivergedAt, Rollout, RolloutFile};
use getup_sim::{GetUp, Lane, SimError, Task, TaskConfig, UP_HEIGHT};
use thiserror::Error;

use crate::link::EpisodeResult;

/// A character stands whose head is up through this many last control steps: 2.5 s.
pub const STAND_STEPS: usize = 100;

/// One episode of an evaluation.
#[derive(Clone, PartialEq, Debug)]
pub struct EvaluatedEpisode {
    /// What determined the fall.
    pub seed: u64,
    /// Sum of the rewards; 0 where the simulation diverged, of which nothing is known.
    pub episode_return: f64,
    /// Height of the head after each control step, in metres.
    pub head_heights: Vec<f64>,
    /// Why the simulation failed, where it did, in the fall or after it; the episode ends there.
    pub diverged: Option<String>,
}

impl EvaluatedEpisode {
    /// An episode whose simulation failed.
    fn failed(seed: u64, cause: String) -> Self {
        Self { seed, episode_return: 0.0, head_heights: Vec::new(), diverged: Some(cause) }
    }

    /// The highest that the head was, in metres.
    pub fn max_head_height(&self) -> f64 {
        self.head_heights.iter().copied().fold(0.0, f64::max)
    }

    /// Where the head was at the end, in metres.
    pub fn final_head_height(&self) -> f64 {
        self.head_heights.last().copied().unwrap_or(0.0)
    }

    /// Whether the head was up at any step of a whole episode.
    pub fn rises(&self) -> bool {
        self.diverged.is_none() && self.max_head_height() >= UP_HEIGHT
    }

    /// Whether the head was up through the last [`STAND_STEPS`] steps of a whole episode.
    pub fn stands(&self) -> bool {
        let last = self.head_heights.iter().rev().take(STAND_STEPS);
        self.diverged.is_none()
            && self.head_heights.len() >= STAND_STEPS
            && last.into_iter().all(|height| *height >= UP_HEIGHT)
    }

    /// The episode as it is reported to the learner.
    pub fn result(&self) -> EpisodeResult {
        EpisodeResult {
            episode_return: self.episode_return,
            max_head_height: self.max_head_height(),
            final_head_height: self.final_head_height(),
            rises: self.rises(),
            stands: self.stands(),
        }
    }
}

/// Why an evaluation ended without a result.
#[derive(Clone, PartialEq, Debug, Error)]
pub enum EvaluateError {
    /// The policy is of another shape than the task.
    #[error(
        "the policy maps {policy:?} numbers, the character {task:?}: evaluate it with the character it was trained on"
    )]
    Shape {
        /// Its observation and action widths.
        policy: (usize, usize),
        /// The task's.
        task: (usize, usize),
    },
    /// A torque limit that is none, or that the actuators clamp.
    #[error("β is {beta}: it must be over 0 and at most {limit}, the actuators' clamp")]
    Beta {
        /// As given.
        beta: f64,
        /// The clamp.
        limit: f64,
    },
    /// Whoever watched its progress ended it.
    #[error("the evaluation was ended before it was complete")]
    Ended,
}

/// Plays evaluations of one character; keeps the landed states of falls for the next one.
pub struct Evaluator {
    task: Arc<GetUp>,
    players: Vec<Player>,
    landed: HashMap<u64, Fall>,
}

/// Where a fall ended, or why its simulation failed.
type Fall = Result<Arc<Landed>, String>;

/// Where a fall ended.
struct Landed {
    qpos: Vec<f64>,
    qvel: Vec<f64>,
}

/// One lane, and the episode that it plays.
struct Player {
    lane: Lane,
    playing: Option<Playing>,
    observation: Vec<f32>,
    action: Vec<f32>,
}

struct Playing {
    /// Its place among the seeds.
    index: usize,
    episode: EvaluatedEpisode,
    rollout: Option<Rollout>,
}

/// An episode and, where it was asked for, its recording.
type Played = (EvaluatedEpisode, Option<Rollout>);

impl Evaluator {
    /// An evaluator for the character and physics of `training`, which plays up to `lanes` episodes at a time.
    ///
    /// `control_limit`: the actuators' clamp, as the training task has it; no β may be above.
    ///
    /// # Errors
    /// [`SimError`] for settings out of range.
    ///
    /// # Panics
    /// With no lanes.
    pub fn new(training: &TaskConfig, control_limit: f64, lanes: usize) -> Result<Self, SimError> {
        assert!(lanes > 0, "an evaluator needs a lane");
        let task = Arc::new(GetUp::new(&training.evaluation(), control_limit)?);
        let players = (0..lanes).map(|_| Player::new(task.clone())).collect();
        Ok(Self { task, players, landed: HashMap::new() })
    }

    /// Plays one episode a seed, and returns them in the order of the seeds.
    ///
    /// `progress` is told how many episodes are done, now and then, and may end the evaluation.
    ///
    /// # Errors
    /// [`EvaluateError`]; an episode that diverges under the policy is a result, not an error.
    pub fn evaluate(
        &mut self,
        policy: &Policy,
        beta: f64,
        seeds: &[u64],
        progress: impl FnMut(usize) -> ControlFlow<()>,
    ) -> Result<Vec<EvaluatedEpisode>, EvaluateError> {
        let played = self.play(policy, beta, seeds, false, progress)?;
        Ok(played.into_iter().map(|(episode, _)| episode).collect())
    }

    /// As [`evaluate`](Self::evaluate), with recordings that `getup rollout` and any other MuJoCo can replay.
    ///
    /// # Errors
    /// As [`evaluate`](Self::evaluate).
    pub fn record(
        &mut self,
        policy: &Policy,
        beta: f64,
        seeds: &[u64],
        progress: impl FnMut(usize) -> ControlFlow<()>,
    ) -> Result<(Vec<EvaluatedEpisode>, RolloutFile), EvaluateError> {
        let played = self.play(policy, beta, seeds, true, progress)?;
        let (episodes, rollouts): (Vec<_>, Vec<_>) = played.into_iter().unzip();
        let file = RolloutFile {
            character: self.players[0].lane.world().character(),
            physics_hz: self.task.physics_hz(),
            control_hz: self.task.control_hz(),
            control_limit: self.task.control_limit(),
            rollouts: rollouts.into_iter().flatten().collect(),
        };
        Ok((episodes, file))
    }

    fn play(
        &mut self,
        policy: &Policy,
        beta: f64,
        seeds: &[u64],
        record: bool,
        mut progress: impl FnMut(usize) -> ControlFlow<()>,
    ) -> Result<Vec<Played>, EvaluateError> {
        self.check(policy, beta)?;
        let mut forward = Forward::new(policy, self.players.len());
        let mut batch = Vec::with_capacity(self.players.len() * policy.shape.observation);
        let mut played: Vec<Option<Played>> = vec![None; seeds.len()];
        let mut waiting = seeds.iter().copied().enumerate();
        let mut done = 0;
        self.players.iter_mut().for_each(|player| player.playing = None);
        while done < seeds.len() {
            if progress(done).is_break() {
                return Err(EvaluateError::Ended);
            }
            for (index, failed) in self.seat(&mut waiting, beta, record) {
                played[index] = Some((failed, None));
                done += 1;
            }
            batch.clear();
            for player in self.players.iter().filter(|player| player.playing.is_some()) {
                batch.extend_from_slice(&player.observation);
            }
            let heads = forward.run(&batch);
            let mut means = heads.mean.chunks_exact(policy.shape.action);
            for player in self.players.iter_mut().filter(|player| player.playing.is_some()) {
                let mean = means.next().expect("the batch has a row for every lane that plays");
                if let Some((index, episode)) = player.step(mean, beta as f32) {
                    played[index] = Some(episode);
                    done += 1;
                }
            }
        }
        let _ = progress(done);
        Ok(played.into_iter().flatten().collect())
    }

    fn check(&self, policy: &Policy, beta: f64) -> Result<(), EvaluateError> {
        let task = (self.task.observation_width(), self.task.action_width());
        let policy = (policy.shape.observation, policy.shape.action);
        if policy != task {
            return Err(EvaluateError::Shape { policy, task });
        }
        let limit = self.task.control_limit();
        if !(beta > 0.0 && beta <= limit) {
            return Err(EvaluateError::Beta { beta, limit });
        }
        Ok(())
    }

    /// Gives every free lane one more seed, and returns the episodes that end before they begin: their falls failed.
    fn seat(
        &mut self,
        waiting: &mut impl Iterator<Item = (usize, u64)>,
        beta: f64,
        record: bool,
    ) -> Vec<(usize, EvaluatedEpisode)> {
        let mut failed = Vec::new();
        for player in self.players.iter_mut().filter(|player| player.playing.is_none()) {
            let Some((index, seed)) = waiting.next() else { break };
            match self.landed.entry(seed).or_insert_with(|| player.fall(seed)) {
                Ok(landed) => player.begin(index, seed, landed, beta, record),
                Err(cause) => failed.push((index, EvaluatedEpisode::failed(seed, cause.clone()))),
            }
        }
        failed
    }
}

impl Player {
    fn new(task: Arc<GetUp>) -> Self {
        let observation = vec![0.0; task.observation_width()];
        let action = vec![0.0; task.action_width()];
        Self { lane: Lane::new(task), playing: None, observation, action }
    }

    /// Plays the fall that `seed` determines.
    fn fall(&mut self, seed: u64) -> Fall {
        self.lane.begin(seed, 1.0);
        self.lane.fall().map_err(|diverged| format!("the fall: {}", diverged.cause))?;
        Ok(Arc::new(Landed { qpos: self.lane.qpos().to_vec(), qvel: self.lane.qvel().to_vec() }))
    }

    fn begin(&mut self, index: usize, seed: u64, landed: &Landed, beta: f64, record: bool) {
        let Landed { qpos, qvel } = landed;
        self.lane.begin_at(qpos, qvel, beta).expect("a landed state is one of this character's");
        self.lane.observe(&mut self.observation);
        let rollout = record.then(|| Rollout {
            beta,
            qpos0: qpos.clone(),
            qvel0: qvel.clone(),
            observations: vec![self.lane.observation().to_vec()],
            ..Rollout::default()
        });
        let episode =
            EvaluatedEpisode { seed, episode_return: 0.0, head_heights: Vec::new(), diverged: None };
        self.playing = Some(Playing { index, episode, rollout });
    }

    /// Plays the mean action; the episode is returned when it is over.
    fn step(&mut self, mean: &[f32], beta: f32) -> Option<(usize, Played)> {
        for (component, mean) in self.action.iter_mut().zip(mean) {
            *component = squash(*mean, beta);
        }
        let Playing { episode, rollout, .. } = self.playing.as_mut()?;
        if let Some(rollout) = rollout {
            rollout.actions.push(self.action.iter().map(|component| f64::from(*component)).collect());
        }
        let over = match self.lane.step(&self.action) {
            Ok(step) => {
                episode.episode_return += self.lane.reward();
                episode.head_heights.push(self.lane.head_height());
                if let Some(rollout) = rollout {
                    rollout.push_step(&self.lane);
                }
                step.terminal || step.truncated
            }
            Err(diverged) => {
                let cause = diverged.cause.to_string();
                *episode = EvaluatedEpisode {
                    head_heights: std::mem::take(&mut episode.head_heights),
                    ..EvaluatedEpisode::failed(episode.seed, cause.clone())
                };
                if let Some(rollout) = rollout {
                    rollout.diverged = Some(DivergedAt { step: diverged.step, cause });
                }
                true
            }
        };
        self.lane.observe(&mut self.observation);
        if !over {
            return None;
        }
        self.playing.take().map(|Playing { index, episode, rollout }| (index, (episode, rollout)))
    }
}
