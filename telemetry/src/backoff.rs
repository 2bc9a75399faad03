//! Jittered exponential back-off: how long to pause before the next attempt.
//!
//! The jitter spreads the clients of a service that came back, so that they do not return all at once.

use std::time::Duration;

use rand::Rng;

/// The pause after the first failure, before jitter.
const FIRST: Duration = Duration::from_millis(100);
/// The longest pause.
const LONGEST: Duration = Duration::from_secs(5);

/// Pauses that double from 100 ms to 5 s, each shortened by up to a half at random.
#[derive(Clone, Debug, Default)]
pub struct Backoff {
    /// How often [`Backoff::next`] was called since the start or the last reset.
    failures: u32,
}

impl Backoff {
    /// A back-off before its first failure.
    pub fn new() -> Self {
        Self::default()
    }

    /// How long to wait now, after one more failure: from 50 ms to 5 s.
    #[expect(clippy::should_implement_trait, reason = "an endless iterator would read worse at every call")]
    pub fn next(&mut self) -> Duration {
        let doublings = self.failures.min(16);
        self.failures = self.failures.saturating_add(1);
        (FIRST * (1 << doublings)).min(LONGEST).mul_f64(rand::rng().random_range(0.5..=1.0))
    }

    /// To be called after a success: the next failure waits briefly again.
    pub fn reset(&mut self) {
        self.failures = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_nth_pause_lies_between_half_of_its_doubling_and_the_whole(failures in 0_u32..100) {
            let mut backoff = Backoff::new();
            for _ in 0..failures {
                backoff.next();
            }
            let pause = backoff.next();
            let whole = LONGEST.min(FIRST * (1 << failures.min(10)));
            prop_assert!(pause >= whole / 2 && pause <= whole, "{pause:?} of {whole:?}");
        }
    }

    #[test]
    fn a_success_makes_the_next_pause_short_again() {
        let mut backoff = Backoff::new();
        for _ in 0..10 {
            backoff.next();
        }
        backoff.reset();
        assert!(backoff.next() <= FIRST);
    }

    #[test]
    fn two_clients_do_not_come_back_in_step() {
        let pauses = |mut backoff: Backoff| (0..20).map(|_| backoff.next()).collect::<Vec<_>>();
        assert_ne!(pauses(Backoff::new()), pauses(Backoff::new()));
    }
}
