//! The policy against a plain reference, and its file against damage.

use getup_policy::{
    Body, Forward, LOG_STD_MAX, LOG_STD_MIN, MeanError, ModelError, NORM_EPSILON, ObservationStatistics,
    Policy, PolicyShape,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn shapes() -> Vec<PolicyShape> {
    let hidden = [vec![], vec![5], vec![32, 17], vec![256, 256], vec![64, 64, 64]];
    let simba = [(128, 1), (5, 2), (33, 0)].map(|(width, blocks)| Body::Simba { width, blocks });
    let bodies = hidden.into_iter().map(|hidden| Body::Mlp { hidden }).chain(simba);
    let widths = [(68, 21), (1, 1), (7, 3)];
    let shape = |body: Body| {
        widths.map(|(observation, action)| PolicyShape { observation, action, body: body.clone() })
    };
    bodies.flat_map(shape).collect()
}

fn random_policy(shape: PolicyShape, rng: &mut ChaCha8Rng) -> Policy {
    let mut policy = Policy::init(shape, rng);
    for values in policy.tensors.values_mut() {
        values.iter_mut().for_each(|value| *value += rng.random_range(-0.1..0.1));
    }
    policy
}

/// The same network in double precision, one row and one sum at a time.
fn reference(policy: &Policy, observation: &[f32]) -> (Vec<f64>, Vec<f64>) {
    let mut values: Vec<f64> = observation.iter().map(|value| f64::from(*value)).collect();
    if let Some(statistics) = &policy.statistics {
        for (index, value) in values.iter_mut().enumerate() {
            let (mean, std) = (f64::from(statistics.mean[index]), f64::from(statistics.std[index]));
            let clip = f64::from(statistics.clip);
            *value = ((*value - mean) / std).clamp(-clip, clip);
        }
    }
    let apply = |name: &str, input: &[f64]| -> Vec<f64> {
        let weight = policy.tensor(&format!("{name}.weight"));
        let bias = policy.tensor(&format!("{name}.bias"));
        (0..bias.len())
            .map(|row| {
                let products = input.iter().zip(&weight[row * input.len()..]).map(|(x, w)| x * f64::from(*w));
                products.sum::<f64>() + f64::from(bias[row])
            })
            .collect()
    };
    let relu = |values: Vec<f64>| -> Vec<f64> { values.into_iter().map(|x| x.max(0.0)).collect() };
    let norm = |name: &str, input: &[f64]| -> Vec<f64> {
        let count = input.len() as f64;
        let mean = input.iter().sum::<f64>() / count;
        let variance = input.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count;
        let weight = policy.tensor(&format!("{name}.weight"));
        let parameters = weight.iter().zip(policy.tensor(&format!("{name}.bias")));
        let normal = input.iter().map(|x| (x - mean) / (variance + f64::from(NORM_EPSILON)).sqrt());
        normal.zip(parameters).map(|(x, (weight, bias))| x * f64::from(*weight) + f64::from(*bias)).collect()
    };
    match &policy.shape.body {
        Body::Mlp { hidden } => {
            for index in 0..hidden.len() {
                values = relu(apply(&format!("body.{index}"), &values));
            }
        }
        Body::Simba { blocks, .. } => {
            values = apply("body.embed", &values);
            for block in 0..*blocks {
                let inner =
                    relu(apply(&format!("body.{block}.up"), &norm(&format!("body.{block}.norm"), &values)));
                let change = apply(&format!("body.{block}.down"), &inner);
                values.iter_mut().zip(change).for_each(|(value, change)| *value += change);
            }
            values = norm("body.norm", &values);
        }
    }
    let (low, high) = (f64::from(LOG_STD_MIN), f64::from(LOG_STD_MAX));
    let log_std = apply("head.log_std", &values);
    let log_std = log_std.into_iter().map(|x| low + 0.5 * (high - low) * (x.tanh() + 1.0)).collect();
    (apply("head.mean", &values), log_std)
}

#[test]
fn the_forward_pass_agrees_with_a_plain_reference_on_every_shape() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for (index, shape) in shapes().into_iter().enumerate() {
        let mut policy = random_policy(shape, &mut rng);
        let (width, actions) = (policy.shape.observation, policy.shape.action);
        if index % 2 == 1 {
            policy.statistics = Some(ObservationStatistics {
                mean: (0..width).map(|_| rng.random_range(-1.0..1.0)).collect(),
                std: (0..width).map(|_| rng.random_range(0.1..2.0)).collect(),
                clip: 3.0,
            });
        }
        let observations: Vec<f32> = (0..19 * width).map(|_| rng.random_range(-2.0..2.0)).collect();
        let mut forward = Forward::new(&policy, 4);
        let heads = forward.run(&observations);
        for (row, observation) in observations.chunks(width).enumerate() {
            let (mean, log_std) = reference(&policy, observation);
            for action in 0..actions {
                let at = row * actions + action;
                assert!((f64::from(heads.mean[at]) - mean[action]).abs() < 1e-5, "{:?}", policy.shape);
                assert!((f64::from(heads.log_std[at]) - log_std[action]).abs() < 1e-5, "{:?}", policy.shape);
            }
        }
    }
}

