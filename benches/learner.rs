//! Updates a second on one core and on two: ours, PyTorch's in eager mode (`peer`: under bfloat16 autocast and in
//! float32, a row each), and this update's own matrix products alone (`limit`), in turns in one run.
//!
//! The peer is `benches/learner_eager.py` under the Python of `cargo xtask setup --peers`.

mod common;

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use common::{Row, median, report};
use getup_learner::config::{NetworkKind, Precision, SacConfig};
use getup_learner::sac::{Batch, Sac, TaskShape};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Turns that each side takes.
const TURNS: usize = 3;
/// How long a turn is.
const TIME: Duration = Duration::from_millis(1500);
const OBSERVATION: usize = 68;
const ACTION: usize = 21;

/// What is updated.
struct Case {
    name: &'static str,
    network: &'static str,
    width: usize,
    batch: usize,
    threads: usize,
}

fn main() -> anyhow::Result<()> {
    let simba = |name, batch, threads| Case { name, network: "simba", width: 128, batch, threads };
    let mlp = |name, width, batch, threads| Case { name, network: "mlp", width, batch, threads };
    let cases = [
        simba("SimBa 128, batch 128", 128, 1),
        simba("SimBa 128, batch 256", 256, 1),
        simba("SimBa 128, batch 128", 128, 2),
        mlp("2×256, batch 256", 256, 256, 1),
        mlp("2×1024, batch 1024", 1024, 1024, 1),
        mlp("2×1024, batch 1024", 1024, 1024, 2),
    ];
    let mut rows = Vec::new();
    for case in &cases {
        rows.extend(case.measure()?);
    }
    report("learner", &rows)
}

impl Case {
    fn measure(&self) -> anyhow::Result<Vec<Row>> {
        let mut fp32 = Side::new(self, Precision::Fp32);
        // Where the processor has no kernels for it, an update in bfloat16 goes through autograd: nothing to compare.
        let mut bf16 = Side::new(self, Precision::Bf16).where_it_multiplies();
        for turn in 0..TURNS {
            for side in bf16.iter_mut().chain([&mut fp32]) {
                side.take_turn(turn)?;
            }
        }
        let row = |what: &str, peer_name: &str, ours: &Side<'_>, peer: &Side<'_>| {
            let [rate, limit, peer] =
                [&ours.ours, &ours.limit, &peer.peer].map(|turns| median(turns.clone()));
            Row {
                name: format!("{}, {} thread(s), {what} / {peer_name}", self.name, self.threads),
                unit: "updates/s".into(),
                ours: rate,
                peer: Some(peer),
                limit: Some(limit),
                ratio_to_peer: Some(rate / peer),
                share_of_limit: Some(rate / limit),
            }
        };
        let mut rows = Vec::new();
        if let Some(bf16) = &bf16 {
            rows.push(row("bf16", "eager bf16", bf16, bf16));
            rows.push(row("bf16", "eager fp32", bf16, &fp32));
        }
        rows.push(row("fp32", "eager fp32", &fp32, &fp32));
        Ok(rows)
    }
}

/// One precision of a case.
struct Side<'a> {
    case: &'a Case,
    precision: Precision,
    sac: Sac,
    batch: Batch,
    ours: Vec<f64>,
    limit: Vec<f64>,
    peer: Vec<f64>,
}

impl<'a> Side<'a> {
    fn new(case: &'a Case, precision: Precision) -> Self {
        let simba = case.network == "simba";
        let config = SacConfig {
            network: if simba { NetworkKind::Simba } else { NetworkKind::Mlp },
            hidden: vec![case.width; 2],
            actor_width: case.width,
            critic_width: case.width,
            critics: if simba { 1 } else { 2 },
            precision,
            normalize_observations: simba,
            weight_decay: if simba { 0.01 } else { 0.0 },
            ..SacConfig::default()
        };
        let shape =
            TaskShape { observation: OBSERVATION, action: ACTION, unnormalized: vec![OBSERVATION - 1] };
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let mut column =
            |width: usize| (0..case.batch * width).map(|_| rng.random_range(-1.0..1.0)).collect();
        let batch = Batch {
            observation: column(OBSERVATION),
            next_observation: column(OBSERVATION),
            action: column(ACTION),
            reward: column(1),
            discount: vec![0.97; case.batch],
            beta: vec![1.0; case.batch],
            weight: Vec::new(),
        };
        let sac = Sac::new(&shape, &config, 0, getup_learner::device::cpu(case.threads), case.threads);
        let [ours, limit, peer] = [const { Vec::new() }; 3];
        Self { case, precision, sac, batch, ours, limit, peer }
    }

    /// Itself, where this processor has kernels for its products.
    fn where_it_multiplies(mut self) -> Option<Self> {
        self.sac.multiply(self.case.batch).then_some(self)
    }

    /// All three, whoever is first changing from turn to turn.
    fn take_turn(&mut self, turn: usize) -> anyhow::Result<()> {
        for part in 0..3 {
            match (turn + part) % 3 {
                0 => {
                    let Self { sac, batch, .. } = self;
                    self.ours.push(rate(|| sac.update(batch).map(drop).context("the update"))?);
                }
                1 => {
                    let (sac, rows) = (&mut self.sac, self.case.batch);
                    self.limit.push(rate(|| if sac.multiply(rows) { Ok(()) } else { bail!("no kernels") })?);
                }
                _ => self.peer.push(self.eager()?),
            }
        }
        Ok(())
    }

    fn eager(&self) -> anyhow::Result<f64> {
        let python = std::env::var("GETUP_PEERS_PYTHON").context("run it as `cargo xtask bench learner`")?;
        let Case { network, width, batch, threads, .. } = self.case;
        let precision = if self.precision == Precision::Bf16 { "bf16" } else { "fp32" };
        let output = Command::new(python)
            .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/learner_eager.py"))
            .args([network.to_string(), width.to_string(), batch.to_string(), threads.to_string()])
            .args([precision.to_string(), TIME.as_secs_f64().to_string()])
            .output()
            .context("cannot start the peer's Python: `cargo xtask setup --peers` installs it")?;
        if !output.status.success() {
            bail!("the peer failed: {}", String::from_utf8_lossy(&output.stderr));
        }
        String::from_utf8_lossy(&output.stdout).trim().parse().context("the peer prints a number")
    }
}

/// Times a second that `work` is done, after a few that are not counted.
fn rate(mut work: impl FnMut() -> anyhow::Result<()>) -> anyhow::Result<f64> {
    for _ in 0..3 {
        work()?;
    }
    let start = Instant::now();
    let mut count = 0;
    while start.elapsed() < TIME {
        work()?;
        count += 1;
    }
    Ok(f64::from(count) / start.elapsed().as_secs_f64())
}
