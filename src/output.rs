//! What commands write: files whole or not at all, and progress on stderr.

use std::fmt;
use std::fs::Permissions;
use std::io::{self, Write};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;
use std::process;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use indicatif::{ProgressBar, ProgressStyle};

/// Prints a line of a command's result on stdout: see [`print_line`].
macro_rules! say {
    ($($text:tt)*) => { $crate::output::print_line(format_args!($($text)*)) };
}
pub(crate) use say;

/// How a program ends that SIGPIPE ended.
const READER_HAS_GONE: i32 = 128 + 13;

/// Prints a line. Where its reader has seen enough, as `head` has, the command is over, in silence; it ends with an error where
/// the line cannot be written for another reason.
pub(crate) fn print_line(line: fmt::Arguments<'_>) {
    match writeln!(io::stdout(), "{line}") {
        Ok(()) => {}
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => process::exit(READER_HAS_GONE),
        Err(error) => {
            eprintln!("error: cannot write to stdout: {error}");
            process::exit(1)
        }
    }
}

/// Refuses a file that cannot be written before anything is done for it.
pub(crate) fn check_place(path: &Path) -> Result<()> {
    let (shown, folder) = (path.display(), folder_of(path));
    ensure!(path.file_name().is_some() && !path.is_dir(), "{shown} names no file");
    ensure!(folder.is_dir(), "{shown}: there is no folder {}: make it, or name another", folder.display());
    Ok(())
}

/// Whether both are there and one, however they are spelled.
pub(crate) fn is_same_file(one: &Path, other: &Path) -> bool {
    let place = |path: &Path| path.metadata().map(|facts| (facts.dev(), facts.ino()));
    matches!((place(one), place(other)), (Ok(one), Ok(other)) if one == other)
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes a file under a temporary name, which goes where that fails, and renames it.
pub(crate) fn write_file(path: &Path, bytes: impl AsRef<[u8]>) -> Result<()> {
    check_place(path)?;
    // Other than secrets, results are for everybody whom the umask lets read them.
    let readable = Permissions::from_mode(0o666);
    let write = || {
        let mut file = tempfile::Builder::new().permissions(readable).tempfile_in(folder_of(path))?;
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
