//! What has happened, as somebody would know who sees all machines at once; and what must never happen.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::Path;
use std::sync::{Mutex, MutexGuard};
use std::time::Duration;

use getup_proto::{PolicyVersion, Segment};
use getup_replay::ReplayCounters;

use crate::machine::Machine;

/// The book of one schedule. What breaks a promise is written down, and ends the schedule.
pub(crate) struct Ledger {
    pages: Mutex<Pages>,
    aloud: bool,
}

#[derive(Default)]
struct Pages {
    digest: u64,
    events: u64,
    violations: Vec<String>,
    /// By replay and writer: what was sent, by its sequence number, and how far it was acknowledged.
    writers: BTreeMap<(usize, u64), Written>,
    /// The last counters of each store.
    counters: BTreeMap<u64, ReplayCounters>,
    /// Leases that were given, with the policy to evaluate and to whom: whoever did not hear of it is told again.
    leases: BTreeMap<u64, (PolicyVersion, String)>,
    accepted: BTreeSet<u64>,
    counted: BTreeSet<PolicyVersion>,
    counted_leases: BTreeSet<u64>,
    /// The newest broadcast, its stage and its β.
    broadcast: Option<(PolicyVersion, u32, f64)>,
    /// By actor: the newest policy that this start of it acts by, and what each replay has acknowledged.
    actors: BTreeMap<String, (PolicyVersion, Vec<u64>)>,
    /// Actors that have ended in order, and what they left unacknowledged.
    ended: BTreeMap<String, usize>,
    /// Env steps of the run, as its learner counts them.
    env_steps: u64,
}

#[derive(Default)]
struct Written {
    sent: BTreeMap<u64, Segment>,
    acknowledged: u64,
}

/// How far everybody is: what must grow once nothing is broken any more.
#[derive(Clone, Debug, Default)]
pub(crate) struct Progress {
    evaluations: usize,
    env_steps: u64,
    broadcast: PolicyVersion,
    acknowledged: BTreeMap<String, Vec<u64>>,
    versions: BTreeMap<String, PolicyVersion>,
}

impl Progress {
    /// Who has not got further since `before`; empty where all have.
    pub(crate) fn stuck_since(&self, before: &Self) -> String {
        let mut stuck = String::new();
        if self.evaluations <= before.evaluations {
            stuck += "no evaluation was counted; ";
        }
        if self.env_steps <= before.env_steps {
            stuck += "the learner counted no env steps; ";
        }
        for (actor, acknowledged) in &self.acknowledged {
            for (replay, now) in acknowledged.iter().enumerate() {
                if *now < before.acknowledged.get(actor).map_or(0, |before| before[replay]) + 3 {
                    let _ = write!(stuck, "replay-{replay} has nothing new of {actor}; ");
                }
            }
        }
        for (actor, version) in &self.versions {
            if *version <= before.broadcast {
                let _ = write!(stuck, "{actor} still acts by policy {version}; ");
            }
        }
        stuck
    }
}

impl Ledger {
    pub(crate) fn new(aloud: bool) -> Self {
        Self { pages: Mutex::new(Pages { digest: 0xcbf2_9ce4_8422_2325, ..Pages::default() }), aloud }
    }

