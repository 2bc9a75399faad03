//! What `/metrics` says of a replay: [`ReplayMetrics`], all names `getup_replay_…`.

use crate::config::DEFAULT_TABLE;
use crate::disk::Disk;
use crate::log::State;
use getup_telemetry::prometheus::{
    Gauge, Histogram, HistogramOpts, IntCounter, IntCounterVec, IntGauge, Opts, Registry, core::Collector,
    exponential_buckets,
};

/// The metrics of one store and its service. Clones share them.
#[derive(Clone, Debug)]
pub struct ReplayMetrics {
    pub(crate) transitions: IntGauge,
    pub(crate) capacity: IntGauge,
    pub(crate) log_transitions: IntGauge,
    pub(crate) log_capacity: IntGauge,
    pub(crate) memory_bytes: IntGauge,
    pub(crate) disk: Disk,
    pub(crate) inserted_env_steps: IntCounter,
    pub(crate) inserted_transitions: IntCounter,
    pub(crate) episodes: IntCounter,
    pub(crate) sampled: IntCounter,
    pub(crate) cursor: Gauge,
    pub(crate) cursor_min: Gauge,
    pub(crate) cursor_max: Gauge,
    pub(crate) writers: IntGauge,
    pub(crate) append_seconds: Histogram,
    pub(crate) commit_segments: Histogram,
    pub(crate) sample_seconds: Histogram,
    rejected: IntCounterVec,
    registry: Registry,
}

impl ReplayMetrics {
    /// Registers the metrics of the default table.
    ///
    /// # Panics
    /// When the registry has them already.
    pub fn new(registry: &Registry) -> Self {
        Self::of_table(registry, DEFAULT_TABLE)
    }

    /// Registers the metrics of a table: they carry its name as the label `table`.
    ///
    /// # Panics
    /// When the registry has them already.
    pub fn of_table(registry: &Registry, table: &str) -> Self {
        let options = |name: &str, help: &str| {
            Opts::new(format!("getup_replay_{name}"), help).const_label("table", table)
        };
        let gauge = |name: &str, help: &str| {
            added(registry, IntGauge::with_opts(options(name, help)).expect(WELL_FORMED))
        };
        // Registered by `begin_at`.
        let counter = |name: &str, help: &str| IntCounter::with_opts(options(name, help)).expect(WELL_FORMED);
        let float = |name: &str, help: &str| {
            added(registry, Gauge::with_opts(options(name, help)).expect(WELL_FORMED))
        };
        let histogram = |name: &str, help: &str, start, factor, count| {
            let buckets = exponential_buckets(start, factor, count).expect(WELL_FORMED);
            let options = HistogramOpts { common_opts: options(name, help), buckets };
            added(registry, Histogram::with_opts(options).expect(WELL_FORMED))
        };
        let rejected = options("rejected_total", "Appends and samples refused, by reason.");
        let rejected = IntCounterVec::new(rejected, &["reason"]).expect(WELL_FORMED);
        for reason in REASONS {
            rejected.with_label_values(&[reason]);
        }
        Self {
            transitions: gauge("transitions", "Transitions that can be sampled now."),
            capacity: gauge("capacity_transitions", "Transitions that fit."),
            log_transitions: gauge("log_transitions", "Transitions in the log, on disk."),
            log_capacity: gauge(
                "log_capacity_transitions",
                "Transitions that the log keeps: those that fit, times the window of a remover that has one.",
            ),
            memory_bytes: gauge("memory_bytes", "Memory of a full ring."),
            disk: added(registry, Disk::new(table)),
            inserted_env_steps: counter("env_steps_total", "Env steps ever stored."),
            inserted_transitions: counter(
                "inserted_transitions_total",
                "Transitions ever stored, limp ones included.",
            ),
            episodes: counter("episodes_total", "Episodes whose end was stored."),
            sampled: counter("sampled_transitions_total", "Transitions handed out in minibatches."),
            cursor: float("limiter_cursor_samples", "Inserts x samples per insert - samples."),
            cursor_min: float("limiter_cursor_min_samples", "Below, sampling waits."),
            cursor_max: float("limiter_cursor_max_samples", "Above, inserting waits."),
            writers: gauge("writers", "Writers connected."),
            append_seconds: histogram(
                "append_seconds",
                "Time of a group commit until durable.",
                1e-4,
                2.0,
                18,
            ),
            commit_segments: histogram("commit_segments", "Segments of a group commit.", 1.0, 2.0, 10),
            sample_seconds: histogram(
                "sample_seconds",
                "Time to gather a minibatch, waits excluded.",
                1e-5,
                2.0,
                16,
            ),
            rejected: added(registry, rejected),
            registry: registry.clone(),
        }
    }

    /// Shows the counters over the store's life from here on, beginning at the totals of earlier processes. Shown before the
    /// store is read back they would begin at 0, and whoever scrapes them would take its whole life for a burst.
    pub(crate) fn begin_at(&self, state: &State, sampled: u64) {
        for (counter, total) in [
            (&self.inserted_env_steps, state.env_steps),
            (&self.inserted_transitions, state.transitions),
            (&self.episodes, state.episodes),
            (&self.sampled, sampled),
        ] {
            counter.inc_by(total);
            added(&self.registry, counter.clone());
        }
    }

    /// Counts a refusal.
    pub(crate) fn reject(&self, reason: &str) {
        self.rejected.with_label_values(&[reason]).inc();
    }
}

/// Why appends and samples are refused.
const REASONS: [&str; 11] = [
    "hello",
    "table",
    "spec",
    "options",
    "writer",
    "sequence",
    "inconsistent",
    "length",
    "dimensions",
    "checksum",
    "non_finite",
];
const WELL_FORMED: &str = "names, labels and buckets are well-formed";

fn added<C: Collector + Clone + 'static>(registry: &Registry, collector: C) -> C {
    registry
        .register(Box::new(collector.clone()))
        .expect("a process has one replay, and a table one set of metrics");
    collector
}
