//! What a run's learner is made from, in a process of its own and beside the other roles in one.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use getup_learner::beginning::Beginning;
use getup_learner::config::SacConfig;
use getup_learner::device::Device;
use getup_learner::hub::Hub;
use getup_learner::hub_metrics::HubMetrics;
use getup_learner::run_folder::{RunFolder, write_atomically};
use getup_learner::sac::TaskShape;
use getup_learner::trainer::{Start, Trainer, TrainerConfig};
use getup_replay::SampleOptions;
use getup_sim::{GetUp, Task};
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::config::Config;
use crate::evaluate::in_run_folder;
use crate::role::Role;

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

/// Refuses what this run cannot begin with before anything is made for it.
pub(crate) fn load_beginning(config: &Config, path: &Path) -> Result<Beginning> {
    ensure!(!path.is_dir(), "--from {}: is a folder: {}", path.display(), in_run_folder(path));
    let load = || -> Result<Beginning> {
        let beginning = Beginning::load(path)?;
        beginning.check(&task_shape(config)?, &config.sac)?;
        Ok(beginning)
    };
    load().context("--from")
}

/// What SAC must know of this run's task.
fn task_shape(config: &Config) -> Result<TaskShape> {
    let task = GetUp::new(&config.task, config.control_limit())?;
    let observation = task.observation_width();
    // β̂ is the last number of an observation.
    Ok(TaskShape { observation, action: task.action_width(), unnormalized: vec![observation - 1] })
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
    // A ring removes whole segments: it is never full to the last transition.
    let refill_steps = config.sac.refill_steps.min(config.replay.capacity as u64 / 2);
    let trainer = TrainerConfig {
        run: config.run.clone(),
        character: config.task.character.to_string(),
        physics_hz: config.task.physics_hz,
        seed: config.seed,
        replays: config.network.replays().len(),
        steps: (config.steps > 0).then_some(config.steps),
        shape: task_shape(config)?,
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

/// Notes the configuration, once everything has accepted it: a refused change leaves the run as it was.
pub(crate) fn note_config(config: &Config, folder: &RunFolder) -> Result<()> {
    Ok(write_atomically(&folder.config(), config.to_toml()?.as_bytes())?)
}
