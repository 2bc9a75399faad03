//! The cluster in small: replay, learner and one actor as three real processes on loopback.

#![cfg(feature = "learner")]

mod common;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use common::{Cluster, getup, metric, scrape, succeed, wait_for};
use getup_policy::Policy;
use serde_json::Value;

const LIMIT: Duration = Duration::from_secs(60);

fn wait_for_at_least(cluster: &Cluster, name: &str, least: f64) -> f64 {
    wait_for(&format!("getup_learner_{name} >= {least}"), LIMIT, || {
        cluster.learner_metric(name).filter(|value| *value >= least)
    })
}

#[test]
fn three_processes_train_promote_survive_a_kill_finish_and_end_with_0() {
    let cluster = Cluster::new();
    // In the order in which they need each other least.
    let mut actor = cluster.start("actor", 1.0);
    let mut learner = cluster.start("learner", 1.0);
    std::thread::sleep(Duration::from_millis(500));
    let mut replay = cluster.start("replay", 1.0);

    wait_for_at_least(&cluster, "updates_total", 20.0);
    wait_for_at_least(&cluster, "env_steps", 1_000.0);
    wait_for_at_least(&cluster, "policy_version", 3.0);
    wait_for_at_least(&cluster, "evaluations_total", 1.0);
    wait_for_at_least(&cluster, "promotions_total", 1.0);
    wait_for_at_least(&cluster, "checkpoints_total", 1.0);
    wait_for("the actor acts by a policy that was trained", LIMIT, || {
        let status = cluster.status()?;
        let version = status["learner"]["actors"][0]["version"].as_str()?.to_owned();
        version.strip_prefix("1.")?.parse::<u64>().ok().filter(|counter| *counter >= 2)
    });
    assert!(cluster.learner_metric("beta").unwrap() < 1.0);

    let before = last_checkpoint_env_steps(cluster.path());
    let stage = cluster.learner_metric("stage").unwrap();
    learner.signal("KILL");
    assert!(!learner.wait(LIMIT).success());
    // The same run, now with a threshold that nobody passes: the stage outlasts its limit.
    let mut learner = cluster.start("learner", 1_000.0);
    wait_for_at_least(&cluster, "env_steps", before);
    assert!(cluster.learner_metric("stage").unwrap() >= stage, "the curriculum goes on where it was");
    wait_for_at_least(&cluster, "finished", 1.0);
    assert!(learner.log().contains("StageOutlasted"), "{}", learner.log());
    let status = cluster.status().unwrap();
    assert_eq!(status["learner"]["state"], "finished");
    for process in [&mut actor, &mut learner, &mut replay] {
        process.assert_running();
    }

    check_metrics(&cluster);
    check_run_folder(&cluster.path().join("runs/smoke"));
    for process in [&mut actor, &mut learner, &mut replay] {
        process.signal("TERM");
    }
    for process in [&mut actor, &mut learner, &mut replay] {
        let status = process.wait(Duration::from_secs(10));
        assert!(status.success(), "{status}:\n{}", process.log());
    }
}

#[test]
fn a_role_whose_peers_are_away_or_frozen_says_so_and_ends_with_0_when_asked() {
    let cluster = Cluster::new();
    let mut learner = cluster.start("learner", 1.0);
    let mut actor = cluster.start("actor", 1.0);
    let waiting = wait_for("the learner says that it waits for the replay", LIMIT, || {
        let status = cluster.status()?;
        let waiting = status["learner"]["waiting"].as_str()?.to_owned();
        (waiting.contains("replay") && !waiting.contains("(for 0 s)")).then_some(waiting)
    });
    assert!(waiting.contains(cluster.address("replay")), "{waiting}");
    // A connection that never says a word, and an actor that is frozen while it is connected.
    let silent = std::net::TcpStream::connect(cluster.address("learner")).unwrap();
    actor.signal("STOP");
    learner.signal("TERM");
    let status = learner.wait(Duration::from_secs(10));
    assert!(status.success(), "{status}:\n{}", learner.log());
    drop(silent);
    actor.signal("CONT");
    actor.signal("TERM");
    let status = actor.wait(Duration::from_secs(10));
    assert!(status.success(), "{status}:\n{}", actor.log());
}

