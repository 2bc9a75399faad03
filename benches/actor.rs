//! What an actor costs on top of the physics, and its forward pass beside libtorch's.
//!
//! Rows `actor`: control steps a second of one thread, everything included: inference, physics, reward, observation,
//! segments and their append to a store on disk, whose own threads tidy up behind it. 16 lanes, 200 Hz, untrained
//! policies; the steps of falls count. Limit: as many control steps as a bare loop of `mj_step`, from fallen states
//! under torques that these lanes chose.
//!
//! Rows `forward`: forward passes a second on one thread. Peer: PyTorch, in eager mode or as a frozen trace, whichever
//! is faster; it is `benches/actor_eager.py` under the Python of `cargo xtask setup --peers`.
//!
//! Both sides take turns, a fraction of a second each; ratios and shares are medians over the pairs of turns.

mod common;

use std::collections::BTreeMap;
use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use common::{Bare, Peer, Row, Side, alternate, report};
use getup_actor::{ActorConfig, ActorMetrics, BetaDraw, Identity, LaneGroup, LaneSettings, PolicyUpdate};
use getup_policy::{Body, Forward, ObservationStatistics, Policy, PolicyShape};
use getup_proto::{ColumnSpec, PolicyVersion, Rows, RunSpec, Segment, columns};
use getup_replay::{ReplayConfig, ReplayMetrics, Store};
use getup_sim::falls::{self, Landed};
use getup_sim::{GetUp, Task, TaskConfig};
use getup_telemetry::{Registry, Traces, Waits};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tempfile::TempDir;

/// Control steps of every lane in a turn: as long as a segment, so that a turn pushes about one a lane.
const STEPS: usize = 64;
/// Fallen states that the bare loop starts from.
const STATES: usize = 64;
/// How long each actor is measured.
const ACTOR_TIME: Duration = Duration::from_secs(30);
/// How long each forward pass is measured.
const FORWARD_TIME: Duration = Duration::from_secs(5);
/// A turn of forward passes.
const FORWARD_TURN: Duration = Duration::from_millis(200);

/// A policy, and the settings that an actor plays it under.
struct Case {
    policy_name: &'static str,
    actor_name: &'static str,
    policy: Arc<Policy>,
    config: ActorConfig,
}

fn main() -> anyhow::Result<()> {
    let config = TaskConfig::default();
    let task: Arc<dyn Task> = Arc::new(GetUp::new(&config, 1.0)?);
    let states = falls::draw(&config, STATES, 0)?.falls;
    let cases = cases(&*task);
    // What needs a peer comes first: a missing one is said at once.
    let mut forward = Vec::new();
    for case in &cases {
        forward.extend(case.evaluate()?);
    }
    let mut rows = Vec::new();
    for case in &cases {
        rows.push(case.act(&task, &states)?);
    }
    rows.extend(forward);
    report("actor", &rows)
}

fn cases(task: &dyn Task) -> [Case; 3] {
    let (observation, action) = (task.observation_width(), task.action_width());
    let init = |body| {
        let shape = PolicyShape { observation, action, body };
        Policy::init(shape, &mut ChaCha8Rng::seed_from_u64(0))
    };
    let mlp = |name, width| Case {
        policy_name: name,
        actor_name: name,
        policy: Arc::new(init(Body::Mlp { hidden: vec![width; 2] })),
        config: ActorConfig::default(),
    };
    let statistics =
        ObservationStatistics { mean: vec![0.0; observation], std: vec![1.0; observation], clip: 10.0 };
    let simba = Policy { statistics: Some(statistics), ..init(Body::Simba { width: 128, blocks: 1 }) };
    let laptop = Case {
        policy_name: "SimBa 128",
        actor_name: "SimBa 128 (laptop)",
        policy: Arc::new(simba),
        config: ActorConfig { fall_pool: 256, noise_hold: 16, store_limp: false, ..ActorConfig::default() },
    };
    [mlp("2×256", 256), laptop, mlp("2×1024", 1024)]
}

impl Case {
    fn act(&self, task: &Arc<dyn Task>, states: &[Landed]) -> anyhow::Result<Row> {
        let mut actor = Actor::new(self, task)?;
        let torques = actor.warm_up(&self.config, task.resets().longest())?;
        let mut bare = Bare::new(&**task);
        let lanes = self.config.lanes;
        let comparison = alternate(ACTOR_TIME, |side, pair| match side {
            Side::Ours => actor.take_turn(),
            Side::Theirs => {
                let stretch =
                    |index: usize| bare.time(&states[index % STATES], &torques[index % torques.len()]);
                let time: Duration = (pair * lanes..(pair + 1) * lanes).map(stretch).sum();
                Ok((lanes * STEPS) as f64 / time.as_secs_f64())
            }
        })?;
        Ok(comparison.with_limit(format!("actor, {}", self.actor_name), "control steps/s"))
    }

