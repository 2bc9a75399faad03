//! Random sequences of appends, samples, priorities, removals and restarts, against a plain list in memory.

use crate::common::{config, open};
use crate::fixtures::{Ending, Part, spec};
use getup_proto::Segment;
use getup_replay::{ItemSelector, Remover, ReplayConfig, SampleOptions, Store, compact, segments};
use proptest::prelude::*;
use proptest::sample::Index;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::collections::HashMap;
use std::path::Path;
use tempfile::TempDir;

const STEPS: usize = 8;
/// Transitions of the longest commit, of appends and of compactions.
const COMMIT: usize = 11 * STEPS;
const COMPACTED: usize = 64 * STEPS;

#[derive(Clone, Debug)]
enum Action {
    /// A group commit of these lengths, by these writers; some repeat an old sequence number.
    Append(Vec<(u64, usize, bool)>),
    Sample(usize, usize),
    /// Priorities for the transitions of segments, counted from the newest ever stored.
    Prioritize(Vec<(Index, f32)>),
    Restart,
    Compact,
}

fn action() -> impl Strategy<Value = Action> {
    let part = (1u64..4, 1..=STEPS, prop::bool::weighted(0.2));
    let priority = prop_oneof![Just(0.0), Just(0.5), Just(1.0), 0.0f32..2.0];
    prop_oneof![
        12 => prop::collection::vec(part, 1..12).prop_map(Action::Append),
        6 => (1usize..40, 1usize..4).prop_map(|(batch, n_step)| Action::Sample(batch, n_step)),
        9 => prop::collection::vec((any::<Index>(), priority), 1..12).prop_map(Action::Prioritize),
        1 => Just(Action::Restart),
        1 => Just(Action::Compact),
    ]
}

fn settings() -> impl Strategy<Value = ReplayConfig> {
    let lowest_priority = (1u32..6).prop_map(|window| Remover::LowestPriority { window });
    let remover = prop_oneof![Just(Remover::Fifo), lowest_priority];
    ((2 * STEPS)..120, remover).prop_map(|(capacity, remover)| {
        let sampler = match remover {
            Remover::Fifo => ItemSelector::Uniform,
            Remover::LowestPriority { .. } => ItemSelector::Prioritized { exponent: 0.7 },
        };
        ReplayConfig { capacity, sampler, remover, ..config() }
    })
}

/// A segment that can be sampled.
struct Held {
    segment: Segment,
    /// Of its first transition.
    key: u64,
    /// Of all its transitions. Equal ones leave first in, first out.
    priorities: Vec<f32>,
}

/// What a store should be.
struct Model {
    capacity: usize,
    /// Transitions that the log keeps.
    kept: u64,
    /// What can be sampled.
    held: Vec<Held>,
    /// Every segment that was ever stored.
    history: Vec<Segment>,
    /// The greatest priority that was given.
    newest: f32,
    durable: HashMap<u64, u64>,
    env_steps: u64,
    transitions: u64,
    episodes: u64,
    sampled: u64,
}

impl Model {
    fn new(settings: &ReplayConfig) -> Self {
        let window = match settings.remover {
            Remover::Fifo => 1,
            Remover::LowestPriority { window } => u64::from(window),
        };
        Self {
            capacity: settings.capacity,
            kept: window * settings.capacity as u64,
            held: Vec::new(),
            history: Vec::new(),
            newest: 1.0,
            durable: HashMap::new(),
            env_steps: 0,
            transitions: 0,
            episodes: 0,
            sampled: 0,
        }
    }

    fn append(&mut self, segment: &Segment) {
        let durable = self.durable.entry(segment.writer).or_default();
        if segment.sequence <= *durable {
            return;
        }
        *durable = segment.sequence;
        self.env_steps += u64::from(segment.env_steps);
        self.episodes += u64::from(segment.end.is_some());
        self.history.push(segment.clone());
        self.hold(segment.clone());
    }

    fn hold(&mut self, segment: Segment) {
        let (key, steps, capacity) = (self.transitions, segment.steps, self.capacity);
        self.transitions += steps as u64;
        self.held.retain(|held| held.key + self.kept >= self.transitions);
        // Rows run out before transitions do where segments are short: see the ring.
        let rows = |model: &Self| model.size() + model.held.len();
        while self.size() + steps > capacity || rows(self) + steps + 1 > capacity + capacity / 8 + STEPS + 1 {
            let greatest = |held: &Held| held.priorities.iter().copied().fold(0.0, f32::max);
            let lowest = self.held.iter().map(greatest).fold(f32::MAX, f32::min);
            let first = self.held.iter().position(|held| greatest(held) == lowest).unwrap();
            self.held.remove(first);
        }
        self.held.push(Held { segment, key, priorities: vec![self.newest; steps] });
    }