fn last_checkpoint_env_steps(folder: &Path) -> f64 {
    let files = std::fs::read_dir(folder.join("runs/smoke/checkpoints")).unwrap();
    let steps = files.filter_map(|file| {
        let name = file.unwrap().file_name().into_string().unwrap();
        name.strip_prefix("step-")?.split('-').next()?.parse::<f64>().ok()
    });
    steps.fold(0.0, f64::max)
}

/// What was provoked above is in `/metrics` of each role, in a form that Prometheus' own linter accepts.
fn check_metrics(cluster: &Cluster) {
    let expected = [
        ("actor_metrics", &["getup_actor_env_steps_total", "getup_actor_evaluations_total"][..]),
        ("replay_metrics", &["getup_replay_env_steps_total", "getup_replay_sampled_transitions_total"]),
        ("learner_metrics", &["getup_learner_evaluation_return_min", "getup_learner_temperature"]),
    ];
    for (role, names) in expected {
        let text = scrape(cluster.address(role)).unwrap();
        assert!(text.contains("getup_build_info"), "{role}");
        for name in names {
            let value = metric(cluster.address(role), name);
            assert!(value.is_some_and(|value| value > 0.0), "{name} is {value:?} in\n{text}");
        }
        lint(role, &text);
    }
}

fn lint(role: &str, text: &str) {
    let linter = Command::new("promtool")
        .args(["check", "metrics"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn();
    let Ok(mut linter) = linter else {
        return common::skip(format!(
            "{role}'s metrics: promtool is not installed (Debian: apt-get install prometheus)"
        ));
    };
    std::io::Write::write_all(linter.stdin.as_mut().unwrap(), text.as_bytes()).unwrap();
    let output = linter.wait_with_output().unwrap();
    let complaints = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "promtool on {role}:\n{complaints}");
}

fn check_run_folder(folder: &Path) {
    let lines = std::fs::read_to_string(folder.join("evaluations.jsonl")).unwrap();
    let evaluations: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    for evaluation in &evaluations {
        for key in ["version", "env_steps", "updates", "stage", "beta", "mean", "min", "returns"] {
            assert!(!evaluation[key].is_null(), "{key} in {evaluation}");
        }
    }
    let steps: Vec<u64> = evaluations.iter().map(|line| line["env_steps"].as_u64().unwrap()).collect();
    assert!(steps.is_sorted(), "{steps:?}");
    let mut stages = Vec::new();
    for model in std::fs::read_dir(folder.join("models")).unwrap().map(|entry| entry.unwrap().path()) {
        let said = Policy::load(&model).unwrap().metadata;
        assert_eq!(said["physics_hz"], "200");
        if let Some(stage) = model.file_stem().unwrap().to_str().unwrap().strip_prefix("stage-") {
            assert_eq!(said["stage"], stage);
            stages.push(stage.parse::<u32>().unwrap());
        }
    }
    let last = stages.iter().max().expect("a stage was passed");
    let best = folder.join("models/best.safetensors");
    let read = |path: &Path| std::fs::read(path).unwrap();
    let passed = folder.join(format!("models/stage-{last}.safetensors"));
    assert!(read(&best) == read(&passed), "best is not what passed stage {last}");
    let report = succeed(
        getup(&["evaluate", best.to_str().unwrap(), "--episodes", "2", "--json"]).current_dir(folder),
    );
    let report: Value = serde_json::from_str(&report).unwrap();
    assert_eq!(report["episodes"], 2);
    assert!(report["beta"].as_f64().unwrap() <= 1.0);
}
