//! Checkpoints: everything that a resumed learner needs to go on bit for bit, given the same minibatches.
//!
//! The file is safetensors: the flat buffers of actor, critics and targets with Adam's moments, and one metadata
//! key `getup` with the rest as JSON. The replay is not part of it: it has its own store.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use getup_policy::ModelError;
use rand_chacha::ChaCha8Rng;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use tch::Tensor;

use crate::adam::ScalarAdam;
use crate::curriculum::Curriculum;
use crate::parameters::to_vec;
use crate::run_folder::{FolderError, remove_unfinished, write_atomically};
use crate::sac::{ActorMismatch, Sac};
use crate::statistics::RunningStatistics;

/// The buffer of the actor's average, which not every run has.
const AVERAGE: &str = "actor.average";

const FORMAT: &str = "getup-checkpoint";
/// The version of the file's format that this program writes, and the newest it reads.
const VERSION: u32 = 2;

/// Why a checkpoint cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The folder cannot be read or written.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The file cannot be read.
    #[error("cannot read the checkpoint {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file is damaged, or not a checkpoint.
    #[error(
        "the checkpoint {path} is not usable: {problem}; checkpoints are files of runs/<name>/checkpoints/, and one \
         that is damaged is moved away to resume the one before it"
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// The file was written by a newer program.
    #[error(
        "the checkpoint {path} has format version {found}, this program reads up to {VERSION}: update getup"
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: u64,
    },
    /// A model file that a run was to begin with.
    #[error("cannot begin with the model {path}")]
    Model {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: ModelError,
    },
    /// Its actor is not like the configured one.
    #[error(transparent)]
    Actor(#[from] ActorMismatch),
    /// The networks of the configuration have another shape.
    #[error(
        "tensor {name:?} of the checkpoint has {found} numbers, the configured networks have {wanted}: resume \
         with the run's own configuration, or begin with an actor of the configured shape"
    )]
    Shape {
        /// The buffer.
        name: String,
        /// Its length in the file.
        found: usize,
        /// Its length in the configured networks.
        wanted: usize,
    },
}

/// Where the run stands, beside the networks.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Env steps of the run.
    pub env_steps: u64,
    /// What of them was counted in which replay store, by the store's name.
    pub stores: BTreeMap<u64, u64>,
    /// Env steps at which the next evaluation is due.
    pub next_evaluation: u64,
    /// Whether one was offered and is not reported: a resumed learner offers it again.
    pub evaluation_owed: bool,
}

/// A checkpoint in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    tensors: BTreeMap<String, Vec<f32>>,
    scalars: Scalars,
    /// The curriculum's state.
    pub curriculum: Curriculum,
    /// Where the run stands.
    pub progress: Progress,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Scalars {
    updates: u64,
    /// See [`Sac::is_trained`].
    #[serde(default)]
    began_trained: bool,
    actor_steps: u64,
    critics_steps: u64,
    log_temperature: f64,
    temperature_adam: ScalarAdam,
    statistics: RunningStatistics,
    /// Whether the networks read observations that the statistics normalise; unknown of a file that does not say it.
    #[serde(default)]
    normalizes: Option<bool>,
    rng: ChaCha8Rng,
}

#[derive(Serialize, Deserialize)]
struct Header {
    format: String,
    version: u32,
    scalars: Scalars,
    curriculum: Curriculum,
    progress: Progress,
}

