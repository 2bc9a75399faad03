//! `--deterministic`: the same parts, driven by one thread in a fixed order.
//!
//! A control step of all lanes; their segments into the store; as many updates as the rate limiter lets through;
//! leased evaluations; the newest policy into the lanes. No clock and no scheduler decides anything.

use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use getup_actor::evaluate::Evaluator;
use getup_actor::identity::Identity;
use getup_actor::lanes::{LaneGroup, LaneSettings};
use getup_actor::link::{Lease, PolicyUpdate};
use getup_actor::metrics::ActorMetrics;
use getup_learner::device;
use getup_learner::hub::Hub;
use getup_learner::run_folder::RunFolder;
use getup_learner::trainer::{Ending, Trainer};
use getup_proto::v1;
use getup_replay::{Sampler, Store};
use getup_sim::GetUp;

use super::open_store;
use super::progress::Progress;
use crate::config::Config;
use crate::learner::{make_hub, make_trainer, sample_options};
use crate::role::Role;

pub(super) fn train(config: &Config, role: &Role, folder: &RunFolder, resume: bool) -> Result<Ending> {
    let device = device::open(config.learner.device, 1)?;
    let store = open_store(config, role, folder)?;
    let (hub, incarnation) = make_hub(config, role, folder)?;
    let trainer = make_trainer(config, role, folder.clone(), Arc::clone(&hub), incarnation, device, resume)?;
    let bar = Progress::start(role, config, Arc::clone(&hub), Arc::clone(&store));
    let mut turns = Turns::new(config, role, folder, hub, store, trainer, incarnation)?;
    let ending = turns.run(role)?;
    tokio::runtime::Handle::current().block_on(bar.finish());
    Ok(ending)
}

/// Everything that takes turns.
struct Turns {
    name: String,
    hub: Arc<Hub>,
    store: Arc<Store>,
    sampler: Sampler,
    trainer: Trainer,
    lanes: LaneGroup,
    evaluator: Evaluator,
    sequence: u64,
    options: getup_replay::SampleOptions,
}
