//! The store itself: [`Store`], a durable log, the ring that is sampled from, and the gate between them.
//!
//! A segment is appended in four steps: it is checked; it becomes durable in the log; it enters the ring; the
//! limiter counts it. Only then does [`Store::append`] return, which is the acknowledgement. Sampling takes the
//! limiter's leave, then reads the ring. Neither holds up the other but for the moment of a copy.

use crate::config::ReplayConfig;
use crate::error::StoreError;
use crate::gate::{Gate, Peer};
use crate::gather::{gather, gather_segments};
use crate::limiter::Limiter;
use crate::log::{self, Log, State, Watermark};
use crate::metrics::ReplayMetrics;
use crate::minibatch::{
    Item, MAX_N_STEP, Minibatch, MinibatchColumn, OptionsError, ReplayCounters, SampleOptions, SampledSegment,
};
use crate::ring::{Drawn, Ring};
use crate::sampler::Sampler;
use crate::undrawn::{Followed, Undrawn};
use getup_proto::{MAX_MESSAGE_BYTES, RunSpec, Segment, SegmentTrace, TraceContext, columns, v1};
use getup_telemetry::traces::{KeyValue, SpanKind};
use getup_telemetry::{Shutdown, Traces, Waits};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

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
        metrics.inserted_env_steps.inc_by(state.env_steps);
        metrics.inserted_transitions.inc_by(state.transitions);
        metrics.episodes.inc_by(state.episodes);
        metrics.sampled.inc_by(sampled);
        metrics.capacity.set(config.capacity as i64);
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

    /// Whether minibatches of this kind can be sampled from this store.
    ///
    /// # Errors
    /// [`OptionsError`] with the first option that is out of range.
    pub fn check_options(&self, options: &SampleOptions) -> Result<(), OptionsError> {
        let &SampleOptions { batch, n_step, gamma, .. } = options;
        // At most two rows of every column, or the longest segment's, and a few numbers.
        let widths: usize = self.spec.columns.iter().map(|column| column.width).sum();
        let rows = if options.segments { self.spec.max_segment_steps + 1 } else { 2 };
        let max = MAX_MESSAGE_BYTES / 2 / ((rows * widths + 2) * columns::VALUE_BYTES);
        if !(1..=max).contains(&batch) {
            return Err(OptionsError::Batch { batch, max });
        }
        let most =
            self.max_times_sampled.map_or(usize::MAX, |times| self.capacity.saturating_mul(times as usize));
        if batch > most {
            return Err(OptionsError::Batch { batch, max: most });
        }
        let error_buffer = self.gate.limiter().largest_sample();
        if batch as f64 > error_buffer {
            return Err(OptionsError::Buffer { batch, error_buffer });
        }
        if !(1..=MAX_N_STEP).contains(&n_step) {
            return Err(OptionsError::NStep(n_step));
        }
        if !(0.0..=1.0).contains(&gamma) {
            return Err(OptionsError::Gamma(gamma));
        }
        Ok(())
    }

    /// A minibatch, if the limiter lets one out now.
    ///
    /// # Errors
    /// [`StoreError::Io`] if the sample cannot be counted.
    pub fn try_sample(
        &self,
        sampler: &mut Sampler,
        options: &SampleOptions,
    ) -> Result<Option<Minibatch>, StoreError> {
        let started = Instant::now();
        let began = self.traces.is_on().then(SystemTime::now);
        let mut sampled = 0;
        let count = |total| {
            sampled = total;
            self.watermark.set_sampled(total)
        };
        let (found, items, followed, state, held) = if self.selects {
            let mut memory = self.memory.write().unwrap_or_else(PoisonError::into_inner);
            if !self.gate.try_sample(options.batch as u64, count)? {
                return Ok(None);
            }
            let drawn = sampler.draw(&mut memory.ring, options.batch);
            self.gate.set_available(memory.ring.available());
            let ring = &memory.ring;
            let item =
                |drawn: &Drawn| Item { key: ring.key(drawn.slot), probability: drawn.probability as f32 };
            let items = drawn.iter().map(item).collect();
            (found(ring, &drawn, options), items, self.followed(ring, &drawn), memory.state, ring.len())
        } else {
            if !self.gate.try_sample(options.batch as u64, count)? {
                return Ok(None);
            }
            let memory = self.memory();
            let drawn = sampler.draw_uniformly(&memory.ring, options.batch);
            let found = found(&memory.ring, &drawn, options);
            (found, Vec::new(), self.followed(&memory.ring, &drawn), memory.state, memory.ring.len())
        };
        let counters = self.counters_of(state, sampled, held);
        self.metrics.sampled.inc_by(options.batch as u64);
        self.metrics.sample_seconds.observe(started.elapsed().as_secs_f64());
        self.show_limiter();
        let (columns, segments) = found;
        let sampled = |followed: Followed| self.sampled(&followed, began, options.batch);
        let traces = followed.into_iter().map(sampled).collect();
        Ok(Some(Minibatch { columns, items, segments, counters, traces }))
    }

    /// Records what befell a segment that is followed up to now, when it has entered the ring as the newest.
    fn committed(&self, ring: &Ring, segment: &Segment, trace: SegmentTrace) {
        let now = SystemTime::now();
        let SegmentTrace { context, begun, since } = trace;
        self.traces.child(context, ("limiter", SpanKind::Internal), begun, since, Vec::new());
        let sequence = KeyValue::new("getup.sequence", segment.sequence as i64);
        self.traces.child(context, ("commit", SpanKind::Consumer), since, now, vec![sequence]);
        self.undrawn.insert(ring.numbers(), context, now);
    }

    /// The segments that are followed of which one of `drawn` is the first draw.
    fn followed(&self, ring: &Ring, drawn: &[Drawn]) -> Vec<Followed> {
        self.undrawn.take(drawn.iter().map(|drawn| ring.number_of(drawn.slot)))
    }

    /// Records that a segment that is followed is in a minibatch for the first time; returns where its trace goes on.
    fn sampled(&self, followed: &Followed, began: Option<SystemTime>, batch: usize) -> TraceContext {
        let &Followed { context, since, .. } = followed;
        let from = began.map_or(since, |began| began.max(since));
        let waited = from.duration_since(since).unwrap_or_default().as_secs_f64();
        let attributes =
            vec![KeyValue::new("getup.batch", batch as i64), KeyValue::new("getup.undrawn_seconds", waited)];
        self.traces.child(context, ("sample", SpanKind::Producer), from, SystemTime::now(), attributes)
    }

    /// Gives transitions priorities, by their keys; returns how many were there to get them. A priority of 0 is the
    /// least there is, and does not remove a transition.
    ///
    /// # Errors
    /// [`OptionsError::Priority`] with the first that is negative or not finite: then none is given.
    pub fn update_priorities(&self, priorities: &[(u64, f32)]) -> Result<u64, OptionsError> {
        if let Some(&(key, priority)) =
            priorities.iter().find(|(_, priority)| !(priority.is_finite() && *priority >= 0.0))
        {
            return Err(OptionsError::Priority { key, priority });
        }
        let mut memory = self.memory.write().unwrap_or_else(PoisonError::into_inner);
        let given = priorities.iter().filter(|&&(key, priority)| memory.ring.set_priority(key, priority));
        Ok(given.count() as u64)
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

/// Those of the segments that are followed are here now, whatever befell them in this process before.
fn arrived(segments: &mut [Segment]) {
    for trace in segments.iter_mut().filter_map(|segment| segment.trace.as_mut()) {
        **trace = SegmentTrace::arrived(trace.context);
    }
}

/// The columns of what was drawn; of whole segments also what they are.
fn found(
    ring: &Ring,
    drawn: &[Drawn],
    options: &SampleOptions,
) -> (Vec<MinibatchColumn>, Vec<SampledSegment>) {
    if options.segments {
        (gather_segments(ring, drawn), drawn.iter().map(|drawn| ring.segment_of(drawn.slot)).collect())
    } else {
        (gather(ring, drawn, options), Vec::new())
    }
}
