//! Further tables of a replay, from a file: `getup replay --tables FILE`.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use getup_proto::{ColumnSpec, RunSpec};
use getup_replay::{DEFAULT_TABLE, ReplayConfig, ReplayMetrics, Store, Tables, check_table_name};

use crate::role::Role;

/// A table of the file.
#[derive(Clone, PartialEq, Debug)]
struct TableConfig {
    name: String,
    spec: RunSpec,
    settings: ReplayConfig,
}

/// Opens the tables of `file` beside the default one, each in `tables/NAME` of the store's folder `dir`.
pub(crate) fn open(
    mut tables: Tables,
    file: &Path,
    dir: &Path,
    run: &RunSpec,
    role: &Role,
) -> Result<Tables> {
    let text =
        std::fs::read_to_string(file).with_context(|| format!("cannot read --tables {}", file.display()))?;
    for table in parse(&text, run).with_context(|| format!("--tables {}", file.display()))? {
        let TableConfig { name, spec, settings } = table;
        let metrics = ReplayMetrics::of_table(&role.registry, &name);
        let folder = dir.join("tables").join(&name);
        let store = Store::open(&folder, &spec, &settings, metrics, role.waits.clone())?;
        tables = tables.with(&name, Arc::new(store.followed_by(role.traces.clone())))?;
    }
    Ok(tables)
}

/// A table's settings are those of a store; `columns` and `max_segment_steps` are the run's unless it has its own.
fn parse(text: &str, run: &RunSpec) -> Result<Vec<TableConfig>> {
    let file: toml::Table = text.parse()?;
    let table = |(name, value): (String, toml::Value)| {
        let parse = || -> Result<TableConfig> {
            check_table_name(&name)?;
            ensure!(name != DEFAULT_TABLE, "it is the run's own: its settings are those of [replay]");
            let mut settings: toml::Table =
                value.try_into().context("a table has settings, such as capacity")?;
            let mut spec = run.clone();
            if let Some(columns) = settings.remove("columns") {
                spec.columns = columns.try_into::<Vec<ColumnSpec>>().context("columns")?;
            }
            if let Some(steps) = settings.remove("max_segment_steps") {
                spec.max_segment_steps = steps.try_into().context("max_segment_steps")?;
            }
            spec.validate()?;
            let settings: ReplayConfig = toml::Value::Table(settings).try_into()?;
            settings.validate_for(&spec)?;
            Ok(TableConfig { name: name.clone(), spec, settings })
        };
        parse().with_context(|| format!("table `{name}`"))
    };
    file.into_iter().map(table).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use getup_proto::Rows;
    use getup_replay::{ItemSelector, Remover};

    fn run() -> RunSpec {
        let column = |name: &str, width, rows| ColumnSpec { name: name.to_owned(), width, rows };
        RunSpec {
            run: "test".to_owned(),
            task: "none/none".to_owned(),
            columns: vec![column("observation", 3, Rows::StepsPlusOne), column("reward", 1, Rows::Steps)],
            max_segment_steps: 64,
        }
    }

    #[test]
    fn tables_have_the_runs_spec_or_their_own() {
        let text = r#"
            [queue]
            capacity = 1000
            min_size = 1
            sampler = "fifo"
            max_times_sampled = 1
            samples_per_insert = 1.0
            error_buffer = 512.0

            [hard]
            sampler = { prioritized = { exponent = 0.6 } }
            remover = { lowest_priority = {} }
            max_segment_steps = 16
            columns = [{ name = "observation", width = 5, rows = "steps_plus_one" }]
        "#;
        let mut tables = parse(text, &run()).unwrap();
        tables.sort_by(|a, b| a.name.cmp(&b.name));
        let [hard, queue] = &tables[..] else { panic!("{tables:?}") };
        assert_eq!((queue.settings.sampler, queue.settings.max_times_sampled), (ItemSelector::Fifo, Some(1)));
        assert_eq!(queue.spec, run());
        assert_eq!(hard.settings.sampler, ItemSelector::Prioritized { exponent: 0.6 });
        assert_eq!(hard.settings.remover, Remover::LowestPriority { window: 4 });
        assert_eq!(queue.settings.remover, Remover::Fifo);
        assert_eq!((hard.spec.columns[0].width, hard.spec.max_segment_steps), (5, 16));
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (text, named) in [
            ("[default]\ncapacity = 1000", "it is the run's own"),
            ("[Upper]", "`Upper` cannot name a table"),
            ("[a]\nsize = 3", "unknown field `size`"),
            ("[a]\ncapacity = 3", "replay.capacity is 3"),
            ("[a]\nmax_times_sampled = 0", "max_times_sampled is 0"),
            ("[a]\nremover = { lowest_priority = {} }", "no priorities to go by"),
            ("[a]\nremover = { lowest_priority = { windows = 3 } }", "unknown field `windows`"),
            ("[a]\nremover = \"lifo\"", "unknown variant `lifo`, expected `fifo` or `lowest_priority`"),
            ("a = 3", "a table has settings"),
            ("[a]\ncolumns = []", "no columns"),
            ("[a", "TOML parse error"),
        ] {
            let error = format!("{:#}", parse(text, &run()).unwrap_err());
            assert!(error.contains(named), "{text}: {error}");
        }
    }
}
