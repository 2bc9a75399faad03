//! The bodies that learn: the paper's humanoid (Table 2) and its two variants (§6.3).
//!
//! [`Character`] names one; [`Character::compile`] makes its MuJoCo model from `humanoid.xml`, which is embedded
//! in the binary. The variants are edits of that one file, so they cannot drift from it.

use std::fmt;
use std::str::FromStr;

use mujoco_rs::prelude::*;
use serde::{Deserialize, Serialize};

use crate::error::SimError;

/// The standard character's MJCF.
const HUMANOID: &str = include_str!("humanoid.xml");

/// Which body is simulated.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Character {
    /// The whole humanoid: 21 motors, nq 28, nv 27.
    #[default]
    Standard,
    /// A straight left knee and a straight right elbow, each without a motor: 19 motors.
    Cast,
    /// No right arm: 18 motors.
    OneArm,
}

impl Character {
    /// Every character, in the order of the paper.
    pub const ALL: [Character; 3] = [Character::Standard, Character::Cast, Character::OneArm];

    /// The name used in configuration, on the command line and in every file: `standard`, `cast` or `one_arm`.
    pub fn name(self) -> &'static str {
        match self {
            Character::Standard => "standard",
            Character::Cast => "cast",
            Character::OneArm => "one_arm",
        }
    }

    /// The number of motors, and so of action components.
    pub fn motors(self) -> usize {
        match self {
            Character::Standard => 21,
            Character::Cast => 19,
            Character::OneArm => 18,
        }
    }

    /// The model at a `timestep` in seconds, its motors clamped to `±control_limit`.
    ///
    /// # Errors
    /// [`SimError::Model`] with MuJoCo's own words if it refuses the model.
    pub(crate) fn compile(self, timestep: f64, control_limit: f64) -> Result<MjModel, SimError> {
        self.spec(timestep, control_limit)
            .and_then(|mut spec| spec.compile())
            .map_err(|source| SimError::Model { character: self, reason: source.to_string() })
    }

    fn spec(self, timestep: f64, control_limit: f64) -> Result<MjSpec, MjEditError> {
        let mut spec = MjSpec::from_xml_string(HUMANOID)?;
        match self {
            Character::Standard => {}
            Character::Cast => put_into_casts(&mut spec)?,
            Character::OneArm => take_right_arm(&mut spec)?,
        }
        spec.option_mut().timestep = timestep;
        for motor in spec.actuator_iter_mut() {
            *motor.ctrlrange_mut() = [-control_limit, control_limit];
        }
        Ok(spec)
    }
}

/// Locks the left knee straight (its resting pose) and bends the right forearm into the line of the upper arm.
fn put_into_casts(spec: &mut MjSpec) -> Result<(), MjEditError> {
    for joint in ["left_knee", "right_elbow"] {
        delete(spec.actuator_mut(joint))?;
        delete(spec.joint_mut(joint))?;
    }
    let forearm = spec.geom_mut("right_lower_arm").ok_or(MjEditError::NotFound)?;
    *forearm.fromto_mut() = [0.01, -0.01, -0.01, 0.17, -0.17, -0.17];
    let hand = spec.body_mut("right_hand").ok_or(MjEditError::NotFound)?;
    *hand.pos_mut() = [0.18, -0.18, -0.18];
    Ok(())
}

/// Leaves of the right arm a massless point at the shoulder, named as the hand: the observation keeps its layout.
fn take_right_arm(spec: &mut MjSpec) -> Result<(), MjEditError> {
    delete(spec.body_mut("right_lower_arm"))?; // With the hand, the elbow and its motor.
    for joint in ["right_shoulder1", "right_shoulder2"] {
        delete(spec.actuator_mut(joint))?;
        delete(spec.joint_mut(joint))?;
    }
    let point = spec.geom_mut("right_upper_arm").ok_or(MjEditError::NotFound)?;
    point.set_type(MjtGeomBase::mjGEOM_SPHERE);
    *point.fromto_mut() = [f64::NAN; 6]; // MuJoCo's "not given".
    *point.size_mut() = [1e-10, 0.0, 0.0];
    point.set_name("right_hand")?;
    spec.body_mut("right_upper_arm").ok_or(MjEditError::NotFound)?.set_name("right_hand")
}

fn delete<T: SpecObject>(found: Option<&mut T>) -> Result<(), MjEditError> {
    let element = found.ok_or(MjEditError::NotFound)?;
    // SAFETY: the element was looked up just now, so no earlier deletion took it, and its handle ends here.
    unsafe { element.delete() }
}

impl fmt::Display for Character {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A name that is none of the characters'.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[error("unknown character {0:?}; known ones are standard, cast and one_arm")]
pub struct UnknownCharacter(pub String);

impl FromStr for Character {
    type Err = UnknownCharacter;

    fn from_str(name: &str) -> Result<Character, UnknownCharacter> {
        Character::ALL
            .into_iter()
            .find(|character| character.name() == name)
            .ok_or_else(|| UnknownCharacter(name.to_owned()))
    }
}
