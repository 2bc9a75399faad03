//! A log line that a stranger can cause is written at most once a minute.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// The shortest time between two lines.
const EVERY: Duration = Duration::from_secs(60);

/// Counts what happens between two lines.
#[derive(Debug, Default)]
pub(crate) struct Throttle {
    /// When the last line was written, and what happened since.
    state: Mutex<(Option<Instant>, u64)>,
}

impl Throttle {
    /// Notes one more; where a line is due, how many there were since the last.
    pub(crate) fn note(&self) -> Option<u64> {
        self.note_at(Instant::now())
    }

    fn note_at(&self, now: Instant) -> Option<u64> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let (last, count) = &mut *state;
        *count += 1;
        if last.is_some_and(|last| now.duration_since(last) < EVERY) {
            return None;
        }
        *last = Some(now);
        Some(std::mem::take(count))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_is_told_at_once_and_those_of_a_minute_together() {
        let (throttle, start) = (Throttle::default(), Instant::now());
        let told: Vec<u64> =
            (0..130).filter_map(|second| throttle.note_at(start + Duration::from_secs(second))).collect();
        assert_eq!(told, [1, 60, 60]);
    }
}
