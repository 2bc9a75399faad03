//! The gRPC clients of replay and learner: how an actor of a cluster is connected.

mod learner;
mod replay;

use std::time::Duration;

use tonic::Status;

use crate::link::LinkError;

pub use learner::GrpcLearner;
pub use replay::GrpcReplay;

/// How long a short call may take to be answered.
const PATIENCE: Duration = Duration::from_secs(5);

/// What a status means for the actor: see [`getup_transport::is_final`].
fn link_error(peer: &str, status: &Status, admitted: bool) -> LinkError {
    let said = match &*getup_transport::reason(status) {
        "" => format!("{peer}: {}", status.code()),
        reason => format!("{peer}: {reason}"),
    };
    if getup_transport::is_final(status, admitted) {
        LinkError::Refused(said)
    } else {
        LinkError::Unavailable(said)
    }
}
