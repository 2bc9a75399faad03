//! One number of actors: its three processes, what they came to, and the rows that say so.

use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use serde::Serialize;
use serde_json::Value;

use crate::actors::ENV_STEPS;
use crate::common::Row;
use crate::processes::{Process, machine_cpu};

const WARM_UP: Duration = Duration::from_secs(2);
pub(crate) const TIME: Duration = Duration::from_secs(8);
/// Minibatches an env step, and their transitions.
const MINIBATCHES_PER_STEP: f64 = 0.4;
/// Minibatches a second that two cores train on.
const MOST_MINIBATCHES: f64 = 740.0;

/// What one number of actors came to. Times in seconds, rates a second, processor time in seconds a second.
#[derive(Serialize)]
pub(crate) struct Point {
    pub(crate) actors: u64,
    pub(crate) broadcasts: f64,
    pub(crate) lag_p50: f64,
    pub(crate) lag_p99: f64,
    pub(crate) append_p50: f64,
    pub(crate) append_p99: f64,
    pub(crate) heartbeat_p50: f64,
    pub(crate) heartbeat_p99: f64,
    pub(crate) cpu_replay: f64,
    pub(crate) cpu_learner: f64,
    pub(crate) cpu_load: f64,
    /// Of all that is not this benchmark.
    pub(crate) cpu_others: f64,
    pub(crate) replay_bytes: u64,
    pub(crate) learner_bytes: u64,
    pub(crate) env_steps: f64,
    pub(crate) env_steps_offered: f64,
    pub(crate) policies: f64,
    pub(crate) policies_offered: f64,
    pub(crate) minibatches: f64,
    pub(crate) minibatches_offered: f64,
}

pub(crate) fn point(actors: u64, broadcasts: f64) -> Result<Point> {
    let env_steps_offered = actors as f64 * ENV_STEPS;
    let minibatches_offered = (MINIBATCHES_PER_STEP * env_steps_offered).min(MOST_MINIBATCHES);
    let dir = tempfile::tempdir()?;
    let replay = Process::start(&["replay", &dir.path().display().to_string()])?;
    let [rate, pace] = [broadcasts, minibatches_offered].map(|number| number.to_string());
    let mut learner = Process::start(&["learner", replay.said("listening on ")?, &rate, &pace])?;
    let addresses = [replay.said("listening on ")?, learner.said("listening on ")?].map(str::to_owned);
    let mut load = Process::start(&["load", &addresses[0], &addresses[1], &actors.to_string()])?;
    load.said("ready")?;
    thread::sleep(WARM_UP);
    // What came before does not count.
    for process in [&mut learner, &mut load] {
        process.ask()?;
    }
    let cpu = || -> Result<[f64; 4]> { Ok([replay.cpu()?, learner.cpu()?, load.cpu()?, machine_cpu()?]) };
    let (started, before) = (Instant::now(), cpu()?);
    thread::sleep(TIME);
    let (seconds, after) = (started.elapsed().as_secs_f64(), cpu()?);
    let [replay_bytes, learner_bytes] = [replay.resident()?, learner.resident()?];
    let (seen, served) = (load.ask()?, learner.ask()?);
    let number = |value: &Value, name: &str| {
        value[name].as_f64().with_context(|| format!("a process of the fleet tells no {name}: {value}"))
    };
    let spent = |place: usize| (after[place] - before[place]) / seconds;
    let [cpu_replay, cpu_learner, cpu_load] = [0, 1, 2].map(spent);
    let point = Point {
        actors,
        broadcasts,
        lag_p50: number(&seen, "lag_p50")?,
        lag_p99: number(&seen, "lag_p99")?,
        append_p50: number(&seen, "append_p50")?,
        append_p99: number(&seen, "append_p99")?,
        heartbeat_p50: number(&seen, "heartbeat_p50")?,
        heartbeat_p99: number(&seen, "heartbeat_p99")?,
        cpu_replay,
        cpu_learner,
        cpu_load,
        cpu_others: spent(3) - cpu_replay - cpu_learner - cpu_load,
        replay_bytes,
        learner_bytes,
        env_steps: number(&seen, "env_steps")?,
        env_steps_offered,
        policies: number(&seen, "policies")?,
        policies_offered: actors as f64 * broadcasts,
        minibatches: number(&served, "minibatches")?,
        minibatches_offered,
    };
    eprintln!(
        "{actors} actors, {broadcasts} broadcasts/s: lag p99 {:.1} ms, append p99 {:.1} ms; processor time: replay {:.2}, \
         learner {:.2}, load {:.2}, others {:.2}; {:.0} % of the env steps, {:.0} % of the policies",
        1e3 * point.lag_p99,
        1e3 * point.append_p99,
        point.cpu_replay,
        point.cpu_learner,
        point.cpu_load,
        point.cpu_others,
        100.0 * point.env_steps / point.env_steps_offered,
        100.0 * point.policies / point.policies_offered,
    );
    Ok(point)
}

impl Point {
    /// The rows, which say how often it was broadcast where that is not as often as `usual`.
    pub(crate) fn rows(&self, usual: f64) -> Vec<Row> {
        let mut of = format!("{} actor{}", self.actors, if self.actors == 1 { "" } else { "s" });
        if self.broadcasts != usual {
            of += &format!(" ({}/s)", self.broadcasts);
        }
        let milliseconds = |what: &str, seconds: f64| Row::less(format!("{what}, {of}"), "ms", 1e3 * seconds);
        let processor =
            |what: &str, cpu: f64| Row::less(format!("{what} processor, {of}"), "ms/s", 1e3 * cpu);
        let memory =
            |what: &str, bytes: u64| Row::less(format!("{what} memory, {of}"), "MB", bytes as f64 / 1e6);
        let kept = |what: &str, unit: &str, ours: f64, offered: f64| {
            let (limit, share_of_limit) = (Some(offered), Some(ours / offered));
            Row { limit, share_of_limit, ..Row::plain(format!("{what}, {of}"), unit, ours) }
        };
        vec![
            milliseconds("broadcast lag p50", self.lag_p50),
            milliseconds("broadcast lag p99", self.lag_p99),
            milliseconds("append p50", self.append_p50),
            milliseconds("append p99", self.append_p99),
            milliseconds("heartbeat p50", self.heartbeat_p50),
            milliseconds("heartbeat p99", self.heartbeat_p99),
            processor("replay", self.cpu_replay),
            processor("learner", self.cpu_learner),
            processor("load", self.cpu_load),
            processor("others", self.cpu_others),
            memory("replay", self.replay_bytes),
            memory("learner", self.learner_bytes),
            kept("env steps", "steps/s", self.env_steps, self.env_steps_offered),
            kept("policies heard", "policies/s", self.policies, self.policies_offered),
            kept("minibatches", "minibatches/s", self.minibatches, self.minibatches_offered),
        ]
    }
}
