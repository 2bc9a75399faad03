//! Evaluations in real physics.

use std::ops::ControlFlow;

use crate::support::policy;
use getup_actor::{EvaluateError, EvaluatedEpisode, Evaluator};
use getup_policy::Policy;
use getup_sim::rollout::{RolloutFile, replay};
use getup_sim::{Stand, TaskConfig};

const SEEDS: [u64; 5] = [3, 1, 4, 15, 9];

fn watch(_: usize) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

fn evaluate(lanes: usize, policy: &Policy) -> Vec<EvaluatedEpisode> {
    let mut evaluator = Evaluator::new(&TaskConfig::default(), 1.0, lanes).unwrap();
    evaluator.evaluate(policy, 0.7, &SEEDS, watch).unwrap()
}

#[test]
fn the_result_is_the_same_bit_for_bit_on_any_number_of_lanes_and_when_repeated() {
    let policy = policy(1);
    let alone = evaluate(1, &policy);
    assert_eq!(alone, evaluate(2, &policy));
    assert_eq!(alone, evaluate(16, &policy));
    let mut evaluator = Evaluator::new(&TaskConfig::default(), 1.0, 3).unwrap();
    for _ in 0..2 {
        assert_eq!(alone, evaluator.evaluate(&policy, 0.7, &SEEDS, watch).unwrap());
    }
    let seeds: Vec<u64> = alone.iter().map(|episode| episode.seed).collect();
    assert_eq!(seeds, SEEDS);
    assert!(alone.iter().all(|episode| episode.head_heights.len() == 250 && episode.diverged.is_none()));
}

#[test]
fn a_diverged_episode_earns_nothing_and_the_evaluation_goes_on() {
    // Torques that no physics step of 5 ms survives.
    let mut evaluator = Evaluator::new(&TaskConfig::default(), 1e5, 2).unwrap();
    let episodes = evaluator.evaluate(&policy(1), 1e5, &SEEDS, watch).unwrap();
    assert_eq!(episodes.len(), SEEDS.len());
    let (failed, whole): (Vec<_>, Vec<_>) = episodes.iter().partition(|episode| episode.diverged.is_some());
    assert!(!failed.is_empty() && whole.iter().all(|episode| episode.head_heights.len() == 250));
    for episode in failed {
        let result = episode.result();
        assert_eq!((result.episode_return, result.rises, result.stands), (0.0, false, false));
    }
}

#[test]
fn no_training_setting_softens_an_evaluation() {
    let soft = TaskConfig {
        ragdoll_steps: 0,
        ragdoll_std: 0.0,
        episode_steps: 5,
        stand: Stand::Gaussian,
        ..TaskConfig::default()
    };
    let policy = policy(2);
    let mut evaluator = Evaluator::new(&soft, 1.0, 5).unwrap();
    assert_eq!(evaluator.evaluate(&policy, 0.7, &SEEDS, watch).unwrap(), evaluate(5, &policy));
}

#[test]
fn a_body_without_torque_lies_and_is_paid_what_the_paper_reports_at_the_start() {
    let mut limp = policy(0);
    limp.tensors.values_mut().for_each(|values| values.fill(0.0));
    let episodes = evaluate(5, &limp);
    let mean = episodes.iter().map(|episode| episode.episode_return).sum::<f64>() / 5.0;
    assert!((3.5..6.0).contains(&mean), "{mean}");
    for episode in &episodes {
        assert!(!episode.rises() && !episode.stands());
        assert!(episode.final_head_height() < 0.5);
        let result = episode.result();
        assert_eq!(result.episode_return, episode.episode_return);
        assert!(result.max_head_height >= result.final_head_height);
    }
}

#[test]
fn a_recording_replays_to_the_same_numbers() {
    let policy = policy(3);
    let mut evaluator = Evaluator::new(&TaskConfig::default(), 1.0, 2).unwrap();
    let (episodes, file) = evaluator.record(&policy, 0.7, &SEEDS[..3], watch).unwrap();
    assert_eq!(episodes, evaluate(2, &policy)[..3]);
    let text = serde_json::to_string(&file).unwrap();
    let played = replay(&RolloutFile::parse(&text).unwrap(), None).unwrap();
    assert_eq!(played, file);
    for (rollout, episode) in file.rollouts.iter().zip(&episodes) {
        assert_eq!(rollout.actions.len(), 250);
        assert!(rollout.actions.iter().flatten().all(|component| component.abs() <= 0.7_f32.into()));
        assert_eq!(rollout.rewards.iter().sum::<f64>(), episode.episode_return);
        assert_eq!(rollout.observations[0][67], 0.7);
    }
}

#[test]
fn standing_is_to_be_up_through_the_last_hundred_steps_and_rising_to_be_up_at_any() {
    let episode = |head_heights: Vec<f64>| EvaluatedEpisode {
        seed: 0,
        episode_return: 0.0,
        head_heights,
        diverged: None,
    };
    let up_for = |steps| episode([vec![0.2; 250 - steps], vec![1.4; steps]].concat());
    assert!(up_for(100).stands() && up_for(100).rises());
    assert!(!up_for(99).stands() && up_for(99).rises());
    assert!(!up_for(0).rises());
    assert!(!EvaluatedEpisode { diverged: Some("so".into()), ..up_for(250) }.stands());
}

#[test]
fn whoever_watches_may_end_it_and_what_cannot_be_played_is_refused() {
    let mut evaluator = Evaluator::new(&TaskConfig::default(), 1.0, 2).unwrap();
    let mut told = Vec::new();
    let ended = evaluator.evaluate(&policy(1), 0.7, &SEEDS, |done| {
        told.push(done);
        if done == 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert_eq!(ended, Err(EvaluateError::Ended));
    assert_eq!((told[0], *told.last().unwrap()), (0, 2));

    let refused = evaluator.evaluate(&policy(1), 1.2, &SEEDS, watch).unwrap_err();
    assert_eq!(refused, EvaluateError::Beta { beta: 1.2, limit: 1.0 });
    let mut narrow = policy(1);
    narrow.shape.observation = 64;
    let refused = evaluator.evaluate(&narrow, 0.7, &SEEDS, watch).unwrap_err();
    assert!(refused.to_string().contains("(64, 21) numbers, the character (68, 21)"), "{refused}");
}
