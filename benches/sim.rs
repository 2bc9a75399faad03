//! What a lane costs on top of the physics.
//!
//! Ours: control steps of a [`Lane`], with the observation written in single precision and the reward. Limit: the
//! same physics steps as a bare loop of `mj_step`, from the same fallen states under the same random torques. The two
//! take turns on one core, a few milliseconds each, so that whatever else the machine does hits both; `share_of_limit`
//! is the median of the ratios of such pairs, `ours` and `limit` are medians of their own.

mod common;

use std::sync::Arc;
use std::time::{Duration, Instant};

use common::{Bare, Row, Side, alternate, report};
use getup_sim::falls::{self, Landed};
use getup_sim::{GetUp, Lane, Task, TaskConfig};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Control steps a turn.
const STEPS: usize = 40;

/// Fallen states to start from.
const STATES: usize = 64;

/// How long each row is measured.
const TIME: Duration = Duration::from_secs(30);

fn main() -> anyhow::Result<()> {
    let rows: Vec<Row> = [200, 800].into_iter().map(measure).collect::<anyhow::Result<_>>()?;
    report("sim", &rows)
}

fn measure(physics_hz: u32) -> anyhow::Result<Row> {
    let config = TaskConfig { physics_hz, ..TaskConfig::default() };
    let states = falls::draw(&config, STATES, 0)?.falls;
    let task: Arc<dyn Task> = Arc::new(GetUp::new(&config, 1.0)?);
    let mut lane = Lane::new(task.clone());
    let mut bare = Bare::new(&*task);
    let comparison = alternate(TIME, |side, pair| {
        let state = &states[pair % STATES];
        let mut rng = ChaCha8Rng::seed_from_u64(pair as u64);
        let actions: Vec<f32> =
            (0..STEPS * task.action_width()).map(|_| rng.random_range(-1.0..=1.0)).collect();
        let time = match side {
            Side::Ours => time_lane(&mut lane, state, &actions)?,
            Side::Theirs => bare.time(state, &actions),
        };
        Ok(STEPS as f64 / time.as_secs_f64())
    })?;
    Ok(comparison.with_limit(format!("lane, {physics_hz} Hz physics"), "control steps/s"))
}

/// How long the lane takes from `state` on, under `actions`, one row of torques a control step.
fn time_lane(lane: &mut Lane, state: &Landed, actions: &[f32]) -> anyhow::Result<Duration> {
    lane.begin_at(&state.qpos, &state.qvel, 1.0)?;
    let mut observation = vec![0.0; lane.observation().len()];
    let width = lane.world().nu();
    let mut paid = 0.0;
    let start = Instant::now();
    for action in actions.chunks_exact(width) {
        paid += lane.step(action)?.reward;
        lane.observe(&mut observation);
        std::hint::black_box(&observation);
    }
    std::hint::black_box(paid);
    Ok(start.elapsed())
}
