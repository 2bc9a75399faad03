//! Getting up from the ground: the paper's task (§7), with its observation and its reward (App. B.1).

use crate::config::{Stand, TaskConfig};
use crate::error::SimError;
use crate::reset::{Fall, Resets, Source, Standing};
use crate::task::Task;
use crate::tolerance::{Sigmoid, tolerance};
use crate::world::{Body, World};

/// Height of the root at the start of a fall, in metres.
const DROP_HEIGHT: f64 = 1.5;

/// Head height of a standing character, in metres.
const STAND_HEIGHT: f64 = 1.55;

/// The head of a character that is up is at least this high, in metres.
pub const UP_HEIGHT: f64 = 1.4;

/// How wide the step is at which a crouch's cost sets in, in metres.
const CROUCH_STEP: f64 = 0.02;

/// Once it was up, a head under this has fallen, in metres.
const DOWN_HEIGHT: f64 = 1.0;

/// The standing pose (the slower stage's target), hinge by hinge, in radians.
const STANDING_POSE: [(&str, f64); 21] = [
    ("abdomen_z", 0.0),
    ("abdomen_y", -0.11665),
    ("abdomen_x", 0.0),
    ("right_hip_x", -0.03601),
    ("right_hip_z", -0.03219),
    ("right_hip_y", 0.05025),
    ("right_knee", -0.39803),
    ("right_ankle_y", -0.30198),
    ("right_ankle_x", 0.13615),
    ("left_hip_x", -0.03601),
    ("left_hip_z", -0.03219),
    ("left_hip_y", 0.05025),
    ("left_knee", -0.39803),
    ("left_ankle_y", -0.30198),
    ("left_ankle_x", -0.13615),
    ("right_shoulder1", 0.40763),
    ("right_shoulder2", -0.41967),
    ("right_elbow", -1.5795),
    ("left_shoulder1", -0.40763),
    ("left_shoulder2", 0.41967),
    ("left_elbow", -1.5795),
];

/// Under this height of the centre of mass, in metres, a character need not hold its torso straight.
const CROUCH_HEIGHT: f64 = 0.5;

/// The get-up task for one character, at 40 Hz.
#[derive(Debug)]
pub struct GetUp {
    physics_hz: u32,
    episode_steps: usize,
    control_limit: f64,
    stand: Stand,
    fall_ends: bool,
    crouch_cost: f64,
    crouch_height: f64,
    resets: Resets,
    standing: Standing,
    bodies: Bodies,
    /// What every lane's world is a copy of.
    world: World,
}

/// The bodies the observation and the reward look at.
#[derive(Debug)]
struct Bodies {
    torso: Body,
    left_foot: Body,
    right_foot: Body,
    /// In the observation's order: left hand, left foot, right hand, right foot.
    end_effectors: [Body; 4],
}

impl GetUp {
    /// `control_limit`: the actuators' clamp in units of their torque limits, at least 1; above 1 only where a
    /// curriculum starts above 1.
    ///
    /// # Errors
    /// [`SimError::Config`] for a setting or a limit out of range.
    pub fn new(config: &TaskConfig, control_limit: f64) -> Result<GetUp, SimError> {
        config.validate()?;
        let world = World::new(config.character, config.physics_hz, control_limit)?;
        let [left_hand, left_foot] = [world.body("left_hand")?, world.body("left_foot")?];
        let [right_hand, right_foot] = [world.body("right_hand")?, world.body("right_foot")?];
        let fall =
            Fall { height: DROP_HEIGHT, limp_steps: config.ragdoll_steps, limp_std: config.ragdoll_std };
        let angle =
            |name: String| STANDING_POSE.iter().find(|(hinge, _)| *hinge == name).map_or(0.0, |pose| pose.1);
        let standing = Standing {
            hinges: world.hinge_names().into_iter().map(angle).collect(),
            hinge_std: 0.1,
            tilt_std: 0.05,
            limp_share: 0.6,
            limp_steps: 59,
        };
        Ok(GetUp {
            standing,
            physics_hz: config.physics_hz,
            episode_steps: config.episode_steps,
            control_limit,
            stand: config.stand,
            fall_ends: config.fall_ends,
            crouch_cost: config.crouch_cost,
            crouch_height: config.crouch_height,
            resets: Resets::new(vec![(1.0, Source::Fall(fall))])?,
            bodies: Bodies {
                torso: world.body("torso")?,
                left_foot,
                right_foot,
                end_effectors: [left_hand, left_foot, right_hand, right_foot],
            },
            world,
        })
    }

