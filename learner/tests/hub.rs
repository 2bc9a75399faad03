//! The learner's interface to actors, driven the same way in process and over gRPC.

use std::sync::Arc;
use std::time::{Duration, Instant};

use getup_learner::hub::{Evaluation, Hub};
use getup_learner::service::service;
use getup_proto::v1::learner_client::LearnerClient;
use getup_proto::{ColumnSpec, Rows, RunSpec, v1};
use getup_telemetry::{Registry, Shutdown, Waits};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::transport::{Channel, Server};
use tonic::{Code, Status, Streaming};

fn spec(run: &str) -> RunSpec {
    let columns = vec![ColumnSpec { name: "reward".into(), width: 1, rows: Rows::Steps }];
    RunSpec { run: run.into(), task: "getup/standard".into(), columns, max_segment_steps: 64 }
}

fn hub(keep_alive: Duration) -> Arc<Hub> {
    let waits = Waits::new(&Registry::new());
    Arc::new(Hub::new(spec("hub"), vec![11, 12], keep_alive, 3, waits))
}

/// Evaluations on offer and on lease, and leases lost.
fn counts(hub: &Hub) -> (usize, usize, u64) {
    let counts = hub.lease_counts();
    (counts.offered, counts.leased, counts.expirations)
}

fn policy(counter: u64) -> Arc<v1::PolicyUpdate> {
    Arc::new(v1::PolicyUpdate {
        version: Some(v1::PolicyVersion { incarnation: 3, counter }),
        networks: vec![v1::NamedNetwork { name: "policy".into(), model: vec![7; 5_000_000].into() }],
        values: [("beta".to_owned(), 0.95)].into(),
        ..v1::PolicyUpdate::default()
    })
}

/// An actor's way to the hub.
enum Door {
    Here(Arc<Hub>),
    Grpc(LearnerClient<Channel>),
}

#[allow(clippy::large_enum_variant)] // One a test.
enum Policies {
    Here(watch::Receiver<Arc<v1::PolicyUpdate>>),
    Grpc(Streaming<v1::PolicyUpdate>),
}

impl Door {
    async fn both(hub: &Arc<Hub>, shutdown: &Shutdown) -> [Door; 2] {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let (service, ended) = (service(Arc::clone(hub), shutdown.clone()), shutdown.clone());
        let server = Server::builder().add_service(service);
        let incoming = TcpListenerStream::new(listener);
        tokio::spawn(server.serve_with_incoming_shutdown(incoming, async move { ended.wait().await }));
        let client = LearnerClient::connect(address).await.unwrap();
        let client = client.max_decoding_message_size(getup_proto::MAX_MESSAGE_BYTES);
        [Door::Here(Arc::clone(hub)), Door::Grpc(client)]
    }

    async fn subscribe(&self, spec: &RunSpec) -> Result<Policies, Status> {
        match self {
            Door::Here(hub) => Ok(Policies::Here(hub.subscribe(spec)?)),
            Door::Grpc(client) => {
                let request = v1::SubscribeRequest { spec: Some(spec.to_wire()), actor: "actor".into() };
                Ok(Policies::Grpc(client.clone().subscribe(request).await?.into_inner()))
            }
        }
    }

    async fn heartbeat(
        &self,
        actor: &str,
        lease: u64,
        idle: bool,
    ) -> Result<Option<v1::EvaluationLease>, Status> {
        let request =
            v1::HeartbeatRequest { actor: actor.into(), lease, idle, ..v1::HeartbeatRequest::default() };
        Ok(match self {
            Door::Here(hub) => hub.heartbeat(request, Instant::now())?.lease,
            Door::Grpc(client) => client.clone().heartbeat(request).await?.into_inner().lease,
        })
    }

    async fn report(&self, lease: u64, returns: &[f64]) -> Result<(), Status> {
        let episode = |&episode_return| v1::EpisodeResult { episode_return, ..v1::EpisodeResult::default() };
        let episodes = returns.iter().map(episode).collect();
        let report = v1::EvaluationReport { lease, actor: "actor".into(), episodes };
        match self {
            Door::Here(hub) => Ok(hub.report(report)?),
            Door::Grpc(client) => client.clone().report(report).await.map(drop),
        }
    }
}

