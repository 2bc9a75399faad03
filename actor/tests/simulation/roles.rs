//! The three roles on their machines: all real but for what plays ([`play`]) and what learns ([`crate::trainer`]).

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use getup_actor::{
    ActorConfig, ActorError, ActorSetup, BetaDraw, EpisodeResult, GrpcLearner, GrpcReplay, Heartbeat,
    Identity, LearnerLink, Lease, LinkError, Playing, PolicySlot, Reported, SegmentBuilder, SegmentWriter,
    StepEnd, StepRecord, run_with,
};
use getup_learner::hub::Hub;
use getup_learner::run_folder::RunFolder;
use getup_learner::service::service;
use getup_proto::{ColumnSpec, Rows, RunSpec, Segment, columns};
use getup_replay::{ReplayConfig, ReplayMetrics, Store, limits, serve_at};
use getup_telemetry::{Registry, Shutdown, Waits};
use getup_transport::{Credentials, Limits, Metrics, Server};
use tokio::task::JoinSet;
use tonic::service::Routes;

use crate::ledger::Ledger;
use crate::machine::Machine;
use crate::network::{Port, endpoint};
use crate::trainer::Trainer;

/// Steps of the longest segment.
const SEGMENT_STEPS: usize = 8;
/// Steps of an episode, of which the first are limp.
const EPISODE_STEPS: u64 = 20;
const LIMP_STEPS: u64 = 3;
const LANES: u32 = 2;
/// How often every lane makes [`STEPS_AT_ONCE`] steps.
const PACE: Duration = Duration::from_millis(100);
const STEPS_AT_ONCE: usize = 4;
/// What an evaluation takes.
const EVALUATION: Duration = Duration::from_millis(700);
/// How long a lease lasts without a heartbeat.
const KEEP_ALIVE: Duration = Duration::from_secs(4);

pub(crate) const LEARNER: &str = "learner";

/// What every role of a schedule knows.
pub(crate) struct Run {
    pub(crate) ledger: Ledger,
    pub(crate) replays: usize,
    /// Whether the replays hold writers and samplers to a pace.
    pub(crate) paced: bool,
}

pub(crate) fn replay_name(index: usize) -> String {
    format!("replay-{index}")
}

pub(crate) fn spec() -> RunSpec {
    let column = |name: &str, width, rows| ColumnSpec { name: name.to_owned(), width, rows };
    RunSpec {
        run: "simulation".to_owned(),
        task: "getup/standard".to_owned(),
        columns: vec![
            column(columns::OBSERVATION, 2, Rows::StepsPlusOne),
            column(columns::ACTION, 1, Rows::Steps),
            column(columns::REWARD, 1, Rows::Steps),
            column(columns::BETA, 1, Rows::Once),
        ],
        max_segment_steps: SEGMENT_STEPS,
    }
}

/// A replay: its store and its service.
pub(crate) async fn replay(run: Arc<Run>, machine: Arc<Machine>) -> turmoil::Result {
    let registry = Registry::new();
    let config = ReplayConfig {
        capacity: 100_000,
        min_size: 32,
        samples_per_insert: run.paced.then_some(0.5),
        error_buffer: run.paced.then_some(64.0),
        ..ReplayConfig::default()
    };
    let store =
        Store::open(machine.disk(), &spec(), &config, ReplayMetrics::new(&registry), Waits::new(&registry));
    let store = store.map_err(|error| format!("{} cannot open its store: {error}", machine.name))?;
    run.ledger.event(&machine, &format!("starts with {:?}", store.counters().transitions));
    let port = Server::new(Credentials::default(), limits(), Metrics::new(&registry));
    let listener = Port::bind(&machine).await?;
    serve_at(port, listener, Arc::new(store), machine.shutdown()).await?;
    run.ledger.event(&machine, "ends");
    Ok(())
}

