//! Export: the transitions of a replay store, for tools that know nothing of this program.
//!
//! | format | what comes out | for whom |
//! | --- | --- | --- |
//! | [`export_npz`] | one file, an array a column, a row a transition | `numpy.load` |
//! | [`export_minari`] | a folder, a dataset of episodes | `minari.load_dataset`, and the libraries on top of it |
//!
//! Segments come in the log's order, where those of one episode stand between those of others. Both formats put the
//! episodes back together; [`Exported`] says what is done with those that are not whole. A lane plays one episode at
//! a time, so only its newest is held in memory: a part of an episode for each lane that ever wrote, however large
//! the store is.
//!
//! # Files
//! What exists is never overwritten. An export is written under a hidden name beside its own and renamed when it is
//! whole: one that fails leaves nothing, one that is killed leaves `.NAME.….partial`, and neither leaves half a
//! file under the name that was asked for.

mod arrow;
mod episodes;
mod minari;
mod npz;

pub use minari::{DatasetId, export_minari};
pub use npz::export_npz;

use crate::error::StoreError;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::{fs, io};

/// What was exported.
///
/// # Episodes
/// They are numbered from 0, in the order in which the log completes them. Not every one is whole, and every step is
/// exported nevertheless:
/// - Its **beginning** may be missing, because the store has evicted it or because its limp steps were never
///   stored. What is there is an episode like any other, and the index in the episode of its first step is greater
///   than 0.
/// - Its **end** may be missing, because it was still played, or was given up, or its actor died. npz says so by a
///   last row that is neither `terminal` nor `truncated`; Minari needs an end, and is told `truncated`. Such an
///   episode comes when its lane begins another, or else at the end of the export, in the order in which they began.
/// - Parts that do not follow one another, or together have more than 131,071 steps (a reader of Minari's takes no
///   more in one piece), are exported as episodes of their own.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub struct Exported {
    /// Transitions, limp ones included.
    pub transitions: u64,
    /// Episodes, or what there is of them.
    pub episodes: u64,
    /// Of the episodes, those whose end is missing.
    pub unfinished: u64,
}

/// Why there is no export.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// Something has the name already.
    #[error("{path} exists already, and an export overwrites nothing: remove it, or export to another path")]
    Exists {
        /// Where it should go.
        path: PathBuf,
    },
    /// The store has no transitions.
    #[error("there is nothing to export to {path}: the replay store holds no transitions")]
    Empty {
        /// Where it should go.
        path: PathBuf,
    },
    /// The disk refuses.
    #[error("the export cannot {action} {path}: {source}. Check the disk's space and permissions")]
    Io {
        /// What was attempted, as a verb.
        action: &'static str,
        /// On what.
        path: PathBuf,
        /// The system's answer.
        source: io::Error,
    },
    /// A column has a name that the format needs.
    #[error("{path} cannot be written: npz has an array `{column}` of its own, and so has the run's spec")]
    Reserved {
        /// Where it should go.
        path: PathBuf,
        /// Its name.
        column: String,
    },
    /// The format needs a column that is not there, or has other rows.
    #[error("{path} cannot be written: Minari needs a column `{column}` with {needs}; export npz instead")]
    Column {
        /// Where it should go.
        path: PathBuf,
        /// Its name.
        column: &'static str,
        /// Its rows.
        needs: &'static str,
    },
    /// Not the name of a Minari dataset.
    #[error(
        "`{id}` does not name a Minari dataset: use NAME-vN or SPACE/NAME-vN, such as getup-v0, with letters, digits, `_` \
         and `-`"
    )]
    DatasetId {
        /// The name.
        id: String,
    },
    /// The store cannot be read, or a segment does not follow the spec.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl ExportError {
    /// For `map_err`: what was attempted on `path`.
    fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| match source.kind() {
            io::ErrorKind::AlreadyExists => Self::Exists { path },
            _ => Self::Io { action, path, source },
        }
    }
}

/// Where an export goes, which nothing has the name of yet.
struct Target {
    path: PathBuf,
    /// Exists; temporary files lie here, so that renaming them copies nothing.
    folder: PathBuf,
    /// Begins their names.
    prefix: OsString,
}

/// Ends the name of a file that is not whole.
const PARTIAL: &str = ".partial";

impl Target {
    /// Refuses a path that exists, and creates the folders above one that does not.
    fn new(path: &Path) -> Result<Self, ExportError> {
        // A link to nowhere is something too.
        if path.symlink_metadata().is_ok() {
            return Err(ExportError::Exists { path: path.to_owned() });
        }
        let unnamed = || io::Error::new(io::ErrorKind::InvalidInput, "the path does not end with a name");
        let name = path.file_name().ok_or_else(unnamed).map_err(ExportError::io("write", path))?;
        let mut prefix = OsString::from(".");
        prefix.push(name);
        prefix.push(".");
        let folder = match path.parent() {
            Some(folder) if folder != Path::new("") => folder.to_owned(),
            _ => PathBuf::from("."),
        };
        fs::create_dir_all(&folder).map_err(ExportError::io("create", &folder))?;
        Ok(Self { path: path.to_owned(), folder, prefix })
    }

