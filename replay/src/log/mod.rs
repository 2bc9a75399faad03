//! The durable log of segments: [`Log`].
//!
//! Segments lie in [files] of at most a sixteenth of what is kept (the capacity, or a window of some capacities: see
//! [`Remover`](crate::Remover)), one record after another. A commit is one write at
//! the end of the newest file: when it returns, the kernel has it, and a process that is killed loses nothing. Then
//! comes the [watermark], and only then the acknowledgement. When the other files hold what is to be kept the oldest is
//! deleted, which gives its space back at once; what only it knew (its writers' marks) goes into the [index]
//! before.
//!
//! At start-up everything is read back and checked, against its checksums, against the totals that each file begins
//! with, and against the watermark.
//!
//! - [`record`]: what a file is made of
//! - [`files`]: where they lie, how they are written and dropped
//! - [`index`]: what they no longer say, in sled
//! - [`writers`]: what makes appends idempotent
//! - [`manifest`], [`watermark`]: two small files beside them
//! - [`panics`]: sled's way to report damage
//! - [`recovery`]: reading it all back
//! - [`snapshot`]: a copy while it is written
//! - [`survey`]: what a store holds, damaged or in use as it may be
//! - [`rewrite`]: a store from what is whole of another

pub(crate) mod files;
mod index;
mod manifest;
mod panics;
pub(crate) mod record;
mod recovery;
mod rewrite;
mod snapshot;
mod survey;
mod watermark;
mod writers;

pub(crate) use record::State;
pub use rewrite::{Rewritten, compact, repair};
pub(crate) use snapshot::FOLDER as SNAPSHOTS;
pub use survey::{Ever, Survey, WriterMark, segments};
pub(crate) use watermark::Watermark;

use crate::config::{ReplayConfig, SyncMode};
use crate::error::StoreError;
use files::Tail;
use getup_proto::{RunSpec, Segment};
use index::{Content, Index};
use manifest::Manifest;
use record::Mark;
use recovery::Recovered;
use std::collections::VecDeque;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};
use writers::Writers;

/// What a log consists of, in its store's folder.
const FOLDERS: [&str; 3] = [files::FOLDER, index::FOLDER, watermark::FILE];
/// Files that make up what is kept, at least.
const FILES: u64 = 16;
/// How long to ask for the lock of a store that is held.
const LOCK_PATIENCE: Duration = Duration::from_secs(1);
/// How long the oldest file stays where the index could not be written.
const EVICT_AGAIN: Duration = Duration::from_secs(5);

/// The durable log of a store. One thread at a time appends.
#[derive(Debug)]
pub(crate) struct Log {
    dir: PathBuf,
    store: u64,
    /// Transitions that are kept; a few more are there.
    kept: u64,
    sync: SyncMode,
    /// Oldest first; the last one is the tail's, where there is one.
    files: VecDeque<Held>,
    /// None before the first commit, and where the newest file is full.
    tail: Option<Tail>,
    state: State,
    writers: Writers,
    index: Index,
    /// Segments whose writers' marks the index has, where these have not come since.
    indexed: u64,
    /// No eviction before.
    evict_at: Instant,
    /// Why there are no more commits.
    failed: Option<String>,
    /// Of the commit that is being put together.
    records: Vec<u8>,
    /// Shared with those who count samples.
    watermark: Arc<Watermark>,
    /// Holds the store for this process; released after sled.
    _lock: File,
}

/// A file of the log.
#[derive(Clone, Copy, Debug)]
struct Held {
    /// Number in the log of its first segment.
    first: u64,
    transitions: u64,
}

