//! What operators see, held against a live fleet and a real Prometheus: every panel's query has an answer, every alert that
//! can be provoked here fires under its fault and clears after it, and docs/metrics.md names what the processes expose.

#![cfg(feature = "learner")]

mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use common::{Cluster, Process, free_address, getup, http_get, metric, scrape, succeed, wait_for};
use serde_json::Value;

const LIMIT: Duration = Duration::from_secs(60);

fn deploy(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy").join(path)
}

/// Whether Debian's Prometheus is there.
fn has_prometheus() -> bool {
    let there =
        Command::new("prometheus").arg("--version").output().is_ok_and(|output| output.status.success());
    if !there {
        println!("not checked: Prometheus is not installed (Debian: apt-get install prometheus)");
    }
    there
}

/// A fleet of four processes, and the Prometheus that scrapes it twice a second. The second actor's way to the learner
/// leads over a link.
struct Fleet {
    cluster: Cluster,
    /// Of the second actor.
    second_metrics: String,
    link: String,
    prometheus: String,
}

impl Fleet {
    fn new() -> Self {
        Self {
            cluster: Cluster::new(),
            second_metrics: free_address(),
            link: free_address(),
            prometheus: free_address(),
        }
    }

    /// The link, with what is wrong with it.
    fn link(&self, slowness: &[&str]) -> Process {
        let mut command = getup(&["delay", "--by", "0"]);
        command.args(slowness).arg(format!("{}={}", self.link, self.cluster.address("learner")));
        Process::start("link", self.cluster.path(), &mut command)
    }

    fn actor(&self, index: usize) -> Process {
        let name = ["actor-0", "actor-1"][index];
        let mut command = self.cluster.command("actor", 1_000.0);
        command.args(["--name", name, "--log-format", "json"]);
        if index == 1 {
            command.args(["--set", &format!("network.actor_metrics={}", self.second_metrics)]);
            command.args(["--set", &format!("network.learner={}", self.link)]);
        }
        Process::start(name, self.cluster.path(), &mut command)
    }

    /// A learner whose stages nobody passes or outlasts, with further settings.
    fn learner(&self, settings: &[&str]) -> Process {
        let mut command = self.cluster.command("learner", 1_000.0);
        command.args([
            "--log-format",
            "json",
            "--set",
            "curriculum.n_min=10000000",
            "--set",
            "curriculum.n_max=20000000",
        ]);
        command.args(settings.iter().flat_map(|setting| ["--set", *setting]));
        Process::start("learner", self.cluster.path(), &mut command)
    }

    /// A replay, on a disk of its own where there is one.
    fn replay(&self, disk: Option<&SmallDisk>) -> Process {
        let mut command = self.cluster.command("replay", 1_000.0);
        command.args(["--log-format", "json"]);
        if let Some(disk) = disk {
            command.arg("--dir").arg(disk.folder.path().join("store"));
        }
        Process::start("replay", self.cluster.path(), &mut command)
    }

    /// Scrapes this fleet by the jobs of the deployment, with its rules, their times a fifteenth as long.
    fn prometheus(&self) -> Process {
        let folder = self.cluster.path();
        let rules = fs::read_to_string(deploy("prometheus/rules/getup.yml")).unwrap();
        fs::write(folder.join("rules.yml"), hurried(&rules)).unwrap();
        let job = |name: &str, targets: &[&str]| {
            format!("  - job_name: {name}\n    static_configs: [{{ targets: {targets:?} }}]\n")
        };
        let address = |name: &str| self.cluster.address(name);
        let mut config =
            "global: { scrape_interval: 500ms, scrape_timeout: 500ms, evaluation_interval: 500ms }\n"
                .to_owned();
        config += "rule_files: [rules.yml]\nscrape_configs:\n";
        config += &job("replay", &[address("replay_metrics")]);
        config += &job("learner", &[address("learner_metrics")]);
        config += &job("actor", &[address("actor_metrics"), &self.second_metrics]);
        fs::write(folder.join("prometheus.yml"), config).unwrap();
        let mut command = Command::new("prometheus");
        command.args(["--config.file=prometheus.yml", "--storage.tsdb.path=tsdb", "--log.level=warn"]);
        command.arg(format!("--web.listen-address={}", self.prometheus)).current_dir(folder);
        let process = Process::start("prometheus", folder, &mut command);
        wait_for("Prometheus answers", LIMIT, || http_get(&self.prometheus, "/-/ready"));
        process
    }

    /// The samples of a query now.
    fn query(&self, query: &str) -> Vec<f64> {
        let encoded: String = query.bytes().map(|byte| format!("%{byte:02X}")).collect();
        let path = format!("/api/v1/query?query={encoded}");
        let answer =
            http_get(&self.prometheus, &path).unwrap_or_else(|| panic!("Prometheus answers {query}"));
        let answer: Value = serde_json::from_str(&answer).unwrap();
        assert_eq!(answer["status"], "success", "{query}: {answer}");
        let value = |sample: &Value| sample["value"][1].as_str()?.parse().ok();
        answer["data"]["result"].as_array().unwrap().iter().filter_map(value).collect()
    }

