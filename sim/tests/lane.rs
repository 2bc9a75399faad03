//! A lane plays episodes that depend on nothing but their seed, their β̂ and their actions.

use std::f64::consts::TAU;
use std::sync::Arc;

use getup_sim::rollout::replay;
use getup_sim::{
    Character, ConfigError, Divergence, Fall, GetUp, Lane, Phase, Resets, SimError, Source, Stand, Step,
    Task, TaskConfig,
};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn lane(config: &TaskConfig) -> Lane {
    Lane::new(Arc::new(GetUp::new(config, 1.0).unwrap()))
}

fn standard() -> Lane {
    lane(&TaskConfig::default())
}

/// A made-up policy: any actions do, as long as they are the same each time.
fn action(step: usize) -> [f32; 21] {
    std::array::from_fn(|motor| f32::sin((step * 5 + motor * 3) as f32))
}

/// Plays the limp phase; the steps it gave.
fn fall(lane: &mut Lane) -> Vec<Step> {
    let mut limp = vec![0.0; lane.world().nu()];
    let mut steps = Vec::new();
    while lane.phase() == Phase::Limp {
        lane.limp_action(&mut limp);
        steps.push(lane.step(&limp).unwrap());
    }
    steps
}

#[test]
fn an_episode_falls_for_eighty_steps_and_is_cut_after_two_hundred_and_fifty() {
    let mut lane = standard();
    lane.begin(1, 0.8);
    assert_eq!(lane.phase(), Phase::Limp);
    let limp = fall(&mut lane);
    assert_eq!(limp.len(), 80);
    assert!(limp.iter().all(|step| !step.terminal && !step.truncated));
    let landed: Vec<usize> = (0..80).filter(|&step| limp[step].landed).collect();
    assert_eq!(landed, [79]);
    for step in 1..=250 {
        let outcome = lane.step(&action(step)).unwrap();
        assert_eq!((outcome.truncated, outcome.terminal, outcome.landed), (step == 250, false, false));
        assert_eq!(lane.steps(), step);
    }
}

#[test]
fn an_episode_depends_on_its_seed_alone_not_on_what_the_lane_did_before() {
    let play = |lane: &mut Lane| {
        lane.begin(7, 0.9);
        fall(lane);
        for step in 0..20 {
            lane.step(&action(step)).unwrap();
        }
        (lane.qpos().to_vec(), lane.qvel().to_vec(), lane.observation().to_vec(), lane.reward())
    };
    let mut fresh = standard();
    let mut used = standard();
    used.begin(8, 0.5);
    used.step(&action(3)).unwrap();
    assert_eq!(play(&mut fresh), play(&mut used));
    assert_eq!(play(&mut fresh), play(&mut fresh));
}

#[test]
fn what_follows_a_landing_is_a_function_of_the_landed_state_and_the_actions() {
    let mut fallen = standard();
    fallen.begin(3, 0.7);
    fall(&mut fallen);
    let mut placed = standard();
    placed.begin_at(fallen.qpos(), fallen.qvel(), 0.7).unwrap();
    for step in 0..50 {
        assert_eq!(fallen.observation(), placed.observation(), "before step {step}");
        assert_eq!(fallen.step(&action(step)).unwrap(), placed.step(&action(step)).unwrap());
    }
}

#[test]
fn different_seeds_begin_differently_and_limp_actions_have_the_paper_s_spread() {
    let mut lane = standard();
    lane.begin(1, 1.0);
    let first = lane.qpos().to_vec();
    lane.begin(2, 1.0);
    assert_ne!(first, lane.qpos());
    let mut actions = [0.0_f32; 21];
    let mut sum = 0.0;
    for _ in 0..1000 {
        lane.limp_action(&mut actions);
        sum += actions.iter().map(|&a| f64::from(a).powi(2)).sum::<f64>();
    }
    let deviation = (sum / 21_000.0).sqrt();
    assert!((deviation - 0.1).abs() < 0.002, "the standard deviation of limp actions is {deviation}");
}

