//! The simulated network in the place of TCP.

use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use getup_transport::network::{DynStream, Stream};
use getup_transport::{Endpoint, Listener, Network};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use turmoil::net::{TcpListener, TcpStream};

use crate::machine::Machine;

/// Where services listen.
const PORT: u16 = 7400;

/// The service of a machine, as another reaches it.
pub(crate) fn endpoint(of: &str, from: &Arc<Machine>) -> Endpoint {
    let machine = from.clone();
    let network = Network::new(move |uri| {
        let machine = machine.clone();
        Box::pin(async move {
            let host = uri.host().unwrap_or_default().to_owned();
            let stream = TcpStream::connect((host.as_str(), uri.port_u16().unwrap_or(PORT))).await?;
            Ok(Box::new(Wire { stream, machine }) as DynStream)
        })
    });
    Endpoint { network, ..Endpoint::from(&format!("{of}:{PORT}")) }
}

/// The port of a machine.
pub(crate) struct Port {
    listener: TcpListener,
    machine: Arc<Machine>,
}

impl Port {
    pub(crate) async fn bind(machine: &Arc<Machine>) -> io::Result<Self> {
        let listener = TcpListener::bind((Ipv4Addr::UNSPECIFIED, PORT)).await?;
        Ok(Self { listener, machine: machine.clone() })
    }
}

impl Listener for Port {
    type Stream = Wire;

    async fn accept(&self) -> io::Result<(Wire, SocketAddr)> {
        let (stream, from) = self.listener.accept().await?;
        self.machine.visited();
        Ok((Wire { stream, machine: self.machine.clone() }, from))
    }
}

/// One end of a connection.
pub(crate) struct Wire {
    stream: TcpStream,
    machine: Arc<Machine>,
}

impl Stream for Wire {
    fn local_addr(&self) -> Option<SocketAddr> {
        self.stream.local_addr().ok()
    }

    fn prepare(&self, _: Duration) -> io::Result<()> {
        Ok(())
    }
}

impl AsyncRead for Wire {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for Wire {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        if self.machine.may_write() {
            Pin::new(&mut self.stream).poll_write(context, bytes)
        } else {
            Poll::Ready(Ok(bytes.len()))
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
