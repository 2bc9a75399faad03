use super::*;
use crate::fixtures::{self, Ending, Part};
use crate::selector::ItemSelector;
use proptest::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn empty(spec: &RunSpec, capacity: usize) -> Ring {
    Ring::new(spec, &ReplayConfig { capacity, ..ReplayConfig::default() })
}

/// What the ring holds, in terms that do not depend on where it lies in memory.
fn contents(ring: &Ring) -> Vec<(Vec<f32>, bool)> {
    (0..ring.rows())
        .map(|n| ring.nth_row(n))
        .map(|slot| {
            let begins = ring.steps_from(slot) > 0;
            let values = ring.values(slot);
            let kept = ring.layout.columns.iter().filter(|column| begins || column.rows != Rows::Steps);
            (kept.flat_map(|column| values[column.at.clone()].to_vec()).collect(), begins)
        })
        .collect()
}

#[test]
fn every_row_of_a_segment_is_kept_as_it_came() {
    let spec = fixtures::spec(8);
    let mut ring = empty(&spec, 32);
    let segment = fixtures::segment(&spec, 4, 9, 5);
    ring.push(&segment);
    let contents = contents(&ring);
    assert_eq!(contents.len(), 6);
    for (step, (values, begins)) in contents.iter().enumerate() {
        let value = |c, step, place| fixtures::value(4, 0, 9, step, c, place);
        let mut expected = vec![value(0, step, 0), value(0, step, 1), value(0, step, 2)];
        if step < 5 {
            expected.extend([value(1, step, 0), value(1, step, 1), value(2, step, 0)]);
        }
        expected.push(value(3, 0, 0));
        assert_eq!((values, *begins), (&expected, step < 5));
    }
}

proptest! {
    #[test]
    fn a_ring_is_a_function_of_the_segments_it_holds_and_within_its_capacity(
        lengths in prop::collection::vec(1usize..=8, 1..120),
        capacity in 16usize..64,
    ) {
        let spec = fixtures::spec(8);
        let segments: Vec<Segment> = (1..).zip(&lengths).map(|(i, &n)| fixtures::segment(&spec, 1, i, n)).collect();
        let mut ring = empty(&spec, capacity);
        let memory = ring.memory_bytes();
        for segment in &segments {
            ring.push(segment);
            prop_assert!(ring.len() <= capacity);
        }
        prop_assert_eq!(ring.memory_bytes(), memory);
        let kept = ring.segments.len();
        let mut rebuilt = empty(&spec, capacity);
        for segment in &segments[segments.len() - kept..] {
            rebuilt.push(segment);
        }
        prop_assert_eq!(rebuilt.len(), ring.len());
        prop_assert_eq!(contents(&rebuilt), contents(&ring));
        // And no segment more would have fitted.
        if kept < segments.len() {
            let one_more = segments[segments.len() - kept - 1].steps;
            let full = ring.len() + one_more > capacity
                || ring.rows() + one_more + 1 > ring.slots.count();
            prop_assert!(full);
        }
    }
}

#[test]
fn a_segment_is_linked_to_the_one_that_continues_its_episode_and_to_no_other() {
    let spec = fixtures::spec(8);
    let part = |sequence, lane, episode, first_step, ending| {
        Part { writer: 1, sequence, lane, episode, first_step, steps: 4, ending }.build(&spec)
    };
    let mut ring = empty(&spec, 64);
    ring.push(&part(1, 0, 0, 0, Ending::None));
    ring.push(&part(2, 1, 0, 0, Ending::None));
    ring.push(&part(3, 0, 0, 4, Ending::Terminal)); // continues 1
    ring.push(&part(4, 1, 1, 4, Ending::None)); // another episode than 2
    ring.push(&part(5, 1, 1, 12, Ending::None)); // a gap after 4
    ring.push(&part(6, 0, 1, 0, Ending::Truncated)); // after an end
    let links: Vec<_> = ring.segments.iter().map(|entry| entry.continued_by).collect();
    assert_eq!(links, [Some(2), None, None, None, None, None]);
    assert_eq!(ring.unfinished.len(), 1);
}

