//! The actor, with real physics and real gRPC.

mod evaluations;
mod grpc_learner;
mod grpc_replay;
mod lanes;
mod role;
mod support;