#[test]
fn a_row_gives_the_same_bits_in_every_batch() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    for shape in shapes() {
        let policy = random_policy(shape, &mut rng);
        let (width, actions) = (policy.shape.observation, policy.shape.action);
        let observations: Vec<f32> = (0..50 * width).map(|_| rng.random_range(-2.0..2.0)).collect();
        let mut forward = Forward::new(&policy, 50);
        let whole = forward.run(&observations);
        let (means, log_stds) = (whole.mean.to_vec(), whole.log_std.to_vec());
        for batch in [1, 2, 7, 16, 31] {
            for (chunk, rows) in observations.chunks(batch * width).enumerate() {
                let heads = forward.run(rows);
                let at = chunk * batch * actions;
                assert_eq!(heads.mean, &means[at..at + heads.mean.len()]);
                assert_eq!(heads.log_std, &log_stds[at..at + heads.log_std.len()]);
            }
        }
    }
}

#[test]
fn a_file_gives_back_the_same_policy_and_the_same_bytes() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let folder = tempfile::tempdir().unwrap();
    for (index, shape) in shapes().into_iter().enumerate() {
        let mut policy = random_policy(shape, &mut rng);
        policy.metadata.insert("beta".into(), "0.95".into());
        policy.metadata.insert("character".into(), "standard".into());
        if index % 2 == 0 {
            let width = policy.shape.observation;
            policy.statistics =
                Some(ObservationStatistics { mean: vec![0.5; width], std: vec![2.0; width], clip: 10.0 });
        }
        let path = folder.path().join("model.safetensors");
        std::fs::write(&path, policy.to_bytes()).unwrap();
        let loaded = Policy::load(&path).unwrap();
        assert_eq!(loaded, policy);
        assert_eq!(loaded.to_bytes(), policy.to_bytes());
        assert_eq!(loaded.number("beta"), Some(0.95));
    }
}

#[test]
fn damage_is_named_and_never_a_panic() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let policy = random_policy(
        PolicyShape { observation: 3, action: 2, body: Body::Mlp { hidden: vec![4] } },
        &mut rng,
    );
    let bytes = policy.to_bytes();
    for length in 0..bytes.len() {
        assert!(Policy::from_bytes(&bytes[..length]).is_err(), "cut at {length}");
    }
    for _ in 0..20_000 {
        let mut damaged = bytes.clone();
        let at = rng.random_range(0..damaged.len());
        damaged[at] ^= 1 << rng.random_range(0..8);
        let _ = Policy::from_bytes(&damaged);
    }
    let mut not_finite = policy.clone();
    not_finite.tensors.get_mut("body.0.weight").unwrap()[5] = f32::NAN;
    let error = Policy::from_bytes(&not_finite.to_bytes()).unwrap_err();
    assert_eq!(error.to_string(), "tensor \"body.0.weight\" of the model: element 5 is NaN, not finite");
    let mut newer = bytes.clone();
    let needle = br#"\"version\":1"#;
    let at = newer.windows(needle.len()).position(|window| window == needle).unwrap();
    newer[at + needle.len() - 1] = b'9';
    assert!(matches!(Policy::from_bytes(&newer), Err(ModelError::Version { found: 9 })));
}

#[test]
fn a_mean_is_taken_weight_by_weight_of_what_is_alike() {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let shape = shapes().remove(0);
    let mut policies: Vec<Policy> = (0..3).map(|_| random_policy(shape.clone(), &mut rng)).collect();
    for index in 1..3 {
        policies[index].statistics = policies[0].statistics.clone();
    }
    let mean = Policy::mean(&policies).unwrap();
    for (name, values) in &mean.tensors {
        for (place, value) in values.iter().enumerate() {
            let sum: f32 = policies.iter().map(|policy| policy.tensors[name][place]).sum();
            assert!((value - sum / 3.0).abs() < 1e-6, "{name}[{place}]");
        }
    }
    assert_eq!((&mean.metadata, &mean.statistics), (&policies[0].metadata, &policies[0].statistics));
    assert_eq!(Policy::mean(&policies[..1]).unwrap(), policies[0]);
    assert_eq!(Policy::mean(&[]), Err(MeanError::None));

    let other = random_policy(shapes().remove(1), &mut rng);
    let differs = |what| Err(MeanError::Differs { index: 1, what });
    assert_eq!(Policy::mean(&[policies[0].clone(), other]), differs("shape"));
    let statistics = policies[0].statistics.is_none().then(|| getup_policy::ObservationStatistics {
        mean: vec![0.0; shape.observation],
        std: vec![1.0; shape.observation],
        clip: 10.0,
    });
    let other = Policy { statistics, ..policies[1].clone() };
    assert_eq!(Policy::mean(&[policies[0].clone(), other]), differs("observation statistics"));
}
