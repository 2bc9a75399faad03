//! `getup learner`: the learner as a process; and what the one-process trainer shares with it.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use getup_learner::beginning::Beginning;
use getup_learner::config::SacConfig;
use getup_learner::device::{self, Device};
use getup_learner::hub::Hub;
use getup_learner::hub_metrics::HubMetrics;
use getup_learner::run_folder::{RunFolder, write_atomically};
use getup_learner::sac::TaskShape;
use getup_learner::service::service;
use getup_learner::trainer::{Ending, Start, TrainError, Trainer, TrainerConfig};
use getup_replay::{RemoteOptions, SampleOptions, ShardedSource};
use getup_sim::{GetUp, Task};
use getup_telemetry::health;
use getup_transport::{Endpoint, Limits, Window};
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tonic::service::Routes;

use crate::config::Config;
use crate::role::{Role, RoleArgs, serve_grpc};

/// Minibatches that are on their way while one is trained on.
const PREFETCH: usize = 8;

/// Run the learner: trains on the replay's minibatches, broadcasts policies, leases evaluations, advances the
/// curriculum. It resumes the run it finds in its folder; when the curriculum has ended it goes on serving the final
/// policy until SIGTERM.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    role: RoleArgs,
    /// The run's folder: checkpoints, models, evaluations. [default: `runs/` and the run's name]
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// Where its folder holds no checkpoint yet, begin with the actor of this file: a model, or a checkpoint of another
    /// run, whose critics are taken too where they have the configured shape.
    #[arg(long, value_name = "FILE")]
    from: Option<PathBuf>,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    let config = arguments.role.config.load()?;
    let role = Role::new("learner", &config, arguments.role.log_format)?;
    let folder = RunFolder::new(arguments.run.unwrap_or_else(|| PathBuf::from("runs").join(&config.run)));
    let device = device::open(config.learner.device, config.learner.effective_threads())?;
    role.run(serve(&config, &role, folder, device, arguments.from.as_deref()))
}

async fn serve(
    config: &Config,
    role: &Role,
    folder: RunFolder,
    device: Device,
    from: Option<&Path>,
) -> Result<()> {
    check_run(config, &folder)?;
    let beginning = from.filter(|_| !folder.has_checkpoint()).map(load_beginning).transpose()?;
    let start = beginning.as_ref().map_or(Start::Newest, Start::From);
    folder.create()?;
    let (hub, incarnation) = make_hub(config, role, &folder)?;
    let address = &config.network.learner;
    let listener = role.bind_grpc(address).await?;
    tracing::info!("learner serves gRPC at {}", listener.local_addr()?);
    let mut trainer =
        make_trainer(config, role, folder.clone(), Arc::clone(&hub), incarnation, device, start)?;
    write_atomically(&folder.config(), config.to_toml()?.as_bytes())?;
    role.serve_metrics(&config.network.learner_metrics).await?;
    let (_reporter, health) = health();
    let routes = Routes::new(health).add_service(service(hub, role.shutdown.clone()));
    let port = role.port(Limits { window: Window::Adaptive, ..Limits::default() });
    let server = tokio::spawn(serve_grpc(port, routes, listener, role.shutdown.clone()));
    role.ready.set();
    let options = RemoteOptions {
        spec: config.run_spec()?,
        sample: sample_options(config, incarnation),
        name: "learner".into(),
        table: String::new(),
        prefetch: PREFETCH,
    };
    let runtime = tokio::runtime::Handle::current();
    let at = |address: &String| Endpoint::new(address, &role.credentials);
    let replays: Vec<Endpoint> = config.network.replays().iter().map(at).collect();
    let (waits, shutdown) = (role.waits.clone(), role.shutdown.clone());
    let mut source = ShardedSource::new(&replays, &options, &runtime, waits, shutdown);
    let shutdown = role.shutdown.clone();
    let result = tokio::task::spawn_blocking(move || trainer.run(&mut source, &shutdown)).await?;
    match &result {
        Err(TrainError::Loss(loss)) => {
            // Actors go on by the last good policy, and whoever looks sees why training does not: until it is restarted.
            tracing::error!("training stopped: {loss}");
            let _stopped = role.waits.begin("learner", format!("training stopped: {loss}"));
            role.shutdown.wait().await;
        }
        Ok(Ending::Shutdown) | Err(_) => {}
        Ok(_) => {
            tracing::info!("finished: serving the final policy until SIGTERM");
            role.shutdown.wait().await;
        }
    }
    role.shutdown.trigger();
    server.await??;
    Ok(result.map(drop)?)
}

