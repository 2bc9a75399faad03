//! The native libraries: PyPI wheels in `.native/`, and the cargo settings that point at them.
//!
//! `.native/wheels` holds MuJoCo, libtorch and the two CUDA libraries that `libtorch_cpu.so` needs to load;
//! `.cargo/native.toml` holds their absolute paths. Both are made here and never committed, and both are
//! remade when the pinned versions or the place of the checkout change.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail};

use crate::prerequisites;

/// MuJoCo's version, as in the name of its library.
const MUJOCO: &str = "3.17.0";
/// What every build needs.
const WHEELS: &[&str] = &[
    "mujoco==3.17.0",
    "torch==2.11.0",
    "nvidia-cuda-runtime==13.0.96",
    "nvidia-cuda-cupti==13.0.85",
];
/// What `libtorch_cuda.so` of that torch needs, on a machine with an NVIDIA driver.
const CUDA_REQUIREMENTS: &[&str] = &["torch==2.11.0"];
/// What benchmarks compare with: PyTorch whole, with NumPy for its tensors.
const PEER_REQUIREMENTS: &[&str] = &["torch==2.11.0", "numpy==2.3.5"];

/// The repository's root.
pub(crate) fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the root").to_owned()
}

fn native() -> PathBuf {
    root().join(".native")
}

/// The Python of the peers' environment.
pub(crate) fn peers_python() -> PathBuf {
    native().join("peers/bin/python")
}

/// Installs the wheels and writes `.cargo/native.toml`, where they are missing or of other versions.
pub(crate) fn set_up() -> Result<()> {
    install_into(&native().join("wheels"), WHEELS, true, "MuJoCo and libtorch (1.3 GB)")?;
    link_mujoco()?;
    write_cargo_settings()
}

/// Installs the CUDA libraries beside the others.
pub(crate) fn set_up_cuda() -> Result<()> {
    let requirements: Vec<String> = nvidia_requirements(CUDA_REQUIREMENTS)?;
    let names: Vec<&str> = requirements.iter().map(String::as_str).collect();
    install_into(&native().join("cuda"), &names, true, "CUDA libraries (about 4 GB)")?;
    write_cargo_settings()
}

/// Makes the environment that the benchmarks' peers run in.
pub(crate) fn set_up_peers() -> Result<()> {
    let folder = native().join("peers");
    let stamp = folder.join("installed");
    let wanted = PEER_REQUIREMENTS.join("\n");
    if fs::read_to_string(&stamp).is_ok_and(|installed| installed == wanted) {
        return Ok(());
    }
    println!("Installing the benchmarks' peers into {}", folder.display());
    run(Command::new("python3").args(["-m", "venv"]).arg(&folder))?;
    run(Command::new(peers_python()).args(["-m", "pip", "install", "--quiet"]).args(PEER_REQUIREMENTS))?;
    fs::write(stamp, wanted).context("cannot note the peers' versions")
}

/// Installs `requirements` into `folder`, whole or not at all.
fn install_into(folder: &Path, requirements: &[&str], no_deps: bool, what: &str) -> Result<()> {
    let stamp = folder.join("installed");
    let wanted = requirements.join("\n");
    if fs::read_to_string(&stamp).is_ok_and(|installed| installed == wanted) {
        return Ok(());
    }
    prerequisites::check()?;
    println!("Installing {what} into {}", folder.display());
    let pip = pip()?;
    let unfinished = folder.with_extension("unfinished");
    for old in [folder, unfinished.as_path()] {
        if old.exists() {
            fs::remove_dir_all(old).with_context(|| format!("cannot remove {}", old.display()))?;
        }
    }
    let mut command = Command::new(pip);
    command.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check"]);
    if no_deps {
        command.arg("--no-deps");
    }
    run(command.arg("--target").arg(&unfinished).args(requirements))?;
    fs::write(unfinished.join("installed"), wanted).context("cannot note the installed versions")?;
    fs::rename(&unfinished, folder).with_context(|| format!("cannot move into {}", folder.display()))
}

/// A Python with pip that belongs to us, so that a distribution's pip rules do not matter.
fn pip() -> Result<PathBuf> {
    let venv = native().join("venv");
    let python = venv.join("bin/python");
    if !python.exists() {
        run(Command::new("python3").args(["-m", "venv"]).arg(&venv))?;
    }
    Ok(python)
}

/// The pinned `nvidia-…` requirements that torch's own metadata names.
fn nvidia_requirements(_of: &[&str]) -> Result<Vec<String>> {
    let metadata = native().join("wheels/torch-2.11.0.dist-info/METADATA");
    let text = fs::read_to_string(&metadata)
        .with_context(|| format!("cannot read {}: run `cargo xtask setup` first", metadata.display()))?;
    let names = text
        .lines()
        .filter_map(|line| line.strip_prefix("Requires-Dist: "))
        .map(|line| line.split(';').next().unwrap_or(line).replace(['(', ')', ' '], ""))
        .filter(|name| name.starts_with("nvidia-") || name.starts_with("cuda-"))
        .collect();
    Ok(names)
}

/// `mujoco-rs` wants a folder that holds `libmujoco.so`; the wheel names it by its version.
fn link_mujoco() -> Result<()> {
    let folder = native().join("mujoco");
    let link = folder.join("libmujoco.so");
    if link.exists() {
        return Ok(());
    }
    fs::create_dir_all(&folder)?;
    let _ = fs::remove_file(&link);
    let target = native().join(format!("wheels/mujoco/libmujoco.so.{MUJOCO}"));
    #[cfg(unix)]
    std::os::unix::fs::symlink(&target, &link)
        .with_context(|| format!("cannot link {} to {}", link.display(), target.display()))?;
    Ok(())
}

/// Writes `.cargo/native.toml` when its content changes: an unchanged file rebuilds nothing.
fn write_cargo_settings() -> Result<()> {
    let wheels = native().join("wheels");
    let libraries = [
        wheels.join("mujoco"),
        wheels.join("torch/lib"),
        wheels.join("nvidia/cu13/lib"),
        wheels.join("nvidia/cuda_cupti/lib"),
    ];
    let flags: Vec<toml::Value> = libraries
        .iter()
        .filter(|folder| folder.is_dir())
        .flat_map(|folder| ["-C".into(), format!("link-arg=-Wl,-rpath,{}", folder.display()).into()])
        .collect();
    let text = |path: PathBuf| toml::Value::String(path.display().to_string());
    let settings = toml::toml! {
        [env]
        LIBTORCH = (text(wheels.join("torch")))
        MUJOCO_DYNAMIC_LINK_DIR = (text(native().join("mujoco")))
        [build]
        rustflags = (flags.clone())
        rustdocflags = (flags)
    };
    let content = format!("# Written by `cargo xtask setup`.\n{settings}");
    let file = root().join(".cargo/native.toml");
    if fs::read_to_string(&file).is_ok_and(|old| old == content) {
        return Ok(());
    }
    fs::write(&file, content).with_context(|| format!("cannot write {}", file.display()))
}

/// Runs a command to its end, with its output shown, and names it where it fails.
pub(crate) fn run(command: &mut Command) -> Result<()> {
    let status = command.status().with_context(|| format!("cannot start {command:?}"))?;
    if !status.success() {
        bail!("{command:?} ended with {status}");
    }
    Ok(())
}
