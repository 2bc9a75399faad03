//! The policy of a character: a squashed Gaussian network, as a value, as a file, and as a forward pass.
//!
//! Actors act with it and learners train it, so it knows neither: no simulation, no libtorch, no network.
//!
//! - [`PolicyShape`] says what the network looks like and names every tensor of it;
//! - [`Policy`] is a shape with its weights, observation statistics and metadata; [`Policy::load`] and
//!   [`Policy::to_bytes`] are its file, safetensors that any framework reads;
//! - [`Forward`] evaluates it on a batch of observations;
//! - [`squash`] turns a Gaussian sample into an action in `[-β̂, β̂]` (*Learning to Get Up*, App. D);
//! - [`init`] draws initial weights.

mod file;
mod forward;
pub mod init;
mod layer;
mod shape;
mod statistics;

pub use file::{MeanError, ModelError, Policy};
pub use forward::{Forward, Heads, squash};
pub use shape::{Body, LOG_STD_MAX, LOG_STD_MIN, NORM_EPSILON, PolicyShape};
pub use statistics::ObservationStatistics;
