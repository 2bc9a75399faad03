//! The replay: its store, its service, its clients and its tools.

#[path = "../common/mod.rs"]
mod common;
#[path = "../fixtures/mod.rs"]
mod fixtures;

mod export;
mod faults;
mod fuzz;
mod kill;
mod maintenance;
mod model;
mod remover;
mod restart;
mod selection;
mod service;
mod shards;
mod sources;