impl Policies {
    /// The counter of the newest policy that has come.
    async fn next(&mut self) -> u64 {
        let update = match self {
            Policies::Here(receiver) => {
                if receiver.borrow().networks.is_empty() {
                    receiver.changed().await.unwrap();
                }
                Arc::unwrap_or_clone(Arc::clone(&receiver.borrow_and_update()))
            }
            Policies::Grpc(stream) => stream.message().await.unwrap().unwrap(),
        };
        assert_eq!(update.networks[0].model.len(), 5_000_000);
        update.version.unwrap().counter
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_newest_policy_is_had_at_once_and_versions_are_skipped_never_queued() {
    let (hub, shutdown) = (hub(Duration::from_secs(10)), Shutdown::new());
    for door in Door::both(&hub, &shutdown).await {
        hub.publish(policy(1));
        let mut policies = door.subscribe(&spec("hub")).await.unwrap();
        assert_eq!(policies.next().await, 1);
        for counter in 2..=40 {
            hub.publish(policy(counter));
            tokio::task::yield_now().await;
        }
        let mut seen = 0;
        for received in 1.. {
            let counter = match &mut policies {
                Policies::Here(receiver) => receiver.borrow().version.unwrap().counter,
                Policies::Grpc(_) => policies.next().await,
            };
            assert!(counter > seen, "never an older one");
            seen = counter;
            if seen == 40 {
                assert!(received < 39, "a reader that sleeps skips versions");
                break;
            }
        }
    }
    shutdown.trigger();
}

#[tokio::test]
async fn an_evaluation_is_leased_kept_alive_and_reported_once() {
    let (hub, shutdown) = (hub(Duration::from_secs(10)), Shutdown::new());
    for door in Door::both(&hub, &shutdown).await {
        assert!(door.heartbeat("a", 0, true).await.unwrap().is_none(), "nothing is offered");
        hub.offer(Evaluation { policy: policy(5), updates: 100 });
        assert!(door.heartbeat("a", 0, false).await.unwrap().is_none(), "it is busy");
        let lease = door.heartbeat("a", 0, true).await.unwrap().unwrap();
        assert_eq!((lease.seeds.as_slice(), lease.scenario.as_str()), ([11, 12].as_slice(), "falls"));
        assert_eq!(lease.policy.unwrap().version.unwrap().counter, 5);
        assert!(door.heartbeat("b", 0, true).await.unwrap().is_none(), "it is taken");
        let again = door.heartbeat("a", 0, true).await.unwrap().unwrap();
        assert_eq!(again.id, lease.id, "whoever did not hear of it is told again");

        let code = |result: Result<(), Status>| result.unwrap_err().code();
        assert_eq!(code(door.report(lease.id, &[1.0]).await), Code::InvalidArgument);
        assert_eq!(code(door.report(lease.id, &[1.0, f64::NAN]).await), Code::InvalidArgument);
        assert_eq!(code(door.report(lease.id + 1, &[1.0, 2.0]).await), Code::FailedPrecondition);
        assert_eq!(
            code(door.report(1, &[1.0, 2.0]).await),
            Code::FailedPrecondition,
            "of an earlier learner"
        );
        assert_eq!(hub.outstanding(), 1, "what is refused changes nothing");
        door.report(lease.id, &[1.0, 2.0]).await.unwrap();
        assert_eq!(code(door.report(lease.id, &[1.0, 2.0]).await), Code::FailedPrecondition);
        let (evaluation, episodes) = hub.take_reported().unwrap();
        assert_eq!((evaluation.updates, episodes.len()), (100, 2));
    }
    shutdown.trigger();
}

#[tokio::test]
async fn actors_of_another_run_and_without_a_name_are_refused() {
    let (hub, shutdown) = (hub(Duration::from_secs(10)), Shutdown::new());
    for door in Door::both(&hub, &shutdown).await {
        let error = door.subscribe(&spec("other")).await.err().unwrap();
        assert_eq!(error.code(), Code::FailedPrecondition);
        assert!(error.message().contains("other") && error.message().contains("hub"), "{}", error.message());
        assert_eq!(door.heartbeat("", 0, true).await.unwrap_err().code(), Code::InvalidArgument);
        if let Door::Grpc(client) = &door {
            // Nor does it take part before its subscription is refused.
            let request = v1::HeartbeatRequest {
                actor: "stranger".into(),
                idle: true,
                spec: Some(spec("other").to_wire()),
                ..v1::HeartbeatRequest::default()
            };
            let error = client.clone().heartbeat(request).await.unwrap_err();
            assert_eq!(error.code(), Code::FailedPrecondition, "{error}");
        }
        door.heartbeat("a", 0, true).await.unwrap();
        let actors = hub.status(Instant::now()).actors;
        assert_eq!(actors.iter().map(|actor| actor.name.as_str()).collect::<Vec<_>>(), ["a"]);
    }
    shutdown.trigger();
}

#[test]
fn who_is_behind_or_silent_is_seen_and_who_leaves_is_not_missed() {
    let hub = hub(Duration::from_secs(10));
    let beat = |actor: &str, counter| v1::HeartbeatRequest {
        actor: actor.into(),
        version: Some(v1::PolicyVersion { incarnation: 3, counter }),
        idle: true,
        ..v1::HeartbeatRequest::default()
    };
    for counter in 1..=3 {
        hub.publish(policy(counter));
    }
    let now = Instant::now();
    hub.heartbeat(beat("newest", 3), now).unwrap();
    hub.heartbeat(beat("behind", 1), now).unwrap();
    let earlier = v1::PolicyVersion { incarnation: 2, counter: 900 };
    hub.heartbeat(v1::HeartbeatRequest { version: Some(earlier), ..beat("earlier", 0) }, now).unwrap();
    let later = now + Duration::from_secs(5);
    let actors = hub.actors(later);
    let behind: Vec<_> = actors.iter().map(|actor| (actor.name.as_str(), actor.versions_behind)).collect();
    assert_eq!(behind, [("behind", 2), ("earlier", 4), ("newest", 0)]);
    assert!(actors.iter().all(|actor| actor.silent == Duration::from_secs(5)));
    assert!(actors[0].lag > Duration::ZERO && actors[0].lag < Duration::from_secs(60));
    assert_eq!(actors[2].lag, Duration::ZERO);

    hub.offer(Evaluation { policy: policy(3), updates: 7 });
    assert_eq!(counts(&hub), (1, 0, 0));
    assert!(hub.heartbeat(beat("behind", 3), later).unwrap().lease.is_some());
    assert_eq!(counts(&hub), (0, 1, 0));
    hub.heartbeat(v1::HeartbeatRequest { leaving: true, ..beat("behind", 3) }, later).unwrap();
    assert_eq!(counts(&hub), (1, 0, 0), "its lease is free at once");
    assert_eq!(hub.actors(later).len(), 2);
    // A holder that falls silent loses its lease, and after ten minutes nobody speaks of it.
    assert!(hub.heartbeat(beat("newest", 3), later).unwrap().lease.is_some());
    let much_later = later + Duration::from_secs(601);
    assert!(hub.heartbeat(beat("another", 3), much_later).unwrap().lease.is_some());
    assert_eq!(counts(&hub), (0, 1, 1));
    assert_eq!(hub.actors(much_later).len(), 1);
}

#[test]
fn who_hears_nothing_falls_behind_without_bound_however_many_policies_there_are() {
    let hub = hub(Duration::from_secs(10));
    hub.publish(policy(1));
    let missed = Instant::now();
    // As fast as a learner that makes a thousand updates a second, for minutes.
    for counter in 2..10_000 {
        let version = Some(v1::PolicyVersion { incarnation: 3, counter });
        hub.publish(Arc::new(v1::PolicyUpdate { version, ..v1::PolicyUpdate::default() }));
    }
    let now = Instant::now() + Duration::from_secs(600);
    let heard_none = v1::HeartbeatRequest { actor: "deaf".into(), ..v1::HeartbeatRequest::default() };
    hub.heartbeat(heard_none, now).unwrap();
    let lag = hub.actors(now)[0].lag;
    assert!(lag >= now - missed, "{lag:?} since the first, which was {:?} ago", now - missed);
}
