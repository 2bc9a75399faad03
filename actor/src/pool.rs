//! Fallen states to begin episodes from: a fall takes 80 steps that teach nothing.

use rand::Rng;

/// States in which falls ended, renewed little by little.
#[derive(Debug)]
pub(crate) struct FallPool {
    size: usize,
    renewal: f64,
    /// Positions and velocities.
    states: Vec<(Vec<f64>, Vec<f64>)>,
}

impl FallPool {
    /// A pool of `size` states, of whose draws a share `renewal` plays a fall after all.
    pub(crate) fn new(size: usize, renewal: f64) -> Self {
        Self { size, renewal, states: Vec::with_capacity(size) }
    }

    /// A state to begin from; none where a fall is to be played: while the pool fills, and to renew it. Without a
    /// pool nothing is drawn from `rng`.
    pub(crate) fn draw(&self, rng: &mut impl Rng) -> Option<(&[f64], &[f64])> {
        if self.states.len() < self.size || self.size == 0 || rng.random_bool(self.renewal) {
            return None;
        }
        let (qpos, qvel) = &self.states[rng.random_range(0..self.size)];
        Some((qpos, qvel))
    }

    /// Takes the state in which a fall ended; in a full pool it replaces another.
    pub(crate) fn put(&mut self, qpos: &[f64], qvel: &[f64], rng: &mut impl Rng) {
        if self.size == 0 {
            return;
        }
        if self.states.len() < self.size {
            self.states.push((qpos.to_vec(), qvel.to_vec()));
            return;
        }
        let (old_qpos, old_qvel) = &mut self.states[rng.random_range(0..self.size)];
        old_qpos.copy_from_slice(qpos);
        old_qvel.copy_from_slice(qvel);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn a_pool_fills_then_gives_and_a_share_of_its_draws_renews_it() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut pool = FallPool::new(64, 0.1);
        for index in 0..64 {
            assert!(pool.draw(&mut rng).is_none(), "still filling at {index}");
            pool.put(&[f64::from(index)], &[0.0], &mut rng);
        }
        let given = (0..10_000).filter(|_| pool.draw(&mut rng).is_some()).count();
        assert!((8_800..9_200).contains(&given), "{given} of 10,000");
        pool.put(&[99.0], &[1.0], &mut rng);
        assert_eq!(pool.states.len(), 64);
        assert_eq!(pool.states.iter().filter(|(qpos, _)| qpos[0] == 99.0).count(), 1);
    }

    #[test]
    fn without_a_pool_nothing_is_kept_or_drawn() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut pool = FallPool::new(0, 0.1);
        pool.put(&[1.0], &[1.0], &mut rng);
        assert!(pool.draw(&mut rng).is_none() && pool.states.is_empty());
        assert_eq!(rng, ChaCha8Rng::seed_from_u64(1));
    }
}
