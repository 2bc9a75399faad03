//! A rolling restart between two versions of the protocol: who speaks another is refused, is told who has to upgrade, and
//! disturbs nobody.

#![cfg(feature = "learner")]

mod common;

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::time::Duration;

use common::{Cluster, Process, wait_for};
use getup_proto::{OLDEST_PROTOCOL, PROTOCOL};
use prost::Message;

const LIMIT: Duration = Duration::from_secs(60);

/// Where `target` is reached by those of another version: on the way there, `ours` becomes `theirs`, as long.
fn in_other_words(target: &str, ours: &[u8], theirs: &[u8]) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let (target, ours, theirs) = (target.to_owned(), ours.to_owned(), theirs.to_owned());
    std::thread::spawn(move || {
        for client in listener.incoming() {
            let (client, Ok(service)) = (client.unwrap(), TcpStream::connect(&target)) else { continue };
            let (from_service, to_client) = (service.try_clone().unwrap(), client.try_clone().unwrap());
            let (ours, theirs) = (ours.clone(), theirs.clone());
            std::thread::spawn(move || {
                pass(client, service, |chunk| {
                    // A subscription and a heartbeat may come together.
                    while let Some(place) = chunk.windows(ours.len()).position(|window| window == ours) {
                        chunk[place..place + theirs.len()].copy_from_slice(&theirs);
                    }
                });
            });
            std::thread::spawn(move || pass(from_service, to_client, |_| {}));
        }
    });
    address
}

/// Until one of the two has ended.
fn pass(mut from: TcpStream, mut to: TcpStream, change: impl Fn(&mut [u8])) {
    let mut chunk = [0; 1 << 16];
    while let Ok(length @ 1..) = from.read(&mut chunk) {
        change(&mut chunk[..length]);
        if to.write_all(&chunk[..length]).is_err() {
            break;
        }
    }
    // They may have ended already.
    let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
}

#[test]
fn actors_of_another_version_are_refused_while_the_others_are_restarted_and_train() {
    let cluster = Cluster::new();
    // Nothing passes this threshold: the run goes on until it is told to end.
    let [replay, learner, mut actor] =
        ["replay", "learner", "actor"].map(|role| cluster.start(role, 1_000.0));
    let trains = |what: &str| {
        wait_for(what, LIMIT, || cluster.learner_metric("updates_total").filter(|updates| *updates >= 1.0));
        let before = cluster.learner_metric("updates_total").unwrap_or(0.0);
        wait_for(what, LIMIT, || {
            cluster.learner_metric("updates_total").filter(|updates| *updates >= before + 20.0)
        });
    };
    trains("updates");

    // What an actor of this run says of itself ends with its version.
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let described =
        runtime.block_on(async { getup_replay::describe(cluster.address("replay")).await }).unwrap();
    let ours = described.spec.unwrap().encode_to_vec();
    assert_eq!(ours.last().copied().map(u32::from), Some(PROTOCOL));
    let of_version = |version: u32| {
        let theirs = [&ours[..ours.len() - 1], &[version as u8]].concat();
        let [replay, learner] =
            ["replay", "learner"].map(|role| in_other_words(cluster.address(role), &ours, &theirs));
        move |cluster: &Cluster, name| {
            let mut command = cluster.command("actor", 1.0);
            command.args(["--set", &format!("network.replay={replay}")]);
            command.args(["--set", &format!("network.learner={learner}")]);
            command.args(["--set", "network.actor_metrics=127.0.0.1:0"]);
            Process::start(name, cluster.path(), &mut command)
        }
    };
    let start_old = of_version(OLDEST_PROTOCOL - 1);
    let start_new = of_version(PROTOCOL + 1);
    let is_refused = |mut process: Process, older: &str| {
        assert!(!process.wait(LIMIT).success(), "{}", process.log());
        let said = format!("upgrade the {older}");
        assert!(process.log().contains(&said), "{said}:\n{}", process.log());
    };

    is_refused(start_old(&cluster, "older"), "sender");
    is_refused(start_new(&cluster, "newer"), "receiver");
    trains("the others train on");
    let mut restarted = Vec::new();
    for (role, mut process) in [("replay", replay), ("learner", learner)] {
        process.signal("TERM");
        // It waits for the role that is away, and is refused by whoever is back first.
        let old = start_old(&cluster, "older");
        assert!(process.wait(LIMIT).success(), "{}", process.log());
        restarted.push(cluster.start(role, 1_000.0));
        is_refused(old, "sender");
        trains("after a restart");
    }
    actor.assert_running();
    // A learner that was restarted knows of nobody until the next heartbeat.
    let actors = wait_for("an actor that the learner knows of", LIMIT, || {
        let status = cluster.status()?;
        let actors = status["learner"]["actors"].as_array()?.len();
        (actors > 0).then_some(actors)
    });
    assert_eq!(actors, 1, "who was refused never took part");
}
