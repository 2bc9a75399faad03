//! `getup learner`: the learner as a process.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Result;
use getup_learner::device::{self, Device};
use getup_learner::run_folder::RunFolder;
use getup_learner::service::service;
use getup_learner::trainer::{Ending, Start, TrainError};
use getup_replay::{RemoteOptions, ShardedSource};
use getup_telemetry::health;
use getup_transport::{Endpoint, Limits, Window};
use tonic::service::Routes;

use crate::config::Config;
use crate::role::{Role, RoleArgs};
use crate::run::{check_run, load_beginning, make_hub, make_trainer, note_config, sample_options};

/// Minibatches that are on their way while one is trained on.
const PREFETCH: usize = 8;

/// Run the learner: trains on the replay's minibatches, broadcasts policies, leases evaluations, advances the curriculum.
///
/// It resumes the run it finds in its folder; when the curriculum has ended it goes on serving the final policy until
/// SIGTERM.
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
    let beginning = from.filter(|_| !folder.has_checkpoint());
    let beginning = beginning.map(|path| load_beginning(config, path)).transpose()?;
    let start = beginning.as_ref().map_or(Start::Newest, Start::From);
    folder.create()?;
    let _lock = folder.lock()?;
    let (hub, incarnation) = make_hub(config, role, &folder)?;
    // Before all that takes long, so that whoever probes sees that it starts.
    role.serve_metrics("network.learner_metrics", &config.network.learner_metrics).await?;
    let address = &config.network.learner;
    let listener = role.bind_grpc("network.learner", address).await?;
    tracing::info!("learner serves gRPC at {}", listener.local_addr()?);
    let mut trainer =
        make_trainer(config, role, folder.clone(), Arc::clone(&hub), incarnation, device, start)?;
    note_config(config, &folder)?;
    let health = health(role.shutdown.clone());
    let routes = Routes::new(health).add_service(service(hub, role.shutdown.clone()));
    let port = role.port(Limits { window: Window::Adaptive, ..Limits::default() });
    let server = tokio::spawn(port.serve(listener, routes, role.shutdown.clone()));
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

/// What `getup doctor` says of libtorch and the configured device.
pub(crate) fn check_device(config: &Config) -> Result<String> {
    Ok(device::check(config.learner.device)?)
}
