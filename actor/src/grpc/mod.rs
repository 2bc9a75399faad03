//! The gRPC clients of replay and learner: how an actor of a cluster is connected.

mod learner;
mod replay;

use std::time::Duration;

use thiserror::Error;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Status};

use crate::link::LinkError;

pub use learner::GrpcLearner;
pub use replay::GrpcReplay;

/// A peer that is silent for this long is pinged, and given up after as long again.
const KEEP_ALIVE: Duration = Duration::from_secs(5);
/// How long a connection may take to come about, and a short call to be answered.
const PATIENCE: Duration = Duration::from_secs(5);

/// An address that is none.
#[derive(Debug, Error)]
#[error("{address:?} is not the address of a service: write it like http://replay:7400 ({reason})")]
pub struct AddressError {
    address: String,
    reason: String,
}

/// A channel that connects when it is first used, and again whenever it has to.
fn channel(address: &str) -> Result<Channel, AddressError> {
    let refused = |reason: String| AddressError { address: address.to_owned(), reason };
    let endpoint = Endpoint::from_shared(address.to_owned()).map_err(|error| refused(error.to_string()))?;
    if endpoint.uri().scheme().is_none() || endpoint.uri().host().is_none() {
        return Err(refused("it needs a scheme and a host".to_owned()));
    }
    Ok(endpoint
        .connect_timeout(PATIENCE)
        .http2_keep_alive_interval(KEEP_ALIVE)
        .keep_alive_timeout(KEEP_ALIVE)
        .keep_alive_while_idle(true)
        // A policy of some MiB should not wait for a window of 64 KiB a round trip.
        .http2_adaptive_window(true)
        .tcp_nodelay(true)
        .connect_lazy())
}

/// What a status means for the actor: whether another attempt is worth while.
fn link_error(peer: &str, status: &Status) -> LinkError {
    let said = match status.message() {
        "" => format!("{peer}: {}", status.code()),
        message => format!("{peer}: {message}"),
    };
    match status.code() {
        Code::InvalidArgument
        | Code::FailedPrecondition
        | Code::Unauthenticated
        | Code::PermissionDenied
        | Code::Unimplemented => LinkError::Refused(said),
        _ => LinkError::Unavailable(said),
    }
}
