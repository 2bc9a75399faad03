//! `getup doctor`: checks this machine and a configuration before a run does.

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, bail, ensure};
use getup_sim::{GetUp, Task};
use serde::Serialize;

use crate::config::{Config, ConfigArgs};
use crate::output::say;

/// Seconds from 1970 to 2024: a clock before that was never set.
const CLOCK_IS_SET: u64 = 1_704_067_200;
/// The MuJoCo that recorded rollouts are compared with.
const MUJOCO: &str = "3.17.0";
const GIB: u64 = 1 << 30;

/// Check this machine and a configuration before a run does: libraries, ports, disk, memory, clock.
#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    config: ConfigArgs,
    /// The run's folder: where its disk space is needed.
    #[arg(long, value_name = "DIR", default_value = "runs/getup")]
    run: PathBuf,
    /// One JSON array on stdout.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Check {
    name: &'static str,
    good: bool,
    finding: String,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    let mut checks = Vec::new();
    let mut add = |name, result: Result<String>| {
        let good = result.is_ok();
        let finding = result.unwrap_or_else(|error| format!("{error:#}"));
        checks.push(Check { name, good, finding });
    };
    match arguments.config.load() {
        Ok(config) => {
            add("configuration", Ok(format!("preset {}", config.preset)));
            add("physics", physics(&config));
            #[cfg(feature = "learner")]
            add("tensors", crate::learner::check_device(&config));
            add("processor", processor(&config));
            add("memory", memory(&config));
            add("ports", ports(&config));
        }
        Err(error) => add("configuration", Err(error)),
    }
    add("disk", disk(&arguments.run));
    add("clock", clock());
    if arguments.json {
        say!("{}", serde_json::to_string(&checks).context("checks are not expressible as JSON")?);
    } else {
        for check in &checks {
            say!("{} {:14} {}", if check.good { "ok  " } else { "FAIL" }, check.name, check.finding);
        }
    }
    let failed = checks.iter().filter(|check| !check.good).count();
    if failed > 0 {
        bail!("{failed} of {} checks failed", checks.len());
    }
    Ok(())
}

fn physics(config: &Config) -> Result<String> {
    let task = GetUp::new(&config.task, config.control_limit())?;
    let (observation, action) = (task.observation_width(), task.action_width());
    let character = config.task.character;
    let version = getup_sim::mujoco_version();
    ensure!(
        version == MUJOCO,
        "MuJoCo {version} is loaded, not {MUJOCO}: run `cargo xtask setup` and build again"
    );
    Ok(format!(
        "MuJoCo {version} loads the {character} character: {observation} observed numbers, {action} motors"
    ))
}

fn processor(config: &Config) -> Result<String> {
    let cores = std::thread::available_parallelism().context("cannot count the cores")?.get();
    let threads = config.actor.threads;
    Ok(format!(
        "{cores} cores for {threads} lane threads and {} learner threads",
        config.learner.effective_threads()
    ))
}

fn memory(config: &Config) -> Result<String> {
    let text = std::fs::read_to_string("/proc/meminfo").context("cannot read /proc/meminfo")?;
    let available = text
        .lines()
        .find_map(|line| line.strip_prefix("MemAvailable:"))
        .and_then(|rest| rest.trim().trim_end_matches(" kB").trim().parse::<u64>().ok())
        .context("/proc/meminfo names no MemAvailable")?
        * 1024;
    let task = GetUp::new(&config.task, config.control_limit())?;
    let transition = 4 * (task.observation_width() + task.action_width() + 1) as u64;
    // The ring, what its store caches, and a floor for libraries and networks.
    let needed = config.replay.capacity as u64 * transition * 3 / 2 + GIB;
    let [needed_gib, available_gib] = [needed, available].map(|bytes| bytes as f64 / GIB as f64);
    if needed > available {
        bail!(
            "a full replay needs about {needed_gib:.1} GiB, {available_gib:.1} GiB are free: lower replay.capacity"
        );
    }
    Ok(format!("{available_gib:.1} GiB free, a full replay needs about {needed_gib:.1} GiB"))
}

fn ports(config: &Config) -> Result<String> {
    let network = &config.network;
    let mut addresses = vec![
        ("network.learner", &network.learner),
        ("network.replay_metrics", &network.replay_metrics),
        ("network.learner_metrics", &network.learner_metrics),
    ];
    // Of several replays each is on a machine of its own.
    if network.replays().len() == 1 {
        addresses.insert(0, ("network.replay", &network.replay));
    }
    for (name, address) in &addresses {
        TcpListener::bind(address).with_context(|| {
            format!("{name} = {address} cannot be bound: is a role running already? choose another with --set {name}=…")
        })?;
    }
    let addresses: Vec<&str> = addresses.iter().map(|(_, address)| address.as_str()).collect();
    Ok(addresses.join(", ") + " are free")
}

fn disk(run: &Path) -> Result<String> {
    let folder = run.ancestors().find(|folder| folder.exists()).unwrap_or(Path::new("."));
    let facts =
        rustix::fs::statvfs(folder).with_context(|| format!("cannot measure {}", folder.display()))?;
    let free = facts.f_bavail * facts.f_frsize;
    let gib = free as f64 / GIB as f64;
    if free < 2 * GIB {
        bail!(
            "{gib:.1} GiB free at {}: a run needs 2 GiB; free some, or choose another --run",
            folder.display()
        );
    }
    Ok(format!("{gib:.1} GiB free at {}", folder.display()))
}

fn clock() -> Result<String> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).context("the clock is before 1970")?.as_secs();
    if now < CLOCK_IS_SET {
        bail!("the clock says {now} s after 1970, before 2024: set it, or logs and metrics will mislead");
    }
    Ok("set".into())
}
