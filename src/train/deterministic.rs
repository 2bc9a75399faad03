//! `--deterministic`: the same parts, driven by one thread in a fixed order.
//!
//! A control step of all lanes; their segments into the store; as many updates as the rate limiter lets through;
//! leased evaluations; the newest policy into the lanes. No clock and no scheduler decides anything.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use getup_actor::evaluate::{EvaluateError, Evaluator};
use getup_actor::identity::Identity;
use getup_actor::lanes::LaneGroup;
use getup_actor::link::{Heartbeat, Lease, PolicyUpdate};
use getup_actor::metrics::ActorMetrics;
use getup_actor::sending::Sending;
use getup_learner::config::LearnerConfig;
use getup_learner::device::Device;
use getup_learner::hub::Hub;
use getup_learner::run_folder::RunFolder;
use getup_learner::trainer::{Ending, Start, Trainer};
use getup_proto::v1;
use getup_replay::{SampleOptions, Store};
use getup_telemetry::Traces;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tokio::sync::watch;

use super::open_store;
use super::progress::Progress;
use crate::config::Config;
use crate::role::Role;
use crate::run::{make_hub, make_trainer, note_config, sample_options};

pub(super) fn train(
    config: &Config,
    role: &Role,
    folder: &RunFolder,
    device: Device,
    start: Start<'_>,
) -> Result<Ending> {
    // Sums over threads depend on their number. What is noted of the run is what was asked for.
    let learner = LearnerConfig { threads: 1, ..config.learner.clone() };
    let (noted, config) = (config, &Config { learner, ..config.clone() });
    folder.create()?;
    let _lock = folder.lock()?;
    let store = open_store(config, role, folder)?;
    let (hub, incarnation) = make_hub(config, role, folder)?;
    let trainer = make_trainer(config, role, folder.clone(), Arc::clone(&hub), incarnation, device, start)?;
    note_config(noted, folder)?;
    let bar = Progress::start(role, config, Arc::clone(&hub));
    let identity =
        Identity::of_start(&config.actor.name, config.seed, incarnation, |writer| store.knows(writer));
    let setup = crate::actor::setup(config, role, identity, folder.root().join("diverged"))?;
    let options = sample_options(config, incarnation);
    store.check_options(&options)?;
    let policies = hub.subscribe(&setup.spec)?;
    let policy = Arc::new(PolicyUpdate::parse(v1::PolicyUpdate::clone(&policies.borrow()))?);
    let settings = setup.lane_settings(ActorMetrics::new(&role.registry, &config.actor.name))?;
    let mut turns = Turns {
        evaluator: Evaluator::new(&config.task, config.control_limit(), config.evaluation.episodes)?,
        lanes: LaneGroup::new(settings, 0, config.actor.lanes, policy)?,
        draws: ChaCha8Rng::seed_from_u64(options.seed),
        name: config.actor.name.clone(),
        traces: role.traces.clone(),
        sequence: 0,
        options,
        policies,
        hub,
        store,
        trainer,
    };
    while turns.trainer.ending().is_none() && !role.shutdown.is_triggered() {
        turns.play()?;
        turns.update(role)?;
        turns.evaluate(role)?;
        turns.take_policy()?;
    }
    let ending = turns.trainer.finish()?;
    tokio::runtime::Handle::current().block_on(bar.finish());
    Ok(ending)
}

/// Everything that takes turns.
struct Turns {
    name: String,
    traces: Traces,
    hub: Arc<Hub>,
    policies: watch::Receiver<Arc<v1::PolicyUpdate>>,
    store: Arc<Store>,
    /// Which transitions are sampled.
    draws: ChaCha8Rng,
    options: SampleOptions,
    trainer: Trainer,
    lanes: LaneGroup,
    evaluator: Evaluator,
    /// Of the last segment.
    sequence: u64,
}

impl Turns {
    /// A control step of every lane.
    fn play(&mut self) -> Result<()> {
        let mut segments = Vec::new();
        self.lanes.step(&mut segments);
        for segment in &mut segments {
            self.sequence += 1;
            segment.sequence = self.sequence;
        }
        let sending = Sending::begin(&self.traces, &self.name, &mut segments);
        self.store.append(segments)?;
        sending.acknowledged();
        Ok(())
    }

    /// As many updates as the limiter lets through.
    fn update(&mut self, role: &Role) -> Result<()> {
        while self.trainer.ending().is_none() && !role.shutdown.is_triggered() {
            match self.store.try_sample(&mut self.draws, &self.options)? {
                Some(minibatch) => {
                    let priorities = self.trainer.tick(minibatch)?;
                    self.store.update_priorities(&priorities)?;
                }
                None => break,
            }
        }
        Ok(())
    }

    /// Every evaluation that is offered, at once.
    fn evaluate(&mut self, role: &Role) -> Result<()> {
        loop {
            let beat = Heartbeat { actor: self.name.clone(), ..Heartbeat::default() };
            let reply = self.hub.heartbeat(beat.into(), Instant::now())?;
            let Some(lease) = reply.lease.map(Lease::parse).transpose()? else { return Ok(()) };
            let go_on = |_| {
                if role.shutdown.is_triggered() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            };
            let (policy, beta) = (&lease.update.policy, lease.update.beta);
            let episodes = match self.evaluator.evaluate(policy, beta, &lease.seeds, go_on) {
                Err(EvaluateError::Ended) => return Ok(()),
                episodes => episodes?,
            };
            let episodes = episodes.iter().map(|episode| episode.result().into()).collect();
            self.hub.report(v1::EvaluationReport { lease: lease.id, actor: self.name.clone(), episodes })?;
            self.trainer.take_reports()?;
        }
    }

    /// The newest policy into the lanes.
    fn take_policy(&mut self) -> Result<()> {
        if self.policies.has_changed()? {
            let policy = v1::PolicyUpdate::clone(&self.policies.borrow_and_update());
            self.lanes.set_policy(Arc::new(PolicyUpdate::parse(policy)?))?;
        }
        Ok(())
    }
}
