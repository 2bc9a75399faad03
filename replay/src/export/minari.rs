//! A [Minari](https://minari.farama.org) dataset: [`export_minari`].
//!
//! Minari stores episodes in HDF5, Arrow or Parquet; this is its Arrow layout, which needs no C library:
//!
//! ```text
//! NAME-v0/data/metadata.json      what the dataset is, and how much there is of it
//! NAME-v0/data/0/part-0.arrow     the first episode: one record batch of a row a state
//! NAME-v0/data/0/metadata.json    where it comes from
//! ```
//!
//! An episode of T steps has T + 1 states, and so has every field of its batch; where a step has no place in the last
//! row, zeros and `false` fill it.

use super::arrow::{self, Batch, Kind};
use super::episodes::{Episode, each_episode};
use super::{ExportError, Exported, Target};
use crate::error::StoreError;
use getup_proto::{ColumnSpec, Rows, RunSpec, Segment, columns};
use polars_arrow_format::ipc::Field;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::{fmt, fs, io};

/// The release of Minari that the dataset claims to be of: the oldest that reads this layout, because a release accepts
/// datasets of earlier ones and refuses those of later ones.
const MINARI_VERSION: &str = "0.5.0";

/// Writes the transitions to the folder `path`, as the Minari dataset `id`. Folders above it are created.
///
/// If `path` is `$MINARI_DATASETS_PATH/ID` (or `~/.minari/datasets/ID`), `minari.load_dataset("ID")` finds it;
/// `minari.MinariDataset("PATH/data")` reads it wherever it lies. Either needs `pip install "minari[arrow]" pillow`.
/// An episode of T steps has, W being the width of a column:
///
/// | | shape | type | |
/// | --- | --- | --- | --- |
/// | `observations` | T + 1 × W | float32 | before each step, and after the last |
/// | `actions` | T × W | float32 | |
/// | `rewards` | T | float32 | |
/// | `terminations` | T | bool | true in the last row of an episode that ended in a terminal state |
/// | `truncations` | T | bool | true in the last row of any other, whether it reached its time limit or has no end |
/// | `infos` | T + 1 × W | float32 | the other columns by their names; zeros in the last row where a step has none |
///
/// The observation space is a box without bounds. The action space is the box from −1 to 1, in which a squashed
/// policy acts, unless an action lies outside; then it has no bounds either. There is no environment to recover.
///
/// `storage.get_episode_metadata` tells of an episode its `writer`, `lane`, number in the lane (`episode`) and
/// `stage`, the index of its `first_step`, the versions of its policies (`first_version`, `last_version`), whether its
/// end is there (`finished`), and if it is, its `episode_return`, `env_steps`, `reason` and `tags`. Which episodes there
/// are says [`Exported`].
///
/// `segments`: in the log's order, following `spec`. `progress` is told how many transitions were written so far,
/// after each episode.
///
/// # Errors
/// [`ExportError`]; then there is no folder. [`ExportError::Column`] if the spec lacks an observation a state, an
/// action a step or a reward.
pub fn export_minari(
    path: &Path,
    id: &DatasetId,
    spec: &RunSpec,
    segments: impl Iterator<Item = Result<Segment, StoreError>>,
    progress: impl FnMut(u64),
) -> Result<Exported, ExportError> {
    let layout = Layout::new(path, spec)?;
    let target = Target::new(path)?;
    let folder = target.partial_folder()?;
    let mut dataset = Dataset::new(folder.path(), layout)?;
    let exported = each_episode(spec, segments, |episode| dataset.push(episode), progress)?;
    if exported.transitions == 0 {
        return Err(ExportError::Empty { path: path.to_owned() });
    }
    dataset.finish(id, exported)?;
    target.keep_folder(folder)?;
    Ok(exported)
}

/// The name of a Minari dataset: `NAME-vN`, perhaps with a namespace, `SPACE/NAME-vN`.
#[derive(Clone, PartialEq, Eq, Hash, Debug)]
pub struct DatasetId(String);