impl Log {
    /// Opens the store in `dir`, or creates it. Its segments are passed to `replay`, oldest first; the newest
    /// transitions that it keeps are among them, and perhaps some before.
    pub(crate) fn open(
        dir: &Path,
        spec: &RunSpec,
        config: &ReplayConfig,
        replay: impl FnMut(&Segment),
    ) -> Result<Self, StoreError> {
        fs::create_dir_all(dir).map_err(StoreError::io("create", dir))?;
        let lock = lock(dir)?;
        rewrite::finish(dir)?;
        let (manifest, watermark) = match Manifest::read(dir, spec)? {
            Some(manifest) => {
                rewrite::remove_unfinished(dir)?;
                snapshot::remove_unfinished(dir)?;
                (manifest, Watermark::open(dir)?)
            }
            None => create(dir, spec)?,
        };
        for folder in [files::FOLDER, index::FOLDER] {
            if !dir.join(folder).is_dir() {
                return Err(StoreError::damaged(dir, format!("its folder `{folder}` is missing")));
            }
        }
        let (index, content) = Index::open(dir, config.sync)?;
        let recovered = Recovered::read(dir, spec, watermark.acknowledged()?, content, replay)?;
        let Recovered { files, state, writers, end } = recovered;
        let mut log = Self {
            dir: dir.to_owned(),
            store: manifest.store,
            kept: config.kept(),
            sync: config.sync,
            files,
            tail: None,
            state,
            writers,
            index,
            indexed: state.oldest,
            evict_at: Instant::now(),
            failed: None,
            records: Vec::new(),
            watermark: Arc::new(watermark),
            _lock: lock,
        };
        if let Some(newest) = log.files.back() {
            log.tail = Some(Tail::open(dir, newest.first, end)?);
        }
        if config.sync == SyncMode::Data {
            // What was read back counts as acknowledged from here on, and whoever wrote it may not have synced it.
            files::sync(dir)?;
        }
        log.watermark.set_acknowledged(state.segments)?;
        Ok(log)
    }

    /// A log that goes on behind the totals `state` and knows these marks, in a folder that does not exist.
    fn begin(
        dir: &Path,
        spec: &RunSpec,
        config: &ReplayConfig,
        state: State,
        marks: Vec<(u64, Mark)>,
    ) -> Result<Self, StoreError> {
        let mut log = Self::open(dir, spec, config, |_| {})?;
        log.state = State { oldest: state.segments, ..state };
        log.indexed = state.segments;
        for &(writer, mark) in &marks {
            log.writers.restore(writer, mark);
        }
        log.index.write(&Content { oldest: state.segments, marks }, &[])?;
        // A file of its own keeps the totals where no segment follows.
        log.tail = Some(Tail::create(dir, log.state, config.sync)?);
        log.files.push_back(Held { first: state.segments, transitions: 0 });
        log.watermark.set_acknowledged(state.segments)?;
        Ok(log)
    }

    /// Appends those of the segments that were not stored before, in order. When this returns they are durable;
    /// it says of each whether it was new.
    ///
    /// After [`StoreError::Full`] the log is as it was. After any other error it takes no more segments: what it
    /// holds is seen when it is opened again.
    pub(crate) fn append(&mut self, segments: &[Segment]) -> Result<Vec<bool>, StoreError> {
        if let Some(reason) = &self.failed {
            return Err(StoreError::Failed(reason.clone()));
        }
        let mut state = self.state;
        let mut writers = self.writers.pending();
        self.records.clear();
        let fresh: Vec<bool> = segments
            .iter()
            .map(|segment| {
                let new = writers.advance(segment.writer, segment.sequence, state.segments);
                if new {
                    record::put_segment(&mut self.records, state.segments, segment);
                    state.add(segment);
                }
                new
            })
            .collect();
        let moved = writers.moved();
        if self.records.is_empty() {
            return Ok(fresh);
        }
        if let Err(error) = self.commit(state) {
            if matches!(error, StoreError::Full { .. }) {
                // The index may have had no room either, and now has.
                self.evict();
            } else {
                self.failed = Some(error.to_string());
            }
            return Err(error);
        }
        self.writers.accept(moved);
        self.evict();
        Ok(fresh)
    }

    /// The greatest sequence number of the writer that is durable; 0 if none is.
    pub(crate) fn durable(&self, writer: u64) -> u64 {
        self.writers.durable(writer)
    }

    /// Totals over the store's life.
    pub(crate) fn state(&self) -> State {
        self.state
    }

    /// The store's name.
    pub(crate) fn store(&self) -> u64 {
        self.store
    }

    /// The file that counts samples.
    pub(crate) fn watermark(&self) -> &Arc<Watermark> {
        &self.watermark
    }

