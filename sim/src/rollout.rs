//! Recorded rollouts, in and out: how an outsider checks this simulation, and how a divergence is repeated.
//!
//! A [`RolloutFile`] is JSON in the format of the golden files in `tests/golden/`. Of a rollout, [`replay`] needs
//! `beta`, `qpos0`, `qvel0` and `actions`; what it adds is `observations` (one more than actions), `rewards`,
//! `terms` (stand, straight, still, feet) and `qpos` (after each control step), each in double precision, printed so
//! that reading it back gives the same bits. Unknown keys are ignored.

use std::sync::Arc;

use serde::{Serialize, Serializer};

use crate::character::Character;
use crate::config::TaskConfig;
use crate::error::SimError;
use crate::getup::GetUp;
use crate::lane::Lane;
use crate::task::Task;

pub use crate::rollout_json::RolloutError;

/// Rollouts of one character under one timing.
#[derive(Clone, PartialEq, Debug, Serialize)]
pub struct RolloutFile {
    /// Key `variant`: `standard`, `Disabled` (the cast) or `Noarm` (one arm); also by our own names. Absent:
    /// `standard`.
    #[serde(rename = "variant", serialize_with = "variant_name")]
    pub character: Character,
    /// Physics steps a second, 200 or 800. Absent: 200.
    pub physics_hz: u32,
    /// Control steps a second: 40.
    pub control_hz: u32,
    /// The motors' clamp, at least 1. Absent: 1.
    pub control_limit: f64,
    /// The rollouts.
    pub rollouts: Vec<Rollout>,
}

/// One rollout of T control steps.
#[derive(Clone, PartialEq, Debug, Default, Serialize)]
pub struct Rollout {
    /// β̂: the last number of each observation.
    pub beta: f64,
    /// The first positions: nq numbers.
    pub qpos0: Vec<f64>,
    /// The first velocities: nv numbers.
    pub qvel0: Vec<f64>,
    /// T × nu: in units of the torque limits.
    pub actions: Vec<Vec<f64>>,
    /// (T + 1) × observation width.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub observations: Vec<Vec<f64>>,
    /// T numbers.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub rewards: Vec<f64>,
    /// T × 4: stand, straight, still, feet.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub terms: Vec<Vec<f64>>,
    /// T × nq: positions after each control step.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub qpos: Vec<Vec<f64>>,
    /// Why and where the simulation failed, if it did: what is recorded above then ends before that step.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub diverged: Option<DivergedAt>,
}

/// Where a replay failed.
#[derive(Clone, PartialEq, Eq, Debug, Serialize)]
pub struct DivergedAt {
    /// The control step, from 0.
    pub step: usize,
    /// What went wrong first.
    pub cause: String,
}

/// The golden files' names of the characters.
fn variant_name<S: Serializer>(character: &Character, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(match character {
        Character::Standard => "standard",
        Character::Cast => "Disabled",
        Character::OneArm => "Noarm",
    })
}

/// Plays every rollout from its first state with its actions. `character` replaces the file's.
///
/// A simulation that fails does not fail the replay: its rollout says so, and the others go on.
///
/// # Errors
/// [`RolloutError`], naming the rollout, the field, what it holds and what it should hold.
pub fn replay(file: &RolloutFile, character: Option<Character>) -> Result<RolloutFile, RolloutError> {
    let character = character.unwrap_or(file.character);
    let config = TaskConfig { character, physics_hz: file.physics_hz, ..TaskConfig::default() };
    let task = Arc::new(GetUp::new(&config, file.control_limit)?);
    if file.control_hz != task.control_hz() {
        return Err(RolloutError::ControlHz { got: file.control_hz, wanted: task.control_hz() });
    }
    let mut lane = Lane::new(task.clone());
    let rollouts = file.rollouts.iter().enumerate();
    let rollouts = rollouts.map(|(index, rollout)| replay_one(&mut lane, &*task, index, rollout));
    Ok(RolloutFile { character, rollouts: rollouts.collect::<Result<_, _>>()?, ..file.clone() })
}

fn replay_one(
    lane: &mut Lane,
    task: &dyn Task,
    rollout: usize,
    given: &Rollout,
) -> Result<Rollout, RolloutError> {
    if !given.beta.is_finite() {
        return Err(RolloutError::NotFinite { rollout, field: "beta".to_owned(), got: given.beta });
    }
    for (step, action) in given.actions.iter().enumerate() {
        check_action(action, task.action_width(), rollout, step)?;
    }
    lane.begin_at(&given.qpos0, &given.qvel0, given.beta)
        .map_err(|error| RolloutError::state(rollout, error))?;
    let mut played = Rollout {
        beta: given.beta,
        qpos0: given.qpos0.clone(),
        qvel0: given.qvel0.clone(),
        actions: given.actions.clone(),
        observations: vec![lane.observation().to_vec()],
        ..Rollout::default()
    };
    for (step, action) in given.actions.iter().enumerate() {
        if let Err(diverged) = lane.step_f64(action) {
            played.diverged = Some(DivergedAt { step, cause: diverged.cause.to_string() });
            break;
        }
        played.push_step(lane);
    }
    Ok(played)
}

fn check_action(action: &[f64], wanted: usize, rollout: usize, step: usize) -> Result<(), RolloutError> {
    if action.len() != wanted {
        let field = format!("actions[{step}]");
        return Err(RolloutError::Length { rollout, field, got: action.len(), wanted });
    }
    match action.iter().position(|x| !x.is_finite()) {
        Some(at) => {
            let field = format!("actions[{step}][{at}]");
            Err(RolloutError::NotFinite { rollout, field, got: action[at] })
        }
        None => Ok(()),
    }
}

impl Rollout {
    /// Records where a control step led.
    pub fn push_step(&mut self, lane: &Lane) {
        self.observations.push(lane.observation().to_vec());
        self.rewards.push(lane.reward());
        self.terms.push(lane.terms().to_vec());
        self.qpos.push(lane.qpos().to_vec());
    }
}

impl RolloutError {
    /// What [`Lane::begin_at`] found wrong with the first state, with the rollout it is in.
    fn state(rollout: usize, error: SimError) -> RolloutError {
        match error {
            SimError::Length { field, got, wanted, .. } => {
                RolloutError::Length { rollout, field: format!("{field}0"), got, wanted }
            }
            SimError::NotFinite { field, index, got } => {
                RolloutError::NotFinite { rollout, field: format!("{field}0[{index}]"), got }
            }
            other => RolloutError::Sim(other),
        }
    }
}
