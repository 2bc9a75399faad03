//! The learner: soft actor-critic with the strong-to-weak torque curriculum.
//!
//! In the order in which a transition meets them:
//!
//! - [`config`]: the settings, with Table 1 of *Learning to Get Up* as defaults;
//! - `sac`: one update, read top to bottom like App. D, on `parameters` (flat buffers) with `adam`;
//! - `cpu`: the same update written out for processors, several times as fast;
//! - `trainer`: the loop that samples, updates, publishes, has policies evaluated and writes checkpoints;
//! - [`curriculum`]: an evaluation in, a decision out (§5, Algorithm 1);
//! - [`leases`]: which actor evaluates which policy;
//! - `hub`: what actors see of the learner: the newest policy, leases, and who is there; `service` is its gRPC;
//! - `checkpoint` and `run_folder`: what a run leaves on disk, and how it is resumed.
//!
//! Everything that needs libtorch is behind the feature `torch`; without it the settings, the state machines and
//! what actors see of a learner remain, for binaries that serve actors and the replay alone, and for simulations.

pub mod config;
pub mod curriculum;
pub mod leases;

#[cfg(feature = "torch")]
mod adam;
#[cfg(feature = "torch")]
pub mod beginning;
#[cfg(feature = "torch")]
pub mod checkpoint;
#[cfg(feature = "torch")]
mod cpu;
#[cfg(feature = "torch")]
pub mod device;
pub mod hub;
pub mod hub_metrics;
#[cfg(feature = "torch")]
mod metrics;
#[cfg(feature = "torch")]
mod networks;
#[cfg(feature = "torch")]
mod parameters;
pub mod run_folder;
#[cfg(feature = "torch")]
pub mod sac;
pub mod service;
#[cfg(feature = "torch")]
mod statistics;
#[cfg(feature = "torch")]
pub mod trainer;