    /// Makes the records durable; `state` counts them too.
    fn commit(&mut self, state: State) -> Result<(), StoreError> {
        let tail = match &mut self.tail {
            Some(tail) => tail,
            None => {
                let tail = Tail::create(&self.dir, self.state, self.sync)?;
                self.files.push_back(Held { first: self.state.segments, transitions: 0 });
                self.tail.insert(tail)
            }
        };
        tail.commit(&self.records, self.sync)?;
        self.watermark.set_acknowledged(state.segments)?;
        let newest = self.files.back_mut().expect("the tail is one of them");
        newest.transitions += state.transitions - self.state.transitions;
        if newest.transitions >= self.kept.div_ceil(FILES) || tail.bytes() >= files::FULL_BYTES {
            self.tail = None;
        }
        self.state = state;
        Ok(())
    }

    /// Drops the oldest files while the others hold what is to be kept. An index that cannot be written leaves them
    /// for a while: nothing is lost by that but space.
    fn evict(&mut self) {
        let excess = self.excess();
        if excess == 0 || Instant::now() < self.evict_at {
            return;
        }
        if let Err(error) = self.drop_files(excess) {
            tracing::warn!("the oldest segments stay for now: {error}");
            self.evict_at = Instant::now() + EVICT_AGAIN;
        }
    }

    fn drop_files(&mut self, excess: usize) -> Result<(), StoreError> {
        let oldest = self.files[excess].first;
        let forgotten = self.writers.forget_excess();
        // Marks that have not moved since are in the index already.
        let moved = self.writers.iter().filter(|(_, mark)| mark.segment >= self.indexed);
        self.index.write(&Content { oldest, marks: moved.collect() }, &forgotten)?;
        (self.state.oldest, self.indexed) = (oldest, self.state.segments);
        for _ in 0..excess {
            // One that stays is counted, and tried again.
            files::remove(&self.dir, self.files[0].first)?;
            self.files.pop_front();
        }
        Ok(())
    }

    /// Transitions in the log's files.
    pub(crate) fn held(&self) -> u64 {
        self.files.iter().map(|file| file.transitions).sum()
    }

    /// How many of the oldest files can go.
    fn excess(&self) -> usize {
        let mut held = self.held();
        let fits = |file: &&Held| {
            held -= file.transitions;
            held >= self.kept
        };
        self.files.iter().take_while(fits).count()
    }
}

/// Bytes that the log of the store in `dir` takes on disk. Snapshots, which share most of them, do not count.
pub(crate) fn disk_bytes(dir: &Path) -> u64 {
    FOLDERS.iter().map(|name| bytes_in(&dir.join(name))).sum()
}

fn bytes_in(path: &Path) -> u64 {
    use std::os::unix::fs::MetadataExt;
    // Files are removed while we look: one that is gone takes no space.
    let Ok(metadata) = fs::metadata(path) else { return 0 };
    if !metadata.is_dir() {
        return metadata.blocks() * 512;
    }
    let Ok(entries) = fs::read_dir(path) else { return 0 };
    entries.flatten().map(|entry| bytes_in(&entry.path())).sum()
}

/// Locks the store for this process. One that is held is asked for again for a moment: whoever inspects a store holds it
/// briefly, and so does a process that was just forked, until it becomes another program.
fn lock(dir: &Path) -> Result<File, StoreError> {
    let give_up = Instant::now() + LOCK_PATIENCE;
    loop {
        match try_lock(dir) {
            Err(StoreError::InUse { .. }) if Instant::now() < give_up => thread::sleep(LOCK_PATIENCE / 50),
            result => return result,
        }
    }
}

fn try_lock(dir: &Path) -> Result<File, StoreError> {
    let path = dir.join("lock");
    let file = File::create(&path).map_err(StoreError::io("create", &path))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(fs::TryLockError::WouldBlock) => Err(StoreError::InUse { dir: dir.to_owned() }),
        Err(fs::TryLockError::Error(error)) => Err(StoreError::io("lock", path)(error)),
    }
}

/// The files of a new store. The manifest comes last: with it, the store is there.
fn create(dir: &Path, spec: &RunSpec) -> Result<(Manifest, Watermark), StoreError> {
    let folder = dir.join(files::FOLDER);
    if folder.is_dir() && !files::list(dir)?.is_empty() {
        return Err(StoreError::manifest(dir, "it has segments but no store.json"));
    }
    for folder in [folder, dir.join(index::FOLDER)] {
        fs::create_dir_all(&folder).map_err(StoreError::io("create", folder))?;
    }
    let watermark = Watermark::create(dir, 0, 0)?;
    let manifest = Manifest::new(spec);
    manifest.write(dir)?;
    Ok((manifest, watermark))
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
