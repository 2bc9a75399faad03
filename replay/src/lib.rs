//! Replay.

mod config;
mod error;
mod gate;
mod gather;
mod limiter;
mod log;
mod metrics;
mod minibatch;
mod ring;
mod sampler;
mod source;
mod store;

#[cfg(test)]
#[path = "../tests/fixtures/mod.rs"]
mod fixtures;

pub use config::{ConfigError, MAX_CAPACITY, ReplayConfig, Sync};
pub use error::StoreError;
pub use metrics::ReplayMetrics;
pub use minibatch::{MAX_N_STEP, Minibatch, MinibatchColumn, OptionsError, ReplayCounters, SampleOptions};
pub use sampler::Sampler;
pub use source::{LocalSource, MinibatchSource, SampleError};
pub use store::Store;