/// A learner: its hub, its service, and what stands in for training.
pub(crate) async fn learner(run: Arc<Run>, machine: Arc<Machine>) -> turmoil::Result {
    let registry = Registry::new();
    let (waits, shutdown) = (Waits::new(&registry), Shutdown::new());
    let folder = RunFolder::new(machine.disk());
    folder.create()?;
    let incarnation = folder.next_incarnation()?;
    run.ledger.event(&machine, &format!("starts as incarnation {incarnation}"));
    let hub = Arc::new(Hub::new(spec(), vec![1, 2, 3], KEEP_ALIVE, incarnation, waits.clone()));
    let routes = Routes::new(service(hub.clone(), shutdown.clone()));
    let port = Server::new(Credentials::default(), Limits::default(), Metrics::new(&registry));
    let listener = Port::bind(&machine).await?;
    tokio::spawn(port.serve(listener, routes, Shutdown::new()));
    let mut trainer = Trainer::new(&run, &machine, folder, hub, incarnation, &waits, &shutdown)?;
    loop {
        trainer.turn()?;
        tokio::time::sleep(PACE).await;
    }
}

/// An actor, whose characters are stubs.
pub(crate) async fn actor(run: Arc<Run>, machine: Arc<Machine>) -> turmoil::Result {
    let registry = Registry::new();
    let (waits, shutdown) = (Waits::new(&registry), machine.shutdown());
    let config = ActorConfig {
        name: machine.name.clone(),
        lanes: LANES as usize,
        segment_steps: SEGMENT_STEPS,
        queue_segments: 12,
        ..ActorConfig::default()
    };
    let setup = ActorSetup {
        config,
        task: Default::default(),
        spec: spec(),
        identity: Identity::new(&machine.name, 7),
        beta: BetaDraw { std: 0.04, floor: 0.4, ceiling: 1.0 },
        diverged_folder: Default::default(),
        traces: Default::default(),
    };
    run.ledger.started(&machine, run.replays);
    let writer = |index: usize| {
        let (to, identity) = (endpoint(&replay_name(index), &machine), setup.identity.towards(index));
        let link = GrpcReplay::new(to, setup.spec.clone(), identity, waits.clone())?;
        Ok::<_, getup_transport::AddressError>(Noted {
            link,
            replay: index,
            run: run.clone(),
            machine: machine.clone(),
        })
    };
    let writers = (0..run.replays).map(writer).collect::<Result<Vec<_>, _>>()?;
    let link =
        GrpcLearner::new(endpoint(LEARNER, &machine), setup.spec.clone(), &machine.name, waits.clone())?;
    let link = Noted { link, replay: 0, run: run.clone(), machine: machine.clone() };
    let (noted, of, identity) = (run.clone(), machine.clone(), setup.identity.clone());
    let play = |playing| {
        let mut tasks = JoinSet::new();
        tasks.spawn(play(playing, noted, of, identity));
        Ok(tasks)
    };
    let ended = run_with(&setup, writers, link, waits, shutdown.clone(), &registry, play).await;
    ended.map_err(|error| format!("{} failed: {error}", machine.name))?;
    let owed: usize =
        (0..run.replays).map(|index| run.ledger.owes(setup.identity.towards(index).writer)).sum();
    run.ledger.ended(&machine, owed);
    Ok(())
}

/// Plays lanes of episodes whose every number says where it belongs, and evaluations that take their time.
async fn play(
    mut playing: Playing,
    run: Arc<Run>,
    machine: Arc<Machine>,
    identity: Identity,
) -> Result<(), ActorError> {
    let mut lanes: Vec<Lane> = (0..LANES).map(|lane| Lane::new(&identity, lane)).collect();
    let mut pending_segments = VecDeque::new();
    let mut ticks = tokio::time::interval(PACE);
    loop {
        tokio::select! {
            biased;
            () = playing.stop.wait() => return Ok(()),
            _ = ticks.tick() => {}
        }
        let Some(update) = playing.updates.borrow_and_update().clone() else { continue };
        run.ledger.acts_by(&machine, update.version);
        if let Ok(lease) = playing.leases.try_recv() {
            run.ledger.leased(&machine, lease.id, lease.update.version);
            tokio::select! {
                biased;
                () = playing.stop.wait() => return Ok(()),
                () = tokio::time::sleep(EVALUATION) => {}
            }
            let results = lease.seeds.iter().map(|seed| result(&lease, *seed)).collect();
            let _ = playing.reports.send((lease.id, results));
            continue;
        }
        playing.queue.fill_from(&mut pending_segments);
        if pending_segments.is_empty() {
            for lane in &mut lanes {
                pending_segments.extend((0..STEPS_AT_ONCE).filter_map(|_| lane.step(&update)));
            }
            playing.queue.fill_from(&mut pending_segments);
        }
    }
}

