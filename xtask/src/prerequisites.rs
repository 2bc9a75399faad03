//! What must be on the machine before anything can be installed by us, and what Debian gives the tests.

use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};

/// Debian packages that tests use, each with what tells that it is there; a test that misses one says what it skips.
const DEBIAN_PACKAGES: &[(&str, Sign)] = &[
    ("prometheus", Sign::Program("promtool")),
    ("libegl1", Sign::Library("libEGL.so.1")),
    ("libgles2", Sign::Library("libGLESv2.so.2")),
    ("libgl1-mesa-dri", Sign::Library("dri")),
];

/// What tells that a package is there.
enum Sign {
    /// On the PATH.
    Program(&'static str),
    /// A file or a folder among the system's libraries.
    Library(&'static str),
}

/// Refuses with the name of a missing prerequisite and how to install it.
pub(crate) fn check() -> Result<()> {
    let compiler = std::env::var("CXX").unwrap_or_else(|_| "c++".into());
    if !runs(&compiler, &["--version"]) {
        bail!(
            "no C++ compiler: `{compiler}` does not run; libtorch's bindings need one. Install it \
             (Debian: apt-get install g++) or name one in the variable CXX"
        );
    }
    if !runs("python3", &["-c", "import sys; sys.exit(sys.version_info < (3, 10))"]) {
        bail!(
            "no Python >= 3.10: `python3` is missing or older; MuJoCo and libtorch come as PyPI \
             wheels. Install it (Debian: apt-get install python3-venv)"
        );
    }
    if !runs("python3", &["-c", "import venv, ensurepip"]) {
        bail!("Python has no venv or pip: install them (Debian: apt-get install python3-venv)");
    }
    Ok(())
}

/// Installs the tests' Debian packages when run as root on Debian; elsewhere prints the command.
pub(crate) fn install_debian_packages() -> Result<()> {
    let missing: Vec<&str> =
        DEBIAN_PACKAGES.iter().filter(|(_, sign)| !sign.is_seen()).map(|(package, _)| *package).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let names = missing.join(" ");
    if !(Path::new("/etc/debian_version").exists() && is_root()) {
        println!(
            "Some tests use {names}, which this machine lacks; they will say what they skip.\n\
             On Debian: sudo apt-get install --no-install-recommends {names}"
        );
        return Ok(());
    }
    println!("Installing Debian packages: {names}");
    for arguments in
        [vec!["update", "-qq"], [vec!["install", "-qq", "-y", "--no-install-recommends"], missing].concat()]
    {
        let status = Command::new("apt-get")
            .args(&arguments)
            .env("DEBIAN_FRONTEND", "noninteractive")
            // Debian starts a service after its installation; the tests start their own.
            .env("RUNLEVEL", "1")
            .stdout(Stdio::null())
            .status()
            .context("cannot run apt-get")?;
        if !status.success() {
            println!("apt-get {} failed: tests that use {names} will say what they skip", arguments[0]);
            return Ok(());
        }
    }
    Ok(())
}

fn runs(program: &str, arguments: &[&str]) -> bool {
    Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success())
}

impl Sign {
    fn is_seen(&self) -> bool {
        match self {
            Self::Program(name) => {
                let path = std::env::var_os("PATH").unwrap_or_default();
                std::env::split_paths(&path).any(|folder| folder.join(name).is_file())
            }
            Self::Library(name) => ["/usr/lib/x86_64-linux-gnu", "/usr/lib64", "/usr/lib"]
                .iter()
                .any(|folder| Path::new(folder).join(name).exists()),
        }
    }
}

fn is_root() -> bool {
    Command::new("id").arg("-u").output().is_ok_and(|output| output.stdout == b"0\n")
}
