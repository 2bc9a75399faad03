//! A copy of a store that is being written: [`Snapshot`].
//!
//! All files but the newest never change again, so the copy shares them (hard links). Of the newest what is committed
//! never changes either, but more may follow, here and in the copy: it is copied, and only links and marks are taken while
//! appends wait.

use super::files;
use super::index::{Content, Index};
use super::manifest::Manifest;
use super::record::Mark;
use super::watermark::Watermark;
use super::{Log, State};
use crate::config::SyncMode;
use crate::error::StoreError;
use getup_proto::RunSpec;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

/// The snapshots' folder in the store's.
pub(crate) const FOLDER: &str = "snapshots";
/// Ends the name of a snapshot that is put together.
const UNFINISHED: &str = ".unfinished";

/// A snapshot that has begun; [`Snapshot::finish`] when appends go on.
#[derive(Debug)]
pub(crate) struct Snapshot {
    /// Where it is put together, and where it goes then.
    unfinished: Unfinished,
    dir: PathBuf,
    /// The store's name: a learner that goes on with the copy has counted what is in it.
    store: u64,
    state: State,
    marks: Vec<(u64, Mark)>,
    sampled: u64,
    /// The newest file, and how many bytes of it count.
    newest: Option<(u64, File, u64)>,
}

impl Log {
    /// Takes what must be of one moment. `dir` must not exist, and lie on the store's file system.
    pub(crate) fn begin_snapshot(&self, dir: &Path) -> Result<Snapshot, StoreError> {
        if dir.exists() {
            return Err(StoreError::SnapshotExists { dir: dir.to_owned() });
        }
        let unfinished = Unfinished::create(dir)?;
        let full = self.files.len().saturating_sub(1);
        for file in self.files.iter().take(full) {
            let (from, to) = (files::path(&self.dir, file.first), files::path(&unfinished.0, file.first));
            fs::hard_link(&from, &to).map_err(StoreError::io("link", from))?;
        }
        let read = |newest: &super::Held| {
            let path = files::path(&self.dir, newest.first);
            // It stays readable when it is dropped.
            let opened = File::open(&path).and_then(|file| Ok((file.metadata()?.len(), file)));
            let (bytes, file) = opened.map_err(StoreError::io("open", path))?;
            Ok::<_, StoreError>((newest.first, file, bytes))
        };
        let newest = self.files.back().map(read).transpose()?;
        Ok(Snapshot {
            unfinished,
            dir: dir.to_owned(),
            store: self.store,
            state: self.state,
            marks: self.writers.iter().collect(),
            sampled: self.watermark.sampled()?,
            newest,
        })
    }
}

impl Snapshot {
    /// Transitions that were sampled before it.
    pub(crate) fn sampled(&self) -> u64 {
        self.sampled
    }

    /// Copies the rest, and gives the snapshot its name: it is there whole, or not at all.
    pub(crate) fn finish(self, spec: &RunSpec) -> Result<(), StoreError> {
        let Self { unfinished, dir, store, state, marks, sampled, newest } = self;
        let folder = &unfinished.0;
        if let Some((first, file, bytes)) = newest {
            let to = files::path(folder, first);
            let copy = || io::copy(&mut file.take(bytes), &mut File::create_new(&to)?);
            copy().map_err(StoreError::io("write", &to))?;
        }
        files::sync(folder)?;
        let (mut index, _) = Index::open(folder, SyncMode::Data)?;
        index.write(&Content { oldest: state.oldest, marks }, &[])?;
        drop(index);
        Watermark::create(folder, state.segments, sampled)?;
        Manifest { store, ..Manifest::new(spec) }.write(folder)?;
        fs::rename(folder, &dir).map_err(StoreError::io("move", &dir))?;
        files::sync_names(&dir.join(".."))
    }
}

/// The folder where a snapshot is put together. It is removed again unless it was renamed: its links would keep the space
/// of files that the store has dropped.
#[derive(Debug)]
struct Unfinished(PathBuf);

impl Unfinished {
    /// For the snapshot `dir`, beside it.
    fn create(dir: &Path) -> Result<Self, StoreError> {
        // No snapshot can be called so: a name that begins with a dot is refused.
        let name = dir.file_name().unwrap_or_default().to_string_lossy();
        let unfinished = Self(dir.with_file_name(format!(".{name}{UNFINISHED}")));
        files::remove_folder(&unfinished.0)?;
        let segments = unfinished.0.join(files::FOLDER);
        fs::create_dir_all(&segments).map_err(StoreError::io("create", &segments))?;
        Ok(unfinished)
    }
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// Removes what snapshots that were killed have left in the store `dir`, which must be locked.
pub(super) fn remove_unfinished(dir: &Path) -> Result<(), StoreError> {
    let folder = dir.join(FOLDER);
    let entries = match fs::read_dir(&folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        entries => entries.map_err(StoreError::io("read", &folder))?,
    };
    for entry in entries {
        let entry = entry.map_err(StoreError::io("read", &folder))?;
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if name.starts_with('.') && name.ends_with(UNFINISHED) {
            files::remove_folder(&entry.path())?;
        }
    }
    Ok(())
}