    fn is_firing(&self, alert: &str) -> bool {
        !self.query(&format!("ALERTS{{alertname=\"{alert}\", alertstate=\"firing\"}}")).is_empty()
    }

    fn wait_until_firing(&self, alert: &str) {
        wait_for(&format!("{alert} fires"), LIMIT, || self.is_firing(alert).then_some(()));
    }

    fn wait_until_clear(&self, alert: &str) {
        wait_for(&format!("{alert} clears"), LIMIT, || (!self.is_firing(alert)).then_some(()));
    }

    fn wait_for_updates(&self, more: f64) {
        let now = self.cluster.learner_metric("updates_total").unwrap_or(0.0);
        wait_for("updates are made", LIMIT, || {
            self.cluster.learner_metric("updates_total").filter(|updates| *updates >= now + more)
        });
    }
}

/// Rules whose times are a fifteenth as long.
fn hurried(rules: &str) -> String {
    let times = [
        ("for: 5m", "for: 8s"),
        ("for: 2m", "for: 4s"),
        ("for: 90s", "for: 4s"),
        ("for: 1m", "for: 3s"),
        ("for: 30s", "for: 2s"),
        ("for: 15s", "for: 1s"),
        ("[30s]", "[3s]"),
        ("seconds > 60", "seconds > 4"),
        // Not a fifteenth: an actor waits five seconds for the answer to a heartbeat before it sends another.
        ("seconds < 30", "seconds < 8"),
    ];
    let mut hurried = rules.to_owned();
    for (long, short) in times {
        assert!(hurried.contains(long), "no rule has {long:?} any more");
        hurried = hurried.replace(long, short);
    }
    assert!(!hurried.contains("for: 1m") && !hurried.contains("for: 2m"));
    hurried
}

/// A disk of a few megabytes, where this process may mount one.
struct SmallDisk {
    folder: tempfile::TempDir,
}

impl SmallDisk {
    fn new(size: &str) -> Option<Self> {
        let disk = Self { folder: tempfile::tempdir().unwrap() };
        disk.mount(&format!("size={size}")).then_some(disk)
    }

    fn mount(&self, options: &str) -> bool {
        let mounting = Command::new("mount")
            .args(["-t", "tmpfs", "-o", options, "tmpfs"])
            .arg(self.folder.path())
            .output();
        mounting.is_ok_and(|output| output.status.success())
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // One that was not mounted is not.
        let _ = Command::new("umount").arg(self.folder.path()).output();
    }
}

/// The queries of all dashboards, by where they stand.
fn panels() -> Vec<(String, String)> {
    let mut queries = Vec::new();
    for name in ["training", "fleet", "replay"] {
        let text = fs::read_to_string(deploy(&format!("grafana/dashboards/{name}.json"))).unwrap();
        let dashboard: Value = serde_json::from_str(&text).unwrap();
        for panel in dashboard["panels"].as_array().unwrap() {
            let title = format!("{name}: {}", panel["title"].as_str().unwrap());
            if panel["type"] == "text" {
                continue;
            }
            assert!(!panel["description"].as_str().unwrap_or("").is_empty(), "{title} has a description");
            let defaults = &panel["fieldConfig"]["defaults"];
            assert!(!defaults["unit"].as_str().unwrap_or("").is_empty(), "{title} has a unit");
            let targets = panel["targets"].as_array().unwrap();
            assert!(!targets.is_empty(), "{title} has a query");
            queries.extend(
                targets.iter().map(|target| (title.clone(), target["expr"].as_str().unwrap().to_owned())),
            );
        }
    }
    queries
}

/// As Grafana fills it in.
fn filled_in(query: &str) -> String {
    let values = [("$__rate_interval", "5s"), ("$run", "smoke"), ("$actor", ".*"), ("$table", ".*")];
    values.iter().fold(query.to_owned(), |query, (variable, value)| query.replace(variable, value))
}