#[test]
fn an_evicted_segment_is_forgotten_by_those_that_would_continue_it() {
    let spec = fixtures::spec(8);
    let mut ring = empty(&spec, 16);
    for lane in 0..50 {
        let part = Part {
            writer: 1,
            sequence: u64::from(lane) + 1,
            lane,
            episode: 0,
            first_step: 0,
            steps: 8,
            ending: Ending::None,
        };
        ring.push(&part.build(&spec));
    }
    assert_eq!((ring.len(), ring.unfinished.len()), (16, 2));
    let late =
        Part { writer: 1, sequence: 51, lane: 0, episode: 0, first_step: 8, steps: 8, ending: Ending::None };
    ring.push(&late.build(&spec));
    assert!(ring.segments.iter().all(|entry| entry.continued_by.is_none()));
}

proptest! {
    #[test]
    fn a_ring_that_was_full_holds_at_least_what_it_says_whatever_its_segments(
        segments in prop::collection::vec((prop_oneof![Just(1usize), Just(8), 1usize..=8], 0.0f32..2.0), 1..200),
        capacity in 16usize..80,
        window in prop::option::of(1u32..4),
    ) {
        let spec = fixtures::spec(8);
        let (sampler, remover) = match window {
            None => (ItemSelector::Uniform, Remover::Fifo),
            Some(window) => (ItemSelector::Prioritized { exponent: 1.0 }, Remover::LowestPriority { window }),
        };
        let config = ReplayConfig { capacity, sampler, remover, ..ReplayConfig::default() };
        let least = Ring::held_at_least(&spec, &config);
        let (mut ring, mut pushed) = (Ring::new(&spec, &config), 0);
        for (sequence, (steps, priority)) in (1..).zip(segments) {
            ring.push(&fixtures::segment(&spec, 1, sequence, steps));
            for key in pushed..pushed + steps as u64 {
                ring.set_priority(key, priority);
            }
            pushed += steps as u64;
            prop_assert!(ring.len() as u64 == pushed || ring.len() >= least, "{} and not {}", ring.len(), least);
        }
    }
}

#[test]
fn a_ring_that_was_full_may_hold_no_more_than_it_says() {
    let spec = fixtures::spec(8);
    // The longest segment leaves for one of a single step, where transitions run out, and where rows do.
    let mut many = vec![1; 38];
    many[0] = 8;
    for (capacity, lengths, least) in [(16, vec![8, 8, 1], 9), (64, many, 37)] {
        let config = ReplayConfig { capacity, ..ReplayConfig::default() };
        let mut ring = Ring::new(&spec, &config);
        for (sequence, steps) in (1..).zip(lengths) {
            ring.push(&fixtures::segment(&spec, 1, sequence, steps));
        }
        assert_eq!((ring.len(), Ring::held_at_least(&spec, &config)), (least, least));
    }
}

/// A ring that the segments of the lowest priority leave first.
fn by_priority(spec: &RunSpec, capacity: usize, window: u32, max_times_sampled: Option<u32>) -> Ring {
    let sampler = ItemSelector::Prioritized { exponent: 1.0 };
    let remover = Remover::LowestPriority { window };
    let config = ReplayConfig { capacity, sampler, remover, max_times_sampled, ..ReplayConfig::default() };
    Ring::new(spec, &config)
}

/// Numbers of the segments that are in the ring, from 0.
fn held(ring: &Ring) -> Vec<u64> {
    let there = (ring.first_segment..).zip(&ring.segments).filter(|(_, entry)| entry.steps > 0);
    there.map(|(number, _)| number).collect()
}

/// What a ring that goes by priorities should be.
struct Plain {
    capacity: usize,
    rows: usize,
    window: u64,
    /// Number, key of the first transition, and the priority of each.
    held: Vec<(u64, u64, Vec<f32>)>,
    pushed: u64,
    newest: f32,
}

impl Plain {
    fn push(&mut self, number: u64, steps: usize) {
        let first_key = self.pushed;
        self.pushed += steps as u64;
        self.held.retain(|(_, key, _)| key + self.window >= self.pushed);
        let size = |held: &[(u64, u64, Vec<f32>)]| {
            held.iter().map(|(.., priorities)| priorities.len()).sum::<usize>()
        };
        while size(&self.held) + steps > self.capacity
            || size(&self.held) + self.held.len() + steps + 1 > self.rows
        {
            let greatest =
                |(.., priorities): &(u64, u64, Vec<f32>)| priorities.iter().copied().fold(0.0, f32::max);
            let lowest = self.held.iter().map(greatest).fold(f32::MAX, f32::min);
            let place = self.held.iter().position(|segment| greatest(segment) == lowest).unwrap();
            self.held.remove(place);
        }
        self.held.push((number, first_key, vec![self.newest; steps]));
    }

