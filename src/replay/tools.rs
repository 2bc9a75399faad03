//! What can be done with a replay's store from outside: inspect, verify, repair, compact, export, snapshot.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use clap::{Subcommand, ValueEnum};
use getup_replay::{DatasetId, Exported, Rewritten, Survey, export_minari, export_npz};
use getup_transport::{Credentials, Endpoint};
use serde_json::json;

use crate::config::{ConfigArgs, reached_at};
use crate::output::{progress_bar, say};

/// A tool and its arguments.
#[derive(Subcommand)]
pub(crate) enum Tool {
    /// Say what a store holds: counts, spec, writers, space. Also of one in use.
    Inspect {
        /// The store's folder, such as runs/laptop-0/replay.
        dir: PathBuf,
        /// One JSON object on stdout.
        #[arg(long)]
        json: bool,
    },
    /// Check every segment of a store against its checksums and totals; fails if anything is wrong.
    Verify {
        /// The store's folder, such as runs/laptop-0/replay.
        dir: PathBuf,
        /// One JSON object on stdout.
        #[arg(long)]
        json: bool,
    },
    /// Mend a damaged store: keeps every whole segment, and says what it dropped.
    ///
    /// The files as they were are moved to damaged-N/ in the store's folder; remove that when nothing is missed.
    Repair {
        /// The store's folder, such as runs/laptop-0/replay.
        dir: PathBuf,
        /// One JSON object on stdout.
        #[arg(long)]
        json: bool,
    },
    /// Write a store anew, without what is no longer needed.
    Compact {
        /// The store's folder, such as runs/laptop-0/replay.
        dir: PathBuf,
        /// Keep the newest N transitions alone (whole segments). [default: all]
        #[arg(long, value_name = "N")]
        keep: Option<u64>,
        /// One JSON object on stdout.
        #[arg(long)]
        json: bool,
    },
    /// Write a store's transitions for other tools: NumPy's .npz, or a Minari dataset. A damaged store is refused.
    Export {
        /// The store's folder, such as runs/laptop-0/replay. It may be in use.
        dir: PathBuf,
        /// What to write.
        #[arg(long, value_enum)]
        format: Format,
        /// Where to: a file for npz, a folder for minari. [default: replay.npz, or the dataset's name]
        #[arg(long, value_name = "PATH")]
        output: Option<PathBuf>,
        /// Minari's name for the dataset, as `namespace/name-v0`. [default: getup/RUN-v0]
        #[arg(long, value_name = "ID")]
        id: Option<String>,
        /// One JSON object on stdout.
        #[arg(long)]
        json: bool,
    },
    /// Have a running replay copy its store to snapshots/NAME in its folder, while it goes on.
    Snapshot {
        /// The copy's name: letters, digits, `-`, `_` and `.`.
        name: String,
        /// The table whose store is copied. [default: default]
        #[arg(long, value_name = "NAME")]
        table: Option<String>,
        #[command(flatten)]
        config: ConfigArgs,
        /// One JSON object on stdout.
        #[arg(long)]
        json: bool,
    },
}

/// What an export is written as.
#[derive(Clone, Copy, ValueEnum)]
pub(crate) enum Format {
    /// One file, an array a column, a row a transition.
    Npz,
    /// A folder, a dataset of episodes.
    Minari,
}

impl Tool {
    pub(crate) fn run(self) -> Result<()> {
        match self {
            Self::Inspect { dir, json } => print_survey(&survey(&dir)?, json),
            Self::Verify { dir, json } => {
                let survey = survey(&dir)?;
                print_survey(&survey, json)?;
                match survey.damages.len() {
                    0 => Ok(()),
                    1 => {
                        bail!("the store is damaged: `getup replay repair {}` keeps the rest", dir.display())
                    }
                    n => bail!(
                        "the store is damaged in {n} ways: `getup replay repair {}` keeps the rest",
                        dir.display()
                    ),
                }
            }
            Self::Repair { dir, json } => print_rewritten(&getup_replay::repair(&dir)?, json),
            Self::Compact { dir, keep, json } => print_rewritten(&getup_replay::compact(&dir, keep)?, json),
            Self::Export { dir, format, output, id, json } => export(&dir, format, output, id, json),
            Self::Snapshot { name, table, config, json } => {
                snapshot(&name, &table.unwrap_or_default(), &config, json)
            }
        }
    }
}

fn survey(dir: &Path) -> Result<Survey> {
    let bar = progress_bar(0, "segments");
    let survey = Survey::read(dir, |_| bar.inc(1))?;
    bar.finish_and_clear();
    Ok(survey)
}

fn print_survey(survey: &Survey, json: bool) -> Result<()> {
    if json {
        say!("{}", serde_json::to_string(survey)?);
        return Ok(());
    }
    let Survey { spec, ever, .. } = survey;
    say!("run       {}, task {}", spec.run, spec.task);
    let columns = spec.columns.iter().map(|column| format!("{} {}", column.name, column.width));
    say!("columns   {}", columns.collect::<Vec<_>>().join(", "));
    say!(
        "holds     {} transitions ({} env steps) in {} segments, {} ends of episodes",
        survey.transitions,
        survey.env_steps,
        survey.segments,
        survey.episodes
    );
    say!(
        "ever      {} transitions ({} env steps) in {} segments, {} episodes",
        ever.transitions,
        ever.env_steps,
        ever.segments,
        ever.episodes
    );
    say!("sampled   {}", survey.sampled.map_or_else(|| "unknown".to_owned(), |n| format!("{n} transitions")));
    say!("writers   {}", survey.writers.len());
    say!(
        "space     {:.1} MB on disk in {} files, for {:.1} MB of values",
        survey.disk_bytes as f64 / 1e6,
        survey.files,
        survey.value_bytes as f64 / 1e6
    );
    for damage in &survey.damages {
        say!("damage    {damage}");
    }
    if survey.damages.is_empty() {
        say!("whole     every segment passes its checks");
    }
    Ok(())
}

