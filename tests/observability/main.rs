//! What operators see, held against a live fleet and a real Prometheus: every panel's query has an answer, every alert that
//! can be provoked here fires under its fault and clears after it, and docs/metrics.md names what the processes expose.

#![cfg(feature = "learner")]

#[path = "../common/mod.rs"]
mod common;
mod documented;
mod fleet;
mod small_disk;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use common::{succeed, wait_for};
use fleet::Fleet;
use serde_json::Value;
use small_disk::SmallDisk;

const LIMIT: Duration = Duration::from_secs(60);

fn deploy(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy").join(path)
}

/// Whether Debian's Prometheus is there.
fn has_prometheus() -> bool {
    let there =
        Command::new("prometheus").arg("--version").output().is_ok_and(|output| output.status.success());
    if !there {
        common::skip("Prometheus is not installed (Debian: apt-get install prometheus)");
    }
    there
}

/// The queries of all dashboards, by where they stand.
fn panels() -> Vec<(String, String)> {
    let mut queries = Vec::new();
    for name in ["training", "fleet", "replay"] {
        let text = fs::read_to_string(deploy(&format!("grafana/dashboards/{name}.json"))).unwrap();
        let dashboard: Value = serde_json::from_str(&text).unwrap();
        for panel in dashboard["panels"].as_array().unwrap() {
            let title = format!("{name}: {}", panel["title"].as_str().unwrap());
            if panel["type"] == "text" {
                continue;
            }
            assert!(!panel["description"].as_str().unwrap_or("").is_empty(), "{title} has a description");
            let defaults = &panel["fieldConfig"]["defaults"];
            assert!(!defaults["unit"].as_str().unwrap_or("").is_empty(), "{title} has a unit");
            let targets = panel["targets"].as_array().unwrap();
            assert!(!targets.is_empty(), "{title} has a query");
            queries.extend(
                targets.iter().map(|target| (title.clone(), target["expr"].as_str().unwrap().to_owned())),
            );
        }
    }
    queries
}

/// As Grafana fills it in.
fn filled_in(query: &str) -> String {
    let values = [("$__rate_interval", "5s"), ("$run", "smoke"), ("$actor", ".*"), ("$table", ".*")];
    values.iter().fold(query.to_owned(), |query, (variable, value)| query.replace(variable, value))
}

