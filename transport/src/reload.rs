//! A value that is made from files, and made again when they change.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::SecurityError;
use crate::throttle::Throttle;

/// How often the files are looked at, at most.
const CHECK_EVERY: Duration = Duration::from_secs(1);

/// A file of the configuration, read. Not `Debug`: it may hold a secret.
#[derive(Clone, PartialEq)]
pub(crate) struct File {
    /// The setting that names it.
    pub(crate) setting: &'static str,
    pub(crate) path: PathBuf,
    pub(crate) bytes: Vec<u8>,
}

impl File {
    pub(crate) fn read(setting: &'static str, path: &Path) -> Result<Self, SecurityError> {
        let path = path.to_owned();
        match std::fs::read(&path) {
            Ok(bytes) => Ok(Self { setting, path, bytes }),
            Err(source) => Err(SecurityError::Unreadable { setting, path, source }),
        }
    }

    /// What is wrong with what the file holds.
    pub(crate) fn malformed(&self, problem: impl Into<String>) -> SecurityError {
        let (path, problem) = (self.path.clone(), problem.into());
        SecurityError::Malformed { setting: self.setting, path, problem }
    }
}

/// The value, with the files that it was made from. Contents are compared, and not times: the files are small, and
/// it does not matter how they were replaced.
pub(crate) struct Reloaded<T> {
    parse: fn(&[File]) -> Result<T, SecurityError>,
    state: Mutex<State<T>>,
    failures: Throttle,
}

struct State<T> {
    value: Arc<T>,
    files: Vec<File>,
    checked: Instant,
}

impl<T> Reloaded<T> {
    /// Reads the files, each named with its setting, and makes the value for the first time.
    pub(crate) fn load(
        files: &[(&'static str, &Path)],
        parse: fn(&[File]) -> Result<T, SecurityError>,
    ) -> Result<Self, SecurityError> {
        let files =
            files.iter().map(|(setting, path)| File::read(setting, path)).collect::<Result<Vec<_>, _>>()?;
        let state = State { value: Arc::new(parse(&files)?), files, checked: Instant::now() };
        Ok(Self { parse, state: Mutex::new(state), failures: Throttle::default() })
    }

    /// The value that the files gave within the last second, or the last one that could be made.
    pub(crate) fn current(&self) -> Arc<T> {
        self.current_at(Instant::now())
    }

    fn current_at(&self, now: Instant) -> Arc<T> {
        // The state is replaced as a whole: a panic elsewhere does not spoil it.
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        if now.duration_since(state.checked) >= CHECK_EVERY {
            state.checked = now;
            match self.read_again(&state.files) {
                Ok(None) => {}
                Ok(Some((value, files))) => {
                    tracing::info!("security.{} and what belongs to it were read again", files[0].setting);
                    (state.value, state.files) = (Arc::new(value), files);
                }
                // Such as a new certificate whose key is not there yet.
                Err(error) => {
                    if self.failures.note().is_some() {
                        tracing::warn!("what was read before stays in use: {error}");
                    }
                }
            }
        }
        Arc::clone(&state.value)
    }

    /// Another value, if the files are other ones.
    fn read_again(&self, known: &[File]) -> Result<Option<(T, Vec<File>)>, SecurityError> {
        let files: Vec<File> =
            known.iter().map(|file| File::read(file.setting, &file.path)).collect::<Result<_, _>>()?;
        if files == known { Ok(None) } else { Ok(Some(((self.parse)(&files)?, files))) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_is_seen_after_a_second_and_what_cannot_be_read_changes_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("number");
        let write = |text: &str| std::fs::write(&path, text).unwrap();
        write("1");
        let number = Reloaded::load(&[("number", &path)], |files| {
            let text = String::from_utf8_lossy(&files[0].bytes);
            text.parse::<u32>().map_err(|error| files[0].malformed(error.to_string()))
        });
        let (number, start) = (number.unwrap(), Instant::now());
        let after = |seconds: u64| *number.current_at(start + Duration::from_secs(seconds));
        write("2");
        assert_eq!((after(0), after(1)), (1, 2));
        write("two");
        assert_eq!(after(2), 2);
        std::fs::remove_file(&path).unwrap();
        assert_eq!(after(3), 2);
        write("3");
        assert_eq!((after(3), after(4)), (2, 3));
    }
}
