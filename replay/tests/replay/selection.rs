//! Stores that draw otherwise than uniformly, in process and over gRPC.

use crate::common::{self, PATIENCE, Replay, config, eventually, open, options};
use crate::fixtures::{get_up_spec, segment, spec, value};
use getup_proto::v1::append_request::Message;
use getup_proto::v1::replay_client::ReplayClient;
use getup_proto::{RunSpec, v1};
use getup_replay::{
    ItemSelector, Minibatch, MinibatchSource, RemoteOptions, RemoteSource, ReplayConfig, ReplayMetrics,
    Store, TableError, Tables, describe_table, serve, update_priorities,
};
use getup_telemetry::{Registry, Shutdown, Waits};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::sync::Arc;
use std::time::Duration;
use tempfile::TempDir;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tonic::{Code, Status};

const STEPS: usize = 8;

fn filled(store: &Store, sequences: std::ops::RangeInclusive<u64>) {
    store.append(sequences.map(|i| segment(&spec(STEPS), 1, i, STEPS)).collect()).unwrap();
}

/// Which transitions these are, as sequence number and step: the fixtures' values say so.
fn origins(minibatch: &Minibatch) -> Vec<(u64, usize)> {
    let observations = &minibatch.column("observation").unwrap().data;
    let origin = |observation: &[f32]| {
        let all = (1..=60).flat_map(|sequence| (0..STEPS).map(move |step| (sequence, step)));
        let is = |&(sequence, step): &(u64, usize)| observation[0] == value(1, 0, sequence, step, 0, 0);
        let mut found = all.filter(is);
        found.next().unwrap()
    };
    observations.chunks(3).map(origin).collect()
}

#[test]
fn a_queue_hands_out_each_transition_once_in_order_and_waits_on_both_sides() {
    // At most 64 transitions ahead of whoever takes them.
    let queue = ReplayConfig {
        sampler: ItemSelector::Fifo,
        max_times_sampled: Some(1),
        samples_per_insert: Some(1.0),
        error_buffer: Some(64.0),
        ..config()
    };
    let replay = Replay::start(spec(STEPS), &queue);
    let mut writer = replay.writer(1);
    let sending = replay.runtime.spawn(async move {
        for sequence in 1..=50 {
            writer.send(&segment(&spec(STEPS), 1, sequence, STEPS)).await.unwrap();
        }
        writer.acknowledged(50).await.unwrap();
    });
    eventually("the writer waits", || replay.waiting().starts_with("writer waits"));
    eventually("what came before is durable", || replay.store.counters().env_steps == 64);
    let mut source = replay.source(options(16), 2);
    let mut taken = Vec::new();
    for _ in 0..25 {
        taken.extend(origins(&source.next().unwrap()));
    }
    let all = (1..=50).flat_map(|sequence| (0..STEPS).map(move |step| (sequence, step)));
    assert_eq!(taken, all.collect::<Vec<_>>());
    replay.runtime.block_on(async { tokio::time::timeout(PATIENCE, sending).await }).unwrap().unwrap();
    // Everything was taken.
    assert!(source.poll(Duration::from_millis(100)).unwrap().is_none());
    eventually("the sampler waits", || replay.waiting().contains("0 of 16 transitions can be sampled"));
}

#[test]
fn a_batch_that_a_full_store_might_never_have_the_draws_for_is_refused() {
    let dir = TempDir::new().unwrap();
    let times = |max_times_sampled| ReplayConfig { max_times_sampled, capacity: 64, ..config() };
    let store = open(dir.path(), &spec(STEPS), &times(Some(2))).unwrap();
    // Of single steps it holds 40, for their rows take all the memory.
    for sequence in 1..=200 {
        store.append(vec![segment(&spec(STEPS), 1, sequence, 1)]).unwrap();
    }
    assert_eq!(store.len(), 40);
    let refused = store.check_options(&options(2 * 64)).unwrap_err().to_string();
    for named in ["a batch of 128", "replay.capacity 64", "replay.max_times_sampled is 2", "take 74 or less"]
    {
        assert!(refused.contains(named), "{refused}");
    }
    // After the longest segment they may be 37: see the ring.
    assert!(store.check_options(&options(2 * 37 + 1)).is_err());
    store.check_options(&options(2 * 37)).unwrap();
    assert!(store.try_sample(&mut ChaCha8Rng::seed_from_u64(1), &options(2 * 37)).unwrap().is_some());
    drop(store);
    // Without a limit any batch comes.
    open(dir.path(), &spec(STEPS), &times(None)).unwrap().check_options(&options(1_000)).unwrap();
}

