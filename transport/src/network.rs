//! The network beneath: TCP, unless somebody brings another, as a simulation of many machines in one process does.

use std::fmt;
use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use http::Uri;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};

/// Bytes in both directions.
pub trait Stream: AsyncRead + AsyncWrite + Send + Unpin + 'static {
    /// This end's address, where it has one.
    fn local_addr(&self) -> Option<SocketAddr>;

    /// Has small messages sent at once, and a peer that leaves what was sent unacknowledged for `send_timeout` cut off.
    ///
    /// # Errors
    /// When the operating system refuses.
    fn prepare(&self, send_timeout: Duration) -> io::Result<()>;
}

/// A port: where streams come in.
pub trait Listener: Send + 'static {
    /// What comes in.
    type Stream: Stream;

    /// The next stream, and where it comes from.
    fn accept(&self) -> impl Future<Output = io::Result<(Self::Stream, SocketAddr)>> + Send;
}

impl Stream for TcpStream {
    fn local_addr(&self) -> Option<SocketAddr> {
        self.local_addr().ok()
    }

    fn prepare(&self, send_timeout: Duration) -> io::Result<()> {
        self.set_nodelay(true)?;
        #[cfg(target_os = "linux")]
        socket2::SockRef::from(self).set_tcp_user_timeout(Some(send_timeout))?;
        Ok(())
    }
}

impl Listener for TcpListener {
    type Stream = TcpStream;

    fn accept(&self) -> impl Future<Output = io::Result<(TcpStream, SocketAddr)>> + Send {
        self.accept()
    }
}

/// A stream of a network that is not TCP.
pub type DynStream = Box<dyn Stream>;

impl Stream for DynStream {
    fn local_addr(&self) -> Option<SocketAddr> {
        (**self).local_addr()
    }

    fn prepare(&self, send_timeout: Duration) -> io::Result<()> {
        (**self).prepare(send_timeout)
    }
}

/// A connection that is coming about.
pub type Connecting = Pin<Box<dyn Future<Output = io::Result<DynStream>> + Send>>;

/// How a client reaches an address. The default is TCP.
#[derive(Clone, Default)]
pub struct Network {
    pub(crate) connect: Option<Arc<dyn Fn(Uri) -> Connecting + Send + Sync>>,
}

impl Network {
    /// A network on which `connect` makes the connections.
    pub fn new(connect: impl Fn(Uri) -> Connecting + Send + Sync + 'static) -> Self {
        Self { connect: Some(Arc::new(connect)) }
    }
}

impl fmt::Debug for Network {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(if self.connect.is_some() { "Network(…)" } else { "Network(TCP)" })
    }
}
