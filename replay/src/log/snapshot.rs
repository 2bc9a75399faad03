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

/// A snapshot that has begun; [`Snapshot::finish`] when appends go on.
#[derive(Debug)]
pub(crate) struct Snapshot {
    /// Where it is put together, and where it goes then.
    unfinished: PathBuf,
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
            let exists = io::Error::from(io::ErrorKind::AlreadyExists);
            return Err(StoreError::io("create", dir)(exists));
        }
        // No snapshot can be called so: a name that begins with a dot is refused.
        let name = dir.file_name().unwrap_or_default().to_string_lossy();
        let unfinished = dir.with_file_name(format!(".{name}.unfinished"));
        if unfinished.exists() {
            fs::remove_dir_all(&unfinished).map_err(StoreError::io("remove", &unfinished))?;
        }
        let segments = unfinished.join(files::FOLDER);
        fs::create_dir_all(&segments).map_err(StoreError::io("create", &segments))?;
        let full = self.files.len().saturating_sub(1);
        for file in self.files.iter().take(full) {
            let (from, to) = (files::path(&self.dir, file.first), files::path(&unfinished, file.first));
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
        if let Some((first, file, bytes)) = newest {
            let to = files::path(&unfinished, first);
            let copy = || io::copy(&mut file.take(bytes), &mut File::create_new(&to)?);
            copy().map_err(StoreError::io("write", &to))?;
        }
        let (mut index, _) = Index::open(&unfinished, SyncMode::Data)?;
        index.write(&Content { oldest: state.oldest, marks }, &[])?;
        drop(index);
        let watermark = Watermark::create(&unfinished)?;
        watermark.set_acknowledged(state.segments)?;
        watermark.set_sampled(sampled)?;
        Manifest { store, ..Manifest::new(spec) }.write(&unfinished)?;
        fs::rename(&unfinished, &dir).map_err(StoreError::io("move", &dir))
    }
}
