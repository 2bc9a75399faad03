//! Two replays of one run, as real processes: what one of them costs when it is killed.

#![cfg(feature = "learner")]

mod common;

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use common::{Cluster, Process, free_address, metric, wait_for};

const LIMIT: Duration = Duration::from_secs(60);
const ROLES: [&str; 2] = ["replay-0", "replay-1"];

/// A cluster with two replays.
struct Sharded {
    cluster: Cluster,
    metrics: [String; 2],
}

impl Sharded {
    fn start_replay(&self, shard: usize) -> Process {
        let mut command = self.cluster.command("replay", 1.0);
        command.args(["--shard", &shard.to_string(), "--log-format", "json"]);
        command.args(["--set", &format!("network.replay_metrics={}", self.metrics[shard])]);
        // A fast machine fills the preset's ring, and what leaves it is in no store.
        command.args(["--set", "replay.capacity=1000000"]);
        Process::start(ROLES[shard], self.cluster.path(), &mut command)
    }

    fn metric(&self, shard: usize, name: &str) -> f64 {
        metric(&self.metrics[shard], &format!("getup_replay_{name}")).unwrap_or(0.0)
    }

    fn wait_for(&self, shard: usize, name: &str, least: f64) {
        let what = format!("{name} of replay {shard} is {least}");
        wait_for(&what, LIMIT, || (self.metric(shard, name) >= least).then_some(()));
    }
}

#[test]
fn two_replays_share_the_work_and_one_that_is_killed_delays_nobody_and_loses_nothing() {
    let replays = [free_address(), free_address()].join(",");
    let sharded =
        Sharded { cluster: Cluster::with_replay(replays), metrics: [free_address(), free_address()] };
    let cluster = &sharded.cluster;
    let mut first = sharded.start_replay(0);
    let mut second = sharded.start_replay(1);
    // Nothing passes its threshold: the run goes on until it is told to end.
    let mut learner = cluster.start("learner", 1_000.0);
    let mut actor = cluster.start("actor", 1_000.0);
    for shard in 0..2 {
        sharded.wait_for(shard, "env_steps_total", 300.0);
        sharded.wait_for(shard, "sampled_transitions_total", 1_000.0);
    }
    wait_for("each has its half", LIMIT, || {
        let stored = [0, 1].map(|shard| sharded.metric(shard, "env_steps_total"));
        (stored[0].min(stored[1]) > 0.8 * stored[0].max(stored[1])).then_some(())
    });

    second.signal("KILL");
    assert!(!second.wait(LIMIT).success());
    let updates = cluster.learner_metric("updates_total").unwrap();
    let stored = sharded.metric(0, "env_steps_total");
    sharded.wait_for(0, "env_steps_total", stored + 500.0);
    wait_for("updates go on", LIMIT, || {
        cluster.learner_metric("updates_total").filter(|now| *now >= updates + 30.0)
    });

    let mut second = sharded.start_replay(1);
    let stored = wait_for("the second is back", LIMIT, || {
        Some(sharded.metric(1, "env_steps_total")).filter(|stored| *stored > 0.0)
    });
    sharded.wait_for(1, "env_steps_total", stored + 100.0);
    let status = cluster.status().unwrap();
    assert_eq!(status["replay"].as_array().map(Vec::len), Some(2), "{status}");

    for process in [&mut actor, &mut learner, &mut first, &mut second] {
        process.signal("TERM");
        let status = process.wait(Duration::from_secs(10));
        assert!(status.success(), "{status}:\n{}", process.log());
    }
    // Every acknowledged segment is in one of the stores, and none in both.
    let mut seen = BTreeMap::new();
    for shard in 0..2 {
        read(&cluster.path().join(format!("runs/smoke/replay-{shard}")), &mut seen);
    }
    let acknowledged = acknowledged(&actor.log());
    assert!(seen.values().all(|&times| times == 1));
    assert!(seen.len() as u64 >= acknowledged && acknowledged > 0, "{} of {acknowledged}", seen.len());
}

/// Counts the segments of a store, by the lane, episode and step that they begin with.
fn read(store: &Path, seen: &mut BTreeMap<(u32, u64, u32), u32>) {
    let survey = getup_replay::Survey::read(store, |segment| {
        *seen.entry((segment.lane, segment.episode, segment.first_step)).or_default() += 1;
    });
    assert_eq!(survey.unwrap().damages, Vec::<String>::new(), "{}", store.display());
}

/// How many segments the actor says were acknowledged, at its end.
fn acknowledged(log: &str) -> u64 {
    let lines = log.lines().filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    let ended = lines.filter_map(|line| line["acknowledged"].as_u64()).next_back();
    ended.unwrap_or_else(|| panic!("the actor says what was acknowledged:\n{log}"))
}
