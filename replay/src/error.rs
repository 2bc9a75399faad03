//! What can go wrong with a store: [`StoreError`].

use crate::config::ConfigError;
use getup_proto::{SegmentError, SpecError};
use std::io;
use std::path::PathBuf;

/// Why a store cannot be opened, or takes no more segments.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A setting out of range.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The spec itself is malformed.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The store holds the transitions of another run.
    #[error("the replay store {dir} cannot be used here: {source}")]
    OtherRun {
        /// Where it is.
        dir: PathBuf,
        /// What differs.
        source: SpecError,
    },
    /// Another version of this program wrote the store.
    #[error(
        "the replay store {dir} has format {found}, and this getup reads format {ours}: use the getup that wrote \
         it, or move the folder away to begin with an empty replay"
    )]
    Format {
        /// Where it is.
        dir: PathBuf,
        /// Its format.
        found: u64,
        /// The one that is read and written here.
        ours: u64,
    },
    /// There is no store to look at.
    #[error("there is no replay store in {dir}: name a folder with a store.json, such as runs/NAME/replay")]
    NoStore {
        /// Where it should be.
        dir: PathBuf,
    },
    /// A process has the store open.
    #[error(
        "the replay store {dir} is in use by another process: end that one, or give this run another folder"
    )]
    InUse {
        /// Where it is.
        dir: PathBuf,
    },
    /// A snapshot of that name is there.
    #[error("there is a snapshot {dir} already: take another name, or remove it")]
    SnapshotExists {
        /// Where it is.
        dir: PathBuf,
    },
    /// What was stored cannot be read back whole.
    #[error(
        "the replay store {dir} is damaged: {what}. `getup replay repair {dir}` keeps every whole segment; or move \
         the folder away to begin with an empty replay (models, checkpoints and the learner's state lie elsewhere \
         and are not touched)"
    )]
    Damaged {
        /// Where it is.
        dir: PathBuf,
        /// What was found.
        what: String,
    },
    /// Its `store.json` is missing or cannot be read: nothing says whose transitions it holds.
    #[error(
        "the replay store {dir} cannot be used: {what}. store.json is written once and never changes: copy it from a \
         snapshot or a backup of this store (such as {dir}/snapshots/NAME/store.json); or move the folder away to begin \
         with an empty replay (models, checkpoints and the learner's state lie elsewhere and are not touched)"
    )]
    Manifest {
        /// Where it is.
        dir: PathBuf,
        /// What was found.
        what: String,
    },
    /// The disk refuses.
    #[error(
        "the replay store cannot {action} {path}: {source}. Check the disk's space and permissions, then start again"
    )]
    Io {
        /// What was attempted, as a verb.
        action: &'static str,
        /// On what.
        path: PathBuf,
        /// The system's answer.
        source: io::Error,
    },
    /// The disk has no room. Nothing has changed: the same append works once there is some.
    #[error(
        "the replay store cannot write {path}: {source}. Make room on its disk, or lower replay.capacity"
    )]
    Full {
        /// What could not grow.
        path: PathBuf,
        /// The system's answer.
        source: io::Error,
    },
    /// An earlier error ended all writing; nothing is acknowledged any more.
    #[error("the replay store takes no more segments after an error: {0}. Start it again")]
    Failed(String),
    /// A segment that does not follow the spec.
    #[error(transparent)]
    Segment(#[from] SegmentError),
}

impl StoreError {
    /// For `map_err`: what was attempted on `path`.
    pub(crate) fn io(action: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { action, path, source }
    }

    pub(crate) fn damaged(dir: impl Into<PathBuf>, what: impl Into<String>) -> Self {
        Self::Damaged { dir: dir.into(), what: what.into() }
    }

    pub(crate) fn manifest(dir: impl Into<PathBuf>, what: impl Into<String>) -> Self {
        Self::Manifest { dir: dir.into(), what: what.into() }
    }

    /// What sled reports about the store in `dir`.
    pub(crate) fn sled(dir: impl Into<PathBuf>) -> impl FnOnce(sled::Error) -> Self {
        let dir = dir.into();
        move |error| match error {
            sled::Error::Io(source)
                if !matches!(source.kind(), io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof) =>
            {
                Self::Io { action: "read or write", path: dir, source }
            }
            other => Self::damaged(dir, format!("its log is inconsistent ({other})")),
        }
    }
}
