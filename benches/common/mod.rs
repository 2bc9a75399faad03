//! What benchmarks share: their rows, the table they print and the file they leave in `target/bench/`; turns taken
//! alternately; the bare loop of physics that limits whoever simulates; and peers that answer turn by turn.

#![allow(dead_code, reason = "each benchmark uses a part of it")]

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use getup_sim::Task;
use getup_sim::falls::Landed;
use mujoco_rs::prelude::{MjData, MjModel};
use serde::Serialize;

/// One measurement. Higher is better; what a row does not have is null in the file.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Row {
    /// What was measured.
    pub(crate) name: String,
    /// Unit of `ours`, `peer` and `limit`.
    pub(crate) unit: String,
    /// What this project reaches.
    pub(crate) ours: f64,
    /// What the peer reaches on the same machine.
    pub(crate) peer: Option<f64>,
    /// What the machine allows.
    pub(crate) limit: Option<f64>,
    /// `ours` over `peer`.
    pub(crate) ratio_to_peer: Option<f64>,
    /// `ours` over `limit`.
    pub(crate) share_of_limit: Option<f64>,
}

impl Row {
    /// A row without a peer and without a limit.
    pub(crate) fn plain(name: String, unit: &str, ours: f64) -> Self {
        Self {
            name,
            unit: unit.to_owned(),
            ours,
            peer: None,
            limit: None,
            ratio_to_peer: None,
            share_of_limit: None,
        }
    }

    /// Such a row, of which less is better.
    pub(crate) fn less(name: String, unit: &str, ours: f64) -> Self {
        Self::plain(name, &format!("{unit} (less is better)"), ours)
    }
}

/// Prints the rows as a table and writes them to `target/bench/NAME.json`.
pub(crate) fn report(name: &str, rows: &[Row]) -> anyhow::Result<()> {
    let number = |value: Option<f64>, decimals: usize| {
        value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
    };
    println!(
        "{:<36} {:<18} {:>12} {:>12} {:>12} {:>8} {:>8}",
        name, "unit", "ours", "peer", "limit", "of peer", "of limit"
    );
    for row in rows {
        let [ours, peer, limit] = [Some(row.ours), row.peer, row.limit].map(|value| number(value, 1));
        let [of_peer, of_limit] = [row.ratio_to_peer, row.share_of_limit].map(|value| number(value, 3));
        println!(
            "{:<36} {:<18} {ours:>12} {peer:>12} {limit:>12} {of_peer:>8} {of_limit:>8}",
            row.name, row.unit
        );
    }
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/bench");
    fs::create_dir_all(&folder)?;
    let file = folder.join(format!("{name}.json"));
    fs::write(&file, serde_json::to_string_pretty(rows)? + "\n")?;
    println!("written to {}", file.display());
    Ok(())
}

/// The median: half of the values are below it.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    assert!(!values.is_empty(), "a median of nothing");
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Who takes a turn.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Side {
    /// This project.
    Ours,
    /// The peer or the limit.
    Theirs,
}

/// Medians over turns that two sides took alternately.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Comparison {
    ours: f64,
    theirs: f64,
    /// Of ours over theirs, pair by pair.
    ratio: f64,
}

/// Lets both sides take turns until `time` is over, so that whatever else the machine does hits both. `turn` is told
/// whose turn it is and in which pair, from 0, and returns what that side reached.
pub(crate) fn alternate(
    time: Duration,
    mut turn: impl FnMut(Side, usize) -> anyhow::Result<f64>,
) -> anyhow::Result<Comparison> {
    let [mut ours, mut theirs, mut ratios] = [const { Vec::new() }; 3];
    let start = Instant::now();
    for pair in 0.. {
        if pair > 0 && start.elapsed() > time {
            break;
        }
        // Whoever goes second finds the caches warm: take turns in that too.
        let (our, their);
        if pair % 2 == 0 {
            our = turn(Side::Ours, pair)?;
            their = turn(Side::Theirs, pair)?;
        } else {
            their = turn(Side::Theirs, pair)?;
            our = turn(Side::Ours, pair)?;
        }
        ours.push(our);
        theirs.push(their);
        ratios.push(our / their);
    }
    Ok(Comparison { ours: median(ours), theirs: median(theirs), ratio: median(ratios) })
}

impl Comparison {
    /// The row of a comparison with a peer.
    pub(crate) fn with_peer(self, name: String, unit: &str) -> Row {
        let Self { ours, theirs, ratio } = self;
        let (peer, ratio_to_peer) = (Some(theirs), Some(ratio));
        Row { name, unit: unit.to_owned(), ours, peer, limit: None, ratio_to_peer, share_of_limit: None }
    }

    /// The row of a comparison with what the machine allows.
    pub(crate) fn with_limit(self, name: String, unit: &str) -> Row {
        let Self { ours, theirs, ratio } = self;
        let (limit, share_of_limit) = (Some(theirs), Some(ratio));
        Row { name, unit: unit.to_owned(), ours, peer: None, limit, ratio_to_peer: None, share_of_limit }
    }
}

/// A bare loop of `mj_step` in a task's world: the physics and nothing else.
pub(crate) struct Bare {
    data: MjData<Arc<MjModel>>,
    substeps: usize,
}

impl Bare {
    pub(crate) fn new(task: &dyn Task) -> Self {
        Self { data: task.world().mujoco().clone(), substeps: task.substeps() }
    }

    /// How long the physics takes from `state` on, under `actions`, one row of torques a control step.
    pub(crate) fn time(&mut self, state: &Landed, actions: &[f32]) -> Duration {
        let Self { data, substeps } = self;
        data.reset();
        data.qpos_mut().copy_from_slice(&state.qpos);
        data.qvel_mut().copy_from_slice(&state.qvel);
        data.forward();
        let width = data.ctrl().len();
        let start = Instant::now();
        for action in actions.chunks_exact(width) {
            for (control, &component) in data.ctrl_mut().iter_mut().zip(action) {
                *control = f64::from(component);
            }
            for _ in 0..*substeps {
                data.step();
            }
        }
        start.elapsed()
    }
}

/// A script of this folder under the Python of `cargo xtask setup --peers`: it answers every line with a number, and
/// rests in between.
pub(crate) struct Peer {
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
}

impl Peer {
    pub(crate) fn start(script: &str, arguments: &[&str]) -> anyhow::Result<Self> {
        Self::start_with("GETUP_PEERS_PYTHON", script, arguments)
    }

    /// As [`Peer::start`], under the Python that this variable names.
    pub(crate) fn start_with(variable: &str, script: &str, arguments: &[&str]) -> anyhow::Result<Self> {
        let python = std::env::var(variable).context("run it as `cargo xtask bench NAME`")?;
        let mut child = Command::new(python)
            .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("benches").join(script))
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .context("cannot start the peer's Python: `cargo xtask setup --peers` installs it")?;
        let input = child.stdin.take().expect("it is piped");
        let output = BufReader::new(child.stdout.take().expect("it is piped"));
        Ok(Self { child, input, output })
    }

    /// What it answers to a line.
    pub(crate) fn ask_line(&mut self, line: &str) -> anyhow::Result<String> {
        writeln!(self.input, "{line}").context("the peer has ended")?;
        let mut answer = String::new();
        self.output.read_line(&mut answer).context("the peer has ended")?;
        Ok(answer)
    }

    /// The number that it answers to a line.
    pub(crate) fn ask(&mut self, line: &str) -> anyhow::Result<f64> {
        let answer = self.ask_line(line)?;
        answer
            .trim()
            .parse::<f64>()
            .with_context(|| format!("the peer answers {answer:?} instead of a number"))
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
