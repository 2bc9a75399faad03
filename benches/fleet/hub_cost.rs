//! What a heartbeat takes of the hub, in process.

use std::hint::black_box;
use std::time::Instant;

use getup_actor::Heartbeat;
use serde::Serialize;

use crate::learner::hub;

/// What a heartbeat takes of a hub that knows so many actors.
#[derive(Serialize)]
pub(crate) struct HubCost {
    pub(crate) actors: u64,
    pub(crate) seconds: f64,
}

/// Every actor says in turn that it is there, without a network.
pub(crate) fn hub_cost(actors: u64) -> HubCost {
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
