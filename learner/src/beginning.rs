//! What a new run may begin with: the actor of another run, from its checkpoint or from a model file.

use std::path::Path;

use getup_policy::{ModelError, Policy};
use tch::Device;

use crate::checkpoint::{Checkpoint, CheckpointError};
use crate::config::SacConfig;
use crate::sac::{Sac, TaskShape};

/// A trained actor, and what else its file holds.
#[derive(Clone, Debug)]
pub enum Beginning {
    /// A checkpoint: the actor with its optimizer and temperature, and its critics.
    Checkpoint(Box<Checkpoint>),
    /// A model file: the actor alone.
    Model(Box<Policy>),
}

impl Beginning {
    /// Reads either; what is neither is refused as the checkpoint that it is not.
    pub fn load(path: &Path) -> Result<Self, CheckpointError> {
        match Policy::load(path) {
            Ok(policy) => Ok(Self::Model(Box::new(policy))),
            Err(error @ (ModelError::Tensor { .. } | ModelError::Version { .. })) => {
                Err(CheckpointError::Model { path: path.to_owned(), source: error })
            }
            Err(ModelError::Io { .. } | ModelError::Format(_)) => {
                Ok(Self::Checkpoint(Box::new(Checkpoint::load(path)?)))
            }
        }
    }

    /// Refuses what does not fit a run of this configuration.
    ///
    /// # Errors
    /// As a run that begins with it.
    pub fn check(&self, shape: &TaskShape, config: &SacConfig) -> Result<(), CheckpointError> {
        self.begin(&mut Sac::new(shape, config, 0, Device::Cpu, 1))
    }

    /// Puts it into the untrained `sac`, whose configuration decides what fits.
    pub(crate) fn begin(&self, sac: &mut Sac) -> Result<(), CheckpointError> {
        match self {
            Self::Checkpoint(checkpoint) => checkpoint.begin(sac),
            Self::Model(policy) => Ok(sac.begin_with(policy)?),
        }
    }
}
