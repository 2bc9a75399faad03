//! Stores that the segments of the lowest priority leave first.

use crate::common::{config, open, options};
use crate::fixtures::{Ending, Part, get_up_spec, segment, spec, value};
use getup_replay::{
    Item, ItemSelector, Minibatch, Remover, ReplayConfig, Store, StoreError, Survey, compact, segments,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::HashMap;
use std::path::Path;
use tempfile::TempDir;

const STEPS: usize = 8;

fn lowest_priority(capacity: usize, window: u32) -> ReplayConfig {
    ReplayConfig {
        capacity,
        sampler: ItemSelector::Prioritized { exponent: 1.0 },
        remover: Remover::LowestPriority { window },
        ..config()
    }
}

/// Sequence numbers in the log of a closed store, whose one writer left no gap.
fn logged(dir: &Path) -> Vec<u64> {
    segments(dir).unwrap().1.map(|segment| segment.unwrap().sequence).collect()
}

/// Which of so many transitions are there: those that can be given a priority. They are given this one.
fn there(store: &Store, transitions: u64, priority: impl Fn(u64) -> f32) -> Vec<u64> {
    let is_there = |&key: &u64| store.update_priorities(&[(key, priority(key))]).unwrap() == 1;
    (0..transitions).filter(is_there).collect()
}

fn keys(sequences: impl IntoIterator<Item = u64>) -> Vec<u64> {
    let of = |sequence: u64| (sequence - 1) * STEPS as u64..sequence * STEPS as u64;
    sequences.into_iter().flat_map(of).collect()
}

#[test]
fn every_transition_is_drawn_as_it_was_appended_also_after_thousands_have_left_between_others() {
    let dir = TempDir::new().unwrap();
    let spec = spec(STEPS);
    let store = open(dir.path(), &spec, &lowest_priority(1000, 4)).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut draws = ChaCha8Rng::seed_from_u64(2);
    // Of each key, the segment and the step.
    let mut origins: HashMap<u64, (u64, usize)> = HashMap::new();
    let mut oldest_drawn = 0;
    for group in 0..400 {
        let (mut appended, mut priorities) = (Vec::new(), Vec::new());
        for sequence in 10 * group + 1..=10 * group + 10 {
            let steps = rng.random_range(1..=STEPS);
            for step in 0..steps {
                let key = origins.len() as u64;
                origins.insert(key, (sequence, step));
                // One segment in ten stays worth more than others.
                priorities.push((key, if sequence % 10 == 0 { 4.0 } else { rng.random_range(0.0..1.0) }));
            }
            appended.push(segment(&spec, 1, sequence, steps));
        }
        store.append(appended).unwrap();
        assert!(store.len() <= 1000);
        assert_eq!(store.update_priorities(&priorities).unwrap(), priorities.len() as u64);
        let minibatch = store.try_sample(&mut draws, &options(64)).unwrap().unwrap();
        let column = |name: &str| minibatch.column(name).unwrap();
        for (i, item) in minibatch.items.iter().enumerate() {
            let (sequence, step) = origins[&item.key];
            let expected = |step, column, width| -> Vec<f32> {
                (0..width).map(|place| value(1, 0, sequence, step, column, place)).collect()
            };
            assert_eq!(column("observation").data[3 * i..3 * i + 3], expected(step, 0, 3));
            assert_eq!(column("action").data[2 * i..2 * i + 2], expected(step, 1, 2));
            assert_eq!(column("reward").data[i..=i], expected(step, 2, 1));
            assert_eq!(column("beta").data[i..=i], expected(0, 3, 1));
            assert_eq!(column("next_observation").data[3 * i..3 * i + 3], expected(step + 1, 0, 3));
            oldest_drawn = oldest_drawn.max(origins.len() as u64 - item.key);
        }
    }
    // First in, first out, nothing older than the capacity would be drawn; and nothing is that is older than the window.
    assert!((3000..=4000).contains(&oldest_drawn), "{oldest_drawn}");
}

#[test]
fn draws_follow_the_priorities_of_what_is_left() {
    let dir = TempDir::new().unwrap();
    let store = open(dir.path(), &spec(STEPS), &lowest_priority(160, 8)).unwrap();
    let append = |sequences: std::ops::RangeInclusive<u64>| {
        store.append(sequences.map(|i| segment(&spec(STEPS), 1, i, STEPS)).collect()).unwrap();
    };
    append(1..=20);
    // Odd segments are worth something, and even ones nothing.
    let worth = |key: u64| if (key / STEPS as u64).is_multiple_of(2) { 0.2 + (key % 5) as f32 } else { 0.0 };
    store.update_priorities(&(0..160).map(|key| (key, worth(key))).collect::<Vec<_>>()).unwrap();
    append(21..=30);
    let mut priorities: HashMap<u64, f32> =
        keys((1..=20).step_by(2)).into_iter().map(|key| (key, worth(key))).collect();
    // New ones have the greatest priority that was given.
    priorities.extend(keys(21..=30).into_iter().map(|key| (key, 4.2)));
    assert_eq!((store.len(), priorities.len()), (160, 160));

    let total: f32 = priorities.values().sum();
    let mut counts: HashMap<u64, f32> = HashMap::new();
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let draws = 400 * 64;
    for _ in 0..400 {
        for Item { key, probability } in store.try_sample(&mut rng, &options(64)).unwrap().unwrap().items {
            assert!((probability - priorities[&key] / total).abs() < 1e-6, "transition {key}");
            *counts.entry(key).or_default() += 1.0;
        }
    }
    let chi_square: f32 = priorities
        .iter()
        .map(|(key, priority)| {
            let expected = draws as f32 * priority / total;
            (counts.get(key).unwrap_or(&0.0) - expected).powi(2) / expected
        })
        .sum();
    // 159 degrees of freedom: above 235 once in ten thousand seeds.
    assert!(chi_square < 235.0, "{chi_square}");
}

#[test]
fn what_was_removed_stays_in_the_log_for_its_window_and_a_restart_begins_with_the_newest() {
    let dir = TempDir::new().unwrap();
    let settings = lowest_priority(80, 4);
    let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
    let append = |store: &Store, sequences: std::ops::RangeInclusive<u64>| {
        for i in sequences {
            store.append(vec![segment(&spec(STEPS), 1, i, STEPS)]).unwrap();
        }
    };
    append(&store, 1..=10);
    // The first five are the best.
    assert_eq!(there(&store, 80, |key| if key < 40 { 2.0 } else { 0.5 }), keys(1..=10));
    append(&store, 11..=15);
    assert_eq!(there(&store, 120, |_| 2.0), keys((1..=5).chain(11..=15)));
    assert_eq!((store.len(), store.counters().transitions, store.counters().held), (80, 120, 80));
    drop(store);
    assert_eq!(logged(dir.path()), (1..=15).collect::<Vec<_>>());

    // Priorities are forgotten: the newest are there, under the same keys.
    let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
    assert_eq!(there(&store, 120, |_| 1.0), keys(6..=15));
    let minibatch = store.try_sample(&mut ChaCha8Rng::seed_from_u64(1), &options(50)).unwrap().unwrap();
    for (item, &observed) in
        minibatch.items.iter().zip(minibatch.column("observation").unwrap().data.iter().step_by(3))
    {
        let (sequence, step) = (item.key / STEPS as u64 + 1, item.key as usize % STEPS);
        assert_eq!(observed, value(1, 0, sequence, step, 0, 0));
        assert!((item.probability - 1.0 / 80.0).abs() < 1e-6);
    }
    // What is worth most leaves with age: nothing is there that the log has not.
    let worth = |key| if (40..80).contains(&key) { 3.0 } else { 1.0 };
    there(&store, 120, worth);
    for i in 16..=100 {
        append(&store, i..=i);
        let held = there(&store, 800, worth);
        let log = logged(dir.path());
        match i {
            // Segments 6 to 10 began after 40 to 72 transitions: 320 later they leave.
            ..=45 => assert_eq!(held, keys((6..=10).chain(i - 4..=i))),
            46..50 => assert_eq!(held, keys((i - 39..=10).chain(i - 4 - (i - 45)..=i))),
            50.. => assert_eq!(held, keys(i - 9..=i)),
        }
        assert!(log.first() <= Some(&(held[0] / STEPS as u64 + 1)), "{held:?} and {log:?}");
        assert_eq!(log.last(), Some(&i));
        // The window, and at most the rest of a file of a sixteenth of it.
        let size = log.len() * STEPS;
        assert!(i < 43 || (320..=320 + 24).contains(&size), "{size} transitions in the log");
    }
}

#[test]
fn tools_see_the_window_and_compacting_keeps_what_it_is_asked_to() {
    let dir = TempDir::new().unwrap();
    let settings = lowest_priority(80, 4);
    let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
    for i in 1..=200 {
        store.append(vec![segment(&spec(STEPS), 1, i, STEPS)]).unwrap();
        there(&store, 40, |_| 5.0);
    }
    let copy = dir.path().join("copy");
    let (_, counters) = store.snapshot(&copy).unwrap();
    assert_eq!((counters.held, counters.transitions), (80, 1600));
    drop(store);
    let held = logged(dir.path());
    let survey = Survey::read(dir.path(), |_| {}).unwrap();
    assert_eq!((survey.damages.len(), survey.segments as usize), (0, held.len()));
    assert!((320..=344).contains(&survey.transitions));
    assert_eq!(logged(&copy), held);
    // All of it, and then the capacity alone.
    for (keep, expected) in [(None, &held[..]), (Some(80), &held[held.len() - 10..])] {
        compact(dir.path(), keep).unwrap();
        assert_eq!(logged(dir.path()), expected);
        let store = open(dir.path(), &spec(STEPS), &settings).unwrap();
        assert_eq!((there(&store, 1600, |_| 1.0), store.counters().transitions), (keys(191..=200), 1600));
    }
    // Another remover takes over, and gives the space back with its first commits.
    let fifo = ReplayConfig { remover: Remover::Fifo, ..settings };
    let store = open(&copy, &spec(STEPS), &fifo).unwrap();
    assert_eq!(there(&store, 1600, |_| 1.0), keys(191..=200));
    for i in 201..=210 {
        store.append(vec![segment(&spec(STEPS), 1, i, STEPS)]).unwrap();
    }
    drop(store);
    assert!(logged(&copy).len() < 18, "{} segments", logged(&copy).len());
}

#[test]
fn an_episode_whose_middle_was_removed_bootstraps_before_the_gap_and_never_across() {
    let dir = TempDir::new().unwrap();
    let store = open(dir.path(), &spec(STEPS), &lowest_priority(24, 8)).unwrap();
    let part = |sequence, first_step, ending| {
        Part { writer: 1, sequence, lane: 0, episode: 0, first_step, steps: 8, ending }.build(&spec(STEPS))
    };
    store
        .append(vec![part(1, 0, Ending::None), part(2, 8, Ending::None), part(3, 16, Ending::Terminal)])
        .unwrap();
    store.update_priorities(&keys([2]).into_iter().map(|key| (key, 0.1)).collect::<Vec<_>>()).unwrap();
    store.append(vec![segment(&spec(STEPS), 2, 1, STEPS)]).unwrap();
    let options = getup_replay::SampleOptions { n_step: 5, ..options(200) };
    let minibatch: Minibatch =
        store.try_sample(&mut ChaCha8Rng::seed_from_u64(3), &options).unwrap().unwrap();
    let (next, discount) =
        (minibatch.column("next_observation").unwrap(), minibatch.column("discount").unwrap());
    let mut seen = [0; 24];
    for (i, item) in minibatch.items.iter().enumerate().filter(|(_, item)| item.key < 24) {
        let step = item.key as usize;
        seen[step] += 1;
        let end = (step + 5).min(if step < 8 { 8 } else { 24 });
        assert_eq!(next.data[3 * i], value(1, 0, 0, end, 0, 0));
        let expected = if end == 24 { 0.0 } else { 0.99_f32.powi((end - step) as i32) };
        assert!(
            (discount.data[i] - expected).abs() < 1e-6,
            "step {step}: {} and not {expected}",
            discount.data[i]
        );
    }
    assert!(seen[..8].iter().chain(&seen[16..]).all(|&count| count > 0) && seen[8..16] == [0; 8], "{seen:?}");
}

#[test]
fn the_disk_is_bounded_by_the_window() {
    let dir = TempDir::new().unwrap();
    let (capacity, window) = (4096, 3);
    let store = open(dir.path(), &get_up_spec(), &lowest_priority(capacity, window)).unwrap();
    let (mut most, mut steady) = (0, 0);
    let mut draws = ChaCha8Rng::seed_from_u64(1);
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    // Ten windows.
    for round in 0..120 {
        store.append((1..=16).map(|i| segment(&get_up_spec(), 1, round * 16 + i, 64)).collect()).unwrap();
        let items = store.try_sample(&mut draws, &options(256)).unwrap().unwrap().items;
        store
            .update_priorities(&items.iter().map(|item| (item.key, rng.random())).collect::<Vec<_>>())
            .unwrap();
        let bytes = store.describe().disk_bytes;
        most = most.max(bytes);
        if round == 30 {
            steady = bytes;
        }
    }
    let values = (capacity * window as usize * 90 * 4) as u64;
    assert!(
        steady > values && 10 * most < 12 * values,
        "{} MB, {} MB for {} MB",
        most >> 20,
        steady >> 20,
        values >> 20
    );
}

#[test]
fn a_store_without_priorities_is_refused() {
    let dir = TempDir::new().unwrap();
    let settings = ReplayConfig { sampler: ItemSelector::Uniform, ..lowest_priority(80, 4) };
    let refused = open(dir.path(), &spec(STEPS), &settings).unwrap_err();
    assert!(matches!(refused, StoreError::Config(_)), "{refused}");
    assert!(!dir.path().join("store.json").exists());
}
