//! Reading a store that may be damaged or in use: [`Survey`].
//!
//! Nothing is changed, and a store may be written meanwhile: what it adds while it is read is not taken for damage.

use super::files;
use super::index::{self, Index};
use super::manifest::Manifest;
use super::record::{self, Mark, Records, State};
use super::watermark::Watermark;
use super::{Writers, disk_bytes, try_lock};
use crate::config::SyncMode;
use crate::error::StoreError;
use getup_proto::{RunSpec, Segment};
use serde::Serialize;
use std::fs::File;
use std::path::Path;

fn as_text<S: serde::Serializer>(number: &u64, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(number)
}

/// What a store's folder holds.
#[derive(Clone, PartialEq, Debug, Serialize)]
pub struct Survey {
    /// Names the store; in JSON as text, for it has more digits than numbers there.
    #[serde(serialize_with = "as_text")]
    pub store: u64,
    /// Of its transitions.
    pub spec: RunSpec,
    /// Files of segments.
    pub files: usize,
    /// Segments that are there and whole.
    pub segments: u64,
    /// Their transitions, limp ones included.
    pub transitions: u64,
    /// Of these, env steps.
    pub env_steps: u64,
    /// Episodes whose end is there.
    pub episodes: u64,
    /// Totals over the store's life, evicted segments included.
    pub ever: Ever,
    /// Writers that the files know of, and the greatest sequence number of each.
    pub writers: Vec<WriterMark>,
    /// Transitions handed out in minibatches; none where the file that counts them cannot be read.
    pub sampled: Option<u64>,
    /// Bytes of the segments' values: 4 a number.
    pub value_bytes: u64,
    /// Bytes that the store takes on disk.
    pub disk_bytes: u64,
    /// What is wrong with it; empty where it is whole.
    pub damages: Vec<String>,
}

/// Totals over a store's life.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize)]
pub struct Ever {
    /// Segments appended.
    pub segments: u64,
    /// Their transitions.
    pub transitions: u64,
    /// Of these, env steps.
    pub env_steps: u64,
    /// Episodes that ended.
    pub episodes: u64,
}

/// How far a writer's segments are durable.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize)]
pub struct WriterMark {
    /// Its number.
    pub writer: u64,
    /// The greatest sequence number that is.
    pub sequence: u64,
}

impl Survey {
    /// Reads the whole store in `dir`; `visit` gets every segment that is whole, oldest first.
    ///
    /// # Errors
    /// [`StoreError`] if there is no store, or so little of one that its transitions cannot be known: damage beyond
    /// that is told in [`Survey::damages`].
    pub fn read(dir: &Path, mut visit: impl FnMut(Segment)) -> Result<Self, StoreError> {
        // A folder that is no store gets no lock file.
        Manifest::existing(dir)?;
        // sled locks its folder: a store in use keeps its index to itself.
        let lock = try_lock(dir).ok();
        Ok(Found::read(dir, lock.as_ref(), |_, segment| visit(segment))?.survey)
    }
}

/// A survey, and what a new log needs to go on from it.
pub(super) struct Found {
    pub(super) survey: Survey,
    /// Totals after the last segment that is there.
    pub(super) end: State,
    /// Of all writers.
    pub(super) writers: Writers,
    /// Why the index, damaged or not, could not be read now: a full disk, say.
    pub(super) unread: Option<StoreError>,
}

impl Found {
    /// As [`Survey::read`]; `visit` also gets the segment's number in the log. The index is read under the store's `lock`
    /// alone.
    pub(super) fn read(
        dir: &Path,
        lock: Option<&File>,
        visit: impl FnMut(u64, Segment),
    ) -> Result<Self, StoreError> {
        let manifest = Manifest::existing(dir)?;
        // Asked before the files are read: what is acknowledged later may be in none of them.
        let watermark = Watermark::open_to_read(dir);
        let acknowledged = watermark
            .as_ref()
            .map_err(ToString::to_string)
            .and_then(|watermark| watermark.acknowledged().map_err(|error| error.to_string()));
        let sampled = watermark.ok().and_then(|watermark| watermark.sampled().ok());
        let mut reading = Reading {
            acknowledged: acknowledged.as_ref().ok().copied(),
            oldest: None,
            dir,
            spec: &manifest.spec,
            begun: false,
            state: State::default(),
            writers: Writers::default(),
            survey: Survey {
                store: manifest.store,
                spec: manifest.spec.clone(),
                files: 0,
                segments: 0,
                transitions: 0,
                env_steps: 0,
                episodes: 0,
                ever: State::default().into(),
                writers: Vec::new(),
                sampled,
                value_bytes: 0,
                disk_bytes: disk_bytes(dir),
                damages: Vec::new(),
            },
            unread: None,
            visit,
        };
        if lock.is_some() {
            reading.read_index();
        }
        reading.read_files()?;
        let Reading { state, writers, mut survey, unread, .. } = reading;
        match acknowledged {
            Ok(acknowledged) if state.segments < acknowledged => survey.damages.push(format!(
                "{acknowledged} segments were acknowledged, and the files end after {}",
                state.segments
            )),
            Ok(_) => {}
            Err(error) => survey.damages.push(error),
        }
        survey.ever = state.into();
        survey.writers =
            writers.iter().map(|(writer, mark)| WriterMark { writer, sequence: mark.sequence }).collect();
        survey.writers.sort_unstable_by_key(|mark| mark.writer);
        Ok(Self { survey, end: state, writers, unread })
    }

