//! Conformance with the reference implementation: `golden/` holds its rollouts (positions, observations, rewards and
//! every reward term of every step) and samples of its tolerance function.

use getup_sim::rollout::{Rollout, RolloutFile, replay};
use getup_sim::{Sigmoid, tolerance};
use serde_json::Value;

/// What is asked for. What is reached is bit equality in positions; see each test.
const ASKED: f64 = 1e-9;

fn read(name: &str) -> String {
    let path = format!("{}/tests/golden/{name}.json", env!("CARGO_MANIFEST_DIR"));
    std::fs::read_to_string(path).unwrap()
}

/// Every number of a JSON value, in order.
fn numbers(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(items) => items.iter().flat_map(numbers).collect(),
        number => vec![number.as_f64().unwrap()],
    }
}

/// The largest absolute difference, and how many numbers differ at all.
fn compare(ours: &[f64], theirs: &[f64]) -> (f64, usize) {
    assert_eq!(ours.len(), theirs.len());
    let differences = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs());
    let differ = ours.iter().zip(theirs).filter(|(a, b)| a != b).count();
    // A NaN differs by more than any number.
    let largest = differences.map(|d| if d.is_nan() { f64::INFINITY } else { d }).fold(0.0, f64::max);
    (largest, differ)
}

fn conforms(name: &str) {
    let text = read(name);
    let golden: Value = serde_json::from_str(&text).unwrap();
    let ours = replay(&RolloutFile::parse(&text).unwrap(), None).unwrap();
    let theirs = golden["rollouts"].as_array().unwrap();
    assert_eq!(ours.rollouts.len(), theirs.len());
    for (index, (ours, theirs)) in ours.rollouts.iter().zip(theirs).enumerate() {
        let Rollout { observations, rewards, terms, qpos, .. } = ours;
        for (field, ours) in [
            ("qpos", qpos.concat()),
            ("observations", observations.concat()),
            ("terms", terms.concat()),
            ("rewards", rewards.clone()),
        ] {
            let (error, differ) = compare(&ours, &numbers(&theirs[field]));
            println!(
                "{name} rollout {index} {field}: largest error {error:e}, {differ} of {} differ",
                ours.len()
            );
            assert!(error <= ASKED, "{name} rollout {index}: {field} is {error:e} off");
        }
    }
}

#[test]
fn the_standard_character_moves_and_is_paid_as_in_the_reference() {
    conforms("getup_standard");
}

#[test]
fn the_standard_character_raised_is_paid_as_in_the_reference() {
    conforms("getup_standard_raised");
}

#[test]
fn the_character_in_casts_moves_and_is_paid_as_in_the_reference() {
    conforms("getup_cast");
}

#[test]
fn the_character_with_one_arm_moves_and_is_paid_as_in_the_reference() {
    conforms("getup_one_arm");
}

#[test]
fn tolerance_is_the_reference_function_for_every_sigmoid() {
    let samples: Value = serde_json::from_str(&read("tolerance")).unwrap();
    let mut largest: f64 = 0.0;
    for sample in samples.as_array().unwrap() {
        let sigmoid = match sample["sigmoid"].as_str().unwrap() {
            "gaussian" => Sigmoid::Gaussian,
            "linear" => Sigmoid::Linear,
            "quadratic" => Sigmoid::Quadratic,
            "long_tail" => Sigmoid::LongTail,
            other => panic!("an unknown sigmoid in the golden data: {other}"),
        };
        let bounds = [0, 1].map(|end| sample["bounds"][end].as_f64().unwrap_or(f64::INFINITY));
        let [margin, value] = ["margin", "value_at_margin"].map(|key| sample[key].as_f64().unwrap());
        let ys: Vec<f64> =
            numbers(&sample["x"]).iter().map(|&x| tolerance(x, bounds, margin, value, sigmoid)).collect();
        largest = largest.max(compare(&ys, &numbers(&sample["y"])).0);
    }
    println!("tolerance: largest error {largest:e}");
    assert!(largest <= ASKED, "tolerance is {largest:e} off");
}
