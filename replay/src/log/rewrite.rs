//! Writing a store anew from what is whole of it: [`repair`] and [`compact`].

use super::manifest::Manifest;
use super::survey::{Found, Survey};
use super::{FOLDERS, Log, State, files, lock};
use crate::config::{ReplayConfig, SyncMode};
use crate::error::StoreError;
use getup_proto::Segment;
use serde::Serialize;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Where the new log is put together.
const UNFINISHED: &str = "rewriting";
/// In it: the new log is whole, and where the old one goes.
const COMPLETE: &str = "complete";
/// Where the old log goes before it is removed.
const REPLACED: &str = "replaced";
/// Segments that are written at once.
const GROUP: usize = 64;

/// What a store was before and is now.
#[derive(Clone, PartialEq, Debug, Serialize)]
pub struct Rewritten {
    /// What was found, its damages too.
    pub found: Survey,
    /// Segments that were kept.
    pub segments: u64,
    /// Their transitions.
    pub transitions: u64,
    /// Where the old files lie; none where there was no need to keep them.
    pub old: Option<PathBuf>,
}

/// Keeps every whole segment of the damaged store in `dir`, each once. The files as they were are moved to
/// `damaged-N/` in it. A store that is whole is left as it is.
///
/// # Errors
/// [`StoreError`] if it is in use, or is no store; nothing has changed then.
pub fn repair(dir: &Path) -> Result<Rewritten, StoreError> {
    Manifest::existing(dir)?;
    let lock = lock(dir)?;
    let found = survey(dir, &lock)?;
    if found.survey.damages.is_empty() {
        let (segments, transitions) = (found.survey.segments, found.survey.transitions);
        return Ok(Rewritten { found: found.survey, segments, transitions, old: None });
    }
    let (segments, transitions) = rewrite(dir, &lock, &found, 0)?;
    let mut names = (1..).map(|n| format!("damaged-{n}"));
    let name = names.find(|name| !dir.join(name).exists()).expect("there is a name left");
    swap(dir, Some(&name))?;
    let old = dir.join(name);
    Ok(Rewritten { found: found.survey, segments, transitions, old: Some(old) })
}

/// Writes the store in `dir` anew with its newest `keep` transitions alone (whole segments, and not fewer), or with
/// all of them.
///
/// # Errors
/// [`StoreError`] if it is in use, damaged, or no store; nothing has changed then.
pub fn compact(dir: &Path, keep: Option<u64>) -> Result<Rewritten, StoreError> {
    Manifest::existing(dir)?;
    let lock = lock(dir)?;
    let found = survey(dir, &lock)?;
    if let Some(damage) = found.survey.damages.first() {
        return Err(StoreError::damaged(dir, damage));
    }
    let excess = keep.map_or(0, |keep| found.survey.transitions.saturating_sub(keep));
    let (segments, transitions) = rewrite(dir, &lock, &found, excess)?;
    swap(dir, None)?;
    Ok(Rewritten { found: found.survey, segments, transitions, old: None })
}

/// All that a new log needs to know; an index that cannot be read now would cost it the marks.
fn survey(dir: &Path, lock: &File) -> Result<Found, StoreError> {
    finish(dir)?;
    let mut found = Found::read(dir, Some(lock), |_, _| {})?;
    found.unread.take().map_or(Ok(found), Err)
}

/// Puts a new log together, without the oldest segments that make up to `excess` transitions; returns its segments
/// and transitions.
fn rewrite(dir: &Path, lock: &File, found: &Found, excess: u64) -> Result<(u64, u64), StoreError> {
    remove_unfinished(dir)?;
    // Just enough that nothing is evicted from it, and that its files are of the usual share.
    let Survey { spec, transitions, .. } = &found.survey;
    let capacity = (transitions - excess).max(2 * spec.max_segment_steps as u64);
    let config = ReplayConfig {
        capacity: capacity as usize,
        min_size: 1,
        sync: SyncMode::Data,
        ..ReplayConfig::default()
    };
    let mut writing = Writing {
        dir: dir.join(UNFINISHED),
        found,
        config,
        excess,
        log: None,
        group: Vec::new(),
        state: found.before(),
        error: None,
    };
    Found::read(dir, Some(lock), |number, segment| writing.take(number, segment))?;
    writing.finish()
}