    /// Totals before the segments that are there, if nothing is missing between them: what is missing counts as evicted, and
    /// the totals over the store's life stay.
    pub(super) fn before(&self) -> State {
        let Survey { segments, env_steps, transitions, episodes, .. } = self.survey;
        State {
            segments: self.end.segments - segments,
            env_steps: self.end.env_steps - env_steps,
            transitions: self.end.transitions - transitions,
            episodes: self.end.episodes - episodes,
            ..self.end
        }
    }
}

/// The spec of the store in `dir`, and its segments, oldest first. The store may be written meanwhile: what it had when
/// this was called is read, but for what it evicts. Segments that are missing are not noticed: [`Survey::read`] does.
///
/// # Errors
/// [`StoreError`] if there is no store; an item is an error where a file is damaged, and the last one then.
pub fn segments(
    dir: &Path,
) -> Result<(RunSpec, impl Iterator<Item = Result<Segment, StoreError>>), StoreError> {
    let manifest = Manifest::existing(dir)?;
    let firsts = files::list(dir)?;
    let newest = firsts.last().copied();
    let (dir, spec) = (dir.to_owned(), manifest.spec.clone());
    let in_file = move |first: u64| -> Vec<Result<Segment, StoreError>> {
        let content = match files::read(&dir, first) {
            Ok(content) => content,
            Err(_) if !files::path(&dir, first).exists() => return Vec::new(),
            Err(error) => return vec![Err(error)],
        };
        let end = content.len();
        let whole = |record: Result<record::Record, record::Torn>| match record {
            Ok(record) => Some(record.segment(&spec)),
            Err(torn) if Some(first) == newest && torn.bytes.end == end => None,
            Err(torn) => {
                Some(Err(format!("bytes {} to {} are no whole segment", torn.bytes.start, torn.bytes.end)))
            }
        };
        let name = |what| StoreError::damaged(&dir, format!("{first:020}: {what}"));
        Records::new(content).filter_map(whole).map(|segment| segment.map_err(name)).collect()
    };
    let mut broken = false;
    let until_damage = move |segment: &Result<Segment, StoreError>| {
        let goes_on = !broken;
        broken |= segment.is_err();
        goes_on
    };
    Ok((manifest.spec, firsts.into_iter().flat_map(in_file).take_while(until_damage)))
}

struct Reading<'a, V> {
    dir: &'a Path,
    /// Segments that were; none where that is not known.
    acknowledged: Option<u64>,
    /// Number of the oldest segment that is kept; what lies before is on its way out. None where that is not known.
    oldest: Option<u64>,
    spec: &'a RunSpec,
    /// Whether the next file must go on where something before it ended.
    begun: bool,
    /// Totals after what was read.
    state: State,
    writers: Writers,
    survey: Survey,
    unread: Option<StoreError>,
    visit: V,
}

