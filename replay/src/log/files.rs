//! The files that segments lie in: where they are, how they are written ([`Tail`]) and dropped.

use super::record::{self, State};
use crate::config::SyncMode;
use crate::error::StoreError;
use bytes::Bytes;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// The files' folder in the store's.
pub(crate) const FOLDER: &str = "segments";
const EXTENSION: &str = "seg";
/// A file takes no more commits from this size on. Reading one back takes as much memory.
pub(crate) const FULL_BYTES: u64 = 32 << 20;

/// The file whose first segment is the log's `first`.
pub(crate) fn path(dir: &Path, first: u64) -> PathBuf {
    // So many digits that names sort as numbers do.
    dir.join(FOLDER).join(format!("{first:020}.{EXTENSION}"))
}

/// The numbers of the first segments of all files of the store in `dir`, in order.
pub(crate) fn list(dir: &Path) -> Result<Vec<u64>, StoreError> {
    let folder = dir.join(FOLDER);
    let mut firsts = Vec::new();
    for entry in fs::read_dir(&folder).map_err(StoreError::io("read", &folder))? {
        let name = entry.map_err(StoreError::io("read", &folder))?.file_name();
        let stem = name.to_str().and_then(|name| name.strip_suffix(&format!(".{EXTENSION}")));
        if let Some(first) = stem.and_then(|stem| stem.parse().ok()) {
            firsts.push(first);
        }
    }
    firsts.sort_unstable();
    Ok(firsts)
}

/// The whole content of a file.
pub(crate) fn read(dir: &Path, first: u64) -> Result<Bytes, StoreError> {
    let path = path(dir, first);
    fs::read(&path).map(Bytes::from).map_err(StoreError::io("read", path))
}

/// Drops a file; one that is gone already is as good.
pub(crate) fn remove(dir: &Path, first: u64) -> Result<(), StoreError> {
    let path = path(dir, first);
    match fs::remove_file(&path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(StoreError::io("remove", path)(error)),
        _ => Ok(()),
    }
}

/// Removes a folder with all that is in it; one that is gone already is as good.
pub(crate) fn remove_folder(path: &Path) -> Result<(), StoreError> {
    match fs::remove_dir_all(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(StoreError::io("remove", path)(error)),
        _ => Ok(()),
    }
}

/// Makes all files of the store in `dir` durable on the disk, whoever wrote them and with whichever [`SyncMode`].
///
/// What a disk refused at an earlier sync may be lost unnoticed: the kernel reports that once, and then takes it for
/// written.
pub(crate) fn sync(dir: &Path) -> Result<(), StoreError> {
    for first in list(dir)? {
        let path = path(dir, first);
        File::open(&path).and_then(|file| file.sync_all()).map_err(StoreError::io("sync", path))?;
    }
    sync_names(&dir.join(FOLDER))
}

/// Makes the names in a folder durable on the disk.
pub(crate) fn sync_names(folder: &Path) -> Result<(), StoreError> {
    File::open(folder).and_then(|file| file.sync_all()).map_err(StoreError::io("sync", folder))
}

/// The end of a log: the file that takes its commits.
#[derive(Debug)]
pub(crate) struct Tail {
    path: PathBuf,
    file: File,
    /// Where the next commit goes: all before it is whole.
    end: u64,
}

impl Tail {
    /// Begins a file behind the segments that `state` counts. Nothing is in it before the first commit.
    pub(crate) fn create(dir: &Path, state: State, sync: SyncMode) -> Result<Self, StoreError> {
        let path = path(dir, state.segments);
        let mut header = Vec::new();
        record::put_header(&mut header, state);
        let create = || {
            let file = File::options().write(true).create(true).truncate(true).open(&path)?;
            let mut tail = Self { path: path.clone(), file, end: 0 };
            tail.append(&header)?;
            if sync == SyncMode::Data {
                tail.file.sync_all()?;
                File::open(dir.join(FOLDER))?.sync_all()?;
            }
            Ok(tail)
        };
        create().map_err(|error| {
            // What a full disk left of it.
            let _ = fs::remove_file(&path);
            refusal("create", &path, error)
        })
    }

    /// Goes on with a file, from `end` on; what lies behind is cut off.
    pub(crate) fn open(dir: &Path, first: u64, end: u64) -> Result<Self, StoreError> {
        let path = path(dir, first);
        let open = || {
            let file = File::options().write(true).open(&path)?;
            file.set_len(end)?;
            Ok(file)
        };
        let file = open().map_err(StoreError::io("open", &path))?;
        Ok(Self { path, file, end })
    }

    /// Bytes in the file.
    pub(crate) fn bytes(&self) -> u64 {
        self.end
    }

    /// Appends whole records, durably.
    ///
    /// # Errors
    /// [`StoreError::Full`] if the disk has no room; then, and only then, the file is as it was before.
    pub(crate) fn commit(&mut self, records: &[u8], sync: SyncMode) -> Result<(), StoreError> {
        match self.append(records) {
            Ok(()) => {}
            Err(error) if is_full(&error) && self.file.set_len(self.end).is_ok() => {
                return Err(refusal("write", &self.path, error));
            }
            Err(error) => return Err(StoreError::io("write", &self.path)(error)),
        }
        match sync {
            SyncMode::Process => Ok(()),
            SyncMode::Data => self.file.sync_data().map_err(StoreError::io("sync", &self.path)),
        }
    }

    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all_at(bytes, self.end)?;
        self.end += bytes.len() as u64;
        Ok(())
    }
}

fn refusal(action: &'static str, path: &Path, error: io::Error) -> StoreError {
    let source = error;
    if is_full(&source) {
        StoreError::Full { path: path.to_owned(), source }
    } else {
        StoreError::Io { action, path: path.to_owned(), source }
    }
}

/// Whether space on the disk is all that lacks.
fn is_full(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}
