//! Train, test, check, bench: each a few cargo commands, all on the release profile, so that they share artefacts.

use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context, Result, bail};

use crate::native::{self, peers_python, readers_python, reverb_python, root, run};

/// Cargo, in the root of the repository.
pub(crate) fn cargo() -> Command {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    // What is built is looked for in target/release, whatever the user's own settings say.
    command
        .current_dir(root())
        .env("CARGO_TARGET_DIR", root().join("target"))
        .env_remove("CARGO_BUILD_TARGET");
    // Cargo gave this process the paths that held before it wrote them anew: let the next one read the file.
    for (name, _) in native::BUILD_VARIABLES {
        command.env_remove(name);
    }
    command
}

/// Builds getup; returns where it lies.
pub(crate) fn build() -> Result<PathBuf> {
    run(cargo().args(["build", "--release", "--package", "getup"]))?;
    Ok(root().join("target/release/getup"))
}

/// Builds and becomes `getup train`: its exit code, its signals, its terminal.
pub(crate) fn train(arguments: &[String]) -> Result<()> {
    let mut command = Command::new(build()?);
    command.arg("train").args(arguments);
    Err(command.exec()).context("cannot start getup")
}

/// The tests; `full` adds the long forms, which read `GETUP_TEST_FULL`.
pub(crate) fn test(full: bool) -> Result<()> {
    let mut command = cargo();
    command.args(["test", "--release", "--workspace"]).env("GETUP_TEST_PYTHON", readers_python());
    if full {
        command.env("GETUP_TEST_FULL", "1");
    }
    run(&mut command)
}

/// How a cluster of containers is tested.
pub(crate) enum Cluster {
    /// Within minutes.
    OneFault,
    /// Each once.
    AllFaults,
    /// And then half an hour of them.
    Soak,
}

/// `deploy/test`: containers of this build, their metrics, and faults; where there is a Docker engine.
pub(crate) fn test_cluster(part: Cluster) -> Result<()> {
    let works = |arguments: &[&str]| {
        let (program, arguments) = arguments.split_first().expect("a program");
        Command::new(program).args(arguments).output().is_ok_and(|output| output.status.success())
    };
    if !(works(&["test", "-O", "/"]) && works(&["docker", "info"]) && works(&["docker-compose", "version"])) {
        println!("skipped: the cluster of containers needs root, a Docker engine and docker-compose");
        return Ok(());
    }
    // The tests before have built it; a build of this package alone would make its dependencies anew, with fewer features.
    let getup = match part {
        Cluster::AllFaults => build()?,
        Cluster::OneFault | Cluster::Soak => root().join("target/release/getup"),
    };
    let test = |arguments: &[&str]| {
        run(Command::new(root().join("deploy/test")).args(arguments).env("GETUP", &getup))
    };
    match part {
        Cluster::OneFault => test(&[]),
        Cluster::AllFaults => test(&["--full"]),
        Cluster::Soak => test(&["--full"]).and_then(|()| test(&["--soak", "30"])),
    }
}

/// Format, clippy (with and without the learner) and documentation, all without a warning.
pub(crate) fn check() -> Result<()> {
    run(cargo().args(["fmt", "--all", "--check"]))?;
    let clippy = ["clippy", "--release", "--all-targets"];
    run(cargo().args(clippy).args(["--workspace", "--", "-D", "warnings"]))?;
    run(cargo().args(clippy).args(["--package", "getup", "--no-default-features", "--", "-D", "warnings"]))?;
    run(cargo()
        .args(["doc", "--release", "--workspace", "--no-deps", "--document-private-items"])
        .env("RUSTDOCFLAGS", "-D warnings"))
}

/// Runs the benchmark NAME of `benches/`, which prints its table and writes `target/bench/NAME.json`.
pub(crate) fn bench(name: &str) -> Result<()> {
    // A file, or a folder with a main.rs; what else is there they share.
    let benchmark = |entry: std::fs::DirEntry| {
        let path = entry.path();
        let is_one =
            path.extension().is_some_and(|extension| extension == "rs") || path.join("main.rs").is_file();
        is_one.then(|| path.file_stem()?.to_str().map(str::to_owned)).flatten()
    };
    let entries = std::fs::read_dir(root().join("benches")).context("cannot read benches/")?;
    let mut known: Vec<String> = entries.filter_map(|entry| benchmark(entry.ok()?)).collect();
    if !known.iter().any(|known| known == name) {
        known.sort();
        bail!("no benchmark {name:?}; there are: {}", known.join(", "));
    }
    run(cargo()
        .args(["bench", "--package", "getup", "--bench", name])
        .env("GETUP_PEERS_PYTHON", peers_python())
        .env("GETUP_REVERB_PYTHON", reverb_python()))
}
