//! A configuration with what each setting means, in the words of the code's own documentation.

use documented::DocumentedFieldsOpt;
use getup_actor::config::ActorConfig;
use getup_learner::config::{CurriculumConfig, EvaluationConfig, LearnerConfig, SacConfig};
use getup_sim::TaskConfig;
use getup_telemetry::TracesConfig;
use getup_transport::SecurityConfig;

use super::{Config, NetworkConfig, ReplayTable};

/// A setting as it stands in a file.
pub(crate) struct Setting {
    /// Of its table; empty for the first ones.
    pub(crate) table: String,
    /// Its name in it.
    pub(crate) key: String,
    /// `key = value`, over one line or several.
    text: String,
}

impl Setting {
    /// The settings of a table and of those in it, in the order of the file: a table's own come first.
    pub(crate) fn all(name: &str, table: toml::Table) -> Result<Vec<Self>, toml::ser::Error> {
        let (mut own, mut others) = (Vec::new(), Vec::new());
        for (key, value) in table {
            if let toml::Value::Table(inner) = value {
                let inner_name = if name.is_empty() { key } else { format!("{name}.{key}") };
                others.extend(Self::all(&inner_name, inner)?);
            } else {
                let text = toml::to_string_pretty(&toml::Table::from_iter([(key.clone(), value)]))?;
                own.push(Self { table: name.to_owned(), key, text });
            }
        }
        own.append(&mut others);
        Ok(own)
    }

    /// What it means.
    pub(crate) fn meaning(&self) -> Option<&'static str> {
        // A setting with parts of its own is a table, which its first name explains.
        let (table, key) = match self.table.split_once('.') {
            Some((table, rest)) => (table, rest.split('.').next().unwrap_or(rest)),
            None => (self.table.as_str(), self.key.as_str()),
        };
        let docs = match table {
            "" => Config::get_field_docs(key),
            "task" => TaskConfig::get_field_docs(key),
            "actor" => ActorConfig::get_field_docs(key),
            "replay" => ReplayTable::get_field_docs(key),
            "sac" => SacConfig::get_field_docs(key),
            "curriculum" => CurriculumConfig::get_field_docs(key),
            "evaluation" => EvaluationConfig::get_field_docs(key),
            "learner" => LearnerConfig::get_field_docs(key),
            "network" => NetworkConfig::get_field_docs(key),
            "security" => SecurityConfig::get_field_docs(key),
            "traces" => TracesConfig::get_field_docs(key),
            _ => return None,
        };
        docs.ok()
    }
}

/// Settings as a file: each under its table, with what it means above it.
pub(crate) fn explained<'a>(settings: impl IntoIterator<Item = &'a Setting>) -> String {
    let (mut text, mut table) = (String::new(), "");
    for setting in settings {
        if setting.table != table {
            table = &setting.table;
            text += &format!("\n[{table}]\n");
        }
        for line in setting.meaning().unwrap_or_default().lines() {
            text += &format!("# {}\n", line.trim());
        }
        text += &setting.text;
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_setting_is_explained_and_the_file_is_the_same_configuration() {
        let remover = getup_replay::Remover::LowestPriority { window: 3 };
        let replay = ReplayTable { remover, priority_exponent: 0.5, ..ReplayTable::default() };
        // No name that anybody would choose.
        let run = "a = \"b\"\n\n[x]\nseed = 3".to_owned();
        let config = Config { replay, run, ..Config::default() };
        let settings = config.settings().unwrap();
        assert!(settings.len() > 80);
        for setting in &settings {
            let meaning = setting.meaning().unwrap_or_default();
            assert!(!meaning.is_empty(), "{}.{} is not explained", setting.table, setting.key);
            let elsewhere = meaning.contains("[`") || meaning.starts_with("See ");
            assert!(!elsewhere, "{}.{}: {meaning}", setting.table, setting.key);
        }
        assert_eq!(toml::from_str::<Config>(&explained(&settings)).unwrap(), config);
    }
}
