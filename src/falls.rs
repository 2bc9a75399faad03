//! `getup falls`: the states in which falls begin and end.

use std::path::PathBuf;

use anyhow::{Context, Result, ensure};
use getup_sim::{Character, TaskConfig, falls};

use crate::output::{check_place, write_file};

/// Write the states in which falls begin and end, as JSON.
///
/// A fall: the root 1.5 m up, its orientation and every joint uniform, redrawn until nothing touches, then 80 limp
/// control steps.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// Number of falls.
    #[arg(long, default_value_t = 100)]
    count: usize,
    /// Seed of all draws.
    ///
    /// The first falls are those that a run of this seed is evaluated on.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// The file to write.
    #[arg(long, value_name = "FILE")]
    output: PathBuf,
    /// standard, cast (a leg and an arm in a cast) or one_arm.
    #[arg(long, default_value = "standard")]
    character: Character,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    let count = arguments.count;
    ensure!((1..=1_000_000).contains(&count), "--count {count}: from 1 to 1000000");
    check_place(&arguments.output)?;
    let config = TaskConfig { character: arguments.character, ..TaskConfig::default() };
    let falls = falls::draw(&config, arguments.count, arguments.seed)?;
    let text = serde_json::to_string(&falls).context("falls are not expressible as JSON")?;
    write_file(&arguments.output, &text)?;
    let landings = &falls.landings;
    eprintln!(
        "{} falls of the {} character, seed {}: {} supine, {} prone, {} lateral. Written to {}",
        falls.falls.len(),
        arguments.character,
        arguments.seed,
        landings.supine,
        landings.prone,
        landings.lateral,
        arguments.output.display()
    );
    Ok(())
}