/// The flat buffers by name.
fn buffers(sac: &Sac) -> [(&'static str, &Tensor); 7] {
    [
        ("actor", sac.actor.parameters.flat()),
        ("actor.first_moment", &sac.actor_adam.first),
        ("actor.second_moment", &sac.actor_adam.second),
        ("critics", sac.critics.parameters.flat()),
        ("critics.first_moment", &sac.critics_adam.first),
        ("critics.second_moment", &sac.critics_adam.second),
        ("targets", sac.targets.parameters.flat()),
    ]
}

impl Checkpoint {
    /// Copies the state of training; the copy is the caller's to write while training goes on.
    pub fn take(sac: &Sac, curriculum: &Curriculum, progress: &Progress) -> Self {
        let average = sac.average.iter().map(|average| (AVERAGE, average));
        let buffers = buffers(sac).into_iter().chain(average);
        let tensors = buffers.map(|(name, tensor)| (name.to_owned(), to_vec(tensor))).collect();
        let scalars = Scalars {
            updates: sac.updates,
            began_trained: sac.began_trained,
            actor_steps: sac.actor_adam.steps,
            critics_steps: sac.critics_adam.steps,
            log_temperature: sac.log_temperature,
            temperature_adam: sac.temperature_adam.clone(),
            statistics: sac.statistics.clone(),
            normalizes: Some(sac.config.normalize_observations),
            rng: sac.rng.clone(),
        };
        Self { tensors, scalars, curriculum: curriculum.clone(), progress: progress.clone() }
    }

    /// Puts the networks' state into `sac`, which has the same configuration.
    pub fn restore(&self, sac: &mut Sac) -> Result<(), CheckpointError> {
        self.put(sac, |_| true)?;
        if let (Some(average), Some(values)) = (&mut sac.average, self.tensors.get(AVERAGE)) {
            tch::no_grad(|| average.copy_(&Tensor::from_slice(values)));
        }
        sac.critics_adam.steps = self.scalars.critics_steps;
        sac.updates = self.scalars.updates;
        sac.began_trained = self.scalars.began_trained;
        sac.rng = self.scalars.rng.clone();
        Ok(())
    }

    /// Lets `sac`, whose run is another, begin with this actor, its temperature and its observations' statistics; and
    /// with these critics, where `sac` has such.
    pub fn begin(&self, sac: &mut Sac) -> Result<(), CheckpointError> {
        let same = self.tensors["critics"].len() == sac.critics.parameters.flat().numel();
        self.put(sac, |name| same || name.starts_with("actor"))?;
        sac.began_trained = true;
        if same {
            sac.critics_adam.steps = self.scalars.critics_steps;
        } else {
            tracing::info!(
                "the checkpoint's critics have another shape than the configured: they begin untrained"
            );
        }
        Ok(())
    }

    /// Puts what both have in common: the buffers that `wanted` names, temperature, statistics, the actor's steps.
    fn put(&self, sac: &mut Sac, wanted: impl Fn(&str) -> bool) -> Result<(), CheckpointError> {
        let buffers: Vec<_> = buffers(sac).into_iter().filter(|(name, _)| wanted(name)).collect();
        for (name, tensor) in &buffers {
            let (found, wanted) = (self.tensors[*name].len(), tensor.numel());
            if found != wanted {
                return Err(CheckpointError::Shape { name: (*name).into(), found, wanted });
            }
        }
        if let Some(normalizes) = self.scalars.normalizes {
            sac.check_normalizes("checkpoint", normalizes)?;
        }
        let _guard = tch::no_grad_guard();
        for (name, tensor) in buffers {
            tensor.shallow_clone().copy_(&Tensor::from_slice(&self.tensors[name]));
        }
        let scalars = self.scalars.clone();
        let learning_rate = sac.temperature_adam.learning_rate;
        sac.temperature_adam = scalars.temperature_adam;
        sac.temperature_adam.learning_rate = learning_rate;
        sac.actor_adam.steps = scalars.actor_steps;
        sac.log_temperature = scalars.log_temperature;
        sac.statistics = scalars.statistics;
        sac.changed();
        Ok(())
    }

    /// The file's name: checkpoints sort by env steps and updates.
    pub fn file_name(&self) -> String {
        format!("step-{:012}-{:012}.safetensors", self.progress.env_steps, self.scalars.updates)
    }

    /// Writes the checkpoint into `folder` and removes all but `kept`: it, and the newest others.
    pub fn save(&self, folder: &Path, kept: usize) -> Result<PathBuf, CheckpointError> {
        remove_unfinished(folder)?;
        let path = folder.join(self.file_name());
        write_atomically(&path, &self.to_bytes())?;
        // Not this one, whatever else is there: files from before a resumption may have later names.
        let others = list(folder)?.into_iter().filter(|other| *other != path);
        for old in others.rev().skip(kept.max(1) - 1) {
            fs::remove_file(&old).map_err(|source| CheckpointError::Io { path: old, source })?;
        }
        Ok(path)
    }

    /// The newest checkpoint of `folder` that can be read; a damaged one is passed over with a warning. None
    /// where there is none.
    pub fn newest(folder: &Path) -> Result<Option<Self>, CheckpointError> {
        let mut first_error = None;
        for path in list(folder)?.into_iter().rev() {
            match Self::load(&path) {
                Ok(checkpoint) => return Ok(Some(checkpoint)),
                // Not damaged: going back behind it would lose what it holds.
                Err(error @ CheckpointError::Version { .. }) => return Err(error),
                Err(error) => {
                    tracing::warn!(%error, "checkpoint passed over");
                    first_error.get_or_insert(error);
                }
            }
        }
        first_error.map_or(Ok(None), Err)
    }

    /// Reads one file.
    pub fn load(path: &Path) -> Result<Self, CheckpointError> {
        let bytes = fs::read(path).map_err(|source| CheckpointError::Io { path: path.to_owned(), source })?;
        Self::from_bytes(&bytes, path)
    }

    fn to_bytes(&self) -> Vec<u8> {
        let header = Header {
            format: FORMAT.into(),
            version: VERSION,
            scalars: self.scalars.clone(),
            curriculum: self.curriculum.clone(),
            progress: self.progress.clone(),
        };
        let header = serde_json::to_string(&header).expect("a header of numbers is JSON");
        let data: Vec<(&str, Vec<u8>)> = self
            .tensors
            .iter()
            .map(|(name, values)| {
                (name.as_str(), values.iter().flat_map(|value| value.to_le_bytes()).collect())
            })
            .collect();
        let views = data.iter().map(|(name, bytes)| {
            let view = TensorView::new(Dtype::F32, vec![bytes.len() / 4], bytes);
            (*name, view.expect("a flat buffer of float32"))
        });
        safetensors::serialize(views, Some([("getup".to_owned(), header)].into()))
            .expect("named float32 buffers are serialisable")
    }

    fn from_bytes(bytes: &[u8], path: &Path) -> Result<Self, CheckpointError> {
        let damaged = |problem: String| CheckpointError::Damaged { path: path.to_owned(), problem };
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|error| damaged(error.to_string()))?;
        let file = SafeTensors::deserialize(bytes).map_err(|error| damaged(error.to_string()))?;
        let header = metadata.metadata().as_ref().and_then(|map| map.get("getup"));
        let header = header.ok_or_else(|| damaged("its metadata has no key \"getup\"".into()))?;
        let mut header: serde_json::Value =
            serde_json::from_str(header).map_err(|error| damaged(error.to_string()))?;
        if header["format"] != FORMAT {
            return Err(damaged(format!("its format is {}, not {FORMAT:?}", header["format"])));
        }
        match header["version"].as_u64() {
            Some(version) if version <= u64::from(VERSION) => {}
            Some(found) => return Err(CheckpointError::Version { path: path.to_owned(), found }),
            None => return Err(damaged("it names no version".into())),
        }
        bring_up_to_date(&mut header["progress"]);
        let header: Header = serde_json::from_value(header).map_err(|error| damaged(error.to_string()))?;
        let mut tensors = BTreeMap::new();
        for name in ["actor", "critics"].iter().flat_map(|network| {
            ["", ".first_moment", ".second_moment"].map(|part| format!("{network}{part}"))
        }) {
            tensors.insert(name.clone(), read_buffer(&file, &name).map_err(damaged)?);
        }
        tensors.insert("targets".into(), read_buffer(&file, "targets").map_err(damaged)?);
        if file.names().contains(&AVERAGE) {
            let average = read_buffer(&file, AVERAGE).map_err(damaged)?;
            if average.len() != tensors["actor"].len() {
                return Err(damaged(format!("{AVERAGE:?} is not as long as \"actor\"")));
            }
            tensors.insert(AVERAGE.into(), average);
        }
        let Header { scalars, curriculum, progress, .. } = header;
        Ok(Self { tensors, scalars, curriculum, progress })
    }
}

