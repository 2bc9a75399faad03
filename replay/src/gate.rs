//! Where writers and samplers wait for each other: [`Gate`], the rate limiter with its doors.
//!
//! A wait can be cancelled, and can say why it lasts: `812 of 1,000 transitions; actor-3 silent for 14 s`.

use crate::limiter::{Blocked, Limiter};
use getup_proto::Segment;
use getup_telemetry::{Shutdown, Waiting, Waits};
use std::collections::HashMap;
use std::fmt::Write;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::watch;

/// How often a wait looks whether it was cancelled.
pub(crate) const CANCEL_TICK: Duration = Duration::from_millis(50);
/// How often a wait's reason is brought up to date.
pub(crate) const REASON_TICK: Duration = Duration::from_secs(1);
/// A peer that was silent for this long is named in the reason.
const SILENCE: Duration = Duration::from_secs(3);
/// Peers that are remembered; beyond, the longest silent is forgotten.
const MOST_PEERS: usize = 4096;

/// The limiter, and everybody who waits at it.
#[derive(Debug)]
pub(crate) struct Gate {
    inner: Mutex<Inner>,
    /// For threads: the limiter has moved.
    moved: Condvar,
    /// The same for tasks.
    moved_tasks: watch::Sender<()>,
    /// Held by the task of a writer that waits for room. The others wait for this, in the order in which they came: else each
    /// step of the limiter would wake a thousand, for one of them to find room.
    turn: tokio::sync::Mutex<()>,
    waits: Waits,
}

#[derive(Debug)]
struct Inner {
    limiter: Limiter,
    writers: HashMap<u64, Peer>,
    samplers: HashMap<u64, Peer>,
}

/// Who is on the other side, and when it was last heard of.
#[derive(Clone, Debug)]
pub(crate) struct Peer {
    pub(crate) name: String,
    pub(crate) heard: Instant,
    /// Open streams.
    pub(crate) connections: usize,
    /// Of a writer: its greatest sequence number that is durable.
    pub(crate) durable: u64,
}

/// Room for an insert that is under way; given back when dropped.
#[derive(Debug)]
pub(crate) struct Permit {
    gate: Arc<Gate>,
    env_steps: u64,
}

impl Drop for Permit {
    fn drop(&mut self) {
        self.gate.lock().limiter.release(self.env_steps);
        self.gate.wake();
    }
}

impl Gate {
    pub(crate) fn new(limiter: Limiter, waits: Waits) -> Arc<Self> {
        let inner = Inner { limiter, writers: HashMap::new(), samplers: HashMap::new() };
        let (moved_tasks, _) = watch::channel(());
        Arc::new(Self {
            inner: Mutex::new(inner),
            moved: Condvar::new(),
            moved_tasks,
            turn: tokio::sync::Mutex::default(),
            waits,
        })
    }

    /// What the limiter says now.
    pub(crate) fn limiter(&self) -> Limiter {
        self.lock().limiter.clone()
    }

    /// Counts segments that are durable and can be sampled; `available` draws are left then.
    pub(crate) fn insert(&self, segments: &[&Segment], available: Option<u64>) {
        let mut inner = self.lock();
        inner.limiter.set_available(available);
        for segment in segments {
            inner.limiter.insert(u64::from(segment.env_steps));
            if let Some(peer) = inner.writers.get_mut(&segment.writer) {
                peer.heard = Instant::now();
                peer.durable = segment.sequence;
            }
        }
        drop(inner);
        self.wake();
    }

    /// Counts a sample, if it need not wait; the new total.
    pub(crate) fn try_sample(&self, batch: u64) -> Option<u64> {
        let mut inner = self.lock();
        if inner.limiter.blocks_sample(batch).is_some() {
            return None;
        }
        inner.limiter.sample(batch);
        let total = inner.limiter.samples();
        drop(inner);
        self.wake();
        Some(total)
    }

    /// A sample that was counted is not handed out after all.
    pub(crate) fn take_back(&self, batch: u64) {
        self.lock().limiter.take_back(batch);
        self.wake();
    }

    /// Notes how many draws are left.
    pub(crate) fn set_available(&self, available: Option<u64>) {
        self.lock().limiter.set_available(available);
    }

    /// For waits of a sampler, over several calls of [`Gate::wait_to_sample`].
    pub(crate) fn sampler_waiting(&self) -> Waiting {
        self.waits.waiting("sampler")
    }

