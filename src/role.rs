//! What every role's process has beside its work: logs, metrics, traces, health, a runtime, and an orderly end.

use std::future::Future;
use std::io::{self, Write};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result};
use getup_telemetry::traces::Recorder;
use getup_telemetry::{
    Ready, Registry, Shown, Shutdown, Traces, Waits, build_info, init_logging, registry, serve_http,
};
use getup_transport::{Credentials, Limits, Metrics, SecurityConfig, Server, require_protection};
use indicatif::MultiProgress;
use tokio::net::TcpListener;

use crate::config::{Config, ConfigArgs};

/// How long the end of a process waits for what does not end by itself.
const GRACE: Duration = Duration::from_secs(2);
/// Files that a role may have open beside its gRPC port's connections: its store, its clients, its HTTP port.
const OTHER_FILES: usize = 1024;

/// What every role's command line shares.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct RoleArgs {
    #[command(flatten)]
    pub(crate) config: ConfigArgs,
    /// How log lines are written.
    #[arg(long, value_name = "FORMAT", default_value = "pretty")]
    pub(crate) log_format: LogFormat,
}

/// How log lines are written.
#[derive(clap::ValueEnum, Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum LogFormat {
    /// A readable line an event, in colour on a terminal.
    Pretty,
    /// A JSON object a line.
    Json,
}

/// A process in the making: what its parts share.
#[derive(Clone)]
pub(crate) struct Role {
    pub(crate) registry: Registry,
    pub(crate) waits: Waits,
    /// What follows some segments from actor to minibatch.
    pub(crate) traces: Traces,
    pub(crate) shutdown: Shutdown,
    /// What this process shows to others, and wants to be shown.
    pub(crate) credentials: Credentials,
    security: SecurityConfig,
    /// That a port takes: in all, and from one address.
    connections: (usize, usize),
    grpc: Metrics,
    /// What `/healthz` says.
    pub(crate) ready: Ready,
    /// Where progress bars go; log lines step aside for them.
    #[cfg(feature = "learner")]
    pub(crate) progress: MultiProgress,
}

impl Role {
    /// Sets up logs and a registry for the role of this name.
    pub(crate) fn new(name: &str, config: &Config, log_format: LogFormat) -> Result<Self> {
        let progress = MultiProgress::new();
        let writer = progress.clone();
        init_logging(log_format == LogFormat::Json, move || LogWriter(writer.clone()))?;
        raise_open_files(config.network.connections);
        let registry = registry(&config.run);
        build_info(&registry, name);
        let host = host_name();
        let recorder = Recorder { role: name, run: &config.run, seed: config.seed, host: &host };
        Ok(Self {
            waits: Waits::new(&registry),
            traces: Traces::start(&config.traces, recorder, &registry)?,
            credentials: Credentials::load(&config.security)?,
            security: config.security.clone(),
            connections: (config.network.connections, config.network.connections_per_address),
            grpc: Metrics::new(&registry),
            registry,
            shutdown: Shutdown::new(),
            ready: Ready::default(),
            #[cfg(feature = "learner")]
            progress,
        })
    }

    /// Runs `work` on a runtime of its own until it ends; SIGTERM and Ctrl-C trigger the shutdown that it awaits.
    pub(crate) fn run<T>(&self, work: impl Future<Output = Result<T>>) -> Result<T> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .context("cannot start the asynchronous runtime")?;
        let result = runtime.block_on(async {
            self.shutdown.on_signals().context("cannot watch for signals")?;
            work.await
        });
        self.traces.shutdown();
        // A thread that the disk or a peer holds up must not hold up the end.
        runtime.shutdown_timeout(GRACE);
        result
    }

    /// Binds a gRPC port, which others than this machine reach only where they show something or are meant to.
    pub(crate) async fn bind_grpc(&self, setting: &str, address: &str) -> Result<TcpListener> {
        let listener = bind(setting, address).await?;
        require_protection(listener.local_addr()?, &self.security)?;
        Ok(listener)
    }

    /// A gRPC port that wants to be shown what the configuration says, and takes as many connections.
    pub(crate) fn port(&self, limits: Limits) -> Server {
        let (connections, connections_per_peer) = self.connections;
        let limits = Limits { connections, connections_per_peer, ..limits };
        Server::new(self.credentials.clone(), limits, self.grpc.clone())
    }

    /// Serves `/metrics` at `address` until shutdown; returns where.
    pub(crate) async fn serve_metrics(&self, setting: &str, address: &str) -> Result<SocketAddr> {
        let listener = bind(setting, address).await?;
        let bound = listener.local_addr()?;
        tracing::info!("metrics at http://{bound}/metrics");
        let credentials = self.credentials.clone();
        let shown = Shown {
            registry: self.registry.clone(),
            ready: self.ready.clone(),
            guard: Arc::new(move |headers| credentials.may_read_metrics(headers)),
        };
        let shutdown = self.shutdown.clone();
        tokio::spawn(async move {
            if let Err(error) = serve_http(listener, shown, shutdown).await {
                tracing::error!(%error, "/metrics is not served any more");
            }
        });
        Ok(bound)
    }
}

/// Binds a listener at the address of a setting, or says which could not be had and what to do.
async fn bind(setting: &str, address: &str) -> Result<TcpListener> {
    TcpListener::bind(address).await.with_context(|| {
        format!(
            "cannot listen at {setting} = {address}: choose another address with --set {setting}=HOST:PORT"
        )
    })
}

/// Lets the process open as many files as its connections and its store may need: many systems begin with 1,024.
fn raise_open_files(connections: usize) {
    let wanted = (connections + OTHER_FILES) as u64;
    match rlimit::increase_nofile_limit(wanted) {
        Ok(limit) if limit < wanted => tracing::warn!(
            "{limit} files and connections may be open here, and network.connections = {connections} may need {wanted}: \
             raise the limit (ulimit -Hn) or lower the setting"
        ),
        Ok(_) => {}
        Err(error) => tracing::warn!(%error, "cannot raise how many files may be open"),
    }
}

/// This machine's name, as logs and traces show it.
pub(crate) fn host_name() -> String {
    match rustix::system::uname().nodename().to_str() {
        Ok(name) if !name.is_empty() => name.to_owned(),
        _ => "host".to_owned(),
    }
}

/// Writes to stderr between two drawings of the progress bar.
struct LogWriter(MultiProgress);

impl Write for LogWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.suspend(|| io::stderr().write_all(bytes))?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}
