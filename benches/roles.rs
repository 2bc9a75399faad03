//! What the network between the roles costs: updates a second of three processes (replay, learner, one actor) over
//! those of the same training in one process (`limit`), in turns, with preset `laptop`.

mod common;
#[path = "../tests/common/mod.rs"]
mod processes;

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use common::{Row, median, report};
use processes::{Process, free_address, getup, metric, wait_for};

/// Pairs of turns.
const PAIRS: usize = 3;
/// How long a turn is measured, once updates are being made.
const TIME: Duration = Duration::from_secs(30);
const PATIENCE: Duration = Duration::from_secs(60);

fn main() -> anyhow::Result<()> {
    let [mut ours, mut limits, mut shares] = [const { Vec::new() }; 3];
    for pair in 0..PAIRS {
        // Whoever goes second finds the caches warm: take turns in that too.
        let (our, limit) = if pair % 2 == 0 {
            let our = three_processes()?;
            (our, one_process()?)
        } else {
            let limit = one_process()?;
            (three_processes()?, limit)
        };
        ours.push(our);
        limits.push(limit);
        shares.push(our / limit);
    }
    let row = Row {
        name: "three processes, laptop".into(),
        unit: "updates/s".into(),
        ours: median(ours),
        peer: None,
        limit: Some(median(limits)),
        ratio_to_peer: None,
        share_of_limit: Some(median(shares)),
    };
    report("roles", &[row])
}

/// A command of a role whose metrics of the learner are served at `metrics`; it trains after 1,000 env steps.
fn command(role: &str, folder: &Path, addresses: &[(&str, String)]) -> Command {
    let mut command =
        getup(&[role, "--preset", "laptop", "--set", "run=bench", "--set", "sac.uniform_steps=1000"]);
    for (name, address) in addresses {
        command.args(["--set", &format!("network.{name}={address}")]);
    }
    command.current_dir(folder);
    command
}

fn one_process() -> anyhow::Result<f64> {
    let folder = tempfile::tempdir()?;
    let addresses = [("learner_metrics", free_address())];
    let _train = Process::start("train", folder.path(), &mut command("train", folder.path(), &addresses));
    Ok(updates_per_second(&addresses[0].1))
}

fn three_processes() -> anyhow::Result<f64> {
    let folder = tempfile::tempdir()?;
    let names = ["replay", "learner", "replay_metrics", "actor_metrics", "learner_metrics"];
    let addresses = names.map(|name| (name, free_address()));
    let start = |role| Process::start(role, folder.path(), &mut command(role, folder.path(), &addresses));
    let _roles = ["replay", "learner", "actor"].map(start);
    Ok(updates_per_second(&addresses[4].1))
}

/// Measured once the first hundred updates are made.
fn updates_per_second(metrics: &str) -> f64 {
    let updates = || metric(metrics, "getup_learner_updates_total").filter(|updates| *updates >= 100.0);
    let before = wait_for("a hundred updates", PATIENCE, updates);
    let start = Instant::now();
    std::thread::sleep(TIME);
    let after = wait_for("the learner's metrics", PATIENCE, updates);
    (after - before) / start.elapsed().as_secs_f64()
}