    fn stand(&self, world: &World) -> f64 {
        let (margin, value_at_margin, sigmoid) = match self.stand {
            Stand::LongTail => (STAND_HEIGHT / 4.0, 0.2, Sigmoid::LongTail),
            Stand::Gaussian => (0.37, 0.1, Sigmoid::Gaussian),
        };
        let height = world.head_height();
        let crouched = 1.0 / (1.0 + ((height - self.crouch_height) / CROUCH_STEP).exp());
        tolerance(height, [STAND_HEIGHT, f64::INFINITY], margin, value_at_margin, sigmoid)
            * (1.0 - self.crouch_cost * crouched)
    }

    fn straight(&self, world: &World) -> f64 {
        if world.centre_of_mass(self.bodies.torso)[2] < CROUCH_HEIGHT {
            return 1.0;
        }
        let upright = world.rotation(self.bodies.torso)[8];
        tolerance(upright, [0.9, f64::INFINITY], 1.9, 0.0, Sigmoid::Linear)
    }

    fn still(&self, world: &World) -> f64 {
        let [x, y, _] = world.centre_of_mass_velocity(self.bodies.torso);
        let slow = |speed| tolerance(speed, [-0.3, 0.3], 1.2, 0.1, Sigmoid::Gaussian);
        (slow(x) + slow(y)) / 2.0
    }

    fn feet(&self, world: &World) -> f64 {
        let [left_x, left_y, _] = world.position(self.bodies.left_foot);
        let [right_x, right_y, _] = world.position(self.bodies.right_foot);
        let [x, y] = [left_x - right_x, left_y - right_y];
        tolerance((x * x + y * y).sqrt(), [0.0, 0.9], 0.38, 0.0, Sigmoid::Quadratic)
    }
}

impl Task for GetUp {
    fn world(&self) -> World {
        self.world.clone()
    }

    fn control_hz(&self) -> u32 {
        40
    }

    fn physics_hz(&self) -> u32 {
        self.physics_hz
    }

    fn episode_steps(&self) -> usize {
        self.episode_steps
    }

    fn control_limit(&self) -> f64 {
        self.control_limit
    }

    fn resets(&self) -> &Resets {
        &self.resets
    }

    fn standing(&self) -> &Standing {
        &self.standing
    }

    /// Hinge angles, head height, 4 × 3 end-effector offsets, 3 + 3 of the torso, velocities, β̂: 68 numbers on the
    /// standard character, 64 with casts, 62 with one arm.
    fn observation_width(&self) -> usize {
        self.world.hinge_ranges().len() + 1 + 12 + 3 + 3 + self.world.nv() + 1
    }

    fn action_width(&self) -> usize {
        self.world.nu()
    }

    fn term_names(&self) -> &'static [&'static str] {
        &["stand", "straight", "still", "feet"]
    }

    /// In this order: hinge angles (rad); head height (m); left hand, left foot, right hand and right foot, each its
    /// offset from the torso in the torso's frame (m); the vertical components of the torso's x, y and z axes; the
    /// velocity of the centre of mass (m/s, world); all velocities (m/s, rad/s); β̂. None of them knows where the
    /// character is or where it is heading.
    fn observe(&self, world: &World, beta: f64, observation: &mut [f64]) {
        let torso = world.position(self.bodies.torso);
        let axes = world.rotation(self.bodies.torso);
        let mut rest = observation;
        let mut put = |values: &[f64]| {
            let (here, after) = std::mem::take(&mut rest).split_at_mut(values.len());
            here.copy_from_slice(values);
            rest = after;
        };
        put(&world.qpos()[7..]);
        put(&[world.head_height()]);
        for body in self.bodies.end_effectors {
            put(&in_frame(&axes, difference(world.position(body), torso)));
        }
        put(&axes[6..9]);
        put(&world.centre_of_mass_velocity(self.bodies.torso));
        put(world.qvel());
        put(&[beta]);
        debug_assert!(rest.is_empty(), "an observation has exactly observation_width numbers");
    }

    /// The product of stand, straight, still and feet (App. B.1), each in [0, 1].
    fn reward(&self, world: &World, terms: &mut [f64]) -> f64 {
        terms.copy_from_slice(&[
            self.stand(world),
            self.straight(world),
            self.still(world),
            self.feet(world),
        ]);
        terms.iter().product()
    }

    fn is_terminal(&self, world: &World, highest: f64) -> bool {
        self.fall_ends && highest >= UP_HEIGHT && world.head_height() < DOWN_HEIGHT
    }
}

fn difference(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}

/// A world vector along the columns of a row-major rotation matrix.
fn in_frame(axes: &[f64; 9], v: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|j| v[0] * axes[j] + v[1] * axes[3 + j] + v[2] * axes[6 + j])
}
