use super::*;
use crate::fixtures::{self, Ending, Part};
use proptest::prelude::*;

fn empty(spec: &RunSpec, capacity: usize) -> Ring {
    Ring::new(spec, &ReplayConfig { capacity, ..ReplayConfig::default() })
}

/// What the ring holds, in terms that do not depend on where it lies in memory.
fn contents(ring: &Ring) -> Vec<(Vec<f32>, bool)> {
    (0..ring.rows())
        .map(|n| ring.nth_row(n))
        .map(|row| {
            let begins = ring.steps_from(ring.slot(row)) > 0;
            let values = ring.values(ring.slot(row));
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
                || ring.rows() as usize + one_more + 1 > ring.slots;
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
