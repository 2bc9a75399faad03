//! What passes between the roles: the messages, and the types they are parsed into at the door.
//!
//! - [`v1`] is generated from `getup/v1/*.proto`, which document the protocol itself: messages, clients, servers.
//! - [`RunSpec`] names the columns of a run's transitions; [`Segment`] is a stretch of one episode that
//!   follows it. Both are made from their wire form by `parse`, which refuses what is malformed and says why,
//!   so that nothing behind the door checks again.
//! - [`TraceContext`] names a place in a trace, which crosses beside what is followed.
//! - [`columns`] turns `f32` values into the little-endian bytes of a column, and back.
//! - [`names`] are those of networks, values and scenarios inside messages.
//! - [`PolicyVersion`] orders the policies of a run.

pub mod columns;
pub mod names;
mod segment;
mod spec;
mod trace;
mod version;

pub use segment::{EpisodeEnd, Segment, SegmentError};
pub use spec::{ColumnSpec, Rows, RunSpec, SpecError};
pub use trace::{SegmentTrace, TraceContext, TraceparentError, mix};
pub use version::PolicyVersion;

/// The largest message that clients and servers of this crate's services accept, in bytes.
///
/// gRPC's usual 4 MiB are too few: an update of a 2 × 1024 policy is larger, and so are large minibatches.
pub const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// The version of the protocol that this crate speaks.
pub const PROTOCOL: u32 = 1;
/// The oldest version that it still understands: roles of this one and later may run beside it, as in a rolling restart.
pub const OLDEST_PROTOCOL: u32 = 1;

/// Generated from the .proto files: messages, clients and servers.
#[allow(missing_docs, unreachable_pub, clippy::all, rustdoc::all)]
pub mod v1 {
    tonic::include_proto!("getup.v1");
}
