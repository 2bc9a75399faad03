//! The whole role: threads, queue, replay and learner, over gRPC.

use std::path::Path;
use std::time::{Duration, Instant};

use getup_actor::{ActorError, ActorSetup, Evaluator, GrpcLearner, GrpcReplay, PolicyUpdate, run};
use getup_proto::v1::EvaluationLease;
use getup_telemetry::{Registry, Shutdown, Waits};
use tokio::task::JoinHandle;

use crate::support::learner::Broadcast;
use crate::support::replay::Store;
use crate::support::{Server, any_port, eventually, setup, update};

/// An actor that runs beside the test.
struct Actor {
    shutdown: Shutdown,
    registry: Registry,
    waits: Waits,
    running: JoinHandle<Result<(), ActorError>>,
}

impl Actor {
    fn start(setup: ActorSetup, replay: &str, learner: &str) -> Self {
        let (shutdown, registry) = (Shutdown::new(), Registry::new());
        let waits = Waits::new(&registry);
        let writer =
            GrpcReplay::new(replay, setup.spec.clone(), setup.identity.clone(), waits.clone()).unwrap();
        let link =
            GrpcLearner::new(learner, setup.spec.clone(), &setup.identity.name, waits.clone()).unwrap();
        let (ended, seen, metrics) = (shutdown.clone(), waits.clone(), registry.clone());
        let running =
            tokio::spawn(async move { run(setup, vec![writer], link, seen, ended, &metrics).await });
        Self { shutdown, registry, waits, running }
    }

    fn metric(&self, name: &str) -> f64 {
        value(&self.registry, name)
    }

    fn waits_for(&self, reason: &str) -> bool {
        self.waits.current().iter().any(|wait| wait.what == "actor" && wait.reason.contains(reason))
    }

    async fn end(self) -> Duration {
        let start = Instant::now();
        self.shutdown.trigger();
        self.running.await.unwrap().unwrap();
        start.elapsed()
    }
}

/// The value of a metric without labels.
fn value(registry: &Registry, name: &str) -> f64 {
    let families = registry.gather();
    let family = families.iter().find(|family| family.name() == name).expect(name);
    let metric = &family.get_metric()[0];
    metric.get_counter().get_value() + metric.get_gauge().get_value()
}