impl DatasetId {
    /// The name of the dataset in the folder `path`: its path from the folder `root` of Minari's datasets, if it lies
    /// there, or else the folder's own name.
    ///
    /// # Errors
    /// [`ExportError::DatasetId`] if that does not name a dataset.
    pub fn of_folder(path: &Path, root: Option<&Path>) -> Result<Self, ExportError> {
        let absolute = |path: &Path| std::path::absolute(path).map_err(ExportError::io("find", path));
        let whole = absolute(path)?;
        let root = root.map(absolute).transpose()?;
        let below = root.and_then(|root| whole.strip_prefix(root).ok().map(Path::to_owned));
        let name = below.or_else(|| path.file_name().map(Into::into)).unwrap_or_default();
        name.to_string_lossy().replace(std::path::MAIN_SEPARATOR, "/").parse()
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for DatasetId {
    type Err = ExportError;

    /// # Errors
    /// [`ExportError::DatasetId`] if Minari does not take it for a name, or it has more than ASCII in it.
    fn from_str(id: &str) -> Result<Self, ExportError> {
        let id = id.to_owned();
        if is_dataset_id(&id) { Ok(Self(id)) } else { Err(ExportError::DatasetId { id }) }
    }
}

impl fmt::Display for DatasetId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Whether Minari takes `id` for a name; of what it takes, only what is ASCII.
fn is_dataset_id(id: &str) -> bool {
    let is_word = |word: &str| {
        !word.is_empty() && word.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-')
    };
    let (namespace, name) = id.rsplit_once('/').map_or((None, id), |(space, name)| (Some(space), name));
    let versioned = name.rsplit_once("-v").is_some_and(|(name, version)| {
        is_word(name) && !version.is_empty() && version.chars().all(|c| c.is_ascii_digit())
    });
    // Minari's pattern wants two characters at least.
    versioned && namespace.is_none_or(|space| space.len() >= 2 && space.split('/').all(is_word))
}

/// Which columns are what.
struct Layout<'a> {
    spec: &'a RunSpec,
    observation: usize,
    action: usize,
    reward: usize,
    /// The others.
    infos: Vec<usize>,
}

impl<'a> Layout<'a> {
    fn new(path: &Path, spec: &'a RunSpec) -> Result<Self, ExportError> {
        let find = |name: &'static str, rows: Rows, needs| {
            let found = spec.column(name).filter(|&index| spec.columns[index].rows == rows);
            found.ok_or_else(|| ExportError::Column { path: path.to_owned(), column: name, needs })
        };
        let observation = find(columns::OBSERVATION, Rows::StepsPlusOne, "a row a step and one more")?;
        let action = find(columns::ACTION, Rows::Steps, "a row a step")?;
        let reward = find(columns::REWARD, Rows::Steps, "a row a step")?;
        let infos = (0..spec.columns.len()).filter(|index| ![observation, action, reward].contains(index));
        Ok(Self { spec, observation, action, reward, infos: infos.collect() })
    }

    fn column(&self, index: usize) -> &'a ColumnSpec {
        &self.spec.columns[index]
    }

    /// The fields of an episode's batch.
    fn fields(&self) -> Vec<Field> {
        let floats = |name: &str, index: usize| arrow::field(name, Kind::Floats(self.column(index).width));
        // Minari's own files note the shape of an info's rows: not needed with one dimension, and 0.5.0 misreads it.
        let info = |&index: &usize| floats(&self.column(index).name, index);
        let mut fields = vec![
            floats("observations", self.observation),
            floats("actions", self.action),
            arrow::field("rewards", Kind::Float),
            arrow::field("terminations", Kind::Bool),
            arrow::field("truncations", Kind::Bool),
        ];
        if !self.infos.is_empty() {
            fields.push(arrow::field("infos", Kind::Group(self.infos.iter().map(info).collect())));
        }
        fields
    }

    /// The values of an episode, in the order of the fields.
    fn batch(&self, episode: &Episode) -> io::Result<Batch> {
        let write = |index: usize| {
            move |out: &mut Vec<u8>| {
                episode.write_rows(index, self.column(index), out)?;
                episode.write_final_row(index, self.column(index), out)
            }
        };
        let last_step = episode.steps() - 1;
        let terminal = episode.last().terminal;
        let mut batch = Batch::new(episode.steps() + 1);
        batch.floats(self.column(self.observation).width, write(self.observation))?;
        batch.floats(self.column(self.action).width, write(self.action))?;
        batch.float(write(self.reward))?;
        batch.flag(terminal.then_some(last_step))?;
        batch.flag((!terminal).then_some(last_step))?;
        if !self.infos.is_empty() {
            batch.group();
        }
        for &index in &self.infos {
            batch.floats(self.column(index).width, write(index))?;
        }
        Ok(batch)
    }
}

