//! `getup bench` against real processes: it measures all that it says, and leaves the run's transitions alone.

#![cfg(feature = "learner")]

mod common;

use std::time::Duration;

use common::{Cluster, Process, fail, succeed, wait_for};
use serde_json::Value;

const LIMIT: Duration = Duration::from_secs(60);

fn bench(cluster: &Cluster, arguments: &[&str]) -> std::process::Command {
    let mut command = cluster.command("bench", 1.0);
    command.args(["--writers", "2", "--seconds", "2"]).args(arguments);
    command
}

#[test]
fn a_cluster_is_measured_by_a_table_of_its_own() {
    let cluster = Cluster::new();
    let mut replay = cluster.start("replay", 1.0);
    wait_for("the replay answers", LIMIT, || cluster.status()?["replay"]["store"].as_str().map(drop));
    // Not by the run's own, unless that is wanted; and not by one that is not there.
    assert!(
        fail(&mut bench(&cluster, &["--table", "default"])).contains("run `smoke` learns from: say --yes")
    );
    assert!(fail(&mut bench(&cluster, &[])).contains("has no table `bench` but default"));
    replay.signal("TERM");
    assert!(replay.wait(LIMIT).success());

    std::fs::write(cluster.path().join("bench.toml"), "[bench]\ncapacity = 20000\nmin_size = 1\n").unwrap();
    let mut command = cluster.command("replay", 1.0);
    let _replay = Process::start("replay", cluster.path(), command.args(["--tables", "bench.toml"]));
    let measure = || -> Value {
        let said = succeed(&mut bench(&cluster, &["--json"]));
        serde_json::from_str(&said).unwrap()
    };
    let positive = |report: &Value, names: &[&str]| {
        for name in names {
            assert!(report[name].as_f64().is_some_and(|value| value > 0.0), "{name}: {report}");
        }
    };
    wait_for("the replay answers", LIMIT, || cluster.status()?["replay"]["store"].as_str().map(drop));
    let report = measure();
    positive(&report, &["append_p50_ms", "append_p99_ms", "env_steps_per_second", "megabytes_per_second"]);
    let batches: Vec<&Value> =
        report["samples"].as_array().unwrap().iter().map(|sampled| &sampled["batch"]).collect();
    assert_eq!(batches, [128, 256, 1024]);
    report["samples"]
        .as_array()
        .unwrap()
        .iter()
        .for_each(|sampled| positive(sampled, &["minibatches_per_second"]));
    // There is no learner yet: that is said, and the rest is measured.
    assert!(report["no_broadcast"].as_str().is_some_and(|why| !why.is_empty()), "{report}");
    assert_eq!(cluster.status().unwrap()["replay"]["transitions"], 0, "the run's table is untouched");

    let _roles = ["learner", "actor"].map(|role| cluster.start(role, 1_000.0));
    wait_for("updates", LIMIT, || cluster.learner_metric("updates_total").filter(|updates| *updates >= 20.0));
    let report = measure();
    positive(&report["broadcast"], &["policies_per_second", "lag_p50_ms", "lag_p99_ms"]);
    let status = cluster.status().unwrap();
    assert_eq!(status["learner"]["actors"].as_array().unwrap().len(), 1, "listeners are no actors: {status}");
}
