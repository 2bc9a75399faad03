//! A model and its state, with no task on top: set it, step it, read it, save it.
//!
//! [`World`] keeps everything MuJoCo derives (positions, contacts, velocities) in step with the state: a plain
//! `mj_step` leaves them one physics step behind, so a control step begins with `mj_step2` and ends with `mj_step1`.
//! MuJoCo recovers from a diverged simulation by silently resetting it; a world reports it, as a [`Divergence`].

use std::sync::{Arc, Once};

use mujoco_rs::logging::set_log_handler;
use mujoco_rs::prelude::*;

use crate::character::Character;
use crate::error::{ConfigError, SimError};

/// The largest magnitude MuJoCo takes for a sane position or velocity.
const SANE: f64 = 1e10;

/// One character on a plane, simulated. Clones share the model and copy the state.
#[derive(Clone, Debug)]
pub struct World {
    character: Character,
    data: MjData<Arc<MjModel>>,
    head: Body,
    /// Ranges of the hinges in qpos order, in radians.
    hinge_ranges: Arc<[[f64; 2]]>,
}

/// A body of a [`World`]'s model: an index that holds for every world of the same character.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Body(usize);

/// How a simulation failed: the first of MuJoCo's warnings that the step raised.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
pub enum Divergence {
    /// Positions became NaN, infinite or larger than 1e10.
    #[error("positions are no longer sane numbers")]
    Position,
    /// Velocities did.
    #[error("velocities are no longer sane numbers")]
    Velocity,
    /// Accelerations did.
    #[error("accelerations are no longer sane numbers")]
    Acceleration,
    /// The control given was NaN, infinite or larger than 1e10.
    #[error("the control is not made of sane numbers")]
    Control,
    /// The inertia matrix became singular.
    #[error("the inertia matrix is singular")]
    Inertia,
    /// Contacts or constraints overflowed MuJoCo's memory.
    #[error("contacts or constraints overflowed MuJoCo's memory")]
    Overflow,
}

impl World {
    /// A world in the model's default pose (standing in the air), at rest.
    ///
    /// `physics_hz`: physics steps a second. `control_limit`: the motors' clamp, at least 1; a control of 1 is the
    /// torque limit of the paper's Table 2.
    ///
    /// # Errors
    /// [`SimError::Config`] for a limit below 1 or not finite, or `physics_hz` of 0.
    pub fn new(character: Character, physics_hz: u32, control_limit: f64) -> Result<World, SimError> {
        if !(control_limit.is_finite() && control_limit >= 1.0) {
            return Err(ConfigError::ControlLimit(control_limit).into());
        }
        if physics_hz == 0 {
            return Err(ConfigError::PhysicsHz(physics_hz).into());
        }
        take_over_messages();
        let model = character.compile(1.0 / f64::from(physics_hz), control_limit)?;
        let hinge_ranges = model.jnt_range()[1..].into();
        let mut world = World { character, data: MjData::new(Arc::new(model)), head: Body(0), hinge_ranges };
        world.head = world.body("head")?;
        world.data.forward();
        world.data.subtree_vel();
        Ok(world)
    }

    /// Which character lives here.
    pub fn character(&self) -> Character {
        self.character
    }

    /// Length of [`qpos`](World::qpos): 3 for the root's position, 4 for its orientation (w x y z), 1 a hinge.
    pub fn nq(&self) -> usize {
        self.data.qpos().len()
    }

    /// Length of [`qvel`](World::qvel): 3 for the root's velocity, 3 for its rotation, 1 a hinge.
    pub fn nv(&self) -> usize {
        self.data.qvel().len()
    }

    /// Number of motors.
    pub fn nu(&self) -> usize {
        self.data.ctrl().len()
    }

    /// Seconds in a physics step.
    pub fn timestep(&self) -> f64 {
        self.data.model_opt().timestep
    }

