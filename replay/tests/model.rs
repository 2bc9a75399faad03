//! Random sequences of appends, samples, evictions and restarts, against a plain list in memory.

mod common;
mod fixtures;

use common::{config, open};
use fixtures::{Ending, Part, spec};
use getup_proto::Segment;
use getup_replay::{ReplayConfig, SampleOptions, Sampler, Store, compact, segments};
use proptest::prelude::*;
use std::collections::{HashMap, VecDeque};
use tempfile::TempDir;

const STEPS: usize = 8;

#[derive(Clone, Debug)]
enum Action {
    /// A group commit of these lengths, by these writers; some repeat an old sequence number.
    Append(Vec<(u64, usize, bool)>),
    Sample(usize, usize),
    Restart,
    Compact,
}

fn action() -> impl Strategy<Value = Action> {
    let part = (1u64..4, 1..=STEPS, prop::bool::weighted(0.2));
    prop_oneof![
        6 => prop::collection::vec(part, 1..12).prop_map(Action::Append),
        3 => (1usize..40, 1usize..4).prop_map(|(batch, n_step)| Action::Sample(batch, n_step)),
        1 => Just(Action::Restart),
        1 => Just(Action::Compact),
    ]
}

/// What a store should be.
#[derive(Default)]
struct Model {
    /// What can be sampled.
    held: VecDeque<Segment>,
    durable: HashMap<u64, u64>,
    env_steps: u64,
    transitions: u64,
    episodes: u64,
    sampled: u64,
}

impl Model {
    fn append(&mut self, segment: &Segment, capacity: usize) {
        let durable = self.durable.entry(segment.writer).or_default();
        if segment.sequence <= *durable {
            return;
        }
        *durable = segment.sequence;
        self.env_steps += u64::from(segment.env_steps);
        self.transitions += segment.steps as u64;
        self.episodes += u64::from(segment.end.is_some());
        self.held.push_back(segment.clone());
        // Rows run out before transitions do where segments are short: see the ring.
        let rows = |held: &VecDeque<Segment>| held.iter().map(|segment| segment.steps + 1).sum::<usize>();
        while self.size() > capacity || rows(&self.held) > capacity + capacity / 8 + STEPS + 1 {
            self.held.pop_front();
        }
    }

    fn size(&self) -> usize {
        self.held.iter().map(|segment| segment.steps).sum()
    }

    /// Whether this is the observation before some step that can be sampled, with that step's action.
    fn holds(&self, observation: &[f32], action: &[f32]) -> bool {
        self.held.iter().any(|segment| {
            let row = |column: usize, width: usize, step: usize| -> Vec<f32> {
                let values = getup_proto::columns::iter(&segment.columns[column]);
                values.skip(step * width).take(width).collect()
            };
            (0..segment.steps).any(|step| row(0, 3, step) == observation && row(1, 2, step) == action)
        })
    }
}

/// Episodes of the writers go on from segment to segment.
#[derive(Default)]
struct Writers {
    /// Of each: sequence, episode, next step.
    places: HashMap<u64, (u64, u64, u32)>,
}

impl Writers {
    fn segment(&mut self, writer: u64, steps: usize, again: bool) -> Segment {
        let (sequence, episode, first_step) = self.places.entry(writer).or_default();
        if again && *sequence > 0 {
            // As after a lost acknowledgement. What it holds does not matter: it is known.
            let part = Part {
                writer,
                sequence: *sequence,
                lane: 0,
                episode: 0,
                first_step: 0,
                steps,
                ending: Ending::None,
            };
            return part.build(&spec(STEPS));
        }
        *sequence += 1;
        let ending = if steps == 3 { Ending::Terminal } else { Ending::None };
        let part = Part {
            writer,
            sequence: *sequence,
            lane: 0,
            episode: *episode,
            first_step: *first_step,
            steps,
            ending,
        };
        *first_step += steps as u32;
        if ending == Ending::Terminal {
            (*episode, *first_step) = (*episode + 1, 0);
        }
        part.build(&spec(STEPS))
    }
}

fn check(store: &Store, model: &Model) -> Result<(), TestCaseError> {
    let counters = store.counters();
    prop_assert_eq!(
        (counters.env_steps, counters.transitions, counters.episodes, counters.sampled),
        (model.env_steps, model.transitions, model.episodes, model.sampled)
    );
    prop_assert_eq!(store.len(), model.size());
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(if std::env::var_os("GETUP_TEST_FULL").is_some() { 400 } else { 24 }))]

    #[test]
    fn a_store_is_what_a_plain_list_says(
        actions in prop::collection::vec(action(), 1..60),
        capacity in (2 * STEPS)..200,
    ) {
        let dir = TempDir::new().unwrap();
        let settings = ReplayConfig { capacity, ..config() };
        let mut store = open(dir.path(), &spec(STEPS), &settings).unwrap();
        let (mut model, mut writers, mut sampler) = (Model::default(), Writers::default(), Sampler::new(1));
        for action in actions {
            match action {
                Action::Append(parts) => {
                    let group: Vec<Segment> =
                        parts.into_iter().map(|(writer, steps, again)| writers.segment(writer, steps, again)).collect();
                    store.append(group.clone()).unwrap();
                    group.iter().for_each(|segment| model.append(segment, capacity));
                }
                Action::Sample(batch, n_step) => {
                    let options = SampleOptions { batch, n_step, gamma: 0.9, seed: 0, segments: false };
                    let Some(minibatch) = store.try_sample(&mut sampler, &options).unwrap() else {
                        prop_assert_eq!(model.env_steps, 0, "sampling waits for the first env step alone");
                        continue;
                    };
                    model.sampled += batch as u64;
                    let column = |name: &str| minibatch.column(name).unwrap();
                    let (observations, actions) = (column("observation"), column("action"));
                    for (observation, action) in observations.data.chunks(3).zip(actions.data.chunks(2)) {
                        prop_assert!(model.holds(observation, action), "{:?} is in no segment", observation);
                    }
                }
                Action::Restart => {
                    drop(store);
                    store = open(dir.path(), &spec(STEPS), &settings).unwrap();
                }
                Action::Compact => {
                    drop(store);
                    compact(dir.path(), Some(capacity as u64)).unwrap();
                    store = open(dir.path(), &spec(STEPS), &settings).unwrap();
                }
            }
            check(&store, &model)?;
        }
        for (&writer, &sequence) in &model.durable {
            prop_assert_eq!(store.introduce(writer, "actor"), sequence);
        }
        drop(store);
        // The log holds what the ring does, in its order, and at most a sixteenth of the capacity more.
        let logged: Vec<Segment> = segments(dir.path()).unwrap().1.map(Result::unwrap).collect();
        let held: Vec<&Segment> = model.held.iter().collect();
        prop_assert_eq!(logged.iter().rev().take(held.len()).rev().collect::<Vec<_>>(), held);
        let steps: usize = logged.iter().map(|segment| segment.steps).sum();
        prop_assert!(steps <= capacity + capacity / 16 + 2 * 12 * STEPS, "{} transitions in the log", steps);
    }
}
