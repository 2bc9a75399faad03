//! The gRPC health service (`grpc.health.v1.Health`), which containers and load balancers probe.

use tonic_health::ServingStatus;
use tonic_health::pb::health_server::{Health, HealthServer};

use crate::Shutdown;

/// The health service to add to a role's gRPC server: serving from the start, and not serving from `shutdown` on, while the
/// role drains.
pub fn health(shutdown: Shutdown) -> HealthServer<impl Health> {
    let (reporter, service) = tonic_health::server::health_reporter();
    tokio::spawn(async move {
        shutdown.wait().await;
        reporter.set_service_status("", ServingStatus::NotServing).await;
    });
    service
}
