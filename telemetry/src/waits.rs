//! Every wait has a reason that logs, metrics and `getup status` can show: nothing hangs silently.
//!
//! Code that is about to wait calls [`Waits::begin`] and holds the guard meanwhile; where a wait goes on over several
//! attempts, it holds a [`Waiting`] instead. A wait is logged after 5 s, and again each time its length has doubled; the gauge `getup_wait_seconds{what}` shows how long the longest
//! wait of a kind has lasted, 0 where there is none.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::thread;
use std::time::{Duration, Instant};

use prometheus::core::{Collector, Desc};
use prometheus::proto::MetricFamily;
use prometheus::{GaugeVec, Opts, Registry};

/// A wait is logged first after this long, then with doubling intervals.
const FIRST_LOG: Duration = Duration::from_secs(5);
/// How often the waits are looked through for one to log.
const TICK: Duration = Duration::from_millis(500);
/// How often a reason that has to be found out is brought up to date.
const REFRESH: Duration = Duration::from_secs(1);

/// One wait that is under way.
#[derive(Clone, PartialEq, Debug)]
pub struct Wait {
    /// Who waits: `actor`, `sampler`.
    pub what: &'static str,
    /// For what, as a clause after "waits: ": `812 of 1,000 transitions`.
    pub reason: String,
    /// For how long already.
    pub seconds: f64,
}

impl fmt::Display for Wait {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} waits: {} (for {:.0} s)", self.what, self.reason, self.seconds)
    }
}

/// The waits of a process; clones share them.
#[derive(Clone, Debug)]
pub struct Waits {
    table: Arc<Mutex<Table>>,
    /// Of a part of the process, which sees its own alone.
    part: Option<u64>,
}

/// A wait that ends when this is dropped.
#[derive(Debug)]
#[must_use = "the wait ends when the guard is dropped"]
pub struct WaitGuard {
    waits: Waits,
    id: u64,
}

/// A wait that goes on over several attempts, and its reason at each of them. It ends at the first that succeeds, or when
/// this is dropped.
#[derive(Debug)]
pub struct Waiting {
    waits: Waits,
    what: &'static str,
    /// The wait under way, and when its reason is old.
    current: Option<(WaitGuard, Instant)>,
}

impl Waits {
    /// An empty table whose gauge is in `registry`, and a thread that logs long waits while the table lives.
    ///
    /// # Panics
    /// When `registry` has such a gauge already: a process has one table, and its roles share it.
    pub fn new(registry: &Registry) -> Self {
        let waits = Self { table: Arc::default(), part: None };
        let gauge = WaitGauge::new(&waits);
        registry.register(Box::new(gauge)).expect("a registry has one table of waits");
        let table = Arc::downgrade(&waits.table);
        thread::Builder::new()
            .name("waits".into())
            .spawn(move || log_long_waits(&table))
            .expect("the system can start a thread at start-up");
        waits
    }

    /// For one part of the process among several alike: its waits are the process's too, and it sees no others.
    pub fn part(&self) -> Self {
        Self { part: Some(self.table().new_id()), ..self.clone() }
    }

    /// Notes that `what` waits for `reason`, until the guard is dropped.
    pub fn begin(&self, what: &'static str, reason: String) -> WaitGuard {
        let id = self.table().begin(Instant::now(), self.part, what, reason);
        WaitGuard { waits: self.clone(), id }
    }

    /// For waits of `what` that go on over several attempts; none has begun.
    pub fn waiting(&self, what: &'static str) -> Waiting {
        Waiting { waits: self.clone(), what, current: None }
    }