fn print_rewritten(rewritten: &Rewritten, json: bool) -> Result<()> {
    if json {
        say!("{}", serde_json::to_string(rewritten)?);
        return Ok(());
    }
    let Rewritten { found, segments, transitions, old } = rewritten;
    for damage in &found.damages {
        say!("damage    {damage}");
    }
    let left_out = found.segments - segments;
    match old {
        Some(old) => {
            say!("kept      {transitions} transitions in {segments} segments: all that are whole");
            if left_out > 0 {
                say!("dropped   {left_out} segments that were there twice");
            }
            say!("old files {}", old.display());
        }
        None if left_out > 0 => {
            say!(
                "kept      the newest {transitions} transitions, in {segments} segments; dropped {left_out} segments"
            );
        }
        None => {
            say!("kept      all {transitions} transitions, in {segments} segments: the store is whole")
        }
    }
    Ok(())
}

fn export(dir: &Path, format: Format, output: Option<PathBuf>, id: Option<String>, json: bool) -> Result<()> {
    ensure!(
        id.is_none() || matches!(format, Format::Minari),
        "--id names a Minari dataset: leave it out with npz"
    );
    let survey = survey(dir)?;
    ensure!(
        survey.damages.is_empty(),
        "the store is damaged, and an export would leave out what is missing: {}. `getup replay repair {}` keeps the \
         rest, which can be exported then",
        survey.damages.join("; "),
        dir.display()
    );
    let (spec, segments) = getup_replay::segments(dir)?;
    let bar = progress_bar(survey.transitions, "transitions");
    let progress = |transitions| bar.set_position(transitions);
    let (path, exported) = match format {
        Format::Npz => {
            let path = output.unwrap_or_else(|| PathBuf::from("replay.npz"));
            let exported = export_npz(&path, &spec, segments, progress)?;
            (path, exported)
        }
        Format::Minari => {
            let (path, id) = dataset(output, id, &spec.run)?;
            let exported = export_minari(&path, &id, &spec, segments, progress)?;
            (path, exported)
        }
    };
    bar.finish_and_clear();
    let Exported { transitions, episodes, unfinished } = exported;
    if json {
        say!(
            "{}",
            json!({"path": path, "transitions": transitions, "episodes": episodes, "unfinished": unfinished})
        );
    } else {
        say!(
            "{}: {transitions} transitions of {episodes} episodes, {unfinished} of them without their end",
            path.display()
        );
    }
    Ok(())
}

/// Where a dataset goes and what it is called: each follows from the other, or both from the run.
fn dataset(output: Option<PathBuf>, id: Option<String>, run: &str) -> Result<(PathBuf, DatasetId)> {
    let parse = |id: &str| id.parse::<DatasetId>().with_context(|| format!("--id {id}"));
    match (output, id) {
        (Some(path), Some(id)) => Ok((path, parse(&id)?)),
        (Some(path), None) => {
            let root = std::env::var_os("MINARI_DATASETS_PATH").map(PathBuf::from);
            let root = root.or_else(|| Some(std::env::home_dir()?.join(".minari/datasets")));
            let id = DatasetId::of_folder(&path, root.as_deref());
            Ok((path, id.context("no name for the dataset follows from --output: give it one by --id")?))
        }
        (None, id) => {
            let id = id.unwrap_or_else(|| format!("getup/{run}-v0"));
            Ok((PathBuf::from(&id), parse(&id)?))
        }
    }
}

#[tokio::main(flavor = "current_thread")]
async fn snapshot(name: &str, table: &str, config: &ConfigArgs, json: bool) -> Result<()> {
    let config = config.load()?;
    let credentials = Credentials::load(&config.security)?;
    for address in config.network.replays() {
        snapshot_of(&Endpoint::new(&reached_at(&address), &credentials), name, table, json).await?;
    }
    Ok(())
}

async fn snapshot_of(endpoint: &Endpoint, name: &str, table: &str, json: bool) -> Result<()> {
    let address = &endpoint.address;
    let taken = getup_replay::take_snapshot(endpoint.clone(), table, name).await;
    let taken = taken
        .map_err(|status| anyhow::anyhow!("replay at {address}: {}", getup_transport::reason(&status)))?;
    let transitions = taken.counters.unwrap_or_default().transitions;
    if json {
        let (paused, seconds) = (taken.paused_seconds, taken.seconds);
        let counted = json!({"path": taken.path, "paused_seconds": paused, "seconds": seconds, "transitions": transitions});
        say!("{counted}");
    } else {
        say!(
            "{}: {transitions} transitions ever stored, copied in {:.2} s; appends waited {:.1} ms",
            taken.path,
            taken.seconds,
            1e3 * taken.paused_seconds
        );
    }
    Ok(())
}
