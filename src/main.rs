//! `getup`: teaches a physically simulated human to get up from the ground.
//!
//! One binary with a subcommand a role; each subcommand is one file here. The work is done in the rooms:
//! `getup-actor`, `getup-learner`, `getup-replay`, `getup-sim`.

mod actor;
mod config;
mod doctor;
mod evaluate;
mod falls;
#[cfg(feature = "learner")]
mod learner;
#[cfg(feature = "learner")]
mod links;
mod output;
#[cfg(feature = "render")]
mod render;
mod replay;
mod role;
mod rollout;
mod status;
#[cfg(feature = "learner")]
mod train;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Teach a physically simulated human to get up from the ground.
///
/// Start with `getup train`: one process, everything in it. The roles also run as processes of their own: `getup
/// replay`, `getup learner`, `getup actor`, in any order, from the same configuration.
#[derive(Parser)]
#[command(version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Train a character in one process.
    #[cfg(feature = "learner")]
    Train(train::Args),
    /// Run the replay: stores what actors push, and serves minibatches.
    Replay(replay::Args),
    /// Run the learner: trains, broadcasts policies, advances the curriculum.
    #[cfg(feature = "learner")]
    Learner(learner::Args),
    /// Run an actor: simulates episodes under the newest policy.
    Actor(actor::Args),
    /// Measure a trained policy on falls it has not seen.
    Evaluate(evaluate::Args),
    /// Draw a strip of frames of one get-up.
    #[cfg(feature = "render")]
    Render(render::Args),
    /// Replay recorded states and actions, and write what the simulation makes of them.
    Rollout(rollout::Args),
    /// Write the states in which falls begin and end.
    Falls(falls::Args),
    /// Check this machine and a configuration before a run does.
    Doctor(doctor::Args),
    /// Ask a running cluster who waits on whom, and why.
    Status(status::Args),
}

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        #[cfg(feature = "learner")]
        Command::Train(arguments) => train::run(arguments),
        Command::Replay(arguments) => replay::run(arguments),
        #[cfg(feature = "learner")]
        Command::Learner(arguments) => learner::run(arguments),
        Command::Actor(arguments) => actor::run(arguments),
        Command::Evaluate(arguments) => evaluate::run(arguments),
        #[cfg(feature = "render")]
        Command::Render(arguments) => render::run(arguments),
        Command::Rollout(arguments) => rollout::run(arguments),
        Command::Falls(arguments) => falls::run(arguments),
        Command::Doctor(arguments) => doctor::run(arguments),
        Command::Status(arguments) => status::run(arguments),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