#[test]
fn reset_sources_are_drawn_by_their_weights_and_bad_weights_are_refused() {
    let source = |limp_steps| Source::Fall(Fall { height: 1.5, limp_steps, limp_std: 0.0 });
    let resets = Resets::new(vec![(1.0, source(1)), (0.0, source(2)), (3.0, source(3))]).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut drawn = [0; 4];
    for _ in 0..10_000 {
        let Source::Fall(fall) = resets.draw(&mut rng);
        drawn[fall.limp_steps] += 1;
    }
    assert_eq!(drawn[2], 0);
    assert!((2_300..2_700).contains(&drawn[1]), "a quarter of 10,000 is {}", drawn[1]);
    assert_eq!(resets.longest(), 3);
    for weights in [vec![], vec![0.0], vec![1.0, -1.0], vec![f64::NAN]] {
        let refused = Resets::new(weights.iter().map(|&weight| (weight, source(1))).collect());
        assert!(matches!(refused, Err(ConfigError::Resets(_))), "{weights:?}");
    }
}

#[test]
fn a_task_without_limp_steps_starts_in_the_control_phase() {
    let mut lane = lane(&TaskConfig { ragdoll_steps: 0, ..TaskConfig::default() });
    lane.begin(1, 1.0);
    assert_eq!(lane.phase(), Phase::Control);
    assert!(lane.qpos()[2] == 1.5);
}

#[test]
fn observations_have_the_characters_widths_and_end_with_beta() {
    for (character, width) in [(Character::Standard, 68), (Character::Cast, 64), (Character::OneArm, 62)] {
        let config = TaskConfig { character, ..TaskConfig::default() };
        let task = GetUp::new(&config, 1.0).unwrap();
        assert_eq!((task.observation_width(), task.action_width()), (width, character.motors()));
        let mut lane = Lane::new(Arc::new(task));
        lane.begin(1, 0.65);
        let mut observation = vec![f32::NAN; width];
        lane.observe(&mut observation);
        assert_eq!(observation[width - 1], 0.65);
        assert!(observation.iter().zip(lane.observation()).all(|(&single, &double)| single == double as f32));
    }
}

#[test]
fn a_divergence_is_an_error_whose_recording_repeats_it() {
    let mut lane = standard();
    lane.begin(1, 1.0);
    fall(&mut lane);
    let mut qvel = lane.qvel().to_vec();
    qvel[10] = 9e9;
    let qpos = lane.qpos().to_vec();
    lane.begin_at(&qpos, &qvel, 1.0).unwrap();
    let diverged = (0..10).find_map(|step| lane.step(&action(step)).err()).expect("9e9 rad/s cannot last");
    assert_eq!(diverged.phase, Phase::Control);
    assert!(diverged.to_string().contains("character standard diverged in step"), "{diverged}");

    let replayed = replay(&diverged.recording, None).unwrap();
    let at = replayed.rollouts[0].diverged.as_ref().expect("the recording diverges again");
    assert_eq!((at.step, &at.cause), (diverged.step, &diverged.cause.to_string()));

    lane.begin(2, 1.0);
    assert_eq!(fall(&mut lane).len(), 80, "the lane is as good as new");
}

#[test]
fn an_action_of_nan_is_a_divergence_not_a_crash() {
    let mut lane = standard();
    lane.begin(1, 1.0);
    let error = lane.step(&[f32::NAN; 21]).unwrap_err();
    assert_eq!((error.cause, error.phase, error.step), (Divergence::Control, Phase::Limp, 0));
}

#[test]
fn lying_pays_what_the_paper_s_curves_start_at_and_next_to_nothing_by_its_text() {
    let pay = |stand| {
        let mut lane = lane(&TaskConfig { stand, ..TaskConfig::default() });
        let mut rewards = Vec::new();
        for seed in 0..20 {
            lane.begin(seed, 1.0);
            fall(&mut lane);
            rewards.push(lane.reward());
        }
        rewards.iter().sum::<f64>() / rewards.len() as f64
    };
    let (long_tail, gaussian) = (pay(Stand::LongTail), pay(Stand::Gaussian));
    assert!((0.017..0.023).contains(&long_tail), "lying pays {long_tail} a step");
    assert!(gaussian < 1e-6, "lying pays {gaussian} a step");
}

