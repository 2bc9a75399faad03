//! `getup rollout`: replays recorded states and actions.

use std::path::PathBuf;

use anyhow::{Context, Result, ensure};
use getup_sim::Character;
use getup_sim::rollout::{RolloutFile, replay};

use crate::output::{check_place, is_same_file, write_file};

/// Replay recorded states and actions, and write what the simulation makes of them.
///
/// The input holds, for every rollout, `beta`, `qpos0`, `qvel0` and `actions`; the output adds observations, rewards,
/// reward terms (stand, straight, still, feet) and positions, in double precision.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The recorded rollouts.
    #[arg(long, value_name = "FILE")]
    input: PathBuf,
    /// The file to write.
    #[arg(long, value_name = "FILE")]
    output: PathBuf,
    /// standard, cast or one_arm. [default: the input's `variant`]
    #[arg(long)]
    character: Option<Character>,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    let (input, output) = (&arguments.input, &arguments.output);
    check_place(output)?;
    ensure!(!is_same_file(input, output), "--output {} is the input: name another", output.display());
    let text = std::fs::read_to_string(input).with_context(|| format!("cannot read {}", input.display()))?;
    let played = RolloutFile::parse(&text)
        .and_then(|file| replay(&file, arguments.character))
        .with_context(|| input.display().to_string())?;
    write_file(&arguments.output, played.to_json())?;
    let steps: usize = played.rollouts.iter().map(|rollout| rollout.rewards.len()).sum();
    let (count, output) = (played.rollouts.len(), arguments.output.display());
    eprintln!(
        "{count} rollouts of the {} character, {steps} control steps. Written to {output}",
        played.character
    );
    for (index, rollout) in played.rollouts.iter().enumerate() {
        if let Some(diverged) = &rollout.diverged {
            eprintln!("rollout {index} diverged at step {}: {}", diverged.step, diverged.cause);
        }
    }
    Ok(())
}
