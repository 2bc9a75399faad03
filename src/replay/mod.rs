//! `getup replay`: the replay as a process, and tools for its store ([`tools`]).

mod tables;
mod tools;

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use getup_replay::{ReplayMetrics, Store, Tables, limits, serve_at};

use crate::config::{Config, NetworkConfig};
use crate::role::{Role, RoleArgs};

/// Run the replay: stores what actors push, durably, and serves minibatches to the learner.
///
/// With a subcommand: look at a store, mend it, copy it, or take its transitions elsewhere.
#[derive(clap::Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct Args {
    #[command(subcommand)]
    tool: Option<tools::Tool>,
    #[command(flatten)]
    role: RoleArgs,
    /// Which of the addresses in network.replay is this one's, from 0; needed where there are several.
    #[arg(long, value_name = "N")]
    shard: Option<usize>,
    /// The store's folder. [default: `replay` in the run's folder; of several replays `replay-N`]
    #[arg(long, value_name = "DIR")]
    dir: Option<PathBuf>,
    /// A TOML file of further tables, a section each: `[NAME]` with capacity, min_size, samples_per_insert,
    /// error_buffer, sync, sampler ("uniform", "fifo", "lifo", { prioritized = { exponent = 0.6 } }), max_times_sampled,
    /// remover ("fifo", { lowest_priority = { window = 4 } }); columns and max_segment_steps where they are not the run's.
    #[arg(long, value_name = "FILE")]
    tables: Option<PathBuf>,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    if let Some(tool) = arguments.tool {
        return tool.run();
    }
    let config = arguments.role.config.load()?;
    let role = Role::new("replay", &config, arguments.role.log_format)?;
    let shard = Shard::choose(&config.network, arguments.shard)?;
    let dir = arguments.dir.unwrap_or_else(|| PathBuf::from("runs").join(&config.run).join(shard.folder()));
    role.run(start(&config, &role, &shard, dir, arguments.tables))
}

/// Which of the run's replays this one is.
struct Shard {
    address: String,
    index: usize,
    of: usize,
}

impl Shard {
    fn choose(network: &NetworkConfig, index: Option<usize>) -> Result<Self> {
        let replays = network.replays();
        let of = replays.len();
        let asked = match index {
            None if of > 1 => bail!(
                "network.replay names {of} replays ({}): say which one this is by --shard 0 to {}",
                network.replay,
                of - 1
            ),
            asked => asked.unwrap_or(0),
        };
        let address = replays.into_iter().nth(asked);
        let address = address.with_context(|| {
            format!("--shard {asked}: network.replay ({}) names {of}, and they count from 0", network.replay)
        })?;
        Ok(Self { address, index: asked, of })
    }

    fn folder(&self) -> String {
        if self.of == 1 { "replay".into() } else { format!("replay-{}", self.index) }
    }
}

async fn start(
    config: &Config,
    role: &Role,
    shard: &Shard,
    dir: PathBuf,
    tables: Option<PathBuf>,
) -> Result<()> {
    let listener = role.bind_grpc("network.replay", &shard.address).await?;
    role.serve_metrics("network.replay_metrics", &config.network.replay_metrics).await?;
    std::fs::create_dir_all(&dir)
        .with_context(|| format!("cannot make the store's folder {}: choose another --dir", dir.display()))?;
    let (spec, settings) = (config.run_spec()?, config.replay_config(shard.of));
    let metrics = ReplayMetrics::new(&role.registry);
    tracing::info!("replay will serve gRPC at {}, its store is {}", listener.local_addr()?, dir.display());
    let (role_here, folder) = (role.clone(), dir.clone());
    let reading = role.waits.begin("replay", format!("the log in {} is read back", dir.display()));
    let opening = tokio::task::spawn_blocking(move || {
        let store = Store::open(&folder, &spec, &settings, metrics, role_here.waits.clone())?;
        let default = Tables::from(Arc::new(store.followed_by(role_here.traces.clone())));
        match tables {
            Some(file) => tables::open(default, &file, &folder, &spec, &role_here),
            None => Ok(default),
        }
    });
    let tables = tokio::select! {
        opened = opening => opened??,
        () = role.shutdown.wait() => return Ok(()),
    };
    drop(reading);
    role.ready.set();
    serve_at(role.port(limits()), listener, tables, role.shutdown.clone()).await?;
    tracing::info!("replay ended: everything acknowledged is stored");
    Ok(())
}
