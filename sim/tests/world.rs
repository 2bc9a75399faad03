//! A world is a model and its state: the characters are those of the paper's Table 2, and whatever is read belongs to
//! the state now.

use getup_sim::{Character, ConfigError, Divergence, SimError, World};
use proptest::prelude::*;

fn world(character: Character) -> World {
    World::new(character, 200, 1.0).unwrap()
}

/// A world pushed about for a while, so that it is falling, turning and in contact.
fn busy_world() -> World {
    let mut world = world(Character::Standard);
    for step in 0..60 {
        let control: Vec<f64> = (0..world.nu()).map(|motor| f64::sin((step * 7 + motor) as f64)).collect();
        world.step(&control, 5).unwrap();
    }
    assert!(world.contacts() > 0, "it has fallen by now");
    world
}

#[test]
fn each_character_has_its_table_s_sizes() {
    for (character, nq, nu) in
        [(Character::Standard, 28, 21), (Character::Cast, 26, 19), (Character::OneArm, 25, 18)]
    {
        let world = world(character);
        assert_eq!((world.nq(), world.nv(), world.nu()), (nq, nq - 1, nu), "{character}");
        assert_eq!(world.nu(), character.motors());
        assert_eq!(world.hinge_ranges().len(), nu);
    }
}

#[test]
fn the_standard_character_weighs_what_its_table_says() {
    let mass = world(Character::Standard).mujoco().model().totalmass();
    assert!((mass - 40.844).abs() < 5e-4, "it weighs {mass} kg");
}

#[test]
fn ranges_and_torque_limits_are_the_table_s() {
    let world = world(Character::Standard);
    let degrees = |[lower, upper]: [f64; 2]| [lower.to_degrees().round(), upper.to_degrees().round()];
    assert_eq!(degrees(world.hinge_ranges()[5]), [-110.0, 20.0], "right hip y");
    assert_eq!(degrees(world.hinge_ranges()[20]), [-90.0, 50.0], "left elbow");
    let gears: Vec<f64> = world.mujoco().model().actuator_gear().iter().map(|gear| gear[0]).collect();
    let table = [40, 40, 40, 40, 40, 120, 80, 20, 20, 40, 40, 120, 80, 20, 20, 20, 20, 40, 20, 20, 40];
    assert_eq!(gears, table.map(f64::from));
}

#[test]
fn what_is_read_after_a_step_belongs_to_the_new_state() {
    let stepped = busy_world();
    let mut fresh = world(Character::Standard);
    fresh.set(stepped.qpos(), stepped.qvel()).unwrap();
    for name in ["torso", "head", "left_hand", "right_foot"] {
        let body = fresh.body(name).unwrap();
        assert_eq!(stepped.position(body), fresh.position(body), "{name}");
        assert_eq!(stepped.rotation(body), fresh.rotation(body), "{name}");
        assert_eq!(stepped.centre_of_mass(body), fresh.centre_of_mass(body), "{name}");
        assert_eq!(stepped.centre_of_mass_velocity(body), fresh.centre_of_mass_velocity(body), "{name}");
    }
    assert_eq!(stepped.contacts(), fresh.contacts());
}

#[test]
fn the_control_limit_is_the_motors_clamp() {
    let after = |limit: f64, control: f64| {
        let mut world = World::new(Character::Standard, 200, limit).unwrap();
        world.step(&[control; 21], 5).unwrap();
        world.qpos().to_vec()
    };
    assert_eq!(after(1.0, 1.6), after(1.0, 1.0), "a limit of 1 clamps 1.6 to 1");
    assert_eq!(after(1.6, 1.0), after(1.0, 1.0), "a wider limit leaves 1 alone");
    assert_eq!(after(1.6, 9.0), after(1.6, 1.6), "a limit of 1.6 clamps 9 to 1.6");
    assert_ne!(after(1.6, 1.6), after(1.0, 1.6), "a wider limit lets 1.6 through");
}

#[test]
fn a_limit_below_one_or_a_rate_of_zero_is_refused() {
    for limit in [0.99, f64::NAN, f64::INFINITY, -1.0] {
        let error = World::new(Character::Standard, 200, limit).unwrap_err();
        assert!(matches!(error, SimError::Config(ConfigError::ControlLimit(_))), "{error}");
    }
    let error = World::new(Character::Standard, 0, 1.0).unwrap_err();
    assert_eq!(error, SimError::Config(ConfigError::PhysicsHz(0)));
}

#[test]
fn four_substeps_at_800_hz_are_the_time_of_one_at_200() {
    let mut world = World::new(Character::Standard, 800, 1.0).unwrap();
    assert_eq!(world.timestep(), 0.00125);
    world.step(&[0.0; 21], 20).unwrap();
    assert!((world.mujoco().time() - 0.025).abs() < 1e-12);
}

#[test]
fn a_bad_state_is_refused_by_name_and_changes_nothing() {
    let mut world = busy_world();
    let before = (world.qpos().to_vec(), world.qvel().to_vec());
    let (mut qpos, mut qvel) = before.clone();
    qvel[3] = f64::NAN;
    let error = world.set(&qpos, &qvel).unwrap_err();
    assert_eq!(error.to_string(), "qvel[3] is NaN; it must be finite and within ±1e10");
    qpos.pop();
    let error = world.set(&qpos, &before.1).unwrap_err();
    assert_eq!(error.to_string(), "qpos has 27 numbers; character standard needs 28");
    assert_eq!((world.qpos(), world.qvel()), (&before.0[..], &before.1[..]));
}

#[test]
fn a_control_of_nan_is_a_divergence_and_the_world_can_be_set_again() {
    let mut world = world(Character::Standard);
    let (qpos, qvel) = (world.qpos().to_vec(), world.qvel().to_vec());
    let mut control = [0.0; 21];
    control[4] = f64::NAN;
    assert_eq!(world.step(&control, 5), Err(Divergence::Control));
    world.set(&qpos, &qvel).unwrap();
    assert_eq!(world.step(&[0.0; 21], 5), Ok(()));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn no_finite_state_however_absurd_ends_the_process(
        magnitude in 0..11_i32,
        numbers in prop::collection::vec(-1.0..1.0_f64, 28 + 27 + 21),
    ) {
        let mut world = world(Character::Standard);
        let scale = 10.0_f64.powi(magnitude) * 0.999;
        let scaled: Vec<f64> = numbers.iter().map(|x| x * scale).collect();
        world.set(&scaled[..28], &scaled[28..55]).unwrap();
        for _ in 0..5 {
            if world.step(&scaled[55..], 5).is_err() {
                return Ok(());
            }
            prop_assert!(world.qpos().iter().chain(world.qvel()).all(|x| x.is_finite()));
        }
    }
}
