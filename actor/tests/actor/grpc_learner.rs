//! The link to the learner against a real server.

use std::sync::Arc;
use std::time::Duration;

use getup_actor::{EpisodeResult, GrpcLearner, Heartbeat, LearnerLink, LinkError, PolicyUpdate, Reported};
use getup_proto::v1::EvaluationLease;
use getup_proto::{PolicyVersion, RunSpec};
use getup_telemetry::{Registry, Waits};
use tokio::sync::watch;

use crate::support::learner::Broadcast;
use crate::support::{Server, any_port, eventually, spec, update};

fn link(server: &Server, spec: RunSpec) -> GrpcLearner {
    GrpcLearner::new(&server.url(), spec, "actor-1", Waits::new(&Registry::new())).unwrap()
}

fn version(slot: &watch::Receiver<Option<Arc<PolicyUpdate>>>) -> Option<PolicyVersion> {
    slot.borrow().as_ref().map(|update| update.version)
}

#[tokio::test]
async fn the_newest_policy_arrives_also_from_a_learner_that_starts_late_and_from_one_that_came_back() {
    let broadcast = Broadcast::new();
    let address = broadcast.serve(any_port()).kill();
    let waits = Waits::new(&Registry::new());
    let link = GrpcLearner::new(&format!("http://{address}"), spec(), "actor-1", waits.clone()).unwrap();
    let (slot, updates) = watch::channel(None);
    let subscription = tokio::spawn(async move { link.subscribe(slot).await });
    eventually("a wait for the learner", || {
        waits.current().iter().any(|wait| wait.what == "actor_link" && wait.reason.contains("learner at"))
    })
    .await;

    broadcast.send(&update(1));
    broadcast.send(&update(2));
    let server = broadcast.serve(address);
    let second = PolicyVersion { incarnation: 1, counter: 2 };
    eventually("the second policy", || version(&updates) == Some(second)).await;
    assert_eq!(**updates.borrow().as_ref().unwrap(), update(2));
    eventually("the end of the wait", || waits.current().is_empty()).await;

    server.kill();
    let resumed = PolicyVersion { incarnation: 2, counter: 1 };
    broadcast.send(&PolicyUpdate { version: resumed, ..update(1) });
    let _server = broadcast.serve(address);
    eventually("the resumed learner's policy", || version(&updates) == Some(resumed)).await;
    assert!(!subscription.is_finished());
    subscription.abort();
}

#[tokio::test]
async fn a_learner_of_another_run_or_with_a_malformed_policy_ends_the_subscription_with_its_reason() {
    let broadcast = Broadcast::new();
    let server = broadcast.serve(any_port());
    let refused = async |link: GrpcLearner| {
        let subscription = link.subscribe(watch::channel(None).0);
        match tokio::time::timeout(Duration::from_secs(10), subscription).await.unwrap() {
            Err(LinkError::Refused(reason)) => reason,
            other => panic!("{other:?}"),
        }
    };
    let reason = refused(link(&server, RunSpec { run: "other".to_owned(), ..spec() })).await;
    assert!(reason.contains("the run is `other` and should be `test`"), "{reason}");

    broadcast.send(&PolicyUpdate { values: [].into(), ..update(1) });
    let reason = refused(link(&server, spec())).await;
    assert!(reason.contains("policy 1.1 has beta None"), "{reason}");
}

#[tokio::test]
async fn a_heartbeat_brings_a_lease_to_an_idle_actor_and_a_report_is_accepted_or_its_lease_was_lost() {
    let broadcast = Broadcast::new();
    let server = broadcast.serve(any_port());
    let link = link(&server, spec());
    broadcast.with(|state| {
        state.lease = Some(EvaluationLease {
            id: 5,
            policy: Some(update(1).to_wire()),
            scenario: "falls".to_owned(),
            seeds: vec![1, 2],
            keep_alive_seconds: 10.0,
        });
    });
    let busy = Heartbeat { actor: "actor-1".to_owned(), lease: 4, env_steps: 9, ..Heartbeat::default() };
    assert_eq!(link.heartbeat(busy.clone()).await.unwrap(), None);
    let lease = link.heartbeat(Heartbeat { lease: 0, ..busy }).await.unwrap().unwrap();
    assert_eq!((lease.id, lease.seeds), (5, vec![1, 2]));
    assert_eq!(*lease.update, update(1));
    let beat = broadcast.with(|state| state.heartbeats[0].clone());
    assert_eq!((beat.actor.as_str(), beat.lease, beat.idle, beat.env_steps), ("actor-1", 4, false, 9));

    let result = EpisodeResult {
        episode_return: 4.6,
        max_head_height: 0.3,
        final_head_height: 0.1,
        rises: true,
        stands: false,
    };
    assert_eq!(link.report(5, vec![result; 2]).await, Ok(Reported::Accepted));
    let report = broadcast.with(|state| state.reports[0].clone());
    assert_eq!((report.lease, report.actor.as_str(), report.episodes.len()), (5, "actor-1", 2));
    assert_eq!(report.episodes[0].episode_return, 4.6);
    broadcast.with(|state| state.lease_lost = true);
    assert_eq!(link.report(5, vec![result; 2]).await, Ok(Reported::LeaseLost));

    server.kill();
    assert!(matches!(link.report(5, vec![]).await, Err(LinkError::Unavailable(_))));
}
