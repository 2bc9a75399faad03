//! `getup evaluate`: a trained policy on falls it has not seen.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use getup_actor::evaluate::{EvaluatedEpisode, Evaluator};
use getup_policy::Policy;
use getup_sim::{Character, TaskConfig};
use serde::Serialize;

use crate::output::{check_place, progress_bar, say, write_file};

/// Lanes that are evaluated together.
const LANES: usize = 16;
/// Unseen seeds begin here: a run's own evaluations draw theirs from its seed.
const SEED_STRIDE: u64 = 1 << 32;

/// Measure a trained policy on falls it has not seen.
///
/// A fall `rises` if the head reaches 1.4 m at any step, and `stands` if it is at or above 1.4 m through the last 100
/// steps (2.5 s). Rates come with their 95 % Wilson intervals.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// A model file, such as runs/getup/models/best.safetensors.
    model: PathBuf,
    /// Falls to evaluate.
    #[arg(long, default_value_t = 100)]
    episodes: usize,
    /// Seed of the falls, under 2^32.
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..1 << 32))]
    seed: u64,
    /// Torque-limit multiplier, over 0 and at most 4. [default: the model's own]
    #[arg(long, allow_negative_numbers = true)]
    beta: Option<f64>,
    /// standard, cast or one_arm. [default: the model's own]
    #[arg(long)]
    character: Option<Character>,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
    /// Also write the episodes, for `getup rollout` or another MuJoCo to replay.
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
}

#[derive(Serialize)]
struct Report {
    rise_rate: f64,
    rise_rate_interval: [f64; 2],
    stand_rate: f64,
    stand_rate_interval: [f64; 2],
    mean_return: f64,
    min_return: f64,
    mean_max_head_height: f64,
    mean_final_head_height: f64,
    diverged: usize,
    beta: f64,
    character: String,
    episodes: usize,
    seed: u64,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    ensure!(
        (1..=1_000_000).contains(&arguments.episodes),
        "--episodes {}: from 1 to 1000000",
        arguments.episodes
    );
    if let Some(path) = &arguments.record {
        check_place(path)?;
    }
    let Actor { policy, beta, task } = Actor::load(&arguments.model, arguments.beta, arguments.character)?;
    let mut evaluator = Evaluator::new(&task, beta.max(1.0), LANES.min(arguments.episodes))?;
    let seeds = unseen_falls(arguments.seed, arguments.episodes);
    let bar = progress_bar(arguments.episodes as u64, "falls");
    let progress = |done: usize| {
        bar.set_position(done as u64);
        ControlFlow::Continue(())
    };
    let (episodes, recorded) = match &arguments.record {
        Some(path) => {
            let (episodes, file) = evaluator.record(&policy, beta, &seeds, progress)?;
            (episodes, Some((path, file)))
        }
        None => (evaluator.evaluate(&policy, beta, &seeds, progress)?, None),
    };
    bar.finish_and_clear();
    // Written before anything is printed, whose reader may go; reported after it, so that a failure costs no report.
    let written = recorded.map(|(path, file)| write_file(path, file.to_json()).map(|()| path)).transpose();
    let report = summarize(&episodes, beta, task.character, arguments.seed);
    if arguments.json {
        say!("{}", serde_json::to_string(&report).context("the report is not expressible as JSON")?);
    } else {
        print_report(&report);
    }
    if let Some(path) = written? {
        eprintln!("Episodes written to {}", path.display());
        let failed = episodes.iter().filter(|episode| episode.head_heights.is_empty()).count();
        if failed > 0 {
            eprintln!("{failed} falls failed, and are not in it");
        }
    }
    Ok(())
}

/// What to name in the place of a run's folder.
pub(crate) fn in_run_folder(folder: &Path) -> String {
    match folder.join("models/best.safetensors") {
        best if best.exists() => format!("name a file in it, such as {}", best.display()),
        _ => "name a file".to_owned(),
    }
}

/// The most that β may be, in training (`curriculum.beta_start`) and here.
const MOST_BETA: f64 = 4.0;

/// A model with what it is asked to act under: its own character and β, unless others are given, and its own physics rate.
pub(crate) struct Actor {
    pub(crate) policy: Policy,
    pub(crate) beta: f64,
    pub(crate) task: TaskConfig,
}

