//! Several services behind one source.

use crate::common::{Replay, config, eventually, options};
use crate::fixtures::{segment, spec};
use getup_replay::{ItemSelector, MinibatchSource, RemoteOptions, ReplayConfig, SampleError, ShardedSource};
use getup_telemetry::{Registry, Shutdown, Waits};
use getup_transport::Endpoint;
use std::time::Duration;
use tokio::runtime::Runtime;

const STEPS: usize = 8;

/// A service that holds so many segments.
fn holding(segments: u64, config: &ReplayConfig) -> Replay {
    let replay = Replay::start(spec(STEPS), config);
    replay.store.append((1..=segments).map(|i| segment(&spec(STEPS), 1, i, STEPS)).collect()).unwrap();
    replay
}

/// A learner of several services.
struct Learner {
    source: ShardedSource,
    waits: Waits,
    _runtime: Runtime,
}

fn learner(replays: &[&Replay]) -> Learner {
    let endpoints: Vec<Endpoint> = replays.iter().map(|replay| (&replay.endpoint).into()).collect();
    let options = RemoteOptions {
        table: String::new(),
        spec: spec(STEPS),
        sample: options(16),
        name: "learner".to_owned(),
        prefetch: 4,
    };
    let runtime = Runtime::new().unwrap();
    let waits = Waits::new(&Registry::new());
    let source = ShardedSource::new(&endpoints, &options, runtime.handle(), waits.clone(), Shutdown::new());
    Learner { source, waits, _runtime: runtime }
}

impl Learner {
    /// From which stores the next minibatches come.
    fn origins(&mut self, count: usize) -> Vec<u64> {
        (0..count).map(|_| self.source.next().unwrap().counters.store).collect()
    }
}

fn name(replay: &Replay) -> u64 {
    replay.store.counters().store
}

#[test]
fn services_are_sampled_in_proportion_to_what_they_hold() {
    let (large, small) = (holding(90, &config()), holding(30, &config()));
    let mut learner = learner(&[&large, &small]);
    // Until both are there.
    eventually("both are sampled", || {
        let origins = learner.origins(8);
        origins.contains(&name(&large)) && origins.contains(&name(&small))
    });
    // One in four; a minibatch that is late gives its turn to the other, and on a busy machine many may be.
    eventually("one in four is of the small one", || {
        let origins = learner.origins(400);
        let from_small = origins.iter().filter(|&&origin| origin == name(&small)).count();
        (70..=130).contains(&from_small)
    });
}

#[test]
fn one_that_goes_delays_nobody_and_what_others_hold_is_sampled_on() {
    let (stays, goes) = (holding(30, &config()), holding(30, &config()));
    let (kept, gone) = (name(&stays), name(&goes));
    let mut learner = learner(&[&stays, &goes]);
    eventually("both are sampled", || learner.origins(8).contains(&gone));
    drop(goes);
    // What was on its way is given out, and then all come from the other.
    eventually("the other gives all", || learner.origins(20).iter().all(|&origin| origin == kept));
    assert_eq!(learner.origins(200), vec![kept; 200]);
}

#[test]
fn who_waits_for_all_of_them_says_for_what() {
    let waiting = ReplayConfig { min_size: 100, ..config() };
    let (first, second) = (holding(3, &waiting), holding(4, &waiting));
    let mut learner = learner(&[&first, &second]);
    let mut polls = 0;
    loop {
        assert!(learner.source.poll(Duration::from_millis(200)).unwrap().is_none());
        let waits = learner.waits.current();
        let reason = waits.iter().find(|wait| wait.what == "learner").map(|wait| wait.reason.clone());
        if reason.is_some_and(|reason| reason.contains("24 of 100") && reason.contains("32 of 100")) {
            break;
        }
        polls += 1;
        assert!(polls < 100, "{waits:?}");
    }
    // One of them suffices.
    first.store.append((4..=20).map(|i| segment(&spec(STEPS), 1, i, STEPS)).collect()).unwrap();
    assert_eq!(learner.source.next().unwrap().counters.store, name(&first));
}

#[test]
fn priorities_go_back_to_where_the_transitions_lie() {
    let prioritized = ReplayConfig { sampler: ItemSelector::Prioritized { exponent: 1.0 }, ..config() };
    let (first, second) = (holding(20, &prioritized), holding(20, &prioritized));
    let mut learner = learner(&[&first, &second]);
    // All that is drawn loses its priority, but for one transition of each.
    let mut favourites = std::collections::BTreeMap::new();
    eventually("each draws its favourite alone", || {
        let minibatch = learner.source.next().unwrap();
        let store = minibatch.counters.store;
        let favourite = *favourites.entry(store).or_insert(minibatch.items[0].key);
        let priority = |key: u64| if key == favourite { 1.0 } else { 1e-6 };
        // Enough of them for a message.
        let updates: Vec<_> =
            minibatch.items.iter().cycle().take(2048).map(|item| (item.key, priority(item.key))).collect();
        learner.source.update_priorities(updates).unwrap();
        favourites.len() == 2 && {
            let mut alone = [0, 0];
            for _ in 0..8 {
                let minibatch = learner.source.next().unwrap();
                let favourite = favourites[&minibatch.counters.store];
                let drawn = minibatch.items.iter().filter(|item| item.key == favourite).count();
                alone[usize::from(minibatch.counters.store == name(&second))] += usize::from(drawn >= 14);
            }
            alone.iter().all(|&count| count >= 2)
        }
    });
}

#[test]
fn one_that_refuses_ends_it_by_name() {
    let (right, wrong) = (holding(20, &config()), Replay::start(spec(2 * STEPS), &config()));
    let mut learner = learner(&[&right, &wrong]);
    let mut refused = None;
    eventually("the refusal is heard", || {
        refused = learner.source.poll(Duration::from_millis(20)).err();
        refused.is_some()
    });
    assert!(matches!(refused, Some(SampleError::Refused { endpoint, .. }) if endpoint == wrong.endpoint));
}