#[test]
fn a_bad_setting_is_named_with_its_value() {
    let refuse = |config: TaskConfig| match GetUp::new(&config, 1.0).map(|_| ()).unwrap_err() {
        SimError::Config(error) => error,
        other => panic!("not a setting's error: {other}"),
    };
    let default = TaskConfig::default;
    assert_eq!(refuse(TaskConfig { physics_hz: 400, ..default() }), ConfigError::PhysicsHz(400));
    assert_eq!(refuse(TaskConfig { ragdoll_std: -0.1, ..default() }), ConfigError::RagdollStd(-0.1));
    assert_eq!(refuse(TaskConfig { crouch_cost: 1.5, ..default() }), ConfigError::CrouchCost(1.5));
    assert_eq!(refuse(TaskConfig { crouch_height: 0.0, ..default() }), ConfigError::CrouchHeight(0.0));
    assert_eq!(refuse(TaskConfig { episode_steps: 0, ..default() }), ConfigError::EpisodeSteps);
    let long = refuse(TaskConfig { ragdoll_steps: 1_000_000_000_000, ..default() }).to_string();
    assert_eq!(long, "task.ragdoll_steps is 1000000000000; it must be at most 1000000");
    let error = refuse(TaskConfig { name: "walk".to_owned(), ..default() });
    assert_eq!(error.to_string(), "task.name is \"walk\"; the only task is \"getup\"");
}

#[test]
fn no_training_setting_softens_an_evaluation() {
    let eased = TaskConfig {
        character: Character::OneArm,
        physics_hz: 800,
        ragdoll_steps: 3,
        ragdoll_std: 0.0,
        episode_steps: 10,
        stand: Stand::Gaussian,
        fall_ends: true,
        crouch_cost: 0.5,
        ..TaskConfig::default()
    };
    let expected = TaskConfig { character: Character::OneArm, physics_hz: 800, ..TaskConfig::default() };
    assert_eq!(eased.evaluation(), expected);
    assert_eq!((expected.ragdoll_steps, expected.ragdoll_std, expected.episode_steps), (80, 0.1, 250));
}

/// The product of two quaternions w x y z.
fn times(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    #[test]
    fn a_character_at_rest_does_not_observe_where_it_is_or_where_it_heads(
        seed in any::<u64>(),
        x in -50.0..50.0_f64,
        y in -50.0..50.0_f64,
        heading in 0.0..TAU,
    ) {
        let mut lane = standard();
        lane.begin(seed, 1.0);
        let here = lane.observation().to_vec();
        let reward = lane.reward();
        let mut qpos = lane.qpos().to_vec();
        let turn = [(heading / 2.0).cos(), 0.0, 0.0, (heading / 2.0).sin()];
        let turned = times(turn, qpos[3..7].try_into().unwrap());
        qpos[..2].copy_from_slice(&[x, y]);
        qpos[3..7].copy_from_slice(&turned);
        lane.begin_at(&qpos, &[0.0; 27], 1.0).unwrap();
        for (a, b) in here.iter().zip(lane.observation()) {
            prop_assert!((a - b).abs() < 1e-12, "{a} is observed as {b}");
        }
        prop_assert!((reward - lane.reward()).abs() < 1e-12);
    }

    #[test]
    fn every_term_is_in_the_unit_interval_and_the_reward_is_their_product(
        seed in any::<u64>(),
        steps in 0..100_usize,
    ) {
        let mut lane = standard();
        lane.begin(seed, 1.0);
        for step in 0..steps {
            lane.step(&action(step)).unwrap();
        }
        prop_assert!(lane.terms().iter().all(|term| (0.0..=1.0).contains(term)));
        prop_assert_eq!(lane.terms().iter().product::<f64>(), lane.reward());
    }
}

