//! `getup chaos`: a plan of faults against a running cluster, and whether it heals.

use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use getup_telemetry::Shutdown;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::output::say;

/// How often a cluster is asked how it is.
const TICK: Duration = Duration::from_millis(500);
/// Between the faults of a soak.
const PAUSE: Duration = Duration::from_secs(20);
/// Seconds that a fault may hold, or its end may take.
const LONGEST: Duration = Duration::from_secs(24 * 3600);
/// An actor that was heard from more recently takes part.
const HEARD_SECONDS: f64 = 5.0;

/// Break a running cluster by a plan, fault by fault, and see it heal.
///
/// The plan is a TOML file. `prelude` is shell code put before every command, `observe` a command that prints `getup
/// status --json` of the cluster. Each `[[fault]]` has a `name`, a command `inject`, perhaps a command `heal`, `hold`
/// (seconds between the two) and `within` (seconds in which the cluster must be well again). It is well when the learner
/// makes updates, the replay stores env steps, and as many actors are heard as before; with `trains = true` it must be so
/// while the fault holds, too. And it must never have lost anything: what the replays hold, the curriculum's stage, and
/// the policies' versions only grow. A fault whose command `needs` fails is skipped. What was injected is healed also
/// where `inject` failed halfway, and after Ctrl-C, which ends the plan; after a second one it is not.
///
/// Commands find this program as $GETUP. deploy/chaos.toml is the plan for a cluster of docker compose.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The plan.
    #[arg(long, value_name = "FILE")]
    plan: PathBuf,
    /// Only faults whose name contains this; may be repeated.
    #[arg(long, value_name = "TEXT")]
    only: Vec<String>,
    /// Go on for so many minutes with faults drawn at random, twenty seconds apart, instead of each once.
    #[arg(long, value_name = "MINUTES")]
    soak: Option<f64>,
    /// Which faults a soak draws.
    #[arg(long, default_value_t = 0, requires = "soak")]
    seed: u64,
    /// List the faults and break nothing.
    #[arg(long)]
    list: bool,
    /// Yes, break the cluster: without it nothing is done.
    #[arg(long)]
    yes: bool,
    /// One JSON object a fault on stdout.
    #[arg(long)]
    json: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Plan {
    #[serde(default)]
    prelude: String,
    observe: String,
    fault: Vec<Fault>,
    /// Somebody asked for the end.
    #[serde(skip)]
    interrupted: Shutdown,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Fault {
    name: String,
    inject: String,
    #[serde(default)]
    heal: String,
    #[serde(default)]
    needs: String,
    #[serde(default)]
    hold: f64,
    #[serde(default)]
    trains: bool,
    #[serde(default = "default_within")]
    within: f64,
}

fn default_within() -> f64 {
    10.0
}

/// How a fault ended.
#[derive(Serialize)]
struct Outcome<'a> {
    fault: &'a str,
    passed: bool,
    /// The cluster lacks what the fault needs: it was not tried.
    skipped: bool,
    /// From the end of the fault until the cluster was well.
    recovered_seconds: Option<f64>,
    problem: Option<String>,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    let shown = arguments.plan.display();
    let text =
        std::fs::read_to_string(&arguments.plan).with_context(|| format!("cannot read the plan {shown}"))?;
    let plan: Plan = toml::from_str(&text).with_context(|| format!("{shown} is no plan"))?;
    for Fault { name, hold, within, .. } in &plan.fault {
        let longest = LONGEST.as_secs_f64();
        ensure!(
            [hold, within].into_iter().all(|seconds| (0.0..=longest).contains(seconds)),
            "{shown}: fault {name:?}: hold = {hold}, within = {within}: seconds, from 0 to {longest}"
        );
    }
    let chosen = |fault: &&Fault| {
        arguments.only.is_empty() || arguments.only.iter().any(|text| fault.name.contains(text.as_str()))
    };
    let faults: Vec<&Fault> = plan.fault.iter().filter(chosen).collect();
    if faults.is_empty() {
        let names: Vec<&str> = plan.fault.iter().map(|fault| fault.name.as_str()).collect();
        bail!("--only: no fault of {shown} has such a name; there are: {}", names.join(", "));
    }
    if arguments.list {
        faults.iter().for_each(|fault| say!("{}", fault.name));
        return Ok(());
    }
    ensure!(
        arguments.yes,
        "this breaks the cluster, on purpose, in {} ways: say --yes to do it, --list to see how",
        faults.len()
    );
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    runtime.block_on(async { plan.interrupted.on_signals() }).context("cannot watch for signals")?;
    let mut failed = 0;
    for fault in plan.sequence(faults, arguments.soak, arguments.seed) {
        if plan.interrupted.is_triggered() {
            bail!("interrupted");
        }
        let outcome = plan.try_fault(fault);
        failed += usize::from(!outcome.passed && !outcome.skipped);
        if arguments.json {
            say!("{}", serde_json::to_string(&outcome)?);
        } else {
            let recovered = outcome.recovered_seconds;
            let recovered =
                recovered.map_or_else(String::new, |seconds| format!(", well again after {seconds:.1} s"));
            let problem = outcome.problem.as_ref().map_or_else(String::new, |problem| format!(": {problem}"));
            let verdict = match outcome {
                Outcome { skipped: true, .. } => "skip",
                Outcome { passed: true, .. } => "pass",
                _ => "FAIL",
            };
            say!("{verdict} {}{recovered}{problem}", fault.name);
        }
    }
    ensure!(failed == 0, "the cluster did not come through {failed} of its faults");
    Ok(())
}