    /// Lower and upper limit of every hinge in qpos order, in radians.
    pub fn hinge_ranges(&self) -> &[[f64; 2]] {
        &self.hinge_ranges
    }

    /// Finds a body by its name in `humanoid.xml`.
    ///
    /// # Errors
    /// [`SimError::NoBody`] if the character has none of that name.
    pub fn body(&self, name: &str) -> Result<Body, SimError> {
        let id = self.data.model().name_to_id(MjtObjBase::mjOBJ_BODY, name);
        id.map(Body).ok_or_else(|| SimError::NoBody { character: self.character, body: name.to_owned() })
    }

    /// Sets the state as if the world were new: no warm start, no history, everything derived up to date.
    ///
    /// # Errors
    /// [`SimError::Length`] or [`SimError::NotFinite`]; the world is then as it was.
    pub fn set(&mut self, qpos: &[f64], qvel: &[f64]) -> Result<(), SimError> {
        self.check("qpos", qpos, self.nq())?;
        self.check("qvel", qvel, self.nv())?;
        self.data.reset();
        self.data.qpos_mut().copy_from_slice(qpos);
        self.data.qvel_mut().copy_from_slice(qvel);
        self.data.forward();
        self.data.subtree_vel();
        Ok(())
    }

    fn check(&self, field: &'static str, values: &[f64], wanted: usize) -> Result<(), SimError> {
        if values.len() != wanted {
            return Err(SimError::Length { field, character: self.character, got: values.len(), wanted });
        }
        match values.iter().position(|x| !x.is_finite() || x.abs() > SANE) {
            Some(index) => Err(SimError::NotFinite { field, index, got: values[index] }),
            None => Ok(()),
        }
    }

    /// Holds `control` (one number a motor, in units of its torque limit, clamped by the motor) for `substeps`
    /// physics steps. Allocates nothing.
    ///
    /// # Errors
    /// [`Divergence`]: the state is then meaningless until the next [`set`](World::set).
    ///
    /// # Panics
    /// If `control` has not one number a motor, or `substeps` is 0.
    pub fn step(&mut self, control: &[f64], substeps: usize) -> Result<(), Divergence> {
        assert!(substeps > 0, "a control step is at least one physics step");
        self.data.ctrl_mut().copy_from_slice(control);
        self.data.step2();
        for _ in 1..substeps {
            self.data.step();
        }
        self.data.step1();
        // Once a control step: as a sensor of the model it would be computed in every physics step.
        self.data.subtree_vel();
        self.divergence().map_or(Ok(()), Err)
    }

    /// The first kind of warning MuJoCo has counted since the last reset.
    fn divergence(&self) -> Option<Divergence> {
        const KINDS: [(MjtWarning, Divergence); 7] = [
            (MjtWarning::mjWARN_BADCTRL, Divergence::Control),
            (MjtWarning::mjWARN_BADQPOS, Divergence::Position),
            (MjtWarning::mjWARN_BADQVEL, Divergence::Velocity),
            (MjtWarning::mjWARN_BADQACC, Divergence::Acceleration),
            (MjtWarning::mjWARN_INERTIA, Divergence::Inertia),
            (MjtWarning::mjWARN_CONTACTFULL, Divergence::Overflow),
            (MjtWarning::mjWARN_CNSTRFULL, Divergence::Overflow),
        ];
        let warnings = &self.data.ffi().warning;
        KINDS
            .into_iter()
            .find(|(kind, _)| warnings[*kind as usize].number > 0)
            .map(|(_, divergence)| divergence)
    }

    /// Puts the character into a pose and tells whether any of its geoms touches another or the floor. Only
    /// positions and contacts are brought up to date: [`set`](World::set) must follow before a step.
    ///
    /// # Panics
    /// If `qpos` is not `nq` long.
    pub fn touches_at(&mut self, qpos: &[f64]) -> bool {
        self.data.qpos_mut().copy_from_slice(qpos);
        self.data.kinematics();
        self.data.com_pos();
        self.data.collision();
        self.contacts() > 0
    }