/// Version 1 knew one store.
fn bring_up_to_date(progress: &mut serde_json::Value) {
    let Some(fields) = progress.as_object_mut() else { return };
    if let (Some(store), Some(env_steps)) = (fields.remove("store"), fields.remove("store_env_steps")) {
        fields.insert("stores".into(), serde_json::json!({ store.to_string(): env_steps }));
    }
}

fn read_buffer(file: &SafeTensors<'_>, name: &str) -> Result<Vec<f32>, String> {
    let tensor = file.tensor(name).map_err(|_| format!("tensor {name:?} is missing"))?;
    if tensor.dtype() != Dtype::F32 {
        return Err(format!("tensor {name:?} is {:?}, not F32", tensor.dtype()));
    }
    let bytes = tensor.data().chunks_exact(4);
    let values = bytes.map(|bytes| f32::from_le_bytes(bytes.try_into().expect("chunks of four")));
    let values: Vec<f32> = values.collect();
    match values.iter().find(|value| !value.is_finite()) {
        Some(value) => Err(format!("tensor {name:?} holds {value}")),
        None => Ok(values),
    }
}

/// Checkpoint files, oldest first.
fn list(folder: &Path) -> Result<Vec<PathBuf>, CheckpointError> {
    let fault = |source| CheckpointError::Io { path: folder.to_owned(), source };
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).map_err(fault)? {
        let path = entry.map_err(fault)?.path();
        if path.extension().is_some_and(|extension| extension == "safetensors") {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{CurriculumConfig, SacConfig};
    use crate::sac::{Batch, TaskShape};
    use rand::{Rng, SeedableRng};
    use tch::Device;

    fn batch(index: u64, shape: &TaskShape) -> Batch {
        let mut rng = ChaCha8Rng::seed_from_u64(index);
        let mut column = |width: usize, low: f32, high: f32| -> Vec<f32> {
            (0..32 * width).map(|_| rng.random_range(low..high)).collect()
        };
        Batch {
            observation: column(shape.observation, -1.0, 1.0),
            next_observation: column(shape.observation, -1.0, 1.0),
            action: column(shape.action, -0.3, 0.3),
            reward: column(1, -1.0, 1.0),
            discount: column(1, 0.0, 0.97),
            beta: column(1, 0.5, 1.0),
            weight: Vec::new(),
        }
    }

    fn train(sac: &mut Sac, shape: &TaskShape, from: u64, to: u64) {
        for index in from..to {
            let batch = batch(index, shape);
            sac.merge_statistics(&batch);
            sac.update(&batch).unwrap();
        }
    }

    #[test]
    fn the_progress_of_version_1_is_read() {
        let mut progress = serde_json::json!({
            "env_steps": 1300, "store": 7, "store_env_steps": 1200, "next_evaluation": 20_000, "evaluation_owed": false
        });
        bring_up_to_date(&mut progress);
        let progress: Progress = serde_json::from_value(progress).unwrap();
        assert_eq!((progress.env_steps, progress.stores), (1300, [(7, 1200)].into()));
    }

    #[test]
    fn a_resumed_learner_is_bit_identical_given_the_same_minibatches() {
        let folder = tempfile::tempdir().unwrap();
        let shape = TaskShape { observation: 11, action: 4, unnormalized: vec![10] };
        let config = SacConfig {
            hidden: vec![32, 32],
            normalize_observations: true,
            actor_average: 0.1,
            ..SacConfig::default()
        };
        let curriculum = Curriculum::new(CurriculumConfig::default());
        let progress = Progress {
            env_steps: 1234,
            stores: [(7, 1200), (9, 34)].into(),
            next_evaluation: 20_000,
            evaluation_owed: true,
        };
        let mut sac = Sac::new(&shape, &config, 9, Device::Cpu, 1);
        train(&mut sac, &shape, 0, 50);
        Checkpoint::take(&sac, &curriculum, &progress).save(folder.path(), 3).unwrap();
        train(&mut sac, &shape, 50, 100);

        let loaded = Checkpoint::newest(folder.path()).unwrap().unwrap();
        assert_eq!((&loaded.curriculum, &loaded.progress), (&curriculum, &progress));
        let mut resumed = Sac::new(&shape, &config, 1, Device::Cpu, 1);
        loaded.restore(&mut resumed).unwrap();
        train(&mut resumed, &shape, 50, 100);
        let end = |sac: &Sac| Checkpoint::take(sac, &curriculum, &progress);
        assert_eq!(end(&resumed), end(&sac));
        assert_eq!(resumed.evaluated_policy(), sac.evaluated_policy());
        assert_eq!(end(&resumed).to_bytes(), end(&sac).to_bytes());
    }

    #[test]
    fn the_newest_good_checkpoint_is_taken_and_old_ones_go() {
        let folder = tempfile::tempdir().unwrap();
        let shape = TaskShape { observation: 2, action: 1, unnormalized: vec![] };
        let config = SacConfig { hidden: vec![4], ..SacConfig::default() };
        let sac = Sac::new(&shape, &config, 0, Device::Cpu, 1);
        let curriculum = Curriculum::new(CurriculumConfig::default());
        let mut newest = PathBuf::new();
        for env_steps in [5, 10, 100_000, 20] {
            let progress = Progress { env_steps, ..Progress::default() };
            let path = Checkpoint::take(&sac, &curriculum, &progress).save(folder.path(), 3).unwrap();
            if env_steps == 100_000 {
                newest = path;
            }
        }
        assert_eq!(list(folder.path()).unwrap().len(), 3);
        assert_eq!(Checkpoint::newest(folder.path()).unwrap().unwrap().progress.env_steps, 100_000);
        let bytes = fs::read(&newest).unwrap();
        fs::write(&newest, &bytes[..bytes.len() / 2]).unwrap();
        assert_eq!(Checkpoint::newest(folder.path()).unwrap().unwrap().progress.env_steps, 20);
        let mut spoiled = Checkpoint::newest(folder.path()).unwrap().unwrap();
        spoiled.progress.env_steps = 21;
        spoiled.tensors.get_mut("actor").unwrap()[3] = f32::NAN;
        let path = spoiled.save(folder.path(), 3).unwrap();
        assert!(Checkpoint::load(&path).unwrap_err().to_string().contains("\"actor\" holds NaN"));
        assert_eq!(Checkpoint::newest(folder.path()).unwrap().unwrap().progress.env_steps, 20);
        // Later names that cannot be read do not push out what is written now.
        spoiled.tensors.get_mut("actor").unwrap()[3] = 0.0;
        spoiled.progress.env_steps = 15;
        let path = spoiled.save(folder.path(), 1).unwrap();
        assert_eq!(list(folder.path()).unwrap(), [path]);
        let wider = SacConfig { hidden: vec![5], ..SacConfig::default() };
        let mut other = Sac::new(&shape, &wider, 0, Device::Cpu, 1);
        let error = Checkpoint::newest(folder.path()).unwrap().unwrap().restore(&mut other).unwrap_err();
        assert!(matches!(error, CheckpointError::Shape { .. }), "{error}");
        // What changes no length changes what the networks read.
        let normalized = SacConfig { normalize_observations: true, ..config };
        let mut other = Sac::new(&shape, &normalized, 0, Device::Cpu, 1);
        let error = Checkpoint::newest(folder.path()).unwrap().unwrap().restore(&mut other).unwrap_err();
        let said = "the checkpoint's observations: as they are; the configuration's: normalised";
        assert!(error.to_string().starts_with(said), "{error}");
    }
}