impl Plan {
    /// Every fault once; or for some minutes one at random after another, with a pause before each.
    fn sequence<'a>(
        &'a self,
        faults: Vec<&'a Fault>,
        soak: Option<f64>,
        seed: u64,
    ) -> Box<dyn Iterator<Item = &'a Fault> + 'a> {
        let Some(minutes) = soak else { return Box::new(faults.into_iter()) };
        let until = Instant::now() + Duration::from_secs_f64(60.0 * minutes.clamp(0.0, 1e6));
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        Box::new(std::iter::from_fn(move || {
            self.pause(PAUSE);
            (Instant::now() < until).then(|| faults[rng.random_range(0..faults.len())])
        }))
    }

    /// Waits, until somebody asks for the end.
    fn pause(&self, time: Duration) {
        let until = Instant::now() + time;
        while !self.interrupted.is_triggered() && Instant::now() < until {
            std::thread::sleep(TICK.min(until.saturating_duration_since(Instant::now())));
        }
    }

    fn try_fault<'a>(&self, fault: &'a Fault) -> Outcome<'a> {
        if !fault.needs.is_empty()
            && let Err(error) = self.shell(&fault.needs)
        {
            let problem = Some(format!("{error:#}"));
            return Outcome {
                fault: &fault.name,
                passed: false,
                skipped: true,
                recovered_seconds: None,
                problem,
            };
        }
        let (recovered, problem) = match self.break_and_watch(fault) {
            Ok(recovered) if recovered.as_secs_f64() <= fault.within => (Some(recovered), None),
            Ok(recovered) => (Some(recovered), Some(format!("it may take {} s", fault.within))),
            Err(error) => (None, Some(format!("{error:#}"))),
        };
        Outcome {
            fault: &fault.name,
            passed: problem.is_none(),
            skipped: false,
            recovered_seconds: recovered.map(|time| time.as_secs_f64()),
            problem,
        }
    }

    /// From the end of the fault until the cluster is well.
    fn break_and_watch(&self, fault: &Fault) -> Result<Duration> {
        // Whatever was broken before must be well, or this fault would be blamed for it.
        let patience = Duration::from_secs(60);
        let before = self.wait_until_well(None, Instant::now(), patience).context("before the fault")?.0;
        if let Err(error) = self.shell(&fault.inject) {
            self.heal_what_there_is(fault);
            return Err(error.context("inject"));
        }
        let (injected, hold) = (Instant::now(), Duration::from_secs_f64(fault.hold));
        let during = fault.trains.then(|| self.wait_until_well(Some(&before), injected, hold));
        self.pause(hold.saturating_sub(injected.elapsed()));
        if let Err(error) = self.shell(&fault.heal) {
            self.heal_what_there_is(fault);
            return Err(error.context("heal"));
        }
        during.transpose().context("during the fault")?;
        // Later than it may, it is still worth knowing when.
        let patience = Duration::from_secs_f64(fault.within + 60.0);
        Ok(self.wait_until_well(Some(&before), Instant::now(), patience)?.1)
    }

    /// Where only some of a fault is there, since its injection failed or something else happened meanwhile: runs each command
    /// of the heal, whether those before it have found something or not.
    fn heal_what_there_is(&self, fault: &Fault) {
        let _ = self.shell(&format!("set +e\n{}", fault.heal));
    }

    /// Watches until the cluster works as before, and that it lost nothing on the way.
    fn wait_until_well(
        &self,
        before: Option<&Health>,
        since: Instant,
        patience: Duration,
    ) -> Result<(Health, Duration)> {
        let mut first: Option<Health> = None;
        let mut why = "nobody answers".to_owned();
        while since.elapsed() < patience {
            ensure!(!self.interrupted.is_triggered(), "interrupted");
            match self.observe() {
                Ok(now) => {
                    if let Some(before) = before {
                        now.check_kept(before)?;
                    }
                    let begun = first.get_or_insert_with(|| now.clone());
                    match now.what_is_missing(begun, before) {
                        None => return Ok((now, since.elapsed())),
                        Some(missing) => why = missing,
                    }
                    // A learner that started again counts its updates from its checkpoint.
                    if now.version.0 != begun.version.0 {
                        first = Some(now);
                    }
                }
                Err(error) => why = format!("{error:#}"),
            }
            std::thread::sleep(TICK);
        }
        bail!("not well after {:.0} s: {why}", patience.as_secs_f64())
    }

    fn observe(&self) -> Result<Health> {
        let text = self.shell(&self.observe)?;
        let status: Value =
            serde_json::from_str(text.trim()).with_context(|| format!("observe printed {text:?}"))?;
        Health::of(&status)
    }

    /// Runs a command in a process group of its own: Ctrl-C ends the plan, not half of a fault.
    fn shell(&self, command: &str) -> Result<String> {
        let script = format!("{}\n{command}", self.prelude);
        let getup = std::env::current_exe().context("this program's file is not known")?;
        let mut bash = Command::new("bash");
        bash.process_group(0);
        let output = bash.args(["-ec", &script]).env("GETUP", getup).output().context("cannot start bash")?;
        let stderr = String::from_utf8_lossy(&output.stderr);
        ensure!(output.status.success(), "{} ({})", stderr.trim(), output.status);
        Ok(String::from_utf8_lossy(&output.stdout).into_owned())
    }
}

