//! The append service over real connections: acknowledgements, refusals, back-pressure, draining.

use crate::common::{Replay, Writer, config, eventually, hello, message, next, open, options};
use crate::fixtures::{Ending, Part, segment, spec};
use getup_proto::v1::append_request::Message;
use getup_proto::{RunSpec, Segment, columns, v1};
use getup_replay::{ItemSelector, LocalSource, MinibatchSource, Remover, ReplayConfig, describe};
use std::time::{Duration, Instant};
use tonic::Code;

#[test]
fn an_acknowledged_segment_can_be_sampled_and_is_never_stored_twice() {
    let replay = Replay::start(spec(8), &config());
    let segments: Vec<Segment> = (1..=50).map(|i| segment(&replay.spec, 7, i, 8)).collect();
    let mut writer = replay.writer(7);
    assert_eq!(writer.durable, 0);
    replay.runtime.block_on(async {
        for segment in &segments {
            writer.send(segment).await.unwrap();
        }
        writer.acknowledged(50).await.unwrap();
    });
    assert_eq!((replay.store.len(), replay.store.counters().transitions), (400, 400));
    // Again, as after a lost acknowledgement: on a new stream, from before its mark.
    let again = [hello(&replay.spec, 7)].into_iter().chain(segments[30..].iter().map(message)).collect();
    assert_eq!(replay.outcome(again).unwrap(), 50);
    assert_eq!(replay.store.counters().transitions, 400);
    assert_eq!(replay.writer(7).durable, 50);
}

#[test]
fn two_streams_of_one_writer_store_each_segment_once() {
    let replay = Replay::start(spec(8), &config());
    let streams: Vec<Writer> = (0..2).map(|_| replay.writer(3)).collect();
    replay.runtime.block_on(async {
        let sending = streams.into_iter().map(|mut writer| {
            let segments: Vec<Segment> = (1..=100).map(|i| segment(&replay.spec, 3, i, 4)).collect();
            tokio::spawn(async move {
                for segment in &segments {
                    writer.send(segment).await.unwrap();
                }
                writer.acknowledged(100).await.unwrap();
            })
        });
        for sent in sending.collect::<Vec<_>>() {
            sent.await.unwrap();
        }
    });
    assert_eq!(replay.store.counters().transitions, 400);
}

#[test]
fn a_traceparent_that_is_none_or_that_nobody_follows_leaves_the_segment_as_it_is() {
    let replay = Replay::start(spec(8), &config());
    let mut writer = replay.writer(1);
    replay.runtime.block_on(async {
        let followed = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";
        for (sequence, traceparent) in [(1, "a trace"), (2, followed)] {
            let message = Some(message(&segment(&replay.spec, 1, sequence, 8)));
            let request = v1::AppendRequest { message, traceparent: traceparent.to_owned() };
            writer.requests.send(request).await.unwrap();
        }
        writer.acknowledged(2).await.unwrap();
    });
    assert_eq!(replay.store.len(), 16);
    let (store, shutdown) = (replay.store.clone(), replay.shutdown.clone());
    let mut source = LocalSource::new(store, options(16), "learner", shutdown).unwrap();
    assert!(source.next().unwrap().traces.is_empty(), "without a collector no trace goes on");
}

#[test]
fn what_is_wrong_is_refused_with_its_reason_and_changes_nothing() {
    let replay = Replay::start(spec(8), &config());
    let good = segment(&replay.spec, 1, 1, 4);
    assert_eq!(replay.outcome(vec![hello(&replay.spec, 1), message(&good)]).unwrap(), 1);
    let before = describe_without_time(&replay);

    let second = || segment(&replay.spec, 1, 2, 4);
    let with = |change: &dyn Fn(&mut Segment)| {
        let mut segment = second();
        change(&mut segment);
        vec![hello(&replay.spec, 1), message(&segment)]
    };
    let other_spec = |change: &dyn Fn(&mut RunSpec)| {
        let mut spec = replay.spec.clone();
        change(&mut spec);
        vec![hello(&spec, 1), message(&second())]
    };
    let mut damaged = second().to_wire();
    damaged.crc32 ^= 1;
    let mut unspecified = v1::AppendHello { spec: None, writer: 1, ..v1::AppendHello::default() };
    unspecified.spec = None;
    use Code::{FailedPrecondition, InvalidArgument};
    let wrong: Vec<(Vec<Message>, Code, &str)> = vec![
        (vec![message(&second())], InvalidArgument, "must be its hello"),
        (vec![], InvalidArgument, "must be its hello"),
        (vec![Message::Hello(unspecified)], InvalidArgument, "no run spec"),
        (
            other_spec(&|s| s.run = "other".into()),
            FailedPrecondition,
            "the run is `other` and should be `test`",
        ),
        (other_spec(&|s| s.columns[0].width = 4), FailedPrecondition, "column `observation`"),
        (other_spec(&|s| s.columns.clear()), InvalidArgument, "no columns"),
        (with(&|s| s.columns[1] = columns::encode(&[0.0; 7])), InvalidArgument, "column `action`"),
        (
            with(&|s| s.columns[1] = columns::encode(&[f32::NAN; 8])),
            InvalidArgument,
            "column `action` holds NaN",
        ),
        (
            with(&|s| s.columns[2] = columns::encode(&[f32::INFINITY; 4])),
            InvalidArgument,
            "`reward` holds inf",
        ),
        (vec![hello(&replay.spec, 1), Message::Segment(damaged)], Code::DataLoss, "checksum"),
        (with(&|s| s.steps = 9), InvalidArgument, "has 9 steps"),
        (with(&|s| s.terminal = true), InvalidArgument, "end is inconsistent"),
        (with(&|s| s.writer = 2), InvalidArgument, "a segment of writer 2"),
        (vec![hello(&replay.spec, 1), hello(&replay.spec, 1)], InvalidArgument, "one hello"),
        (
            vec![hello(&replay.spec, 1), message(&good), message(&good)],
            InvalidArgument,
            "segment 1 came after segment 1",
        ),
    ];
    for (messages, code, reason) in wrong {
        let status = replay.outcome(messages).expect_err(reason);
        assert_eq!(status.code(), code, "{status}");
        assert!(status.message().contains(reason), "{status}");
        assert_eq!(describe_without_time(&replay), before, "after {reason}");
    }
    assert_eq!(replay.store.len(), 4);
    let refused =
        replay.registry.gather().into_iter().find(|family| family.name() == "getup_replay_rejected_total");
    let total: f64 =
        refused.unwrap().get_metric().iter().map(|metric| metric.get_counter().get_value()).sum();
    assert_eq!(total, 15.0);
    // And the service goes on.
    assert_eq!(replay.outcome(vec![hello(&replay.spec, 1), message(&second())]).unwrap(), 2);
}