/// A dataset that is being written.
struct Dataset<'a> {
    layout: Layout<'a>,
    fields: Vec<Field>,
    data: PathBuf,
    episodes: u64,
    bytes: u64,
    /// No action so far lies outside −1 … 1.
    squashed: bool,
}

impl<'a> Dataset<'a> {
    fn new(folder: &Path, layout: Layout<'a>) -> Result<Self, ExportError> {
        let data = folder.join("data");
        fs::create_dir(&data).map_err(ExportError::io("create", &data))?;
        let fields = layout.fields();
        Ok(Self { layout, fields, data, episodes: 0, bytes: 0, squashed: true })
    }

    fn push(&mut self, episode: &Episode) -> Result<(), ExportError> {
        let folder = self.data.join(self.episodes.to_string());
        fs::create_dir(&folder).map_err(ExportError::io("create", &folder))?;
        let batch = self.layout.batch(episode).map_err(ExportError::io("write", &folder))?;
        self.write(&folder.join("part-0.arrow"), &arrow::file(&self.fields, batch))?;
        let facts = describe(self.episodes, episode);
        self.write(&folder.join("metadata.json"), facts.to_string().as_bytes())?;
        let mut actions =
            episode.segments().iter().flat_map(|segment| columns::iter(&segment.columns[self.layout.action]));
        self.squashed = self.squashed && actions.all(|value| value.abs() <= 1.0);
        self.episodes += 1;
        Ok(())
    }

    fn finish(mut self, id: &DatasetId, exported: Exported) -> Result<(), ExportError> {
        let RunSpec { run, task, .. } = self.layout.spec;
        let version = env!("CARGO_PKG_VERSION");
        let width = |index: usize| self.layout.column(index).width;
        let facts = json!({
            "dataset_id": id.as_str(),
            "data_format": "arrow",
            "minari_version": MINARI_VERSION,
            "observation_space": box_space(width(self.layout.observation), None),
            "action_space": box_space(width(self.layout.action), self.squashed.then_some(1)),
            "total_episodes": exported.episodes,
            "total_steps": exported.transitions,
            // In MB, as Minari rounds it.
            "dataset_size": (self.bytes as f64 / 1e5).round() / 10.0,
            "description": format!("Replay of run `{run}`, task `{task}`, exported by getup {version}"),
        });
        self.write(&self.data.join("metadata.json"), facts.to_string().as_bytes())
    }

    fn write(&mut self, path: &Path, bytes: &[u8]) -> Result<(), ExportError> {
        self.bytes += bytes.len() as u64;
        fs::write(path, bytes).map_err(ExportError::io("write", path))
    }
}

/// Where an episode comes from, and how it ended.
fn describe(id: u64, episode: &Episode) -> serde_json::Value {
    let (first, last) = (episode.first(), episode.last());
    let mut facts = json!({
        "id": id,
        "total_steps": episode.steps(),
        "writer": first.writer,
        "lane": first.lane,
        "episode": first.episode,
        "stage": first.stage,
        "first_step": first.first_step,
        "first_version": first.first_version.to_string(),
        "last_version": last.last_version.to_string(),
        "finished": episode.is_finished(),
    });
    if let Some(end) = &last.end {
        facts["episode_return"] = end.episode_return.into();
        facts["env_steps"] = end.env_steps.into();
        facts["reason"] = end.reason.as_str().into();
        facts["tags"] = json!(end.tags);
    }
    facts
}

