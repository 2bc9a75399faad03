//! Scale on one machine: simulated actors against one learner and one replay, and what grows how with their number.
//!
//! Three processes, so that processor time can be told apart:
//!
//! | process | what is real | what is not |
//! | --- | --- | --- |
//! | replay | store, log, service | |
//! | learner | hub, service, broadcasts of preset `laptop`'s policy, sampling over gRPC | no gradients |
//! | load | each actor's two connections: segments of 64 steps appended, policies heard and parsed, a heartbeat a second | no physics: segments come at a fixed pace |
//!
//! An actor makes [`ENV_STEPS`] env steps a second, a sixth of what a core with physics makes, so that 256 of them fit on
//! two cores beside the services. The learner samples as preset `laptop` does, 0.4 minibatches of 128 an env step, but no
//! more than [`MOST_MINIBATCHES`] a second, which is what two cores train on. The replay's limiter is off.
//!
//! | row | |
//! | --- | --- |
//! | `broadcast lag` | from a policy's publication until it is in the actor's slot, parsed |
//! | `append` | until a segment is acknowledged |
//! | `heartbeat` | until it is answered |
//! | `… processor` | processor time: milliseconds a second; `others` is all that is not this benchmark |
//! | `… memory` | resident; that of the replay grows with its transitions |
//! | `env steps`, `policies heard`, `minibatches` | a second; `limit` is what was offered |
//! | `heartbeat in the hub` | the hub's part of it, in process, alone: the fastest of several rounds |
//!
//! `(1/s)` marks a further point with one broadcast a second, that tells what a broadcast costs.
//!
//! `GETUP_FLEET_BROADCASTS=1` broadcasts once a second instead of five times; with `GETUP_FLEET_RECORD=1` the points are
//! also written to `docs/runs/fleet.json`, from where `cargo xtask plot` draws them.

mod common;
#[path = "../replay/tests/fixtures/mod.rs"]
mod fixtures;
#[path = "../src/bench/load.rs"]
mod load;

use std::fs;
use std::hint::black_box;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, bail, ensure};
use common::{Row, report};
use fixtures::get_up_spec;
use getup_actor::link::{BETA_VALUE, HIGH_STARTS_VALUE, LearnerLink, POLICY_NETWORK, SegmentWriter};
use getup_actor::{GrpcLearner, GrpcReplay, Heartbeat, Identity, LinkError, PolicyUpdate};
use getup_learner::hub::Hub;
use getup_learner::service::service;
use getup_policy::{Body, ObservationStatistics, Policy, PolicyShape};
use getup_proto::{PolicyVersion, Segment, v1};
use getup_replay::{
    MinibatchSource, RemoteOptions, ReplayConfig, ReplayMetrics, SampleError, SampleOptions, ShardedSource,
    Store, serve_at,
};
use getup_telemetry::{Registry, Shutdown, Waits, health};
use getup_transport::{Credentials, Endpoint, Limits, Metrics, Server, Window};
use load::{episode, percentiles};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use serde_json::{Value, json};
use tokio::io::AsyncBufReadExt;
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tonic::service::Routes;

