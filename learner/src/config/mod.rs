//! The settings of training. Defaults are *Learning to Get Up*, Table 1.

mod curriculum;
mod process;
mod sac;

pub use curriculum::{CurriculumConfig, EvaluationConfig};
pub use process::{Device, LearnerConfig};
pub use sac::{Auto, NetworkKind, Precision, SacConfig, TargetEntropy};

/// A setting that cannot be used: which, its value, and what it may be.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{key} = {value}: {wanted}")]
pub struct ConfigError {
    /// The setting's name, as in the configuration file.
    pub key: &'static str,
    /// What it is set to.
    pub value: String,
    /// What it may be.
    pub wanted: &'static str,
}

fn check(
    good: bool,
    key: &'static str,
    value: &dyn ToString,
    wanted: &'static str,
) -> Result<(), ConfigError> {
    if good { Ok(()) } else { Err(ConfigError { key, value: value.to_string(), wanted }) }
}