#[test]
fn a_high_start_stands_on_the_floor_and_is_limp_in_part_of_the_cases() {
    for character in [Character::Standard, Character::Cast, Character::OneArm] {
        let mut lane = lane(&TaskConfig { character, ..TaskConfig::default() });
        let (mut limp, mut heads, mut headings) = (0, Vec::new(), Vec::new());
        for seed in 0..300 {
            lane.begin_standing(seed, 0.9);
            limp += usize::from(lane.phase() == Phase::Limp);
            heads.push(lane.world().head_height());
            let qpos = lane.world().qpos();
            headings.push(2.0 * qpos[6].atan2(qpos[3]));
            let ranges = lane.world().hinge_ranges().iter().zip(&qpos[7..]);
            assert!(ranges.into_iter().all(|([lower, upper], angle)| lower <= angle && angle <= upper));
            let (qpos, qvel) = (qpos.to_vec(), lane.world().qvel().to_vec());
            assert!(qvel.iter().all(|velocity| *velocity == 0.0));
            let mut world = lane.world().clone();
            assert!(world.lowest_point_at(&qpos).abs() < 1e-9);
        }
        heads.sort_by(f64::total_cmp);
        assert!(heads[0] > 1.35 && heads[299] < 1.7, "{} to {}", heads[0], heads[299]);
        // 60 % are limp at first, but one in sixty of those for no step at all.
        assert!((140..215).contains(&limp), "{limp} of 300");
        assert!(
            headings.iter().any(|heading| heading.sin() > 0.9) && headings.iter().any(|h| h.sin() < -0.9)
        );
    }
}

#[test]
fn a_high_start_depends_on_its_seed_alone_and_ends_its_limp_steps_like_a_fall() {
    let (mut used, mut fresh) = (standard(), standard());
    used.begin(3, 1.0);
    fall(&mut used);
    for seed in 0..20 {
        used.begin_standing(seed, 0.8);
        fresh.begin_standing(seed, 0.8);
        let steps = fall(&mut used);
        assert_eq!(steps, fall(&mut fresh));
        assert!(steps.len() <= 59 && steps.last().is_none_or(|step| step.landed));
        assert_eq!(used.observation(), fresh.observation());
        for step in 1..=250 {
            assert_eq!(used.step(&action(step)).unwrap().truncated, step == 250);
        }
    }
}

#[test]
fn a_crouch_costs_its_share_of_the_stand_term_and_standing_nothing() {
    for crouch_height in [1.3, 1.43] {
        a_crouch_under(crouch_height);
    }
}

fn a_crouch_under(crouch_height: f64) {
    let mut costly = lane(&TaskConfig { crouch_cost: 0.4, crouch_height, ..TaskConfig::default() });
    let (mut free, mut seen) = (standard(), [0; 2]);
    for seed in 0..20 {
        costly.begin_standing(seed, 1.0);
        free.begin_standing(seed, 1.0);
        fall(&mut costly);
        fall(&mut free);
        for _ in 0..60 {
            costly.step(&[0.0; 21]).unwrap();
            free.step(&[0.0; 21]).unwrap();
            let kept = costly.terms()[0] / free.terms()[0];
            assert!((0.599..=1.0).contains(&kept) && costly.terms()[1..] == free.terms()[1..]);
            match costly.head_height() {
                up if up > crouch_height + 0.02 => {
                    assert!(kept > 0.89, "{kept} at {up} m");
                    seen[0] += 1;
                }
                down if down < crouch_height - 0.13 => {
                    assert!(kept < 0.605, "{kept} at {down} m");
                    seen[1] += 1;
                }
                _ => {}
            }
        }
    }
    assert!(seen.iter().all(|count| *count > 0), "{seen:?}");
}

#[test]
fn where_falling_ends_an_episode_only_a_head_that_was_up_and_sinks_ends_it() {
    let mut lane = lane(&TaskConfig { fall_ends: true, ..TaskConfig::default() });
    let (mut ended, mut endless) = (0, standard());
    for seed in 0..20 {
        lane.begin_standing(seed, 1.0);
        endless.begin_standing(seed, 1.0);
        fall(&mut lane);
        fall(&mut endless);
        let mut highest = lane.head_height();
        for step in 1..=250 {
            let (outcome, same) = (lane.step(&[0.0; 21]).unwrap(), endless.step(&[0.0; 21]).unwrap());
            assert!(!same.terminal);
            highest = highest.max(lane.head_height());
            assert_eq!(
                outcome.terminal,
                highest >= 1.4 && lane.head_height() < 1.0,
                "seed {seed}, step {step}"
            );
            if outcome.terminal {
                ended += 1;
                break;
            }
        }
    }
    // Limp, nobody stands for six seconds; some starts are limp for so long that the head is never up.
    assert!((8..20).contains(&ended), "{ended} of 20");
    lane.begin(1, 1.0);
    fall(&mut lane);
    assert!((1..=250).all(|step| !lane.step(&action(step)).unwrap().terminal));
}
