//! A live fleet and the Prometheus that scrapes it.

use std::fs;
use std::process::Command;

use serde_json::Value;

use crate::common::{Cluster, Process, free_address, getup, http_get, wait_for};
use crate::small_disk::SmallDisk;
use crate::{LIMIT, deploy};

/// A fleet of four processes, and the Prometheus that scrapes it twice a second. The second actor's way to the learner
/// leads over a link.
pub(crate) struct Fleet {
    pub(crate) cluster: Cluster,
    /// Of the second actor.
    second_metrics: String,
    link: String,
    prometheus: String,
}

impl Fleet {
    pub(crate) fn new() -> Self {
        Self {
            cluster: Cluster::new(),
            second_metrics: free_address(),
            link: free_address(),
            prometheus: free_address(),
        }
    }

    /// The link, with what is wrong with it.
    pub(crate) fn link(&self, slowness: &[&str]) -> Process {
        let mut command = getup(&["delay", "--by", "0"]);
        command.args(slowness).arg(format!("{}={}", self.link, self.cluster.address("learner")));
        Process::start("link", self.cluster.path(), &mut command)
    }

    pub(crate) fn actor(&self, index: usize) -> Process {
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
    pub(crate) fn learner(&self, settings: &[&str]) -> Process {
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
    pub(crate) fn replay(&self, disk: Option<&SmallDisk>) -> Process {
        let mut command = self.cluster.command("replay", 1_000.0);
        command.args(["--log-format", "json"]);
        if let Some(disk) = disk {
            command.arg("--dir").arg(disk.folder.path().join("store"));
        }
        Process::start("replay", self.cluster.path(), &mut command)
    }

    /// Scrapes this fleet by the jobs of the deployment, with its rules, their times a fifteenth as long.
    pub(crate) fn prometheus(&self) -> Process {
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
    pub(crate) fn query(&self, query: &str) -> Vec<f64> {
        let encoded: String = query.bytes().map(|byte| format!("%{byte:02X}")).collect();
        let path = format!("/api/v1/query?query={encoded}");
        let answer =
            http_get(&self.prometheus, &path).unwrap_or_else(|| panic!("Prometheus answers {query}"));
        let answer: Value = serde_json::from_str(&answer).unwrap();
        assert_eq!(answer["status"], "success", "{query}: {answer}");
        let value = |sample: &Value| sample["value"][1].as_str()?.parse().ok();
        answer["data"]["result"].as_array().unwrap().iter().filter_map(value).collect()
    }

    pub(crate) fn is_firing(&self, alert: &str) -> bool {
        !self.query(&format!("ALERTS{{alertname=\"{alert}\", alertstate=\"firing\"}}")).is_empty()
    }

    pub(crate) fn wait_until_firing(&self, alert: &str) {
        wait_for(&format!("{alert} fires"), LIMIT, || self.is_firing(alert).then_some(()));
    }

    pub(crate) fn wait_until_clear(&self, alert: &str) {
        wait_for(&format!("{alert} clears"), LIMIT, || (!self.is_firing(alert)).then_some(()));
    }

    pub(crate) fn wait_for_updates(&self, more: f64) {
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
