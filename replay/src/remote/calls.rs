//! Short calls to a replay service, and how it is connected.

use std::future::Future;
use std::time::Duration;

use getup_proto::v1::replay_client::ReplayClient;
use getup_proto::{MAX_MESSAGE_BYTES, v1};
use getup_transport::{AddressError, Channel, ChannelOptions, Endpoint, Window};
use tonic::Status;

/// How long a connection or a short call may take.
pub(super) const CALL_PATIENCE: Duration = Duration::from_secs(5);
/// A service that does not answer pings for this long is gone.
const PING_EVERY: Duration = Duration::from_secs(10);
/// Bytes of a stream that may be on their way to a client that is not reading.
const STREAM_WINDOW_BYTES: u32 = 8 << 20;

/// What the service says of its default table.
///
/// # Errors
/// UNAVAILABLE if the service is not there, DEADLINE_EXCEEDED if it does not answer.
pub async fn describe(endpoint: impl Into<Endpoint>) -> Result<v1::DescribeReply, Status> {
    describe_table(endpoint, "").await
}

/// What the service says of one of its tables.
///
/// # Errors
/// As [`describe`]; NOT_FOUND if it has no such table.
pub async fn describe_table(endpoint: impl Into<Endpoint>, table: &str) -> Result<v1::DescribeReply, Status> {
    ask(client(&endpoint.into())?, table).await
}

/// Gives transitions of a service's table (empty for the default) priorities, by their keys; returns how many were still there.
///
/// # Errors
/// As [`describe`]; INVALID_ARGUMENT if one is negative or not finite, and then none is given.
pub async fn update_priorities(
    endpoint: impl Into<Endpoint>,
    table: &str,
    priorities: &[(u64, f32)],
) -> Result<u64, Status> {
    let (keys, priorities) = priorities.iter().copied().unzip();
    let mut client = client(&endpoint.into())?;
    let request = v1::UpdatePrioritiesRequest { keys, priorities, table: table.to_owned() };
    Ok(in_time(client.update_priorities(request)).await?.updated)
}

/// Has the service copy the store of a table (empty for the default) to `snapshots/NAME` in its folder.
///
/// It returns when the copy is on the disk, however long that takes.
///
/// # Errors
/// UNAVAILABLE if the service is not there, INVALID_ARGUMENT if the name is none, FAILED_PRECONDITION if the copy cannot be made.
pub async fn take_snapshot(
    endpoint: impl Into<Endpoint>,
    table: &str,
    name: &str,
) -> Result<v1::SnapshotReply, Status> {
    let request = v1::SnapshotRequest { name: name.to_owned(), table: table.to_owned() };
    client(&endpoint.into())?.snapshot(request).await.map(tonic::Response::into_inner)
}

pub(super) async fn ask(mut client: ReplayClient<Channel>, table: &str) -> Result<v1::DescribeReply, Status> {
    let request = v1::DescribeRequest { table: table.to_owned() };
    in_time(client.describe(request)).await
}

/// What a short call answers.
pub(super) async fn in_time<T>(
    call: impl Future<Output = Result<tonic::Response<T>, Status>>,
) -> Result<T, Status> {
    let answer = tokio::time::timeout(CALL_PATIENCE, call).await;
    answer.map_err(|_| Status::deadline_exceeded("replay does not answer"))?.map(tonic::Response::into_inner)
}

/// A client whose calls say when the service is not there.
fn client(endpoint: &Endpoint) -> Result<ReplayClient<Channel>, Status> {
    let channel = channel(endpoint).map_err(|error| Status::invalid_argument(error.to_string()))?;
    Ok(ReplayClient::new(channel).max_encoding_message_size(MAX_MESSAGE_BYTES))
}

pub(super) fn channel(endpoint: &Endpoint) -> Result<Channel, AddressError> {
    endpoint.channel(ChannelOptions {
        connect_timeout: CALL_PATIENCE,
        keep_alive_interval: PING_EVERY,
        keep_alive_timeout: PING_EVERY,
        keep_alive_while_idle: false,
        window: Window::Fixed { stream: STREAM_WINDOW_BYTES, connection: STREAM_WINDOW_BYTES },
    })
}
