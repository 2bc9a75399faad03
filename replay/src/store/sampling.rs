//! What is drawn from a [`Store`], and how often what.

use std::sync::PoisonError;
use std::time::{Instant, SystemTime};

use getup_proto::{MAX_MESSAGE_BYTES, columns};
use rand_chacha::ChaCha8Rng;

use super::Store;
use crate::error::StoreError;
use crate::gather::{gather, gather_segments};
use crate::minibatch::{
    Item, MAX_N_STEP, Minibatch, MinibatchColumn, OptionsError, SampleOptions, SampledSegment,
};
use crate::ring::{Drawn, Ring};
use crate::undrawn::Followed;

impl Store {
    /// Whether minibatches of this kind can be sampled from this store.
    ///
    /// # Errors
    /// [`OptionsError`] with the first option that is out of range.
    pub fn check_options(&self, options: &SampleOptions) -> Result<(), OptionsError> {
        let &SampleOptions { batch, n_step, gamma, .. } = options;
        // At most two rows of every column, or the longest segment's, and a few numbers.
        let widths: usize = self.spec.columns.iter().map(|column| column.width).sum();
        let rows = if options.segments { self.spec.max_segment_steps + 1 } else { 2 };
        let max = MAX_MESSAGE_BYTES / 2 / ((rows * widths + 2) * columns::VALUE_BYTES);
        if !(1..=max).contains(&batch) {
            return Err(OptionsError::Batch { batch, max });
        }
        if let Some(times) = self.max_times_sampled {
            let (held, capacity) = (self.held_at_least, self.capacity);
            let max = held.saturating_mul(times as usize);
            if batch > max {
                return Err(OptionsError::Draws { batch, max, held, times, capacity });
            }
        }
        let error_buffer = self.gate.limiter().largest_sample();
        if batch as f64 > error_buffer {
            return Err(OptionsError::Buffer { batch, error_buffer });
        }
        if !(1..=MAX_N_STEP).contains(&n_step) {
            return Err(OptionsError::NStep(n_step));
        }
        if !(0.0..=1.0).contains(&gamma) {
            return Err(OptionsError::Gamma(gamma));
        }
        Ok(())
    }

    /// A minibatch, if the limiter lets one out now, of transitions that `rng` and the store's
    /// [`ItemSelector`](crate::ItemSelector) decide on.
    ///
    /// # Errors
    /// [`StoreError::Io`] if the sample cannot be counted.
    pub fn try_sample(
        &self,
        rng: &mut ChaCha8Rng,
        options: &SampleOptions,
    ) -> Result<Option<Minibatch>, StoreError> {
        let started = Instant::now();
        let began = self.traces.is_on().then(SystemTime::now);
        let (sampled, found, items, followed, state, held) = if self.selects {
            let mut memory = self.memory.write().unwrap_or_else(PoisonError::into_inner);
            let Some(sampled) = self.gate.try_sample(options.batch as u64) else { return Ok(None) };
            let drawn = (0..options.batch).map(|_| memory.ring.draw(rng)).collect::<Vec<_>>();
            self.gate.set_available(memory.ring.available());
            let ring = &memory.ring;
            let item =
                |drawn: &Drawn| Item { key: ring.key(drawn.slot), probability: drawn.probability as f32 };
            let items = drawn.iter().map(item).collect();
            let followed = self.followed(ring, &drawn);
            (sampled, found(ring, &drawn, options), items, followed, memory.state, ring.len())
        } else {
            let Some(sampled) = self.gate.try_sample(options.batch as u64) else { return Ok(None) };
            let memory = self.memory();
            let drawn = (0..options.batch).map(|_| memory.ring.draw_uniformly(rng)).collect::<Vec<_>>();
            let found = found(&memory.ring, &drawn, options);
            let followed = self.followed(&memory.ring, &drawn);
            (sampled, found, Vec::new(), followed, memory.state, memory.ring.len())
        };
        // Before it is handed out; not under a lock that writers wait for, since the disk may take long.
        if let Err(error) = self.watermark.raise_sampled(sampled) {
            self.gate.take_back(options.batch as u64);
            return Err(error);
        }
        let counters = self.counters_of(state, sampled, held);
        self.metrics.sampled.inc_by(options.batch as u64);
        self.metrics.sample_seconds.observe(started.elapsed().as_secs_f64());
        self.show_limiter();
        let (columns, segments) = found;
        let sampled = |followed: Followed| self.sampled(&followed, began, options.batch);
        let traces = followed.into_iter().map(sampled).collect();
        Ok(Some(Minibatch { columns, items, segments, counters, traces }))
    }

    /// Gives transitions priorities, by their keys; returns how many were there to get them. A priority of 0 is the
    /// least there is, and does not remove a transition.
    ///
    /// # Errors
    /// [`OptionsError::Priority`] with the first that is negative or not finite: then none is given.
    pub fn update_priorities(&self, priorities: &[(u64, f32)]) -> Result<u64, OptionsError> {
        OptionsError::check_priorities(priorities)?;
        let mut memory = self.memory.write().unwrap_or_else(PoisonError::into_inner);
        let given = priorities.iter().filter(|&&(key, priority)| memory.ring.set_priority(key, priority));
        Ok(given.count() as u64)
    }
}

/// The columns of what was drawn; of whole segments also what they are.
fn found(
    ring: &Ring,
    drawn: &[Drawn],
    options: &SampleOptions,
) -> (Vec<MinibatchColumn>, Vec<SampledSegment>) {
    if options.segments {
        (gather_segments(ring, drawn), drawn.iter().map(|drawn| ring.segment_of(drawn.slot)).collect())
    } else {
        (gather(ring, drawn, options), Vec::new())
    }
}