/// Simulated actors of the points.
const ACTORS: [u64; 5] = [1, 4, 16, 64, 256];
/// Env steps a second of an actor.
const ENV_STEPS: f64 = 400.0;
/// Broadcasts a second, unless `GETUP_FLEET_BROADCASTS` says otherwise.
const BROADCASTS: f64 = 5.0;
/// Of one more point, that tells what a broadcast costs.
const FEW_BROADCASTS: f64 = 1.0;
/// Minibatches an env step, and their transitions.
const MINIBATCHES_PER_STEP: f64 = 0.4;
const BATCH: usize = 128;
/// Minibatches a second that two cores train on.
const MOST_MINIBATCHES: f64 = 740.0;
/// Minibatches ahead, as a learner has them.
const PREFETCH: usize = 8;
const STEPS: usize = 64;
const WARM_UP: Duration = Duration::from_secs(2);
const TIME: Duration = Duration::from_secs(8);
/// How long all actors may take to connect.
const PATIENCE: Duration = Duration::from_secs(30);
/// How long a process may take to end.
const GRACE: Duration = Duration::from_secs(3);
/// The whole benchmark ends by then.
const LIMIT: Duration = Duration::from_secs(175);
/// Ticks a second in /proc: the same on every Linux.
const TICKS: f64 = 100.0;
/// The value of an update that says when it was published, in seconds since 1970.
const PUBLISHED: &str = "published";

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[1..] {
        ["replay", dir] => return run_replay(Path::new(dir)),
        ["learner", replay, broadcasts, minibatches] => {
            return run_learner(replay, broadcasts.parse()?, minibatches.parse()?);
        }
        ["load", replay, learner, actors] => return run_load(replay, learner, actors.parse()?),
        _ => {}
    }
    thread::spawn(|| {
        thread::sleep(LIMIT);
        eprintln!("error: the benchmark takes longer than {LIMIT:?}: is the machine busy?");
        // The other processes end with this one.
        std::process::exit(1);
    });
    let broadcasts = match std::env::var("GETUP_FLEET_BROADCASTS") {
        Ok(text) => text.parse().context("GETUP_FLEET_BROADCASTS is a number of broadcasts a second")?,
        Err(_) => BROADCASTS,
    };
    let mut points = Vec::new();
    for actors in ACTORS {
        points.push(point(actors, broadcasts)?);
    }
    if broadcasts != FEW_BROADCASTS {
        points.push(point(ACTORS[ACTORS.len() - 1], FEW_BROADCASTS)?);
    }
    let hub: Vec<HubCost> = [256, 10_000].map(hub_cost).into();
    let mut rows: Vec<Row> = points.iter().flat_map(|point| point.rows(broadcasts)).collect();
    for HubCost { actors, seconds } in &hub {
        rows.push(less(format!("heartbeat in the hub, {actors} actors"), "us", 1e6 * seconds));
    }
    report("fleet", &rows)?;
    if std::env::var_os("GETUP_FLEET_RECORD").is_some() {
        let record = json!({
            "broadcasts_per_second": broadcasts,
            "env_steps_per_actor": ENV_STEPS,
            "seconds": TIME.as_secs_f64(),
            "model_bytes": policy().to_bytes().len(),
            "points": points,
            "hub": hub,
        });
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/runs/fleet.json");
        fs::write(&file, serde_json::to_string_pretty(&record)? + "\n")?;
        println!("written to {}", file.display());
    }
    Ok(())
}

// ---- Points

/// What one number of actors came to. Times in seconds, rates a second, processor time in seconds a second.
#[derive(Serialize)]
struct Point {
    actors: u64,
    broadcasts: f64,
    lag_p50: f64,
    lag_p99: f64,
    append_p50: f64,
    append_p99: f64,
    heartbeat_p50: f64,
    heartbeat_p99: f64,
    cpu_replay: f64,
    cpu_learner: f64,
    cpu_load: f64,
    /// Of all that is not this benchmark.
    cpu_others: f64,
    replay_bytes: u64,
    learner_bytes: u64,
    env_steps: f64,
    env_steps_offered: f64,
    policies: f64,
    policies_offered: f64,
    minibatches: f64,
    minibatches_offered: f64,
}

/// What a heartbeat takes of a hub that knows so many actors.
#[derive(Serialize)]
struct HubCost {
    actors: u64,
    seconds: f64,
}

