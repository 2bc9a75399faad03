//! One suite of assertions for both ways to sample: in the same process, and over gRPC.

use crate::common::{Replay, config, eventually, options};
use crate::fixtures::{Ending, Part, segment, spec, value};
use getup_proto::columns;
use getup_replay::{
    LocalSource, Minibatch, MinibatchSource, RemoteOptions, RemoteSource, ReplayConfig, ReplayMetrics,
    SampleError, SampleOptions, Store, serve,
};
use getup_telemetry::{Registry, Shutdown, Waits};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::net::TcpListener;

/// How to get a source from a replay.
type Connect = fn(&Replay, SampleOptions) -> Result<Box<dyn MinibatchSource>, SampleError>;

fn local(replay: &Replay, options: SampleOptions) -> Result<Box<dyn MinibatchSource>, SampleError> {
    let source = LocalSource::new(replay.store.clone(), options, "learner", replay.shutdown.clone())?;
    Ok(Box::new(source))
}

fn remote(replay: &Replay, sample: SampleOptions) -> Result<Box<dyn MinibatchSource>, SampleError> {
    Ok(Box::new(replay.source(sample, 4)))
}

macro_rules! both_sources {
    ($($name:ident)*) => {
        mod in_process { $(#[test] fn $name() { super::$name(super::local) })* }
        mod over_grpc { $(#[test] fn $name() { super::$name(super::remote) })* }
    };
}

both_sources! {
    minibatches_hold_whole_transitions_of_what_was_appended
    n_step_returns_span_segments
    whole_segments_come_as_they_were_appended
    counters_come_with_every_minibatch
    the_first_sample_waits_for_the_minimum_and_says_why
    sampling_waits_for_inserts_and_stays_in_the_band
    options_out_of_range_are_refused
    shutdown_ends_a_wait
}

fn minibatches_hold_whole_transitions_of_what_was_appended(connect: Connect) {
    let replay = Replay::start(spec(8), &config());
    let segments = (1..=20).map(|i| segment(&replay.spec, 1, i, 8)).collect();
    replay.store.append(segments).unwrap();
    let mut source = connect(&replay, options(32)).unwrap();
    for _ in 0..20 {
        let minibatch = source.next().unwrap();
        let names: Vec<_> =
            minibatch.columns.iter().map(|column| (column.name.as_str(), column.width)).collect();
        let expected = [
            ("observation", 3),
            ("action", 2),
            ("reward", 1),
            ("beta", 1),
            ("next_observation", 3),
            ("discount", 1),
        ];
        assert_eq!(names, expected);
        let data = |name: &str| &minibatch.column(name).unwrap().data;
        for i in 0..32 {
            let is_here = |&(episode, step): &(u64, usize)| {
                data("observation")[3 * i] == value(1, 0, episode, step, 0, 0)
                    && data("action")[2 * i + 1] == value(1, 0, episode, step, 1, 1)
                    && data("reward")[i] == value(1, 0, episode, step, 2, 0)
                    && data("beta")[i] == value(1, 0, episode, 0, 3, 0)
                    && data("next_observation")[3 * i + 2] == value(1, 0, episode, step + 1, 0, 2)
                    && data("discount")[i] == 0.99
            };
            let all = (1..=20).flat_map(|episode| (0..8).map(move |step| (episode, step)));
            assert_eq!(all.filter(is_here).count(), 1);
        }
    }
}

fn n_step_returns_span_segments(connect: Connect) {
    let replay = Replay::start(spec(4), &config());
    let part = |sequence, first_step, ending| Part {
        writer: 1,
        sequence,
        lane: 0,
        episode: 0,
        first_step,
        steps: 4,
        ending,
    };
    for (sequence, first_step, ending) in
        [(1, 0, Ending::None), (2, 4, Ending::None), (3, 8, Ending::Terminal)]
    {
        replay.store.append(vec![part(sequence, first_step, ending).build(&replay.spec)]).unwrap();
    }
    let mut source = connect(&replay, SampleOptions { n_step: 5, gamma: 0.5, ..options(64) }).unwrap();
    let minibatch = source.next().unwrap();
    let data = |name: &str| &minibatch.column(name).unwrap().data;
    for i in 0..64 {
        let step = (0..12).find(|&t| data("observation")[3 * i] == value(1, 0, 0, t, 0, 0)).unwrap();
        let end = (step + 5).min(12);
        let reward: f32 = (step..end).map(|t| 0.5f32.powi((t - step) as i32) * value(1, 0, 0, t, 2, 0)).sum();
        assert!((data("reward")[i] - reward).abs() < 1e-6);
        assert_eq!(data("discount")[i], if end == 12 { 0.0 } else { 0.5f32.powi(5) });
        assert_eq!(data("next_observation")[3 * i], value(1, 0, 0, end, 0, 0));
    }
}

fn whole_segments_come_as_they_were_appended(connect: Connect) {
    let replay = Replay::start(spec(8), &config());
    let lengths = [8, 3, 1, 5];
    let appended: Vec<_> =
        lengths.iter().zip(1..).map(|(&steps, sequence)| segment(&replay.spec, 1, sequence, steps)).collect();
    replay.store.append(appended.clone()).unwrap();
    let mut source = connect(&replay, SampleOptions { segments: true, ..options(64) }).unwrap();
    let minibatch = source.next().unwrap();
    assert_eq!((minibatch.segments.len(), minibatch.counters.sampled), (64, 64));
    assert!(minibatch.column("discount").is_none());
    let mut rows = vec![0; minibatch.columns.len()];
    let mut seen = [0; 4];
    for sampled in &minibatch.segments {
        let index = lengths.iter().position(|&steps| steps == sampled.steps as usize).unwrap();
        seen[index] += 1;
        let (whole, of_spec) = (&appended[index], &replay.spec.columns);
        assert_eq!((sampled.writer, sampled.lane, sampled.episode), (1, whole.lane, whole.episode));
        assert_eq!((sampled.first_step, sampled.terminal), (whole.first_step, whole.terminal));
        for ((column, bytes), row) in minibatch.columns.iter().zip(&whole.columns).zip(&mut rows) {
            let values: Vec<f32> = columns::iter(bytes).collect();
            assert_eq!(&column.data[*row..*row + values.len()], values, "{} of segment {index}", column.name);
            *row += values.len();
        }
        assert_eq!(of_spec.len(), minibatch.columns.len());
    }
    // All is accounted for, and the longer a segment the more often it is drawn.
    assert!(minibatch.columns.iter().zip(&rows).all(|(column, row)| column.data.len() == *row));
    assert!(seen[0] > seen[2], "{seen:?}");
    // A batch that a message holds as transitions may be too large as segments.
    let fits =
        |segments, batch| replay.store.check_options(&SampleOptions { segments, ..options(batch) }).is_ok();
    assert!(fits(false, 500_000) && !fits(true, 500_000), "segments of 9 rows, transitions of 2");
}

fn counters_come_with_every_minibatch(connect: Connect) {
    let replay = Replay::start(spec(8), &config());
    let mut limp = segment(&replay.spec, 1, 1, 8);
    limp.env_steps = 3;
    replay.store.append(vec![limp]).unwrap();
    let mut source = connect(&replay, options(16)).unwrap();
    for round in 1..=10 {
        let counters = source.next().unwrap().counters;
        assert_eq!((counters.env_steps, counters.transitions, counters.episodes), (3, 8, 0));
        assert_eq!((counters.store, counters.sampled), (replay.store.counters().store, round * 16));
    }
}

fn the_first_sample_waits_for_the_minimum_and_says_why(connect: Connect) {
    let replay = Replay::start(spec(8), &ReplayConfig { min_size: 1000, ..config() });
    replay.store.introduce(1, "actor-3");
    let waiting = {
        let mut source = connect(&replay, options(16)).unwrap();
        std::thread::spawn(move || source.next())
    };
    for sequence in 1..=100 {
        replay.store.append(vec![segment(&replay.spec, 1, sequence, 8)]).unwrap();
    }
    let mut seen = Vec::new();
    eventually("the wait names the minimum and who is silent", || {
        seen = replay.waits.current().into_iter().map(|wait| wait.to_string()).collect();
        seen.iter().any(|text| text.contains("800 of 1,000 transitions; actor-3 silent for "))
    });
    assert!(!waiting.is_finished());
    for sequence in 101..=125 {
        replay.store.append(vec![segment(&replay.spec, 1, sequence, 8)]).unwrap();
    }
    let minibatch = waiting.join().unwrap().unwrap();
    assert_eq!(minibatch.counters.env_steps, 1000);
    eventually("nobody waits", || replay.waits.current().is_empty());
}

fn sampling_waits_for_inserts_and_stays_in_the_band(connect: Connect) {
    let paced =
        ReplayConfig { min_size: 16, samples_per_insert: Some(2.0), error_buffer: Some(32.0), ..config() };
    let replay = Replay::start(spec(8), &paced);
    let mut source = connect(&replay, options(8)).unwrap();
    let (mut taken, mut sequence) = (0, 0);
    for _ in 0..40 {
        while replay.store.can_insert(4) {
            sequence += 1;
            replay.store.append(vec![segment(&replay.spec, 1, sequence, 4)]).unwrap();
        }
        while source.poll(Duration::from_millis(100)).unwrap().is_some() {
            taken += 8;
            let counters = replay.store.counters();
            let cursor = counters.env_steps as f64 * 2.0 - counters.sampled as f64;
            assert!((0.0..=64.0).contains(&cursor), "{counters:?}");
            if replay.store.can_insert(4) && taken % 64 == 0 {
                break;
            }
        }
    }
    let counters = replay.store.counters();
    assert!(counters.env_steps > 100, "{counters:?}");
    let ratio = counters.sampled as f64 / counters.env_steps as f64;
    assert!((1.6..=2.1).contains(&ratio), "{ratio}");
}

fn options_out_of_range_are_refused(connect: Connect) {
    let paced =
        ReplayConfig { min_size: 16, samples_per_insert: Some(2.0), error_buffer: Some(32.0), ..config() };
    let replay = Replay::start(spec(8), &paced);
    let refused = |options| {
        let outcome = connect(&replay, options).and_then(|mut source| source.next());
        outcome.expect_err("the options are out of range").to_string()
    };
    assert!(refused(options(0)).contains("a batch of 0"));
    assert!(refused(options(33)).contains("raise it to the batch"));
    assert!(refused(options(1 << 30)).contains("so that a message holds it"));
    assert!(refused(SampleOptions { n_step: 0, ..options(8) }).contains("n_step is 0"));
    assert!(refused(SampleOptions { gamma: 1.5, ..options(8) }).contains("gamma is 1.5"));
    assert!(refused(SampleOptions { gamma: f32::NAN, ..options(8) }).contains("gamma is NaN"));
}

fn shutdown_ends_a_wait(connect: Connect) {
    let replay = Replay::start(spec(8), &config());
    let mut source = connect(&replay, options(8)).unwrap();
    assert!(source.poll(Duration::from_millis(50)).unwrap().is_none());
    let waiting = std::thread::spawn(move || source.next());
    std::thread::sleep(Duration::from_millis(50));
    let started = Instant::now();
    let (result, _) = replay.stop();
    result.unwrap();
    assert!(matches!(waiting.join().unwrap(), Err(SampleError::Shutdown)));
    assert!(started.elapsed() < Duration::from_secs(3));
}

#[test]
fn a_remote_source_waits_for_the_service_and_comes_back_after_its_restart_with_other_draws() {
    let dir = tempfile::TempDir::new().unwrap();
    let (registry, shutdown) = (Registry::new(), Shutdown::new());
    let waits = Waits::new(&registry);
    let metrics = ReplayMetrics::new(&registry);
    let store = Arc::new(Store::open(dir.path(), &spec(8), &config(), metrics, waits.clone()).unwrap());
    store.append((1..=100).map(|i| segment(&spec(8), 1, i, 8)).collect()).unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let bind = |address: &str| runtime.block_on(TcpListener::bind(address)).unwrap();
    let endpoint = bind("127.0.0.1:0").local_addr().unwrap().to_string();

    let options = RemoteOptions {
        spec: spec(8),
        sample: options(32),
        name: "learner".to_owned(),
        table: String::new(),
        prefetch: 1,
    };
    let mut source = RemoteSource::new(&endpoint, options, runtime.handle(), waits.clone(), shutdown);
    assert!(source.poll(Duration::from_millis(200)).unwrap().is_none());
    let mut drawn: Vec<Minibatch> = Vec::new();
    for _ in 0..3 {
        let ends = Shutdown::new();
        let serving = runtime.spawn(serve(bind(&endpoint), store.clone(), ends.clone()));
        drawn.extend((0..3).map(|_| source.next().unwrap()));
        ends.trigger();
        runtime.block_on(serving).unwrap().unwrap();
    }
    let waiting = std::thread::spawn(move || while source.poll(Duration::from_secs(2)).unwrap().is_some() {});
    eventually("the wait names the service", || {
        waits.current().iter().any(|wait| wait.reason.contains(&format!("replay at {endpoint}")))
    });
    waiting.join().unwrap();
    for (i, minibatch) in drawn.iter().enumerate() {
        assert!(drawn[..i].iter().all(|other| other.columns != minibatch.columns), "drawn twice");
    }
}
