use super::*;
use crate::config::ReplayConfig;
use crate::fixtures::{self, Ending, Part};
use crate::remover::Remover;
use crate::selector::ItemSelector;
use getup_proto::Segment;
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const GAMMA: f32 = 0.9;

/// Episodes of several lanes, interleaved segment by segment.
fn episodes(lengths: &[(usize, Ending)], cut: usize) -> Vec<Segment> {
    let spec = fixtures::spec(8);
    let mut parts = Vec::new();
    for (lane, &(length, ending)) in lengths.iter().enumerate() {
        for first_step in (0..length).step_by(cut) {
            let steps = cut.min(length - first_step);
            let ending = if first_step + steps == length { ending } else { Ending::None };
            let (lane, first_step) = (lane as u32, first_step as u32);
            parts.push(Part { writer: 1, sequence: 0, lane, episode: 0, first_step, steps, ending });
        }
    }
    parts.sort_by_key(|part| (part.first_step, part.lane));
    (1..).zip(parts).map(|(sequence, part)| Part { sequence, ..part }.build(&spec)).collect()
}

/// n-step return, its discount and where it ends, straight from the definition: step `t` of an episode of which
/// the ring holds the steps before `held`.
fn reference(lane: u32, t: usize, n: usize, held: usize, terminal: bool) -> (f32, f32, usize) {
    let end = (t + n).min(held);
    let reward = |step| fixtures::value(1, lane, 0, step, 2, 0) as f64;
    let total: f64 = (t..end).map(|step| (GAMMA as f64).powi((step - t) as i32) * reward(step)).sum();
    let discount = if terminal && end == held { 0.0 } else { (GAMMA as f64).powi((end - t) as i32) };
    (total as f32, discount as f32, end)
}

fn reward_place(ring: &Ring) -> usize {
    ring.layout().columns[2].at.start
}

fn observation(ring: &Ring, slot: usize) -> f32 {
    ring.values(slot)[ring.layout().columns[0].at.start]
}

proptest! {
    #[test]
    fn n_step_transitions_equal_a_straightforward_reference(
        lengths in prop::collection::vec((1usize..40, prop_oneof![
            Just(Ending::None), Just(Ending::Terminal), Just(Ending::Truncated)]), 1..6),
        cut in 1usize..=8,
        n in 1usize..=20,
    ) {
        let segments = episodes(&lengths, cut);
        let mut ring = Ring::new(&fixtures::spec(8), &ReplayConfig::default());
        let mut steps = Vec::new();
        for segment in &segments {
            ring.push(segment);
            steps.extend((0..=segment.steps).map(|i| (segment.lane, segment.first_step as usize + i)));
        }
        for (number, (lane, t)) in (0..).zip(steps) {
            let row = ring.nth_row(number);
            if ring.steps_from(row) == 0 {
                continue;
            }
            let (length, ending) = lengths[lane as usize];
            let got = span(&ring, row, Some(reward_place(&ring)), n, GAMMA);
            let (reward, discount, end) = reference(lane, t, n, length, ending == Ending::Terminal);
            prop_assert!((got.reward - reward).abs() < 1e-5);
            prop_assert!((got.discount - discount).abs() < 1e-6);
            prop_assert_eq!(observation(&ring, got.begin), fixtures::value(1, lane, 0, t, 0, 0));
            prop_assert_eq!(observation(&ring, got.end), fixtures::value(1, lane, 0, end, 0, 0));
        }
    }
}

