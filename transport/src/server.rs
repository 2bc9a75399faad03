//! The server's end: a port that knows whom it lets in, and how many.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use getup_telemetry::{Backoff, Shutdown};
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout_at};
use tokio_rustls::TlsAcceptor;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::either::Either;
use tonic::service::{InterceptorLayer, Routes};

use crate::connection::{Connection, Peer, Stream};
use crate::door::Door;
use crate::metrics::Reason;
use crate::network::{self, Listener};
use crate::seats::{Seat, Seats};
use crate::{Credentials, Metrics, Window};

/// A peer that is silent for this long is pinged, and gone after as long again.
const PING_EVERY: Duration = Duration::from_secs(10);
/// How long peers have to let go of their connections at a shutdown.
const GRACE: Duration = Duration::from_secs(3);

/// What a port lets its peers take.
#[derive(Clone, PartialEq, Debug)]
pub struct Limits {
    /// Connections in all.
    pub connections: usize,
    /// Connections from one address.
    pub connections_per_peer: usize,
    /// Calls that are under way at once on one connection.
    pub streams_per_connection: u32,
    /// How long a peer has from its connection to its first call that is let in, TLS included.
    pub handshake_timeout: Duration,
    /// How long a peer may leave what was sent to it unacknowledged or unread.
    pub send_timeout: Duration,
    /// How much a peer may send ahead of what is read.
    pub window: Window,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            connections: 1024,
            connections_per_peer: 256,
            streams_per_connection: 128,
            handshake_timeout: Duration::from_secs(10),
            send_timeout: Duration::from_secs(30),
            window: Window::Standard,
        }
    }
}

/// A port in the making.
#[derive(Clone, Debug)]
pub struct Server {
    credentials: Credentials,
    limits: Limits,
    metrics: Metrics,
}

impl Server {
    /// A port that wants what `credentials` say.
    pub fn new(credentials: Credentials, limits: Limits, metrics: Metrics) -> Self {
        Self { credentials, limits, metrics }
    }

    /// Serves `routes` to whoever connects and may, until `shutdown`; returns when all connections have ended, a few
    /// seconds after it at the latest.
    ///
    /// # Errors
    /// When tonic fails; a connection that fails ends alone.
    pub async fn serve(
        self,
        listener: impl Listener,
        routes: Routes,
        shutdown: Shutdown,
    ) -> Result<(), tonic::transport::Error> {
        let door = Door { tokens: self.credentials.tokens.clone(), metrics: self.metrics.clone() };
        let (stream, connection) = self.limits.window.bytes();
        let mut server = tonic::transport::Server::builder()
            .http2_keepalive_interval(Some(PING_EVERY))
            .http2_keepalive_timeout(Some(PING_EVERY))
            .http2_adaptive_window(Some(self.limits.window == Window::Adaptive))
            .initial_stream_window_size(stream)
            .initial_connection_window_size(connection)
            .max_concurrent_streams(self.limits.streams_per_connection)
            .layer(InterceptorLayer::new(door));
        let (accepted, incoming) = mpsc::channel(1);
        tokio::spawn(async move {
            // The port is closed as soon as tonic takes no more connections.
            tokio::select! {
                () = accepted.closed() => {}
                () = self.accept(listener, &accepted) => {}
            }
        });
        let incoming = ReceiverStream::new(incoming).map(Ok::<_, io::Error>);
        let serving = server.add_routes(routes).serve_with_incoming_shutdown(incoming, shutdown.wait());
        tokio::select! {
            served = serving => served,
            () = async { shutdown.wait().await; tokio::time::sleep(GRACE).await } => {
                tracing::warn!("ending with connections open: their peers did not let go");
                Ok(())
            }
        }
    }

    /// Takes connections while there are places for them; each shakes hands by itself, so that none waits for another.
    async fn accept<L: Listener>(self, listener: L, accepted: &mpsc::Sender<Connection<L::Stream>>) {
        let Limits { connections, connections_per_peer, .. } = self.limits;
        let seats = Seats::new(connections, connections_per_peer, self.metrics.connections.clone());
        let server = Arc::new(self);
        let mut backoff = Backoff::new();
        loop {
            let (stream, peer) = match listener.accept().await {
                Ok(connection) => connection,
                Err(error) => {
                    let pause = backoff.next();
                    tracing::warn!("cannot accept a connection ({error}): trying again in {pause:.1?}");
                    tokio::time::sleep(pause).await;
                    continue;
                }
            };
            backoff.reset();
            match seats.take(peer.ip()) {
                Ok(seat) => {
                    let (server, accepted) = (Arc::clone(&server), accepted.clone());
                    tokio::spawn(async move {
                        if let Some(connection) = server.welcome(stream, peer, seat).await {
                            // Nobody takes it after a shutdown.
                            let _ = accepted.send(connection).await;
                        }
                    });
                }
                Err(reason) => {
                    let (whose, most) = match reason {
                        Reason::PeerConnections => ("its address", connections_per_peer),
                        _ => ("the port", connections),
                    };
                    let why = format_args!("{whose} has {most} connections, as many as it may");
                    server.metrics.refuse(reason, Some(peer), why);
                }
            }
        }
    }

    /// The connection, once hands are shaken.
    async fn welcome<S: network::Stream>(
        &self,
        stream: S,
        remote: SocketAddr,
        seat: Seat,
    ) -> Option<Connection<S>> {
        let deadline = Instant::now() + self.limits.handshake_timeout;
        let peer = Peer::new(stream.local_addr(), remote);
        let shaken = timeout_at(deadline, self.shake_hands(stream)).await;
        let stream = match shaken.unwrap_or_else(|late| Err(late.into())) {
            Ok(stream) => stream,
            Err(error) => {
                self.metrics.refuse(Reason::Handshake, Some(remote), error);
                return None;
            }
        };
        Some(Connection::new(stream, peer, deadline, self.metrics.clone(), seat))
    }

    async fn shake_hands<S: network::Stream>(&self, stream: S) -> io::Result<Stream<S>> {
        stream.prepare(self.limits.send_timeout)?;
        let Some(tls) = &self.credentials.tls else { return Ok(Either::Left(stream)) };
        let acceptor = TlsAcceptor::from(Arc::clone(&tls.current().server));
        let accepted = acceptor.accept(stream).await;
        let stream = accepted.map_err(|error| {
            io::Error::other(format!("no TLS ({error}): both ends want certificates of one authority"))
        })?;
        Ok(Either::Right(stream))
    }
}
