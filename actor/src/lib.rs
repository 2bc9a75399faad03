//! The actor: simulates lanes of episodes under the newest policy, and pushes their segments to the replay.
//!
//! It may die or vanish at any moment at no cost but its unfinished episodes and its unacknowledged segments.
//!
//! | module | what lives there |
//! | --- | --- |
//! | [`lanes`] | [`LaneGroup`]: lanes stepped together, with one forward pass; no thread, no network |
//! | [`explore`] | the draws of β̂ and of actions |
//! | [`segments`] | [`SegmentBuilder`]: episodes cut into segments |
//! | [`evaluate`] | [`Evaluator`]: episodes from seeded falls under the mean action |
//! | [`link`] | [`SegmentWriter`] and [`LearnerLink`], and the typed values that pass through them |
//! | [`grpc`] | both as gRPC clients |
//! | `queue`, `spread` | the bounded queue of segments, and its way to one or several replays |
//! | [`sending`] | [`Sending`]: what traces tell of that way |
//! | [`worker`] | [`run`]: the role, with its threads, its queue, heartbeats and shutdown; [`run_with`]: with a stub that plays |
//! | [`config`], [`identity`], [`metrics`] | settings; who an actor is, and its random draws; what it counts |

pub mod config;
mod divergence;
mod error;
pub mod evaluate;
pub mod explore;
pub mod grpc;
pub mod identity;
mod lane_thread;
pub mod lanes;
pub mod link;
pub mod metrics;
mod office;
mod pool;
mod queue;
pub mod segments;
pub mod sending;
mod spread;
pub mod worker;

pub use config::{ActorConfig, ConfigError};
pub use error::ActorError;
pub use evaluate::{EvaluateError, EvaluatedEpisode, Evaluator};
pub use explore::BetaDraw;
pub use grpc::{GrpcLearner, GrpcReplay};
pub use identity::Identity;
pub use lanes::{GroupError, LaneGroup, LaneSettings, ShapeError};
pub use link::{
    EpisodeResult, Heartbeat, LearnerLink, Lease, LinkError, PolicySlot, PolicyUpdate, Reported,
    SegmentWriter, UpdateError,
};
pub use metrics::ActorMetrics;
pub use queue::QueueInput;
pub use segments::{LayoutError, SegmentBuilder, StepEnd, StepRecord};
pub use sending::Sending;
pub use worker::{ActorSetup, Playing, run, run_with};
