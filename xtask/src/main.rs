//! Set-up, training, tests, checks and benchmarks of getup, with one command each.
//!
//! `xtask` builds without MuJoCo or libtorch, so that it can be the program that brings them.

mod native;
mod prerequisites;
mod tasks;

use anyhow::Result;
use clap::{Parser, Subcommand};

/// Set up, train, test, check and measure getup.
#[derive(Parser)]
#[command(bin_name = "cargo xtask")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Install what is missing: MuJoCo and libtorch into `.native/`, Debian packages of the tests.
    Setup {
        /// Also the peers that benchmarks compare with (PyTorch with its dependencies).
        #[arg(long)]
        peers: bool,
        /// Also the CUDA libraries that `--device cuda` needs (about 4 GB).
        #[arg(long)]
        cuda: bool,
    },
    /// Set up what is missing, build, and run `getup train` with ARGS.
    Train {
        /// Arguments of `getup train`, after `--`; `-- --help` lists them.
        #[arg(last = true)]
        args: Vec<String>,
    },
    /// Set up what is missing and run the tests in their short form.
    Test {
        /// The long forms too: soaks and hundreds of kills.
        #[arg(long)]
        full: bool,
    },
    /// Format, clippy and documentation, without a warning.
    Check,
    /// Run one benchmark: prints a table and writes `target/bench/NAME.json`.
    Bench {
        /// The benchmark; a file of this name lies in `benches/`.
        name: String,
    },
}

fn main() -> Result<()> {
    match Cli::parse().command {
        Command::Setup { peers, cuda } => {
            native::set_up(cuda)?;
            prerequisites::install_debian_packages()?;
            if peers {
                native::set_up_peers()?;
            }
            println!("Ready. Next: cargo xtask train");
            Ok(())
        }
        Command::Train { args } => {
            native::set_up(false)?;
            tasks::train(&args)
        }
        Command::Test { full } => {
            native::set_up(false)?;
            prerequisites::install_debian_packages()?;
            tasks::test(full)
        }
        Command::Check => {
            native::set_up(false)?;
            tasks::check()
        }
        Command::Bench { name } => {
            native::set_up(false)?;
            tasks::bench(&name)
        }
    }
}
