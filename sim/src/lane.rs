//! One character playing episodes of one task: a fall or a high start, then control steps until the time limit or a
//! terminal state.
//!
//! A [`Lane`] does nothing by itself: its owner draws β̂, chooses actions and begins the next episode. Stepping
//! allocates nothing. Everything an episode starts with comes from its seed, and everything after the landing from the
//! landed state and the actions, so an episode can be repeated anywhere.

use std::sync::Arc;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::error::SimError;
use crate::reset::{Fall, Source};
use crate::rollout::{Rollout, RolloutFile};
use crate::task::Task;
use crate::world::{Divergence, World};

/// Where in its episode a lane is.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Phase {
    /// Falling: actions are [`Lane::limp_action`]'s, and steps count for nothing.
    Limp,
    /// Getting up: actions are the policy's, and steps are env steps.
    Control,
}

/// What one control step led to.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Step {
    /// The reward for the state now, in [0, 1].
    pub reward: f32,
    /// The state now ends the episode for good.
    pub terminal: bool,
    /// The episode is over because its time is up: a critic bootstraps through it.
    pub truncated: bool,
    /// This was the last limp step: the character has landed and the next action is the policy's.
    pub landed: bool,
}

/// A simulation that failed. The lane needs a new beginning; nothing else is lost.
#[derive(Clone, Debug, thiserror::Error)]
#[error("the simulation of character {} diverged in step {step} of the {phase:?} phase: {cause}", recording.character)]
pub struct Diverged {
    /// What went wrong first.
    pub cause: Divergence,
    /// In which phase.
    pub phase: Phase,
    /// In which of the phase's steps, from 0.
    pub step: usize,
    /// The phase's first state and all its actions, the fatal one last: `getup rollout` repeats the failure from it. One
    /// that is no number is left out, as JSON has none.
    pub recording: Box<RolloutFile>,
}

/// One world playing episodes of one task.
pub struct Lane {
    task: Arc<dyn Task>,
    world: World,
    /// The episode's own: seeded by [`begin`](Lane::begin).
    rng: ChaCha8Rng,
    /// The fall under way; none in the control phase.
    fall: Option<Fall>,
    /// β̂ of the episode.
    beta: f64,
    /// Steps done in this phase.
    steps: usize,
    /// The highest that the head was in this phase, in metres.
    highest: f64,
    recording: Recording,
    observation: Vec<f64>,
    terms: Vec<f64>,
    reward: f64,
}

/// The current phase from its first state, so that a divergence can be repeated.
struct Recording {
    qpos0: Vec<f64>,
    qvel0: Vec<f64>,
    /// Steps × action width; room for the longest phase is made once.
    actions: Vec<f64>,
}

impl Lane {
    /// A lane at the default pose with β̂ = 1, waiting for its first [`begin`](Lane::begin).
    pub fn new(task: Arc<dyn Task>) -> Lane {
        let world = task.world();
        let longest = task.episode_steps().max(task.resets().longest()).max(task.standing().limp_steps);
        let mut lane = Lane {
            rng: ChaCha8Rng::seed_from_u64(0),
            fall: None,
            beta: 1.0,
            steps: 0,
            highest: 0.0,
            recording: Recording {
                qpos0: world.qpos().to_vec(),
                qvel0: world.qvel().to_vec(),
                actions: Vec::with_capacity(longest * task.action_width()),
            },
            observation: vec![0.0; task.observation_width()],
            terms: vec![0.0; task.term_names().len()],
            reward: 0.0,
            world,
            task,
        };
        lane.look();
        lane
    }

    /// Begins an episode: draws its source and its first pose from the seed alone, and keeps β̂ for the whole of it.
    pub fn begin(&mut self, episode_seed: u64, beta: f64) {
        self.rng = ChaCha8Rng::seed_from_u64(episode_seed);
        let Source::Fall(fall) = self.task.resets().draw(&mut self.rng);
        fall.draw_pose(&mut self.world, &mut self.rng, &mut self.recording.qpos0);
        self.recording.qvel0.fill(0.0);
        self.fall = (fall.limp_steps > 0).then(|| fall.clone());
        self.beta = beta;
        self.enter();
    }

    /// Begins an episode high: see [`Standing`](crate::Standing). Draws everything from the seed alone.
    pub fn begin_standing(&mut self, episode_seed: u64, beta: f64) {
        self.rng = ChaCha8Rng::seed_from_u64(episode_seed);
        let standing = self.task.standing();
        standing.draw_pose(&mut self.world, &mut self.rng, &mut self.recording.qpos0);
        let limp_steps = standing.draw_limp_steps(&mut self.rng);
        self.recording.qvel0.fill(0.0);
        // Limp as at the end of a fall.
        let Source::Fall(fall) = self.task.resets().draw(&mut self.rng);
        self.fall = (limp_steps > 0).then(|| Fall { limp_steps, ..fall.clone() });
        self.beta = beta;
        self.enter();
    }

    /// Begins an episode at a given state, straight in the control phase.
    ///
    /// # Errors
    /// [`SimError::Length`] or [`SimError::NotFinite`]; the lane is then as it was.
    pub fn begin_at(&mut self, qpos: &[f64], qvel: &[f64], beta: f64) -> Result<(), SimError> {
        self.world.set(qpos, qvel)?;
        self.recording.qpos0.copy_from_slice(qpos);
        self.recording.qvel0.copy_from_slice(qvel);
        self.fall = None;
        self.beta = beta;
        self.enter();
        Ok(())
    }

    /// Starts a phase at the recording's first state.
    fn enter(&mut self) {
        let Recording { qpos0, qvel0, actions } = &mut self.recording;
        self.world
            .set(qpos0, qvel0)
            .expect("a drawn, given or landed state has the right lengths and sane numbers");
        actions.clear();
        self.steps = 0;
        self.highest = 0.0;
        self.look();
    }

