//! The segment writer against a real server that fails as servers do.

use std::time::Duration;

use bytes::Bytes;
use getup_actor::{GrpcReplay, Identity, LinkError, SegmentWriter};
use getup_proto::{PolicyVersion, RunSpec, Segment};
use getup_telemetry::{Registry, Waits};

use crate::support::replay::Store;
use crate::support::{Server, any_port, eventually, spec};

fn writer(server: &Server, spec: RunSpec, waits: &Waits) -> GrpcReplay {
    let identity = Identity { name: "actor-1".to_owned(), run_seed: 0, writer: 42 };
    GrpcReplay::new(&server.url(), spec, identity, waits.clone()).unwrap()
}

fn segments(sequences: std::ops::RangeInclusive<u64>) -> Vec<Segment> {
    let segment = |sequence| Segment {
        writer: 42,
        sequence,
        lane: 0,
        episode: sequence,
        first_step: 0,
        steps: 2,
        env_steps: 2,
        terminal: false,
        truncated: false,
        stage: 0,
        first_version: PolicyVersion::default(),
        last_version: PolicyVersion::default(),
        columns: spec().columns.iter().map(|column| Bytes::from(vec![0; column.bytes(2)])).collect(),
        end: None,
        trace: None,
    };
    sequences.map(segment).collect()
}

#[tokio::test]
async fn every_segment_is_stored_once_and_in_order_through_cut_streams_and_a_crash() {
    let store = Store::default();
    let server = store.serve(any_port());
    let waits = Waits::new(&Registry::new());
    let mut writer = writer(&server, spec(), &waits);
    writer.append(segments(1..=5)).await.unwrap();
    assert_eq!(store.len(), 5);

    // Stored, and the stream cut before the acknowledgement: only what is not stored comes again.
    store.with(|state| state.cut_after = Some(3));
    writer.append(segments(6..=20)).await.unwrap();
    store.with(|state| state.cut_after = None);
    assert_eq!(store.len(), 20);

    let address = server.kill();
    let appending = tokio::spawn(async move {
        writer.append(segments(21..=40)).await.unwrap();
        writer
    });
    eventually("a wait for the replay", || {
        waits.current().iter().any(|wait| wait.what == "actor_writer" && wait.reason.contains("replay at"))
    })
    .await;
    let _server = store.serve(address);
    let mut writer = appending.await.unwrap();
    assert!(waits.current().is_empty());
    writer.append(segments(41..=41)).await.unwrap();

    let stored = store.with(|state| state.segments.clone());
    assert_eq!(stored, segments(1..=41));
    assert_eq!(store.with(|state| state.repeated), 0);
}

#[tokio::test]
async fn a_call_returns_only_when_the_replay_has_acknowledged_and_connects_again_after_it_was_dropped() {
    let store = Store::default();
    let server = store.serve(any_port());
    let mut writer = writer(&server, spec(), &Waits::new(&Registry::new()));
    store.with(|state| state.silent = true);
    {
        let mut call = std::pin::pin!(writer.append(segments(1..=3)));
        tokio::select! {
            returned = &mut call => panic!("nothing was acknowledged: {returned:?}"),
            () = eventually("the replay has all", || store.len() == 3) => {}
        }
        assert!(tokio::time::timeout(Duration::from_millis(50), call).await.is_err());
    }
    store.with(|state| state.silent = false);
    writer.append(segments(1..=4)).await.unwrap();
    assert_eq!((store.len(), store.with(|state| state.repeated)), (4, 0));
}

#[tokio::test]
async fn a_replay_of_another_run_ends_the_writer_with_its_reason_at_once() {
    let store = Store::default();
    let server = store.serve(any_port());
    let other = RunSpec { run: "other".to_owned(), ..spec() };
    let mut writer = writer(&server, other, &Waits::new(&Registry::new()));
    let Err(LinkError::Refused(reason)) = writer.append(segments(1..=1)).await else {
        panic!("a writer of another run was let in");
    };
    assert!(reason.starts_with("replay at http://127.0.0.1:"), "{reason}");
    assert!(reason.contains("the run is `other` and should be `test`"), "{reason}");
    assert_eq!(store.len(), 0);
}

#[tokio::test]
async fn an_address_that_is_none_is_refused_before_any_connection() {
    let waits = Waits::new(&Registry::new());
    for address in ["", "replay", "replay:7400:x", "http://"] {
        let identity = Identity::new("actor", 0);
        let refused = GrpcReplay::new(address, spec(), identity, waits.clone()).err();
        let message = refused.expect(address).to_string();
        assert!(message.contains("write it like replay:7401"), "{message}");
    }
}
