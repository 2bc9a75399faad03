//! A store that is closed and opened again goes on as if nothing had happened.

use crate::common::{config, open, options};
use crate::fixtures::{Ending, Part, segment, spec};
use getup_replay::{Minibatch, ReplayConfig, SampleOptions, Store};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tempfile::TempDir;

/// Minibatches of the store, drawn from a fixed seed.
fn drawn(store: &Store, count: usize) -> Vec<Minibatch> {
    let mut draws = ChaCha8Rng::seed_from_u64(11);
    let options = SampleOptions { n_step: 3, ..options(64) };
    (0..count).map(|_| store.try_sample(&mut draws, &options).unwrap().unwrap()).collect()
}

#[test]
fn ring_counters_limiter_and_marks_are_the_same_after_a_restart() {
    let dir = TempDir::new().unwrap();
    let spec = spec(8);
    // Small enough to evict most, with n-step links across what is kept.
    let paced = ReplayConfig {
        capacity: 200,
        min_size: 50,
        samples_per_insert: Some(1.0),
        error_buffer: Some(2000.0),
        ..config()
    };
    let store = open(dir.path(), &spec, &paced).unwrap();
    let mut sequence = 0;
    for episode in 0..12 {
        for first_step in (0..40).step_by(8) {
            sequence += 1;
            let ending = if first_step == 32 { Ending::Terminal } else { Ending::None };
            let part = Part { writer: 4, sequence, lane: 2, episode, first_step, steps: 8, ending };
            let mut segment = part.build(&spec);
            segment.env_steps = 5;
            store.append(vec![segment]).unwrap();
        }
    }
    drawn(&store, 3);
    let (counters, size) = (store.counters(), store.len());
    assert_eq!(
        (counters.env_steps, counters.transitions, counters.episodes, counters.sampled),
        (300, 480, 12, 192)
    );
    drop(store);

    let store = open(dir.path(), &spec, &paced).unwrap();
    assert_eq!((store.counters(), store.len()), (counters, size));
    let limiter = store.describe().limiter.unwrap();
    assert_eq!(limiter.cursor, 300.0 - 192.0);
    assert_eq!(store.introduce(4, "actor"), 60);
    let first = drawn(&store, 5);
    drop(store);
    let store = open(dir.path(), &spec, &paced).unwrap();
    let columns =
        |minibatches: Vec<Minibatch>| minibatches.into_iter().map(|m| m.columns).collect::<Vec<_>>();
    assert_eq!(columns(drawn(&store, 5)), columns(first));
}

#[test]
fn a_ring_rebuilt_from_the_log_equals_the_one_that_was_never_lost() {
    let spec = spec(8);
    let small = ReplayConfig { capacity: 300, ..config() };
    let (restarted, kept) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    let never = open(kept.path(), &spec, &small).unwrap();
    let mut sequence = 0;
    for round in 0..6 {
        let store = open(restarted.path(), &spec, &small).unwrap();
        for steps in [8, 3, 5, 1, 8, 8, 2].into_iter().cycle().take(17 + round) {
            sequence += 1;
            store.append(vec![segment(&spec, 1, sequence, steps)]).unwrap();
            never.append(vec![segment(&spec, 1, sequence, steps)]).unwrap();
        }
        assert_eq!(store.len(), never.len());
        let columns = |store: &Store| drawn(store, 3).into_iter().map(|m| m.columns).collect::<Vec<_>>();
        assert_eq!(columns(&store), columns(&never));
    }
}

#[test]
fn a_segment_whose_first_copy_was_evicted_is_not_stored_again_also_after_a_restart() {
    let dir = TempDir::new().unwrap();
    let spec = spec(8);
    let small = ReplayConfig { capacity: 64, ..config() };
    let store = open(dir.path(), &spec, &small).unwrap();
    for sequence in 1..=200 {
        store.append(vec![segment(&spec, 1, sequence, 8)]).unwrap();
    }
    store.append(vec![segment(&spec, 1, 1, 8)]).unwrap();
    drop(store);
    let store = open(dir.path(), &spec, &small).unwrap();
    store.append(vec![segment(&spec, 1, 2, 8), segment(&spec, 1, 200, 8)]).unwrap();
    assert_eq!(store.counters().transitions, 1600);
    store.append(vec![segment(&spec, 1, 201, 8)]).unwrap();
    assert_eq!(store.counters().transitions, 1608);
}

#[test]
fn a_writer_may_leave_gaps_in_its_sequence() {
    let dir = TempDir::new().unwrap();
    let store = open(dir.path(), &spec(8), &config()).unwrap();
    for sequence in [500, 502, 900] {
        store.append(vec![segment(&spec(8), 1, sequence, 8)]).unwrap();
    }
    assert_eq!((store.counters().transitions, store.introduce(1, "actor")), (24, 900));
}

#[test]
fn one_thread_can_insert_and_sample_in_a_fixed_order() {
    let run = || {
        let dir = TempDir::new().unwrap();
        let paced =
            ReplayConfig { min_size: 8, samples_per_insert: Some(8.0), error_buffer: Some(64.0), ..config() };
        let store = open(dir.path(), &spec(4), &paced).unwrap();
        let mut draws = ChaCha8Rng::seed_from_u64(2);
        let mut columns = Vec::new();
        for sequence in 1..=50 {
            assert!(store.can_insert(4));
            store.append(vec![segment(&spec(4), 1, sequence, 4)]).unwrap();
            while store.can_sample(16) {
                columns.push(store.try_sample(&mut draws, &options(16)).unwrap().unwrap().columns);
            }
        }
        columns
    };
    let first = run();
    assert!(first.len() > 90, "{}", first.len());
    assert_eq!(run(), first);
}
