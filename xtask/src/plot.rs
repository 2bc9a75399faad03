//! Figures and a table of the runs in `docs/runs/`: `docs/curves.py`, in a Python that has matplotlib.

use std::process::Command;

use anyhow::Result;

use crate::native::{self, plots_python, root, run};

/// Draws the figures of `docs/`.
pub(crate) fn figures() -> Result<()> {
    curves("plot")
}

/// Prints the runs' table, as Markdown.
pub(crate) fn table() -> Result<()> {
    curves("table")
}

fn curves(mode: &str) -> Result<()> {
    native::set_up_plots()?;
    run(Command::new(plots_python()).arg(root().join("docs/curves.py")).arg(mode))
}
