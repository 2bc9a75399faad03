//! Which transitions a minibatch is made of: [`Sampler`].
//!
//! A sampler draws rows of the [`Ring`]; another way to draw is another variant here.

use crate::ring::{Ring, Row};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// Draws transitions. Its whole state can be saved and restored: the draws go on as if nothing had happened.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sampler {
    /// Every transition in the ring with the same probability, with replacement.
    Uniform(ChaCha8Rng),
}

impl Sampler {
    /// A uniform sampler.
    pub fn uniform(seed: u64) -> Self {
        Self::Uniform(ChaCha8Rng::seed_from_u64(seed))
    }

    /// The first row of a transition.
    ///
    /// # Panics
    /// If the ring is empty.
    pub(crate) fn draw(&mut self, ring: &Ring) -> Row {
        match self {
            Self::Uniform(rng) => loop {
                // Rows are uniform, and so are those of them that begin a transition: all but one a segment.
                let row = ring.nth_row(rng.random_range(0..ring.rows()));
                if ring.steps_from(ring.slot(row)) > 0 {
                    return row;
                }
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures;

    /// Chi-square of `counts` against a uniform distribution, as a number of standard deviations.
    fn deviation(counts: &[u32]) -> f64 {
        let expected = counts.iter().sum::<u32>() as f64 / counts.len() as f64;
        let chi_square: f64 = counts.iter().map(|&n| (n as f64 - expected).powi(2) / expected).sum();
        let freedom = (counts.len() - 1) as f64;
        (chi_square - freedom) / (2.0 * freedom).sqrt()
    }

    #[test]
    fn every_transition_is_drawn_with_the_same_probability_also_after_the_ring_has_wrapped() {
        let spec = fixtures::spec(8);
        let mut ring = Ring::new(&spec, 100);
        for (i, steps) in [8, 1, 3, 8, 2, 5].into_iter().cycle().take(60).enumerate() {
            ring.push(&fixtures::segment(&spec, 1, i as u64 + 1, steps));
        }
        let mut counts = vec![0; ring.rows() as usize];
        let mut sampler = Sampler::uniform(3);
        for _ in 0..200_000 {
            counts[(sampler.draw(&ring).number() - ring.nth_row(0).number()) as usize] += 1;
        }
        let begins = |i: &usize| ring.steps_from(ring.slot(ring.nth_row(*i as u64))) > 0;
        let drawn: Vec<u32> = (0..counts.len()).filter(begins).map(|i| counts[i]).collect();
        assert_eq!(drawn.len(), ring.len());
        assert_eq!(drawn.iter().sum::<u32>(), 200_000);
        assert!(deviation(&drawn).abs() < 4.0, "{} standard deviations", deviation(&drawn));
    }

    #[test]
    fn a_restored_sampler_goes_on_with_the_same_draws() {
        let spec = fixtures::spec(8);
        let mut ring = Ring::new(&spec, 100);
        ring.push(&fixtures::segment(&spec, 1, 1, 8));
        let mut sampler = Sampler::uniform(7);
        for _ in 0..13 {
            sampler.draw(&ring);
        }
        let saved = serde_json::to_string(&sampler).unwrap();
        let mut restored: Sampler = serde_json::from_str(&saved).unwrap();
        for _ in 0..50 {
            assert_eq!(restored.draw(&ring), sampler.draw(&ring));
        }
    }
}