/// A Gymnasium box of so many `float32` between −`bound` and `bound`, as Minari serialises it: in Python's JSON,
/// which has infinities.
fn box_space(width: usize, bound: Option<u32>) -> String {
    let high = bound.map_or("Infinity".to_owned(), |bound| format!("{bound}.0"));
    let low = vec![format!("-{high}"); width].join(", ");
    let high = vec![high; width].join(", ");
    format!(r#"{{"type": "Box", "dtype": "float32", "shape": [{width}], "low": [{low}], "high": [{high}]}}"#)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::{self, Ending, Part};
    use serde_json::Value;

    #[test]
    fn a_dataset_is_named_after_its_folder_and_namespace() {
        let id = |path: &str, root: Option<&str>| {
            DatasetId::of_folder(Path::new(path), root.map(Path::new)).map(|id| id.to_string())
        };
        assert_eq!(id("out/getup-v0", None).unwrap(), "getup-v0");
        assert_eq!(id("/sets/getup-v0", Some("/sets")).unwrap(), "getup-v0");
        assert_eq!(id("/sets/getup/strong-v12", Some("/sets/")).unwrap(), "getup/strong-v12");
        assert_eq!(id("/elsewhere/getup/strong-v12", Some("/sets")).unwrap(), "strong-v12");
        assert_eq!(id("sets/up/a_b-v0-v1", Some("sets")).unwrap(), "up/a_b-v0-v1");
        for refused in ["getup", "getup-v", "-v0", "getup-vx", "get.up-v0", "get up-v0", "getup-v0.npz", ".."]
        {
            assert!(matches!(id(refused, None), Err(ExportError::DatasetId { .. })), "{refused}");
        }
        assert!(id("/sets/a/getup-v0", Some("/sets")).is_err(), "a namespace of one character");
        assert!(id("/sets", Some("/sets")).is_err(), "the root itself");
    }

    #[test]
    fn a_box_is_serialised_as_python_writes_it() {
        let expected =
            r#"{"type": "Box", "dtype": "float32", "shape": [2], "low": [-1.0, -1.0], "high": [1.0, 1.0]}"#;
        assert_eq!(box_space(2, Some(1)), expected);
        assert!(box_space(1, None).ends_with(r#""low": [-Infinity], "high": [Infinity]}"#));
    }

    #[test]
    fn a_spec_without_what_minari_needs_is_refused() {
        let path = Path::new("x-v0");
        let refused = |change: &dyn Fn(&mut RunSpec)| {
            let mut spec = fixtures::spec(4);
            change(&mut spec);
            match Layout::new(path, &spec).err() {
                Some(ExportError::Column { column, .. }) => column,
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(refused(&|spec| spec.columns[0].rows = Rows::Steps), "observation");
        assert_eq!(refused(&|spec| spec.columns[1].rows = Rows::Once), "action");
        assert_eq!(refused(&|spec| spec.columns[2].name = "gain".to_owned()), "reward");
    }

    fn json(path: PathBuf) -> Value {
        serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
    }

    /// Exports the segments and returns the folder, and what the dataset says of itself.
    fn export(spec: &RunSpec, segments: Vec<Segment>) -> (tempfile::TempDir, Value) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x-v0");
        let id = DatasetId::of_folder(&path, None).unwrap();
        export_minari(&path, &id, spec, segments.into_iter().map(Ok), |_| ()).unwrap();
        let facts = json(path.join("data/metadata.json"));
        (folder, facts)
    }

    #[test]
    fn a_dataset_says_what_it_is_and_where_its_episodes_come_from() {
        let spec = fixtures::spec(4);
        let part = |lane, first_step, ending| Part {
            writer: u64::MAX,
            sequence: 1,
            lane,
            episode: 3,
            first_step,
            steps: 4,
            ending,
        };
        let segments = vec![part(0, 8, Ending::None).build(&spec), part(1, 0, Ending::Terminal).build(&spec)];
        let (folder, facts) = export(&spec, segments);
        assert_eq!((&facts["dataset_id"], &facts["data_format"]), (&json!("x-v0"), &json!("arrow")));
        assert_eq!((&facts["total_episodes"], &facts["total_steps"]), (&json!(2), &json!(8)));
        let data = folder.path().join("x-v0/data");
        let finished = json(data.join("0/metadata.json"));
        assert_eq!((&finished["finished"], &finished["reason"]), (&json!(true), &json!("terminal")));
        assert_eq!(finished["writer"], json!(u64::MAX));
        let cut = json(data.join("1/metadata.json"));
        assert_eq!((&cut["finished"], &cut["first_step"], &cut["id"]), (&json!(false), &json!(8), &json!(1)));
        assert_eq!(cut.get("reason"), None);
    }

    #[test]
    fn the_action_space_is_bounded_if_the_actions_are() {
        let spec = fixtures::spec(4);
        let mut segment = fixtures::segment(&spec, 1, 1, 4);
        let (_folder, facts) = export(&spec, vec![segment.clone()]);
        assert_eq!(facts["action_space"], json!(box_space(2, Some(1))));
        segment.columns[1] = columns::encode(&[1.0, -1.0, 0.0, 0.5, -1.25, 0.0, 0.0, 0.0]);
        let (_folder, facts) = export(&spec, vec![segment]);
        assert_eq!(facts["action_space"], json!(box_space(2, None)));
        assert_eq!(facts["observation_space"], json!(box_space(3, None)));
    }
}
