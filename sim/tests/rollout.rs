//! Rollout files: what is replayed, what is written, and what is said about a file that cannot be.

use getup_sim::Character;
use getup_sim::rollout::{RolloutFile, replay};
use serde_json::{Value, json};

/// A file of one short rollout of the standard character at its default pose.
fn file() -> Value {
    let mut qpos0 = vec![0.0; 28];
    qpos0[2..4].copy_from_slice(&[1.2, 1.0]);
    json!({
        "variant": "standard",
        "physics_hz": 200,
        "rollouts": [{"beta": 0.8, "qpos0": qpos0, "qvel0": vec![0.0; 27], "actions": vec![vec![0.1; 21]; 3]}],
    })
}

/// What is said about the file after an edit.
fn complaint(edit: impl FnOnce(&mut Value)) -> String {
    let mut file = file();
    edit(&mut file);
    let played = RolloutFile::parse(&file.to_string()).and_then(|file| replay(&file, None));
    played.expect_err("the edit makes the file unplayable").to_string()
}

/// Adds a second rollout, like the first but for one field.
fn second(file: &mut Value, field: &str, value: Value) {
    let mut rollout = file["rollouts"][0].clone();
    rollout[field] = value;
    file["rollouts"].as_array_mut().unwrap().push(rollout);
}

#[test]
fn a_rollout_needs_four_fields_and_is_given_the_rest() {
    let played = replay(&RolloutFile::parse(&file().to_string()).unwrap(), None).unwrap();
    let rollout = &played.rollouts[0];
    assert_eq!(rollout.observations.len(), 4);
    assert!(rollout.observations.iter().all(|observation| observation.len() == 68 && observation[67] == 0.8));
    assert_eq!((rollout.rewards.len(), rollout.terms.len(), rollout.qpos.len()), (3, 3, 3));
    assert!(
        rollout
            .terms
            .iter()
            .zip(&rollout.rewards)
            .all(|(terms, reward)| terms.iter().product::<f64>() == *reward)
    );
    assert_eq!(rollout.diverged, None);
}

#[test]
fn what_is_written_is_read_back_to_the_bit_and_replays_to_itself() {
    let played = replay(&RolloutFile::parse(&file().to_string()).unwrap(), None).unwrap();
    let again = replay(&RolloutFile::parse(&played.to_json()).unwrap(), None).unwrap();
    assert_eq!(played, again);
}

#[test]
fn keys_that_are_not_known_are_ignored_and_rates_have_defaults() {
    let mut file = file();
    file["author"] = json!("someone else");
    file["rollouts"][0]["seed"] = json!(4);
    file["rollouts"][0]["rewards"] = json!(null);
    for absent in ["physics_hz", "variant"] {
        file.as_object_mut().unwrap().remove(absent);
    }
    let parsed = RolloutFile::parse(&file.to_string()).unwrap();
    assert_eq!((parsed.physics_hz, parsed.control_hz, parsed.control_limit), (200, 40, 1.0));
    assert_eq!(parsed.character, Character::Standard);
}

#[test]
fn every_character_has_the_golden_files_name_and_its_own() {
    for (name, character) in [
        ("standard", Character::Standard),
        ("Disabled", Character::Cast),
        ("cast", Character::Cast),
        ("Noarm", Character::OneArm),
        ("one_arm", Character::OneArm),
    ] {
        let mut file = file();
        file["variant"] = json!(name);
        assert_eq!(RolloutFile::parse(&file.to_string()).unwrap().character, character);
    }
    let written: Value = serde_json::from_str(
        &RolloutFile { character: Character::Cast, ..RolloutFile::parse(&file().to_string()).unwrap() }
            .to_json(),
    )
    .unwrap();
    assert_eq!(written["variant"], "Disabled");
}

#[test]
fn the_character_asked_for_replaces_the_file_s() {
    let parsed = RolloutFile::parse(&file().to_string()).unwrap();
    let error = replay(&parsed, Some(Character::Cast)).unwrap_err();
    assert_eq!(error.to_string(), "rollouts[0].actions[0] has 21 numbers; the character needs 19");
}

#[test]
fn an_absent_field_is_named_with_its_rollout() {
    for field in ["beta", "qpos0", "qvel0", "actions"] {
        let said = complaint(|file| {
            second(file, field, json!(null));
            file["rollouts"][1].as_object_mut().unwrap().remove(field);
        });
        assert_eq!(said, format!("rollouts[1].{field} is absent; it must be given"));
    }
    let said = complaint(|file| drop(file.as_object_mut().unwrap().remove("rollouts")));
    assert_eq!(said, "rollouts is absent; it must be given");
}