#[test]
fn every_panel_has_an_answer_and_alerts_fire_under_their_faults_and_clear_after() {
    if !has_prometheus() {
        return;
    }
    let fleet = Fleet::new();
    let mut replay = fleet.replay(None);
    let mut learner = fleet.learner(&[]);
    let link = fleet.link(&[]);
    let actors = [fleet.actor(0), fleet.actor(1)];
    let _prometheus = fleet.prometheus();
    fleet.wait_for_updates(20.0);
    wait_for("an evaluation", LIMIT, || {
        fleet.cluster.learner_metric("evaluations_total").filter(|count| *count >= 2.0)
    });

    // Every query of every panel is answered by numbers.
    let mut unanswered: BTreeMap<(String, String), Vec<f64>> =
        panels().into_iter().map(|panel| (panel, Vec::new())).collect();
    let until = Instant::now() + LIMIT;
    while !unanswered.is_empty() && Instant::now() < until {
        unanswered.retain(|(_, query), found| {
            *found = fleet.query(&filled_in(query));
            found.is_empty() || found.iter().any(|value| value.is_nan())
        });
        std::thread::sleep(Duration::from_millis(500));
    }
    assert!(unanswered.is_empty(), "{unanswered:#?}");
    // They move: so does what they count.
    let updates = "sum(rate(getup_learner_updates_total{run=~\"smoke\"}[3s]))";
    assert!(fleet.query(updates)[0] > 0.0);
    for alert in [
        "LearnerStalled",
        "LossNotFinite",
        "ActorLost",
        "PolicyStale",
        "EvaluationOverdue",
        "LimiterStuck",
        "TargetDown",
    ] {
        assert!(!fleet.is_firing(alert), "{alert} fires in health");
    }

    // A way to the actor that is too narrow for policies: its heartbeats are heard, what it plays grows old.
    drop(link);
    let link = fleet.link(&["--back", "500"]);
    fleet.wait_until_firing("PolicyStale");
    assert_eq!(
        fleet.query("ALERTS{alertname=\"PolicyStale\", alertstate=\"firing\", actor!=\"actor-1\"}"),
        Vec::<f64>::new()
    );
    drop(link);
    let _link = fleet.link(&[]);
    fleet.wait_until_clear("PolicyStale");

    // A replay that hangs: no metrics from it, no updates.
    replay.signal("STOP");
    fleet.wait_until_firing("TargetDown");
    fleet.wait_until_firing("LearnerStalled");
    assert!(fleet.query(updates).iter().all(|rate| *rate == 0.0), "the panel shows it");
    replay.signal("CONT");
    fleet.wait_until_clear("TargetDown");
    fleet.wait_until_clear("LearnerStalled");

    // A learner that hangs: actors are ahead as far as they may.
    learner.signal("STOP");
    fleet.wait_until_firing("LimiterStuck");
    learner.signal("CONT");
    fleet.wait_until_clear("LimiterStuck");

    // Actors that hang while an evaluation is out: it is overdue, and they are lost.
    let hanging = || {
        wait_for("an evaluation is out", LIMIT, || {
            fleet.cluster.learner_metric("evaluations_outstanding").filter(|count| *count > 0.0)
        });
        actors.iter().for_each(|actor| actor.signal("STOP"));
        std::thread::sleep(Duration::from_millis(500));
        let out = fleet.cluster.learner_metric("evaluations_outstanding").unwrap() > 0.0;
        if !out {
            actors.iter().for_each(|actor| actor.signal("CONT"));
        }
        out.then_some(())
    };
    wait_for("actors hang while an evaluation is out", LIMIT, hanging);
    fleet.wait_until_firing("ActorLost");
    fleet.wait_until_firing("EvaluationOverdue");
    assert_eq!(fleet.query("count(ALERTS{alertname=\"ActorLost\", alertstate=\"firing\"})"), [2.0]);
    actors.iter().for_each(|actor| actor.signal("CONT"));
    fleet.wait_until_clear("ActorLost");
    fleet.wait_until_clear("EvaluationOverdue");

    // A temperature that grows without end: training stops, the process stays and says so. Back at the last checkpoint it goes on.
    learner.signal("TERM");
    assert!(learner.wait(LIMIT).success());
    let mut learner = fleet.learner(&["sac.temperature_lr=1", "sac.target_entropy=1000000.0"]);
    fleet.wait_until_firing("LossNotFinite");
    learner.assert_running();
    learner.signal("TERM");
    assert!(!learner.wait(LIMIT).success(), "it ends with its error");
    assert!(learner.log().contains("loss is"), "{}", learner.log());
    let mut learner = fleet.learner(&[]);
    fleet.wait_until_clear("LossNotFinite");
    fleet.wait_for_updates(20.0);

    // A disk that cannot hold the capacity.
    replay.signal("TERM");
    assert!(replay.wait(LIMIT).success());
    let Some(disk) = SmallDisk::new("3m") else {
        println!("not checked: a disk that is nearly full; this process may not mount a file system");
        return;
    };
    let mut replay = fleet.replay(Some(&disk));
    fleet.wait_until_firing("DiskNearlyFull");
    assert!(disk.mount("remount,size=64m"));
    fleet.wait_until_clear("DiskNearlyFull");
    fleet.wait_for_updates(5.0);
    for process in [&mut replay, &mut learner] {
        process.assert_running();
    }
}

