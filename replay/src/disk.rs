//! What a store takes of its disk, and what is left: [`Disk`], asked whenever `/metrics` is read.

use crate::log::disk_bytes;
use getup_telemetry::prometheus::core::{Collector, Desc};
use getup_telemetry::prometheus::proto::MetricFamily;
use getup_telemetry::prometheus::{IntGauge, Opts};
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

/// The disk of a table's store. Clones share it.
#[derive(Clone, Debug)]
pub(crate) struct Disk {
    /// The store's folder, once it is open.
    dir: Arc<OnceLock<PathBuf>>,
    used: IntGauge,
    free: IntGauge,
    total: IntGauge,
}

impl Disk {
    pub(crate) fn new(table: &str) -> Self {
        let gauge = |name: &str, help: &str| {
            let options = Opts::new(format!("getup_replay_{name}"), help).const_label("table", table);
            IntGauge::with_opts(options).expect("names and labels are well-formed")
        };
        Self {
            dir: Arc::default(),
            used: gauge("disk_bytes", "Disk space of the log."),
            free: gauge("disk_free_bytes", "What is left of the disk that the log lies on."),
            total: gauge("disk_total_bytes", "Size of the disk that the log lies on."),
        }
    }

    /// Looks at the disk of the store in `dir` from now on.
    pub(crate) fn watch(&self, dir: &Path) {
        // A table's store is opened once.
        let _ = self.dir.set(dir.to_owned());
    }

    fn gauges(&self) -> [&IntGauge; 3] {
        [&self.used, &self.free, &self.total]
    }
}

impl Collector for Disk {
    fn desc(&self) -> Vec<&Desc> {
        self.gauges().into_iter().flat_map(Collector::desc).collect()
    }

    fn collect(&self) -> Vec<MetricFamily> {
        if let Some(dir) = self.dir.get() {
            self.used.set(disk_bytes(dir) as i64);
            if let Some((free, total)) = space(dir) {
                self.free.set(free as i64);
                self.total.set(total as i64);
            }
        }
        self.gauges().into_iter().flat_map(Collector::collect).collect()
    }
}

/// Bytes that are free to this process, and all, of the disk that `dir` lies on.
fn space(dir: &Path) -> Option<(u64, u64)> {
    let facts = rustix::fs::statvfs(dir).ok()?;
    Some((facts.f_bavail * facts.f_frsize, facts.f_blocks * facts.f_frsize))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_has_free_space_and_more_in_all() {
        let (free, total) = space(Path::new("/")).unwrap();
        assert!(free <= total && total > 0, "{free} of {total}");
        assert_eq!(space(Path::new("/no/such/folder")), None);
    }
}
