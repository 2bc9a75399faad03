//! A run's folder: what lies where.
//!
//! ```text
//! runs/<name>/
//!   config.toml          the whole effective configuration
//!   lock                 held by the process that trains the run
//!   incarnation          how often a learner was started on this run
//!   checkpoints/         step-<env steps>-<updates>.safetensors, the newest few
//!   replay/              the replay's store
//!   evaluations.jsonl    a line an evaluation
//!   timings.jsonl        the wall time of the same
//!   models/              stage-<i>.safetensors at each promotion, best.safetensors, last.safetensors
//!   diverged/            states of simulations that diverged, for `getup rollout`
//! ```

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;

/// The extension of a file that is being written, or whose writing was cut short.
const UNFINISHED: &str = "unfinished";

/// A run's folder cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[error("cannot {action} {path}: {source}")]
pub struct FolderError {
    action: &'static str,
    path: PathBuf,
    source: io::Error,
}

fn fault(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> FolderError {
    move |source| FolderError { action, path: path.to_owned(), source }
}

/// The folder of one run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunFolder {
    root: PathBuf,
}

impl RunFolder {
    /// The folder at `root`; nothing is made yet.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    /// The folder itself.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The effective configuration of the run.
    pub fn config(&self) -> PathBuf {
        self.root.join("config.toml")
    }

    /// Checkpoints.
    pub fn checkpoints(&self) -> PathBuf {
        self.root.join("checkpoints")
    }

    /// The replay's store.
    pub fn replay(&self) -> PathBuf {
        self.root.join("replay")
    }

    /// Model files.
    pub fn models(&self) -> PathBuf {
        self.root.join("models")
    }

    /// One model file, by its stem: `best`, `last`, `stage-3`.
    pub fn model(&self, stem: &str) -> PathBuf {
        self.models().join(format!("{stem}.safetensors"))
    }

    /// A line an evaluation; byte for byte the same for the same seed under `--deterministic`.
    pub fn evaluations(&self) -> PathBuf {
        self.root.join("evaluations.jsonl")
    }

    /// The wall time of each evaluation.
    pub fn timings(&self) -> PathBuf {
        self.root.join("timings.jsonl")
    }

    /// Whether there is something to resume: a checkpoint, not only one whose writing was cut short.
    pub fn has_checkpoint(&self) -> bool {
        let finished = |entry: io::Result<fs::DirEntry>| {
            entry.is_ok_and(|entry| entry.path().extension().is_some_and(|extension| extension != UNFINISHED))
        };
        fs::read_dir(self.checkpoints()).is_ok_and(|mut files| files.any(finished))
    }

    /// Makes the folder and its parts.
    pub fn create(&self) -> Result<(), FolderError> {
        for folder in [self.checkpoints(), self.models()] {
            fs::create_dir_all(&folder).map_err(fault("create", &folder))?;
        }
        Ok(())
    }

    /// Takes the run for this process, until what is returned is dropped: two learners would remove each other's checkpoints.
    ///
    /// # Errors
    /// [`FolderError`] if another process has it.
    pub fn lock(&self) -> Result<File, FolderError> {
        let path = self.root.join("lock");
        let file = File::create(&path).map_err(fault("create", &path))?;
        match file.try_lock() {
            Ok(()) => Ok(file),
            Err(TryLockError::WouldBlock) => {
                let used = "another process trains this run: end it, or choose another --run";
                Err(fault("lock", &path)(io::Error::new(io::ErrorKind::ResourceBusy, used)))
            }
            // A disk that knows no locks.
            Err(TryLockError::Error(error)) if error.kind() == io::ErrorKind::Unsupported => Ok(file),
            Err(TryLockError::Error(error)) => Err(fault("lock", &path)(error)),
        }
    }

    /// The number of this start of a learner on this run, from 1; every call counts one.
    pub fn next_incarnation(&self) -> Result<u64, FolderError> {
        let path = self.root.join("incarnation");
        let last = match fs::read_to_string(&path) {
            Ok(text) => text.trim().parse::<u64>().map_err(|error| {
                let source =
                    io::Error::new(io::ErrorKind::InvalidData, format!("{text:?} is no count: {error}"));
                fault("read", &path)(source)
            })?,
            Err(error) if error.kind() == io::ErrorKind::NotFound => 0,
            Err(error) => return Err(fault("read", &path)(error)),
        };
        write_atomically(&path, format!("{}\n", last + 1).as_bytes())?;
        Ok(last + 1)
    }
}

/// Appends one JSON line: whole, or not at all.
pub fn append_line(path: &Path, line: &impl Serialize) -> Result<(), FolderError> {
    let mut text = serde_json::to_string(line).expect("lines are plain structures of numbers and strings");
    text.push('\n');
    let mut file = OpenOptions::new().create(true).append(true).open(path).map_err(fault("open", path))?;
    let length = file.metadata().map_err(fault("append to", path))?.len();
    file.write_all(text.as_bytes()).map_err(|error| {
        // On a full disk half of it may be there, and the next line would go on from it.
        let _ = file.set_len(length);
        fault("append to", path)(error)
    })
}

/// Removes what a process that was killed had not finished writing to a folder. Nobody may be writing there.
pub fn remove_unfinished(folder: &Path) -> Result<(), FolderError> {
    for entry in fs::read_dir(folder).map_err(fault("read", folder))? {
        let path = entry.map_err(fault("read", folder))?.path();
        if path.extension().is_some_and(|extension| extension == UNFINISHED) {
            fs::remove_file(&path).map_err(fault("remove", &path))?;
        }
    }
    Ok(())
}

/// Writes a file under a temporary name, syncs it, and renames it: a reader sees the old one or the new one. Where that
/// fails, what was written of it is removed: on a full disk it would take the room of the next try.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), FolderError> {
    let unfinished = path.with_extension(UNFINISHED);
    let write = || -> io::Result<()> {
        let mut file = File::create(&unfinished)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&unfinished, path)?;
        if let Some(folder) = path.parent() {
            File::open(folder)?.sync_all()?;
        }
        Ok(())
    };
    write().map_err(|error| {
        let _ = fs::remove_file(&unfinished);
        fault("write", path)(error)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_checkpoint_whose_writing_was_cut_short_is_none() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunFolder::new(folder.path());
        run.create().unwrap();
        let cut = run.checkpoints().join("step-1.unfinished");
        fs::write(&cut, "half of one").unwrap();
        assert!(!run.has_checkpoint());
        remove_unfinished(&run.checkpoints()).unwrap();
        assert!(!cut.exists());
        write_atomically(&run.checkpoints().join("step-1.safetensors"), b"one").unwrap();
        assert!(run.has_checkpoint());
    }

    #[test]
    fn a_run_is_one_process_s_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunFolder::new(folder.path());
        let held = run.lock().unwrap();
        let error = run.lock().unwrap_err().to_string();
        assert!(error.contains("another process trains this run"), "{error}");
        drop(held);
        run.lock().unwrap();
    }

    #[test]
    fn what_cannot_be_written_whole_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        // Nothing is renamed over a folder with something in it.
        let path = folder.path().join("model.safetensors");
        fs::create_dir_all(path.join("something")).unwrap();
        let error = write_atomically(&path, b"a model").unwrap_err().to_string();
        assert!(error.starts_with("cannot write") && error.contains("model.safetensors"), "{error}");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