impl Actor {
    pub(crate) fn load(model: &Path, beta: Option<f64>, character: Option<Character>) -> Result<Self> {
        let shown = model.display();
        ensure!(!model.is_dir(), "{shown} is a folder: {}", in_run_folder(model));
        let policy = Policy::load(model).with_context(|| shown.to_string())?;
        let Some(beta) = beta.or_else(|| policy.number("beta")) else {
            bail!("the model names no beta: give one with --beta");
        };
        ensure!(beta > 0.0 && beta <= MOST_BETA, "--beta {beta}: over 0 and at most {MOST_BETA}");
        let character = match (character, policy.metadata.get("character")) {
            (Some(character), _) => character,
            (None, Some(name)) => name.parse().with_context(|| "the model's metadata")?,
            (None, None) => Character::Standard,
        };
        let mut task = TaskConfig { character, ..TaskConfig::default() };
        if let Some(physics_hz) = policy.metadata.get("physics_hz") {
            let unusable = || format!("the model's metadata: physics_hz = {physics_hz:?}");
            task.physics_hz = physics_hz.parse().with_context(unusable)?;
            task.validate().with_context(unusable)?;
        }
        Ok(Self { policy, beta, task })
    }
}

/// Seeds of the first `count` falls of `seed`, which no run draws.
pub(crate) fn unseen_falls(seed: u64, count: usize) -> Vec<u64> {
    (0..count as u64).map(|index| seed.wrapping_mul(SEED_STRIDE).wrapping_add(index)).collect()
}

fn summarize(episodes: &[EvaluatedEpisode], beta: f64, character: Character, seed: u64) -> Report {
    let count = episodes.len();
    let mean =
        |value: &dyn Fn(&EvaluatedEpisode) -> f64| episodes.iter().map(value).sum::<f64>() / count as f64;
    let rises = episodes.iter().filter(|episode| episode.rises()).count();
    let stands = episodes.iter().filter(|episode| episode.stands()).count();
    Report {
        rise_rate: rises as f64 / count as f64,
        rise_rate_interval: wilson_interval(rises, count),
        stand_rate: stands as f64 / count as f64,
        stand_rate_interval: wilson_interval(stands, count),
        mean_return: mean(&|episode| episode.episode_return),
        min_return: episodes.iter().map(|episode| episode.episode_return).fold(f64::INFINITY, f64::min),
        mean_max_head_height: mean(&EvaluatedEpisode::max_head_height),
        mean_final_head_height: mean(&EvaluatedEpisode::final_head_height),
        diverged: episodes.iter().filter(|episode| episode.diverged.is_some()).count(),
        beta,
        character: character.to_string(),
        episodes: count,
        seed,
    }
}

fn print_report(report: &Report) {
    let percent = |rate: f64, [low, high]: [f64; 2]| {
        format!("{:5.1} %  (95 %: {:.1} to {:.1})", 100.0 * rate, 100.0 * low, 100.0 * high)
    };
    say!("{} falls of the {} character, β = {}", report.episodes, report.character, report.beta);
    say!("  rise          {}", percent(report.rise_rate, report.rise_rate_interval));
    say!("  stand         {}", percent(report.stand_rate, report.stand_rate_interval));
    say!("  return        mean {:.2}, minimum {:.2}", report.mean_return, report.min_return);
    let (highest, last) = (report.mean_max_head_height, report.mean_final_head_height);
    say!("  head height   highest {highest:.2} m, at the end {last:.2} m (means)");
    if report.diverged > 0 {
        say!("  diverged      {} simulations", report.diverged);
    }
}

/// The 95 % interval of a rate (Wilson 1927), which holds at 0 and 1 too.
fn wilson_interval(hits: usize, count: usize) -> [f64; 2] {
    const Z: f64 = 1.959_963_985;
    let (n, p) = (count as f64, hits as f64 / count as f64);
    let centre = p + Z * Z / (2.0 * n);
    let half = Z * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    [centre - half, centre + half].map(|bound| (bound / (1.0 + Z * Z / n)).clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interval_is_wilsons() {
        // Reference: scipy.stats.binomtest(…).proportion_ci(method="wilson").
        for (hits, count, low, high) in [
            (0, 10, 0.0, 0.277_533),
            (10, 10, 0.722_467, 1.0),
            (99, 100, 0.945_514, 0.998_233),
            (45, 50, 0.786_398, 0.956_523),
        ] {
            let [ours_low, ours_high] = wilson_interval(hits, count);
            assert!(
                (ours_low - low).abs() < 1e-5 && (ours_high - high).abs() < 1e-5,
                "{ours_low} {ours_high}"
            );
        }
    }
}
