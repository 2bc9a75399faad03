//! Whose random numbers decide which transitions are drawn: [`Sampler`].
//!
//! How they decide is the store's [`ItemSelector`](crate::ItemSelector).

use crate::ring::{Drawn, Ring};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// The random numbers of one who samples. Their whole state can be saved and restored: the draws go on as if nothing had happened.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sampler {
    /// From one generator.
    #[serde(rename = "uniform")]
    Seeded(ChaCha8Rng),
}

impl Sampler {
    /// Those of this seed.
    pub fn new(seed: u64) -> Self {
        Self::Seeded(ChaCha8Rng::seed_from_u64(seed))
    }

    /// Draws transitions of a ring whose draws leave no trace.
    ///
    /// # Panics
    /// If the ring is empty.
    pub(crate) fn draw_uniformly(&mut self, ring: &Ring, count: usize) -> Vec<Drawn> {
        let Self::Seeded(rng) = self;
        (0..count).map(|_| ring.draw_uniformly(rng)).collect()
    }

    /// Draws transitions as the ring's sampler does.
    ///
    /// # Panics
    /// If there are not so many draws left.
    pub(crate) fn draw(&mut self, ring: &mut Ring, count: usize) -> Vec<Drawn> {
        let Self::Seeded(rng) = self;
        (0..count).map(|_| ring.draw(rng)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::ReplayConfig;
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
        let mut ring = Ring::new(&spec, &ReplayConfig { capacity: 100, ..ReplayConfig::default() });
        for (i, steps) in [8, 1, 3, 8, 2, 5].into_iter().cycle().take(60).enumerate() {
            ring.push(&fixtures::segment(&spec, 1, i as u64 + 1, steps));
        }
        let rows: Vec<usize> = (0..ring.rows()).map(|n| ring.nth_row(n)).collect();
        let mut counts = vec![0; rows.iter().max().unwrap() + 1];
        let mut sampler = Sampler::new(3);
        for drawn in sampler.draw_uniformly(&ring, 200_000) {
            counts[drawn.slot] += 1;
        }
        let begin = rows.into_iter().filter(|&slot| ring.steps_from(slot) > 0);
        let drawn: Vec<u32> = begin.map(|slot| counts[slot]).collect();
        assert_eq!(drawn.len(), ring.len());
        assert_eq!(drawn.iter().sum::<u32>(), 200_000);
        assert!(deviation(&drawn).abs() < 4.0, "{} standard deviations", deviation(&drawn));
    }

    #[test]
    fn a_restored_sampler_goes_on_with_the_same_draws() {
        let spec = fixtures::spec(8);
        let mut ring = Ring::new(&spec, &ReplayConfig { capacity: 100, ..ReplayConfig::default() });
        ring.push(&fixtures::segment(&spec, 1, 1, 8));
        let mut sampler = Sampler::new(7);
        sampler.draw_uniformly(&ring, 13);
        let saved = serde_json::to_string(&sampler).unwrap();
        let mut restored: Sampler = serde_json::from_str(&saved).unwrap();
        assert_eq!(restored.draw_uniformly(&ring, 50), sampler.draw_uniformly(&ring, 50));
    }
}
