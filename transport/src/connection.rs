//! A connection that a port has accepted: its bytes, its place, and whether its peer has shown who it is.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep};
use tokio_rustls::server::TlsStream;
use tokio_util::either::Either;
use tonic::transport::server::{Connected, TcpConnectInfo};

use crate::metrics::{Metrics, Reason};
use crate::network;
use crate::seats::Seat;

/// The bytes, with TLS or without.
pub(crate) type Stream<S> = Either<S, TlsStream<S>>;

/// The connection as tonic serves it.
pub(crate) struct Connection<S> {
    stream: Stream<S>,
    peer: Peer,
    /// Until when the peer must have made a call that was let in; then gone.
    deadline: Option<Pin<Box<Sleep>>>,
    metrics: Metrics,
    _seat: Seat,
}

/// What calls know of their connection.
#[derive(Clone)]
pub(crate) struct Peer {
    /// The addresses of both ends.
    pub(crate) tcp: TcpConnectInfo,
    /// Whether a call was let in.
    admitted: Arc<AtomicBool>,
}

impl Peer {
    pub(crate) fn new(local: Option<SocketAddr>, remote: SocketAddr) -> Self {
        let tcp = TcpConnectInfo { local_addr: local, remote_addr: Some(remote) };
        Self { tcp, admitted: Arc::default() }
    }

    /// Notes that a call was let in: the connection may stay.
    pub(crate) fn admit(&self) {
        self.admitted.store(true, Ordering::Relaxed);
    }
}

impl<S> Connection<S> {
    pub(crate) fn new(
        stream: Stream<S>,
        peer: Peer,
        deadline: Instant,
        metrics: Metrics,
        seat: Seat,
    ) -> Self {
        let deadline = Some(Box::pin(tokio::time::sleep_until(deadline)));
        Self { stream, peer, deadline, metrics, _seat: seat }
    }

    /// Fails once the deadline has passed and no call was let in. Reads and writes both ask: while something cannot be
    /// written, nothing is read.
    fn check_deadline(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        let Some(deadline) = &mut self.deadline else { return Ok(()) };
        if deadline.as_mut().poll(context).is_pending() {
            return Ok(());
        }
        self.deadline = None;
        if self.peer.admitted.load(Ordering::Relaxed) {
            return Ok(());
        }
        self.metrics.refuse(Reason::Handshake, self.peer.tcp.remote_addr, "it made no call that may be made");
        Err(io::ErrorKind::TimedOut.into())
    }
}

impl<S: network::Stream> Connected for Connection<S> {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        self.peer.clone()
    }
}

impl<S: network::Stream> AsyncRead for Connection<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check_deadline(context)?;
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl<S: network::Stream> AsyncWrite for Connection<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.check_deadline(context)?;
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check_deadline(context)?;
        Pin::new(&mut self.stream).poll_write_vectored(context, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check_deadline(context)?;
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