#[test]
fn a_vector_of_the_wrong_length_is_named_with_both_lengths() {
    let said = complaint(|file| second(file, "qpos0", json!(vec![0.0; 27])));
    assert_eq!(said, "rollouts[1].qpos0 has 27 numbers; the character needs 28");
    let said = complaint(|file| second(file, "qvel0", json!([])));
    assert_eq!(said, "rollouts[1].qvel0 has 0 numbers; the character needs 27");
    let said = complaint(|file| second(file, "actions", json!([vec![0.0; 21], vec![0.0; 20]])));
    assert_eq!(said, "rollouts[1].actions[1] has 20 numbers; the character needs 21");
}

#[test]
fn a_number_that_is_none_is_named_with_its_place() {
    let said = complaint(|file| file["rollouts"][0]["actions"][2][5] = json!(null));
    assert_eq!(said, "rollouts[0].actions[2][5] is null; it must be a finite number");
    let said = complaint(|file| file["rollouts"][0]["qvel0"][1] = json!("fast"));
    assert_eq!(said, "rollouts[0].qvel0[1] is \"fast\"; it must be a finite number");
    let said = complaint(|file| file["rollouts"][0]["qpos0"][0] = json!(2e10));
    assert!(said.starts_with("rollouts[0].qpos0[0] is 20000000000; it must be finite"), "{said}");

    let text = file().to_string().replace("0.8", "NaN");
    let said = RolloutFile::parse(&text).unwrap_err().to_string();
    assert!(said.starts_with("not JSON: ") && said.contains("line 1 column"), "{said}");
    let text = file().to_string().replace("0.8", "1e999");
    let said = RolloutFile::parse(&text).unwrap_err().to_string();
    assert!(said.starts_with("not JSON: number out of range"), "{said}");

    let mut parsed = RolloutFile::parse(&file().to_string()).unwrap();
    parsed.rollouts[0].actions[1][3] = f64::NAN;
    let said = replay(&parsed, None).unwrap_err().to_string();
    assert!(said.starts_with("rollouts[0].actions[1][3] is NaN; it must be finite"), "{said}");
}

#[test]
fn a_file_of_another_kind_is_named_for_what_it_is() {
    let of = |text: &str| RolloutFile::parse(text).unwrap_err().to_string();
    assert_eq!(of("[1, 2]"), "the file is a list of 2; it must be an object");
    assert_eq!(of(r#"{"rollouts": 3}"#), "rollouts is 3; it must be a list of rollouts");
    assert_eq!(of(r#"{"rollouts": [7]}"#), "rollouts[0] is 7; it must be an object");
    assert!(of("").starts_with("not JSON: EOF"));
}

#[test]
fn an_unknown_variant_or_rate_is_refused() {
    let said = complaint(|file| file["variant"] = json!("Headless"));
    assert!(said.starts_with("variant is \"Headless\"; it must be \"standard\""), "{said}");
    let said = complaint(|file| file["physics_hz"] = json!(500));
    assert!(said.starts_with("task.physics_hz is 500; use 200"), "{said}");
    let said = complaint(|file| file["physics_hz"] = json!(-200));
    assert_eq!(said, "physics_hz is -200; it must be a whole number of steps a second");
    let said = complaint(|file| file["control_hz"] = json!(50));
    assert_eq!(said, "control_hz is 50; the get-up task is controlled at 40");
    let said = complaint(|file| file["control_limit"] = json!(0.5));
    assert!(said.starts_with("the control limit is 0.5; it must be finite and at least 1"), "{said}");
}

#[test]
fn a_rollout_that_diverges_says_so_and_the_others_go_on() {
    let mut file = file();
    let mut fast = vec![0.0; 27];
    fast[8] = 9e9;
    second(&mut file, "qvel0", json!(fast));
    file["rollouts"].as_array_mut().unwrap().swap(0, 1);
    let played = replay(&RolloutFile::parse(&file.to_string()).unwrap(), None).unwrap();
    let [first, other] = &played.rollouts[..] else { panic!("two rollouts in, two out") };
    let at = first.diverged.as_ref().expect("9e9 rad/s cannot last");
    assert_eq!(first.rewards.len(), at.step);
    assert_eq!(first.observations.len(), at.step + 1);
    assert_eq!((other.rewards.len(), &other.diverged), (3, &None));
}

#[test]
fn both_physics_rates_play_the_same_time() {
    let mut file = file();
    let slow = replay(&RolloutFile::parse(&file.to_string()).unwrap(), None).unwrap();
    file["physics_hz"] = json!(800);
    let fine = replay(&RolloutFile::parse(&file.to_string()).unwrap(), None).unwrap();
    let [slow, fine] = [slow, fine].map(|played| played.rollouts[0].qpos[2][2]);
    assert!((slow - fine).abs() < 0.01, "after 75 ms the root is at {slow} or {fine} m");
    assert_ne!(slow, fine);
}