#[test]
fn lifo_hands_out_the_newest() {
    let dir = TempDir::new().unwrap();
    let newest =
        ReplayConfig { sampler: ItemSelector::Lifo, max_times_sampled: Some(1), capacity: 100, ..config() };
    let store = open(dir.path(), &spec(STEPS), &newest).unwrap();
    let mut draws = ChaCha8Rng::seed_from_u64(1);
    filled(&store, 1..=40);
    let mut taken = origins(&store.try_sample(&mut draws, &options(10)).unwrap().unwrap());
    filled(&store, 41..=41);
    taken.extend(origins(&store.try_sample(&mut draws, &options(8)).unwrap().unwrap()));
    let down = |sequence| (0..STEPS).rev().map(move |step| (sequence, step));
    let expected: Vec<_> = down(40).chain(down(39)).take(10).chain(down(41)).collect();
    assert_eq!(taken, expected);
}

#[test]
fn priorities_move_the_draws_and_weights_make_up_for_them() {
    let prioritized = ReplayConfig { sampler: ItemSelector::Prioritized { exponent: 1.0 }, ..config() };
    let replay = Replay::start(spec(STEPS), &prioritized);
    filled(&replay.store, 1..=10);
    let mut source = replay.source(options(64), 2);
    let first = source.next().unwrap();
    // All have the same priority at first.
    assert!(first.items.iter().all(|item| (item.probability - 1.0 / 80.0).abs() < 1e-6));
    assert!(first.importance_weights(0.4).iter().all(|&weight| weight == 1.0));
    // Keys say which transition it is.
    let keys: Vec<u64> =
        origins(&first).iter().map(|&(i, step)| (i - 1) * STEPS as u64 + step as u64).collect();
    assert_eq!(first.items.iter().map(|item| item.key).collect::<Vec<_>>(), keys);

    // Of the transitions 0 to 79, number 10 is worth as much as nine, and all after 19 nothing.
    let priorities: Vec<(u64, f32)> = (0..80)
        .map(|key| {
            (
                key,
                if key == 10 {
                    9.0
                } else if key < 20 {
                    1.0
                } else {
                    0.0
                },
            )
        })
        .collect();
    let update = |priorities: &[(u64, f32)]| {
        replay.runtime.block_on(update_priorities(&replay.endpoint, "", priorities))
    };
    assert_eq!(update(&priorities).unwrap(), 80);
    assert_eq!(update(&[(80, 1.0), (u64::MAX, 1.0)]).unwrap(), 0);
    let refused = update(&[(0, 0.5), (1, f32::NAN)]).unwrap_err();
    assert!(refused.message().contains("priority of transition 1 is NaN"), "{refused}");

    let mut draws = ChaCha8Rng::seed_from_u64(3);
    let mut counts = [0.0_f64; 80];
    for _ in 0..400 {
        let minibatch = replay.store.try_sample(&mut draws, &options(64)).unwrap().unwrap();
        let weights = minibatch.importance_weights(1.0);
        for (item, weight) in minibatch.items.iter().zip(weights) {
            counts[item.key as usize] += 1.0;
            let expected = if item.key == 10 { 9.0 / 28.0 } else { 1.0 / 28.0 };
            assert!((item.probability - expected).abs() < 1e-6, "{item:?}");
            assert!((weight - if item.key == 10 { 1.0 / 9.0 } else { 1.0 }).abs() < 1e-6);
        }
    }
    let draws = 400.0 * 64.0;
    let chi_square: f64 = (0..20)
        .map(|key| {
            let expected = draws * if key == 10 { 9.0 } else { 1.0 } / 28.0;
            (counts[key] - expected).powi(2) / expected
        })
        .sum();
    // 19 degrees of freedom: above 50 once in eight thousand seeds.
    assert!(chi_square < 50.0, "{chi_square}");
    assert_eq!(counts[20..], [0.0; 60]);
}

