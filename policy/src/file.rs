//! A policy with its weights, and its file.
//!
//! The file is safetensors. Each layer gives `<name>.weight` (`[outputs, inputs]`) and `<name>.bias`, float32;
//! normalised observations add `observation.mean` and `observation.std`. The metadata has one key, `getup`, a
//! JSON object: `format`, `version`, `shape`, `clip`, and whatever its maker adds (`beta`, `character`, `run`…).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rand::Rng;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use crate::init::orthogonal;
use crate::{ObservationStatistics, PolicyShape};

const FORMAT: &str = "getup-policy";
/// The version of the file's format that this program writes, and the newest it reads.
const VERSION: u32 = 1;

/// Why a model cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The file cannot be read or written.
    #[error("cannot access the model {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The bytes are not a model of this project.
    #[error("not a getup model: {0}; models are written by `getup train` into runs/<name>/models/")]
    Format(String),
    /// It was written by a newer program.
    #[error("the model has format version {found}, this program reads up to {VERSION}: update getup")]
    Version {
        /// The file's version.
        found: u64,
    },
    /// A tensor is missing, misshapen or not finite.
    #[error("tensor {name:?} of the model: {problem}")]
    Tensor {
        /// The tensor's name in the file.
        name: String,
        /// What is wrong with it.
        problem: String,
    },
}

/// Why policies have no mean.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MeanError {
    /// There are none.
    #[error("no policies")]
    None,
    /// Weights of one place mean different things.
    #[error("policy {index} has another {what} than the first: only policies of one ancestor have a mean")]
    Differs {
        /// Which of them, from 0.
        index: usize,
        /// What is different.
        what: &'static str,
    },
}

/// A squashed Gaussian policy: everything that is needed to act.
#[derive(Clone, Debug, PartialEq)]
pub struct Policy {
    /// The network's shape.
    pub shape: PolicyShape,
    /// Weights by tensor name, row-major; the names and shapes are [`PolicyShape::tensors`].
    pub tensors: BTreeMap<String, Vec<f32>>,
    /// How observations are normalised before the first layer; none where they are not.
    pub statistics: Option<ObservationStatistics>,
    /// What its maker says of it: `beta`, `character`, `run`, `env_steps`…
    pub metadata: BTreeMap<String, String>,
}

#[derive(Serialize, Deserialize)]
struct Header {
    format: String,
    version: u32,
    shape: PolicyShape,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    clip: Option<f32>,
    #[serde(default)]
    metadata: BTreeMap<String, String>,
}

impl Policy {
    /// An untrained policy: zero biases, and orthogonal weights with gain 1 (App. D); a residual body's blocks and heads as
    /// SimBa has them.
    pub fn init(shape: PolicyShape, rng: &mut impl Rng) -> Self {
        let mut tensors = BTreeMap::new();
        for (name, _, values) in crate::init::body(&shape.body, shape.observation, rng) {
            tensors.insert(name, values);
        }
        let width = shape.body.output_width(shape.observation);
        let gain = if matches!(shape.body, crate::Body::Mlp { .. }) { 1.0 } else { 0.01 };
        for head in ["head.mean", "head.log_std"] {
            tensors.insert(format!("{head}.weight"), orthogonal(shape.action, width, gain, rng));
            tensors.insert(format!("{head}.bias"), vec![0.0; shape.action]);
        }
        Self { shape, tensors, statistics: None, metadata: BTreeMap::new() }
    }

    /// A weight or bias by its name; every name of [`PolicyShape::tensors`] is there.
    pub fn tensor(&self, name: &str) -> &[f32] {
        &self.tensors[name]
    }

    /// A number of the metadata, such as `beta`.
    pub fn number(&self, key: &str) -> Option<f64> {
        self.metadata.get(key)?.parse().ok()
    }