    /// Height of the lowest point of the character's geoms (capsules and spheres) in a pose, in metres. As after
    /// [`touches_at`](World::touches_at), [`set`](World::set) must follow before a step.
    ///
    /// # Panics
    /// If `qpos` is not `nq` long.
    pub fn lowest_point_at(&mut self, qpos: &[f64]) -> f64 {
        self.data.qpos_mut().copy_from_slice(qpos);
        self.data.kinematics();
        let model = self.data.model();
        let (bodies, sizes, kinds) = (model.geom_bodyid(), model.geom_size(), model.geom_type());
        let (positions, rotations) = (self.data.geom_xpos(), self.data.geom_xmat());
        let lowest = |geom: usize| {
            let [radius, half_length, _] = sizes[geom];
            // A capsule lies along its z axis.
            let reach = if kinds[geom] == MjtGeomBase::mjGEOM_CAPSULE { half_length } else { 0.0 };
            positions[geom][2] - (rotations[geom][8] * reach).abs() - radius
        };
        // Body 0 is the world, whose only geom is the floor.
        (0..bodies.len()).filter(|geom| bodies[*geom] != 0).map(lowest).fold(f64::INFINITY, f64::min)
    }

    /// Names of the hinges, in qpos order.
    pub fn hinge_names(&self) -> Vec<String> {
        let model = self.data.model();
        let name = |joint| model.id_to_name(MjtObjBase::mjOBJ_JOINT, joint).unwrap_or_default().to_owned();
        (1..=self.hinge_ranges.len()).map(name).collect()
    }

    /// The number of contacts.
    pub fn contacts(&self) -> usize {
        self.data.contact().len()
    }

    /// MuJoCo's own model and state, for what a world does not wrap: drawing, or another way to step a clone of them.
    pub fn mujoco(&self) -> &MjData<Arc<MjModel>> {
        &self.data
    }

    /// Positions: see [`nq`](World::nq).
    pub fn qpos(&self) -> &[f64] {
        self.data.qpos()
    }

    /// Velocities: see [`nv`](World::nv).
    pub fn qvel(&self) -> &[f64] {
        self.data.qvel()
    }

    /// Height of the head's centre above the floor, in metres: 1.69 in the default pose, 0.09 lying on it.
    pub fn head_height(&self) -> f64 {
        self.position(self.head)[2]
    }

    /// Where a body's frame is in the world, in metres.
    pub fn position(&self, body: Body) -> [f64; 3] {
        self.data.xpos()[body.0]
    }

    /// A body's rotation matrix, by rows: the columns are the body's axes in the world.
    pub fn rotation(&self, body: Body) -> [f64; 9] {
        self.data.xmat()[body.0]
    }

    /// The centre of mass of a body and all below it, in metres.
    pub fn centre_of_mass(&self, body: Body) -> [f64; 3] {
        self.data.subtree_com()[body.0]
    }

    /// The velocity of that centre of mass, in metres a second.
    pub fn centre_of_mass_velocity(&self, body: Body) -> [f64; 3] {
        self.data.subtree_linvel()[body.0]
    }
}

/// Keeps MuJoCo from printing its warnings and writing them to a file in the working folder: a world counts them and
/// returns them as errors. Its errors proper (out of memory) still end the process, once said on stderr.
fn take_over_messages() {
    static ONCE: Once = Once::new();
    fn say(message: &MjLogMessage) {
        if message.level() == MjtLogLevel::mjLOG_ERROR {
            eprintln!("MuJoCo cannot go on: {}", message.subject());
        }
    }
    // SAFETY: worlds are the process's only use of MuJoCo, and every world waits here before it makes its model, so
    // no thread uses MuJoCo while the handler changes.
    ONCE.call_once(|| unsafe { set_log_handler(say) });
}
