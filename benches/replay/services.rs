//! Our services, as processes of this program.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;

use anyhow::{Context, Result};
use getup_proto::Segment;
use getup_replay::{ReplayConfig, ReplayMetrics, Store, SyncMode, serve};
use getup_telemetry::{Registry, Shutdown, Waits};
use tokio::net::TcpListener;
use tokio::runtime::Runtime;

use crate::FULL;
use crate::fixtures::get_up_spec;
use crate::load::episode;

fn config(sync: SyncMode) -> ReplayConfig {
    ReplayConfig { capacity: FULL, min_size: 1, sync, ..ReplayConfig::default() }
}

pub(crate) fn open(dir: &Path, sync: SyncMode) -> Result<Store> {
    let registry = Registry::new();
    let (metrics, waits) = (ReplayMetrics::new(&registry), Waits::new(&registry));
    Ok(Store::open(dir, &get_up_spec(), &config(sync), metrics, waits)?)
}

/// A store of a million transitions.
pub(crate) fn fill(dir: &Path) -> Result<()> {
    let store = open(dir, SyncMode::Process)?;
    let mut segments: Vec<Segment> = (0..16).flat_map(|number| episode(&get_up_spec(), number)).collect();
    let mut sequence = 0;
    while store.counters().transitions < FULL as u64 + 1000 {
        for segment in &mut segments {
            sequence += 1;
            segment.sequence = sequence;
        }
        store.append(segments.clone())?;
    }
    Ok(())
}

pub(crate) fn serve_store(dir: &Path, synced: bool) -> Result<()> {
    let store = open(dir, if synced { SyncMode::Data } else { SyncMode::Process })?;
    Runtime::new()?.block_on(async {
        let listener = listen().await?;
        Ok(serve(listener, Arc::new(store), Shutdown::new()).await?)
    })
}

pub(crate) async fn listen() -> Result<TcpListener> {
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    println!("listening on {}", listener.local_addr()?);
    std::io::stdout().flush()?;
    Ok(listener)
}

/// A process of this program that serves.
pub(crate) struct Service {
    pub(crate) child: Child,
    pub(crate) endpoint: String,
}

impl Service {
    pub(crate) fn start(arguments: &[&str]) -> Result<Self> {
        let mut child =
            Command::new(std::env::current_exe()?).args(arguments).stdout(Stdio::piped()).spawn()?;
        let mut line = String::new();
        BufReader::new(child.stdout.take().context("it is piped")?).read_line(&mut line)?;
        let endpoint =
            line.trim().strip_prefix("listening on ").context("a service says where it listens")?;
        Ok(Self { endpoint: endpoint.to_owned(), child })
    }

    /// Resident bytes.
    pub(crate) fn resident(&self) -> Result<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id()))?;
        let line =
            status.lines().find_map(|line| line.strip_prefix("VmRSS:")).context("a process has a size")?;
        Ok(1024 * line.trim().trim_end_matches(" kB").parse::<u64>()?)
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
