//! The store itself: [`Store`], a durable log, the ring that is sampled from, and the gate between them.
//!
//! A segment is appended in four steps: it is checked; it becomes durable in the log; it enters the ring; the
//! limiter counts it. Only then does [`Store::append`] return, which is the acknowledgement. Sampling takes the
//! limiter's leave, then reads the ring. Neither holds up the other but for the moment of a copy.

mod following;
mod sampling;

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use following::arrived;
use getup_proto::{RunSpec, Segment, v1};
use getup_telemetry::{Shutdown, Traces, Waits};

use crate::config::ReplayConfig;
use crate::error::StoreError;
use crate::gate::{Gate, Peer};
use crate::limiter::Limiter;
use crate::log::{self, Log, State, Watermark};
use crate::metrics::ReplayMetrics;
use crate::minibatch::ReplayCounters;
use crate::ring::Ring;
use crate::undrawn::Undrawn;

/// How often a full disk is tried again.
const FULL_TICK: Duration = Duration::from_millis(250);

/// A replay store. Threads share it in an [`Arc`].
#[derive(Debug)]
pub struct Store {
    dir: PathBuf,
    spec: RunSpec,
    /// Names the store.
    id: u64,
    capacity: usize,
    max_times_sampled: Option<u32>,
    /// Transitions that can be sampled at least, once it was full.
    held_at_least: usize,
    /// Whether draws change the ring.
    selects: bool,
    /// Locked by one append at a time, for as long as the disk takes.
    log: Mutex<Log>,
    /// Locked briefly.
    memory: RwLock<Memory>,
    /// Locked for as long as a snapshot takes.
    snapshots: Mutex<()>,
    gate: Arc<Gate>,
    watermark: Arc<Watermark>,
    metrics: ReplayMetrics,
    waits: Waits,
    traces: Traces,
    undrawn: Undrawn,
}

/// What sampling needs.
#[derive(Debug)]
struct Memory {
    ring: Ring,
    state: State,
}

impl Store {
    /// Opens the store in the folder `dir`, or creates it, and reads back what it holds.
    ///
    /// # Errors
    /// [`StoreError`], if the store is damaged, in use, of another run or of another format, or cannot be read.
    pub fn open(
        dir: &Path,
        spec: &RunSpec,
        config: &ReplayConfig,
        metrics: ReplayMetrics,
        waits: Waits,
    ) -> Result<Self, StoreError> {
        spec.validate()?;
        config.validate_for(spec)?;
        let started = Instant::now();
        // Other tables of the process wait for their own reasons.
        let waits = waits.part();
        let mut ring = Ring::new(spec, config);
        let log = Log::open(dir, spec, config, |segment| ring.push(segment))?;
        let (state, sampled) = (log.state(), log.watermark().sampled()?);
        ring.set_stored(state.transitions);
        let mut limiter = Limiter::new(config, spec);
        limiter.set_available(ring.available());
        limiter.restore(state.env_steps, sampled);
        if state.segments > 0 {
            tracing::info!(
                transitions = ring.len(),
                env_steps = state.env_steps,
                seconds = started.elapsed().as_secs_f64(),
                "replay goes on from {}",
                dir.display()
            );
        }
        metrics.begin_at(&state, sampled);
        metrics.transitions.set(ring.len() as i64);
        metrics.capacity.set(config.capacity as i64);
        metrics.log_transitions.set(log.held() as i64);
        metrics.log_capacity.set(config.kept() as i64);
        metrics.memory_bytes.set(ring.memory_bytes() as i64);
        metrics.disk.watch(dir);
        if let Some((_, min, max)) = limiter.band() {
            metrics.cursor_min.set(min);
            metrics.cursor_max.set(max);
        }
        let store = Self {
            dir: dir.to_owned(),
            spec: spec.clone(),
            id: log.store(),
            capacity: config.capacity,
            max_times_sampled: config.max_times_sampled,
            held_at_least: Ring::held_at_least(spec, config),
            selects: ring.selects(),
            watermark: log.watermark().clone(),
            log: Mutex::new(log),
            memory: RwLock::new(Memory { ring, state }),
            snapshots: Mutex::new(()),
            gate: Gate::new(limiter, waits.clone()),
            metrics,
            waits,
            traces: Traces::default(),
            undrawn: Undrawn::default(),
        };
        store.show_limiter();
        Ok(store)
    }

    /// Goes on with the traces of segments that are followed, and leads them to the minibatch that each is first in.
    pub fn followed_by(self, traces: Traces) -> Self {
        Self { traces, ..self }
    }

