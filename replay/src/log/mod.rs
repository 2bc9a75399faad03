//! The durable log of segments, over sled: [`Log`].
//!
//! A commit is one sled batch in one tree, which is atomic when the process is killed: the segments' pieces, the
//! marks of their writers, and the totals. Then comes a flush, then the [watermark], and only then the
//! acknowledgement.
//!
//! Trees are *generations*: each takes a sixteenth of the capacity, and when the others hold the capacity, the
//! oldest is dropped whole, which costs sled little and gives the disk space back for new ones. The first commit
//! of a generation repeats all marks, so nothing is lost with those that were dropped.
//!
//! At start-up everything is read back and checked, against its checksums and against the watermark.
//!
//! - [`record`]: keys and values
//! - [`writers`]: what makes appends idempotent
//! - [`manifest`], [`watermark`]: two small files beside sled's
//! - [`panics`]: sled's way to report damage
//! - [`recovery`]: reading it all back

mod manifest;
mod panics;
mod record;
mod recovery;
mod watermark;
mod writers;

pub(crate) use record::State;
pub(crate) use watermark::Watermark;

use crate::config::{ReplayConfig, SyncMode};
use crate::error::StoreError;
use getup_proto::{RunSpec, Segment};
use manifest::Manifest;
use panics::caught;
use record::Key;
use recovery::Recovered;
use std::collections::VecDeque;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use writers::Writers;

/// Generations that make up the capacity.
const GENERATIONS: u64 = 16;
/// sled's page cache. The log is read at start-up alone, so that it only has to hold what is being written.
const CACHE_BYTES: u64 = 32 << 20;
/// How often sled moves records out of sparsely filled parts of its file, so that these can be used again.
const CLEAN_EVERY: Duration = Duration::from_millis(500);
/// How long to wait for the lock of a store that was just closed in this process.
const LOCK_PATIENCE: Duration = Duration::from_secs(5);
/// Begins the name of a generation's tree; its number follows, in 16 hexadecimal digits.
const TREE_PREFIX: &str = "generation-";
/// sled's folder in the store's.
const SLED: &str = "log";

/// The durable log of a store. One thread at a time appends.
#[derive(Debug)]
pub(crate) struct Log {
    dir: PathBuf,
    store: u64,
    capacity: u64,
    /// sled's data file, to be synced before acknowledging; None where the kernel's word is enough.
    fsync: Option<File>,
    /// Oldest first; the last takes the commits.
    generations: VecDeque<Generation>,
    /// The last generation takes no more commits.
    full: bool,
    state: State,
    writers: Writers,
    /// Why there are no more commits.
    failed: Option<String>,
    db: sled::Db,
    /// Shared with those who count samples.
    watermark: Arc<Watermark>,
    /// Holds the store for this process; released after sled.
    _lock: File,
}

/// One tree of the log.
#[derive(Clone, Copy, Debug)]
struct Generation {
    number: u64,
    /// Number in the log of its first segment.
    first_segment: u64,
    transitions: u64,
}

impl Log {
    /// Opens the store in `dir`, or creates it. Its segments are passed to `replay`, oldest first; the newest
    /// `config.capacity` transitions are among them, and perhaps some before.
    pub(crate) fn open(
        dir: &Path,
        spec: &RunSpec,
        config: &ReplayConfig,
        replay: impl FnMut(&Segment),
    ) -> Result<Self, StoreError> {
        fs::create_dir_all(dir).map_err(StoreError::io("create", dir))?;
        let lock = lock(dir)?;
        let (manifest, watermark) = match Manifest::read(dir, spec)? {
            Some(manifest) => (manifest, Watermark::open(dir)?),
            None => create(dir, spec)?,
        };
        let acknowledged = watermark.acknowledged()?;
        let opened = caught(|| Recovered::read(dir, spec, acknowledged, replay));
        let (db, recovered) = opened
            .map_err(|panic| StoreError::damaged(dir, format!("its log is inconsistent ({panic})")))??;
        let fsync = match config.sync {
            SyncMode::Process => None,
            SyncMode::Data => {
                let path = dir.join(SLED).join("db");
                Some(File::open(&path).map_err(StoreError::io("open", path))?)
            }
        };
        let mut log = Self {
            dir: dir.to_owned(),
            store: manifest.store,
            capacity: config.capacity as u64,
            fsync,
            generations: recovered.generations,
            full: true,
            state: recovered.state,
            writers: recovered.writers,
            failed: None,
            db,
            watermark: Arc::new(watermark),
            _lock: lock,
        };
        log.full = log.generations.back().is_none_or(|newest| log.is_full(newest));
        log.watermark.set_acknowledged(log.state.segments)?;
        Ok(log)
    }

