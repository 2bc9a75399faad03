//! Compiles the .proto files with protox (no protoc needed) into clients, servers and messages.

use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=getup");
    let files = ["getup/v1/common.proto", "getup/v1/replay.proto", "getup/v1/learner.proto"];
    let descriptors = protox::compile(files, ["."])?;
    tonic_prost_build::configure().bytes(".").compile_fds(descriptors)?;
    Ok(())
}