fn services(folder: &Path) -> (ActorSetup, Store, Server, Broadcast, Server) {
    let (store, broadcast) = (Store::default(), Broadcast::new());
    let (replay, learner) = (store.serve(any_port()), broadcast.serve(any_port()));
    (setup(folder), store, replay, broadcast, learner)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_actor_waits_for_a_policy_plays_evaluates_and_ends_with_its_queue_empty() {
    let folder = tempfile::tempdir().unwrap();
    let (setup, store, replay, broadcast, learner) = services(folder.path());
    let (task, beta) = (setup.task.clone(), setup.beta);
    let actor = Actor::start(setup, &replay.url(), &learner.url());
    let reason = "no policy from the learner yet";
    eventually("the wait for a policy", || actor.waits_for(reason)).await;
    eventually("a heartbeat that says so", || {
        broadcast.with(|state| state.heartbeats.iter().any(|beat| beat.waiting == reason))
    })
    .await;

    broadcast.send(&update(1));
    eventually("segments", || store.len() > 50).await;
    broadcast.send(&update(2));
    let acts_by =
        |counter| store.with(|s| s.segments.last().is_some_and(|s| s.first_version.counter == counter));
    eventually("segments of the second policy", || acts_by(2)).await;

    let seeds = vec![8, 9, 10];
    let lease = EvaluationLease {
        id: 5,
        policy: Some(update(7).to_wire()),
        scenario: "falls".to_owned(),
        seeds: seeds.clone(),
        keep_alive_seconds: 10.0,
    };
    broadcast.with(|state| state.lease = Some(lease));
    eventually("a report", || broadcast.with(|state| !state.reports.is_empty())).await;
    let mut evaluator = Evaluator::new(&task, beta.ceiling, 1).unwrap();
    let expected =
        evaluator.evaluate(&update(7).policy, 0.8, &seeds, |_| std::ops::ControlFlow::Continue(()));
    let expected: Vec<f64> = expected.unwrap().iter().map(|episode| episode.episode_return).collect();
    let report = broadcast.with(|state| state.reports[0].clone());
    assert_eq!(report.episodes.iter().map(|e| e.episode_return).collect::<Vec<_>>(), expected);

    let (registry, waits) = (actor.registry.clone(), actor.waits.clone());
    assert!(actor.end().await < Duration::from_secs(4));
    assert!(waits.current().is_empty());
    let leaves = |state: &mut crate::support::learner::State| {
        state.heartbeats.last().map(|beat| (beat.leaving, beat.idle))
    };
    assert_eq!(broadcast.with(leaves), Some((true, false)), "its last heartbeat says that it ends");
    let stored = store.with(|state| state.segments.clone());
    let sequences: Vec<u64> = stored.iter().map(|segment| segment.sequence).collect();
    assert_eq!(sequences, (1..=stored.len() as u64).collect::<Vec<_>>());
    let lanes: std::collections::BTreeSet<u32> = stored.iter().map(|segment| segment.lane).collect();
    assert_eq!(lanes.len(), 4);
    let text = getup_telemetry::prometheus::TextEncoder::new().encode_to_string(&registry.gather()).unwrap();
    for (name, value) in [
        ("unacknowledged_segments", 0),
        ("evaluations_total", 1),
        ("diverged_episodes_total", 0),
        ("segments_acknowledged_total", stored.len()),
    ] {
        let line = format!("getup_actor_{name}{{actor=\"actor-1\"}} {value}");
        assert!(text.lines().any(|found| found == line), "{line} in\n{text}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_full_queue_stops_the_lanes_with_a_reason_and_not_the_evaluations() {
    let folder = tempfile::tempdir().unwrap();
    let (mut setup, store, replay, broadcast, learner) = services(folder.path());
    setup.config.queue_segments = 10;
    setup.config.drain_seconds = 0.2;
    store.with(|state| state.silent = true);
    broadcast.send(&update(1));
    let actor = Actor::start(setup, &replay.url(), &learner.url());
    let reason = "replay has not acknowledged 10 segments";
    eventually("the wait for the replay", || actor.waits_for(reason)).await;
    eventually("a heartbeat that says so", || {
        broadcast.with(|state| state.heartbeats.iter().any(|beat| beat.waiting.contains(reason)))
    })
    .await;
    eventually("both lane threads wait", || {
        actor
            .waits
            .current()
            .iter()
            .filter(|wait| wait.what == "actor" && wait.reason.contains(reason))
            .count()
            == 2
    })
    .await;
    let steps = actor.metric("getup_actor_env_steps_total");
    assert_eq!(actor.metric("getup_actor_unacknowledged_segments"), 10.0);

    let lease = EvaluationLease {
        id: 6,
        policy: Some(update(1).to_wire()),
        scenario: "falls".to_owned(),
        seeds: vec![1],
        keep_alive_seconds: 10.0,
    };
    broadcast.with(|state| state.lease = Some(lease));
    eventually("a report", || broadcast.with(|state| !state.reports.is_empty())).await;
    assert_eq!(actor.metric("getup_actor_env_steps_total"), steps);
    let registry = actor.registry.clone();
    assert!(actor.end().await < Duration::from_secs(4), "the drain is bounded");
    // The segment that did not fit stopped the lanes: it is among those that are said to be lost.
    assert!(value(&registry, "getup_actor_unacknowledged_segments") > 10.0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_replay_that_comes_back_gets_everything_and_the_lanes_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let (mut setup, store, replay, broadcast, learner) = services(folder.path());
    setup.config.queue_segments = 10;
    broadcast.send(&update(1));
    let actor = Actor::start(setup, &replay.url(), &learner.url());
    eventually("segments", || store.len() > 20).await;
    let address = replay.kill();
    eventually("the wait for the replay", || actor.waits_for("replay has not acknowledged")).await;
    let before = store.len();
    let _replay = store.serve(address);
    eventually("more segments", || store.len() > before + 50).await;
    actor.end().await;
    let sequences = store.with(|state| state.segments.iter().map(|s| s.sequence).collect::<Vec<_>>());
    assert_eq!(sequences, (1..=sequences.len() as u64).collect::<Vec<_>>());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_the_final_policy_an_actor_idles_until_its_shutdown() {
    let folder = tempfile::tempdir().unwrap();
    let (setup, _store, replay, broadcast, learner) = services(folder.path());
    broadcast.send(&PolicyUpdate { finished: true, ..update(1) });
    let actor = Actor::start(setup, &replay.url(), &learner.url());
    eventually("the idle wait", || actor.waits_for("training has finished")).await;
    assert_eq!(actor.metric("getup_actor_env_steps_total"), 0.0);
    assert!(actor.end().await < Duration::from_secs(4));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_actor_of_another_run_ends_with_the_reason_of_whoever_refuses_it() {
    let folder = tempfile::tempdir().unwrap();
    let (mut setup, _store, replay, _broadcast, learner) = services(folder.path());
    setup.spec.run = "other".to_owned();
    let actor = Actor::start(setup, &replay.url(), &learner.url());
    let ended = tokio::time::timeout(Duration::from_secs(10), actor.running).await.unwrap().unwrap();
    let message = ended.unwrap_err().to_string();
    assert!(message.starts_with("refused by the learner at http://"), "{message}");
    assert!(message.contains("the run is `other` and should be `test`"), "{message}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_actor_ends_at_once_where_neither_replay_nor_learner_ever_came() {
    let folder = tempfile::tempdir().unwrap();
    let (setup, store, replay, broadcast, learner) = services(folder.path());
    let (replay, learner) = (format!("http://{}", replay.kill()), format!("http://{}", learner.kill()));
    let actor = Actor::start(setup, &replay, &learner);
    eventually("the wait for a policy", || actor.waits_for("no policy from the learner yet")).await;
    assert!(actor.end().await < Duration::from_secs(4));
    assert_eq!((store.len(), broadcast.with(|state| state.heartbeats.len())), (0, 0));
}
