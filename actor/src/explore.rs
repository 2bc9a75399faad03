//! How an actor explores: the draw of β̂ (§5) and of actions (App. D).

use std::collections::BTreeMap;

use getup_policy::squash;
use getup_proto::names::{BETA_FLOOR_VALUE, BETA_STD_VALUE};
use rand::Rng;
use rand_distr::StandardNormal;

/// The draw of an episode's torque limit β̂ around the curriculum's β^i (§5).
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct BetaDraw {
    /// Standard deviation: 0.04 in the paper.
    pub std: f64,
    /// Lower clip, the curriculum's floor: 0.4 in the paper.
    pub floor: f64,
    /// Upper clip: 1, or the curriculum's β^0 where that is above.
    pub ceiling: f64,
}

impl BetaDraw {
    /// As an update's named values say, where they do: a fleet has one curriculum, whatever its actors are configured with.
    /// The ceiling is the actuators', which are an actor's own.
    pub fn told_by(self, values: &BTreeMap<String, f64>) -> Self {
        let told = |name: &str, own| values.get(name).copied().unwrap_or(own);
        let floor = told(BETA_FLOOR_VALUE, self.floor).min(self.ceiling);
        Self { std: told(BETA_STD_VALUE, self.std), floor, ceiling: self.ceiling }
    }

    /// β̂ ~ N(`beta`, std), clipped to [floor, ceiling]. Drawn at an episode's start and kept throughout.
    pub fn draw(&self, beta: f64, rng: &mut impl Rng) -> f32 {
        let noise: f64 = rng.sample(StandardNormal);
        (beta + self.std * noise).clamp(self.floor, self.ceiling) as f32
    }
}

/// The standard normal noise of a lane's actions, held for some steps: a body moved by the same push for a while gets
/// further than one that trembles.
#[derive(Clone, Debug)]
pub struct Noise {
    values: Vec<f32>,
    /// Steps that it is still held for.
    left: usize,
    /// Probability that it is held for at most 1, 2, … steps.
    cumulative: Vec<f64>,
}

impl Noise {
    /// Noise for `width` motors, held for k ≤ `longest` steps with probability ∝ 1/k².
    pub fn new(width: usize, longest: usize) -> Self {
        let mut cumulative: Vec<f64> = (1..=longest.max(1))
            .scan(0.0, |sum, k| {
                *sum += (k as f64).powi(-2);
                Some(*sum)
            })
            .collect();
        let total = cumulative[cumulative.len() - 1];
        cumulative.iter_mut().for_each(|sum| *sum /= total);
        Self { values: vec![0.0; width], left: 0, cumulative }
    }

    /// Draws anew at the next step: an episode begins.
    pub fn release(&mut self) {
        self.left = 0;
    }

    /// The noise of the next step, one number a motor.
    pub fn next(&mut self, rng: &mut impl Rng) -> &[f32] {
        if self.left == 0 {
            self.values.iter_mut().for_each(|value| *value = rng.sample(StandardNormal));
            // Without a choice nothing is drawn.
            self.left = match self.cumulative.len() {
                1 => 1,
                longest => {
                    let uniform: f64 = rng.random();
                    1 + self.cumulative.partition_point(|sum| *sum <= uniform).min(longest - 1)
                }
            };
        }
        self.left -= 1;
        &self.values
    }
}

/// a = β̂·tanh(u), u = mean + exp(log_std)·noise, one number a motor.
pub fn sample_action(mean: &[f32], log_std: &[f32], noise: &[f32], beta: f32, action: &mut [f32]) {
    for (((component, mean), log_std), noise) in action.iter_mut().zip(mean).zip(log_std).zip(noise) {
        *component = squash(mean + log_std.exp() * noise, beta);
    }
}

