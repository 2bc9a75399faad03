//! Who may reach a role's port: real processes with tokens and certificates, right, wrong and none.

#![cfg(feature = "learner")]

mod common;

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use common::{Cluster, Process, fail, getup, metric, scrape, succeed, wait_for};

const LIMIT: Duration = Duration::from_secs(60);

/// The settings of mutual TLS with the files of a folder.
fn tls(folder: &Path) -> Vec<String> {
    let setting = |key: &str, file: &str| format!("security.{key}={}", folder.join(file).display());
    vec![setting("ca", "ca.pem"), setting("certificate", "peer.pem"), setting("key", "peer.key")]
}

fn start(cluster: &Cluster, role: &'static str, settings: &[String]) -> Process {
    Process::start(role, cluster.path(), command(cluster, role, settings).args(["--log-format", "json"]))
}

fn command(cluster: &Cluster, role: &str, settings: &[String]) -> Command {
    let mut command = cluster.command(role, 1_000.0);
    command.args(settings.iter().flat_map(|setting| ["--set", setting.as_str()]));
    command
}

fn refused(cluster: &Cluster, reason: &str) -> f64 {
    let text = scrape(cluster.address("replay_metrics")).unwrap_or_default();
    let label = format!("reason=\"{reason}\"");
    let line =
        text.lines().find(|line| line.starts_with("getup_grpc_refused_total") && line.contains(&label));
    line.and_then(|line| line.rsplit(' ').next()?.parse().ok()).unwrap_or(0.0)
}

fn wait_for_env_steps(cluster: &Cluster, least: f64) {
    wait_for("transitions come", LIMIT, || {
        metric(cluster.address("replay_metrics"), "getup_replay_env_steps_total")
            .filter(|steps| *steps >= least)
    });
}

#[test]
fn with_certificates_the_roles_train_and_whoever_has_none_or_others_is_refused_and_counted() {
    let cluster = Cluster::new();
    let [ours, others] = ["ours", "others"].map(|name| cluster.path().join(name));
    for folder in [&ours, &others] {
        succeed(getup(&["certs"]).arg(folder));
    }
    let mut processes = ["replay", "learner", "actor"].map(|role| start(&cluster, role, &tls(&ours)));
    wait_for("updates are made", LIMIT, || {
        cluster.learner_metric("updates_total").filter(|updates| *updates >= 20.0)
    });
    // What a role says of itself is up to a second old, and between updates a learner may wait.
    wait_for("the status says so", LIMIT, || {
        succeed(&mut command(&cluster, "status", &tls(&ours))).contains("learner  training").then_some(())
    });

    let before = refused(&cluster, "handshake");
    for settings in [Vec::new(), tls(&others)] {
        let error = fail(&mut command(&cluster, "status", &settings));
        assert!(error.contains("no role answers"), "{error}");
    }
    wait_for("they are counted", LIMIT, || (refused(&cluster, "handshake") >= before + 2.0).then_some(()));

    // A new certificate of the same authority, while all run: a process that starts now has it, and the others take it.
    let renewed = succeed(getup(&["certs"]).arg(&ours));
    assert!(renewed.contains("peer.pem is new"), "{renewed}");
    processes[2].signal("KILL");
    processes[2].wait(LIMIT);
    let stored = metric(cluster.address("replay_metrics"), "getup_replay_env_steps_total").unwrap();
    processes[2] = start(&cluster, "actor", &tls(&ours));
    wait_for_env_steps(&cluster, stored + 200.0);

    let secret = std::fs::read_to_string(ours.join("peer.key")).unwrap();
    let secret = secret.lines().nth(1).unwrap();
    for process in &processes {
        assert!(!process.log().contains(secret), "a log holds the key");
    }
    for process in &mut processes {
        process.signal("TERM");
        assert!(process.wait(Duration::from_secs(10)).success(), "{}", process.log());
    }
}