/// What must grow, and who is there.
#[derive(Clone, Debug)]
struct Health {
    /// Of each replay: its store's name, and the transitions ever stored.
    stores: Vec<(String, u64)>,
    env_steps: u64,
    updates: u64,
    stage: u64,
    /// Learner's start, policy's counter.
    version: (u64, u64),
    actors: usize,
    finished: bool,
}

impl Health {
    /// Reads what `getup status --json` says.
    fn of(status: &Value) -> Result<Self> {
        let replays = match &status["replay"] {
            Value::Array(several) => several.iter().collect(),
            one => vec![one],
        };
        // What is not there is not 0: a comparison with it would hold for ever.
        let count =
            |of: &Value, name: &str| of[name].as_u64().with_context(|| format!("a status without {name}"));
        let mut stores = Vec::new();
        let mut env_steps = 0;
        for replay in replays {
            if let Some(error) = replay["error"].as_str() {
                bail!("replay: {error}");
            }
            let store = replay["store"].as_str().context("a replay without a store")?.to_owned();
            stores.push((store, count(replay, "transitions")?));
            env_steps += count(replay, "env_steps")?;
        }
        let learner = &status["learner"];
        if let Some(error) = learner["error"].as_str() {
            bail!("learner: {error}");
        }
        let version = learner["version"].as_str().and_then(|version| version.split_once('.'));
        let (incarnation, counter) = version.context("a learner without a policy")?;
        let heard =
            |actor: &&Value| actor["silent_seconds"].as_f64().is_some_and(|silent| silent < HEARD_SECONDS);
        Ok(Self {
            stores,
            env_steps,
            updates: count(learner, "updates")?,
            stage: count(learner, "stage")?,
            version: (incarnation.parse()?, counter.parse()?),
            actors: learner["actors"].as_array().map_or(0, |actors| actors.iter().filter(heard).count()),
            finished: learner["state"] == "finished",
        })
    }

