//! The simulation: characters, tasks, rewards and falls, in MuJoCo. No network, no tensors, no async runtime.
//!
//! From the ground up:
//!
//! * [`Character`]: which body; its MJCF is embedded in the binary.
//! * [`World`]: one model and its state, with no task on top.
//! * [`tolerance()`]: the reward's one building block.
//! * [`Task`] and [`GetUp`]: what is observed, what is paid, how episodes begin ([`Resets`]) and end.
//! * [`Lane`]: one world playing episodes of one task.
//! * [`falls`] and [`rollout`]: the files behind `getup falls` and `getup rollout`.
//! * `picture`, with the feature `render`: what `getup render` draws.
//!
//! ```
//! use std::sync::Arc;
//! use getup_sim::{GetUp, Lane, Phase, TaskConfig};
//!
//! let task = Arc::new(GetUp::new(&TaskConfig::default(), 1.0)?);
//! let mut lane = Lane::new(task);
//! let mut action = [0.0; 21];
//! lane.begin(7, 1.0);
//! while lane.phase() == Phase::Limp {
//!     lane.limp_action(&mut action);
//!     lane.step(&action)?;
//! }
//! let step = lane.step(&[0.0; 21])?; // the policy's first
//! assert!(step.reward < 0.1, "lying pays little");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod character;
mod config;
mod error;
pub mod falls;
mod getup;
mod lane;
#[cfg(feature = "render")]
pub mod picture;
mod reset;
pub mod rollout;
mod rollout_json;
mod task;
mod tolerance;
mod world;

pub use character::{Character, UnknownCharacter};
pub use config::{Stand, TaskConfig};
pub use error::{ConfigError, SimError};
pub use getup::{GetUp, UP_HEIGHT};
pub use lane::{Diverged, Lane, Phase, Step};
pub use reset::{Fall, Resets, Source, Standing};
pub use task::Task;
pub use tolerance::{Sigmoid, tolerance};
pub use world::{Body, Divergence, World};

/// The version of the MuJoCo library that is loaded, such as `3.17.0`.
pub fn mujoco_version() -> &'static str {
    mujoco_rs::mujoco_version()
}
