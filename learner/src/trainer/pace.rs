//! How fast updates are made, over the last seconds.

use std::time::{Duration, Instant};

/// The window over which the rate is measured.
const WINDOW: Duration = Duration::from_secs(2);

pub(super) struct Pace {
    started: Instant,
    updates: u64,
    window_start: Instant,
    window_updates: u64,
    per_second: f64,
}

impl Pace {
    pub(super) fn new(updates: u64) -> Self {
        let now = Instant::now();
        Self { started: now, updates, window_start: now, window_updates: updates, per_second: 0.0 }
    }

    /// Counts an update; true once in a while, when it is time to show something.
    pub(super) fn count(&mut self) -> bool {
        self.updates += 1;
        self.is_time_to_show() || self.updates.is_multiple_of(100)
    }

    fn close_window(&mut self) {
        let elapsed = self.window_start.elapsed().as_secs_f64();
        self.per_second = (self.updates - self.window_updates) as f64 / elapsed;
        (self.window_start, self.window_updates) = (Instant::now(), self.updates);
    }

    /// For whoever makes no update now: true once in a while.
    pub(super) fn is_time_to_show(&mut self) -> bool {
        let is_time = self.window_start.elapsed() >= WINDOW;
        if is_time {
            self.close_window();
        }
        is_time
    }

    pub(super) fn per_second(&self) -> f64 {
        self.per_second
    }

    /// Since training began in this process.
    pub(super) fn seconds(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }
}