fn point(actors: u64, broadcasts: f64) -> Result<Point> {
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
    fn rows(&self, usual: f64) -> Vec<Row> {
        let mut of = format!("{} actor{}", self.actors, if self.actors == 1 { "" } else { "s" });
        if self.broadcasts != usual {
            of += &format!(" ({}/s)", self.broadcasts);
        }
        let milliseconds = |what: &str, seconds: f64| less(format!("{what}, {of}"), "ms", 1e3 * seconds);
        let processor = |what: &str, cpu: f64| less(format!("{what} processor, {of}"), "ms/s", 1e3 * cpu);
        let memory = |what: &str, bytes: u64| less(format!("{what} memory, {of}"), "MB", bytes as f64 / 1e6);
        let kept = |what: &str, unit: &str, ours: f64, offered: f64| {
            let (limit, share_of_limit) = (Some(offered), Some(ours / offered));
            Row { limit, share_of_limit, ..plain(format!("{what}, {of}"), unit, ours) }
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

fn less(name: String, unit: &str, ours: f64) -> Row {
    plain(name, &format!("{unit} (less is better)"), ours)
}

fn plain(name: String, unit: &str, ours: f64) -> Row {
    Row {
        name,
        unit: unit.to_owned(),
        ours,
        peer: None,
        limit: None,
        ratio_to_peer: None,
        share_of_limit: None,
    }
}

/// Every actor says in turn that it is there, without a network.
fn hub_cost(actors: u64) -> HubCost {
    const ROUNDS: usize = 30;
    const BEATS: usize = 100;
    let hub = hub();
    let names: Vec<String> = (0..actors).map(|actor| format!("actor-{actor}")).collect();
    let beat = |name: &String| {
        let beat = Heartbeat { actor: name.clone(), ..Heartbeat::default() };
        black_box(hub.heartbeat(beat.into(), Instant::now())).expect("a heartbeat of a known actor");
    };
    names.iter().for_each(beat);
    let round = || {
        let started = Instant::now();
        names.iter().take(BEATS).for_each(beat);
        started.elapsed().as_secs_f64() / BEATS as f64
    };
    // Other work on the machine slows some of them.
    HubCost { actors, seconds: (0..ROUNDS).map(|_| round()).fold(f64::INFINITY, f64::min) }
}

// ---- The replay

fn run_replay(dir: &Path) -> Result<()> {
    let registry = Registry::new();
    let config = ReplayConfig { min_size: 1, ..ReplayConfig::default() };
    let (metrics, waits) = (ReplayMetrics::new(&registry), Waits::new(&registry));
    let store = Arc::new(Store::open(dir, &get_up_spec(), &config, metrics, waits)?);
    let shutdown = Shutdown::new();
    let served = run(&shutdown, async {
        let listener = listen().await?;
        let serving = serve_at(port(getup_replay::limits()), listener, store, shutdown.clone());
        tokio::select! {
            served = serving => Ok(served?),
            answered = answer(|| json!({})) => answered,
        }
    });
    // Also where the process that made the folder was killed.
    let _ = fs::remove_dir_all(dir);
    served
}

// ---- The learner

fn run_learner(replay: &str, broadcasts: f64, minibatches: f64) -> Result<()> {
    let shutdown = Shutdown::new();
    run(&shutdown, async {
        let hub = Arc::new(hub());
        let listener = listen().await?;
        let (_reporter, health) = health();
        let routes = Routes::new(health).add_service(service(Arc::clone(&hub), shutdown.clone()));
        let sampled = Arc::new(AtomicU64::new(0));
        let source = source(replay, &shutdown);
        let (count, ended) = (Arc::clone(&sampled), shutdown.clone());
        thread::spawn(move || publish(&hub, broadcasts, &ended));
        let ended = shutdown.clone();
        thread::spawn(move || sample(source, minibatches, &count, &ended));
        let ended = shutdown.clone();
        let limits = Limits { window: Window::Adaptive, ..Limits::default() };
        let serving = port(limits).serve(listener, routes, async move { ended.wait().await });
        let mut since = Instant::now();
        let counts = || {
            let minibatches = sampled.swap(0, Ordering::Relaxed) as f64 / since.elapsed().as_secs_f64();
            since = Instant::now();
            json!({ "minibatches": minibatches })
        };
        tokio::select! {
            served = serving => Ok(served?),
            answered = answer(counts) => answered,
        }
    })
}

fn hub() -> Hub {
    let seeds = (0..10).collect();
    Hub::new(get_up_spec(), seeds, Duration::from_secs(30), 1, Waits::new(&Registry::new()))
}

/// A policy of the size that preset `laptop` broadcasts.
fn policy() -> Policy {
    let body = Body::Simba { width: 128, blocks: 1 };
    let shape = PolicyShape { observation: 68, action: 21, body };
    let mut policy = Policy::init(shape, &mut ChaCha8Rng::seed_from_u64(1));
    policy.statistics = Some(ObservationStatistics { mean: vec![0.0; 68], std: vec![1.0; 68], clip: 5.0 });
    policy.metadata = [("beta", "1"), ("task", "getup"), ("run", "fleet"), ("updates", "100000")]
        .map(|(key, value)| (key.to_owned(), value.to_owned()))
        .into();
    policy
}

/// Broadcasts at a fixed pace, as a trainer does: each time the policy becomes a model file.
fn publish(hub: &Hub, per_second: f64, shutdown: &Shutdown) {
    let policy = policy();
    let mut pace = Pace::new(per_second);
    for counter in 0.. {
        pace.wait();
        if shutdown.is_triggered() {
            return;
        }
        let model = policy.to_bytes().into();
        let values = [(BETA_VALUE, 1.0), (HIGH_STARTS_VALUE, 0.0), (PUBLISHED, unix_seconds())];
        hub.publish(Arc::new(v1::PolicyUpdate {
            version: Some(PolicyVersion { incarnation: 1, counter }.into()),
            networks: vec![v1::NamedNetwork { name: POLICY_NETWORK.to_owned(), model }],
            values: values.map(|(name, value)| (name.to_owned(), value)).into(),
            ..v1::PolicyUpdate::default()
        }));
    }
}

fn source(replay: &str, shutdown: &Shutdown) -> ShardedSource {
    let options = RemoteOptions {
        endpoint: Endpoint::default(),
        spec: get_up_spec(),
        sample: SampleOptions { batch: BATCH, n_step: 5, gamma: 0.97, seed: 1, segments: false },
        name: "learner".to_owned(),
        table: String::new(),
        prefetch: PREFETCH,
    };
    let runtime = tokio::runtime::Handle::current();
    let waits = Waits::new(&Registry::new());
    ShardedSource::new(&[replay.into()], &options, &runtime, waits, shutdown.clone())
}

/// Takes minibatches at a fixed pace.
fn sample(mut source: ShardedSource, per_second: f64, count: &AtomicU64, shutdown: &Shutdown) {
    let mut pace = Pace::new(per_second);
    while !shutdown.is_triggered() {
        pace.wait();
        match source.next() {
            Ok(minibatch) => drop(black_box(minibatch)),
            Err(SampleError::Shutdown) => return,
            Err(error) => return eprintln!("the learner samples no more: {error}"),
        }
        count.fetch_add(1, Ordering::Relaxed);
    }
}

/// So many times a second; what was missed by more than a second is not made up for.
struct Pace {
    due: Instant,
    every: Duration,
}

impl Pace {
    fn new(per_second: f64) -> Self {
        Self { due: Instant::now(), every: Duration::from_secs_f64(1.0 / per_second) }
    }

    fn wait(&mut self) {
        let now = Instant::now();
        thread::sleep(self.due.saturating_duration_since(now));
        let earliest = now.checked_sub(Duration::from_secs(1)).unwrap_or(now);
        self.due = (self.due + self.every).max(earliest);
    }
}

// ---- The load

/// What the actors have seen, all together; times in seconds.
#[derive(Default)]
struct Seen {
    lags: Vec<f64>,
    appends: Vec<f64>,
    heartbeats: Vec<f64>,
    env_steps: usize,
}

/// What the tasks of an actor share.
#[derive(Clone)]
struct Actor {
    name: String,
    /// Its place among the actors, in [0, 1): they do not act in step.
    phase: f64,
    seen: Arc<Mutex<Seen>>,
    /// Told when the first segment is acknowledged, and when the first policy is there.
    arrived: mpsc::UnboundedSender<()>,
}

fn run_load(replay: &str, learner: &str, actors: u64) -> Result<()> {
    let shutdown = Shutdown::new();
    run(&shutdown, async {
        let seen = Arc::new(Mutex::new(Seen::default()));
        let segments: Arc<[Segment]> = (0..8).flat_map(|number| episode(&get_up_spec(), number)).collect();
        let (arrived, mut arrivals) = mpsc::unbounded_channel();
        let mut tasks = JoinSet::new();
        for number in 0..actors {
            let actor = Actor {
                name: format!("actor-{number}"),
                phase: number as f64 / actors as f64,
                seen: Arc::clone(&seen),
                arrived: arrived.clone(),
            };
            let waits = Waits::new(&Registry::new());
            let identity = Identity { name: actor.name.clone(), run_seed: 0, writer: number + 1 };
            let to_replay = GrpcReplay::new(replay, get_up_spec(), identity, waits.clone())?;
            let to_learner = GrpcLearner::new(learner, get_up_spec(), &actor.name, waits)?;
            let (slot, updates) = watch::channel(None);
            tasks.spawn(append(to_replay, Arc::clone(&segments), actor.clone()));
            tasks.spawn(hear(updates.clone(), actor.clone()));
            tasks.spawn(async move {
                // Both by one connection, as an actor does.
                tokio::select! {
                    ended = to_learner.subscribe(slot) => Ok(ended?),
                    ended = send_heartbeats(&to_learner, updates, actor) => ended,
                }
            });
        }
        let all_arrive = async {
            for _ in 0..2 * actors {
                arrivals.recv().await;
            }
        };
        let mut since = Instant::now();
        let counts = || {
            let seen = std::mem::take(&mut *lock(&seen));
            let seconds = since.elapsed().as_secs_f64();
            since = Instant::now();
            seen.summary(seconds)
        };
        let work = async {
            let arrive = tokio::time::timeout(PATIENCE, all_arrive).await;
            arrive.map_err(|_| anyhow::anyhow!("not all actors were connected within {PATIENCE:?}"))?;
            say("ready")?;
            answer(counts).await
        };
        tokio::select! {
            worked = work => worked,
            Some(ended) = tasks.join_next() => ended?.and_then(|()| bail!("an actor has ended")),
        }
    })
}

/// Appends segments as they become due, all that are there at a time.
async fn append(mut link: GrpcReplay, segments: Arc<[Segment]>, actor: Actor) -> Result<()> {
    let (writer, mut sequence, mut first) = (link.writer(), 0, true);
    let mut next = segments.iter().cycle().skip(writer as usize % segments.len());
    let mut due =
        tokio::time::Instant::now() + Duration::from_secs_f64(actor.phase * STEPS as f64 / ENV_STEPS);
    loop {
        tokio::time::sleep_until(due).await;
        let now = tokio::time::Instant::now();
        let (mut group, mut env_steps) = (Vec::new(), 0);
        while due <= now
            && let Some(segment) = next.next()
        {
            sequence += 1;
            group.push(Segment { writer, sequence, ..segment.clone() });
            env_steps += segment.steps;
            due += Duration::from_secs_f64(segment.steps as f64 / ENV_STEPS);
        }
        let began = Instant::now();
        link.append(group).await?;
        let took = began.elapsed().as_secs_f64();
        if std::mem::take(&mut first) {
            // Whoever counts may have ended.
            let _ = actor.arrived.send(());
        }
        let mut seen = lock(&actor.seen);
        seen.appends.push(took);
        seen.env_steps += env_steps;
    }
}

/// Notes when each policy comes.
async fn hear(mut updates: watch::Receiver<Option<Arc<PolicyUpdate>>>, actor: Actor) -> Result<()> {
    let mut first = true;
    while updates.changed().await.is_ok() {
        let Some(update) = updates.borrow_and_update().clone() else { continue };
        let published = update.values.get(PUBLISHED).context("an update says when it was published")?;
        lock(&actor.seen).lags.push(unix_seconds() - published);
        if std::mem::take(&mut first) {
            let _ = actor.arrived.send(());
        }
    }
    bail!("{} hears no policies any more", actor.name)
}

async fn send_heartbeats(
    link: &GrpcLearner,
    updates: watch::Receiver<Option<Arc<PolicyUpdate>>>,
    actor: Actor,
) -> Result<()> {
    let start = tokio::time::Instant::now() + Duration::from_secs_f64(actor.phase);
    let mut ticks = tokio::time::interval_at(start, Duration::from_secs(1));
    loop {
        ticks.tick().await;
        let version = updates.borrow().as_ref().map(|update| update.version).unwrap_or_default();
        let beat = Heartbeat { actor: actor.name.clone(), version, ..Heartbeat::default() };
        let began = Instant::now();
        // One that is late is noted as such, as by an actor.
        if let Err(error @ LinkError::Refused(_)) = link.heartbeat(beat).await {
            return Err(error.into());
        }
        lock(&actor.seen).heartbeats.push(began.elapsed().as_secs_f64());
    }
}

impl Seen {
    fn summary(self, seconds: f64) -> Value {
        let policies = self.lags.len() as f64 / seconds;
        let [lag, append, heartbeat] =
            [self.lags, self.appends, self.heartbeats].map(|times| percentiles(times, [0.5, 0.99]));
        json!({
            "lag_p50": lag[0],
            "lag_p99": lag[1],
            "append_p50": append[0],
            "append_p99": append[1],
            "heartbeat_p50": heartbeat[0],
            "heartbeat_p99": heartbeat[1],
            "policies": policies,
            "env_steps": self.env_steps as f64 / seconds,
        })
    }
}

fn lock(seen: &Mutex<Seen>) -> MutexGuard<'_, Seen> {
    seen.lock().unwrap_or_else(PoisonError::into_inner)
}

fn unix_seconds() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

// ---- Processes

/// Works on a runtime as a role's until the work ends or a signal comes.
fn run(shutdown: &Shutdown, work: impl Future<Output = Result<()>>) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let worked = runtime.block_on(async {
        shutdown.on_signals()?;
        tokio::select! {
            worked = work => worked,
            () = shutdown.wait() => Ok(()),
        }
    });
    shutdown.trigger();
    runtime.shutdown_timeout(GRACE / 6);
    worked
}

/// Answers every line of the process that started this one, until that has ended or lets go.
async fn answer(mut counts: impl FnMut() -> Value) -> Result<()> {
    let mut lines = tokio::io::BufReader::new(tokio::io::stdin()).lines();
    while lines.next_line().await?.is_some() {
        say(&counts().to_string())?;
    }
    Ok(())
}

fn say(line: &str) -> Result<()> {
    let mut output = std::io::stdout().lock();
    writeln!(output, "{line}")?;
    Ok(output.flush()?)
}

async fn listen() -> Result<TcpListener> {
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    say(&format!("listening on {}", listener.local_addr()?))?;
    Ok(listener)
}

/// An open port. All actors come from one address here, which has places for no more than 256 otherwise.
fn port(limits: Limits) -> Server {
    let limits = Limits { connections_per_peer: limits.connections, ..limits };
    Server::new(Credentials::default(), limits, Metrics::new(&Registry::new()))
}

/// A process of this program; it ends when this is dropped, or this process ends.
struct Process {
    child: Child,
    input: Option<ChildStdin>,
    output: BufReader<ChildStdout>,
    /// Its first line.
    greeting: String,
}

impl Process {
    fn start(arguments: &[&str]) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        let mut child = command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let input = child.stdin.take();
        let output = BufReader::new(child.stdout.take().context("it is piped")?);
        let mut process = Self { child, input, output, greeting: String::new() };
        process.greeting = process.line()?;
        Ok(process)
    }

    fn line(&mut self) -> Result<String> {
        let mut line = String::new();
        self.output.read_line(&mut line)?;
        ensure!(!line.is_empty(), "a process of the fleet has ended: what it wrote above says why");
        Ok(line.trim().to_owned())
    }

    /// What follows these words in its first line.
    fn said(&self, words: &str) -> Result<&str> {
        let rest = self.greeting.strip_prefix(words);
        rest.with_context(|| format!("a process says {:?} and not {words:?}", self.greeting))
    }

    /// Its counts since it was last asked.
    fn ask(&mut self) -> Result<Value> {
        writeln!(self.input.as_mut().context("it is piped")?)?;
        Ok(serde_json::from_str(&self.line()?)?)
    }

    /// Processor seconds so far.
    fn cpu(&self) -> Result<f64> {
        let stat = fs::read_to_string(format!("/proc/{}/stat", self.child.id()))?;
        // The name before it, in parentheses, may contain spaces. After it the 12th and 13th fields.
        let (_, fields) = stat.rsplit_once(')').context("a process has a name")?;
        ticks(fields.split_whitespace().skip(11).take(2))
    }

    /// Resident bytes.
    fn resident(&self) -> Result<u64> {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id()))?;
        let line =
            status.lines().find_map(|line| line.strip_prefix("VmRSS:")).context("a process has a size")?;
        Ok(1024 * line.trim().trim_end_matches(" kB").parse::<u64>()?)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        drop(self.input.take());
        let until = Instant::now() + GRACE;
        while Instant::now() < until && matches!(self.child.try_wait(), Ok(None)) {
            thread::sleep(Duration::from_millis(20));
        }
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Processor seconds of the whole machine so far.
fn machine_cpu() -> Result<f64> {
    let stat = fs::read_to_string("/proc/stat")?;
    let fields: Vec<&str> = stat.lines().next().context("/proc/stat has lines")?.split_whitespace().collect();
    // user, nice, system; irq, softirq.
    ticks([1, 2, 3, 6, 7].into_iter().filter_map(|place| fields.get(place).copied()))
}

fn ticks<'a>(fields: impl Iterator<Item = &'a str>) -> Result<f64> {
    let ticks: u64 = fields.map(str::parse::<u64>).sum::<Result<_, _>>()?;
    Ok(ticks as f64 / TICKS)
}
