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
use getup_actor::lanes::{LaneGroup, LaneSettings};
use getup_actor::link::{Heartbeat, Lease, PolicyUpdate};
use getup_actor::metrics::ActorMetrics;
use getup_actor::sending::Sending;
use getup_learner::config::LearnerConfig;
use getup_learner::device;
use getup_learner::hub::Hub;
use getup_learner::run_folder::RunFolder;
use getup_learner::trainer::{Ending, Start, Trainer};
use getup_proto::v1;
use getup_replay::{SampleOptions, Sampler, Store};
use getup_sim::GetUp;
use getup_telemetry::Traces;
use tokio::sync::watch;

use super::progress::Progress;
use super::{note_config, open_store};
use crate::config::Config;
use crate::learner::{make_hub, make_trainer, sample_options};
use crate::role::Role;

pub(super) fn train(config: &Config, role: &Role, folder: &RunFolder, start: Start<'_>) -> Result<Ending> {
    // Sums over threads depend on their number.
    let learner = LearnerConfig { threads: 1, ..config.learner.clone() };
    let config = &Config { learner, ..config.clone() };
    let device = device::open(config.learner.device, 1)?;
    folder.create()?;
    let store = open_store(config, role, folder)?;
    let (hub, incarnation) = make_hub(config, role, folder)?;
    let trainer = make_trainer(config, role, folder.clone(), Arc::clone(&hub), incarnation, device, start)?;
    note_config(config, folder)?;
    let bar = Progress::start(role, config, Arc::clone(&hub));
    let identity =
        Identity::of_start(&config.actor.name, config.seed, incarnation, |writer| store.knows(writer));
    let setup = crate::actor::setup(config, role, identity, folder.root().join("diverged"))?;
    let options = sample_options(config, incarnation);
    store.check_options(&options)?;
    let policies = hub.subscribe(&setup.spec)?;
    let policy = Arc::new(PolicyUpdate::parse(v1::PolicyUpdate::clone(&policies.borrow()))?);
    let settings = LaneSettings {
        task: Arc::new(GetUp::new(&setup.task, config.control_limit())?),
        config: setup.config,
        spec: setup.spec,
        identity: setup.identity,
        beta: setup.beta,
        diverged_folder: setup.diverged_folder,
        metrics: ActorMetrics::new(&role.registry, &config.actor.name),
        traces: setup.traces,
    };
    let mut turns = Turns {
        evaluator: Evaluator::new(&config.task, config.control_limit(), config.evaluation.episodes)?,
        lanes: LaneGroup::new(settings, 0, config.actor.lanes, policy)?,
        sampler: Sampler::new(options.seed),
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
    sampler: Sampler,
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
            match self.store.try_sample(&mut self.sampler, &self.options)? {
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
