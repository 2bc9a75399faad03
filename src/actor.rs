//! `getup actor`: the actor as a process.

use std::path::PathBuf;

use anyhow::Result;
use getup_actor::config::ActorConfig;
use getup_actor::grpc::{GrpcLearner, GrpcReplay};
use getup_actor::identity::Identity;
use getup_actor::worker::{self, ActorSetup};
use getup_telemetry::health;
use getup_transport::{Endpoint, Limits};
use tonic::service::Routes;

use crate::config::Config;
use crate::role::{Role, RoleArgs, host_name};

/// Run an actor: simulates episodes under the newest policy, pushes them to the replay, plays leased evaluations.
///
/// It waits for replay and learner to be there, reconnects when they come back, and may be killed at any moment.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    role: RoleArgs,
    /// Names this actor in logs, metrics and `getup status`. [default: actor.name, or host name and process id]
    #[arg(long)]
    name: Option<String>,
    /// Where the states of simulations that diverged are kept, for `getup rollout`.
    #[arg(long, value_name = "DIR", default_value = "diverged")]
    diverged: PathBuf,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    let mut config = arguments.role.config.load()?;
    if let Some(name) = arguments.name {
        config.actor.name = name;
    } else if config.actor.name == ActorConfig::default().name {
        // Actors of one configuration are told apart.
        config.actor.name = format!("{}-{}", host_name(), std::process::id());
    }
    config.validate()?;
    let role = Role::new("actor", &config, arguments.role.log_format)?;
    role.run(serve(&config, &role, arguments.diverged))
}

async fn serve(config: &Config, role: &Role, diverged: PathBuf) -> Result<()> {
    let identity = Identity::new(&config.actor.name, config.seed);
    let setup = setup(config, role, identity.clone(), diverged)?;
    let network = &config.network;
    let waits = &role.waits;
    let at = |address: &str| Endpoint::new(address, &role.credentials);
    let writer = |(index, address): (usize, &String)| {
        GrpcReplay::new(at(address), setup.spec.clone(), identity.towards(index), waits.clone())
    };
    let writers = network.replays().iter().enumerate().map(writer).collect::<Result<Vec<_>, _>>()?;
    let link = GrpcLearner::new(at(&network.learner), setup.spec.clone(), &config.actor.name, waits.clone())?;
    role.serve_metrics("network.actor_metrics", &network.actor_metrics).await?;
    let listener = role.bind_grpc("network.actor", &network.actor).await?;
    tracing::info!(name = config.actor.name, health = %listener.local_addr()?, "actor started");
    let (port, routes) = (role.port(Limits::default()), Routes::new(health(role.shutdown.clone())));
    let server = tokio::spawn(port.serve(listener, routes, role.shutdown.clone()));
    role.ready.set();
    let result =
        worker::run(setup, writers, link, waits.clone(), role.shutdown.clone(), &role.registry).await;
    role.shutdown.trigger();
    server.await??;
    Ok(result?)
}

/// Everything that an actor of this run is made from.
pub(crate) fn setup(
    config: &Config,
    role: &Role,
    identity: Identity,
    diverged_folder: PathBuf,
) -> Result<ActorSetup> {
    Ok(ActorSetup {
        config: config.actor.clone(),
        task: config.task.clone(),
        spec: config.run_spec()?,
        identity,
        beta: config.beta_draw(),
        diverged_folder,
        traces: role.traces.clone(),
    })
}
