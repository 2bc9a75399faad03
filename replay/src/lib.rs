//! Replay.

mod config;
mod error;
mod gate;
mod gather;
mod limiter;
mod log;
mod metrics;
mod minibatch;
mod remote;
mod ring;
mod sampler;
mod service;
mod source;
mod store;

#[cfg(test)]
#[path = "../tests/fixtures/mod.rs"]
mod fixtures;

pub use config::{ConfigError, MAX_CAPACITY, ReplayConfig, SyncMode};
pub use error::StoreError;
pub use metrics::ReplayMetrics;
pub use minibatch::{MAX_N_STEP, Minibatch, MinibatchColumn, OptionsError, ReplayCounters, SampleOptions};
pub use remote::{RemoteOptions, RemoteSource, describe};
pub use sampler::Sampler;
pub use service::{ServeError, serve};
pub use source::{LocalSource, MinibatchSource, SampleError};
pub use store::Store;