/// A run goes on under the preset and the seed that it began with, whatever layer they come from now.
pub(crate) fn check_run(config: &Config, folder: &RunFolder) -> Result<()> {
    let Ok(text) = std::fs::read_to_string(folder.config()) else { return Ok(()) };
    let table: toml::Table = text.parse().with_context(|| folder.config().display().to_string())?;
    let preset = table.get("preset").and_then(|value| value.as_str()).unwrap_or(&config.preset);
    let root = folder.root().display();
    ensure!(
        preset == config.preset,
        "the run in {root} has preset {preset}, not {}: leave --preset as it was, or choose another --run",
        config.preset
    );
    let seed = table.get("seed").and_then(|value| value.as_integer()).map(|seed| seed as u64);
    let seed = seed.unwrap_or(Config::default().seed);
    ensure!(
        seed == config.seed,
        "the run in {root} has seed {seed}, not {}: its evaluations are drawn from it; leave the seed as it was, or \
         choose another --run",
        config.seed
    );
    Ok(())
}

/// Refuses what no run can begin with before anything is made for the run.
pub(crate) fn load_beginning(path: &Path) -> Result<Beginning> {
    Beginning::load(path).context("--from")
}

/// The meeting place of this learner and its actors, and the number of this start of a learner on the run.
pub(crate) fn make_hub(config: &Config, role: &Role, folder: &RunFolder) -> Result<(Arc<Hub>, u64)> {
    let incarnation = folder.next_incarnation()?;
    let seeds = evaluation_seeds(config.seed, config.evaluation.episodes);
    let keep_alive = Duration::from_secs_f64(config.evaluation.lease_seconds);
    let hub = Hub::new(config.run_spec()?, seeds, keep_alive, incarnation, role.waits.clone());
    let hub = Arc::new(hub);
    role.registry.register(Box::new(HubMetrics::new(Arc::downgrade(&hub))))?;
    Ok((hub, incarnation))
}

/// The seeds of a run's evaluations: the same fallen states throughout.
fn evaluation_seeds(run_seed: u64, episodes: usize) -> Vec<u64> {
    let mut rng = ChaCha8Rng::seed_from_u64(run_seed);
    (0..episodes).map(|_| rng.next_u64()).collect()
}

/// The trainer of this run.
pub(crate) fn make_trainer(
    config: &Config,
    role: &Role,
    folder: RunFolder,
    hub: Arc<Hub>,
    incarnation: u64,
    device: Device,
    start: Start<'_>,
) -> Result<Trainer> {
    let task = GetUp::new(&config.task, config.control_limit())?;
    let observation = task.observation_width();
    // A ring removes whole segments: it is never full to the last transition.
    let refill_steps = config.sac.refill_steps.min(config.replay.capacity as u64 / 2);
    let trainer = TrainerConfig {
        run: config.run.clone(),
        character: config.task.character.to_string(),
        physics_hz: config.task.physics_hz,
        seed: config.seed,
        replays: config.network.replays().len(),
        steps: (config.steps > 0).then_some(config.steps),
        // β̂ is the last number of an observation.
        shape: TaskShape { observation, action: task.action_width(), unnormalized: vec![observation - 1] },
        sac: SacConfig { refill_steps, ..config.sac.clone() },
        curriculum: config.curriculum.clone(),
        evaluation: config.evaluation.clone(),
        learner: config.learner.clone(),
    };
    let trainer = Trainer::new(trainer, folder, hub, incarnation, start, device, &role.registry)?;
    Ok(trainer.followed_by(role.traces.clone()))
}

/// How the learner samples; each of its starts draws other minibatches.
pub(crate) fn sample_options(config: &Config, incarnation: u64) -> SampleOptions {
    SampleOptions {
        batch: config.sac.batch,
        n_step: config.sac.n_step,
        gamma: config.sac.gamma as f32,
        seed: config.seed.wrapping_add(incarnation << 32),
        segments: false,
    }
}

/// What `getup doctor` says of libtorch and the configured device.
pub(crate) fn check_device(config: &Config) -> Result<String> {
    Ok(device::check(config.learner.device)?)
}
