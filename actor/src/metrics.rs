//! What an actor counts: `getup_actor_…`.

use getup_telemetry::Registry;
use getup_telemetry::prometheus::{
    Counter, CounterVec, Gauge, Histogram, IntCounter, IntGauge, register_counter_vec_with_registry,
    register_gauge_with_registry, register_histogram_with_registry, register_int_counter_with_registry,
    register_int_gauge_with_registry,
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
    /// Registers an actor's metrics.
    ///
    /// # Panics
    /// When `registry` has them already: a process has one actor.
    pub fn new(registry: &Registry) -> Self {
        Self::register(registry).expect("the names are well-formed, and a process has one actor")
    }

    fn register(registry: &Registry) -> getup_telemetry::prometheus::Result<Self> {
        let counter = |name: &str, help: &str| register_int_counter_with_registry!(name, help, registry);
        let gauge = |name: &str, help: &str| register_int_gauge_with_registry!(name, help, registry);
        let busy: CounterVec = register_counter_vec_with_registry!(
            "getup_actor_busy_seconds_total",
            "Time that lane threads spent, by kind of work; what is left of their time they waited.",
            &["work"],
            registry
        )?;
        Ok(Self {
            env_steps: counter("getup_actor_env_steps_total", "Control steps of get-up phases played.")?,
            limp_steps: counter("getup_actor_limp_steps_total", "Control steps of falls played.")?,
            episode_return: register_histogram_with_registry!(
                "getup_actor_episode_return",
                "Returns of finished episodes: sums of the rewards of their env steps.",
                vec![2.0, 5.0, 7.5, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0, 130.0, 160.0, 200.0],
                registry
            )?,
            diverged_episodes: counter(
                "getup_actor_diverged_episodes_total",
                "Episodes that were dropped because their simulation failed.",
            )?,
            evaluations: counter("getup_actor_evaluations_total", "Leased evaluations played to their end.")?,
            segments: counter("getup_actor_segments_total", "Segments queued for the replay.")?,
            segments_acknowledged: counter(
                "getup_actor_segments_acknowledged_total",
                "Segments that the replay has acknowledged as durable.",
            )?,
            unacknowledged_segments: gauge(
                "getup_actor_unacknowledged_segments",
                "Segments queued or sent that the replay has not acknowledged.",
            )?,
            policy_version: gauge("getup_actor_policy_version", "The newest policy's counter.")?,
            policy_age: register_gauge_with_registry!(
                "getup_actor_policy_age_seconds",
                "Time since the newest policy arrived; 0 before the first.",
                registry
            )?,
            forward_seconds: busy.with_label_values(&["forward"]),
            physics_seconds: busy.with_label_values(&["physics"]),
            evaluation_seconds: busy.with_label_values(&["evaluation"]),
        })
    }
}
