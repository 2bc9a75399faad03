//! Replay: keeps the transitions of a run durably, and hands them out in minibatches at the right pace.
//!
//! # From a segment to a minibatch
//! An actor's [`Segment`](getup_proto::Segment) comes in over gRPC ([`serve`]) or from the same process
//! ([`Store::append`]). It is committed to the log, with others, and is acknowledged only when it would survive
//! the process being killed. Then it enters the ring, from where samplers gather minibatches: over gRPC
//! ([`RemoteSource`]) or in the same process ([`LocalSource`]); a learner sees a [`MinibatchSource`] either way.
//! Between the two sides stands the rate limiter: whoever is ahead waits, and can say why.
//!
//! # The modules
//! | module | what it is |
//! | --- | --- |
//! | `store` | [`Store`]: the parts below, put together |
//! | `log` | the durable log: commits, eviction, recovery, snapshots, repair |
//! | `ring`, `slots` | the transitions in memory, and where in memory |
//! | `remover` | [`Remover`]: which segments leave a full ring: the oldest, or those of the lowest priority |
//! | `gather` | from drawn rows to contiguous columns, with n-step returns |
//! | `selector`, `sum_tree` | [`ItemSelector`]: which transitions are drawn: uniform, prioritized, FIFO, LIFO |
//! | `undrawn` | segments that are followed by traces, up to their first minibatch |
//! | `limiter` | Reverb's cursor between two bounds, a pure state machine |
//! | `gate` | the limiter with its doors: who waits there, and for whom |
//! | `tables` | [`Tables`]: stores by name, behind one address |
//! | `service` | [`serve_at`]: the streams of writers and samplers |
//! | `source`, `remote`, `shards` | [`MinibatchSource`], in process, over gRPC, and from several services; [`describe`] |
//! | `export` | a store's transitions for other tools |
//! | `minibatch`, `config`, `error`, `metrics`, `disk` | [`Minibatch`], [`ReplayConfig`], [`StoreError`], [`ReplayMetrics`] |

mod config;
mod disk;
mod error;
mod export;
mod gate;
mod gather;
mod limiter;
mod log;
mod metrics;
mod minibatch;
mod remote;
mod remover;
mod ring;
mod selector;
mod service;
mod shards;
mod slots;
mod source;
mod store;
mod sum_tree;
mod tables;
mod undrawn;

#[cfg(test)]
#[path = "../tests/fixtures/mod.rs"]
mod fixtures;

pub use config::{ConfigError, DEFAULT_TABLE, MAX_CAPACITY, ReplayConfig, SyncMode};
pub use error::StoreError;
pub use export::{DatasetId, ExportError, Exported, export_minari, export_npz};
pub use log::{Ever, Rewritten, Survey, WriterMark, compact, repair, segments};
pub use metrics::ReplayMetrics;
pub use minibatch::{
    Item, MAX_N_STEP, Minibatch, MinibatchColumn, OptionsError, ReplayCounters, SampleOptions, SampledSegment,
};
pub use remote::{RemoteOptions, RemoteSource, describe, describe_table, take_snapshot, update_priorities};
pub use remover::Remover;
pub use selector::ItemSelector;
pub use service::{ServeError, limits, serve, serve_at};
pub use shards::ShardedSource;
pub use source::{LocalSource, MinibatchSource, SampleError};
pub use store::Store;
pub use tables::{TableError, Tables, check_table_name};
