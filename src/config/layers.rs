//! How a configuration is layered: defaults, preset, file, environment, `--set`; each over the ones before.
//!
//! The known settings are those of the default configuration: nothing is listed twice.

use std::ffi::OsString;

use anyhow::{Context, Result, anyhow, bail};
use toml::{Table, Value};

use super::Config;

/// The presets: a name, and the settings in which it differs from the defaults.
pub(super) const PRESETS: [(&str, &str); 5] = [
    ("smoke", include_str!("../presets/smoke.toml")),
    ("laptop", include_str!("../presets/laptop.toml")),
    ("standing", include_str!("../presets/standing.toml")),
    ("paper", include_str!("../presets/paper.toml")),
    ("gpu", include_str!("../presets/gpu.toml")),
];

/// Environment variables with our prefix that are no settings: the preset, and what the cluster's compose files are told.
const NOT_SETTINGS: [&str; 12] = [
    PRESET_VARIABLE,
    "GETUP_IMAGE",
    "GETUP_TAG",
    "GETUP_SETTINGS",
    "GETUP_GRAFANA_PORT",
    "GETUP_PROMETHEUS_PORT",
    "GETUP_REPLAY_CPUS",
    "GETUP_REPLAY_MEMORY",
    "GETUP_LEARNER_CPUS",
    "GETUP_LEARNER_MEMORY",
    "GETUP_ACTOR_CPUS",
    "GETUP_ACTOR_MEMORY",
];
/// How names of others begin: of the tests and benchmarks.
const OTHER_PREFIXES: [&str; 7] = [
    "GETUP_TEST_",
    "GETUP_UPDATE_",
    "GETUP_SIMULATION_",
    "GETUP_SOAK_",
    "GETUP_FLEET_",
    "GETUP_PEERS_",
    "GETUP_REVERB_",
];
/// Chooses the preset where the command line does not.
pub(super) const PRESET_VARIABLE: &str = "GETUP_PRESET";

/// The layers so far, merged.
pub(crate) struct Layers {
    known: Table,
    merged: Table,
}

impl Layers {
    /// The defaults alone.
    pub(crate) fn new() -> Result<Self> {
        let known = Table::try_from(Config::default()).context("the defaults are not expressible in TOML")?;
        Ok(Self { merged: known.clone(), known })
    }

    /// A preset by its name.
    pub(crate) fn preset(&mut self, name: &str) -> Result<()> {
        let Some((_, text)) = PRESETS.iter().find(|(preset, _)| *preset == name) else {
            let names = PRESETS.map(|(preset, _)| preset);
            bail!(
                "no preset {name:?}{}; there are {}",
                nearest(name, names.iter().copied()),
                names.join(", ")
            );
        };
        self.overlay(&format!("preset {name}"), text.parse().context("a preset is not TOML")?)?;
        self.merged.insert("preset".into(), name.into());
        Ok(())
    }

    /// A table of settings, from a source that errors name.
    pub(crate) fn overlay(&mut self, source: &str, table: Table) -> Result<()> {
        check_known(source, "", &table, &self.known)?;
        merge(&mut self.merged, table);
        self.parse().map(drop).with_context(|| source.to_owned())
    }

    /// Variables such as `GETUP_SAC__BATCH=256`.
    pub(crate) fn environment(
        &mut self,
        variables: impl Iterator<Item = (OsString, OsString)>,
    ) -> Result<()> {
        let ours = variables.filter_map(|(name, value)| Some((name.into_string().ok()?, value)));
        let mut settings: Vec<(String, OsString)> =
            ours.filter(|(name, _)| name.starts_with("GETUP_") && !is_no_setting(name)).collect();
        settings.sort();
        for (name, value) in settings {
            let key = name["GETUP_".len()..].to_lowercase().replace("__", ".");
            let value = value.into_string().map_err(|value| anyhow!("{name}: {value:?} is not UTF-8"))?;
            self.set(&name, &format!("{key}={value}"))?;
        }
        Ok(())
    }