/// Draws an action uniform in [-β̂, β̂]: how the first steps of a run explore.
pub fn uniform_action(beta: f32, rng: &mut impl Rng, action: &mut [f32]) {
    for component in action {
        *component = rng.random_range(-beta..=beta);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    const DRAW: BetaDraw = BetaDraw { std: 0.04, floor: 0.4, ceiling: 1.0 };

    #[test]
    fn an_update_says_how_beta_is_drawn_where_it_says_anything() {
        let told = |name: &str, value| DRAW.told_by(&[(name.to_owned(), value)].into());
        assert_eq!(told("beta", 0.5), DRAW);
        assert_eq!(told(BETA_STD_VALUE, 0.1), BetaDraw { std: 0.1, ..DRAW });
        assert_eq!(told(BETA_FLOOR_VALUE, 0.3), BetaDraw { floor: 0.3, ..DRAW });
        assert_eq!(told(BETA_FLOOR_VALUE, 1.5).draw(0.5, &mut ChaCha8Rng::seed_from_u64(0)), 1.0);
    }

    proptest! {
        #[test]
        fn beta_stays_between_the_floor_and_the_ceiling(beta in 0.3_f64..1.2, seed: u64) {
            let drawn = DRAW.draw(beta, &mut ChaCha8Rng::seed_from_u64(seed));
            prop_assert!((0.4_f32..=1.0).contains(&drawn));
        }

        #[test]
        fn actions_stay_within_beta(
            mean in prop::array::uniform4(-30_f32..30.0), log_std in -5_f32..2.0, beta in 0.4_f32..2.0, seed: u64
        ) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut action = [0.0; 4];
            let mut noise = Noise::new(4, 1);
            sample_action(&mean, &[log_std; 4], noise.next(&mut rng), beta, &mut action);
            prop_assert!(action.iter().all(|component| component.abs() <= beta));
            uniform_action(beta, &mut rng, &mut action);
            prop_assert!(action.iter().all(|component| component.abs() <= beta));
        }
    }

    #[test]
    fn noise_is_held_for_a_time_that_falls_off_with_its_square() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut noise = Noise::new(2, 16);
        let mut holds = [0; 17];
        let (mut last, mut held) = (noise.next(&mut rng).to_vec(), 1);
        for _ in 0..200_000 {
            let next = noise.next(&mut rng).to_vec();
            if next == last {
                held += 1;
            } else {
                holds[held] += 1;
                (last, held) = (next, 1);
            }
        }
        let total: i32 = holds.iter().sum();
        let normaliser: f64 = (1..=16).map(|k| f64::from(k).powi(-2)).sum();
        for (k, count) in holds.iter().enumerate().skip(1) {
            let (share, wanted) = (f64::from(*count) / f64::from(total), (k as f64).powi(-2) / normaliser);
            assert!((share - wanted).abs() < 0.005, "held {k}: {share}, wanted {wanted}");
        }
    }

    #[test]
    fn noise_that_is_not_held_is_drawn_anew_in_every_step_and_release_ends_a_hold() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut anew = Noise::new(3, 1);
        assert_ne!(anew.next(&mut rng).to_vec(), anew.next(&mut rng).to_vec());
        let mut held = Noise::new(3, 16);
        for _ in 0..100 {
            let before = held.next(&mut rng).to_vec();
            held.release();
            assert_ne!(held.next(&mut rng).to_vec(), before);
        }
    }

    #[test]
    fn beta_is_normal_with_the_given_spread_where_nothing_clips_it() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let draws: Vec<f64> = (0..20_000).map(|_| f64::from(DRAW.draw(0.7, &mut rng))).collect();
        let mean = draws.iter().sum::<f64>() / draws.len() as f64;
        let variance = draws.iter().map(|draw| (draw - mean).powi(2)).sum::<f64>() / draws.len() as f64;
        assert!((mean - 0.7).abs() < 0.001, "{mean}");
        assert!((variance.sqrt() - 0.04).abs() < 0.001, "{}", variance.sqrt());
    }
}