/// What `describe` says, but for how long writers were silent and what files weigh.
fn describe_without_time(replay: &Replay) -> v1::DescribeReply {
    let mut described = replay.runtime.block_on(describe(&replay.endpoint)).unwrap();
    described.disk_bytes = 0;
    for writer in &mut described.writers {
        writer.silent_seconds = 0.0;
    }
    described
}

#[test]
fn segments_before_a_wrong_one_are_acknowledged() {
    let replay = Replay::start(spec(8), &config());
    let mut wrong = segment(&replay.spec, 1, 3, 4);
    wrong.columns[2] = columns::encode(&[f32::NAN; 4]);
    let mut writer = replay.writer(1);
    let (durable, status) = replay.runtime.block_on(async {
        for sequence in 1..=2 {
            writer.send(&segment(&replay.spec, 1, sequence, 4)).await.unwrap();
        }
        writer.send(&wrong).await.unwrap();
        let mut durable = 0;
        loop {
            match next(&mut writer.replies).await {
                Ok(sequence) => durable = sequence,
                Err(status) => return (durable, status),
            }
        }
    });
    assert_eq!((durable, status.code()), (2, Code::InvalidArgument));
    assert_eq!(replay.store.len(), 8);
}

#[test]
fn the_in_process_door_refuses_the_same() {
    let replay = Replay::start(spec(8), &config());
    let mut wrong = segment(&replay.spec, 1, 2, 4);
    wrong.columns[0] = columns::encode(&[f32::NAN; 15]);
    let error = replay.store.append(vec![segment(&replay.spec, 1, 1, 4), wrong]).unwrap_err();
    assert!(error.to_string().contains("column `observation` holds NaN"), "{error}");
    assert_eq!(replay.store.counters().transitions, 0);
}

#[test]
fn writers_wait_for_samplers_and_say_so_and_go_on_when_these_have_sampled() {
    let paced =
        ReplayConfig { min_size: 8, samples_per_insert: Some(4.0), error_buffer: Some(32.0), ..config() };
    let replay = Replay::start(spec(8), &paced);
    let mut writer = replay.writer(1);
    let spec = replay.spec.clone();
    let sending = replay.runtime.spawn(async move {
        for sequence in 1..=40 {
            writer.send(&segment(&spec, 1, sequence, 4)).await.unwrap();
        }
        writer.acknowledged(40).await.unwrap();
    });
    // Up to the band's upper edge: (16 - 8) x 4 = 32 samples ahead.
    eventually("the writer waits", || replay.waiting().starts_with("writer waits"));
    eventually("what came before is durable", || replay.store.counters().env_steps == 16);
    let waiting = replay.waiting();
    assert!(waiting.contains("16 env steps with 0 samples are ahead of 4 samples per insert"), "{waiting}");
    assert!(waiting.contains("no sampler has come"), "{waiting}");

    let mut source =
        LocalSource::new(replay.store.clone(), options(16), "learner", replay.shutdown.clone()).unwrap();
    while !sending.is_finished() {
        source.poll(Duration::from_millis(10)).unwrap();
        let counters = replay.store.counters();
        // What was inserted but not yet counted can only make the cursor look too high here.
        let cursor = counters.env_steps as f64 * 4.0 - counters.sampled as f64;
        assert!(cursor >= 0.0, "{counters:?}");
    }
    replay.runtime.block_on(sending).unwrap();
    assert_eq!(replay.store.counters().env_steps, 160);
    assert!(replay.store.counters().sampled >= 160 * 4 - 64);
}

