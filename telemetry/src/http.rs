//! `GET /metrics` over HTTP.

use std::io;
use std::time::Duration;

use axum::Router;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use prometheus::{Registry, TEXT_FORMAT, TextEncoder};
use tokio::net::TcpListener;

use crate::Shutdown;

/// How long a request that is under way at shutdown may take to end.
const GRACE: Duration = Duration::from_secs(1);

/// Serves `GET /metrics` in Prometheus' text format until shutdown; any other path is 404.
///
/// # Errors
/// When the listener fails for good.
pub async fn serve_http(listener: TcpListener, registry: Registry, shutdown: Shutdown) -> io::Result<()> {
    let router = Router::new().route("/metrics", get(metrics)).with_state(registry);
    let ended = shutdown.clone();
    let server = axum::serve(listener, router).with_graceful_shutdown(async move { ended.wait().await });
    tokio::select! {
        result = server => result,
        // A client that never finishes its request must not hold up the end.
        () = async { shutdown.wait().await; tokio::time::sleep(GRACE).await } => Ok(()),
    }
}

async fn metrics(State(registry): State<Registry>) -> Response {
    match TextEncoder::new().encode_to_string(&registry.gather()) {
        Ok(text) => ([(header::CONTENT_TYPE, TEXT_FORMAT)], text).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}