    /// What is waited for now, the longest wait first.
    pub fn current(&self) -> Vec<Wait> {
        self.table().current(Instant::now(), self.part)
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        // A table is whole after every statement: a panic elsewhere does not spoil it.
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl WaitGuard {
    /// Replaces the reason; the wait goes on.
    pub fn set_reason(&self, reason: String) {
        if let Some(entry) = self.waits.table().entries.iter_mut().find(|entry| entry.id == self.id) {
            entry.reason = reason;
        }
    }
}

impl Waiting {
    /// An attempt failed for this reason: the wait begins, or goes on with it.
    pub fn because(&mut self, reason: String) {
        let old = Instant::now() + REFRESH;
        match &mut self.current {
            Some((guard, at)) => {
                guard.set_reason(reason);
                *at = old;
            }
            None => self.current = Some((self.waits.begin(self.what, reason), old)),
        }
    }

    /// The same for attempts that follow each other fast: the reason is asked for at the beginning, and once a second.
    pub fn because_with(&mut self, reason: impl FnOnce() -> String) {
        if self.current.as_ref().is_none_or(|(_, old)| Instant::now() >= *old) {
            self.because(reason());
        }
    }

    /// An attempt succeeded.
    pub fn over(&mut self) {
        self.current = None;
    }

    /// Whether a wait is under way.
    pub fn is_under_way(&self) -> bool {
        self.current.is_some()
    }
}

impl Drop for WaitGuard {
    fn drop(&mut self) {
        self.waits.table().end(self.id);
    }
}

/// The table itself, in terms of given instants.
#[derive(Debug, Default)]
struct Table {
    /// In the order of their beginnings.
    entries: Vec<Entry>,
    /// Everything that ever waited: its gauge stays, at 0.
    known: BTreeSet<&'static str>,
    last_id: u64,
}

#[derive(Debug)]
struct Entry {
    id: u64,
    part: Option<u64>,
    what: &'static str,
    reason: String,
    since: Instant,
    /// How long it has to last to be logged next.
    next_log: Duration,
}

impl Entry {
    fn wait(&self, now: Instant) -> Wait {
        let seconds = now.duration_since(self.since).as_secs_f64();
        Wait { what: self.what, reason: self.reason.clone(), seconds }
    }
}

impl Table {
    fn new_id(&mut self) -> u64 {
        self.last_id += 1;
        self.last_id
    }

    fn begin(&mut self, now: Instant, part: Option<u64>, what: &'static str, reason: String) -> u64 {
        let id = self.new_id();
        self.known.insert(what);
        self.entries.push(Entry { id, part, what, reason, since: now, next_log: FIRST_LOG });
        id
    }

    fn end(&mut self, id: u64) {
        self.entries.retain(|entry| entry.id != id);
    }

    /// Of one part, or of all.
    fn current(&self, now: Instant, part: Option<u64>) -> Vec<Wait> {
        let asked = self.entries.iter().filter(|entry| part.is_none() || entry.part == part);
        asked.map(|entry| entry.wait(now)).collect()
    }

    /// The waits to log now, each of which is then due again at twice its length.
    fn due(&mut self, now: Instant) -> Vec<Wait> {
        let mut due = Vec::new();
        for entry in &mut self.entries {
            let lasted = now.duration_since(entry.since);
            if lasted >= entry.next_log {
                entry.next_log = 2 * lasted;
                due.push(entry.wait(now));
            }
        }
        due
    }
}

fn log_long_waits(table: &Weak<Mutex<Table>>) {
    loop {
        thread::sleep(TICK);
        let Some(table) = table.upgrade() else { return };
        // Not under the lock: whoever reads the log may be slow.
        let due = Waits { table, part: None }.table().due(Instant::now());
        for wait in due {
            tracing::info!(what = wait.what, seconds = wait.seconds, "{wait}");
        }
    }
}

/// Shows the table as it is when the metrics are asked for.
struct WaitGauge {
    table: Weak<Mutex<Table>>,
    seconds: GaugeVec,
}

impl WaitGauge {
    fn new(waits: &Waits) -> Self {
        let options = Opts::new("getup_wait_seconds", "How long this has waited; 0 while it does not.");
        let seconds = GaugeVec::new(options, &["what"]).expect("the name and label are well-formed");
        Self { table: Arc::downgrade(&waits.table), seconds }
    }
}

impl Collector for WaitGauge {
    fn desc(&self) -> Vec<&Desc> {
        self.seconds.desc()
    }

    fn collect(&self) -> Vec<MetricFamily> {
        if let Some(table) = self.table.upgrade() {
            let waits = Waits { table, part: None };
            for what in &waits.table().known {
                self.seconds.with_label_values(&[what]).set(0.0);
            }
            for wait in waits.current().iter().rev() {
                self.seconds.with_label_values(&[wait.what]).set(wait.seconds);
            }
        }
        self.seconds.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wait_is_logged_after_5_seconds_and_then_each_time_its_length_has_doubled() {
        let mut table = Table::default();
        let start = Instant::now();
        let id = table.begin(start, None, "actor", "no policy yet".into());
        let logged: Vec<u64> =
            (0..100).filter(|second| !table.due(start + Duration::from_secs(*second)).is_empty()).collect();
        assert_eq!(logged, [5, 10, 20, 40, 80]);
        table.end(id);
        assert!(table.due(start + Duration::from_secs(1000)).is_empty());
    }

    #[test]
    fn the_longest_wait_comes_first_and_a_new_reason_keeps_its_beginning() {
        let waits = Waits::new(&Registry::new());
        let first = waits.begin("actor", "no policy yet".into());
        let second = waits.begin("sampler", "812 of 1,000 transitions".into());
        first.set_reason("the learner is gone".into());
        let reasons: Vec<_> = waits.current().into_iter().map(|wait| wait.reason).collect();
        assert_eq!(reasons, ["the learner is gone", "812 of 1,000 transitions"]);
        drop(first);
        assert_eq!(waits.current()[0].what, "sampler");
        drop(second);
        assert!(waits.current().is_empty());
    }

    #[test]
    fn a_wait_over_several_attempts_is_one_wait_with_the_last_reason() {
        let waits = Waits::new(&Registry::new());
        let mut waiting = waits.waiting("actor_writer");
        assert!(waits.current().is_empty() && !waiting.is_under_way());
        waiting.because("replay refused the connection".into());
        thread::sleep(Duration::from_millis(20));
        waiting.because("replay has not acknowledged".into());
        let [wait] = &waits.current()[..] else { panic!("{:?}", waits.current()) };
        assert_eq!(wait.reason, "replay has not acknowledged");
        assert!(wait.seconds >= 0.02, "{wait}");
        waiting.because_with(|| unreachable!("the reason is not a second old"));
        assert!(waiting.is_under_way());
        waiting.over();
        assert!(waits.current().is_empty());
        waiting.because_with(|| "replay is full".into());
        assert_eq!(waits.current()[0].reason, "replay is full");
        drop(waiting);
        assert!(waits.current().is_empty());
    }

    #[test]
    fn a_part_sees_its_own_waits_and_the_process_sees_all() {
        let process = Waits::new(&Registry::new());
        let (first, second) = (process.part(), process.part());
        let _own = first.clone().begin("sampler", "812 of 1,000 transitions".into());
        let _whole = process.begin("learner", "no replay".into());
        assert_eq!((process.current().len(), first.current().len(), second.current().len()), (2, 1, 0));
        assert_eq!(first.current()[0].what, "sampler");
    }

    #[test]
    fn the_gauge_shows_the_longest_wait_of_a_kind_and_0_once_it_is_over() {
        let registry = Registry::new();
        let waits = Waits::new(&registry);
        let gauge = || registry.gather()[0].get_metric()[0].get_gauge().get_value();
        let long = waits.begin("actor", "no policy yet".into());
        thread::sleep(Duration::from_millis(20));
        let short = waits.begin("actor", "replay has not acknowledged".into());
        assert!(gauge() >= 0.02);
        drop(long);
        let shown = gauge();
        assert!(shown <= waits.current()[0].seconds, "{shown} s is not the short one's");
        drop(short);
        assert_eq!(gauge(), 0.0);
    }
}