    fn set_priority(&mut self, key: u64, priority: f32) -> bool {
        let mut held = self.held.iter_mut();
        let found =
            held.find(|(_, first, priorities)| (*first..first + priorities.len() as u64).contains(&key));
        let Some((_, first, priorities)) = found else { return false };
        priorities[(key - *first) as usize] = priority;
        self.newest = self.newest.max(priority);
        true
    }
}

#[test]
fn by_priority_a_ring_holds_what_a_plain_list_says_and_every_row_as_it_came() {
    let longest = 16;
    let spec = fixtures::spec(longest);
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    for round in 0..24 {
        let (capacity, window) = (rng.random_range(2 * longest..300), rng.random_range(1..8));
        // Some rounds of short segments alone, where rows run out before transitions do.
        let lengths = 1..=if round % 3 == 0 { 3 } else { longest };
        let mut ring = by_priority(&spec, capacity, window, None);
        let memory = ring.memory_bytes();
        let mut plain = Plain {
            capacity,
            rows: capacity + capacity / 8 + longest + 1,
            window: u64::from(window) * capacity as u64,
            held: Vec::new(),
            pushed: 0,
            newest: 1.0,
        };
        for number in 0..1500 {
            let steps = rng.random_range(lengths.clone());
            ring.push(&fixtures::segment(&spec, 1, number + 1, steps));
            plain.push(number, steps);
            for _ in 0..rng.random_range(0..12) {
                // Mostly of those that are there, and few enough priorities that many are equal.
                let key =
                    plain.pushed.saturating_sub(rng.random_range(0..2 * plain.window.min(plain.pushed) + 9));
                let priority = [0.0, 0.25, 0.5, 1.0, 2.0][rng.random_range(0..5)];
                assert_eq!(ring.set_priority(key, priority), plain.set_priority(key, priority), "key {key}");
            }
            assert_eq!(held(&ring), plain.held.iter().map(|(number, ..)| *number).collect::<Vec<_>>());
            let size = plain.held.iter().map(|(.., priorities)| priorities.len()).sum::<usize>();
            assert_eq!((ring.len(), ring.rows()), (size, size + plain.held.len()));
            assert!(ring.len() <= capacity && ring.segments.len() as u64 <= plain.window);
            if number % 50 != 0 {
                continue;
            }
            for (number, first_key, priorities) in &plain.held {
                let entry = &ring.segments[(number - ring.first_segment) as usize];
                let value = |c, step, place| fixtures::value(1, 0, number + 1, step, c, place);
                for (step, slot) in ring.slots.walk(entry.slot, entry.steps + 1).enumerate() {
                    let at = |c: usize| &ring.values(slot)[ring.layout.columns[c].at.clone()];
                    assert_eq!(at(0), [value(0, step, 0), value(0, step, 1), value(0, step, 2)]);
                    assert_eq!(ring.steps_from(slot), priorities.len() - step);
                    assert_eq!(ring.entry_of(slot).slot, entry.slot);
                    if step < entry.steps {
                        assert_eq!(
                            (at(1), at(2)),
                            (&[value(1, step, 0), value(1, step, 1)][..], &[value(2, step, 0)][..])
                        );
                        assert_eq!(ring.key(slot), first_key + step as u64);
                        let weight = ring.selector.as_ref().unwrap().weight(slot);
                        assert_eq!(weight, f64::from(priorities[step]).max(f64::MIN_POSITIVE));
                    }
                }
            }
        }
        assert_eq!(ring.memory_bytes(), memory);
    }
}

proptest! {
    #[test]
    fn of_equal_priorities_the_oldest_leave_and_that_is_fifo(
        lengths in prop::collection::vec(1usize..=8, 1..120),
        capacity in 16usize..64,
        window in 1u32..4,
    ) {
        let spec = fixtures::spec(8);
        let (mut fifo, mut ring) = (empty(&spec, capacity), by_priority(&spec, capacity, window, None));
        for (i, &steps) in (1..).zip(&lengths) {
            let segment = fixtures::segment(&spec, 1, i, steps);
            fifo.push(&segment);
            ring.push(&segment);
            prop_assert_eq!((held(&ring), ring.len()), (held(&fifo), fifo.len()));
        }
    }
}

