//! docs/metrics.md names what the processes expose.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use crate::LIMIT;
use crate::common::{Cluster, metric, scrape, wait_for};

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