    /// Brings observation, terms and reward up to date.
    fn look(&mut self) {
        self.task.observe(&self.world, self.beta, &mut self.observation);
        self.reward = self.task.reward(&self.world, &mut self.terms);
        self.highest = self.highest.max(self.world.head_height());
    }

    /// Where in its episode the lane is.
    pub fn phase(&self) -> Phase {
        if self.fall.is_some() { Phase::Limp } else { Phase::Control }
    }

    /// Draws the next limp action from the episode's own generator: one number a motor. Zeros when not falling.
    pub fn limp_action(&mut self, action: &mut [f32]) {
        match &self.fall {
            Some(fall) => fall.draw_action(&mut self.rng, action),
            None => action.fill(0.0),
        }
    }

    /// Plays the limp steps of an episode to their end; how many there were.
    ///
    /// # Errors
    /// As [`step`](Lane::step).
    pub fn fall(&mut self) -> Result<usize, Diverged> {
        let mut action = vec![0.0; self.task.action_width()];
        let mut limp_steps = 0;
        while self.phase() == Phase::Limp {
            self.limp_action(&mut action);
            self.step(&action)?;
            limp_steps += 1;
        }
        Ok(limp_steps)
    }

    /// Plays one control step.
    ///
    /// `action`: one number a motor, in units of its torque limit; the motors clamp it.
    ///
    /// # Errors
    /// [`Diverged`], with what it takes to repeat it. Begin the lane anew.
    ///
    /// # Panics
    /// If `action` has not one number a motor.
    pub fn step(&mut self, action: &[f32]) -> Result<Step, Diverged> {
        self.act(action.iter().map(|&component| f64::from(component)))
    }

    /// [`step`](Lane::step) in double precision, as recorded rollouts need it.
    ///
    /// # Errors
    /// As [`step`](Lane::step).
    ///
    /// # Panics
    /// As [`step`](Lane::step).
    pub fn step_f64(&mut self, action: &[f64]) -> Result<Step, Diverged> {
        self.act(action.iter().copied())
    }

    fn act(&mut self, action: impl Iterator<Item = f64>) -> Result<Step, Diverged> {
        let actions = &mut self.recording.actions;
        let from = actions.len();
        actions.extend(action);
        self.world.step(&actions[from..], self.task.substeps()).map_err(|cause| self.diverged(cause))?;
        self.steps += 1;
        let landed = self.fall.as_ref().is_some_and(|fall| self.steps == fall.limp_steps);
        if landed {
            self.land();
        } else {
            self.look();
        }
        let in_control = self.fall.is_none() && !landed;
        Ok(Step {
            reward: self.reward as f32,
            terminal: in_control && self.task.is_terminal(&self.world, self.highest),
            truncated: in_control && self.steps >= self.task.episode_steps(),
            landed,
        })
    }

    /// Ends the fall. The state is set afresh from its positions and velocities: what MuJoCo carries over from the
    /// fall (its warm start) would make the episode depend on more than the landed state.
    fn land(&mut self) {
        self.recording.qpos0.copy_from_slice(self.world.qpos());
        self.recording.qvel0.copy_from_slice(self.world.qvel());
        self.fall = None;
        self.enter();
    }

    fn diverged(&self, cause: Divergence) -> Diverged {
        let Recording { qpos0, qvel0, actions } = &self.recording;
        let rollout = Rollout {
            beta: self.beta,
            qpos0: qpos0.clone(),
            qvel0: qvel0.clone(),
            actions: actions
                .chunks(self.task.action_width())
                .filter(|action| action.iter().all(|control| control.is_finite()))
                .map(<[f64]>::to_vec)
                .collect(),
            ..Rollout::default()
        };
        let recording = Box::new(RolloutFile {
            character: self.world.character(),
            physics_hz: self.task.physics_hz(),
            control_hz: self.task.control_hz(),
            control_limit: self.task.control_limit(),
            rollouts: vec![rollout],
        });
        Diverged { cause, phase: self.phase(), step: self.steps, recording }
    }

    /// Writes the observation of the state now.
    ///
    /// # Panics
    /// If `observation` is not the task's observation width long.
    pub fn observe(&self, observation: &mut [f32]) {
        assert_eq!(observation.len(), self.observation.len(), "an observation has the task's width");
        for (out, &value) in observation.iter_mut().zip(&self.observation) {
            *out = value as f32;
        }
    }

    /// The state in which this phase began: positions and velocities. At a landing, that is the landed state.
    pub fn phase_start(&self) -> (&[f64], &[f64]) {
        (&self.recording.qpos0, &self.recording.qvel0)
    }

    /// The observation of the state now, in double precision.
    pub fn observation(&self) -> &[f64] {
        &self.observation
    }

    /// The reward's terms for the state now, named by [`Task::term_names`].
    pub fn terms(&self) -> &[f64] {
        &self.terms
    }

    /// The reward for the state now.
    pub fn reward(&self) -> f64 {
        self.reward
    }

    /// β̂ of the episode.
    pub fn beta(&self) -> f64 {
        self.beta
    }

    /// Steps done in the current phase.
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// Height of the head's centre above the floor, in metres.
    pub fn head_height(&self) -> f64 {
        self.world.head_height()
    }

    /// The world the lane plays in.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Positions now: see [`World::nq`].
    pub fn qpos(&self) -> &[f64] {
        self.world.qpos()
    }

    /// Velocities now: see [`World::nv`].
    pub fn qvel(&self) -> &[f64] {
        self.world.qvel()
    }
}
