//! The ablation of the paper's Fig. 3a: the strong-to-weak curriculum against fixed torque limits.
//!
//! A [`Run`] is one [`Kind`] under one seed. It lies in `runs/ablation/<kind>-<seed>/`; at its end, what the figures
//! read of it is copied to `docs/runs/ablation/`. Each run is a `getup train` of its own, begun, resumed or skipped by
//! what its folder holds, so that the same command goes on wherever the last one was stopped.

use std::collections::VecDeque;
use std::fmt;
use std::fs::{self, File};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard};
use std::thread;

use anyhow::{Context, Result, bail, ensure};
use clap::builder::PossibleValuesParser;

use crate::native::root;
use crate::tasks;

/// Where the runs lie, from the repository's root.
const RUNS: &str = "runs/ablation";
/// Where what the figures read of them lies.
const PUBLIC: &str = "docs/runs/ablation";
/// What the figures read of a run.
const FILES: [&str; 3] = ["config.toml", "evaluations.jsonl", "timings.jsonl"];

/// How a run's torque limit is ruled.
struct Kind {
    name: &'static str,
    /// β throughout; none where the curriculum rules it.
    beta: Option<f64>,
}

static KINDS: [Kind; 5] = [
    Kind { name: "curriculum", beta: None },
    Kind { name: "fixed-100", beta: Some(1.0) },
    Kind { name: "fixed-60", beta: Some(0.6) },
    Kind { name: "fixed-50", beta: Some(0.5) },
    Kind { name: "fixed-40", beta: Some(0.4) },
];

/// The options of `cargo xtask ablate`.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Env steps of each run; the curriculum may end before.
    #[arg(long, value_name = "N", default_value_t = 600_000)]
    steps: u64,
    /// Every kind of run is trained once for each.
    #[arg(long, value_name = "SEEDS", value_delimiter = ',', default_value = "1,2")]
    seeds: Vec<u64>,
    /// Only the runs of this kind.
    #[arg(long, value_name = "NAME", value_parser = PossibleValuesParser::new(KINDS.iter().map(|kind| kind.name)))]
    only: Option<String>,
    /// Runs at once, on a machine with cores to spare: they share the cores, and each logs to
    /// runs/ablation/NAME-SEED.log.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::MIN)]
    concurrent: NonZeroUsize,
}

/// One kind under one seed; shown as the name of its folder.
struct Run {
    kind: &'static Kind,
    seed: u64,
}

impl fmt::Display for Run {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}-{}", self.kind.name, self.seed)
    }
}

/// Whether Ctrl-C was pressed: nothing begins any more.
static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// Trains every run that is not at its end.
pub(crate) fn ablate(args: &Args) -> Result<()> {
    let mut queue = VecDeque::new();
    for &seed in &args.seeds {
        for kind in &KINDS {
            if args.only.as_deref().is_none_or(|only| only == kind.name) {
                queue.push_back(Run { kind, seed });
            }
        }
    }
    let ablation = Ablation {
        getup: tasks::build()?,
        steps: args.steps,
        concurrent: args.concurrent.get(),
        queue: Mutex::new(queue),
    };
    fs::create_dir_all(root().join(RUNS)).with_context(|| format!("cannot make {RUNS}"))?;
    outlive_interrupts();
    let ended: Vec<Result<()>> = thread::scope(|scope| {
        let workers: Vec<_> = (0..ablation.concurrent).map(|_| scope.spawn(|| ablation.work_off())).collect();
        workers.into_iter().map(|worker| worker.join().expect("a worker does not panic")).collect()
    });
    ended.into_iter().collect::<Result<()>>()?;
    println!("Done. Next: cargo xtask plot");
    Ok(())
}

/// What the runs have in common.
struct Ablation {
    /// The program.
    getup: PathBuf,
    /// Env steps of a run.
    steps: u64,
    /// Runs at once.
    concurrent: usize,
    /// Runs that nobody has taken on yet.
    queue: Mutex<VecDeque<Run>>,
}

impl Ablation {
    /// Takes on one run after another. Where one does not reach its end, nobody begins a further one.
    fn work_off(&self) -> Result<()> {
        loop {
            let next = self.queue().pop_front();
            let Some(run) = next else { return Ok(()) };
            let done = self.complete(&run);
            if done.is_err() {
                self.queue().clear();
                return done;
            }
        }
    }

