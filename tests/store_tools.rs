//! The tools of a replay's store, as their user meets them.

#![cfg(feature = "learner")]

mod common;

use std::fs;
use std::path::Path;
use std::time::Duration;

use common::{Process, fail, free_address, getup, succeed, wait_for};
use serde_json::Value;

fn json(folder: &Path, arguments: &[&str]) -> Value {
    let said = succeed(getup(arguments).arg("--json").current_dir(folder));
    serde_json::from_str(&said).unwrap()
}

/// A replay service with a table of its own beside the default one, and where it listens.
fn replay(folder: &Path) -> (Process, String) {
    fs::write(folder.join("tables.toml"), "[queue]\nsampler = \"fifo\"\nmax_times_sampled = 1\n").unwrap();
    let (address, metrics) = (free_address(), free_address());
    let mut command = getup(&["replay", "--preset", "smoke", "--tables", "tables.toml", "--dir", "store"]);
    command.args(["--set", &format!("network.replay={address}")]);
    command.args(["--set", &format!("network.replay_metrics={metrics}")]);
    (Process::start("replay", folder, command.current_dir(folder)), address)
}

#[test]
fn a_runs_store_is_inspected_verified_mended_compacted_and_exported() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut train = getup(&["train", "--preset", "smoke", "--steps", "3000", "--run", "run"]);
    train.args(["--set", &format!("network.learner_metrics={}", free_address())]);
    succeed(train.current_dir(folder));
    let store = "run/replay";
    let held = json(folder, &["replay", "inspect", store]);
    assert!(held["ever"]["env_steps"].as_u64().unwrap() >= 3000, "{held}");
    assert_eq!((&held["damages"], &held["spec"]["run"]), (&serde_json::json!([]), &serde_json::json!("run")));
    let said = succeed(getup(&["replay", "verify", store]).current_dir(folder));
    assert!(said.contains("every segment passes its checks"), "{said}");

    // What is exported is what there is.
    let exported = json(folder, &["replay", "export", store, "--format", "npz", "--output", "run.npz"]);
    assert_eq!(exported["transitions"], held["transitions"]);
    let dataset = json(folder, &["replay", "export", store, "--format", "minari", "--id", "getup/smoke-v0"]);
    assert_eq!(dataset["transitions"], held["transitions"]);
    let metadata = fs::read(folder.join("getup/smoke-v0/data/metadata.json")).unwrap();
    let metadata: Value = serde_json::from_slice(&metadata).unwrap();
    assert_eq!(metadata["total_steps"], held["transitions"]);
    let again = fail(
        getup(&["replay", "export", store, "--format", "npz", "--output", "run.npz"]).current_dir(folder),
    );
    assert!(again.contains("run.npz exists already"), "{again}");

    // The oldest file is missing: what is left is not exported as if it were all.
    let segments = folder.join(store).join("segments");
    let oldest = fs::read_dir(&segments).unwrap().map(|entry| entry.unwrap().path()).min().unwrap();
    fs::rename(&oldest, folder.join("aside")).unwrap();
    for format in ["npz", "minari"] {
        let mut export = getup(&["replay", "export", store, "--format", format, "--output", "holes-v0"]);
        let refused = fail(export.current_dir(folder));
        assert!(
            refused.contains("damaged") && refused.contains("getup replay repair run/replay"),
            "{refused}"
        );
        assert!(!folder.join("holes-v0").exists());
    }
    fs::rename(folder.join("aside"), &oldest).unwrap();

    // A hole in it.
    let mut bytes = fs::read(&oldest).unwrap();
    let hole = bytes.len() / 2;
    bytes[hole..hole + 64].fill(0);
    fs::write(&oldest, bytes).unwrap();
    let damaged = fail(getup(&["replay", "verify", store]).current_dir(folder));
    assert!(damaged.contains("damaged") && damaged.contains("getup replay repair run/replay"), "{damaged}");
    let refused = fail(getup(&["train", "--resume", "--run", "run"]).current_dir(folder));
    assert!(refused.contains("are no whole segment") && refused.contains("getup replay repair"), "{refused}");
    let refused = fail(getup(&["replay", "compact", store]).current_dir(folder));
    assert!(refused.contains("damaged"), "{refused}");
    let repaired = json(folder, &["replay", "repair", store]);
    let kept = repaired["segments"].as_u64().unwrap();
    assert_eq!(kept, held["segments"].as_u64().unwrap() - 1, "{repaired}");
    assert!(folder.join(repaired["old"].as_str().unwrap()).join("segments").is_dir());
    succeed(getup(&["replay", "verify", store]).current_dir(folder));
    let compacted = json(folder, &["replay", "compact", store, "--keep", "500"]);
    assert!((500..564).contains(&compacted["transitions"].as_u64().unwrap()), "{compacted}");
    // And training goes on with it.
    succeed(getup(&["train", "--resume", "--run", "run", "--steps", "3500"]).current_dir(folder));

    let nothing = fail(getup(&["replay", "inspect", "run"]).current_dir(folder));
    assert!(nothing.contains("there is no replay store in run"), "{nothing}");
}

#[test]
fn a_running_replay_has_tables_and_copies_itself() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let (mut replay, address) = replay(folder);
    let setting = format!("network.replay={address}");
    let snapshot = |name, table: &[&str]| {
        let mut command = getup(&["replay", "snapshot", name, "--set", &setting, "--json"]);
        command.args(table).current_dir(folder);
        command
    };
    let taken = wait_for("the service", Duration::from_secs(30), || {
        let output = common::output(&mut snapshot("first", &["--table", "queue"]));
        output.status.success().then(|| serde_json::from_slice::<Value>(&output.stdout).unwrap())
    });
    let path = taken["path"].as_str().unwrap();
    assert!(path.ends_with("store/tables/queue/snapshots/first"), "{taken}");
    succeed(getup(&["replay", "verify", path]).current_dir(folder));
    let unknown = fail(&mut snapshot("second", &["--table", "stack"]));
    assert!(unknown.contains("no table `stack` here, but default, queue"), "{unknown}");
    // In use: it can be looked at.
    succeed(getup(&["replay", "inspect", "store"]).current_dir(folder));
    let refused = fail(getup(&["replay", "compact", "store"]).current_dir(folder));
    assert!(refused.contains("in use by another process"), "{refused}");
    replay.signal("TERM");
    assert!(replay.wait(Duration::from_secs(10)).success(), "{}", replay.log());
}
