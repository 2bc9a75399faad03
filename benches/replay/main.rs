//! The replay service beside DeepMind Reverb's, and beside what the network and the memory allow.
//!
//! Transitions of the get-up task: 68 numbers of observation, 21 of action, a reward and β, in segments of 64 steps (the
//! last of an episode shorter) of episodes of 250. Both services are processes of their own, on loopback, and their
//! clients use both cores with them.
//!
//! | row | ours | peer | limit |
//! | --- | --- | --- | --- |
//! | `grpc insert` | transitions a second, acknowledged, as an actor appends them: 16 segments at a time; durable against a kill | Reverb's best in the committed sweep, in its memory | |
//! | `grpc insert, synced` | the same with `replay.sync = "data"`: durable against a power loss | | |
//! | `grpc sample` | transitions a second of a [`RemoteSource`], 16 minibatches ahead | Reverb's best, through tf.data | a bare tonic stream of equal messages, parsed no further |
//! | `in-process sample` | transitions a second of `Store::try_sample`, batch 256 | | a bare gather of as many rows at random places of a flat array |
//! | `… latency` | seconds: p50 and p99 until 64 steps are acknowledged, nothing else on its way; of a minibatch at full speed | the same of Reverb | |
//! | `resident memory`, `restart` | at a million transitions | the same of Reverb | 1.4 × the raw bytes; 5 s |
//! | `snapshot` | the longest pause of appends | | |
//!
//! Both sides take turns; ratios and shares are medians over them. `benches/replay_reverb.py` is the peer, and says how
//! it is treated fairly.

mod bare;
mod clients;
#[path = "../common/mod.rs"]
mod common;
#[path = "../../replay/tests/fixtures/mod.rs"]
mod fixtures;
#[path = "../../src/bench/load.rs"]
mod load;
mod reverb;
mod rows;
mod services;

use std::path::Path;
use std::time::Duration;

use anyhow::Result;
use common::report;
use reverb::Reverb;
use services::Service;
use tokio::runtime::Runtime;

const TURN: Duration = Duration::from_secs(4);
/// Transitions of a full store.
const FULL: usize = 1_000_000;
/// Minibatches that are fetched ahead.
const PREFETCH: usize = 16;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[1..] {
        ["serve", dir, sync] => return services::serve_store(Path::new(dir), sync == "data"),
        ["bare", batch] => return bare::serve_bare(batch.parse()?),
        _ => {}
    }
    let runtime = Runtime::new()?;
    let mut peer = Reverb::start()?;
    let mut rows = Vec::new();
    for writers in [1, 8] {
        rows.extend(rows::insert_rows(&runtime, &mut peer, writers)?);
    }
    let dir = tempfile::tempdir()?;
    services::fill(dir.path())?;
    let service = Service::start(&["serve", &dir.path().display().to_string(), "process"])?;
    rows.push(rows::memory_row(&runtime, &service, &mut peer)?);
    rows.push(rows::snapshot_row(&runtime, &service)?);
    for batch in [256, 1024] {
        rows.extend(rows::sample_rows(&runtime, &service, &mut peer, batch)?);
    }
    drop(service);
    rows.push(rows::restart_row(&runtime, dir.path(), &mut peer)?);
    drop(peer);
    rows.push(rows::in_process_row(dir.path())?);
    report("replay", &rows)
}