    fn evaluate(&self) -> anyhow::Result<Vec<Row>> {
        let (network, width) = match &self.policy.shape.body {
            Body::Mlp { hidden } => ("mlp", hidden[0]),
            Body::Simba { width, .. } => ("simba", *width),
        };
        let seconds = FORWARD_TURN.as_secs_f64().to_string();
        let mut peer = Peer::start("actor_eager.py", &[network, &width.to_string(), &seconds])?;
        // The first answer comes once PyTorch is loaded.
        peer.ask("1")?;
        let row = |batch: usize| -> anyhow::Result<Row> {
            let mut forward = Forward::new(&self.policy, batch);
            let mut rng = ChaCha8Rng::seed_from_u64(0);
            let numbers = batch * self.policy.shape.observation;
            let observations: Vec<f32> = (0..numbers).map(|_| rng.random_range(-1.0..1.0)).collect();
            let comparison = alternate(FORWARD_TIME, |side, _| match side {
                Side::Ours => Ok(passes_per_second(&mut forward, &observations)),
                Side::Theirs => peer.ask(&batch.to_string()),
            })?;
            let name = format!("forward, {}, batch {batch}", self.policy_name);
            Ok(comparison.with_peer(name, "passes/s"))
        };
        [1, 8, 16].into_iter().map(row).collect()
    }
}

/// Lanes on one thread, and the store that takes their segments.
struct Actor {
    lanes: LaneGroup,
    metrics: ActorMetrics,
    store: Store,
    /// Of the last segment.
    sequence: u64,
    /// Goes last: the store lies in it.
    _folder: TempDir,
}

impl Actor {
    fn new(case: &Case, task: &Arc<dyn Task>) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir()?;
        let registry = Registry::new();
        let (metrics, spec) = (ActorMetrics::new(&registry, "bench"), run_spec(&**task));
        // Without samples_per_insert nobody waits.
        let (config, waits) = (ReplayConfig::default(), Waits::new(&registry));
        let store = Store::open(folder.path(), &spec, &config, ReplayMetrics::new(&registry), waits)?;
        let settings = LaneSettings {
            task: task.clone(),
            config: case.config.clone(),
            spec,
            identity: Identity { name: "bench".to_owned(), run_seed: 0, writer: 1 },
            beta: BetaDraw { std: 0.04, floor: 0.4, ceiling: 1.0 },
            diverged_folder: folder.path().join("diverged"),
            metrics: metrics.clone(),
            traces: Traces::default(),
        };
        let lanes = LaneGroup::new(settings, 0, case.config.lanes, policy_update(&case.policy))?;
        Ok(Self { lanes, metrics, store, sequence: 0, _folder: folder })
    }

    /// Plays until every lane is under way and the pool of fallen states is full: from then on the mixture of steps
    /// stays as it is. Returns the torques of whole segments, one row a control step.
    fn warm_up(&mut self, config: &ActorConfig, fall_steps: usize) -> anyhow::Result<Vec<Vec<f32>>> {
        let limp_steps = (config.lanes + config.fall_pool) * fall_steps;
        let mut torques = Vec::new();
        while self.metrics.limp_steps.get() < limp_steps as u64 {
            let segments = self.play();
            let whole = segments.iter().filter(|segment| segment.env_steps as usize == STEPS);
            // The second column of the spec.
            torques.extend(whole.map(|segment| columns::iter(&segment.columns[1]).collect::<Vec<f32>>()));
            self.store.append(segments)?;
        }
        Ok(torques)
    }

    /// Control steps a second.
    fn take_turn(&mut self) -> anyhow::Result<f64> {
        let (before, start) = (self.control_steps(), Instant::now());
        for _ in 0..STEPS {
            let segments = self.play();
            self.store.append(segments)?;
        }
        Ok((self.control_steps() - before) as f64 / start.elapsed().as_secs_f64())
    }

    /// A control step of every lane.
    fn play(&mut self) -> Vec<Segment> {
        let mut segments = Vec::new();
        self.lanes.step(&mut segments);
        for segment in &mut segments {
            self.sequence += 1;
            segment.sequence = self.sequence;
        }
        segments
    }

    fn control_steps(&self) -> u64 {
        self.metrics.env_steps.get() + self.metrics.limp_steps.get()
    }
}

fn run_spec(task: &dyn Task) -> RunSpec {
    let column = |name: &str, width, rows| ColumnSpec { name: name.to_owned(), width, rows };
    RunSpec {
        run: "bench".to_owned(),
        task: "getup/standard".to_owned(),
        columns: vec![
            column(columns::OBSERVATION, task.observation_width(), Rows::StepsPlusOne),
            column(columns::ACTION, task.action_width(), Rows::Steps),
            column(columns::REWARD, 1, Rows::Steps),
            column(columns::BETA, 1, Rows::Once),
        ],
        max_segment_steps: STEPS,
    }
}

fn policy_update(policy: &Arc<Policy>) -> Arc<PolicyUpdate> {
    Arc::new(PolicyUpdate {
        version: PolicyVersion { incarnation: 1, counter: 0 },
        policy: policy.clone(),
        beta: 1.0,
        high_starts: 0.0,
        values: BTreeMap::new(),
        stage: 0,
        env_steps: 0,
        uniform: false,
        finished: false,
    })
}

fn passes_per_second(forward: &mut Forward, observations: &[f32]) -> f64 {
    let (mut count, start) = (0, Instant::now());
    while start.elapsed() < FORWARD_TURN {
        black_box(forward.run(black_box(observations)));
        count += 1;
    }
    f64::from(count) / start.elapsed().as_secs_f64()
}