    /// Nothing acknowledged may be gone, and the curriculum never goes back.
    fn check_kept(&self, before: &Self) -> Result<()> {
        for (old, new) in before.stores.iter().zip(&self.stores) {
            ensure!(old.0 == new.0, "replay lost its store {}: it has another, {}", old.0, new.0);
            ensure!(new.1 >= old.1, "replay lost transitions: it had {}, it has {}", old.1, new.1);
        }
        ensure!(
            self.stage >= before.stage,
            "the curriculum went back from stage {} to {}",
            before.stage,
            self.stage
        );
        ensure!(
            self.version >= before.version,
            "the policies went back from {:?} to {:?}",
            before.version,
            self.version
        );
        Ok(())
    }

    /// Why it is not well: since `begun` all must have moved, and as many actors as `before` must be there.
    fn what_is_missing(&self, begun: &Self, before: Option<&Self>) -> Option<String> {
        let wanted = before.map_or(1, |before| before.actors);
        if self.actors < wanted {
            return Some(format!("{} of {wanted} actors are heard", self.actors));
        }
        if self.finished {
            return None;
        }
        if self.env_steps <= begun.env_steps {
            return Some(format!("no env step since {}", begun.env_steps));
        }
        (self.updates <= begun.updates).then(|| format!("no update since {}", begun.updates))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn health(env_steps: u64, updates: u64, actors: &[f64]) -> Health {
        let actors: Vec<Value> = actors.iter().map(|silent| json!({"silent_seconds": silent})).collect();
        Health::of(&json!({
            "replay": {"store": "a", "transitions": env_steps, "env_steps": env_steps},
            "learner": {"version": "2.7", "updates": updates, "stage": 1, "state": "training", "actors": actors},
        }))
        .unwrap()
    }

    #[test]
    fn a_cluster_is_well_when_all_moves_and_all_are_there() {
        let before = health(100, 10, &[0.1, 0.2]);
        let missing = |now: Health| now.what_is_missing(&before, Some(&before));
        assert_eq!(missing(health(101, 11, &[0.1, 0.2])), None);
        assert!(missing(health(101, 10, &[0.1, 0.2])).unwrap().contains("no update"));
        assert!(missing(health(100, 11, &[0.1, 0.2])).unwrap().contains("no env step"));
        assert!(missing(health(101, 11, &[0.1, 30.0])).unwrap().contains("1 of 2 actors"));
    }

    #[test]
    fn a_status_that_lacks_what_is_compared_is_none() {
        let whole = json!({
            "replay": {"store": "a", "transitions": 1, "env_steps": 1},
            "learner": {"version": "2.7", "updates": 1, "stage": 1, "state": "training", "actors": []},
        });
        assert!(Health::of(&whole).is_ok());
        for (role, name) in
            [("replay", "transitions"), ("replay", "env_steps"), ("learner", "updates"), ("learner", "stage")]
        {
            let mut status = whole.clone();
            status[role].as_object_mut().unwrap().remove(name);
            assert!(Health::of(&status).unwrap_err().to_string().contains(name), "{role} without {name}");
        }
    }

    #[test]
    fn what_was_acknowledged_or_passed_is_never_gone() {
        let before = health(100, 10, &[0.1]);
        assert!(
            health(100, 3, &[]).check_kept(&before).is_ok(),
            "updates since the checkpoint are made again"
        );
        assert!(
            health(99, 11, &[0.1]).check_kept(&before).unwrap_err().to_string().contains("lost transitions")
        );
        let back = Health { stage: 0, ..before.clone() };
        assert!(back.check_kept(&before).unwrap_err().to_string().contains("went back from stage 1 to 0"));
        let other = Health { stores: vec![("b".into(), 500)], ..before.clone() };
        assert!(other.check_kept(&before).unwrap_err().to_string().contains("lost its store"));
        let older = Health { version: (1, 900), ..before.clone() };
        assert!(older.check_kept(&before).is_err());
    }
}
