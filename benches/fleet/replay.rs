//! The process `replay`: store, log and service as they are.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use anyhow::Result;
use getup_replay::{ReplayConfig, ReplayMetrics, Store, serve_at};
use getup_telemetry::{Registry, Shutdown, Waits};
use serde_json::json;

use crate::fixtures::get_up_spec;
use crate::processes::{answer, listen, port, work_until};

pub(crate) fn run(dir: &Path) -> Result<()> {
    let registry = Registry::new();
    let config = ReplayConfig { min_size: 1, ..ReplayConfig::default() };
    let (metrics, waits) = (ReplayMetrics::new(&registry), Waits::new(&registry));
    let store = Arc::new(Store::open(dir, &get_up_spec(), &config, metrics, waits)?);
    let shutdown = Shutdown::new();
    let served = work_until(&shutdown, async {
        let listener = listen().await?;
        let serving = serve_at(port(getup_replay::limits()), listener, store, shutdown.clone());
        tokio::select! {
            served = serving => Ok(served?),
            answered = answer(|| json!({})) => answered,
        }
    });
    // Also where the process that made the folder was killed.
    let _ = fs::remove_dir_all(dir);
    served
}