    /// Notes an event at a simulated time.
    pub(crate) fn note(&self, at: Duration, who: &str, what: &str) {
        let line = format!("{:>9.3} {who}: {what}", at.as_secs_f64());
        if self.aloud {
            println!("{line}");
        }
        let mut pages = self.pages();
        pages.events += 1;
        for byte in line.bytes() {
            pages.digest = (pages.digest ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }

    /// An event of a machine, unless its power has gone.
    pub(crate) fn event(&self, machine: &Machine, what: &str) {
        if machine.is_alive() {
            self.note(turmoil::sim_elapsed().unwrap_or_default(), &machine.name, what);
        }
    }

    /// A broken promise.
    pub(crate) fn violation(&self, what: String) {
        self.pages().violations.push(what);
    }

    /// The first broken promise.
    pub(crate) fn broken(&self) -> Option<String> {
        self.pages().violations.first().cloned()
    }

    /// How many events there were, and what they come to.
    pub(crate) fn summary(&self) -> String {
        let pages = self.pages();
        let acknowledged: u64 = pages.writers.values().map(|written| written.acknowledged).sum();
        format!(
            "{} events, {} writers, {acknowledged} segments acknowledged, {} evaluations counted, {:?}, digest {:016x}",
            pages.events,
            pages.writers.len(),
            pages.counted.len(),
            pages.broadcast,
            pages.digest
        )
    }

    /// An actor starts.
    pub(crate) fn started(&self, machine: &Machine, replays: usize) {
        {
            let mut pages = self.pages();
            pages.actors.insert(machine.name.clone(), (PolicyVersion::default(), vec![0; replays]));
            pages.ended.remove(&machine.name);
        }
        self.event(machine, "starts");
    }

    /// Segments are handed to the link, in order.
    pub(crate) fn sent(&self, replay: usize, segments: &[Segment]) {
        let mut pages = self.pages();
        for segment in segments {
            let written = pages.writers.entry((replay, segment.writer)).or_default();
            let next = written.sent.last_key_value().map_or(1, |(last, _)| last + 1);
            if segment.sequence != next {
                let (writer, sequence) = (segment.writer, segment.sequence);
                pages.violations.push(format!("writer {writer} sends {sequence} where {next} is next"));
            } else {
                written.sent.insert(next, segment.clone());
            }
        }
    }

    /// The link says that a replay has them all.
    pub(crate) fn acknowledged(&self, machine: &Machine, replay: usize, writer: u64, sequence: u64) {
        {
            let mut pages = self.pages();
            let written = pages.writers.entry((replay, writer)).or_default();
            let more = sequence - written.acknowledged;
            written.acknowledged = sequence;
            if let Some(actor) = pages.actors.get_mut(&machine.name) {
                actor.1[replay] += more;
            }
        }
        self.event(machine, &format!("replay-{replay} has {writer:016x} up to {sequence}"));
    }

    /// An actor has ended in order, with so many segments that nobody acknowledged.
    pub(crate) fn ended(&self, machine: &Machine, owed: usize) {
        if machine.is_alive() {
            self.pages().ended.insert(machine.name.clone(), owed);
        }
        self.event(machine, &format!("ends, {owed} segments unacknowledged"));
    }

    /// The actors that have ended in order since they were started last, and what each left unacknowledged.
    pub(crate) fn endings(&self) -> BTreeMap<String, usize> {
        self.pages().ended.clone()
    }

    /// Segments of a writer that were sent and not acknowledged.
    pub(crate) fn owes(&self, writer: u64) -> usize {
        let pages = self.pages();
        let of_writer = pages.writers.iter().filter(|((_, of), _)| *of == writer);
        of_writer.map(|(_, written)| written.sent.len() - written.acknowledged as usize).sum()
    }

    /// An actor acts by a policy.
    pub(crate) fn acts_by(&self, machine: &Machine, version: PolicyVersion) {
        let mut pages = self.pages();
        let Some(actor) = pages.actors.get_mut(&machine.name) else { return };
        let before = std::mem::replace(&mut actor.0, version);
        if version < before {
            pages.violations.push(format!("{} goes from policy {before} back to {version}", machine.name));
        }
        drop(pages);
        if version > before {
            self.event(machine, &format!("acts by policy {version}"));
        }
    }

    /// An actor was given a lease.
    pub(crate) fn leased(&self, machine: &Machine, lease: u64, version: PolicyVersion) {
        let given = (version, machine.name.clone());
        let before = self.pages().leases.insert(lease, given.clone());
        if let Some(before) = before
            && before != given
        {
            self.violation(format!("lease {lease:#x} was given as {before:?} and as {given:?}"));
        }
        self.event(machine, &format!("leases {lease:#x} of policy {version}"));
    }

    /// The learner has said that a report counts.
    pub(crate) fn accepted(&self, machine: &Machine, lease: u64) {
        if !self.pages().accepted.insert(lease) {
            self.violation(format!("two reports of lease {lease:#x} were accepted"));
        }
        self.event(machine, &format!("reported {lease:#x}"));
    }

    /// The learner counts the result of an evaluation, which was played under a lease.
    pub(crate) fn counted(&self, machine: &Machine, version: PolicyVersion, lease: u64) {
        if !machine.is_alive() {
            return;
        }
        let mut pages = self.pages();
        if pages.leases.get(&lease).map(|(leased, _)| leased) != Some(&version) {
            pages.violations.push(format!("the result of {version} is that of lease {lease:#x}"));
        }
        if !pages.counted.insert(version) || !pages.counted_leases.insert(lease) {
            pages.violations.push(format!("the evaluation of {version} (lease {lease:#x}) counts twice"));
        }
        drop(pages);
        self.event(machine, &format!("counts the evaluation of {version}"));
    }

    /// The learner broadcasts.
    pub(crate) fn broadcast(&self, machine: &Machine, version: PolicyVersion, stage: u32, beta: f64) {
        if !machine.is_alive() {
            return;
        }
        let mut pages = self.pages();
        if let Some((last, last_stage, last_beta)) = pages.broadcast
            && !(version > last && stage >= last_stage && beta <= last_beta)
        {
            pages.violations.push(format!(
                "policy {version} of stage {stage} and β {beta} follows {last} of stage {last_stage} and β {last_beta}"
            ));
        }
        pages.broadcast = Some((version, stage, beta));
        drop(pages);
        self.event(machine, &format!("broadcasts {version}, stage {stage}, β {beta:.3}"));
    }

    /// The learner was given a minibatch.
    pub(crate) fn sampled(&self, machine: &Machine, counters: ReplayCounters) {
        if !machine.is_alive() {
            return;
        }
        let mut pages = self.pages();
        let before = pages.counters.insert(counters.store, counters).unwrap_or_default();
        let of = |counters: &ReplayCounters| {
            [counters.env_steps, counters.transitions, counters.episodes, counters.sampled]
        };
        if of(&before).iter().zip(of(&counters)).any(|(before, now)| now < *before) {
            pages.violations.push(format!("a store went from {before:?} back to {counters:?}"));
        }
        drop(pages);
        self.event(machine, &format!("samples {:?}", of(&counters)));
    }

    /// The learner has counted so many env steps of the run.
    pub(crate) fn env_steps(&self, machine: &Machine, env_steps: u64) {
        if machine.is_alive() {
            self.pages().env_steps = env_steps;
        }
    }

    /// How far everybody is.
    pub(crate) fn progress(&self) -> Progress {
        let pages = self.pages();
        Progress {
            evaluations: pages.counted.len(),
            env_steps: pages.env_steps,
            broadcast: pages.broadcast.map_or_else(PolicyVersion::default, |broadcast| broadcast.0),
            acknowledged: pages.actors.iter().map(|(name, actor)| (name.clone(), actor.1.clone())).collect(),
            versions: pages.actors.iter().map(|(name, actor)| (name.clone(), actor.0)).collect(),
        }
    }

    /// Holds the folder of a replay's store against what was sent and acknowledged: each writer's segments without a gap,
    /// each once, as they were sent, and all that were acknowledged.
    pub(crate) fn check_store(&self, replay: usize, folder: &Path) {
        let mut stored: BTreeMap<u64, u64> = BTreeMap::new();
        let mut pages = self.pages();
        let (_, segments) = getup_replay::segments(folder).unwrap();
        for segment in segments {
            let segment = segment.unwrap();
            let (writer, sequence) = (segment.writer, segment.sequence);
            let last = stored.insert(writer, sequence).unwrap_or(0);
            let sent = pages.writers.get(&(replay, writer)).and_then(|written| written.sent.get(&sequence));
            let problem = match sent {
                _ if sequence != last + 1 => format!("follows segment {last}"),
                None => "was never sent".to_owned(),
                Some(sent) if *sent != segment => "is not what was sent".to_owned(),
                Some(_) => continue,
            };
            pages.violations.push(format!(
                "replay-{replay} holds segment {sequence} of writer {writer:016x}, which {problem}"
            ));
        }
        let mut lost = Vec::new();
        for (&(of, writer), written) in &pages.writers {
            let durable = stored.get(&writer).copied().unwrap_or(0);
            if of == replay && durable < written.acknowledged {
                let acknowledged = written.acknowledged;
                lost.push(format!(
                    "replay-{replay} has acknowledged {acknowledged} segments of writer {writer:016x} and holds {durable}"
                ));
            }
        }
        pages.violations.extend(lost);
    }

    fn pages(&self) -> MutexGuard<'_, Pages> {
        self.pages.lock().unwrap()
    }
}
