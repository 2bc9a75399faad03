//! `getup train`: all roles in one process. The same parts as in a cluster, without the network between them.

mod deterministic;
mod progress;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail, ensure};
use getup_actor::identity::Identity;
use getup_actor::worker;
use getup_learner::curriculum::Outcome;
use getup_learner::device::{self, Device};
use getup_learner::run_folder::RunFolder;
use getup_learner::trainer::{Ending, Start};
use getup_replay::{LocalSource, ReplayMetrics, Store};

use crate::config::{Config, ConfigArgs};
use crate::links::{HubLink, StoreWriter};
use crate::output::say;
use crate::role::{LogFormat, Role};
use crate::run::{check_run, load_beginning, make_hub, make_trainer, note_config, sample_options};

/// Train a character in one process: simulation, replay, learner and curriculum.
///
/// Everything a run leaves is in its folder. Ctrl-C saves and ends; `--resume` goes on.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    /// The run's folder. [default: `runs/` with preset and seed, such as runs/laptop-0]
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// Go on with the run in that folder, under its own config.toml.
    #[arg(long)]
    resume: bool,
    /// Begin a new run with the actor of this file: a model, or a checkpoint of another run, whose critics are taken too
    /// where they have the configured shape. Curriculum and counters begin anew.
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// Every random draw comes from it. [default: 0]
    #[arg(long, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    seed: Option<u64>,
    /// Env steps of the whole run; looked at once updates begin, after the uniform ones. [default: until the
    /// curriculum ends]
    #[arg(long)]
    steps: Option<u64>,
    /// One lane thread and a fixed interleaving: the same seed repeats evaluations.jsonl byte for byte on the same
    /// machine. Slower: simulation and updates take turns.
    #[arg(long)]
    deterministic: bool,
    /// cpu, or cuda for the first NVIDIA device. [default: the preset's]
    #[arg(long)]
    device: Option<String>,
    /// How log lines are written.
    #[arg(long, value_name = "FORMAT", default_value = "pretty")]
    log_format: LogFormat,
}

pub(crate) fn run(mut arguments: Args) -> Result<()> {
    let (config, folder) = prepare(&mut arguments)?;
    let role = Role::new("train", &config, arguments.log_format)?;
    // Before all else that libtorch does. Sums over threads depend on their number.
    let threads = if arguments.deterministic { 1 } else { config.learner.effective_threads() };
    let device = device::open(config.learner.device, threads)?;
    let beginning = arguments.from.as_deref().map(|path| load_beginning(&config, path)).transpose()?;
    let start = match (&beginning, arguments.resume) {
        (Some(beginning), _) => Start::From(beginning),
        (None, true) => Start::Newest,
        (None, false) => Start::Untrained,
    };
    let ending = if arguments.deterministic {
        role.run(async {
            tokio::task::block_in_place(|| deterministic::train(&config, &role, &folder, device, start))
        })
    } else {
        role.run(train(&config, &role, &folder, device, start))
    }?;
    conclude(ending, &folder);
    Ok(())
}

/// The run's configuration and folder, which is new unless the run is resumed.
fn prepare(arguments: &mut Args) -> Result<(Config, RunFolder)> {
    let shorthands = [
        arguments.seed.map(|seed| format!("seed={seed}")),
        arguments.steps.map(|steps| format!("steps={steps}")),
        arguments.device.as_ref().map(|device| format!("learner.device={device}")),
    ];
    arguments.config.set.extend(shorthands.into_iter().flatten());
    if arguments.resume {
        return prepare_resumed(arguments);
    }
    let mut config = arguments.config.load()?;
    let path = arguments.run.clone().unwrap_or_else(|| default_folder(&config));
    if path.join("config.toml").exists() {
        let shown = path.display();
        bail!(
            "{shown} holds a run already: go on with it by `--resume --run {shown}`, or choose another --run"
        );
    }
    name_after_folder(&mut config, &path);
    Ok((config, RunFolder::new(path)))
}

/// Where a run of this preset and seed is, unless `--run` says it.
fn default_folder(config: &Config) -> PathBuf {
    format!("runs/{}-{}", config.preset, config.seed).into()
}

fn prepare_resumed(arguments: &mut Args) -> Result<(Config, RunFolder)> {
    ensure!(
        arguments.config.config.is_none(),
        "--resume starts from the run's own config.toml, not from --config"
    );
    let path = match &arguments.run {
        Some(path) => path.clone(),
        None => default_folder(&arguments.config.load()?),
    };
    let preset = arguments.config.preset.take();
    let folder = RunFolder::new(path);
    let file = folder.config();
    ensure!(
        file.exists(),
        "--resume: there is no run in {}: name its folder with --run",
        folder.root().display()
    );
    arguments.config.config = Some(file);
    let config = arguments.config.load()?;
    if let Some(preset) = preset
        && preset != config.preset
    {
        bail!(
            "--resume: the run in {} has preset {}, not {preset}: leave --preset out, or train a new run",
            folder.root().display(),
            config.preset
        );
    }
    check_run(&config, &folder).context("--resume")?;
    Ok((config, folder))
}

