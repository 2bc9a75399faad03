//! A schedule: machines, a network, and what happens to them, all out of one seed.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use turmoil::Sim;

use crate::ledger::Ledger;
use crate::machine::Machine;
use crate::roles::{LEARNER, Run, actor, learner, replay, replay_name};

/// The simulation's step; an event of the network takes a whole number of them.
const TICK: Duration = Duration::from_millis(10);
/// For how long things are broken.
const FAULTS: Duration = Duration::from_secs(20);
/// Within which all must go on again afterwards.
const HEALING: Duration = Duration::from_secs(30);
/// Within which all must end in order.
const ENDING: Duration = Duration::from_secs(10);
/// A machine whose fuse burns for longer is cut off at once.
const FUSE: Duration = Duration::from_millis(500);
/// How long messages travel where nothing is wrong.
const LATENCY: Duration = Duration::from_millis(2);

/// Something that will happen.
enum Action {
    Fault,
    Cut(usize),
    Start(usize),
    Release(usize, usize),
    Repair(usize, usize),
    RepairOneWay(usize, usize),
    Quicken(usize, usize),
}

struct Schedule<'a> {
    rng: ChaCha8Rng,
    sim: Sim<'a>,
    run: Arc<Run>,
    machines: Vec<Arc<Machine>>,
    /// Whether a machine is down, or about to be.
    down: Vec<bool>,
    /// Pairs whose link is not as it should be.
    hurt: Vec<(usize, usize)>,
    actions: Vec<(Duration, Action)>,
    now: Duration,
}

/// Plays the schedule of a seed, with disks in an empty folder; what came of it, or the first promise that was broken.
pub(crate) fn play(seed: u64, folder: &Path, aloud: bool) -> Result<String, String> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (replays, actors) = (rng.random_range(1..=2), rng.random_range(1..=3));
    let paced = rng.random();
    let run = Arc::new(Run { ledger: Ledger::new(aloud), replays, paced });
    let mut sim = turmoil::Builder::new()
        .tick_duration(TICK)
        .simulation_duration(Duration::from_secs(3600))
        .min_message_latency(LATENCY)
        .max_message_latency(Duration::from_millis(rng.random_range(2..60)))
        .tcp_capacity(4096)
        .rng_seed(seed)
        .build();
    let mut machines = Vec::new();
    let disk = |name: &str| {
        let disk = folder.join(name);
        std::fs::create_dir(&disk).unwrap();
        Some(disk)
    };
    for index in 0..replays {
        let name = replay_name(index);
        let machine = Arc::new(Machine::new(name.clone(), disk(&name)));
        let (run, on) = (run.clone(), machine.clone());
        sim.host(name, move || replay(run.clone(), on.clone()));
        machines.push(machine);
    }
    let machine = Arc::new(Machine::new(LEARNER.to_owned(), disk(LEARNER)));
    let (shared, on) = (run.clone(), machine.clone());
    sim.host(LEARNER, move || learner(shared.clone(), on.clone()));
    machines.push(machine);
    for index in 0..actors {
        let machine = Arc::new(Machine::new(format!("actor-{index}"), None));
        let (run, on) = (run.clone(), machine.clone());
        sim.host(machine.name.clone(), move || actor(run.clone(), on.clone()));
        machines.push(machine);
    }
    let down = vec![false; machines.len()];
    let (hurt, now) = (Vec::new(), Duration::ZERO);
    let actions = vec![(Duration::from_millis(rng.random_range(0..3_000)), Action::Fault)];
    let mut schedule = Schedule { rng, sim, run, machines, down, hurt, actions, now };
    schedule.play()?;
    drop(schedule.sim);
    let Run { ledger, .. } = &*schedule.run;
    for (index, machine) in schedule.machines[..replays].iter().enumerate() {
        ledger.check_store(index, machine.disk());
    }
    ledger.broken().map_or_else(|| Ok(ledger.summary()), Err)
}