    /// One `key=value`. The value is TOML where it parses and fits, and else text.
    pub(crate) fn set(&mut self, source: &str, assignment: &str) -> Result<()> {
        let Some((key, text)) = assignment.split_once('=') else {
            bail!("{source}: {assignment:?} is not of the form KEY=VALUE, such as sac.batch=256");
        };
        let (key, text) = (key.trim(), text.trim());
        if key == "preset" {
            bail!("{source}: a preset is a layer of its own: choose it with --preset {text}");
        }
        check_known(source, "", &nested(key, Value::Boolean(true)), &self.known)?;
        let as_toml =
            format!("value = {text}").parse::<Table>().ok().and_then(|mut table| table.remove("value"));
        let as_text = Value::String(text.to_owned());
        let mut first_error = None;
        for value in as_toml.into_iter().chain([as_text]) {
            let before = self.merged.clone();
            match self.overlay(source, nested(key, value)) {
                Ok(()) => return Ok(()),
                Err(error) => {
                    self.merged = before;
                    first_error.get_or_insert(error);
                }
            }
        }
        Err(first_error.expect("text is always tried"))
            .with_context(|| format!("cannot set {key} to {text:?}"))
    }

    /// The configuration, valid.
    pub(crate) fn finish(self) -> Result<Config> {
        let config = self.parse()?;
        config.validate()?;
        Ok(config)
    }

    fn parse(&self) -> Result<Config> {
        Value::Table(self.merged.clone())
            .try_into()
            .map_err(|error: toml::de::Error| anyhow!("{}", error.to_string().trim()))
    }
}

/// Whether a variable with our prefix is there for something else.
fn is_no_setting(name: &str) -> bool {
    NOT_SETTINGS.contains(&name) || OTHER_PREFIXES.iter().any(|beginning| name.starts_with(beginning))
}

/// `a.b = value` as tables.
fn nested(key: &str, value: Value) -> Table {
    let (first, rest) = key.split_once('.').map_or((key, None), |(first, rest)| (first, Some(rest)));
    let value = match rest {
        Some(rest) => Value::Table(nested(rest, value)),
        None => value,
    };
    Table::from_iter([(first.to_owned(), value)])
}

fn merge(into: &mut Table, from: Table) {
    for (key, value) in from {
        match (into.get_mut(&key), value) {
            (Some(Value::Table(into)), Value::Table(from)) => merge(into, from),
            (_, value) => drop(into.insert(key, value)),
        }
    }
}

fn check_known(source: &str, prefix: &str, table: &Table, known: &Table) -> Result<()> {
    for (key, value) in table {
        let path = format!("{prefix}{key}");
        match (known.get(key), value) {
            (Some(Value::Table(known)), Value::Table(table)) => {
                check_known(source, &format!("{path}."), table, known)?;
            }
            (Some(Value::Table(known)), _) => {
                let members: Vec<String> = known.keys().map(|member| format!("{path}.{member}")).collect();
                bail!("{source}: {path} is a table; its settings are {}", members.join(", "));
            }
            (Some(_), _) => {}
            (None, _) => {
                let mut names = Vec::new();
                leaves("", &known_root(known, prefix), &mut names);
                let suggestion = nearest(&path, names.iter().map(String::as_str));
                bail!("{source}: unknown setting {path}{suggestion}");
            }
        }
    }
    Ok(())
}

/// `known` again under its own prefix, so that its leaves have their full names.
fn known_root(known: &Table, prefix: &str) -> Table {
    match prefix.trim_end_matches('.') {
        "" => known.clone(),
        path => nested(path, Value::Table(known.clone())),
    }
}

fn leaves(prefix: &str, table: &Table, names: &mut Vec<String>) {
    for (key, value) in table {
        match value {
            Value::Table(table) => leaves(&format!("{prefix}{key}."), table, names),
            _ => names.push(format!("{prefix}{key}")),
        }
    }
}

/// "; did you mean …?" where a name is near.
fn nearest<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> String {
    let near =
        known.map(|known| (strsim::jaro_winkler(name, known), known)).max_by(|a, b| a.0.total_cmp(&b.0));
    match near {
        Some((similarity, known)) if similarity > 0.8 => format!("; did you mean {known}?"),
        _ => String::new(),
    }
}
