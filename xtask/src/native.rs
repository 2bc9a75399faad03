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
/// What every build needs; without libtorch the first is enough.
pub(crate) const WHEELS: &[&str] =
    &["mujoco==3.17.0", "torch==2.11.0", "nvidia-cuda-runtime==13.0.96", "nvidia-cuda-cupti==13.0.85"];
/// What `libtorch_cuda.so` of that torch needs beside them; it looks for them in the same folder.
pub(crate) const CUDA_WHEELS: &[&str] = &[
    "nvidia-cublas==13.1.0.3",
    "nvidia-cuda-nvrtc==13.0.88",
    "nvidia-cudnn-cu13==9.19.0.56",
    "nvidia-cufft==12.0.0.61",
    "nvidia-cufile==1.15.1.6",
    "nvidia-curand==10.4.0.35",
    "nvidia-cusolver==12.0.4.66",
    "nvidia-cusparse==12.6.3.3",
    "nvidia-cusparselt-cu13==0.8.0",
    "nvidia-nccl-cu13==2.28.9",
    "nvidia-nvjitlink==13.0.88",
    "nvidia-nvshmem-cu13==3.4.5",
    "nvidia-nvtx==13.0.85",
];
/// What benchmarks compare with: PyTorch whole, with NumPy for its tensors.
const PEER_REQUIREMENTS: &[&str] = &["torch==2.11.0", "numpy==2.3.5"];
/// What `benches/replay/` compares with, in an environment of its own: it needs an older NumPy.
const REVERB_REQUIREMENTS: &[&str] =
    &["dm-reverb[tensorflow]==0.14.0", "tensorflow==2.15.1", "numpy==1.26.4"];
/// What tests read exported stores with, and what they check `deploy/` against: the schemas of Compose, Grafana (for
/// Python 3.11 and later) and Kubernetes.
const READER_REQUIREMENTS: &[&str] = &[
    "minari[arrow]==0.5.4",
    // Minari's Arrow reader imports it.
    "pillow==12.0.0",
    "numpy==2.2.6",
    "check-jsonschema==0.39.0",
    "grafana-foundation-sdk==1769699379!11.6.0; python_version >= '3.11'",
    "kubernetes-validate==1.37.0",
];
/// What `docs/curves.py` and `docs/dashboards.py` draw with; tomli reads TOML where Python does not yet.
const PLOT_REQUIREMENTS: &[&str] = &["matplotlib==3.10.9", "tomli==2.5.0; python_version < '3.11'"];

/// The variables that tell build scripts where the libraries are, and the folder of each in `.native`.
pub(crate) const BUILD_VARIABLES: [(&str, &str); 2] =
    [("LIBTORCH", "wheels/torch"), ("MUJOCO_DYNAMIC_LINK_DIR", "mujoco")];

/// The repository's root.
pub(crate) fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the root").to_owned()
}

/// What is installed for this checkout, and ignored by git.
pub(crate) fn native() -> PathBuf {
    root().join(".native")
}

/// The Python of Reverb's environment.
pub(crate) fn reverb_python() -> PathBuf {
    native().join("peers-reverb/bin/python")
}

/// The Python of the peers' environment.
pub(crate) fn peers_python() -> PathBuf {
    native().join("peers/bin/python")
}

/// The Python that has what tests read with.
pub(crate) fn readers_python() -> PathBuf {
    native().join("readers/bin/python")
}

/// The Python of the plots' environment.
pub(crate) fn plots_python() -> PathBuf {
    native().join("plots/bin/python")
}

/// Installs the wheels and writes `.cargo/native.toml`, where they are missing or of other versions. An installation with
/// CUDA's libraries keeps them, whether `cuda` asks for them or not.
pub(crate) fn set_up(cuda: bool) -> Result<()> {
    prerequisites::check()?;
    let with_cuda = [WHEELS, CUDA_WHEELS].concat();
    let installed = fs::read_to_string(native().join("wheels/installed")).unwrap_or_default();
    let had_cuda =
        CUDA_WHEELS.iter().any(|wheel| installed.lines().any(|line| package(line) == package(wheel)));
    let (wheels, what) = if cuda || had_cuda {
        (&with_cuda[..], "MuJoCo and libtorch with CUDA (about 4 GB)")
    } else {
        (WHEELS, "MuJoCo and libtorch (1.3 GB)")
    };
    if installed != wheels.join("\n") {
        install_wheels(wheels, what)?;
    }
    link_mujoco()?;
    write_cargo_settings()
}

/// The package of a requirement such as `numpy==2.3.5`.
fn package(requirement: &str) -> &str {
    requirement.split_once("==").map_or(requirement, |(package, _)| package)
}