#[test]
fn a_segment_leaves_by_its_greatest_priority_of_equals_the_oldest_and_with_age_at_the_latest() {
    let spec = fixtures::spec(4);
    let mut ring = by_priority(&spec, 16, 2, None);
    let push = |ring: &mut Ring, i| ring.push(&fixtures::segment(&spec, 1, i, 4));
    (1..=4).for_each(|i| push(&mut ring, i));
    // Segment 2 has one great priority among small ones; 0 and 1 are equal; 3 is lowest.
    let priorities = [0.5, 0.1, 0.1, 0.1, 0.5, 0.2, 0.2, 0.2, 9.0, 0.0, 0.0, 0.0, 0.3, 0.3, 0.3, 0.3];
    for (key, priority) in (0..).zip(priorities) {
        assert!(ring.set_priority(key, priority));
    }
    push(&mut ring, 5);
    assert_eq!(held(&ring), [0, 1, 2, 4]);
    push(&mut ring, 6);
    assert_eq!(held(&ring), [1, 2, 4, 5]);
    // A segment that rises is passed over, also where it is the oldest.
    assert!(ring.set_priority(4, 10.0) && !ring.set_priority(12, 10.0) && !ring.set_priority(0, 10.0));
    assert!((16..24).all(|key| ring.set_priority(key, 1.0)));
    push(&mut ring, 7);
    assert_eq!(held(&ring), [1, 2, 5, 6]);
    push(&mut ring, 8);
    assert_eq!(held(&ring), [1, 2, 6, 7]);
    // Segments 1 and 2 began after 4 and 8 transitions: 36 and 40 later the window of 32 has passed them.
    assert!((24..32).all(|key| ring.set_priority(key, 1.0)));
    push(&mut ring, 9);
    assert_eq!(held(&ring), [1, 2, 7, 8]);
    push(&mut ring, 10);
    assert_eq!(held(&ring), [2, 7, 8, 9]);
    push(&mut ring, 11);
    assert_eq!((held(&ring), ring.first_segment), (vec![7, 8, 9, 10], 7));
}

#[test]
fn what_can_be_drawn_no_more_keeps_no_segment() {
    let spec = fixtures::spec(4);
    let mut ring = by_priority(&spec, 12, 8, Some(1));
    for i in 1..=3 {
        ring.push(&fixtures::segment(&spec, 1, i, 4));
    }
    let priorities: Vec<f32> = (0..12).map(|key| if (4..8).contains(&key) { 1e9 } else { 0.0 }).collect();
    (0..).zip(priorities).for_each(|(key, priority)| assert!(ring.set_priority(key, priority)));
    // All four of segment 1, and no other: their priorities are a billion to nothing.
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let slots = [(); 4].map(|()| ring.draw(&mut rng).slot);
    let mut drawn = slots.map(|slot| ring.key(slot));
    drawn.sort_unstable();
    assert_eq!(drawn, [4, 5, 6, 7]);
    assert_eq!(ring.available(), Some(8));
    ring.push(&fixtures::segment(&spec, 1, 4, 4));
    assert_eq!((held(&ring), ring.available()), (vec![0, 2, 3], Some(12)));
}

/// Chi-square of `counts` against a uniform distribution, as a number of standard deviations.
fn deviation(counts: &[u32]) -> f64 {
    let expected = counts.iter().sum::<u32>() as f64 / counts.len() as f64;
    let chi_square: f64 = counts.iter().map(|&n| (n as f64 - expected).powi(2) / expected).sum();
    let freedom = (counts.len() - 1) as f64;
    (chi_square - freedom) / (2.0 * freedom).sqrt()
}

#[test]
fn every_transition_is_drawn_with_the_same_probability_also_after_the_ring_has_wrapped() {
    let spec = fixtures::spec(8);
    let mut ring = empty(&spec, 100);
    for (i, steps) in [8, 1, 3, 8, 2, 5].into_iter().cycle().take(60).enumerate() {
        ring.push(&fixtures::segment(&spec, 1, i as u64 + 1, steps));
    }
    let rows: Vec<usize> = (0..ring.rows()).map(|n| ring.nth_row(n)).collect();
    let mut counts = vec![0; rows.iter().max().unwrap() + 1];
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for _ in 0..200_000 {
        counts[ring.draw_uniformly(&mut rng).slot] += 1;
    }
    let begin = rows.into_iter().filter(|&slot| ring.steps_from(slot) > 0);
    let drawn: Vec<u32> = begin.map(|slot| counts[slot]).collect();
    assert_eq!(drawn.len(), ring.len());
    assert_eq!(drawn.iter().sum::<u32>(), 200_000);
    assert!(deviation(&drawn).abs() < 4.0, "{} standard deviations", deviation(&drawn));
}