    /// The run's spec.
    pub fn spec(&self) -> &RunSpec {
        &self.spec
    }

    /// Whether a writer ever stored anything here.
    pub fn knows(&self, writer: u64) -> bool {
        self.log().durable(writer) > 0
    }

    /// Notes that a writer has come, under the name that logs and `status` show, and returns the greatest sequence
    /// number of it that is durable: it goes on from there. [`Store::farewell`] when it goes.
    pub fn introduce(&self, writer: u64, name: &str) -> u64 {
        let durable = self.log().durable(writer);
        self.gate.writer_came(writer, name, durable);
        self.metrics.writers.inc();
        durable
    }

    /// Notes that a writer that was introduced has gone.
    pub fn farewell(&self, writer: u64) {
        self.gate.writer_went(writer);
        self.metrics.writers.dec();
    }

    /// Whether the limiter lets so many env steps in now.
    pub fn can_insert(&self, env_steps: u64) -> bool {
        self.gate.limiter().blocks_insert(env_steps).is_none()
    }

    /// Whether the limiter lets a minibatch of so many transitions out now.
    pub fn can_sample(&self, batch: usize) -> bool {
        self.gate.limiter().blocks_sample(batch as u64).is_none()
    }

    /// Waits until the limiter lets the segments in, then appends them. Each must have room in the limiter's band
    /// by itself; they are appended one after another where they do not have it together.
    ///
    /// # Errors
    /// As [`Store::append`]. False if `shutdown` ended the wait: the rest was not appended.
    pub fn append_when_due(
        &self,
        mut segments: Vec<Segment>,
        shutdown: &Shutdown,
    ) -> Result<bool, StoreError> {
        let all: u64 = segments.iter().map(|segment| u64::from(segment.env_steps)).sum();
        self.check(&segments)?;
        arrived(&mut segments);
        if let Some(_permit) = self.gate.try_admit(all) {
            return self.append_when_there_is_room(&segments, shutdown);
        }
        for mut segment in segments {
            let Some(_permit) = self.gate.admit(u64::from(segment.env_steps), shutdown) else {
                return Ok(false);
            };
            if let Some(trace) = &mut segment.trace {
                trace.since = SystemTime::now();
            }
            if !self.append_when_there_is_room(&[segment], shutdown)? {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Appends segments without asking the limiter, in one group commit: when this returns they are durable and
    /// can be sampled. Those that were stored before are left out. If one is malformed, none is appended.
    ///
    /// # Errors
    /// [`StoreError::Segment`] if a segment does not follow the spec, [`StoreError::Full`] if the disk has no room:
    /// then nothing has changed. Any other error ends all appending: what is durable is known when the store is
    /// opened again.
    pub fn append(&self, mut segments: Vec<Segment>) -> Result<(), StoreError> {
        self.check(&segments)?;
        arrived(&mut segments);
        self.append_checked(&segments)
    }

    fn check(&self, segments: &[Segment]) -> Result<(), StoreError> {
        for segment in segments {
            if let Err(error) = segment.check(&self.spec) {
                self.metrics.reject(error.kind());
                return Err(error.into());
            }
        }
        Ok(())
    }

    /// As [`Store::append`], for segments that were checked; where the disk is full, waits until it has room.
    /// False if `shutdown` ended the wait: nothing was appended.
    pub(crate) fn append_when_there_is_room(
        &self,
        segments: &[Segment],
        shutdown: &Shutdown,
    ) -> Result<bool, StoreError> {
        let mut wait = None;
        loop {
            let full = match self.append_checked(segments) {
                Err(error @ StoreError::Full { .. }) => error,
                result => return result.map(|()| true),
            };
            if shutdown.is_triggered() {
                return Ok(false);
            }
            wait.get_or_insert_with(|| {
                tracing::warn!("{full}");
                self.waits.begin("replay", full.to_string())
            });
            thread::sleep(FULL_TICK);
        }
    }

    fn append_checked(&self, segments: &[Segment]) -> Result<(), StoreError> {
        let started = Instant::now();
        if segments.is_empty() {
            return Ok(());
        }
        let wait = self.waits.begin("replay", format!("the disk takes {} segments", segments.len()));
        let mut log = self.log();
        let new = log.append(segments)?;
        drop(wait);
        let fresh: Vec<&Segment> =
            segments.iter().zip(new).filter_map(|(segment, new)| new.then_some(segment)).collect();
        let state = log.state();
        self.metrics.log_transitions.set(log.held() as i64);
        {
            let mut memory = self.memory.write().unwrap_or_else(PoisonError::into_inner);
            for segment in &fresh {
                memory.ring.push(segment);
                if let Some(trace) = segment.trace.as_deref().filter(|_| self.traces.is_on()) {
                    self.committed(&memory.ring, segment, *trace);
                }
            }
            memory.state = state;
            self.metrics.transitions.set(memory.ring.len() as i64);
            // Told under the lock: a sampler that comes next must not see more than there is.
            self.gate.insert(&fresh, memory.ring.available());
        }
        let count = |of: fn(&Segment) -> u64| fresh.iter().copied().map(of).sum::<u64>();
        let env_steps = count(|segment| u64::from(segment.env_steps));
        self.metrics.inserted_env_steps.inc_by(env_steps);
        self.metrics.inserted_transitions.inc_by(count(|segment| segment.steps as u64));
        self.metrics.episodes.inc_by(count(|segment| u64::from(segment.end.is_some())));
        self.metrics.commit_segments.observe(fresh.len() as f64);
        self.metrics.append_seconds.observe(started.elapsed().as_secs_f64());
        self.show_limiter();
        Ok(())
    }

    /// Copies the store as it is now to the folder `to`, which must not exist and must lie on the same file system:
    /// a store in itself. Appends wait only while files are linked, sampling not at all; returns for how long they did,
    /// and the copy's totals.
    ///
    /// # Errors
    /// [`StoreError::Io`]; the store itself goes on.
    pub fn snapshot(&self, to: &Path) -> Result<(Duration, ReplayCounters), StoreError> {
        let _one_at_a_time = self.snapshots.lock().unwrap_or_else(PoisonError::into_inner);
        let log = self.log();
        let started = Instant::now();
        let snapshot = log.begin_snapshot(to);
        let (state, held) = (log.state(), self.len());
        drop(log);
        let paused = started.elapsed();
        let snapshot = snapshot?;
        let counters = self.counters_of(state, snapshot.sampled(), held);
        snapshot.finish(&self.spec)?;
        Ok((paused, counters))
    }

    /// Where the store lies.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Totals over the store's life.
    pub fn counters(&self) -> ReplayCounters {
        let (state, held) = {
            let memory = self.memory();
            (memory.state, memory.ring.len())
        };
        self.counters_of(state, self.gate.limiter().samples(), held)
    }

    /// Transitions that can be sampled now.
    pub fn len(&self) -> usize {
        self.memory().ring.len()
    }

    /// Whether there is nothing to sample.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The spec, sizes, counters, and the limiter's state.
    pub fn describe(&self) -> v1::DescribeReply {
        let limiter = self.gate.limiter();
        let (samples_per_insert, min_cursor, max_cursor) = limiter.band().unwrap_or_default();
        let writer = |(writer, peer): (u64, Peer)| v1::WriterState {
            name: peer.name,
            writer,
            durable_sequence: peer.durable,
            silent_seconds: peer.heard.elapsed().as_secs_f64(),
        };
        let writers = self.gate.writers().into_iter().map(writer).collect();
        v1::DescribeReply {
            spec: Some(self.spec.to_wire()),
            counters: Some(self.counters().into()),
            size: self.len() as u64,
            capacity: self.capacity as u64,
            memory_bytes: self.memory().ring.memory_bytes() as u64,
            disk_bytes: log::disk_bytes(&self.dir),
            limiter: Some(v1::LimiterState {
                min_size: limiter.min_size(),
                samples_per_insert,
                cursor: limiter.cursor(),
                min_cursor,
                max_cursor,
                waiting: self.gate.waiting(),
            }),
            writers,
            // Whoever serves it knows.
            tables: Vec::new(),
        }
    }

    pub(crate) fn gate(&self) -> &Arc<Gate> {
        &self.gate
    }

    pub(crate) fn metrics(&self) -> &ReplayMetrics {
        &self.metrics
    }

    fn counters_of(&self, state: State, sampled: u64, held: usize) -> ReplayCounters {
        let State { env_steps, transitions, episodes, .. } = state;
        ReplayCounters { store: self.id, env_steps, transitions, episodes, sampled, held: held as u64 }
    }

    fn show_limiter(&self) {
        self.metrics.cursor.set(self.gate.limiter().cursor());
    }

    fn log(&self) -> MutexGuard<'_, Log> {
        // A log that panicked refuses all further appends by itself.
        self.log.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn memory(&self) -> RwLockReadGuard<'_, Memory> {
        self.memory.read().unwrap_or_else(PoisonError::into_inner)
    }
}