impl Schedule<'_> {
    fn play(&mut self) -> Result<(), String> {
        while self.now < FAULTS {
            while let Some(due) = self.actions.iter().position(|(at, _)| *at <= self.now) {
                let (_, action) = self.actions.remove(due);
                self.act(action);
            }
            self.step()?;
        }
        self.heal();
        // Those that were started run from here on.
        self.step()?;
        let healed = (self.now, self.run.ledger.progress());
        self.until(healed.0 + HEALING, "after the faults", |run| {
            run.ledger.progress().stuck_since(&healed.1)
        })?;
        self.note("all go on");
        let replays = self.run.replays;
        let actors = self.machines[replays + 1..].to_vec();
        actors.iter().for_each(|actor| actor.shutdown().trigger());
        self.until(self.now + ENDING, "at the end", |run| {
            let endings = run.ledger.endings();
            // A replay that keeps a pace takes nothing while its learner has not noticed that their stream is dead.
            let most = if run.paced { usize::MAX } else { 0 };
            let left = |machine: &&Arc<Machine>| endings.get(&machine.name).is_none_or(|owed| *owed > most);
            let left = actors.iter().filter(left);
            let left = left.map(|machine| format!("{} has not ended with all sent; ", machine.name));
            left.collect()
        })
    }

    /// Goes on until nobody is stuck.
    fn until(&mut self, limit: Duration, when: &str, stuck: impl Fn(&Run) -> String) -> Result<(), String> {
        loop {
            let stuck = stuck(&self.run);
            if stuck.is_empty() {
                return Ok(());
            }
            if self.now >= limit {
                return Err(format!("{when}, by {:.2?}: {stuck}", self.now));
            }
            self.step()?;
        }
    }

    fn step(&mut self) -> Result<(), String> {
        self.sim.step().map_err(|error| format!("at {:.2?}: {error}", self.now))?;
        self.now += TICK;
        for index in 0..self.machines.len() {
            let machine = self.machines[index].clone();
            if !machine.is_alive() && self.sim.is_host_running(machine.name.as_str()) {
                self.note(&format!("{} has lost its power", machine.name));
                self.sim.crash(machine.name.as_str());
            }
        }
        self.run.ledger.broken().map_or(Ok(()), Err)
    }

    fn act(&mut self, action: Action) {
        match action {
            Action::Fault => {
                self.fault();
                let pause = self.between(100, 3_000);
                self.later(pause, Action::Fault);
            }
            Action::Cut(machine) => self.machines[machine].cut_power(),
            Action::Start(machine) => self.start(machine),
            Action::Release(a, b) => self.link(a, b, "holds no more", |sim, a, b| sim.release(a, b)),
            Action::Repair(a, b) => self.link(a, b, "is whole", |sim, a, b| sim.repair(a, b)),
            Action::RepairOneWay(a, b) => {
                self.link(a, b, "is whole", |sim, a, b| sim.repair_oneway(a, b));
            }
            Action::Quicken(a, b) => {
                self.link(a, b, "is quick", |sim, a, b| sim.set_link_latency(a, b, LATENCY));
            }
        }
    }

    /// Something breaks.
    fn fault(&mut self) {
        if self.rng.random_bool(0.5) {
            let machine = self.rng.random_range(0..self.machines.len());
            if self.down[machine] {
                return;
            }
            self.down[machine] = true;
            let downtime = self.between(20, 9_000);
            // Nobody asks a learner to end here: what it does then is the real trainer's.
            if machine != self.run.replays && self.rng.random_bool(0.25) {
                self.note(&format!("{} is asked to end", self.machines[machine].name));
                self.machines[machine].shutdown().trigger();
            } else {
                let (writes, leaves) = (self.rng.random_range(0..40), self.rng.random());
                self.note(&format!("the power of {} goes in {writes} writes", self.machines[machine].name));
                self.machines[machine].light_fuse(writes, leaves);
                self.later(FUSE, Action::Cut(machine));
            }
            self.later(FUSE + downtime, Action::Start(machine));
        } else {
            let a = self.rng.random_range(0..self.machines.len());
            let b = self.rng.random_range(0..self.machines.len());
            let replays = self.run.replays;
            // Only those who speak with each other.
            if a == b || self.hurt.contains(&(a.min(b), a.max(b))) || a.min(b) > replays {
                return;
            }
            let lasts = self.between(50, 14_000);
            let (what, end): (fn(&Sim<'_>, &str, &str), Action) = match self.rng.random_range(0..4) {
                0 => (|sim, a, b| sim.hold(a, b), Action::Release(a, b)),
                1 => (|sim, a, b| sim.partition(a, b), Action::Repair(a, b)),
                2 => (|sim, a, b| sim.partition_oneway(a, b), Action::RepairOneWay(a, b)),
                _ => (
                    |sim, a, b| sim.set_link_latency(a, b, Duration::from_millis(900)),
                    Action::Quicken(a, b),
                ),
            };
            let name = match end {
                Action::Release(..) => "holds everything",
                Action::Repair(..) => "is cut",
                Action::RepairOneWay(..) => "is cut one way",
                _ => "is slow",
            };
            self.link(a, b, name, what);
            self.hurt.push((a.min(b), a.max(b)));
            self.later(lasts, end);
        }
    }

    fn link(&mut self, a: usize, b: usize, what: &str, change: impl Fn(&Sim<'_>, &str, &str)) {
        let (from, to) = (self.machines[a].name.clone(), self.machines[b].name.clone());
        self.note(&format!("the link of {from} and {to} {what}"));
        change(&self.sim, &from, &to);
        self.hurt.retain(|pair| *pair != (a.min(b), a.max(b)));
    }

    fn start(&mut self, index: usize) {
        let machine = self.machines[index].clone();
        self.note(&format!("{} is started", machine.name));
        self.sim.crash(machine.name.as_str());
        machine.reset();
        self.down[index] = false;
        self.sim.bounce(machine.name.as_str());
    }

    /// Everything is as it should be.
    fn heal(&mut self) {
        self.note("all is healed");
        for (_, action) in std::mem::take(&mut self.actions) {
            if !matches!(action, Action::Fault | Action::Cut(_)) {
                self.act(action);
            }
        }
    }

    fn later(&mut self, after: Duration, action: Action) {
        self.actions.push((self.now + after, action));
    }

    /// Milliseconds, of which shorter ones are likelier.
    fn between(&mut self, least: u64, most: u64) -> Duration {
        let share: f64 = self.rng.random();
        Duration::from_millis(least + ((most - least) as f64 * share * share) as u64)
    }

    fn note(&self, what: &str) {
        self.run.ledger.note(self.now, "--", what);
    }
}