    /// Appends the segments that were not stored before, in order, and returns these once they are durable.
    ///
    /// After an error the log takes no more segments: what it holds is seen when it is opened again.
    pub(crate) fn append(&mut self, segments: Vec<Segment>) -> Result<Vec<Segment>, StoreError> {
        if let Some(reason) = &self.failed {
            return Err(StoreError::Failed(reason.clone()));
        }
        let before = self.state.segments;
        let mut fresh = segments;
        let mut number = before;
        fresh.retain(|segment| {
            let new = self.writers.advance(segment.writer, segment.sequence, number);
            number += u64::from(new);
            new
        });
        if !fresh.is_empty() {
            self.guarded(|log| log.commit(&fresh))?;
        }
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

    /// Runs what writes; an error or a panic of sled's ends all writing.
    fn guarded(&mut self, work: impl FnOnce(&mut Self) -> Result<(), StoreError>) -> Result<(), StoreError> {
        let result = caught(|| work(self))
            .unwrap_or_else(|panic| Err(StoreError::damaged(&self.dir, format!("its log broke ({panic})"))));
        if let Err(error) = &result {
            self.failed = Some(error.to_string());
        }
        result
    }

    fn commit(&mut self, segments: &[Segment]) -> Result<(), StoreError> {
        let mut batch = sled::Batch::default();
        if self.full {
            self.begin_generation(&mut batch);
        }
        let mut state = self.state;
        for segment in segments {
            record::put_segment(&mut batch, state.segments, segment);
            state.add(segment);
        }
        for segment in segments {
            let mark = self.writers.get(segment.writer).expect("its mark was just advanced");
            record::put(&mut batch, Key::Writer(segment.writer), &mark.encode());
        }
        let newest = self.generations.back_mut().expect("the first commit begins one");
        newest.transitions += state.transitions - self.state.transitions;
        let excess = self.excess();
        state.oldest = self.generations[excess].first_segment;
        record::put(&mut batch, Key::State, &state.encode());
        self.write(batch)?;
        self.watermark.set_acknowledged(state.segments)?;

        self.state = state;
        self.full = self.generations.back().is_some_and(|newest| self.is_full(newest));
        for generation in self.generations.drain(..excess) {
            self.db.drop_tree(generation.tree_name()).map_err(StoreError::sled(&self.dir))?;
        }
        Ok(())
    }

    /// Makes the batch durable in the newest generation.
    fn write(&self, batch: sled::Batch) -> Result<(), StoreError> {
        let newest = self.generations.back().expect("the first commit begins one");
        let tree = self.db.open_tree(newest.tree_name()).map_err(StoreError::sled(&self.dir))?;
        tree.apply_batch(batch).map_err(StoreError::sled(&self.dir))?;
        self.db.flush().map_err(StoreError::sled(&self.dir))?;
        match &self.fsync {
            Some(file) => file.sync_data().map_err(StoreError::io("sync", &self.dir)),
            None => Ok(()),
        }
    }

    fn begin_generation(&mut self, batch: &mut sled::Batch) {
        let number = self.generations.back().map_or(0, |newest| newest.number + 1);
        let first_segment = self.state.segments;
        self.generations.push_back(Generation { number, first_segment, transitions: 0 });
        self.writers.forget_excess();
        for (writer, mark) in self.writers.iter() {
            record::put(batch, Key::Writer(writer), &mark.encode());
        }
    }

    fn is_full(&self, generation: &Generation) -> bool {
        generation.transitions >= self.capacity.div_ceil(GENERATIONS)
    }

    /// How many of the oldest generations can go, as the others hold the capacity.
    fn excess(&self) -> usize {
        let mut held: u64 = self.generations.iter().map(|generation| generation.transitions).sum();
        let fits = |generation: &&Generation| {
            held -= generation.transitions;
            held >= self.capacity
        };
        self.generations.iter().take_while(fits).count()
    }
}

impl Generation {
    fn tree_name(&self) -> String {
        format!("{TREE_PREFIX}{:016x}", self.number)
    }
}

/// Bytes that the store in `dir` takes on disk.
pub(crate) fn disk_bytes(dir: &Path) -> u64 {
    use std::os::unix::fs::MetadataExt;
    // sled removes files while we look: one that is gone takes no space.
    let Ok(entries) = fs::read_dir(dir) else { return 0 };
    let of = |entry: fs::DirEntry| match entry.metadata() {
        Ok(metadata) if metadata.is_dir() => disk_bytes(&entry.path()),
        Ok(metadata) => metadata.blocks() * 512,
        Err(_) => 0,
    };
    entries.flatten().map(of).sum()
}

fn lock(dir: &Path) -> Result<File, StoreError> {
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
    if dir.join(SLED).exists() {
        return Err(StoreError::damaged(dir, "it has a log but no store.json"));
    }
    let watermark = Watermark::create(dir)?;
    let manifest = Manifest::new(spec);
    manifest.write(dir)?;
    Ok((manifest, watermark))
}

fn open_sled(dir: &Path) -> Result<sled::Db, StoreError> {
    let config = sled::Config::new()
        .path(dir.join(SLED))
        .cache_capacity(CACHE_BYTES)
        .flush_every_ms(Some(CLEAN_EVERY.as_millis() as u64));
    let give_up = Instant::now() + LOCK_PATIENCE;
    loop {
        match config.open() {
            // A store that this process closed keeps sled's lock until sled's threads have let go of it.
            Err(sled::Error::Io(error)) if error.to_string().contains("lock") && Instant::now() < give_up => {
                thread::sleep(Duration::from_millis(20));
            }
            result => return result.map_err(StoreError::sled(dir)),
        }
    }
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
