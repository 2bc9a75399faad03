//! The client's end: how a role reaches a service of another.

use std::error::Error;
use std::fmt;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use http::Uri;
use hyper_util::client::legacy::connect::HttpConnector;
use hyper_util::rt::TokioIo;
use rustls::pki_types::ServerName;
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_util::either::Either;
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Endpoint;
use tonic::{Code, Request, Status};
use tower::ServiceExt;

use crate::network::{DynStream, Network};
use crate::reload::Reloaded;
use crate::tls::Tls;
use crate::token::Tokens;
use crate::{AddressError, Credentials};

/// A connection that comes about when it is first used, and again whenever it has to; clones share it.
pub type Channel = InterceptedService<tonic::transport::Channel, Bearer>;

/// How a channel keeps its connection. Each of its times is up to a fifth longer or shorter, at random: of many clients
/// that lose their service in the same moment not all notice it, give up, and come back together.
#[derive(Clone, PartialEq, Debug)]
pub struct ChannelOptions {
    /// How long a connection may take to come about: name, TCP and TLS together.
    pub connect_timeout: Duration,
    /// A peer that is silent for this long is pinged.
    pub keep_alive_interval: Duration,
    /// A peer that does not answer a ping for this long is gone.
    pub keep_alive_timeout: Duration,
    /// Whether the peer is pinged while no call is under way, too.
    pub keep_alive_while_idle: bool,
    /// How much the peer may send ahead of what is read.
    pub window: Window,
}

impl Default for ChannelOptions {
    fn default() -> Self {
        Self {
            connect_timeout: Duration::from_secs(5),
            keep_alive_interval: Duration::from_secs(5),
            keep_alive_timeout: Duration::from_secs(5),
            keep_alive_while_idle: true,
            window: Window::Adaptive,
        }
    }
}

/// HTTP/2's flow control: the bytes that may be on their way to an end that is not reading.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Window {
    /// As many as hyper gives by itself: 1 MiB a stream at a server, 2 MiB at a client.
    #[default]
    Standard,
    /// As many as the connection turns out to carry.
    Adaptive,
    /// As many as are given here.
    Fixed {
        /// Bytes of one stream.
        stream: u32,
        /// Bytes of all streams of a connection together.
        connection: u32,
    },
}

impl Window {
    /// The windows of a stream and of a connection, if they are fixed.
    pub(crate) fn bytes(self) -> (Option<u32>, Option<u32>) {
        match self {
            Self::Fixed { stream, connection } => (Some(stream), Some(connection)),
            Self::Standard | Self::Adaptive => (None, None),
        }
    }
}

impl Credentials {
    /// A channel to the service at `host:port`; a scheme before it may be there and changes nothing, as certificates
    /// alone decide whether there is TLS. The name is looked up at every connection.
    ///
    /// # Errors
    /// [`AddressError`], for what is no such address, or `https://…` without certificates.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn channel(&self, address: &str, options: ChannelOptions) -> Result<Channel, AddressError> {
        self.channel_through(&Network::default(), address, options)
    }

    /// As [`Credentials::channel`], through another network than TCP.
    pub(crate) fn channel_through(
        &self,
        network: &Network,
        address: &str,
        options: ChannelOptions,
    ) -> Result<Channel, AddressError> {
        let refused = |reason: &str| AddressError { address: address.to_owned(), reason: reason.to_owned() };
        let (scheme, authority) = address.split_once("://").unwrap_or(("http", address));
        match scheme {
            "http" => {}
            "https" if self.tls.is_some() => {}
            "https" => return Err(refused("TLS wants security.ca, security.certificate and security.key")),
            _ => return Err(refused("its scheme is neither http nor https")),
        }
        if authority.contains(['@', '#']) {
            return Err(refused("it is a host and a port, and nothing else"));
        }
        let scheme = if self.tls.is_some() { "https" } else { "http" };
        let uri: Uri = format!("{scheme}://{}", authority.strip_suffix('/').unwrap_or(authority))
            .parse()
            .map_err(|error: http::uri::InvalidUri| refused(&error.to_string()))?;
        let (Some(host), Some(_)) = (uri.host(), uri.port_u16()) else {
            return Err(refused("it needs a host and a port"));
        };
        if uri.path() != "/" || uri.query().is_some() {
            return Err(refused("nothing follows the port"));
        }
        let host = ServerName::try_from(host.trim_matches(['[', ']']).to_owned())
            .map_err(|_| refused("its host is neither a name nor an IP address"))?;
        let mut http = HttpConnector::new();
        http.enforce_http(false);
        http.set_nodelay(true);
        // Shared by the addresses of a name, within the patience for all of it: a dead one leaves time for the next.
        http.set_connect_timeout(Some(options.connect_timeout.mul_f64(0.7)));
        let (network, tls) = (network.clone(), self.tls.clone());
        let connector = Connector { http, network, tls, host, patience: options.connect_timeout };
        let channel = endpoint(uri, &options)
            .connect_with_connector_lazy(tower::service_fn(move |uri| connector.clone().connect(uri)));
        Ok(InterceptedService::new(channel, Bearer { tokens: self.tokens.clone() }))
    }
}

