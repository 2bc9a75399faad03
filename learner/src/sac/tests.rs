//! SAC against numbers that are not ours, and on a task whose optimum is known.

use std::collections::BTreeMap;

use super::*;
use crate::config::{NetworkKind, Precision, TargetEntropy};
use crate::parameters::Parameters;
use serde::Deserialize;

#[derive(Deserialize)]
struct Record {
    actor: BTreeMap<String, Vec<f32>>,
    critics: BTreeMap<String, Vec<f32>>,
    updates: Vec<RecordedUpdate>,
}

#[derive(Deserialize)]
struct RecordedUpdate {
    batch: BTreeMap<String, Vec<f32>>,
    next_noise: Vec<f32>,
    noise: Vec<f32>,
    critic_loss: f64,
    actor_loss: f64,
    entropy: f64,
    actor: BTreeMap<String, Vec<f32>>,
    critics: BTreeMap<String, Vec<f32>>,
    targets: BTreeMap<String, Vec<f32>>,
    log_alpha: f64,
}

fn load(parameters: &mut Parameters, recorded: &BTreeMap<String, Vec<f32>>) {
    let values: Vec<f32> =
        parameters.to_values().iter().flat_map(|(name, _, _)| recorded[name].clone()).collect();
    parameters.copy_from(&values);
}

fn assert_close(parameters: &Parameters, recorded: &BTreeMap<String, Vec<f32>>, what: &str) {
    for (name, _, values) in parameters.to_values() {
        for (index, (ours, theirs)) in values.iter().zip(&recorded[&name]).enumerate() {
            assert!((ours - theirs).abs() < 2e-6, "{what} {name}[{index}]: {ours}, PyTorch {theirs}");
        }
    }
}

/// One of the two ways to take an update.
type Update = fn(&mut Sac, &Batch, &[f32], &[f32]) -> Result<Losses, NonFiniteLoss>;

#[test]
fn updates_of_a_tiny_network_match_pytorch_both_ways() {
    matches_pytorch(Sac::update_by_autograd);
    matches_pytorch(Sac::update_with_noise);
}

fn matches_pytorch(take: Update) {
    let record: Record = serde_json::from_str(include_str!("../../tests/data/sac_update.json")).unwrap();
    let config = SacConfig {
        hidden: vec![4, 4],
        actor_lr: 1e-3,
        critic_lr: 2e-3,
        temperature_lr: 3e-3,
        batch: 5,
        ..SacConfig::default()
    };
    let shape = TaskShape { observation: 3, action: 2, unnormalized: vec![] };
    let mut sac = Sac::new(&shape, &config, 0, Device::Cpu, 1);
    load(&mut sac.actor.parameters, &record.actor);
    load(&mut sac.critics.parameters, &record.critics);
    load(&mut sac.targets.parameters, &record.critics);
    for update in &record.updates {
        let column = |name: &str| update.batch[name].clone();
        let batch = Batch {
            observation: column("observation"),
            action: column("action"),
            reward: column("reward"),
            next_observation: column("next_observation"),
            discount: column("discount"),
            beta: column("beta"),
            weight: Vec::new(),
        };
        let losses = take(&mut sac, &batch, &update.next_noise, &update.noise).unwrap();
        assert!((losses.critic - update.critic_loss).abs() < 1e-5);
        assert!((losses.actor - update.actor_loss).abs() < 1e-5);
        assert!((losses.entropy - update.entropy).abs() < 1e-4);
        assert!((sac.log_temperature - update.log_alpha).abs() < 1e-6);
        assert_close(&sac.actor.parameters, &update.actor, "actor");
        assert_close(&sac.critics.parameters, &update.critics, "critic");
        assert_close(&sac.targets.parameters, &update.targets, "target");
    }
}

