//! Ten times the capacity passes through: memory and disk stay what they were when the store was first full, whichever
//! segments leave.
//!
//! The only test of its process, so that the process' memory is the store's.

mod common;
mod fixtures;

use common::{open, options};
use fixtures::{get_up_spec, segment};
use getup_proto::Segment;
use getup_replay::{ItemSelector, Remover, ReplayConfig};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tempfile::TempDir;

fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    1024 * line.trim().trim_end_matches(" kB").parse::<u64>().unwrap()
}

#[test]
fn memory_and_disk_stay_within_half_more_of_the_steady_state() {
    soak(ReplayConfig::default(), 1);
    let sampler = ItemSelector::Prioritized { exponent: 0.6 };
    let remover = Remover::LowestPriority { window: 2 };
    soak(ReplayConfig { sampler, remover, ..ReplayConfig::default() }, 2);
}

/// With a log of `window` times the capacity.
fn soak(settings: ReplayConfig, window: usize) {
    let capacity = if std::env::var_os("GETUP_TEST_FULL").is_some() { 1_000_000 } else { 50_000 };
    let dir = TempDir::new().unwrap();
    let settings = ReplayConfig { capacity, min_size: 1, ..settings };
    let store = open(dir.path(), &get_up_spec(), &settings).unwrap();
    let mut segments: Vec<Segment> = (1..=16).map(|i| segment(&get_up_spec(), 1, i, 64)).collect();
    let (mut draws, mut rng) = (ChaCha8Rng::seed_from_u64(1), ChaCha8Rng::seed_from_u64(1));
    let (mut steady, mut most) = (None, (0, 0));
    while store.counters().transitions < 11 * capacity as u64 {
        store.append(segments.clone()).unwrap();
        for segment in &mut segments {
            segment.sequence += 16;
            segment.episode += 16;
        }
        let minibatch = store.try_sample(&mut draws, &options(256)).unwrap().unwrap();
        let priorities: Vec<(u64, f32)> =
            minibatch.items.iter().map(|item| (item.key, rng.random())).collect();
        store.update_priorities(&priorities).unwrap();
        // Measuring takes longer than appending.
        let stored = store.counters().transitions;
        if stored.is_multiple_of(8 * 1024)
            && stored > (window * capacity) as u64
            && store.len() > capacity - 2000
        {
            let now = (resident_bytes(), store.describe().disk_bytes);
            steady.get_or_insert(now);
            most = (most.0.max(now.0), most.1.max(now.1));
        }
    }
    let steady = steady.unwrap();
    println!("resident {} MB, at most {}", steady.0 >> 20, most.0 >> 20);
    println!("disk {} MB, at most {}", steady.1 >> 20, most.1 >> 20);
    assert!(2 * most.0 <= 3 * steady.0 && 2 * most.1 <= 3 * steady.1, "{steady:?} has become {most:?}");
    // And the steady state itself is what the transitions need.
    let values = (window * capacity * 90 * 4) as u64;
    assert!(10 * most.1 <= 12 * values + (40 << 20), "{} MB on disk for {} MB", most.1 >> 20, values >> 20);
}
