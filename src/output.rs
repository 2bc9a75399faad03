//! What commands write: files whole or not at all, and progress on stderr.

use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressStyle};

/// Writes a file under a temporary name and renames it.
pub(crate) fn write_file(path: &Path, bytes: impl AsRef<[u8]>) -> Result<()> {
    let mut name = path.file_name().with_context(|| format!("{} names no file", path.display()))?.to_owned();
    name.push(".unfinished");
    let unfinished = path.with_file_name(name);
    std::fs::write(&unfinished, bytes)
        .and_then(|()| std::fs::rename(&unfinished, path))
        .with_context(|| format!("cannot write {}", path.display()))
}

/// A bar over `length` things on stderr; nothing where stderr is no terminal.
pub(crate) fn progress_bar(length: u64, things: &'static str) -> ProgressBar {
    let bar = ProgressBar::new(length);
    let template = format!("{{bar:40}} {{pos}}/{{len}} {things} ({{eta}} left)");
    bar.set_style(ProgressStyle::with_template(&template).expect("the template is constant and valid"));
    bar.enable_steady_tick(Duration::from_millis(200));
    bar
}
