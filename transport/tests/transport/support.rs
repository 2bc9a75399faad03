//! A port that serves the health service, and clients of it.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use getup_telemetry::{Registry, Shutdown, health};
use getup_transport::{Channel, ChannelOptions, Credentials, Limits, Metrics, SecurityConfig, Server};
use tempfile::TempDir;
use tokio::net::TcpListener;
use tonic::service::Routes;
use tonic::service::interceptor::InterceptedService;
use tonic::{Code, Request, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

/// Longer than anything should take.
pub(crate) const PATIENCE: Duration = Duration::from_secs(15);

/// A port on a loopback, until it is dropped.
pub(crate) struct Port {
    pub(crate) address: SocketAddr,
    registry: Registry,
    shutdown: Shutdown,
}

impl Port {
    pub(crate) async fn open(config: &SecurityConfig) -> Self {
        Self::limited(config, Limits::default()).await
    }

    pub(crate) async fn limited(config: &SecurityConfig, limits: Limits) -> Self {
        let (registry, shutdown) = (Registry::new(), Shutdown::new());
        // All of 127.0.0.0/8.
        let listener = TcpListener::bind("0.0.0.0:0").await.unwrap();
        let address = SocketAddr::from(([127, 0, 0, 1], listener.local_addr().unwrap().port()));
        let server = Server::new(Credentials::load(config).unwrap(), limits, Metrics::new(&registry));
        let ended = shutdown.clone();
        tokio::spawn(async move {
            let routes = Routes::new(InterceptedService::new(health(ended.clone()), behind_the_door));
            server.serve(listener, routes, ended).await.unwrap();
        });
        Self { address, registry, shutdown }
    }

    pub(crate) fn channel(&self, config: &SecurityConfig) -> Channel {
        channel(&self.address.to_string(), config)
    }

    /// Ends it.
    pub(crate) fn close(&self) {
        self.shutdown.trigger();
    }

    /// How much was refused for this reason.
    pub(crate) fn refused(&self, reason: &str) -> u64 {
        let families = self.registry.gather();
        let family = families.iter().find(|family| family.name() == "getup_grpc_refused_total").unwrap();
        let metric = family.get_metric().iter().find(|metric| metric.get_label()[0].value() == reason);
        metric.unwrap().get_counter().get_value() as u64
    }

    pub(crate) fn connections(&self) -> u64 {
        let families = self.registry.gather();
        let family = families.iter().find(|family| family.name() == "getup_grpc_connections").unwrap();
        family.get_metric()[0].get_gauge().get_value() as u64
    }
}

impl Drop for Port {
    fn drop(&mut self) {
        self.close();
    }
}

/// A service knows who calls, and does not see the token.
fn behind_the_door(request: Request<()>) -> Result<Request<()>, Status> {
    match (request.remote_addr(), request.metadata().get("authorization")) {
        (Some(_), None) => Ok(request),
        seen => Err(Status::internal(format!("{seen:?}"))),
    }
}

pub(crate) fn channel(address: &str, config: &SecurityConfig) -> Channel {
    Credentials::load(config).unwrap().channel(address, ChannelOptions::default()).unwrap()
}

/// A call of the health service.
pub(crate) async fn call(channel: &Channel) -> Result<(), Status> {
    HealthClient::new(channel.clone()).check(HealthCheckRequest::default()).await.map(drop)
}

pub(crate) async fn refusal(channel: &Channel) -> (Code, String) {
    let status = call(channel).await.expect_err("the call should be refused");
    (status.code(), status.message().to_owned())
}

/// Tries again until it is so.
pub(crate) async fn eventually(mut so: impl AsyncFnMut() -> bool) {
    let started = Instant::now();
    while !so().await {
        assert!(started.elapsed() < PATIENCE, "it does not come about");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// A folder with files of a test.
pub(crate) struct Folder(TempDir);

impl Folder {
    pub(crate) fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }

    pub(crate) fn write(&self, name: &str, contents: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path().join(name);
        std::fs::write(&path, contents).unwrap();
        path
    }

    pub(crate) fn text(&self, name: &str) -> String {
        std::fs::read_to_string(self.path().join(name)).unwrap()
    }

    /// The configuration with a file of these tokens.
    pub(crate) fn token(&self, tokens: &str) -> SecurityConfig {
        SecurityConfig { token_file: self.write("token", tokens), ..SecurityConfig::default() }
    }

    /// The configuration with the files that `make_authority` writes.
    pub(crate) fn tls(&self) -> SecurityConfig {
        let [ca, certificate, key] = ["ca.pem", "peer.pem", "peer.key"].map(|name| self.path().join(name));
        SecurityConfig { ca, certificate, key, ..SecurityConfig::default() }
    }
}
