//! The gRPC clients of replay and learner: how an actor of a cluster is connected.

mod learner;
mod replay;

use std::time::Duration;

use tonic::{Code, Status};

use crate::link::LinkError;

pub use learner::GrpcLearner;
pub use replay::GrpcReplay;

/// How long a short call may take to be answered.
const PATIENCE: Duration = Duration::from_secs(5);

/// What a status means for the actor: whether another attempt is worth while. `admitted`: whether the peer has let it in
/// before. Then a token that it does not know is one that reaches the two of them at different times.
fn link_error(peer: &str, status: &Status, admitted: bool) -> LinkError {
    let said = match &*getup_transport::reason(status) {
        "" => format!("{peer}: {}", status.code()),
        reason => format!("{peer}: {reason}"),
    };
    match status.code() {
        Code::Unauthenticated if admitted => LinkError::Unavailable(said),
        Code::InvalidArgument
        | Code::FailedPrecondition
        | Code::Unauthenticated
        | Code::PermissionDenied
        | Code::Unimplemented => LinkError::Refused(said),
        _ => LinkError::Unavailable(said),
    }
}
