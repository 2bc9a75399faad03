//! `getup`: teaches a physically simulated human to get up from the ground.
//!
//! One binary with a subcommand a role; each subcommand is one file here. The work is done in the rooms:
//! `getup-actor`, `getup-learner`, `getup-replay`, `getup-sim`.

mod actor;
mod average;
mod bench;
mod certs;
mod chaos;
mod config;
mod delay;
mod doctor;
mod evaluate;
mod falls;
mod health;
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
#[cfg(feature = "learner")]
mod run;
mod settings;
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
    // Each is described where its arguments are.
    #[cfg(feature = "learner")]
    Train(train::Args),
    Replay(replay::Args),
    #[cfg(feature = "learner")]
    Learner(learner::Args),
    Actor(actor::Args),
    Evaluate(evaluate::Args),
    Average(average::Args),
    #[cfg(feature = "render")]
    Render(render::Args),
    Rollout(rollout::Args),
    Falls(falls::Args),
    Settings(settings::Args),
    Doctor(doctor::Args),
    Certs(certs::Args),
    Bench(bench::Args),
    Chaos(chaos::Args),
    #[command(hide = true)]
    Delay(delay::Args),
    Health(health::Args),
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
        Command::Average(arguments) => average::run(arguments),
        #[cfg(feature = "render")]
        Command::Render(arguments) => render::run(arguments),
        Command::Rollout(arguments) => rollout::run(arguments),
        Command::Falls(arguments) => falls::run(arguments),
        Command::Settings(arguments) => settings::run(arguments),
        Command::Doctor(arguments) => doctor::run(arguments),
        Command::Certs(arguments) => certs::run(arguments),
        Command::Bench(arguments) => bench::run(arguments),
        Command::Chaos(arguments) => chaos::run(arguments),
        Command::Delay(arguments) => delay::run(arguments),
        Command::Health(arguments) => health::run(arguments),
        Command::Status(arguments) => status::run(arguments),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {}", reasons(&error));
            ExitCode::FAILURE
        }
    }
}

/// An error and what caused it, each said once: many name their cause in their own words already.
fn reasons(error: &anyhow::Error) -> String {
    error.chain().map(ToString::to_string).fold(String::new(), |said, cause| {
        if said.is_empty() {
            cause
        } else if said.contains(&cause) {
            said
        } else {
            format!("{said}: {cause}")
        }
    })
}

#[cfg(test)]
mod tests {
    use anyhow::Context;

    #[test]
    fn every_reason_is_said_once() {
        let cause = std::io::Error::other("the disk is full");
        let error = getup_policy::ModelError::Io { path: "a.safetensors".into(), source: cause };
        let error = Err::<(), _>(error).context("the run ends").unwrap_err();
        let said = super::reasons(&error);
        assert_eq!(said, "the run ends: cannot access the model a.safetensors: the disk is full");
    }
}
