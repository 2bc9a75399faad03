//! Set-up, training, tests, checks, benchmarks and figures of getup, with one command each.
//!
//! `xtask` builds without MuJoCo or libtorch, so that it can be the program that brings them.

mod ablate;
mod audit;
mod native;
mod plot;
mod prerequisites;
mod sbom;
mod tasks;

use anyhow::Result;
use clap::{Parser, Subcommand};
use tasks::Cluster;

/// Set up, train, test, check, measure and show getup.
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
        /// Also the peers that benchmarks compare with (PyTorch, and Reverb with TensorFlow: Python 3.11).
        #[arg(long)]
        peers: bool,
        /// Also the CUDA libraries that `--device cuda` needs (about 4 GB).
        #[arg(long)]
        cuda: bool,
    },
    /// Set up what is missing, build, and run `getup train` with ARGS.
    Train {
        /// Arguments of `getup train`; `-- --help` lists them.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<String>,
    },
    /// Set up what is missing and run the tests in their short form; where a Docker engine is present also on a cluster of
    /// containers, with one fault.
    Test {
        /// The long forms too: soaks, hundreds of kills, every fault of the cluster.
        #[arg(long)]
        full: bool,
        /// Only the cluster, with every fault.
        #[arg(long, conflicts_with = "full")]
        cluster: bool,
    },
    /// Format, clippy, documentation and dependencies (see `audit`), without a warning.
    Check,
    /// Licences, sources and known faults of the dependencies, by cargo-deny as `deny.toml` says.
    ///
    /// The first time builds cargo-deny into .native/tools/. Where the RustSec database cannot be fetched, advisories
    /// are not checked, and that is said.
    Audit,
    /// Write target/sbom/IMAGE.cdx.json: what the images slim, learner and learner-cuda hold, as CycloneDX.
    Sbom,
    /// Run one benchmark: prints a table and writes `target/bench/NAME.json`.
    Bench {
        /// The benchmark; a file of this name lies in `benches/`.
        name: String,
    },
    /// Train what the paper's Fig. 3a compares: the curriculum and fixed torque limits.
    ///
    /// The runs are curriculum, fixed-100, fixed-60, fixed-50 and fixed-40 (per cent of the character's own torques),
    /// each for every seed, with preset laptop, one after another. They lie in runs/ablation/; what the figures read of
    /// a run is copied to docs/runs/ablation/ when it is done.
    ///
    /// Ctrl-C saves and ends; the same command again goes on, and skips what is done.
    Ablate(ablate::Args),
    /// Draw the figures in `docs/` from the runs in `docs/runs/`.
    ///
    /// To show a run, copy its config.toml, evaluations.jsonl and timings.jsonl to docs/runs/NAME-SEED/, such as
    /// docs/runs/laptop-1/. They become docs/learning-curve.png and docs/torque-limit.png; the runs docs/runs/standing*
    /// become docs/standing.png, and the runs of `cargo xtask ablate` docs/ablation.png; docs/fleet.png is from what
    /// `GETUP_FLEET_RECORD=1 cargo xtask bench fleet` writes. A figure without a run is left out, and said to be. The
    /// first time installs matplotlib into .native/plots/.
    Plot,
    /// Draw the Grafana dashboards as pictures in `docs/dashboards/`, from the Prometheus of a running cluster.
    ///
    /// First start a cluster (deploy/compose.yaml says how) and let it train for some minutes; its Prometheus is at
    /// http://127.0.0.1:9090 unless GETUP_PROMETHEUS_PORT says otherwise. Grafana is not needed. Each dashboard of
    /// deploy/grafana/dashboards/ becomes docs/dashboards/NAME.png; a panel that no data answers is said to be empty.
    /// The first time installs matplotlib into .native/plots/.
    Dashboards(plot::Args),
    /// Print a Markdown table of the runs in `docs/runs/`: env steps and minutes to each mark.
    Runs,
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
        Command::Test { full, cluster } => {
            native::set_up(false)?;
            prerequisites::install_debian_packages()?;
            if !cluster {
                native::set_up_readers()?;
                tasks::test(full)?;
            }
            tasks::test_cluster(match (full, cluster) {
                (true, _) => Cluster::Soak,
                (false, true) => Cluster::AllFaults,
                (false, false) => Cluster::OneFault,
            })
        }
        Command::Check => {
            native::set_up(false)?;
            tasks::check()?;
            audit::audit()
        }
        Command::Audit => audit::audit(),
        Command::Sbom => sbom::write(),
        Command::Bench { name } => {
            native::set_up(false)?;
            tasks::bench(&name)
        }
        Command::Ablate(args) => {
            native::set_up(false)?;
            ablate::ablate(&args)
        }
        Command::Plot => plot::figures(),
        Command::Dashboards(args) => plot::dashboards(&args),
        Command::Runs => plot::table(),
    }
}