#[test]
fn every_panel_has_an_answer_and_alerts_fire_under_their_faults_and_clear_after() {
    if !has_prometheus() {
        return;
    }
    let fleet = Fleet::new();
    let mut replay = fleet.replay(None);
    let mut learner = fleet.learner(&[]);
    let link = fleet.link(&[]);
    let actors = [fleet.actor(0), fleet.actor(1)];
    let _prometheus = fleet.prometheus();
    fleet.wait_for_updates(20.0);
    wait_for("an evaluation", LIMIT, || {
        fleet.cluster.learner_metric("evaluations_total").filter(|count| *count >= 2.0)
    });

    // Every query of every panel is answered by numbers.
    let mut unanswered: BTreeMap<(String, String), Vec<f64>> =
        panels().into_iter().map(|panel| (panel, Vec::new())).collect();
    let until = Instant::now() + LIMIT;
    while !unanswered.is_empty() && Instant::now() < until {
        unanswered.retain(|(_, query), found| {
            *found = fleet.query(&filled_in(query));
            found.is_empty() || found.iter().any(|value| value.is_nan())
        });
        std::thread::sleep(Duration::from_millis(500));
    }
    assert!(unanswered.is_empty(), "{unanswered:#?}");
    // They move: so does what they count.
    let updates = "sum(rate(getup_learner_updates_total{run=~\"smoke\"}[3s]))";
    assert!(fleet.query(updates)[0] > 0.0);
    for alert in [
        "LearnerStalled",
        "LossNotFinite",
        "ActorLost",
        "PolicyStale",
        "EvaluationOverdue",
        "LimiterStuck",
        "TargetDown",
    ] {
        assert!(!fleet.is_firing(alert), "{alert} fires in health");
    }

    // A way to the actor that is too narrow for policies: its heartbeats are heard, what it plays grows old.
    drop(link);
    let link = fleet.link(&["--back", "500"]);
    fleet.wait_until_firing("PolicyStale");
    assert_eq!(
        fleet.query("ALERTS{alertname=\"PolicyStale\", alertstate=\"firing\", actor!=\"actor-1\"}"),
        Vec::<f64>::new()
    );
    drop(link);
    let _link = fleet.link(&[]);
    fleet.wait_until_clear("PolicyStale");

    // A replay that hangs: no metrics from it, no updates.
    replay.signal("STOP");
    fleet.wait_until_firing("TargetDown");
    fleet.wait_until_firing("LearnerStalled");
    assert!(fleet.query(updates).iter().all(|rate| *rate == 0.0), "the panel shows it");
    replay.signal("CONT");
    fleet.wait_until_clear("TargetDown");
    fleet.wait_until_clear("LearnerStalled");

    // A learner that hangs: actors are ahead as far as they may.
    learner.signal("STOP");
    fleet.wait_until_firing("LimiterStuck");
    learner.signal("CONT");
    fleet.wait_until_clear("LimiterStuck");

    // Actors that hang while an evaluation is out: it is overdue, and they are lost.
    let hanging = || {
        wait_for("an evaluation is out", LIMIT, || {
            fleet.cluster.learner_metric("evaluations_outstanding").filter(|count| *count > 0.0)
        });
        actors.iter().for_each(|actor| actor.signal("STOP"));
        std::thread::sleep(Duration::from_millis(500));
        let out = fleet.cluster.learner_metric("evaluations_outstanding").unwrap() > 0.0;
        if !out {
            actors.iter().for_each(|actor| actor.signal("CONT"));
        }
        out.then_some(())
    };
    wait_for("actors hang while an evaluation is out", LIMIT, hanging);
    fleet.wait_until_firing("ActorLost");
    fleet.wait_until_firing("EvaluationOverdue");
    assert_eq!(fleet.query("count(ALERTS{alertname=\"ActorLost\", alertstate=\"firing\"})"), [2.0]);
    actors.iter().for_each(|actor| actor.signal("CONT"));
    fleet.wait_until_clear("ActorLost");
    fleet.wait_until_clear("EvaluationOverdue");

    // A temperature that grows without end: training stops, the process stays and says so. Back at the last checkpoint it goes on.
    learner.signal("TERM");
    assert!(learner.wait(LIMIT).success());
    let mut learner = fleet.learner(&["sac.temperature_lr=1", "sac.target_entropy=1000000.0"]);
    fleet.wait_until_firing("LossNotFinite");
    learner.assert_running();
    learner.signal("TERM");
    assert!(!learner.wait(LIMIT).success(), "it ends with its error");
    assert!(learner.log().contains("training stopped: the "), "{}", learner.log());
    let mut learner = fleet.learner(&[]);
    fleet.wait_until_clear("LossNotFinite");
    fleet.wait_for_updates(20.0);

    // A disk that cannot hold the capacity.
    replay.signal("TERM");
    assert!(replay.wait(LIMIT).success());
    let Some(disk) = SmallDisk::new("3m") else {
        common::skip("a disk that is nearly full: this process may not mount a file system");
        return;
    };
    let mut replay = fleet.replay(Some(&disk));
    fleet.wait_until_firing("DiskNearlyFull");
    assert!(disk.mount("remount,size=64m"));
    fleet.wait_until_clear("DiskNearlyFull");
    fleet.wait_for_updates(5.0);
    for process in [&mut replay, &mut learner] {
        process.assert_running();
    }
}

#[test]
fn rules_pass_promtools_checks_and_unit_tests() {
    if !has_prometheus() {
        return;
    }
    let folder = deploy("prometheus");
    succeed(Command::new("promtool").args(["check", "rules", "rules/getup.yml"]).current_dir(&folder));
    succeed(
        Command::new("promtool").args(["test", "rules", "getup_test.yml"]).current_dir(folder.join("tests")),
    );
    let rules = fs::read_to_string(folder.join("rules/getup.yml")).unwrap();
    let runbook = fs::read_to_string(folder.join("../../docs/runbook.md")).unwrap();
    let alerts: Vec<&str> = rules.lines().filter_map(|line| line.trim().strip_prefix("- alert: ")).collect();
    assert!(alerts.len() >= 8, "{alerts:?}");
    for alert in alerts {
        assert!(
            runbook.lines().any(|line| line.trim_start_matches('#').trim() == alert),
            "{alert} is in the runbook"
        );
    }
}