impl<V: FnMut(u64, Segment)> Reading<'_, V> {
    /// The marks of writers whose segments are gone, and where the log begins.
    fn read_index(&mut self) {
        if !self.dir.join(index::FOLDER).is_dir() {
            self.survey.damages.push(format!("its folder `{}` is missing", index::FOLDER));
            return;
        }
        match Index::open(self.dir, SyncMode::Process) {
            Ok((_, content)) => {
                content.marks.into_iter().for_each(|(writer, mark)| self.writers.restore(writer, mark));
                self.oldest = Some(content.oldest);
            }
            Err(error @ StoreError::Damaged { .. }) => self.survey.damages.push(what(error)),
            Err(error) => self.unread = Some(error),
        }
    }

    fn read_files(&mut self) -> Result<(), StoreError> {
        if !self.dir.join(files::FOLDER).is_dir() {
            self.survey.damages.push(format!("its folder `{}` is missing", files::FOLDER));
            return Ok(());
        }
        let mut firsts = files::list(self.dir)?;
        if let Some(oldest) = self.oldest {
            firsts.retain(|&first| first >= oldest);
            if let Some(&first) = firsts.first()
                && first != oldest
            {
                self.damage(first, &format!("the file of segment {oldest} should come before it"));
            }
        }
        for (place, &first) in firsts.iter().enumerate() {
            self.read_file(first, place + 1 == firsts.len());
        }
        Ok(())
    }

    fn read_file(&mut self, first: u64, newest: bool) {
        let content = match files::read(self.dir, first) {
            Ok(content) => content,
            // Dropped since it was listed, and all before it were.
            Err(_) if !files::path(self.dir, first).exists() => {
                self.begun = false;
                return;
            }
            Err(error) => return self.survey.damages.push(what(error)),
        };
        self.survey.files += 1;
        match record::header(&content) {
            Some(header) => self.go_on(first, header),
            None if newest && content.len() < record::HEADER_BYTES => return,
            None => self.damage(first, "its header cannot be read"),
        }
        for record in Records::new(content) {
            let segment = match record {
                // Bytes that look like a record in another one's body.
                Ok(record) if record.number < self.state.segments => {
                    self.damage(first, &format!("segment {} comes twice", record.number));
                    continue;
                }
                Ok(record) => {
                    self.state.segments = record.number;
                    record.segment(self.spec)
                }
                // Cut off while it was written, and not acknowledged.
                Err(_) if newest && self.is_unacknowledged() => return,
                Err(torn) => {
                    let bytes = torn.bytes;
                    self.damage(
                        first,
                        &format!("bytes {} to {} are no whole segment", bytes.start, bytes.end),
                    );
                    continue;
                }
            };
            match segment {
                Ok(segment) => self.take(segment),
                Err(error) => self.damage(first, &format!("a segment cannot be read ({error})")),
            }
        }
    }

    /// Whether what comes next was not acknowledged, as far as the watermark says.
    fn is_unacknowledged(&self) -> bool {
        self.acknowledged.is_some_and(|acknowledged| self.state.segments >= acknowledged)
    }

    /// Goes on with a file that begins after the totals `header`: what is missing before it is in them.
    fn go_on(&mut self, first: u64, header: State) {
        if header.segments != first {
            self.damage(
                first,
                &format!("it begins after {} segments, and its name says {first}", header.segments),
            );
        }
        let counts = |state: State| State { oldest: 0, ..state };
        if self.begun && counts(header) != counts(self.state) {
            self.damage(
                first,
                &format!(
                    "it begins after {} segments and {} transitions, and what comes before has {} and {}",
                    header.segments, header.transitions, self.state.segments, self.state.transitions
                ),
            );
        }
        self.state = self.state.max(header);
        self.begun = true;
    }

    fn take(&mut self, segment: Segment) {
        let number = self.state.segments;
        self.begun = true;
        let Survey { segments, transitions, env_steps, episodes, value_bytes, .. } = &mut self.survey;
        *segments += 1;
        *transitions += segment.steps as u64;
        *env_steps += u64::from(segment.env_steps);
        *episodes += u64::from(segment.end.is_some());
        *value_bytes += segment.columns.iter().map(|column| column.len() as u64).sum::<u64>();
        self.writers.restore(segment.writer, Mark { sequence: segment.sequence, segment: number });
        self.state.add(&segment);
        (self.visit)(number, segment);
    }

    fn damage(&mut self, first: u64, text: &str) {
        let path = files::path(self.dir, first);
        let name = path.file_name().unwrap_or_default().display();
        self.survey.damages.push(format!("{name}: {text}"));
    }
}

/// What is wrong, without where and how to mend it.
fn what(error: StoreError) -> String {
    match error {
        StoreError::Damaged { what, .. } => what,
        other => other.to_string(),
    }
}

impl From<State> for Ever {
    fn from(state: State) -> Self {
        let State { segments, env_steps, transitions, episodes, .. } = state;
        Self { segments, transitions, env_steps, episodes }
    }
}
