use super::*;
use crate::fixtures;
use proptest::prelude::*;
use std::collections::HashSet;

fn limiter(min_size: u64, samples_per_insert: Option<f64>, error_buffer: Option<f64>) -> Limiter {
    let config = ReplayConfig { min_size, samples_per_insert, error_buffer, ..ReplayConfig::default() };
    Limiter::new(&config, &fixtures::spec(4))
}

#[test]
fn no_reachable_state_blocks_both_sides_or_leaves_the_band() {
    for (min_size, samples_per_insert, batch) in [(1, 0.5, 2), (5, 1.0, 4), (7, 3.0, 12), (8, 0.25, 1)] {
        let buffer = f64::max(samples_per_insert * 4.0, batch as f64);
        let start = limiter(min_size, Some(samples_per_insert), Some(buffer));
        let (_, min, max) = start.band().unwrap();
        let mut reached = HashSet::new();
        let mut open = vec![start];
        while let Some(state) = open.pop() {
            if state.inserts > 60 || !reached.insert((state.inserts, state.samples)) {
                continue;
            }
            let cursor = state.cursor();
            assert!(cursor <= max && (state.inserts < min_size || cursor >= min), "{state:?}");
            let mut moved = false;
            for env_steps in 1..=4 {
                if state.blocks_insert(env_steps).is_none() {
                    let mut next = state.clone();
                    next.insert(env_steps);
                    open.push(next);
                    moved |= env_steps == 4;
                }
            }
            if state.blocks_sample(batch).is_none() {
                let mut next = state.clone();
                next.sample(batch);
                open.push(next);
                moved = true;
            }
            assert!(moved, "both sides wait: {state:?}");
        }
        assert!(reached.len() > 60);
    }
}

proptest! {
    #[test]
    fn the_cursor_stays_in_its_band_and_somebody_can_always_go_on(
        min_size in 1u64..2000,
        samples_per_insert in 0.01f64..512.0,
        batch in 1u64..2048,
        slack in 0.0f64..1e4,
        choices in prop::collection::vec((any::<bool>(), 0u64..=4), 1..400),
    ) {
        let buffer = f64::max(samples_per_insert * 4.0, batch as f64) + slack;
        let mut limiter = limiter(min_size, Some(samples_per_insert), Some(buffer));
        let (_, min, max) = limiter.band().unwrap();
        let tolerance = 1e-9 * (limiter.inserts as f64 * samples_per_insert + buffer);
        for (sample, env_steps) in choices {
            let (insert_waits, sample_waits) = (limiter.blocks_insert(4), limiter.blocks_sample(batch));
            prop_assert!(insert_waits.is_none() || sample_waits.is_none(), "{limiter:?}");
            if sample && sample_waits.is_none() {
                limiter.sample(batch);
            } else if limiter.blocks_insert(env_steps).is_none() {
                limiter.insert(env_steps);
            }
            let cursor = limiter.cursor();
            prop_assert!(cursor <= max + tolerance);
            prop_assert!(limiter.inserts < min_size || cursor >= min - tolerance);
        }
    }

    #[test]
    fn many_writers_that_reserve_first_stay_within_the_band(
        events in prop::collection::vec((0usize..3, 1u64..=4), 1..300),
    ) {
        let mut limiter = limiter(10, Some(2.0), Some(20.0));
        let (_, _, max) = limiter.band().unwrap();
        let mut under_way = Vec::new();
        for (event, env_steps) in events {
            match event {
                0 if limiter.blocks_insert(env_steps).is_none() => {
                    limiter.reserve(env_steps);
                    under_way.push(env_steps);
                }
                1 if !under_way.is_empty() => {
                    let durable = under_way.remove(0);
                    limiter.insert(durable);
                    limiter.release(durable);
                }
                2 if limiter.blocks_sample(6).is_none() => limiter.sample(6),
                _ => {}
            }
            prop_assert!(limiter.cursor() <= max);
            prop_assert_eq!(limiter.reserved, under_way.iter().sum::<u64>());
        }
    }

    #[test]
    fn a_restart_under_any_settings_leaves_nobody_waiting_for_long(
        inserts in 0u64..1_000_000,
        samples in 0u64..1_000_000_000,
        samples_per_insert in 0.1f64..512.0,
    ) {
        let mut limiter = limiter(1000, Some(samples_per_insert), Some(samples_per_insert * 8.0));
        limiter.restore(inserts, samples);
        prop_assert!(limiter.blocks_insert(4).is_none() || limiter.blocks_sample(4).is_none());
        let (_, min, max) = limiter.band().unwrap();
        let cursor = limiter.cursor();
        prop_assert!(cursor <= max + 1e-3 && (inserts < 1000 || cursor >= min - 1e-3));
        limiter.insert(1000u64.saturating_sub(inserts));
        prop_assert!(limiter.cursor() >= min - 1e-3 && limiter.cursor() <= max + 1e-3, "once samples may be taken");
    }
}

#[test]
fn a_restart_under_the_same_settings_changes_nothing() {
    let mut before = limiter(10, Some(2.0), Some(20.0));
    before.insert(14);
    before.sample(9);
    let mut after = limiter(10, Some(2.0), Some(20.0));
    after.restore(before.inserts, before.samples());
    assert_eq!(after, before);
}

#[test]
fn without_a_ratio_only_the_first_sample_waits() {
    let mut limiter = limiter(1000, None, None);
    limiter.insert(812);
    assert_eq!(limiter.blocks_sample(256).unwrap().to_string(), "812 of 1,000 transitions");
    assert!(limiter.blocks_insert(1 << 40).is_none());
    limiter.insert(188);
    assert!(limiter.blocks_sample(1 << 40).is_none());
}

#[test]
fn limp_steps_never_wait_and_never_count() {
    let mut limiter = limiter(1, Some(1.0), Some(4.0));
    limiter.insert(5);
    assert!(limiter.blocks_insert(1).is_some());
    assert!(limiter.blocks_insert(0).is_none());
}

#[test]
fn one_update_a_step_is_a_setting() {
    let batch = 256;
    let mut limiter = limiter(10, Some(256.0), None);
    limiter.insert(10);
    let mut updates = 0;
    for _ in 0..1000 {
        limiter.insert(1);
        while limiter.blocks_sample(batch).is_none() {
            limiter.sample(batch);
            updates += 1;
        }
    }
    // The band lets the first few updates go ahead; from there on they alternate with the steps.
    assert!((1000..=1000 + 8).contains(&updates), "{updates}");
}

#[test]
fn large_numbers_are_grouped_for_reading() {
    assert_eq!([0, 12, 999, 1000, 1234567].map(thousands), ["0", "12", "999", "1,000", "1,234,567"]);
}
