//! A load without physics, for `getup bench` and for the benchmark of a fleet: what actors would send, and percentiles.

use getup_proto::{ColumnSpec, EpisodeEnd, PolicyVersion, Rows, RunSpec, Segment, columns};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Env steps of an episode.
const EPISODE: usize = 250;

/// An episode of random numbers, cut into segments of writer 1: whoever appends them numbers them anew.
pub(crate) fn episode(spec: &RunSpec, number: u64) -> Vec<Segment> {
    let mut rng = ChaCha8Rng::seed_from_u64(number);
    let mut values = |column: &ColumnSpec| -> Vec<f32> {
        (0..column.rows.count(EPISODE) * column.width).map(|_| rng.random()).collect()
    };
    let whole: Vec<Vec<f32>> = spec.columns.iter().map(&mut values).collect();
    let cut = |first: usize| {
        let steps = spec.max_segment_steps.min(EPISODE - first);
        let truncated = first + steps == EPISODE;
        let column = |(column, values): (&ColumnSpec, &Vec<f32>)| {
            let first = if column.rows == Rows::Once { 0 } else { first };
            columns::encode(&values[first * column.width..(first + column.rows.count(steps)) * column.width])
        };
        Segment {
            writer: 1,
            sequence: 1,
            lane: 0,
            episode: number,
            first_step: first as u32,
            steps,
            env_steps: steps as u32,
            terminal: false,
            truncated,
            stage: 0,
            first_version: PolicyVersion::default(),
            last_version: PolicyVersion::default(),
            columns: spec.columns.iter().zip(&whole).map(column).collect(),
            end: truncated.then(|| EpisodeEnd {
                episode_return: 1.0,
                env_steps: EPISODE as u32,
                reason: "time_limit".to_owned(),
                tags: [].into(),
            }),
            trace: None,
        }
    };
    (0..EPISODE).step_by(spec.max_segment_steps).map(cut).collect()
}

/// The values at these shares of the sorted ones, 0.5 for the median; none where there are no values.
pub(crate) fn percentiles<const N: usize>(mut values: Vec<f64>, shares: [f64; N]) -> [Option<f64>; N] {
    values.sort_by(f64::total_cmp);
    let last = values.len().saturating_sub(1);
    shares.map(|share| values.get((last as f64 * share).round() as usize).copied())
}