    /// Waits until a sample of this size might be let through. False when `cancelled` or `patience` ends the wait.
    pub(crate) fn wait_to_sample(
        &self,
        batch: u64,
        patience: Duration,
        wait: &mut Waiting,
        cancelled: impl Fn() -> bool,
    ) -> bool {
        let started = Instant::now();
        let mut inner = self.lock();
        while let Some(blocked) = inner.limiter.blocks_sample(batch) {
            let left = patience.saturating_sub(started.elapsed());
            if left.is_zero() || cancelled() {
                return false;
            }
            self.sampler_waits(&mut inner, &blocked, batch, wait);
            let tick = left.min(CANCEL_TICK);
            inner = self.moved.wait_timeout(inner, tick).unwrap_or_else(PoisonError::into_inner).0;
        }
        true
    }

    /// The same, in a task that whoever shuts down drops.
    pub(crate) async fn wait_to_sample_task(&self, batch: u64, wait: &mut Waiting) {
        let mut moved = self.moved_tasks.subscribe();
        loop {
            {
                let mut inner = self.lock();
                let Some(blocked) = inner.limiter.blocks_sample(batch) else { return };
                self.sampler_waits(&mut inner, &blocked, batch, wait);
            }
            // The sender lives in `self`; a wait that times out only refreshes its reason.
            let _ = tokio::time::timeout(REASON_TICK, moved.changed()).await;
        }
    }

    fn sampler_waits(&self, inner: &mut Inner, blocked: &Blocked, batch: u64, wait: &mut Waiting) {
        if matches!(blocked, Blocked::Consumed { .. }) && inner.limiter.want(batch) {
            self.wake_tasks();
        }
        wait.because_with(|| inner.reason(blocked, &inner.writers));
    }

    /// Room for an insert, if it need not wait.
    pub(crate) fn try_admit(self: &Arc<Self>, env_steps: u64) -> Option<Permit> {
        self.lock().try_admit(env_steps).ok()?;
        Some(Permit { gate: self.clone(), env_steps })
    }

    /// Waits for room for an insert, on a thread. None when `shutdown` ends the wait.
    pub(crate) fn admit(self: &Arc<Self>, env_steps: u64, shutdown: &Shutdown) -> Option<Permit> {
        let mut wait = self.waits.waiting("writer");
        let mut inner = self.lock();
        while let Err(blocked) = inner.try_admit(env_steps) {
            if shutdown.is_triggered() {
                return None;
            }
            wait.because_with(|| inner.reason(&blocked, &inner.samplers));
            inner = self.moved.wait_timeout(inner, CANCEL_TICK).unwrap_or_else(PoisonError::into_inner).0;
        }
        drop(inner);
        Some(Permit { gate: self.clone(), env_steps })
    }

    /// Waits for room for an insert, in a task that whoever shuts down drops; in turn with others.
    pub(crate) async fn admit_task(self: &Arc<Self>, env_steps: u64) -> Permit {
        // Limp steps alone need no room.
        if env_steps == 0
            && let Some(permit) = self.try_admit(env_steps)
        {
            return permit;
        }
        let mut wait = self.waits.waiting("writer");
        let turn = self.turn.lock();
        tokio::pin!(turn);
        let _turn = loop {
            match tokio::time::timeout(REASON_TICK, &mut turn).await {
                Ok(turn) => break turn,
                Err(_) => wait.because_with(|| self.why_writers_wait(env_steps)),
            }
        };
        let mut moved = self.moved_tasks.subscribe();
        loop {
            {
                let mut inner = self.lock();
                match inner.try_admit(env_steps) {
                    Ok(()) => return Permit { gate: self.clone(), env_steps },
                    Err(blocked) => {
                        wait.because_with(|| inner.reason(&blocked, &inner.samplers));
                    }
                }
            }
            // The sender lives in `self`; a wait that times out only refreshes its reason.
            let _ = tokio::time::timeout(REASON_TICK, moved.changed()).await;
        }
    }

    /// A writer has come, whose segments are durable up to this sequence number.
    pub(crate) fn writer_came(&self, writer: u64, name: &str, durable: u64) {
        came(&mut self.lock().writers, writer, name, durable);
    }

    /// A writer's segment has come.
    pub(crate) fn heard_writer(&self, writer: u64) {
        if let Some(peer) = self.lock().writers.get_mut(&writer) {
            peer.heard = Instant::now();
        }
    }

    /// A writer's stream has ended.
    pub(crate) fn writer_went(&self, writer: u64) {
        if let Some(peer) = self.lock().writers.get_mut(&writer) {
            peer.connections -= 1;
        }
    }

    /// A sampler has come.
    pub(crate) fn sampler_came(&self, sampler: u64, name: &str) {
        came(&mut self.lock().samplers, sampler, name, 0);
    }

    /// A sampler took a minibatch or asked for one.
    pub(crate) fn heard_sampler(&self, sampler: u64) {
        if let Some(peer) = self.lock().samplers.get_mut(&sampler) {
            peer.heard = Instant::now();
        }
    }

    /// A sampler has gone for good: a new one has another number.
    pub(crate) fn sampler_went(&self, sampler: u64) {
        self.lock().samplers.remove(&sampler);
    }

