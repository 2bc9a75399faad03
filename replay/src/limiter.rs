//! The rate limiter: Reverb's cursor between two bounds, as a pure state machine ([`Limiter`]).
//!
//! With inserts counted in env steps and samples in transitions, the cursor is
//!
//! ```text
//! cursor = inserts × samples_per_insert − samples
//! ```
//!
//! Sampling waits for `min_size` inserts. From there on the cursor is kept within
//! `min_size × samples_per_insert ± error_buffer`: an insert that would lift it above waits for samples, a sample
//! that would take it below waits for inserts. As long as the buffer has room for one insert and for one sample,
//! the two never wait for each other (Cassirer et al. 2021, "Reverb: a framework for experience replay", §3.4).
//!
//! An insert is first reserved and counts when it is durable, so that many writers at once stay within the band.

use crate::config::ReplayConfig;
use getup_proto::RunSpec;
use std::fmt;

/// The band of the cursor.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Band {
    samples_per_insert: f64,
    /// Bounds of the cursor, in samples.
    min: f64,
    max: f64,
}

/// The cursor, and what it says to writers and samplers.
#[derive(Clone, PartialEq, Debug)]
pub(crate) struct Limiter {
    min_size: u64,
    /// None where nobody is held back once `min_size` is reached.
    band: Option<Band>,
    /// Env steps that are durable.
    inserts: u64,
    /// Env steps under way to become so.
    reserved: u64,
    /// Transitions handed out.
    samples: u64,
    /// Draws that are left in the store; None where there is no limit.
    available: Option<u64>,
    /// Transitions that a sampler waits for, where the draws that are left are fewer.
    wanted: u64,
    /// Added to the cursor where an earlier process had other settings; see [`Limiter::restore`].
    offset: f64,
}

/// Why an insert or a sample must wait.
#[derive(Clone, PartialEq, Debug)]
pub(crate) enum Blocked {
    /// Too few env steps for the first sample.
    MinSize { inserts: u64, min_size: u64 },
    /// There are too few transitions, or they have been sampled as often as they may be.
    Consumed { available: u64, transitions: u64 },
    /// A sample would take the cursor below its band.
    SamplesAhead { inserts: u64, samples: u64, samples_per_insert: f64 },
    /// An insert would lift the cursor above its band.
    InsertsAhead { inserts: u64, samples: u64, samples_per_insert: f64 },
}

impl Limiter {
    /// A limiter before its first insert.
    pub(crate) fn new(config: &ReplayConfig, spec: &RunSpec) -> Self {
        let band = config.samples_per_insert.map(|samples_per_insert| {
            let longest = 2.0 * samples_per_insert * spec.max_segment_steps as f64;
            let middle = config.min_size as f64 * samples_per_insert;
            let error_buffer = config.error_buffer.unwrap_or_else(|| longest.max(0.1 * middle));
            Band { samples_per_insert, min: middle - error_buffer, max: middle + error_buffer }
        });
        Self {
            min_size: config.min_size,
            band,
            inserts: 0,
            reserved: 0,
            samples: 0,
            available: None,
            wanted: 0,
            offset: 0.0,
        }
    }

    /// Goes on from the totals of earlier processes.
    ///
    /// Where they had other settings the cursor may lie outside its band, and one side would wait for as long as
    /// the other needs to catch up; the cursor then begins at the edge of the band instead.
    pub(crate) fn restore(&mut self, inserts: u64, samples: u64) {
        (self.inserts, self.samples, self.offset) = (inserts, samples, 0.0);
        if let Some(band) = self.band {
            // The band holds nobody up before the first sample may be taken.
            let cursor = self.cursor_at(inserts.max(self.min_size), samples);
            self.offset = cursor.clamp(band.min, band.max) - cursor;
        }
    }

    /// Whether an insert of this many env steps must wait.
    pub(crate) fn blocks_insert(&self, env_steps: u64) -> Option<Blocked> {
        let band = self.band?;
        // Whoever waits for transitions waits for inserts: the band must not hold those up, or both would wait.
        if self.available.is_some_and(|available| available < self.wanted) {
            return None;
        }
        let inserts = self.inserts + self.reserved + env_steps;
        let waits = env_steps > 0 && self.cursor_at(inserts, self.samples) > band.max;
        waits.then_some(Blocked::InsertsAhead {
            inserts: self.inserts + self.reserved,
            samples: self.samples,
            samples_per_insert: band.samples_per_insert,
        })
    }

