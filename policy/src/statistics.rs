//! Observation normalisation: statistics that travel with the weights wherever a policy goes.

use serde::{Deserialize, Serialize};

/// Per-number mean and standard deviation; an observation is normalised to `(o − mean) / std`, clipped to
/// `[-clip, clip]`. A number that must stay as it is (β̂) has mean 0 and standard deviation 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ObservationStatistics {
    /// `[observation]`.
    pub mean: Vec<f32>,
    /// `[observation]`, all positive.
    pub std: Vec<f32>,
    /// Largest magnitude that is passed on.
    pub clip: f32,
}

impl ObservationStatistics {
    /// Normalises rows of observations, `[n, observation]`, from `from` into `to`.
    pub fn normalize_into(&self, from: &[f32], to: &mut [f32]) {
        let width = self.mean.len();
        for (row, out) in from.chunks_exact(width).zip(to.chunks_exact_mut(width)) {
            for (((out, value), mean), std) in out.iter_mut().zip(row).zip(&self.mean).zip(&self.std) {
                *out = ((value - mean) / std).clamp(-self.clip, self.clip);
            }
        }
    }
}
