//! What commands write: files whole or not at all, and progress on stderr.

use std::fs::Permissions;
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressStyle};

/// Writes a file under a temporary name, which goes where that fails, and renames it.
pub(crate) fn write_file(path: &Path, bytes: impl AsRef<[u8]>) -> Result<()> {
    path.file_name().with_context(|| format!("{} names no file", path.display()))?;
    // Other than secrets, results are for everybody whom the umask lets read them.
    let readable = Permissions::from_mode(0o666);
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let write = || {
        let mut file = tempfile::Builder::new().permissions(readable).tempfile_in(folder)?;
        file.write_all(bytes.as_ref())?;
        file.persist(path)?;
        io::Result::Ok(())
    };
    write().with_context(|| format!("cannot write {}", path.display()))
}

/// A bar over `length` things on stderr; nothing where stderr is no terminal.
pub(crate) fn progress_bar(length: u64, things: &'static str) -> ProgressBar {
    let bar = ProgressBar::new(length);
    let template = format!("{{bar:40}} {{pos}}/{{len}} {things} ({{eta}} left)");
    bar.set_style(ProgressStyle::with_template(&template).expect("the template is constant and valid"));
    bar.enable_steady_tick(Duration::from_millis(200));
    bar
}