/// A point on a line is moved to where the action says, and paid `1 − (position − 0.5)²`: the optimum is to
/// choose 0.5 from everywhere, and its value is 1 / (1 − γ).
fn toy_batch(size: usize, gamma: f32, rng: &mut ChaCha8Rng) -> Batch {
    let uniform = |rng: &mut ChaCha8Rng| rng.random_range(-1.0f32..1.0);
    let observation: Vec<f32> = (0..size).map(|_| uniform(rng)).collect();
    let action: Vec<f32> = (0..size).map(|_| uniform(rng)).collect();
    let reward: Vec<f32> = action.iter().map(|action| 1.0 - (action - 0.5).powi(2)).collect();
    Batch {
        observation,
        next_observation: action.clone(),
        action,
        reward,
        discount: vec![gamma; size],
        beta: vec![1.0; size],
        weight: Vec::new(),
    }
}

fn toy_config() -> SacConfig {
    SacConfig {
        hidden: vec![32, 32],
        batch: 64,
        gamma: 0.8,
        tau: 0.02,
        actor_lr: 1e-3,
        critic_lr: 3e-3,
        temperature_lr: 1e-3,
        initial_temperature: 0.01,
        target_entropy: TargetEntropy::Nats(-3.0),
        ..SacConfig::default()
    }
}

#[test]
fn a_toy_task_is_learned_to_its_known_optimum_normalised_or_not_and_in_both_precisions() {
    for (normalize_observations, precision) in
        [(false, Precision::Fp32), (true, Precision::Fp32), (false, Precision::Bf16)]
    {
        let config = SacConfig { normalize_observations, precision, ..toy_config() };
        let shape = TaskShape { observation: 1, action: 1, unnormalized: vec![] };
        let mut sac = Sac::new(&shape, &config, 3, Device::Cpu, 1);
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut losses = Losses::default();
        for _ in 0..1500 {
            let batch = toy_batch(64, 0.8, &mut rng);
            sac.merge_statistics(&batch);
            losses = sac.update(&batch).unwrap();
        }
        let mut forward = getup_policy::Forward::new(&sac.policy(), 9);
        let positions: Vec<f32> = (-4..=4).map(|i| i as f32 / 4.0).collect();
        for (position, mean) in positions.iter().zip(forward.run(&positions).mean) {
            assert!((mean.tanh() - 0.5).abs() < 0.1, "at {position}: {}", mean.tanh());
        }
        // Mean over uniform actions of 1 − (a − 0.5)² + γ/(1 − γ): 1 − 7/12 + 4.
        assert!((losses.q - 4.42).abs() < 0.3, "Q {}", losses.q);
    }
}

#[test]
fn the_actors_forward_pass_agrees_with_the_learners_network_on_every_shape() {
    let mlp = |hidden: &[usize]| SacConfig { hidden: hidden.to_vec(), ..SacConfig::default() };
    let simba = |actor_width, actor_blocks| SacConfig {
        network: NetworkKind::Simba,
        actor_width,
        actor_blocks,
        ..SacConfig::default()
    };
    for (config, observation, action) in [
        (mlp(&[1024, 1024]), 68, 21),
        (mlp(&[256, 256]), 68, 21),
        (mlp(&[64]), 62, 18),
        (mlp(&[40, 30, 20]), 64, 19),
        (simba(128, 1), 68, 21),
        (simba(33, 2), 62, 18),
        (simba(64, 0), 64, 19),
    ] {
        let config = SacConfig { normalize_observations: true, ..config };
        let shape = TaskShape { observation, action, unnormalized: vec![observation - 1] };
        let mut sac = Sac::new(&shape, &config, 5, Device::Cpu, 1);
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let values: Vec<f32> = (0..33 * observation).map(|_| rng.random_range(-3.0..3.0)).collect();
        sac.statistics.merge(&values);
        let policy = Policy::from_bytes(&sac.policy().to_bytes()).unwrap();
        let mut forward = getup_policy::Forward::new(&policy, 33);
        let heads = forward.run(&values);
        let input = Tensor::from_slice(&values).view([33, observation as i64]);
        let gaussian = tch::no_grad(|| sac.actor.forward(&sac.normalize(&input)));
        for (ours, theirs) in heads.mean.iter().zip(to_vec(gaussian.mean())) {
            assert!((ours - theirs).abs() < 1e-5, "{ours} {theirs}");
        }
        for (ours, theirs) in heads.log_std.iter().zip(to_vec(gaussian.log_std())) {
            assert!((ours - theirs).abs() < 1e-5, "{ours} {theirs}");
        }
    }
}

