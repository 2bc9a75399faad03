//! Logs, metrics, traces, health and shutdown: what every role serves besides its work.
//!
//! | module | what it gives |
//! | --- | --- |
//! | [`logging`] | [`init_logging`]: structured logs, pretty for people or JSON for machines |
//! | [`metrics`] | [`registry`], which every role's metrics register in, and [`build_info`] |
//! | [`traces`] | [`Traces`]: some segments, followed from actor to minibatch; told to an OpenTelemetry collector |
//! | [`http`] | [`serve_http`]: `/metrics` for Prometheus, `/healthz` for whoever starts containers |
//! | [`health`](mod@health) | [`health()`]: the gRPC health service |
//! | [`shutdown`] | [`Shutdown`]: the one thing that everything awaits to end |
//! | [`waits`] | [`Waits`]: every wait has a reason that logs, metrics and `getup status` show |
//! | [`backoff`] | [`Backoff`]: how long to pause before the next attempt |

pub mod backoff;
pub mod health;
pub mod http;
pub mod logging;
pub mod metrics;
pub mod shutdown;
pub mod traces;
pub mod waits;

pub use backoff::Backoff;
pub use health::health;
pub use http::{Ready, Shown, serve_http};
pub use logging::{LoggingError, init_logging};
pub use metrics::{build_info, registry};
pub use prometheus::{self, Registry};
pub use shutdown::Shutdown;
pub use traces::{Traces, TracesConfig, TracesError};
pub use waits::{Wait, WaitGuard, Waiting, Waits};