/// A run that has no name of its own is called like its folder.
fn name_after_folder(config: &mut Config, path: &Path) {
    if config.run == Config::default().run
        && let Some(name) = path.file_name().and_then(|name| name.to_str())
    {
        config.run = name.to_owned();
    }
}

async fn train(
    config: &Config,
    role: &Role,
    folder: &RunFolder,
    device: Device,
    start: Start<'_>,
) -> Result<Ending> {
    serve_metrics(config, role).await?;
    let spec = config.run_spec()?;
    folder.create()?;
    let _lock = folder.lock()?;
    let store = open_store(config, role, folder)?;
    let (hub, incarnation) = make_hub(config, role, folder)?;
    let mut trainer =
        make_trainer(config, role, folder.clone(), Arc::clone(&hub), incarnation, device, start)?;
    let options = sample_options(config, incarnation);
    let mut source = LocalSource::new(Arc::clone(&store), options, "learner", role.shutdown.clone())?;
    note_config(config, folder)?;
    role.ready.set();
    let bar = progress::Progress::start(role, config, Arc::clone(&hub));

    let identity =
        Identity::of_start(&config.actor.name, config.seed, incarnation, |writer| store.knows(writer));
    let writer = StoreWriter::new(store, &identity, role.shutdown.clone());
    let setup = crate::actor::setup(config, role, identity, folder.root().join("diverged"))?;
    let link = HubLink { hub: Arc::clone(&hub), spec, name: config.actor.name.clone() };
    let mut acting = {
        let role = role.clone();
        tokio::spawn(async move {
            worker::run(setup, vec![writer], link, role.waits.clone(), role.shutdown.clone(), &role.registry)
                .await
        })
    };
    let shutdown = role.shutdown.clone();
    let mut training = tokio::task::spawn_blocking(move || trainer.run(&mut source, &shutdown));
    let (trained, acted) = tokio::select! {
        trained = &mut training => {
            role.shutdown.trigger();
            (trained, acting.await)
        }
        acted = &mut acting => {
            role.shutdown.trigger();
            (training.await, acted)
        }
    };
    bar.finish().await;
    let ending = trained.context("the training thread failed")?;
    acted.context("the actor failed")??;
    Ok(ending?)
}

fn open_store(config: &Config, role: &Role, folder: &RunFolder) -> Result<Arc<Store>> {
    let spec = config.run_spec()?;
    let metrics = ReplayMetrics::new(&role.registry);
    let store = Store::open(&folder.replay(), &spec, &config.replay_config(1), metrics, role.waits.clone())?;
    Ok(Arc::new(store.followed_by(role.traces.clone())))
}

/// Serves `/metrics`; where its port is taken, by another run on this machine, at any other.
async fn serve_metrics(config: &Config, role: &Role) -> Result<()> {
    let address = &config.network.learner_metrics;
    if let Err(error) = role.serve_metrics("network.learner_metrics", address).await {
        tracing::warn!("another port serves this run's metrics: {error:#}");
        role.serve_metrics("network.learner_metrics", "127.0.0.1:0").await?;
    }
    Ok(())
}

/// Says how training ended and what to try next.
fn conclude(ending: Ending, folder: &RunFolder) {
    let shown = folder.root().display();
    match ending {
        Ending::Curriculum(Outcome::FloorPassed { beta }) => {
            say!("Done: the curriculum went all the way, the weakest stage passed has β = {beta:.3}.");
        }
        Ending::Curriculum(Outcome::StageOutlasted { beta }) => {
            say!("Done: the curriculum is over, the weakest stage passed has β = {beta:.3}.");
        }
        Ending::Curriculum(Outcome::Settled { beta }) => {
            say!("Done: at β = {beta:.3} no evaluation was better than the best for long.");
        }
        Ending::Steps(steps) => say!("Done: {steps} env steps{}.", last_evaluation(folder)),
        Ending::Shutdown => {
            say!("Saved. Go on with: {} train --resume --run {shown}", program());
            return;
        }
    }
    let model = if folder.model("best").exists() { "best" } else { "last" };
    say!("Evaluations: {}", folder.evaluations().display());
    say!("Try it on unseen falls: {} evaluate {}", program(), folder.model(model).display());
    if let Ending::Steps(steps) = ending {
        let more = steps.saturating_mul(2);
        say!("Train it further: {} train --resume --run {shown} --steps {more}", program());
    }
}

/// What the newest evaluation found, where there is one.
fn last_evaluation(folder: &RunFolder) -> String {
    let text = std::fs::read_to_string(folder.evaluations()).unwrap_or_default();
    let line = text.lines().last().and_then(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    let found = line.and_then(|line| Some((line["mean"].as_f64()?, line["min"].as_f64()?)));
    found.map_or_else(String::new, |(mean, min)| {
        format!(", last evaluation: mean return {mean:.1}, minimum {min:.1}")
    })
}

/// How this program was called.
fn program() -> String {
    std::env::args().next().unwrap_or_else(|| "getup".into())
}
