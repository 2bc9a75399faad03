//! Many actors, and a learner that was away from all of them: whether they come back at once.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use turmoil::Sim;

use crate::ledger::Ledger;
use crate::machine::Machine;
use crate::roles::{LEARNER, Run, actor, learner, replay, replay_name};

/// Actors, all of them started in the same moment.
pub(crate) const ACTORS: usize = 40;
/// When the learner goes, and when it is back.
const GOES: Duration = Duration::from_secs(8);
const COMES: Duration = Duration::from_secs(14);
const END: Duration = Duration::from_secs(24);

/// How the learner is away.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Absence {
    /// Its machine loses its power, and what is sent there is lost; another start of it comes up.
    Crash,
    /// All that is sent to it and by it is held up, and then delivered.
    Hang,
}

/// Moments since the learner was back, in their order.
pub(crate) struct Return {
    /// It took a connection.
    pub(crate) connections: Vec<Duration>,
    /// It was sent a heartbeat.
    pub(crate) heartbeats: Vec<Duration>,
}

/// Plays it, with disks in an empty folder.
pub(crate) fn play(folder: &Path, absence: Absence) -> Return {
    let run = Arc::new(Run { ledger: Ledger::new(false), replays: 1, paced: false });
    let mut sim = turmoil::Builder::new()
        .tick_duration(Duration::from_millis(10))
        .simulation_duration(Duration::from_secs(3600))
        .min_message_latency(Duration::from_millis(2))
        .max_message_latency(Duration::from_millis(20))
        .tcp_capacity(4096)
        .rng_seed(1)
        .build();
    let disk = |name: &str| {
        let disk = folder.join(name);
        std::fs::create_dir(&disk).unwrap();
        Some(disk)
    };
    let store = Arc::new(Machine::new(replay_name(0), disk("replay")));
    let (shared, on) = (run.clone(), store.clone());
    sim.host(store.name.clone(), move || replay(shared.clone(), on.clone()));
    let service = Arc::new(Machine::new(LEARNER.to_owned(), disk("learner")));
    let (shared, on) = (run.clone(), service.clone());
    sim.host(LEARNER, move || learner(shared.clone(), on.clone()));
    let actors: Vec<Arc<Machine>> =
        (0..ACTORS).map(|index| Arc::new(Machine::new(format!("actor-{index}"), None))).collect();
    for machine in &actors {
        let (shared, on) = (run.clone(), machine.clone());
        sim.host(machine.name.clone(), move || actor(shared.clone(), on.clone()));
    }
    let each = |sim: &Sim<'_>, change: fn(&Sim<'_>, &str, &str)| {
        actors.iter().for_each(|actor| change(sim, &actor.name, LEARNER));
    };
    let until = |sim: &mut Sim<'_>, time| {
        while sim.elapsed() < time {
            sim.step().unwrap();
        }
    };
    until(&mut sim, GOES);
    match absence {
        Absence::Crash => {
            service.cut_power();
            sim.crash(LEARNER);
            each(&sim, |sim, actor, learner| sim.partition(actor, learner));
        }
        Absence::Hang => each(&sim, |sim, actor, learner| sim.hold(actor, learner)),
    }
    until(&mut sim, COMES);
    match absence {
        Absence::Crash => {
            service.reset();
            sim.bounce(LEARNER);
            each(&sim, |sim, actor, learner| sim.repair(actor, learner));
        }
        Absence::Hang => each(&sim, |sim, actor, learner| sim.release(actor, learner)),
    }
    until(&mut sim, END);
    assert_eq!(run.ledger.broken(), None);
    let since = |moments: Vec<Duration>| {
        let mut moments: Vec<Duration> =
            moments.into_iter().filter_map(|moment| moment.checked_sub(COMES)).collect();
        moments.sort();
        moments
    };
    Return {
        connections: since(service.visits()),
        heartbeats: since(actors.iter().flat_map(|actor| actor.heartbeats()).collect()),
    }
}