#[test]
fn describe_tells_sizes_counters_limiter_and_writers() {
    let paced = ReplayConfig { samples_per_insert: Some(4.0), min_size: 100, ..config() };
    let replay = Replay::start(spec(8), &paced);
    let part = Part {
        writer: 9,
        sequence: 1,
        lane: 0,
        episode: 0,
        first_step: 0,
        steps: 8,
        ending: Ending::Truncated,
    };
    let mut limp = part.build(&replay.spec);
    limp.env_steps = 5;
    let mut writer = replay.writer(9);
    replay.runtime.block_on(async {
        writer.send(&limp).await.unwrap();
        writer.acknowledged(1).await.unwrap();
    });
    let described = replay.runtime.block_on(describe(&replay.endpoint)).unwrap();
    assert_eq!(RunSpec::parse(described.spec.unwrap()).unwrap(), replay.spec);
    let counters = described.counters.unwrap();
    assert_eq!((counters.env_steps, counters.transitions, counters.episodes, counters.sampled), (5, 8, 1, 0));
    assert_ne!(counters.store, 0);
    assert_eq!((described.size, described.capacity), (8, 10_000));
    assert!(described.memory_bytes > 0 && described.disk_bytes > 0);
    let limiter = described.limiter.unwrap();
    assert_eq!((limiter.min_size, limiter.samples_per_insert, limiter.cursor), (100, 4.0, 20.0));
    assert_eq!((limiter.min_cursor, limiter.max_cursor), (400.0 - 64.0, 400.0 + 64.0));
    let [writer] = &described.writers[..] else { panic!("{:?}", described.writers) };
    assert_eq!((writer.name.as_str(), writer.writer, writer.durable_sequence), ("actor-9", 9, 1));
}

#[test]
fn metrics_follow_what_is_appended_and_sampled() {
    let sampler = ItemSelector::Prioritized { exponent: 1.0 };
    let remover = Remover::LowestPriority { window: 2 };
    let replay = Replay::start(spec(8), &ReplayConfig { sampler, remover, ..config() });
    replay.store.append((1..=10).map(|i| segment(&replay.spec, 1, i, 8)).collect()).unwrap();
    let mut source =
        LocalSource::new(replay.store.clone(), options(16), "learner", replay.shutdown.clone()).unwrap();
    source.next().unwrap();
    let families = replay.registry.gather();
    let value = |name: &str| {
        let family = families.iter().find(|family| family.name() == format!("getup_replay_{name}"));
        let metric = &family.expect(name).get_metric()[0];
        metric.get_counter().get_value()
            + metric.get_gauge().get_value()
            + metric.get_histogram().get_sample_count() as f64
    };
    assert_eq!((value("transitions"), value("capacity_transitions")), (80.0, 10_000.0));
    assert_eq!((value("log_transitions"), value("log_capacity_transitions")), (80.0, 20_000.0));
    assert_eq!((value("env_steps_total"), value("inserted_transitions_total")), (80.0, 80.0));
    assert_eq!((value("sampled_transitions_total"), value("episodes_total")), (16.0, 0.0));
    assert_eq!((value("append_seconds"), value("sample_seconds"), value("commit_segments")), (1.0, 1.0, 1.0));
    assert!(
        value("memory_bytes") > 0.0 && value("disk_bytes") >= 0.0 && value("limiter_cursor_samples") == 0.0
    );
}

#[test]
fn shutdown_acknowledges_what_came_tells_clients_and_takes_little_time() {
    let replay = Replay::start(spec(8), &config());
    let mut writer = replay.writer(1);
    let idle = replay.writer(2);
    let store = replay.store.clone();
    replay.runtime.block_on(async {
        for sequence in 1..=20 {
            writer.send(&segment(&replay.spec, 1, sequence, 8)).await.unwrap();
        }
    });
    let reading = replay.runtime.spawn(async move {
        let mut durable = 0;
        loop {
            match next(&mut writer.replies).await {
                Ok(sequence) => durable = sequence,
                Err(status) => return (durable, status),
            }
        }
    });
    eventually("some are stored", || store.counters().transitions > 0);
    let started = Instant::now();
    replay.shutdown.trigger();
    // What reads is a task of the runtime that ends with the replay, so it is waited for first.
    let (durable, status) = replay.runtime.block_on(reading).unwrap();
    replay.stop().0.unwrap();
    let took = started.elapsed();
    assert!(took < Duration::from_secs(3), "{took:?}");
    assert_eq!(status.code(), Code::Unavailable, "{status}");
    assert!(durable > 0);
    assert_eq!(store.counters().transitions, durable * 8);
    drop(idle);
}

#[test]
fn a_second_store_on_the_same_folder_is_refused() {
    let dir = tempfile::TempDir::new().unwrap();
    let store = open(dir.path(), &spec(8), &config()).unwrap();
    assert!(open(dir.path(), &spec(8), &config()).unwrap_err().to_string().contains("in use"));
    drop(store);
    open(dir.path(), &spec(8), &config()).unwrap();
}
