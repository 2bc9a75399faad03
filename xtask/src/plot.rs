//! Figures and a table of the runs in `docs/runs/`, and pictures of the dashboards: `docs/curves.py` and
//! `docs/dashboards.py`, in a Python that has matplotlib.

use std::process::Command;

use anyhow::Result;

use crate::native::{self, plots_python, root, run};

/// The options of `cargo xtask dashboards`.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The Prometheus of a running cluster.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:9090")]
    url: String,
    /// The run to show; needed where Prometheus has seen several.
    #[arg(long, value_name = "RUN")]
    run: Option<String>,
    /// How far back from now.
    #[arg(long, value_name = "N", default_value_t = 15, value_parser = clap::value_parser!(u32).range(1..))]
    minutes: u32,
}

/// Draws the figures of `docs/`.
pub(crate) fn figures() -> Result<()> {
    curves("plot")
}

/// Prints the runs' table, as Markdown.
pub(crate) fn table() -> Result<()> {
    curves("table")
}

/// Draws the dashboards from what a Prometheus knows of a run.
pub(crate) fn dashboards(args: &Args) -> Result<()> {
    native::set_up_plots()?;
    let mut command = Command::new(plots_python());
    command.arg(root().join("docs/dashboards.py")).arg(&args.url);
    command.arg("--minutes").arg(args.minutes.to_string());
    if let Some(run) = &args.run {
        command.arg("--run").arg(run);
    }
    run(&mut command)
}

fn curves(mode: &str) -> Result<()> {
    native::set_up_plots()?;
    run(Command::new(plots_python()).arg(root().join("docs/curves.py")).arg(mode))
}
