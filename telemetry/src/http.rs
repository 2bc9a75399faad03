//! A role's HTTP port: `GET /metrics` for Prometheus, `/healthz` for whoever starts and stops containers.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::serve::Listener;
use prometheus::{Registry, TEXT_FORMAT, TextEncoder};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, Sleep};

use crate::Shutdown;

/// How long a request that is under way at shutdown may take to end.
const GRACE: Duration = Duration::from_secs(1);

/// Connections at once; further ones wait. Prometheus keeps one, a health check needs one for a moment.
const MOST_CONNECTIONS: usize = 256;
/// A connection on which nothing comes or goes for this long is closed.
const SILENCE: Duration = Duration::from_secs(75);

/// Whether a role does its work: it does not while it reads back its store. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct Ready(Arc<AtomicBool>);

impl Ready {
    /// From now on it does.
    pub fn set(&self) {
        self.0.store(true, Ordering::Release);
    }
}

/// Says by a request's headers whether it may read `/metrics`.
pub type Guard = Arc<dyn Fn(&HeaderMap) -> bool + Send + Sync>;

/// What the port shows.
#[derive(Clone)]
pub struct Shown {
    /// At `/metrics`.
    pub registry: Registry,
    /// At `/healthz`: 200 once the role does its work, 503 before and during its end.
    pub ready: Ready,
    /// Who may read `/metrics`.
    pub guard: Guard,
}

/// Serves `GET /metrics` in Prometheus' text format, `/healthz` (the role does its work) and `/livez` (the process answers)
/// until shutdown; any other path is 404.
///
/// # Errors
/// When the listener fails for good.
pub async fn serve_http(listener: TcpListener, shown: Shown, shutdown: Shutdown) -> io::Result<()> {
    let ended = shutdown.clone();
    let router = Router::new()
        .route("/metrics", get(metrics))
        .route("/healthz", get(health))
        .route("/livez", get(|| async { "ok\n" }))
        .with_state((shown, shutdown.clone()));
    let server =
        axum::serve(Port::new(listener), router).with_graceful_shutdown(async move { ended.wait().await });
    tokio::select! {
        result = server => result,
        // A client that never finishes its request must not hold up the end.
        () = async { shutdown.wait().await; tokio::time::sleep(GRACE).await } => Ok(()),
    }
}

/// The listener, with so many places for connections: whoever fills them must not take the files that a role needs. One
/// that is silent, or vanished without a word, gives its place back.
struct Port {
    listener: TcpListener,
    places: Arc<Semaphore>,
}

/// A connection in its place.
struct Placed {
    stream: TcpStream,
    /// When it has been silent for too long.
    end: Pin<Box<Sleep>>,
    _place: OwnedSemaphorePermit,
}

impl Port {
    fn new(listener: TcpListener) -> Self {
        Self { listener, places: Arc::new(Semaphore::new(MOST_CONNECTIONS)) }
    }
}

impl Listener for Port {
    type Io = Placed;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Placed, SocketAddr) {
        let place = self.places.clone().acquire_owned().await.expect("the places are never closed");
        // Waits and tries again where the system gives no connection.
        let (stream, peer) = Listener::accept(&mut self.listener).await;
        (Placed { stream, end: Box::pin(tokio::time::sleep(SILENCE)), _place: place }, peer)
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }
}

impl Placed {
    /// What a read or write has come to, or that it has been waited for too long.
    fn watched<T>(&mut self, done: Poll<io::Result<T>>, context: &mut Context<'_>) -> Poll<io::Result<T>> {
        if done.is_ready() {
            self.end.as_mut().reset(Instant::now() + SILENCE);
            return done;
        }
        self.end.as_mut().poll(context).map(|()| Err(io::ErrorKind::TimedOut.into()))
    }
}

impl AsyncRead for Placed {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let read = Pin::new(&mut self.stream).poll_read(context, buffer);
        self.watched(read, context)
    }
}

impl AsyncWrite for Placed {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.watched(written, context)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

async fn metrics(State((shown, _)): State<(Shown, Shutdown)>, headers: HeaderMap) -> Response {
    if !(shown.guard)(&headers) {
        let how = "a token is needed: send `authorization: Bearer TOKEN` with the one in security.metrics_token_file\n";
        return (StatusCode::UNAUTHORIZED, how).into_response();
    }
    // Some of them are asked of the disk, which may take long: not on a thread that others need.
    let text = tokio::task::spawn_blocking(move || {
        TextEncoder::new().encode_to_string(&shown.registry.gather()).map_err(|error| error.to_string())
    });
    match text.await.map_err(|error| error.to_string()).flatten() {
        Ok(text) => ([(header::CONTENT_TYPE, TEXT_FORMAT)], text).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error).into_response(),
    }
}

async fn health(State((shown, shutdown)): State<(Shown, Shutdown)>) -> Response {
    if shutdown.is_triggered() {
        (StatusCode::SERVICE_UNAVAILABLE, "ending\n").into_response()
    } else if shown.ready.0.load(Ordering::Acquire) {
        "ok\n".into_response()
    } else {
        (StatusCode::SERVICE_UNAVAILABLE, "starting\n").into_response()
    }
}
