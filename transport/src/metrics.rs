//! What a port counts: its connections, and what it refused.

use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;

use getup_telemetry::Registry;
use getup_telemetry::prometheus::{IntCounter, IntCounterVec, IntGauge, Opts};

use crate::throttle::Throttle;

/// `getup_grpc_connections` and `getup_grpc_refused_total{reason}`; clones share them, and so do all ports of a process.
#[derive(Clone, Debug)]
pub struct Metrics {
    pub(crate) connections: IntGauge,
    refused: Arc<[Refused; Reason::ALL.len()]>,
}

/// Why a connection or a call was refused.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Reason {
    /// A call without a token, or with another.
    Token,
    /// A connection that did not get as far as a call that may be made.
    Handshake,
    /// There are as many connections as there may be.
    Connections,
    /// There are as many from this address as there may be.
    PeerConnections,
}

impl Reason {
    const ALL: [Self; 4] = [Self::Token, Self::Handshake, Self::Connections, Self::PeerConnections];
}

impl fmt::Display for Reason {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Token => "token",
            Self::Handshake => "handshake",
            Self::Connections => "connections",
            Self::PeerConnections => "peer_connections",
        })
    }
}

#[derive(Debug)]
struct Refused {
    counter: IntCounter,
    log: Throttle,
}

impl Metrics {
    /// Registers both.
    ///
    /// # Panics
    /// When `registry` has them already: a process has them once.
    pub fn new(registry: &Registry) -> Self {
        let options = Opts::new("getup_grpc_connections", "Connections that the process's gRPC ports hold.");
        let connections = IntGauge::with_opts(options).expect("the name is well-formed");
        let options = Opts::new("getup_grpc_refused_total", "Connections and calls that were refused.");
        let refused = IntCounterVec::new(options, &["reason"]).expect("the name and label are well-formed");
        registry.register(Box::new(connections.clone())).expect("a process registers them once");
        registry.register(Box::new(refused.clone())).expect("a process registers them once");
        let refused = Reason::ALL.map(|reason| Refused {
            counter: refused.with_label_values(&[&reason.to_string()]),
            log: Throttle::default(),
        });
        Self { connections, refused: Arc::new(refused) }
    }

    /// Counts a refusal, and logs it unless one for the same reason was logged within the minute.
    pub(crate) fn refuse(&self, reason: Reason, peer: Option<SocketAddr>, why: impl fmt::Display) {
        let refused = &self.refused[reason as usize];
        refused.counter.inc();
        if let Some(count) = refused.log.note() {
            let peer = peer.map_or_else(|| "a peer".to_owned(), |peer| peer.to_string());
            tracing::warn!(%reason, refused = count, "{peer} was refused: {why}");
        }
    }
}
