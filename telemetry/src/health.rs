//! The gRPC health service (`grpc.health.v1.Health`), which containers and load balancers probe.

pub use tonic_health::ServingStatus;
pub use tonic_health::pb::health_server::{Health, HealthServer};
pub use tonic_health::server::HealthReporter;

/// The health service to add to a role's gRPC server, and the handle that sets what it says.
///
/// The overall status, of the empty service name, is serving from the start; a role that drains sets it with
/// `reporter.set_service_status("", ServingStatus::NotServing)`.
pub fn health() -> (HealthReporter, HealthServer<impl Health>) {
    tonic_health::server::health_reporter()
}