proptest! {
    #[test]
    fn a_transition_ends_where_the_segment_that_follows_was_removed(
        lengths in prop::collection::vec((1usize..40, prop_oneof![
            Just(Ending::None), Just(Ending::Terminal), Just(Ending::Truncated)]), 1..6),
        cut in 1usize..=8,
        n in 1usize..=20,
        removed in prop::collection::vec(prop::bool::weighted(0.3), 200),
    ) {
        let (capacity, spec) = (2000, fixtures::spec(8));
        let sampler = ItemSelector::Prioritized { exponent: 1.0 };
        let remover = Remover::LowestPriority { window: 8 };
        let mut ring = Ring::new(&spec, &ReplayConfig { capacity, sampler, remover, ..ReplayConfig::default() });
        let segments = episodes(&lengths, cut);
        segments.iter().for_each(|segment| ring.push(segment));
        // Others fill the ring, and leave after those that are to be removed and before those that are not.
        let mut others = (1..).map(|i| fixtures::segment(&spec, 2, i, 8));
        let (mut key, ours) = (0, ring.len() as u64);
        ring.push(&others.next().unwrap());
        while ring.len() + 8 <= capacity && ring.slots().free() > 8 {
            ring.push(&others.next().unwrap());
        }
        for key in ours..ring.len() as u64 {
            prop_assert!(ring.set_priority(key, 0.5));
        }
        let mut gone = Vec::new();
        let mut there = std::collections::HashSet::new();
        for (segment, removed) in segments.iter().zip(removed) {
            if removed {
                (key..).take(segment.steps).for_each(|key| assert!(ring.set_priority(key, 0.0)));
                gone.push(key);
            } else {
                there.extend((0..segment.steps).map(|step| (segment.lane, segment.first_step as usize + step)));
            }
            key += segment.steps as u64;
        }
        while gone.iter().any(|&key| ring.set_priority(key, 0.0)) {
            ring.push(&others.next().unwrap());
        }
        let mut key = 0;
        for segment in &segments {
            let (lane, (length, ending)) = (segment.lane, lengths[segment.lane as usize]);
            for t in (segment.first_step as usize..).take(segment.steps) {
                key += 1;
                if !there.contains(&(lane, t)) {
                    prop_assert!(!ring.set_priority(key - 1, 1.0));
                    continue;
                }
                let begin = ring.slot_of(key - 1).unwrap();
                let held = (t..length).find(|&t| !there.contains(&(lane, t))).unwrap_or(length);
                let got = span(&ring, begin, Some(reward_place(&ring)), n, GAMMA);
                let terminal = ending == Ending::Terminal && held == length;
                let (reward, discount, end) = reference(lane, t, n, held, terminal);
                prop_assert!((got.reward - reward).abs() < 1e-5);
                prop_assert!((got.discount - discount).abs() < 1e-6, "{} and not {}", got.discount, discount);
                prop_assert_eq!(observation(&ring, got.begin), fixtures::value(1, lane, 0, t, 0, 0));
                prop_assert_eq!(observation(&ring, got.end), fixtures::value(1, lane, 0, end, 0, 0));
            }
        }
    }
}

#[test]
fn a_transition_is_shorter_while_the_next_segment_has_not_come_and_whole_once_it_has() {
    let segments = episodes(&[(16, Ending::Truncated)], 8);
    let mut ring = Ring::new(&fixtures::spec(8), &ReplayConfig { capacity: 100, ..ReplayConfig::default() });
    ring.push(&segments[0]);
    let row = ring.nth_row(6);
    let short = span(&ring, row, Some(reward_place(&ring)), 4, GAMMA);
    assert_eq!(
        (short.discount, observation(&ring, short.end)),
        (GAMMA * GAMMA, fixtures::value(1, 0, 0, 8, 0, 0))
    );
    ring.push(&segments[1]);
    let whole = span(&ring, row, Some(reward_place(&ring)), 4, GAMMA);
    assert_eq!(observation(&ring, whole.end), fixtures::value(1, 0, 0, 10, 0, 0));
}

#[test]
fn columns_come_in_the_order_of_the_spec_then_the_next_states_then_the_discount() {
    let mut ring = Ring::new(&fixtures::spec(8), &ReplayConfig { capacity: 100, ..ReplayConfig::default() });
    for segment in episodes(&[(30, Ending::Terminal), (20, Ending::Truncated)], 7) {
        ring.push(&segment);
    }
    let options = SampleOptions { batch: 64, n_step: 1, gamma: GAMMA, seed: 0, segments: false };
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let drawn: Vec<_> = (0..options.batch).map(|_| ring.draw_uniformly(&mut rng)).collect();
    let columns = gather(&ring, &drawn, &options);
    let shape: Vec<_> = columns.iter().map(|c| (c.name.as_str(), c.width, c.data.len())).collect();
    let expected = [
        ("observation", 3, 192),
        ("action", 2, 128),
        ("reward", 1, 64),
        ("beta", 1, 64),
        ("next_observation", 3, 192),
        ("discount", 1, 64),
    ];
    assert_eq!(shape, expected);
    // Every row is one transition: its parts belong together.
    for i in 0..64 {
        let same = |&(lane, t): &(u32, usize)| {
            let value = |step, column, place| fixtures::value(1, lane, 0, step, column, place);
            columns[0].data[3 * i..3 * i + 3] == [value(t, 0, 0), value(t, 0, 1), value(t, 0, 2)]
                && columns[1].data[2 * i..2 * i + 2] == [value(t, 1, 0), value(t, 1, 1)]
                && columns[2].data[i] == value(t, 2, 0)
                && columns[3].data[i] == value(0, 3, 0)
                && columns[4].data[3 * i] == value(t + 1, 0, 0)
                && columns[5].data[i] == if lane == 0 && t == 29 { 0.0 } else { GAMMA }
        };
        let all = (0..30).map(|t| (0, t)).chain((0..20).map(|t| (1, t)));
        assert_eq!(all.filter(same).count(), 1);
    }
}