/// The result of an evaluation's episode: it names its lease, and its return is now and then enough for the next stage.
fn result(lease: &Lease, seed: u64) -> EpisodeResult {
    let draw = mix(lease.id ^ (seed << 56)) % 40;
    EpisodeResult {
        episode_return: 50.0 + draw as f64,
        max_head_height: lease.id as f64,
        final_head_height: 0.0,
        rises: true,
        stands: false,
    }
}

struct Lane {
    builder: SegmentBuilder,
    writer: u64,
    lane: u32,
    episode: u64,
    step: u64,
}

impl Lane {
    fn new(identity: &Identity, lane: u32) -> Self {
        let builder = SegmentBuilder::new(&spec(), 2, 1, SEGMENT_STEPS, identity.writer, lane);
        let builder = builder.expect("the spec is the simulation's own");
        Self { builder, writer: identity.writer, lane, episode: 0, step: 0 }
    }

    fn step(&mut self, update: &getup_actor::PolicyUpdate) -> Option<Segment> {
        if self.step == 0 {
            self.builder.begin(self.episode, update.stage, update.beta as f32);
        }
        let end = match self.step + 1 {
            LIMP_STEPS => StepEnd::Landed,
            EPISODE_STEPS => StepEnd::TimeLimit,
            _ => StepEnd::Continues,
        };
        let value = |step: u64| self.value(step);
        let segment = self.builder.push(&StepRecord {
            observation: &value(self.step),
            action: &value(self.step)[..1],
            reward: 1.0,
            next_observation: &value(self.step + 1),
            env_step: self.step >= LIMP_STEPS,
            version: update.version,
            end,
        });
        self.step += 1;
        if self.step == EPISODE_STEPS {
            (self.episode, self.step) = (self.episode + 1, 0);
        }
        segment
    }

    fn value(&self, step: u64) -> [f32; 2] {
        let hash = mix(self.writer ^ mix((u64::from(self.lane) << 48) | (self.episode << 16) | step));
        [(hash >> 40) as f32, (hash & 0xff_ffff) as f32]
    }
}

/// splitmix64's finalizer.
fn mix(value: u64) -> u64 {
    let value = (value ^ (value >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ (value >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ (value >> 31)
}

/// A link, with what passes through it noted.
struct Noted<T> {
    link: T,
    replay: usize,
    run: Arc<Run>,
    machine: Arc<Machine>,
}

impl<T: SegmentWriter> SegmentWriter for Noted<T> {
    fn writer(&self) -> u64 {
        self.link.writer()
    }

    async fn append(&mut self, segments: Vec<Segment>) -> Result<(), LinkError> {
        let last = segments.last().map_or(0, |segment| segment.sequence);
        self.run.ledger.sent(self.replay, &segments);
        self.link.append(segments).await?;
        self.run.ledger.acknowledged(&self.machine, self.replay, self.link.writer(), last);
        Ok(())
    }
}

impl<T: LearnerLink> LearnerLink for Noted<T> {
    async fn subscribe(&self, slot: PolicySlot) -> Result<(), LinkError> {
        self.link.subscribe(slot).await
    }

    async fn heartbeat(&self, beat: Heartbeat) -> Result<Option<Lease>, LinkError> {
        self.machine.beats();
        self.link.heartbeat(beat).await
    }

    async fn report(&self, lease: u64, episodes: Vec<EpisodeResult>) -> Result<Reported, LinkError> {
        let reported = self.link.report(lease, episodes).await?;
        if reported == Reported::Accepted {
            self.run.ledger.accepted(&self.machine, lease);
        }
        Ok(reported)
    }
}
