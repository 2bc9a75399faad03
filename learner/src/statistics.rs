//! Running mean and variance of observations, merged batch by batch (Chan et al. 1979).

use getup_policy::ObservationStatistics;
use serde::{Deserialize, Serialize};

/// Variances are never taken to be smaller: a number that hardly moves must not be blown up.
const VARIANCE_FLOOR: f64 = 1e-4;
/// Largest magnitude of a normalised number.
const CLIP: f32 = 10.0;

/// What a model's statistics count for: its file does not say of how many observations they are.
const FOREIGN_COUNT: f64 = 1e6;

/// Statistics over all observations seen so far; part of the checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct RunningStatistics {
    count: f64,
    mean: Vec<f64>,
    /// Sum of squared deviations from the mean.
    squares: Vec<f64>,
    /// Numbers that stay as they are, such as β̂.
    unnormalized: Vec<usize>,
}

impl RunningStatistics {
    pub(crate) fn new(width: usize, unnormalized: Vec<usize>) -> Self {
        Self { count: 0.0, mean: vec![0.0; width], squares: vec![0.0; width], unnormalized }
    }

    /// Merges rows of observations, `[n, width]`.
    pub(crate) fn merge(&mut self, rows: &[f32]) {
        let width = self.mean.len();
        let added = (rows.len() / width) as f64;
        if added == 0.0 {
            return;
        }
        let total = self.count + added;
        // Row by row: columns would be read with a stride.
        let mut means = vec![0.0; width];
        for row in rows.chunks_exact(width) {
            means.iter_mut().zip(row).for_each(|(mean, value)| *mean += f64::from(*value));
        }
        means.iter_mut().for_each(|mean| *mean /= added);
        for row in rows.chunks_exact(width) {
            for ((squares, mean), value) in self.squares.iter_mut().zip(&means).zip(row) {
                *squares += (f64::from(*value) - mean).powi(2);
            }
        }
        for ((squares, old), mean) in self.squares.iter_mut().zip(&mut self.mean).zip(&means) {
            let shift = mean - *old;
            *squares += shift * shift * self.count * added / total;
            *old += shift * added / total;
        }
        self.count = total;
    }

    /// Takes over what a model was normalised by, as if of [`FOREIGN_COUNT`] observations: those of this run move it
    /// slowly, where they may.
    pub(crate) fn begin_with(&mut self, statistics: &ObservationStatistics) {
        self.count = FOREIGN_COUNT;
        self.mean = statistics.mean.iter().map(|mean| f64::from(*mean)).collect();
        self.squares = statistics.std.iter().map(|std| f64::from(*std).powi(2) * self.count).collect();
    }

    /// What travels with the weights.
    pub(crate) fn snapshot(&self) -> ObservationStatistics {
        let variance = |squares: &f64| if self.count > 0.0 { squares / self.count } else { 1.0 };
        let mut mean: Vec<f32> = self.mean.iter().map(|mean| *mean as f32).collect();
        let mut std: Vec<f32> =
            self.squares.iter().map(|squares| variance(squares).max(VARIANCE_FLOOR).sqrt() as f32).collect();
        for index in &self.unnormalized {
            mean[*index] = 0.0;
            std[*index] = 1.0;
        }
        ObservationStatistics { mean, std, clip: CLIP }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn merging_parts_gives_the_statistics_of_the_whole() {
        let rows: Vec<f32> = (0..300).map(|i| (i as f32 * 0.37).sin() * 5.0 + (i % 3) as f32).collect();
        let mut whole = RunningStatistics::new(3, vec![2]);
        whole.merge(&rows);
        let mut parts = RunningStatistics::new(3, vec![2]);
        for part in rows.chunks(3 * 7) {
            parts.merge(part);
        }
        let (whole, parts) = (whole.snapshot(), parts.snapshot());
        for column in 0..3 {
            assert!((whole.mean[column] - parts.mean[column]).abs() < 1e-5);
            assert!((whole.std[column] - parts.std[column]).abs() < 1e-5);
        }
        assert_eq!((whole.mean[2], whole.std[2]), (0.0, 1.0));
        let column: Vec<f32> = rows.iter().step_by(3).copied().collect();
        let mean = column.iter().sum::<f32>() / 100.0;
        assert!((whole.mean[0] - mean).abs() < 1e-4);
    }
}