/// Makes the environment that the benchmarks' peers run in.
pub(crate) fn set_up_peers() -> Result<()> {
    set_up_environment("peers", &peers_python(), PEER_REQUIREMENTS, "the benchmarks' peers")?;
    set_up_environment("peers-reverb", &reverb_python(), REVERB_REQUIREMENTS, "Reverb, a peer of benchmarks")
}

/// Makes the environment that figures are drawn in.
pub(crate) fn set_up_plots() -> Result<()> {
    prerequisites::check()?;
    set_up_environment("plots", &plots_python(), PLOT_REQUIREMENTS, "matplotlib for the figures (200 MB)")
}

/// Makes the environment that tests read exports and manifests in.
pub(crate) fn set_up_readers() -> Result<()> {
    set_up_environment(
        "readers",
        &readers_python(),
        READER_REQUIREMENTS,
        "NumPy, Minari and schemas for the tests (500 MB)",
    )
}

/// Makes a Python environment in `.native/NAME`, where it is missing or of other requirements.
fn set_up_environment(name: &str, python: &Path, requirements: &[&str], what: &str) -> Result<()> {
    let folder = native().join(name);
    let stamp = folder.join("installed");
    let wanted = requirements.join("\n");
    if fs::read_to_string(&stamp).is_ok_and(|installed| installed == wanted) && has_pip(python) {
        return Ok(());
    }
    // Standard output belongs to what the environment is made for, such as a table.
    eprintln!("Installing {what} into {}", folder.display());
    run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&folder))?;
    let pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check"];
    run(Command::new(python).args(pip).args(requirements))?;
    fs::write(&stamp, wanted).with_context(|| format!("cannot note the versions in {}", stamp.display()))
}

/// Installs wheels without their dependencies, all or none.
fn install_wheels(wheels: &[&str], what: &str) -> Result<()> {
    let folder = native().join("wheels");
    println!("Installing {what} into {}", folder.display());
    let pip = pip()?;
    let unfinished = native().join("wheels.unfinished");
    let remove = |old: &Path| match old.exists() {
        true => fs::remove_dir_all(old).with_context(|| format!("cannot remove {}", old.display())),
        false => Ok(()),
    };
    remove(&unfinished)?;
    let mut command = Command::new(pip);
    command.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", "--target"]);
    if let Err(error) = run(command.arg(&unfinished).args(wheels)) {
        // Gigabytes, on what may be a full disk. What was installed before still works.
        let _ = remove(&unfinished);
        return Err(error);
    }
    fs::write(unfinished.join("installed"), wheels.join("\n"))
        .context("cannot note the installed versions")?;
    remove(&folder)?;
    fs::rename(&unfinished, &folder).with_context(|| format!("cannot move into {}", folder.display()))
}

/// A Python with pip that belongs to us, so that a distribution's pip rules do not matter.
fn pip() -> Result<PathBuf> {
    let venv = native().join("venv");
    let python = venv.join("bin/python");
    if !has_pip(&python) {
        run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&venv))?;
    }
    Ok(python)
}

/// Whether it runs and finds its packages: another version of the system's Python does not.
fn has_pip(python: &Path) -> bool {
    let version = Command::new(python).args(["-m", "pip", "--version"]).output();
    version.is_ok_and(|output| output.status.success())
}

/// `mujoco-rs` wants a folder that holds `libmujoco.so`; the wheel names it by its version.
fn link_mujoco() -> Result<()> {
    let folder = native().join("mujoco");
    let link = folder.join("libmujoco.so");
    let target = native().join(format!("wheels/mujoco/libmujoco.so.{MUJOCO}"));
    if fs::read_link(&link).is_ok_and(|old| old == target) {
        return Ok(());
    }
    fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
    // Not there, or the link of another place.
    let _ = fs::remove_file(&link);
    #[cfg(unix)]
    std::os::unix::fs::symlink(&target, &link)
        .with_context(|| format!("cannot link {} to {}", link.display(), target.display()))?;
    Ok(())
}

/// Writes `.cargo/native.toml` when its content changes: an unchanged file rebuilds nothing.
fn write_cargo_settings() -> Result<()> {
    let wheels = native().join("wheels");
    let libraries = [wheels.join("mujoco"), wheels.join("torch/lib"), wheels.join("nvidia/cu13/lib")];
    let flags: Vec<toml::Value> = libraries
        .iter()
        .filter(|folder| folder.is_dir())
        .flat_map(|folder| ["-C".into(), format!("link-arg=-Wl,-rpath,{}", folder.display()).into()])
        .collect();
    let variables: toml::Table = BUILD_VARIABLES
        .into_iter()
        .map(|(name, folder)| (name.to_owned(), native().join(folder).display().to_string().into()))
        .collect();
    let settings = toml::toml! {
        env = (variables)
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