#[test]
fn keys_are_the_same_after_a_restart_and_after_evictions() {
    let dir = TempDir::new().unwrap();
    let settings =
        ReplayConfig { sampler: ItemSelector::Prioritized { exponent: 0.6 }, capacity: 100, ..config() };
    let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
    filled(&store, 1..=60);
    drop(store);
    let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
    let minibatch = store.try_sample(&mut ChaCha8Rng::seed_from_u64(1), &options(50)).unwrap().unwrap();
    for (item, (sequence, step)) in minibatch.items.iter().zip(origins(&minibatch)) {
        assert_eq!(item.key, (sequence - 1) * STEPS as u64 + step as u64);
    }
    // Evicted long ago, the oldest that is there, and one that is to come.
    let oldest = 480 - store.len() as u64;
    assert_eq!(
        store.update_priorities(&[(0, 1.0), (oldest - 1, 1.0), (oldest, 1.0), (480, 1.0)]).unwrap(),
        1
    );
}

#[test]
fn tables_of_one_service_know_nothing_of_each_other() {
    let (default, other) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    let process = Waits::new(&Registry::new());
    let store = |dir: &TempDir, spec: &RunSpec, settings: &ReplayConfig| {
        let metrics = ReplayMetrics::new(&Registry::new());
        Arc::new(Store::open(dir.path(), spec, settings, metrics, process.clone()).unwrap())
    };
    // Of another spec, sampler and limit.
    let queue = ReplayConfig { sampler: ItemSelector::Fifo, max_times_sampled: Some(1), ..config() };
    let (plain, queue) = (store(&default, &spec(STEPS), &config()), store(&other, &get_up_spec(), &queue));
    let tables = Tables::from(plain.clone()).with("queue", queue.clone()).unwrap();
    assert!(matches!(tables.clone().with("queue", queue.clone()), Err(TableError::Duplicate(_))));
    let runtime = Runtime::new().unwrap();
    let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
    let endpoint = listener.local_addr().unwrap().to_string();
    let shutdown = Shutdown::new();
    let serving = runtime.spawn(serve(listener, tables, shutdown.clone()));

    // The same writer's first segment goes to both.
    let append = |table: &str, spec: &RunSpec, steps| {
        let hello = v1::AppendHello {
            spec: Some(spec.to_wire()),
            writer: 1,
            name: "actor".to_owned(),
            table: table.to_owned(),
        };
        let messages = [Message::Hello(hello), common::message(&segment(spec, 1, 1, steps))];
        let requests =
            messages.map(|message| v1::AppendRequest { message: Some(message), ..Default::default() });
        runtime.block_on(async {
            let mut client = ReplayClient::connect(format!("http://{endpoint}")).await.unwrap();
            let mut replies = client.append(tokio_stream::iter(requests)).await?.into_inner();
            while replies.message().await?.is_some() {}
            Ok::<_, Status>(())
        })
    };
    append("", &spec(STEPS), STEPS).unwrap();
    append("queue", &get_up_spec(), 64).unwrap();
    assert_eq!((plain.len(), queue.len()), (STEPS, 64));
    let refused = append("queue", &spec(STEPS), STEPS).unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition, "{refused}");
    let unknown = append("que", &spec(STEPS), STEPS).unwrap_err();
    assert_eq!(unknown.code(), Code::NotFound);
    assert!(unknown.message().contains("no table `que` here, but default, queue"), "{unknown}");

    let described = runtime.block_on(describe_table(&endpoint, "queue")).unwrap();
    assert_eq!((described.size, described.tables), (64, vec!["default".to_owned(), "queue".to_owned()]));
    let options = RemoteOptions {
        spec: get_up_spec(),
        sample: options(32),
        name: "learner".to_owned(),
        table: "queue".to_owned(),
        prefetch: 2,
    };
    let waits = Waits::new(&Registry::new());
    let mut source = RemoteSource::new(&endpoint, options, runtime.handle(), waits, shutdown.clone());
    let taken: Vec<u64> = (0..2).flat_map(|_| source.next().unwrap().items).map(|item| item.key).collect();
    assert_eq!(taken, (0..64).collect::<Vec<_>>());
    assert!(source.poll(Duration::from_millis(50)).unwrap().is_none());
    assert_eq!((plain.counters().sampled, queue.counters().sampled), (0, 64));

    let waiting =
        |table| runtime.block_on(describe_table(&endpoint, table)).unwrap().limiter.unwrap().waiting;
    eventually("the queue's sampler waits", || waiting("queue").starts_with("sampler waits"));
    assert_eq!(waiting("default"), "");
    shutdown.trigger();
    runtime.block_on(serving).unwrap().unwrap();
}
