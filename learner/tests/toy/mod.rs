//! A task that is learned within seconds: a point on a line is to be moved to 0.5.

#![allow(dead_code)]

use getup_learner::config::{SacConfig, TargetEntropy};
use getup_learner::sac::TaskShape;
use getup_proto::{ColumnSpec, PolicyVersion, Rows, RunSpec, Segment, columns};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

const STEPS: usize = 16;

/// What its transitions look like.
pub(crate) fn spec() -> RunSpec {
    let column = |name: &str, rows| ColumnSpec { name: name.to_owned(), width: 1, rows };
    RunSpec {
        run: "toy".to_owned(),
        task: "line/point".to_owned(),
        columns: vec![
            column(columns::OBSERVATION, Rows::StepsPlusOne),
            column(columns::ACTION, Rows::Steps),
            column(columns::REWARD, Rows::Steps),
            column(columns::BETA, Rows::Once),
        ],
        max_segment_steps: STEPS,
    }
}

/// A point on a line is moved to where the action says, and paid `1 − (position − 0.5)²`; actions are uniform.
pub(crate) fn segment(sequence: u64, rng: &mut ChaCha8Rng) -> Segment {
    let positions: Vec<f32> = (0..=STEPS).map(|_| rng.random_range(-1.0..1.0)).collect();
    let actions = &positions[1..];
    let rewards: Vec<f32> = actions.iter().map(|action| 1.0 - (action - 0.5).powi(2)).collect();
    Segment {
        writer: 1,
        sequence,
        lane: 0,
        episode: sequence,
        first_step: 0,
        steps: STEPS,
        env_steps: STEPS as u32,
        terminal: false,
        truncated: false,
        stage: 0,
        first_version: PolicyVersion::default(),
        last_version: PolicyVersion::default(),
        columns: [&positions[..], actions, &rewards, &[1.0]].map(columns::encode).to_vec(),
        end: None,
        trace: None,
    }
}

/// SAC that learns it.
pub(crate) fn config() -> SacConfig {
    SacConfig {
        hidden: vec![32, 32],
        batch: 64,
        gamma: 0.8,
        tau: 0.02,
        actor_lr: 1e-3,
        critic_lr: 3e-3,
        temperature_lr: 1e-3,
        initial_temperature: 0.01,
        target_entropy: TargetEntropy::Nats(-3.0),
        ..SacConfig::default()
    }
}

/// Position, and where to.
pub(crate) fn shape() -> TaskShape {
    TaskShape { observation: 1, action: 1, unnormalized: vec![] }
}