    fn queue(&self) -> MutexGuard<'_, VecDeque<Run>> {
        self.queue.lock().expect("nobody panics with the queue in hand")
    }

    /// Brings a run to its end, where it is not there yet, and copies what the figures read.
    fn complete(&self, run: &Run) -> Result<()> {
        ensure!(
            !INTERRUPTED.load(Ordering::Relaxed),
            "interrupted before {run}; `cargo xtask ablate` goes on there"
        );
        let folder = root().join(RUNS).join(run.to_string());
        // Not there before the first evaluation.
        let evaluations = fs::read_to_string(folder.join("evaluations.jsonl")).unwrap_or_default();
        if last_env_steps(&evaluations).is_some_and(|steps| steps >= self.steps) {
            println!("{run}: skipped, it has its {} env steps", self.steps);
        } else {
            self.train(run, &folder)?;
        }
        publish(run, &folder)
    }

    /// Begins the run, or resumes it. One whose curriculum is over says so again and ends at once.
    fn train(&self, run: &Run, folder: &Path) -> Result<()> {
        let mut command = Command::new(&self.getup);
        command.current_dir(root()).arg("train").arg("--run").arg(Path::new(RUNS).join(run.to_string()));
        command.args(["--steps", &self.steps.to_string()]);
        if folder.join("config.toml").exists() {
            println!("{run}: resumed");
            command.arg("--resume");
        } else {
            println!("{run}: begun");
            command.args(run.settings());
        }
        let mut log_place = String::new();
        if self.concurrent > 1 {
            let log = folder.with_extension("log");
            let file = File::options().create(true).append(true).open(&log);
            command.stderr(file.with_context(|| format!("cannot write {}", log.display()))?);
            let cores = thread::available_parallelism().map_or(1, usize::from);
            // A core of its share is for the rest, as where a run has the machine for itself.
            let threads = (cores / self.concurrent).saturating_sub(1).max(1);
            command.args(["--set", &format!("learner.threads={threads}")]);
            log_place = format!(", see {}", log.display());
        } else {
            command.stderr(Stdio::inherit());
        }
        // Standard output is how training ended, and nothing before.
        let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
        if !output.status.success() {
            bail!("{run}: getup train ended with {}{log_place}", output.status);
        }
        let said = String::from_utf8_lossy(&output.stdout);
        match said.lines().next() {
            Some(ending) if ending.starts_with("Done") => println!("{run}: {ending}"),
            _ => bail!("{run} was stopped before its end, and saved; `cargo xtask ablate` goes on there"),
        }
        Ok(())
    }
}

impl Run {
    /// The arguments of `getup train` that make a new run this one.
    fn settings(&self) -> Vec<String> {
        let seed = self.seed.to_string();
        let mut settings = ["--preset", "laptop", "--seed", &seed].map(str::to_owned).to_vec();
        if let Some(beta) = self.kind.beta {
            // The floor bounds β̂ too: it lies where the weakest kind is.
            for setting in ["fixed=true", &format!("beta_start={beta:?}"), "beta_floor=0.4", "beta_std=0"] {
                settings.extend(["--set".to_owned(), format!("curriculum.{setting}")]);
            }
        }
        settings
    }
}

/// Copies what the figures read of a run to where it is committed.
fn publish(run: &Run, folder: &Path) -> Result<()> {
    let public = root().join(PUBLIC).join(run.to_string());
    fs::create_dir_all(&public).with_context(|| format!("cannot make {}", public.display()))?;
    for file in FILES {
        fs::copy(folder.join(file), public.join(file))
            .with_context(|| format!("cannot copy {file} of {} to {}", folder.display(), public.display()))?;
    }
    Ok(())
}

/// Env steps of the last line of `evaluations.jsonl`; none where there is no line, or half a line.
fn last_env_steps(evaluations: &str) -> Option<u64> {
    let last: serde_json::Value = serde_json::from_str(evaluations.lines().last()?).ok()?;
    last["env_steps"].as_u64()
}

/// Ctrl-C reaches the runs from the terminal, and they save; this process waits for them, and begins no other.
fn outlive_interrupts() {
    extern "C" fn note(_: libc::c_int) {
        INTERRUPTED.store(true, Ordering::Relaxed);
    }
    // SAFETY: the handler only stores to a lock-free atomic, which a signal handler may. A program started later has
    // the default again: exec resets handlers.
    unsafe { libc::signal(libc::SIGINT, note as extern "C" fn(libc::c_int) as libc::sighandler_t) };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_as_far_as_its_last_evaluation() {
        let lines = "{\"version\":\"1.0\",\"env_steps\":0,\"mean\":4.6}\n\
                     {\"version\":\"1.92\",\"env_steps\":600030,\"mean\":61.0}\n";
        assert_eq!(last_env_steps(lines), Some(600_030));
        assert_eq!(last_env_steps(""), None);
        for cut in ["{\"version\":\"1.0\",\"env_st", "{\"version\":\"1.0\",\"env_steps\":600030,\"up"] {
            assert_eq!(last_env_steps(cut), None);
        }
    }

    #[test]
    fn a_fixed_run_keeps_its_beta_exactly_and_the_curriculum_is_the_preset() {
        let fixed = Run { kind: &KINDS[2], seed: 2 };
        assert_eq!(fixed.to_string(), "fixed-60-2");
        let settings = fixed.settings().join(" ");
        assert!(settings.starts_with("--preset laptop --seed 2 --set curriculum.fixed=true"), "{settings}");
        assert!(settings.contains("curriculum.beta_start=0.6 "), "{settings}");
        assert!(settings.ends_with("curriculum.beta_std=0"), "{settings}");
        let curriculum = Run { kind: &KINDS[0], seed: 1 };
        assert_eq!(curriculum.settings(), ["--preset", "laptop", "--seed", "1"]);
    }
}