struct Writing<'a> {
    dir: PathBuf,
    found: &'a Found,
    config: ReplayConfig,
    /// Transitions that are still to be left out.
    excess: u64,
    log: Option<Log>,
    group: Vec<Segment>,
    /// Totals after what was left out.
    state: State,
    error: Option<StoreError>,
}

impl Writing<'_> {
    fn take(&mut self, number: u64, segment: Segment) {
        if self.error.is_some() {
            return;
        }
        if self.log.is_none() {
            if segment.steps as u64 <= self.excess {
                self.excess -= segment.steps as u64;
                self.state.add(&segment);
                return;
            }
            self.error = self.begin(number).err();
        }
        self.group.push(segment);
        if self.group.len() == GROUP {
            self.write();
        }
    }

    /// Begins the log where the segment `number` is the first that is written; the marks of writers whose segments are
    /// gone come along.
    fn begin(&mut self, number: u64) -> Result<(), StoreError> {
        let marks = self.found.writers.iter().filter(|(_, mark)| mark.segment < number);
        let log = Log::begin(&self.dir, &self.found.survey.spec, &self.config, self.state, marks.collect())?;
        if let Some(sampled) = self.found.survey.sampled {
            log.watermark().raise_sampled(sampled)?;
        }
        self.state = log.state();
        self.log = Some(log);
        Ok(())
    }

    fn write(&mut self) {
        let group = std::mem::take(&mut self.group);
        if let (Some(log), None) = (&mut self.log, &self.error) {
            self.error = log.append(&group).err();
        }
    }

    fn finish(mut self) -> Result<(u64, u64), StoreError> {
        self.write();
        if self.log.is_none() && self.error.is_none() {
            // Nothing is left, and the totals are not forgotten.
            self.error = self.begin(self.found.end.segments).err();
        }
        match (self.error, self.log) {
            (None, Some(log)) => {
                let State { segments, transitions, .. } = log.state();
                Ok((segments - self.state.segments, transitions - self.state.transitions))
            }
            (Some(error), _) => Err(error),
            (None, None) => unreachable!("the log was begun"),
        }
    }
}

/// Puts the new log in the old one's place, and that to the folder `aside`, or away. From the marker on, a process that
/// is killed leaves what the next one finishes.
fn swap(dir: &Path, aside: Option<&str>) -> Result<(), StoreError> {
    let (unfinished, marker) = (dir.join(UNFINISHED), dir.join(UNFINISHED).join(COMPLETE));
    files::sync_names(&unfinished)?;
    let write = || {
        let mut file = File::create(&marker)?;
        file.write_all(aside.unwrap_or_default().as_bytes())?;
        file.sync_all()
    };
    write().map_err(StoreError::io("write", &marker))?;
    files::sync_names(&unfinished)?;
    finish(dir)
}

/// Finishes a swap that was begun, if one was. The store must be locked.
pub(super) fn finish(dir: &Path) -> Result<(), StoreError> {
    let unfinished = dir.join(UNFINISHED);
    let marker = unfinished.join(COMPLETE);
    if !marker.try_exists().map_err(StoreError::io("read", &marker))? {
        return Ok(());
    }
    let aside = fs::read_to_string(&marker).map_err(StoreError::io("read", &marker))?;
    let replaced = dir.join(if aside.is_empty() { REPLACED } else { &aside });
    fs::create_dir_all(&replaced).map_err(StoreError::io("create", &replaced))?;
    for name in FOLDERS {
        let (old, new) = (dir.join(name), unfinished.join(name));
        // Where the new one is gone, it is in place already.
        if new.exists() {
            if old.exists() {
                fs::rename(&old, replaced.join(name)).map_err(StoreError::io("move", &old))?;
            }
            fs::rename(&new, &old).map_err(StoreError::io("move", &new))?;
        }
    }
    files::sync_names(dir)?;
    if aside.is_empty() {
        fs::remove_dir_all(&replaced).map_err(StoreError::io("remove", &replaced))?;
    }
    fs::remove_dir_all(&unfinished).map_err(StoreError::io("remove", &unfinished))
}

/// Removes what a rewriting that was killed before its swap has left: to be called after [`finish`], which takes what a swap
/// needs. The store must be locked.
pub(super) fn remove_unfinished(dir: &Path) -> Result<(), StoreError> {
    files::remove_folder(&dir.join(UNFINISHED))
}
