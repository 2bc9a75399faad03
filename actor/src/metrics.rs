//! What an actor counts: `getup_actor_…`, with the actor's name as the label `actor`.

use getup_telemetry::Registry;
use getup_telemetry::prometheus::core::Collector;
use getup_telemetry::prometheus::{
    Counter, CounterVec, Gauge, Histogram, HistogramOpts, IntCounter, IntGauge, Opts, exponential_buckets,
};

/// The metrics of one actor; clones share them.
#[derive(Clone, Debug)]
pub struct ActorMetrics {
    /// `getup_actor_env_steps_total`
    pub env_steps: IntCounter,
    /// `getup_actor_limp_steps_total`
    pub limp_steps: IntCounter,
    /// `getup_actor_episode_return`: its count is the number of finished episodes.
    pub episode_return: Histogram,
    /// `getup_actor_diverged_episodes_total`
    pub diverged_episodes: IntCounter,
    /// `getup_actor_evaluations_total`
    pub evaluations: IntCounter,
    /// `getup_actor_segments_total`
    pub segments: IntCounter,
    /// `getup_actor_segments_acknowledged_total`
    pub segments_acknowledged: IntCounter,
    /// `getup_actor_unacknowledged_segments`
    pub unacknowledged_segments: IntGauge,
    /// `getup_actor_append_seconds`
    pub append_seconds: Histogram,
    /// `getup_actor_policy_version`
    pub policy_version: IntGauge,
    /// `getup_actor_policy_age_seconds`
    pub policy_age: Gauge,
    /// `getup_actor_busy_seconds_total{work="forward"}`
    pub forward_seconds: Counter,
    /// `getup_actor_busy_seconds_total{work="physics"}`
    pub physics_seconds: Counter,
    /// `getup_actor_busy_seconds_total{work="evaluation"}`
    pub evaluation_seconds: Counter,
}

impl ActorMetrics {
    /// Registers the metrics of the actor of this name.
    ///
    /// # Panics
    /// When `registry` has them already: a process has one actor.
    pub fn new(registry: &Registry, actor: &str) -> Self {
        const WELL_FORMED: &str = "names, labels and buckets are well-formed";
        let options = |name: &str, help: &str| {
            Opts::new(format!("getup_actor_{name}"), help).const_label("actor", actor)
        };
        let counter = |name: &str, help: &str| {
            added(registry, IntCounter::with_opts(options(name, help)).expect(WELL_FORMED))
        };
        let whole = |name: &str, help: &str| {
            added(registry, IntGauge::with_opts(options(name, help)).expect(WELL_FORMED))
        };
        let gauge = |name: &str, help: &str| {
            added(registry, Gauge::with_opts(options(name, help)).expect(WELL_FORMED))
        };
        let histogram = |name: &str, help: &str, buckets: Vec<f64>| {
            let options = HistogramOpts { common_opts: options(name, help), buckets };
            added(registry, Histogram::with_opts(options).expect(WELL_FORMED))
        };
        let busy = options(
            "busy_seconds_total",
            "Time that lane threads spent, by kind of work; what is left of their time they waited.",
        );
        let busy = added(registry, CounterVec::new(busy, &["work"]).expect(WELL_FORMED));
        Self {
            env_steps: counter("env_steps_total", "Control steps of get-up phases played."),
            limp_steps: counter("limp_steps_total", "Control steps of falls played."),
            episode_return: histogram(
                "episode_return",
                "Returns of finished episodes: sums of the rewards of their env steps.",
                vec![2.0, 5.0, 7.5, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0, 130.0, 160.0, 200.0],
            ),
            diverged_episodes: counter(
                "diverged_episodes_total",
                "Episodes that were dropped because their simulation failed.",
            ),
            evaluations: counter("evaluations_total", "Leased evaluations played to their end."),
            segments: counter("segments_total", "Segments queued for the replay."),
            segments_acknowledged: counter(
                "segments_acknowledged_total",
                "Segments that the replay has acknowledged as durable.",
            ),
            unacknowledged_segments: whole(
                "unacknowledged_segments",
                "Segments queued or sent that the replay has not acknowledged.",
            ),
            append_seconds: histogram(
                "append_seconds",
                "Time from sending segments to their acknowledgement, waits for the limiter and reconnections included.",
                exponential_buckets(1e-4, 2.0, 20).expect(WELL_FORMED),
            ),
            policy_version: whole("policy_version", "The newest policy's counter."),
            policy_age: gauge(
                "policy_age_seconds",
                "Time since the newest policy arrived; 0 before the first.",
            ),
            forward_seconds: busy.with_label_values(&["forward"]),
            physics_seconds: busy.with_label_values(&["physics"]),
            evaluation_seconds: busy.with_label_values(&["evaluation"]),
        }
    }
}

fn added<C: Collector + Clone + 'static>(registry: &Registry, collector: C) -> C {
    registry.register(Box::new(collector.clone())).expect("a process has one actor");
    collector
}
