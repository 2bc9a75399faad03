//! What a lane costs on top of the physics.
//!
//! Ours: control steps of a [`Lane`], with the observation written in single precision and the reward. Limit: the
//! same physics steps as a bare loop of `mj_step`, from the same fallen states under the same random torques. The two
//! take turns on one core, a few milliseconds each, so that whatever else the machine does hits both; `share_of_limit`
//! is the median of the ratios of such pairs, `ours` and `limit` are medians of their own.

mod common;

use std::sync::Arc;
use std::time::{Duration, Instant};

use common::{Row, median, report};
use getup_sim::falls::{self, Landed};
use getup_sim::{GetUp, Lane, Task, TaskConfig};
use mujoco_rs::prelude::{MjData, MjModel};
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
    let task = Arc::new(GetUp::new(&config, 1.0)?);
    let mut lane = Lane::new(task.clone());
    let mut bare = task.world().mujoco().clone();
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let [mut ours, mut limits, mut shares] = [const { Vec::new() }; 3];
    let start = Instant::now();
    for pair in 0.. {
        if start.elapsed() > TIME {
            break;
        }
        let state = &states[pair % STATES];
        let actions: Vec<Vec<f32>> = (0..STEPS)
            .map(|_| (0..task.action_width()).map(|_| rng.random_range(-1.0..=1.0)).collect())
            .collect();
        // Whoever goes second finds the caches warm: take turns in that too.
        let (our, limit);
        if pair % 2 == 0 {
            our = time_lane(&mut lane, state, &actions)?;
            limit = time_bare(&mut bare, state, &actions, task.substeps());
        } else {
            limit = time_bare(&mut bare, state, &actions, task.substeps());
            our = time_lane(&mut lane, state, &actions)?;
        }
        ours.push(our);
        limits.push(limit);
        shares.push(our / limit);
    }
    Ok(Row {
        name: format!("lane, {physics_hz} Hz physics"),
        unit: "control steps/s".to_owned(),
        ours: median(ours),
        peer: None,
        limit: Some(median(limits)),
        ratio_to_peer: None,
        share_of_limit: Some(median(shares)),
    })
}

/// Control steps a second of the lane, from `state` under `actions`.
fn time_lane(lane: &mut Lane, state: &Landed, actions: &[Vec<f32>]) -> anyhow::Result<f64> {
    lane.begin_at(&state.qpos, &state.qvel, 1.0)?;
    let mut observation = vec![0.0; lane.observation().len()];
    let mut paid = 0.0;
    let start = Instant::now();
    for action in actions {
        paid += lane.step(action)?.reward;
        lane.observe(&mut observation);
        std::hint::black_box(&observation);
    }
    std::hint::black_box(paid);
    Ok(actions.len() as f64 / start.elapsed().as_secs_f64())
}

/// The same of `mj_step` alone.
fn time_bare(data: &mut MjData<Arc<MjModel>>, state: &Landed, actions: &[Vec<f32>], substeps: usize) -> f64 {
    data.reset();
    data.qpos_mut().copy_from_slice(&state.qpos);
    data.qvel_mut().copy_from_slice(&state.qvel);
    data.forward();
    let start = Instant::now();
    for action in actions {
        for (control, &component) in data.ctrl_mut().iter_mut().zip(action) {
            *control = f64::from(component);
        }
        for _ in 0..substeps {
            data.step();
        }
    }
    actions.len() as f64 / start.elapsed().as_secs_f64()
}