    /// A file that is removed again unless it is given its name.
    fn partial_file(&self) -> Result<tempfile::NamedTempFile, ExportError> {
        let mut builder = tempfile::Builder::new();
        builder.prefix(&self.prefix).suffix(PARTIAL);
        // Temporary files are for their owner alone; this one is to become a file like any other.
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
        builder.tempfile_in(&self.folder).map_err(ExportError::io("create a file in", &self.folder))
    }

    /// A folder that is removed again unless it is given its name.
    fn partial_folder(&self) -> Result<tempfile::TempDir, ExportError> {
        let mut builder = tempfile::Builder::new();
        builder.prefix(&self.prefix).suffix(PARTIAL);
        builder.tempdir_in(&self.folder).map_err(ExportError::io("create a folder in", &self.folder))
    }

    /// Gives a file its name, once its bytes have reached the disk.
    fn keep_file(&self, file: tempfile::NamedTempFile) -> Result<(), ExportError> {
        file.as_file().sync_all().map_err(ExportError::io("write", &self.path))?;
        let kept = file.persist_noclobber(&self.path).map_err(|error| error.error);
        kept.map(drop).map_err(ExportError::io("create", &self.path))
    }

    /// Gives a folder its name. Its files reach the disk when the kernel thinks fit: they are thousands, and an
    /// export that a power loss takes can be repeated.
    fn keep_folder(&self, folder: tempfile::TempDir) -> Result<(), ExportError> {
        // Fails where something has come to be in the meantime, unless it is an empty folder.
        fs::rename(folder.path(), &self.path).map_err(ExportError::io("create", &self.path))?;
        let _renamed = folder.keep();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures;
    use getup_proto::Segment;

    fn segments(last: Result<Segment, StoreError>) -> impl Iterator<Item = Result<Segment, StoreError>> {
        let spec = fixtures::spec(8);
        (1..4).map(move |sequence| Ok(fixtures::segment(&spec, 1, sequence, 8))).chain([last])
    }

    fn export_both(
        folder: &Path,
        last: fn() -> Result<Segment, StoreError>,
    ) -> [Result<Exported, ExportError>; 2] {
        let spec = fixtures::spec(8);
        let (npz, minari) = (folder.join("x.npz"), folder.join("x-v0"));
        let id = DatasetId::of_folder(&minari, None).unwrap();
        [
            export_npz(&npz, &spec, segments(last()), |_| ()),
            export_minari(&minari, &id, &spec, segments(last()), |_| ()),
        ]
    }

    fn entries(folder: &Path) -> Vec<OsString> {
        let mut names: Vec<_> =
            fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        names
    }

    fn whole() -> Result<Segment, StoreError> {
        Ok(fixtures::segment(&fixtures::spec(8), 1, 4, 5))
    }

    #[test]
    fn an_export_has_its_name_alone_and_is_not_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        for exported in export_both(folder.path(), whole) {
            assert_eq!(exported.unwrap(), Exported { transitions: 29, episodes: 4, unfinished: 4 });
        }
        assert_eq!(entries(folder.path()), ["x-v0", "x.npz"]);
        let before = fs::read(folder.path().join("x.npz")).unwrap();
        for exported in export_both(folder.path(), whole) {
            assert!(matches!(exported, Err(ExportError::Exists { .. })));
        }
        assert_eq!(fs::read(folder.path().join("x.npz")).unwrap(), before);
    }

    #[test]
    fn an_export_that_fails_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        for exported in export_both(folder.path(), || Err(StoreError::Failed("a test".to_owned()))) {
            assert!(matches!(exported, Err(ExportError::Store(StoreError::Failed(_)))));
        }
        let other = || Ok(fixtures::segment(&fixtures::get_up_spec(), 1, 4, 8));
        for exported in export_both(folder.path(), other) {
            assert!(matches!(exported, Err(ExportError::Store(StoreError::Segment(_)))));
        }
        assert!(entries(folder.path()).is_empty());
    }

    #[test]
    fn a_store_without_transitions_is_not_exported() {
        let (folder, spec) = (tempfile::tempdir().unwrap(), fixtures::spec(8));
        let npz = export_npz(&folder.path().join("x.npz"), &spec, std::iter::empty(), |_| ());
        assert!(matches!(npz, Err(ExportError::Empty { .. })));
        let path = folder.path().join("x-v0");
        let id = DatasetId::of_folder(&path, None).unwrap();
        let minari = export_minari(&path, &id, &spec, std::iter::empty(), |_| ());
        assert!(matches!(minari, Err(ExportError::Empty { .. })));
        assert!(entries(folder.path()).is_empty());
    }

    #[cfg(unix)]
    #[test]
    fn an_export_can_be_read_by_whoever_could_read_a_new_file() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        for exported in export_both(folder.path(), whole) {
            exported.unwrap();
        }
        fs::write(folder.path().join("plain"), "").unwrap();
        fs::create_dir(folder.path().join("folder")).unwrap();
        let mode = |name: &str| folder.path().join(name).metadata().unwrap().permissions().mode();
        assert_eq!(mode("x.npz"), mode("plain"));
        assert_eq!(mode("x-v0"), mode("folder"));
    }
}
