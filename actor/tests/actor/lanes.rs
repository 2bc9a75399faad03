//! Groups of lanes in real physics.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::support::{setup, spec, update};
use getup_actor::{ActorMetrics, ActorSetup, LaneGroup, LaneSettings, PolicyUpdate};
use getup_policy::{Body, Policy, PolicyShape};
use getup_proto::{Segment, columns};
use getup_sim::rollout::{RolloutFile, replay};
use getup_telemetry::Registry;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn settings(setup: &ActorSetup) -> LaneSettings {
    setup.lane_settings(ActorMetrics::new(&Registry::new(), "actor")).unwrap()
}

fn play(
    settings: &LaneSettings,
    lanes: std::ops::Range<u32>,
    update: PolicyUpdate,
    steps: usize,
) -> Vec<Segment> {
    let count = lanes.len();
    let mut group = LaneGroup::new(settings.clone(), lanes.start, count, Arc::new(update)).unwrap();
    let mut segments = Vec::new();
    for _ in 0..steps {
        group.step(&mut segments);
    }
    segments
}

#[test]
fn the_same_seeds_and_policies_give_the_same_segments() {
    let folder = tempfile::tempdir().unwrap();
    let setup = setup(folder.path());
    let segments = play(&settings(&setup), 0..4, update(1), 200);
    assert!(segments.len() > 20);
    assert_eq!(segments, play(&settings(&setup), 0..4, update(1), 200));
    let mut other = setup;
    other.identity.run_seed += 1;
    assert_ne!(segments, play(&settings(&other), 0..4, update(1), 200));
}

#[test]
fn a_lane_plays_the_same_alone_as_among_others() {
    let folder = tempfile::tempdir().unwrap();
    let settings = settings(&setup(folder.path()));
    let mut together = play(&settings, 0..4, update(1), 200);
    together.retain(|segment| segment.lane == 2);
    let alone = play(&settings, 2..3, update(1), 200);
    assert!(!alone.is_empty());
    assert_eq!(together, alone);
}

#[test]
fn segments_follow_the_spec_and_limp_steps_never_count_as_env_steps() {
    let folder = tempfile::tempdir().unwrap();
    for store_limp in [true, false] {
        let mut setup = setup(folder.path());
        setup.config.store_limp = store_limp;
        let settings = settings(&setup);
        let segments = play(&settings, 0..4, update(1), 240);
        let mut episodes: BTreeMap<(u32, u64), Vec<&Segment>> = BTreeMap::new();
        for segment in &segments {
            let wire = Segment { sequence: 1, ..segment.clone() }.to_wire();
            Segment::parse(wire, &spec()).unwrap();
            episodes.entry((segment.lane, segment.episode)).or_default().push(segment);
        }
        let whole = episodes.values().filter(|episode| episode.last().unwrap().end.is_some());
        let mut count = 0;
        for episode in whole {
            count += 1;
            let end = episode.last().unwrap().end.as_ref().unwrap();
            let rewards = |segment: &&Segment| columns::iter(&segment.columns[2]).map(f64::from).sum::<f64>();
            let control = episode.iter().filter(|segment| segment.env_steps > 0);
            let sum: f64 = control.map(rewards).sum();
            assert!((f64::from(end.episode_return) - sum).abs() < 1e-4);
            assert_eq!((end.env_steps, end.reason.as_str()), (40, "time_limit"));
            assert_eq!(episode[0].first_step, if store_limp { 0 } else { 20 });
            let steps: usize = episode.iter().map(|segment| segment.steps).sum();
            assert_eq!(steps, if store_limp { 60 } else { 40 });
            assert_eq!(episode.iter().map(|segment| segment.env_steps).sum::<u32>(), 40);
            assert!(episode.iter().all(|segment| segment.stage == 3));
            assert!(episode.iter().all(|segment| segment.columns[3] == episode[0].columns[3]));
        }
        assert_eq!(settings.metrics.episode_return.get_sample_count(), count);
        assert!(count >= 8);
    }
}

#[test]
fn uniform_actions_fill_the_torque_limit_of_their_episode_and_do_not_exceed_it() {
    let folder = tempfile::tempdir().unwrap();
    let settings = settings(&setup(folder.path()));
    let segments = play(&settings, 0..4, PolicyUpdate { uniform: true, ..update(1) }, 200);
    let played: Vec<&Segment> = segments.iter().filter(|segment| segment.env_steps > 0).collect();
    assert!(!played.is_empty());
    for segment in played {
        let beta = columns::iter(&segment.columns[3]).next().unwrap();
        let largest = columns::iter(&segment.columns[1]).map(f32::abs).fold(0.0, f32::max);
        assert!((0.4..=1.0).contains(&beta) && largest <= beta && largest > 0.9 * beta);
        let observed = columns::iter(&segment.columns[0]).nth(67).unwrap();
        assert_eq!(observed, beta);
    }
}

#[test]
fn a_newer_policy_acts_from_the_next_step_on_and_one_of_another_shape_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let settings = settings(&setup(folder.path()));
    let mut group = LaneGroup::new(settings, 0, 1, Arc::new(update(1))).unwrap();
    let mut segments = Vec::new();
    (0..8).for_each(|_| group.step(&mut segments));
    group.set_policy(Arc::new(update(2))).unwrap();
    (0..24).for_each(|_| group.step(&mut segments));
    let versions = segments.iter().map(|s| (s.first_version.counter, s.last_version.counter));
    assert_eq!(versions.collect::<Vec<_>>(), [(1, 2), (2, 2)]);

    let shape = PolicyShape { observation: 64, action: 19, body: Body::Mlp { hidden: vec![8] } };
    let cast = Policy::init(shape, &mut ChaCha8Rng::seed_from_u64(0));
    let refused = group.set_policy(Arc::new(PolicyUpdate { policy: Arc::new(cast), ..update(3) }));
    let message = refused.unwrap_err().to_string();
    assert!(message.contains("policy 1.3 maps 64 numbers to 19, the task 68 to 21"), "{message}");
    assert_eq!(group.policy().version.counter, 2);
}

#[test]
fn a_diverged_episode_is_dropped_counted_and_kept_for_replay_and_the_lane_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let diverged = folder.path().join("diverged");
    let mut setup = setup(&diverged);
    // Torques that no physics step of 5 ms survives.
    setup.beta.ceiling = 1e5;
    let settings = settings(&setup);
    let wild = PolicyUpdate { beta: 1e5, uniform: true, ..update(1) };
    let segments = play(&settings, 0..2, wild, 300);

    let dropped = settings.metrics.diverged_episodes.get();
    assert!(dropped >= 2, "{dropped} episodes diverged");
    assert!(segments.iter().any(|segment| segment.lane == 0 && segment.episode > 0));
    let files: Vec<_> = std::fs::read_dir(&diverged).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert_eq!(files.len() as u64, dropped);
    for path in files {
        let file = RolloutFile::parse(&std::fs::read_to_string(&path).unwrap()).unwrap();
        let played = replay(&file, None).unwrap();
        let actions = file.rollouts[0].actions.len();
        assert_eq!(played.rollouts[0].diverged.as_ref().unwrap().step, actions - 1, "{}", path.display());
    }
}