#[test]
fn in_bfloat16_the_learners_network_stays_within_its_rounding_of_the_actors() {
    let shape = TaskShape { observation: 68, action: 21, unnormalized: vec![] };
    let network = |precision| {
        let config = SacConfig { hidden: vec![256, 256], precision, ..SacConfig::default() };
        Sac::new(&shape, &config, 5, Device::Cpu, 1)
    };
    let (exact, rounded) = (network(Precision::Fp32), network(Precision::Bf16));
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let values: Vec<f32> = (0..33 * 68).map(|_| rng.random_range(-1.0..1.0)).collect();
    let input = Tensor::from_slice(&values).view([33, 68]);
    let mean = |sac: &Sac| tch::no_grad(|| sac.actor.forward(&input).mean().shallow_clone());
    let (exact, rounded) = (mean(&exact), mean(&rounded));
    let error = (&exact - &rounded).abs().max().double_value(&[]);
    // Eight bits of mantissa over two layers of values around 1.
    assert!(error > 0.0 && error < 0.02 * exact.abs().max().double_value(&[]).max(1.0), "{error}");
}

#[test]
fn the_average_follows_the_actor_update_by_update_and_begins_again_with_another() {
    let shape = TaskShape { observation: 1, action: 1, unnormalized: vec![] };
    let config = SacConfig { actor_average: 0.3, ..toy_config() };
    let mut sac = Sac::new(&shape, &config, 0, Device::Cpu, 1);
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let weights = |policy: Policy| policy.tensors.into_values().flatten().collect::<Vec<f32>>();
    let mut expected = weights(sac.policy());
    assert_eq!(weights(sac.evaluated_policy()), expected);
    for _ in 0..20 {
        sac.update(&toy_batch(64, 0.8, &mut rng)).unwrap();
        for (average, now) in expected.iter_mut().zip(weights(sac.policy())) {
            *average += 0.3 * (now - *average);
        }
    }
    let average = weights(sac.evaluated_policy());
    assert_ne!(average, weights(sac.policy()));
    assert!(average.iter().zip(&expected).all(|(ours, expected)| (ours - expected).abs() < 1e-6));

    let mut other = Sac::new(&shape, &config, 1, Device::Cpu, 1);
    other.begin_with(&sac.policy()).unwrap();
    assert!(other.is_trained() && other.evaluated_policy() == sac.policy());
    let without = Sac::new(&shape, &toy_config(), 0, Device::Cpu, 1);
    assert_eq!(without.evaluated_policy(), without.policy());
}

#[test]
fn a_loss_that_is_not_a_number_stops_the_update_and_says_which() {
    let shape = TaskShape { observation: 1, action: 1, unnormalized: vec![] };
    let mut sac = Sac::new(&shape, &toy_config(), 0, Device::Cpu, 1);
    let mut batch = toy_batch(64, 0.8, &mut ChaCha8Rng::seed_from_u64(0));
    batch.reward.fill(f32::INFINITY);
    let before = to_vec(sac.critics.parameters.flat());
    let error = sac.update(&batch).unwrap_err();
    assert_eq!((error.name, error.update), ("critic loss", 0));
    assert_eq!(to_vec(sac.critics.parameters.flat()), before);
}

#[test]
fn a_gradient_whose_square_is_no_number_stops_training_while_the_loss_is_still_one() {
    let shape = TaskShape { observation: 1, action: 1, unnormalized: vec![] };
    let mut sac = Sac::new(&shape, &toy_config(), 0, Device::Cpu, 1);
    let mut batch = toy_batch(64, 0.8, &mut ChaCha8Rng::seed_from_u64(0));
    batch.reward.fill(1e30);
    let error = sac.update(&batch).unwrap_err();
    // Autograd, where this processor has no products of ours, squares in float32.
    assert!(["critic gradient", "critic loss"].contains(&error.name), "{error}");
}
