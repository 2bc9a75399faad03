//! What `/metrics` says of a learner's actors and leases: [`HubMetrics`], asked whenever it is read.

use std::sync::{Mutex, PoisonError, Weak};
use std::time::Instant;

use getup_telemetry::prometheus::core::{Collector, Desc};
use getup_telemetry::prometheus::proto::MetricFamily;
use getup_telemetry::prometheus::{GaugeVec, IntCounter, IntGauge, IntGaugeVec, Opts};

use crate::hub::{ACTOR_LOST, Hub};

/// Every actor that a hub knows, as gauges with the label `actor`.
pub struct HubMetrics {
    hub: Weak<Hub>,
    actors: IntGauge,
    silent: GaugeVec,
    behind: IntGaugeVec,
    lag: GaugeVec,
    leases: IntGaugeVec,
    expirations: IntCounter,
    superseded: IntCounter,
    /// Held by whoever reads them.
    collecting: Mutex<()>,
}

impl HubMetrics {
    /// Of this hub, for as long as it is there.
    pub fn new(hub: Weak<Hub>) -> Self {
        const WELL_FORMED: &str = "names and labels are well-formed";
        let options = |name: &str, help: &str| Opts::new(format!("getup_learner_{name}"), help);
        let by_actor =
            |name: &str, help: &str| GaugeVec::new(options(name, help), &["actor"]).expect(WELL_FORMED);
        let behind = options("actor_versions_behind", "Policies published since the one the actor acts by.");
        let leases = options("leases", "Evaluations not reported yet, by state: offered, leased.");
        let expirations = options("lease_expirations_total", "Leases lost because their holder was silent.");
        let superseded = options(
            "evaluations_superseded_total",
            "Evaluations that no actor had begun when the next was due.",
        );
        let actors = options("actors", "Actors heard from within a minute.");
        Self {
            hub,
            actors: IntGauge::with_opts(actors).expect(WELL_FORMED),
            silent: by_actor(
                "actor_silent_seconds",
                "Time since the actor's last heartbeat; gone once it ended in order, or after ten minutes.",
            ),
            behind: IntGaugeVec::new(behind, &["actor"]).expect(WELL_FORMED),
            lag: by_actor(
                "broadcast_lag_seconds",
                "How long the actor has been without the policy that followed its own; 0 where it has the newest.",
            ),
            leases: IntGaugeVec::new(leases, &["state"]).expect(WELL_FORMED),
            expirations: IntCounter::with_opts(expirations).expect(WELL_FORMED),
            superseded: IntCounter::with_opts(superseded).expect(WELL_FORMED),
            collecting: Mutex::default(),
        }
    }

    fn collectors(&self) -> [&dyn Collector; 7] {
        [
            &self.actors,
            &self.silent,
            &self.behind,
            &self.lag,
            &self.leases,
            &self.expirations,
            &self.superseded,
        ]
    }
}

impl Collector for HubMetrics {
    fn desc(&self) -> Vec<&Desc> {
        self.collectors().into_iter().flat_map(Collector::desc).collect()
    }

    fn collect(&self) -> Vec<MetricFamily> {
        let Some(hub) = self.hub.upgrade() else { return Vec::new() };
        // Two who read at once would see each other's half, and count what is counted twice.
        let _alone = self.collecting.lock().unwrap_or_else(PoisonError::into_inner);
        let actors = hub.actors(Instant::now());
        self.actors.set(actors.iter().filter(|actor| actor.silent < ACTOR_LOST).count() as i64);
        self.silent.reset();
        self.behind.reset();
        self.lag.reset();
        for actor in &actors {
            let name = [actor.name.as_str()];
            self.silent.with_label_values(&name).set(actor.silent.as_secs_f64());
            self.behind.with_label_values(&name).set(actor.versions_behind as i64);
            self.lag.with_label_values(&name).set(actor.lag.as_secs_f64());
        }
        let counts = hub.lease_counts();
        self.leases.with_label_values(&["offered"]).set(counts.offered as i64);
        self.leases.with_label_values(&["leased"]).set(counts.leased as i64);
        for (counter, count) in
            [(&self.expirations, counts.expirations), (&self.superseded, counts.superseded)]
        {
            counter.inc_by(count.saturating_sub(counter.get()));
        }
        self.collectors().into_iter().flat_map(Collector::collect).collect()
    }
}