#[test]
fn rules_pass_promtools_checks_and_unit_tests() {
    if !has_prometheus() {
        return;
    }
    let folder = deploy("prometheus");
    succeed(Command::new("promtool").args(["check", "rules", "rules/getup.yml"]).current_dir(&folder));
    succeed(
        Command::new("promtool").args(["test", "rules", "getup_test.yml"]).current_dir(folder.join("tests")),
    );
    let rules = fs::read_to_string(folder.join("rules/getup.yml")).unwrap();
    let runbook = fs::read_to_string(folder.join("../../docs/runbook.md")).unwrap();
    for alert in rules.lines().filter_map(|line| line.trim().strip_prefix("- alert: ")) {
        assert!(
            runbook.lines().any(|line| line.trim_start_matches('#').trim() == alert),
            "{alert} is in the runbook"
        );
    }
}

/// A metric, as docs/metrics.md shows it.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Debug)]
struct Metric {
    name: String,
    kind: String,
    labels: BTreeSet<String>,
    help: String,
}

/// The metrics in the text of `/metrics`.
fn metrics(text: &str) -> Vec<Metric> {
    let mut found: Vec<Metric> = Vec::new();
    for line in text.lines() {
        if let Some((name, help)) = line.strip_prefix("# HELP ").and_then(|rest| rest.split_once(' ')) {
            let (name, help) = (name.to_owned(), help.to_owned());
            found.push(Metric { name, kind: String::new(), labels: BTreeSet::new(), help });
        } else if let Some((_, kind)) = line.strip_prefix("# TYPE ").and_then(|rest| rest.split_once(' ')) {
            found.last_mut().unwrap().kind = kind.to_owned();
        } else if let Some((_, labels)) = line.split_once('{') {
            // No value of ours has a comma or an equals sign in it.
            let labels =
                labels.split('}').next().unwrap().split(',').filter_map(|label| label.split_once('='));
            let names = labels
                .map(|(name, _)| name.to_owned())
                .filter(|name| !["le", "run"].contains(&name.as_str()));
            found.last_mut().unwrap().labels.extend(names);
        }
    }
    found
}

#[test]
fn docs_name_every_metric_and_what_it_means() {
    let cluster = Cluster::new();
    let processes = ["replay", "learner", "actor"].map(|role| cluster.start(role, 1.0));
    wait_for("an evaluation and a wait", LIMIT, || {
        let evaluated = cluster.learner_metric("evaluations_total").filter(|count| *count >= 1.0);
        evaluated.filter(|_| cluster.learner_metric("gradient_norm").is_some())
    });
    let mut table = String::from(
        "# Metrics\n\nWhat each role serves at `/metrics`. Every metric also carries the run's name as the label `run`. \
         This file is made by `GETUP_UPDATE_DOCS=1 cargo test --release --test observability`, which also holds it against \
         what running processes expose.\n",
    );
    for role in ["replay", "learner", "actor"] {
        let address = cluster.address(&format!("{role}_metrics"));
        assert!(metric(address, "getup_build_info").is_some());
        let found = metrics(&scrape(address).unwrap());
        writeln!(
            table,
            "\n## {role}\n\n| metric | type | labels | what it says |\n| --- | --- | --- | --- |"
        )
        .unwrap();
        let common = |metric: &&Metric| metric.name.contains(role) != role.is_empty();
        for Metric { name, kind, labels, help } in found.iter().filter(common) {
            let labels = labels.iter().map(|label| format!("`{label}`")).collect::<Vec<_>>().join(", ");
            writeln!(table, "| `{name}` | {kind} | {labels} | {help} |").unwrap();
        }
    }
    writeln!(
        table,
        "\n## every role\n\n| metric | type | labels | what it says |\n| --- | --- | --- | --- |"
    )
    .unwrap();
    let found = metrics(&scrape(cluster.address("learner_metrics")).unwrap());
    for Metric { name, kind, labels, help } in found.iter().filter(|metric| !metric.name.contains("learner"))
    {
        let labels = labels.iter().map(|label| format!("`{label}`")).collect::<Vec<_>>().join(", ");
        writeln!(table, "| `{name}` | {kind} | {labels} | {help} |").unwrap();
    }
    drop(processes);
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/metrics.md");
    if std::env::var_os("GETUP_UPDATE_DOCS").is_some() {
        fs::write(&path, &table).unwrap();
    }
    let documented = fs::read_to_string(&path).unwrap_or_default();
    let missing: Vec<&str> = table.lines().filter(|line| !documented.contains(line)).collect();
    let gone: Vec<&str> = documented.lines().filter(|line| !table.contains(line)).collect();
    assert!(
        missing.is_empty() && gone.is_empty(),
        "docs/metrics.md is not up to date; lacking: {missing:#?}; gone: {gone:#?}"
    );
}
