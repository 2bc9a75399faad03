//! `getup settings`: what can be set, and what it means.

use anyhow::{Result, ensure};

use crate::config::{ConfigArgs, Setting, explained};
use crate::output::say;

/// Print every setting, its value and what it means, as a file for `--config`.
///
/// The values are those that a role would run with under the same preset, file, environment and `--set`.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Only settings whose names contain one of these words, such as `replay.` or `entropy`.
    #[arg(value_name = "WORD")]
    words: Vec<String>,
    #[command(flatten)]
    config: ConfigArgs,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    let settings = arguments.config.load()?.settings()?;
    let asked = |setting: &&Setting| {
        let name = format!("{}.{}", setting.table, setting.key);
        arguments.words.is_empty() || arguments.words.iter().any(|word| name.contains(&word.to_lowercase()))
    };
    let shown: Vec<&Setting> = settings.iter().filter(asked).collect();
    ensure!(
        !shown.is_empty(),
        "no setting's name contains {}: `getup settings` alone lists all",
        arguments.words.join(" or ")
    );
    say!("{}", explained(shown).trim());
    Ok(())
}