fn endpoint(uri: Uri, options: &ChannelOptions) -> Endpoint {
    let (stream, connection) = options.window.bytes();
    Endpoint::from(uri)
        .http2_keep_alive_interval(spread(options.keep_alive_interval))
        .keep_alive_timeout(spread(options.keep_alive_timeout))
        .keep_alive_while_idle(options.keep_alive_while_idle)
        .http2_adaptive_window(options.window == Window::Adaptive)
        .initial_stream_window_size(stream)
        .initial_connection_window_size(connection)
}

/// Up to a fifth more or less.
fn spread(time: Duration) -> Duration {
    time.mul_f64(rand::random_range(0.8..=1.2))
}

/// Adds the token to each call, where there is one.
#[derive(Clone)]
pub struct Bearer {
    tokens: Option<Arc<Reloaded<Tokens>>>,
}

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(tokens) = &self.tokens {
            request.metadata_mut().insert("authorization", tokens.current().header());
        }
        Ok(request)
    }
}

impl fmt::Debug for Bearer {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(if self.tokens.is_some() { "Bearer(…)" } else { "Bearer(none)" })
    }
}

/// Makes connections, each with the certificates of its moment.
#[derive(Clone)]
struct Connector {
    http: HttpConnector,
    network: Network,
    tls: Option<Arc<Reloaded<Tls>>>,
    /// Whom the peer's certificate has to name.
    host: ServerName<'static>,
    patience: Duration,
}

/// Of TCP, but in a simulation.
type Plain = Either<TcpStream, DynStream>;
type Connection = TokioIo<Either<Plain, TlsStream<Plain>>>;

impl Connector {
    async fn connect(self, uri: Uri) -> Result<Connection, Box<dyn Error + Send + Sync>> {
        let place = uri.authority().map(ToString::to_string).unwrap_or_default();
        let patience = self.patience;
        tokio::time::timeout(spread(patience), self.connect_to(uri, &place))
            .await
            .unwrap_or_else(|_| Err(format!("{place} does not answer within {patience:?}")))
            .map_err(Into::into)
    }

    async fn connect_to(self, uri: Uri, place: &str) -> Result<Connection, String> {
        let refused = |error: &dyn Error| format!("cannot connect to {place}: {}", root_cause(error));
        let plain = match &self.network.connect {
            None => Plain::Left(self.http.oneshot(uri).await.map_err(|error| refused(&error))?.into_inner()),
            Some(connect) => Plain::Right(connect(uri).await.map_err(|error| refused(&error))?),
        };
        let Some(tls) = self.tls else { return Ok(TokioIo::new(Either::Left(plain))) };
        let connector = TlsConnector::from(Arc::clone(&tls.current().client));
        let stream = connector.connect(self.host, plain).await.map_err(|error| {
            format!("no TLS with {place}: {error}; are the certificates of both ends from one authority?")
        })?;
        Ok(TokioIo::new(Either::Right(stream)))
    }
}

/// What a call's status says. Where the connection broke, tonic says so and keeps the reason to itself: this says the
/// reason, such as a certificate that the peer refused.
pub fn reason(status: &Status) -> String {
    let said = status.message();
    match status.source().map(root_cause) {
        Some(cause) if !said.contains(&cause) => format!("{said}: {cause}"),
        _ => said.to_owned(),
    }
}

/// Whether a call that failed so would fail again, so that another attempt is not worth while. `admitted`: whether the peer
/// has let this role in before. Then a token that it does not know is one that reaches the two of them at different times.
pub fn is_final(status: &Status, admitted: bool) -> bool {
    match status.code() {
        Code::Unauthenticated => !admitted,
        // A message that is longer than the other side takes is out of range.
        Code::InvalidArgument
        | Code::FailedPrecondition
        | Code::NotFound
        | Code::OutOfRange
        | Code::PermissionDenied
        | Code::Unimplemented => true,
        _ => false,
    }
}

/// The innermost error: "connection refused" says more than "tcp connect error".
fn root_cause(error: &dyn Error) -> String {
    let (mut said, mut cause) = (error.to_string(), error.source());
    while let Some(source) = cause {
        let failed = source.downcast_ref::<io::Error>();
        if failed.is_some_and(|failed| failed.kind() == io::ErrorKind::TimedOut) {
            return "it does not answer".to_owned();
        }
        (said, cause) = (source.to_string(), source.source());
    }
    said
}