    /// Begins again with no priorities, from the log.
    fn restart(&mut self) {
        (self.newest, self.transitions) = (1.0, 0);
        self.held.clear();
        for segment in self.history.clone() {
            self.hold(segment);
        }
    }

    /// The key of the first transition of one of the segments stored last, and how many it has.
    fn recent(&self, index: Index) -> (u64, u64) {
        let back = index.index(self.history.len().min(self.capacity / 3));
        let place = self.history.len() - 1 - back;
        let newer: u64 = self.history[place..].iter().map(|segment| segment.steps as u64).sum();
        (self.transitions - newer, self.history[place].steps as u64)
    }

    /// Whether the transition was there to get it.
    fn prioritize(&mut self, key: u64, priority: f32) -> bool {
        let of = |held: &&mut Held| (held.key..held.key + held.priorities.len() as u64).contains(&key);
        let Some(held) = self.held.iter_mut().find(of) else { return false };
        held.priorities[(key - held.key) as usize] = priority;
        self.newest = self.newest.max(priority);
        true
    }

    fn size(&self) -> usize {
        self.held.iter().map(|held| held.segment.steps).sum()
    }

    /// Whether this is the observation before some step that can be sampled, with that step's action.
    fn holds(&self, observation: &[f32], action: &[f32]) -> bool {
        self.held.iter().any(|Held { segment, .. }| {
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

/// The log of a closed store holds the end of all that was stored, what could be sampled is in it, and it keeps at most a
/// file more than it is to keep: a sixteenth of that, and the rest of a commit of so many transitions.
fn check_log(dir: &Path, model: &Model, commit: usize) -> Result<(), TestCaseError> {
    let logged: Vec<Segment> = segments(dir).unwrap().1.map(Result::unwrap).collect();
    prop_assert!(model.history.ends_with(&logged));
    let mut rest = logged.iter();
    for Held { segment, .. } in &model.held {
        prop_assert!(rest.any(|logged| logged == segment), "{:?} is not in the log", segment);
    }
    let (steps, kept): (usize, _) = (logged.iter().map(|segment| segment.steps).sum(), model.kept as usize);
    prop_assert!(steps <= kept + kept.div_ceil(16) + commit, "{} transitions in the log", steps);
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(if std::env::var_os("GETUP_TEST_FULL").is_some() { 400 } else { 24 }))]

    #[test]
    fn a_store_is_what_a_plain_list_says(
        actions in prop::collection::vec(action(), 1..100),
        settings in settings(),
    ) {
        let dir = TempDir::new().unwrap();
        let mut commit = COMMIT;
        let mut store = open(dir.path(), &spec(STEPS), &settings).unwrap();
        let (mut model, mut writers, mut draws) = (Model::new(&settings), Writers::default(), ChaCha8Rng::seed_from_u64(1));
        for action in actions {
            match action {
                Action::Append(parts) => {
                    let group: Vec<Segment> =
                        parts.into_iter().map(|(writer, steps, again)| writers.segment(writer, steps, again)).collect();
                    store.append(group.clone()).unwrap();
                    group.iter().for_each(|segment| model.append(segment));
                }
                Action::Sample(batch, n_step) => {
                    let options = SampleOptions { batch, n_step, gamma: 0.9, seed: 0, segments: false };
                    let Some(minibatch) = store.try_sample(&mut draws, &options).unwrap() else {
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
                Action::Prioritize(priorities) if model.transitions > 0 => {
                    let mut by_key = Vec::new();
                    for (index, priority) in priorities {
                        let (key, steps) = model.recent(index);
                        by_key.extend((key..key + steps).map(|key| (key, priority)));
                    }
                    let priorities = by_key;
                    let given = store.update_priorities(&priorities).unwrap();
                    if settings.remover == Remover::Fifo {
                        prop_assert_eq!(given, 0, "nothing has a priority");
                    } else {
                        let there = priorities.into_iter().filter(|&(key, priority)| model.prioritize(key, priority));
                        prop_assert_eq!(given, there.count() as u64);
                    }
                }
                Action::Prioritize(_) => {}
                Action::Restart => {
                    drop(store);
                    check_log(dir.path(), &model, commit)?;
                    model.restart();
                    store = open(dir.path(), &spec(STEPS), &settings).unwrap();
                }
                Action::Compact => {
                    drop(store);
                    check_log(dir.path(), &model, commit)?;
                    compact(dir.path(), Some(model.kept)).unwrap();
                    commit = COMPACTED;
                    model.restart();
                    store = open(dir.path(), &spec(STEPS), &settings).unwrap();
                }
            }
            check(&store, &model)?;
        }
        for (&writer, &sequence) in &model.durable {
            prop_assert_eq!(store.introduce(writer, "actor"), sequence);
        }
        drop(store);
        check_log(dir.path(), &model, commit)?;
    }
}
