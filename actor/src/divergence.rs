//! Keeps what it takes to repeat a diverged episode: `getup rollout --input FILE` fails as it failed.

use std::fs;
use std::path::{Path, PathBuf};

use getup_sim::{Diverged, Divergence};

use crate::identity::Identity;

/// Files that one group of lanes writes at most: a policy that diverges all the time must not fill the disk.
const MOST_FILES: usize = 100;

/// Writes diverged episodes to a folder.
pub(crate) struct DivergenceLog {
    folder: PathBuf,
    written: usize,
}

impl DivergenceLog {
    /// A log that makes `folder` when it has something to write.
    pub(crate) fn new(folder: PathBuf) -> Self {
        Self { folder, written: 0 }
    }

    /// Logs a divergence and keeps its recording. A file that cannot be written is logged too, and no more.
    pub(crate) fn keep(&mut self, identity: &Identity, lane: u32, episode: u64, diverged: &Diverged) {
        let name = &identity.name;
        if self.written == MOST_FILES {
            tracing::warn!(actor = name, lane, episode, "{diverged}; not kept: {MOST_FILES} others are");
            return;
        }
        // Not the name: it may hold what a file name may not.
        let file = format!("{:016x}-lane{lane}-episode{episode}.json", identity.writer);
        let path = self.folder.join(file);
        match write(&path, diverged) {
            Ok(()) => {
                self.written += 1;
                let (input, cause) = (path.display(), &diverged.cause);
                let how = match cause {
                    // JSON has no such number to repeat it by.
                    Divergence::Control => "what came before it can be repeated",
                    _ => "repeat it",
                };
                tracing::warn!(
                    actor = name,
                    lane,
                    episode,
                    "{diverged}; {how} with `getup rollout --input {input} --output out.json`"
                );
            }
            Err(error) => {
                tracing::warn!(
                    actor = name,
                    lane,
                    episode,
                    "{diverged}; cannot write {}: {error}",
                    path.display()
                );
            }
        }
    }
}

fn write(path: &Path, diverged: &Diverged) -> std::io::Result<()> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder)?;
    }
    fs::write(path, serde_json::to_vec(&diverged.recording)?)
}