#[test]
fn with_a_token_the_roles_meet_and_whoever_has_none_or_another_is_refused_by_what_to_do() {
    let cluster = Cluster::new();
    let secrets = cluster.path().join("secrets");
    succeed(getup(&["certs", "--token"]).arg(&secrets));
    let other = cluster.path().join("other");
    std::fs::write(&other, "another-token-altogether\n").unwrap();
    let with = |path: &Path| vec![format!("security.token_file={}", path.display())];
    let right = with(&secrets.join("token"));
    let mut metrics_too = right.clone();
    metrics_too.push(format!("security.metrics_token_file={}", other.display()));
    let mut replay = start(&cluster, "replay", &right);
    let mut actor = start(&cluster, "actor", &metrics_too);
    let mut learner = start(&cluster, "learner", &right);
    wait_for_env_steps(&cluster, 200.0);
    assert_eq!(scrape(cluster.address("actor_metrics")), None, "its metrics want a token too");

    for (settings, said) in [(Vec::new(), "this port wants a token"), (with(&other), "another token")] {
        let output = command(&cluster, "status", &settings).output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(
            !output.status.success() && text.contains(said) && text.contains("security.token_file"),
            "{text}"
        );
    }
    assert!(refused(&cluster, "token") >= 2.0);
    // An actor with another token ends, and says why.
    let mut stranger = command(&cluster, "actor", &with(&other));
    stranger.args(["--set", "network.actor_metrics=127.0.0.1:0"]);
    let error = fail(&mut stranger);
    assert!(error.contains("another token"), "{error}");

    let token = std::fs::read_to_string(secrets.join("token")).unwrap();
    // A replay that comes back with a token of its own, as where a new one reaches machines at different times: those that
    // it had let in wait until theirs is known.
    wait_for("updates", LIMIT, || cluster.learner_metric("updates_total").filter(|updates| *updates > 0.0));
    replay.signal("KILL");
    replay.wait(LIMIT);
    let unlike = cluster.path().join("unlike");
    std::fs::write(&unlike, "a-token-that-nobody-else-has-yet\n").unwrap();
    let mut replay = start(&cluster, "replay", &with(&unlike));
    wait_for("learner and actor are refused", LIMIT, || (refused(&cluster, "token") >= 4.0).then_some(()));
    std::fs::write(&unlike, &token).unwrap();
    let stored = metric(cluster.address("replay_metrics"), "getup_replay_env_steps_total").unwrap();
    wait_for_env_steps(&cluster, stored + 200.0);
    learner.assert_running();
    actor.assert_running();

    let run = std::fs::read_to_string(cluster.path().join("runs/smoke/config.toml")).unwrap();
    assert!(!run.contains(token.trim()), "the run's folder holds the token");
    for process in [&mut replay, &mut learner, &mut actor] {
        assert!(!process.log().contains(token.trim()), "a log holds the token");
        process.signal("TERM");
        assert!(process.wait(Duration::from_secs(10)).success(), "{}", process.log());
    }
}

#[test]
fn a_port_that_others_reach_is_not_opened_by_accident() {
    let cluster = Cluster::new();
    let port = cluster.address("replay").rsplit(':').next().unwrap();
    let open = vec![format!("network.replay=0.0.0.0:{port}")];
    let error = fail(&mut command(&cluster, "replay", &open));
    for way in ["security.token_file", "security.ca", "security.accept_open_port"] {
        assert!(error.contains(way), "{error}");
    }
    let meant = [open, vec!["security.accept_open_port=true".to_owned()]].concat();
    let mut replay = start(&cluster, "replay", &meant);
    wait_for("it says that it is open", LIMIT, || replay.log().contains("open to everyone").then_some(()));
    replay.signal("TERM");
    assert!(replay.wait(Duration::from_secs(10)).success());

    let half = vec!["security.ca=ca.pem".to_owned()];
    let error = fail(&mut command(&cluster, "replay", &half));
    assert!(error.contains("security.ca is set") && error.contains("security."), "{error}");
}

#[test]
fn health_says_whether_a_role_works() {
    let cluster = Cluster::new();
    let ask = || {
        let mut command = cluster.command("health", 1.0);
        command.arg("replay");
        command
    };
    let error = fail(&mut ask());
    assert!(error.contains("does not answer at"), "{error}");
    let mut replay = cluster.start("replay", 1.0);
    wait_for("it is healthy", LIMIT, || ask().output().unwrap().status.success().then_some(()));
    replay.signal("TERM");
    assert!(replay.wait(Duration::from_secs(10)).success());
}
