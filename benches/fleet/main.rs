//! Scale on one machine: simulated actors against one learner and one replay, and what grows how with their number.
//!
//! Three processes, so that processor time can be told apart:
//!
//! | process | what is real | what is not |
//! | --- | --- | --- |
//! | replay | store, log, service | |
//! | learner | hub, service, broadcasts of preset `laptop`'s policy, sampling over gRPC | no gradients |
//! | load | each actor's two connections: segments of 64 steps appended, policies heard and parsed, a heartbeat a second | no physics: segments come at a fixed pace |
//!
//! An actor makes [`ENV_STEPS`] env steps a second, a sixth of what a core with physics makes, so that 256 of them fit on
//! two cores beside the services. The learner samples 0.4 minibatches of 128 an env step, but no
//! more than [`MOST_MINIBATCHES`] a second, which two cores can train on. The replay's limiter is off.
//!
//! | row | |
//! | --- | --- |
//! | `broadcast lag` | from a policy's publication until it is in the actor's slot, parsed |
//! | `append` | until a segment is acknowledged |
//! | `heartbeat` | until it is answered |
//! | `… processor` | processor time: milliseconds a second; `others` is all that is not this benchmark |
//! | `… memory` | resident; that of the replay grows with its transitions |
//! | `env steps`, `policies heard`, `minibatches` | a second; `limit` is what was offered |
//! | `heartbeat in the hub` | the hub's part of it, in process, alone: the fastest of several rounds |
//!
//! `(1/s)` marks a further point with one broadcast a second, that tells what a broadcast costs.
//!
//! `GETUP_FLEET_BROADCASTS=1` broadcasts once a second instead of five times; with `GETUP_FLEET_RECORD=1` the points are
//! also written to `docs/runs/fleet.json`, from where `cargo xtask plot` draws them.

mod actors;
#[path = "../common/mod.rs"]
mod common;
#[path = "../../replay/tests/fixtures/mod.rs"]
mod fixtures;
mod hub_cost;
mod learner;
#[path = "../../src/bench/load.rs"]
mod load;
mod point;
mod processes;
mod replay;

use std::fs;
use std::path::Path;
use std::thread;
use std::time::Duration;

use actors::ENV_STEPS;
use anyhow::{Context, Result};
use common::{Row, report};
use hub_cost::{HubCost, hub_cost};
use point::{TIME, point};
use serde_json::json;

/// Simulated actors of the points.
const ACTORS: [u64; 5] = [1, 4, 16, 64, 256];
/// Broadcasts a second, unless `GETUP_FLEET_BROADCASTS` says otherwise.
const BROADCASTS: f64 = 5.0;
/// Of one more point, that tells what a broadcast costs.
const FEW_BROADCASTS: f64 = 1.0;
/// The whole benchmark ends by then.
const LIMIT: Duration = Duration::from_secs(175);

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[1..] {
        ["replay", dir] => return replay::run(Path::new(dir)),
        ["learner", replay, broadcasts, minibatches] => {
            return learner::run(replay, broadcasts.parse()?, minibatches.parse()?);
        }
        ["load", replay, learner, actors] => return actors::run(replay, learner, actors.parse()?),
        _ => {}
    }
    thread::spawn(|| {
        thread::sleep(LIMIT);
        eprintln!("error: the benchmark takes longer than {LIMIT:?}: is the machine busy?");
        // The other processes end with this one.
        std::process::exit(1);
    });
    let broadcasts = match std::env::var("GETUP_FLEET_BROADCASTS") {
        Ok(text) => text.parse().context("GETUP_FLEET_BROADCASTS is a number of broadcasts a second")?,
        Err(_) => BROADCASTS,
    };
    let mut points = Vec::new();
    for actors in ACTORS {
        points.push(point(actors, broadcasts)?);
    }
    if broadcasts != FEW_BROADCASTS {
        points.push(point(ACTORS[ACTORS.len() - 1], FEW_BROADCASTS)?);
    }
    let hub: Vec<HubCost> = [256, 10_000].map(hub_cost).into();
    let mut rows: Vec<Row> = points.iter().flat_map(|point| point.rows(broadcasts)).collect();
    for HubCost { actors, seconds } in &hub {
        rows.push(Row::less(format!("heartbeat in the hub, {actors} actors"), "us", 1e6 * seconds));
    }
    report("fleet", &rows)?;
    if std::env::var_os("GETUP_FLEET_RECORD").is_some() {
        let record = json!({
            "broadcasts_per_second": broadcasts,
            "env_steps_per_actor": ENV_STEPS,
            "seconds": TIME.as_secs_f64(),
            "model_bytes": learner::policy().to_bytes().len(),
            "points": points,
            "hub": hub,
        });
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/runs/fleet.json");
        fs::write(&file, serde_json::to_string_pretty(&record)? + "\n")?;
        println!("written to {}", file.display());
    }
    Ok(())
}
