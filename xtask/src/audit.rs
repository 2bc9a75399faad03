//! Whether the dependencies are such as `deny.toml` allows, by cargo-deny, which is installed into `.native/tools/`.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};

use crate::native::{native, root, run};
use crate::tasks::cargo;

/// The version of cargo-deny.
const CARGO_DENY: &str = "0.20.2";

/// Checks licences, bans and sources, and advisories where their database can be fetched.
pub(crate) fn audit() -> Result<()> {
    let program = install()?;
    run(deny(&program).args(["check", "--deny", "warnings", "bans", "licenses", "sources"]))?;
    let fetched = deny(&program).args(["fetch", "db"]).output().context("cannot start cargo-deny")?;
    if !fetched.status.success() {
        let said = String::from_utf8_lossy(&fetched.stderr);
        let reason =
            said.lines().map(str::trim).rfind(|line| !line.is_empty()).unwrap_or("no reason is given");
        println!("advisories NOT CHECKED: the RustSec database cannot be fetched ({reason})");
        return Ok(());
    }
    // Offline: the database and the crates are there, and what fails now is a finding.
    run(deny(&program).args(["--offline", "check", "--deny", "warnings", "advisories"]))
}

/// cargo-deny in the root of the repository.
fn deny(program: &Path) -> Command {
    let mut command = Command::new(program);
    // Asked for a password, git would wait for ever.
    command.current_dir(root()).env("GIT_TERMINAL_PROMPT", "0").args(["--workspace", "--locked"]);
    command
}

/// Builds cargo-deny where it is missing or of another version. Its release profile optimises across all crates,
/// which costs many times what it saves here.
fn install() -> Result<PathBuf> {
    let folder = native().join("tools");
    let program = folder.join("bin/cargo-deny");
    let version = Command::new(&program).arg("--version").output();
    let wanted = format!("cargo-deny {CARGO_DENY}");
    if version.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).trim() == wanted) {
        return Ok(program);
    }
    println!("Building {wanted} into {} (some minutes, once)", folder.display());
    let mut command = cargo();
    command.args(["install", "--quiet", "--locked", "--debug", "--root"]).arg(&folder);
    // In a folder that goes with it.
    command.env_remove("CARGO_TARGET_DIR");
    run(command.arg(format!("cargo-deny@{CARGO_DENY}")).env("CARGO_PROFILE_DEV_DEBUG", "false"))?;
    Ok(program)
}