    /// The writers that are remembered.
    pub(crate) fn writers(&self) -> Vec<(u64, Peer)> {
        self.lock().writers.iter().map(|(&writer, peer)| (writer, peer.clone())).collect()
    }

    /// What the longest wait of this store waits for; empty where nobody waits.
    pub(crate) fn waiting(&self) -> String {
        self.waits.current().first().map_or_else(String::new, ToString::to_string)
    }

    fn why_writers_wait(&self, env_steps: u64) -> String {
        let inner = self.lock();
        let blocked = inner.limiter.blocks_insert(env_steps);
        blocked.map_or_else(|| "its turn".to_owned(), |blocked| inner.reason(&blocked, &inner.samplers))
    }

    fn wake(&self) {
        self.moved.notify_all();
        self.wake_tasks();
    }

    /// Those that are tasks; threads look for themselves, often enough.
    fn wake_tasks(&self) {
        self.moved_tasks.send_replace(());
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // Counters are whole after every statement: a panic elsewhere does not spoil them.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    fn try_admit(&mut self, env_steps: u64) -> Result<(), Blocked> {
        if let Some(blocked) = self.limiter.blocks_insert(env_steps) {
            return Err(blocked);
        }
        self.limiter.reserve(env_steps);
        Ok(())
    }

    /// Why somebody waits for `others`.
    fn reason(&self, blocked: &Blocked, others: &HashMap<u64, Peer>) -> String {
        let mut reason = blocked.to_string();
        // The one heard of last: if it is silent, all are.
        match others.values().max_by_key(|peer| peer.heard) {
            None => {
                let nobody =
                    if matches!(blocked, Blocked::InsertsAhead { .. }) { "sampler" } else { "writer" };
                let _ = write!(reason, "; no {nobody} has come");
            }
            Some(peer) if peer.heard.elapsed() >= SILENCE => {
                let _ = write!(reason, "; {} silent for {} s", peer.name, peer.heard.elapsed().as_secs());
            }
            Some(_) => {}
        }
        reason
    }
}

fn came(peers: &mut HashMap<u64, Peer>, id: u64, name: &str, durable: u64) {
    let connections = peers.get(&id).map_or(0, |peer| peer.connections) + 1;
    peers.insert(id, Peer { name: name.to_owned(), heard: Instant::now(), connections, durable });
    if peers.len() > MOST_PEERS {
        let silent =
            peers.iter().filter(|(_, peer)| peer.connections == 0).min_by_key(|(_, peer)| peer.heard);
        if let Some(id) = silent.map(|(&id, _)| id) {
            peers.remove(&id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ReplayConfig, fixtures};
    use getup_telemetry::Registry;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::task::{Context, Poll, Wake, Waker};

    /// How often a task was woken.
    #[derive(Default)]
    struct Woken(AtomicUsize);

    impl Wake for Woken {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// A gate with room for three inserts of 8 env steps, and for one more after each sample of 8.
    fn gate() -> Arc<Gate> {
        let (min_size, samples_per_insert, error_buffer) = (8, Some(1.0), Some(16.0));
        let config = ReplayConfig { min_size, samples_per_insert, error_buffer, ..ReplayConfig::default() };
        Gate::new(Limiter::new(&config, &fixtures::spec(8)), Waits::new(&Registry::new()))
    }

    #[tokio::test]
    async fn a_step_of_the_limiter_wakes_the_writer_whose_turn_it_is_alone_and_they_are_admitted_in_order() {
        let gate = gate();
        while let Some(permit) = gate.try_admit(8) {
            gate.lock().limiter.insert(8);
            drop(permit);
        }
        let wakers: Vec<Arc<Woken>> = (0..100).map(|_| Arc::default()).collect();
        let mut writers: Vec<_> = wakers.iter().map(|_| Box::pin(gate.admit_task(8))).collect();
        let mut poll = |index: usize| {
            let waker = Waker::from(Arc::clone(&wakers[index]));
            writers[index].as_mut().poll(&mut Context::from_waker(&waker))
        };
        assert!((0..100).all(|index| poll(index).is_pending()));
        let woken = || wakers.iter().map(|woken| woken.0.load(Ordering::Relaxed)).collect::<Vec<_>>();
        for admitted in 0..5 {
            assert!(gate.try_sample(8).is_some());
            // The next one has its turn as soon as the one before is through.
            let Poll::Ready(permit) = poll(admitted) else {
                panic!("{admitted} is not admitted: {:?}", woken())
            };
            gate.lock().limiter.insert(8);
            drop(permit);
            assert!(woken()[admitted + 2..].iter().all(|woken| *woken == 0), "{:?}", woken());
            assert!(poll(admitted + 1).is_pending(), "there is room for one");
        }
    }
}