    /// The file's bytes; equal policies give equal bytes.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut data: Vec<(String, Vec<usize>, Vec<u8>)> = self
            .shape
            .tensors()
            .into_iter()
            .map(|(name, shape)| {
                let bytes = little_endian(self.tensor(&name));
                (name, shape, bytes)
            })
            .collect();
        if let Some(statistics) = &self.statistics {
            for (name, values) in [("mean", &statistics.mean), ("std", &statistics.std)] {
                data.push((format!("observation.{name}"), vec![values.len()], little_endian(values)));
            }
        }
        let header = Header {
            format: FORMAT.into(),
            version: VERSION,
            shape: self.shape.clone(),
            clip: self.statistics.as_ref().map(|statistics| statistics.clip),
            metadata: self.metadata.clone(),
        };
        let header = serde_json::to_string(&header).expect("a header of strings and numbers is JSON");
        let views = data.iter().map(|(name, shape, bytes)| {
            let view = TensorView::new(Dtype::F32, shape.clone(), bytes);
            (name.as_str(), view.expect("shapes and bytes come from the same policy"))
        });
        safetensors::serialize(views, Some([("getup".to_owned(), header)].into()))
            .expect("named float32 tensors are serialisable")
    }

    /// Reads [`Policy::to_bytes`], and checks every tensor's shape and that every number is finite.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, ModelError> {
        let format = |error: &dyn std::fmt::Display| ModelError::Format(error.to_string());
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|error| format(&error))?;
        let file = SafeTensors::deserialize(bytes).map_err(|error| format(&error))?;
        let header = metadata.metadata().as_ref().and_then(|map| map.get("getup"));
        let header = header.ok_or_else(|| format(&"its metadata has no key \"getup\""))?;
        let header: serde_json::Value = serde_json::from_str(header).map_err(|error| format(&error))?;
        if header["format"] != FORMAT {
            return Err(format(&format!("its format is {}, not {FORMAT:?}", header["format"])));
        }
        match header["version"].as_u64() {
            Some(version) if version <= u64::from(VERSION) => {}
            Some(version) => return Err(ModelError::Version { found: version }),
            None => return Err(format(&"it names no version")),
        }
        let header: Header = serde_json::from_value(header).map_err(|error| format(&error))?;
        if let Some(fault) = header.shape.fault() {
            return Err(format(&fault));
        }
        if let Some(clip) = header.clip.filter(|clip| clip.is_nan() || *clip <= 0.0) {
            return Err(format(&format!("its clip is {clip}, not over 0")));
        }
        let mut tensors = BTreeMap::new();
        for (name, shape) in header.shape.tensors() {
            tensors.insert(name.clone(), read_tensor(&file, &name, &shape)?);
        }
        let statistics = match header.clip {
            Some(clip) => Some(read_statistics(&file, header.shape.observation, clip)?),
            None => None,
        };
        Ok(Self { shape: header.shape, tensors, statistics, metadata: header.metadata })
    }

    /// The mean of the weights of policies that learned from a common ancestor, weight by weight; better than each where
    /// they have not gone far apart (Wortsman et al. 2022). Metadata is the first's.
    ///
    /// # Errors
    /// What one of them has otherwise than the first, by its index: its shape, or what normalises its observations.
    pub fn mean(policies: &[Self]) -> Result<Self, MeanError> {
        let Some((first, others)) = policies.split_first() else { return Err(MeanError::None) };
        let mut mean = first.clone();
        for (index, other) in (1..).zip(others) {
            if other.shape != first.shape {
                return Err(MeanError::Differs { index, what: "shape" });
            }
            if other.statistics != first.statistics {
                return Err(MeanError::Differs { index, what: "observation statistics" });
            }
        }
        for (name, values) in &mut mean.tensors {
            for (place, value) in values.iter_mut().enumerate() {
                let sum: f64 = policies.iter().map(|policy| f64::from(policy.tensors[name][place])).sum();
                *value = (sum / policies.len() as f64) as f32;
            }
        }
        Ok(mean)
    }

    /// Reads a model file.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, ModelError> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|source| ModelError::Io { path: path.to_owned(), source })?;
        Self::from_bytes(&bytes)
    }
}

fn little_endian(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

fn read_statistics(
    file: &SafeTensors<'_>,
    width: usize,
    clip: f32,
) -> Result<ObservationStatistics, ModelError> {
    let mean = read_tensor(file, "observation.mean", &[width])?;
    let std = read_tensor(file, "observation.std", &[width])?;
    if std.iter().any(|value| *value <= 0.0) {
        let problem = "has a number that is not positive".to_owned();
        return Err(ModelError::Tensor { name: "observation.std".into(), problem });
    }
    Ok(ObservationStatistics { mean, std, clip })
}

fn read_tensor(file: &SafeTensors<'_>, name: &str, shape: &[usize]) -> Result<Vec<f32>, ModelError> {
    let fault = |problem: String| ModelError::Tensor { name: name.to_owned(), problem };
    let tensor = file.tensor(name).map_err(|_| fault("is missing".into()))?;
    if tensor.dtype() != Dtype::F32 || tensor.shape() != shape {
        return Err(fault(format!(
            "is {:?} {:?}, the shape in the metadata wants F32 {shape:?}",
            tensor.dtype(),
            tensor.shape()
        )));
    }
    let values: Vec<f32> = tensor
        .data()
        .chunks_exact(4)
        .map(|bytes| f32::from_le_bytes(bytes.try_into().expect("chunks of four bytes")))
        .collect();
    match values.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(fault(format!("element {index} is {}, not finite", values[index]))),
        None => Ok(values),
    }
}