    /// Whether a sample of this many transitions must wait.
    pub(crate) fn blocks_sample(&self, transitions: u64) -> Option<Blocked> {
        if self.inserts < self.min_size {
            return Some(Blocked::MinSize { inserts: self.inserts, min_size: self.min_size });
        }
        if let Some(available) = self.available
            && available < transitions
        {
            return Some(Blocked::Consumed { available, transitions });
        }
        let band = self.band?;
        let waits = self.cursor_at(self.inserts, self.samples + transitions) < band.min;
        waits.then_some(Blocked::SamplesAhead {
            inserts: self.inserts,
            samples: self.samples,
            samples_per_insert: band.samples_per_insert,
        })
    }

    /// Takes room for an insert that is not durable yet.
    pub(crate) fn reserve(&mut self, env_steps: u64) {
        self.reserved += env_steps;
    }

    /// Gives that room back: the insert is durable and counted, or will not happen.
    pub(crate) fn release(&mut self, env_steps: u64) {
        self.reserved -= env_steps;
    }

    /// Notes how many draws are left in the store.
    pub(crate) fn set_available(&mut self, available: Option<u64>) {
        self.available = available;
    }

    /// Notes that a sampler waits for so many transitions; whether that is more than was known.
    pub(crate) fn want(&mut self, transitions: u64) -> bool {
        let more = transitions > self.wanted;
        self.wanted = self.wanted.max(transitions);
        more
    }

    /// Counts env steps that have become durable.
    pub(crate) fn insert(&mut self, env_steps: u64) {
        self.inserts += env_steps;
    }

    /// Counts transitions that are handed out.
    pub(crate) fn sample(&mut self, transitions: u64) {
        self.samples += transitions;
        self.wanted = 0;
    }

    /// Counts them no more: they could not be.
    pub(crate) fn take_back(&mut self, transitions: u64) {
        self.samples -= transitions;
    }

    /// The most transitions that one sample may ever have; a larger one could wait forever.
    pub(crate) fn largest_sample(&self) -> f64 {
        self.band.map_or(f64::INFINITY, |band| (band.max - band.min) / 2.0)
    }

    /// Transitions sampled so far.
    pub(crate) fn samples(&self) -> u64 {
        self.samples
    }

    /// Env steps before the first sample.
    pub(crate) fn min_size(&self) -> u64 {
        self.min_size
    }

    /// Samples per insert, and the cursor's bounds.
    pub(crate) fn band(&self) -> Option<(f64, f64, f64)> {
        self.band.map(|band| (band.samples_per_insert, band.min, band.max))
    }

    /// The cursor; 0 where there is no band to keep it in.
    pub(crate) fn cursor(&self) -> f64 {
        self.cursor_at(self.inserts, self.samples)
    }

    fn cursor_at(&self, inserts: u64, samples: u64) -> f64 {
        let Some(band) = self.band else { return 0.0 };
        inserts as f64 * band.samples_per_insert - samples as f64 + self.offset
    }
}

impl fmt::Display for Blocked {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::MinSize { inserts, min_size } => {
                write!(f, "{} of {} transitions", thousands(inserts), thousands(min_size))
            }
            Self::Consumed { available, transitions } => {
                write!(f, "{} of {} transitions can be sampled", thousands(available), thousands(transitions))
            }
            Self::SamplesAhead { inserts, samples, samples_per_insert } => write!(
                f,
                "{} samples of {} env steps are ahead of {samples_per_insert} samples per insert",
                thousands(samples),
                thousands(inserts)
            ),
            Self::InsertsAhead { inserts, samples, samples_per_insert } => write!(
                f,
                "{} env steps with {} samples are ahead of {samples_per_insert} samples per insert",
                thousands(inserts),
                thousands(samples)
            ),
        }
    }
}

/// `1234567` as `1,234,567`.
fn thousands(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::with_capacity(digits.len() + digits.len() / 3);
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
#[path = "limiter_tests.rs"]
mod tests;
