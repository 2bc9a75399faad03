//! The transitions that can be sampled, in memory: [`Ring`].
//!
//! A segment of T steps takes T + 1 rows. A row holds, side by side, everything that belongs to one step: the
//! observation before it, its action, its reward, and the episode's β̂; the last row holds the final observation
//! alone. So a transition is two neighbouring rows, no next state is stored twice, and sampling one touches one
//! place in memory. In front of each row stands how many steps follow it in its segment, which is all that most
//! samples need to know of the segment. Rows are numbered from the first ever pushed and lie in a buffer that wraps
//! around.
//!
//! The oldest segments leave, whole, when a new one would exceed the capacity. What is in the ring is therefore a
//! function of the segments pushed most recently, however many were pushed before: a ring that is rebuilt from
//! the log equals the one that was lost.

use crate::config::ReplayConfig;
use crate::minibatch::SampledSegment;
use crate::selector::Selector;
use getup_proto::{ColumnSpec, Rows, RunSpec, Segment, columns};
use rand::Rng;
use std::collections::{HashMap, VecDeque};
use std::ops::Range;

/// A row, by its number since the ring began.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Row(u64);

impl Row {
    /// Counts from the first row ever pushed.
    #[cfg(test)]
    pub(crate) fn number(self) -> u64 {
        self.0
    }
}

/// The newest transitions, up to a capacity.
#[derive(Debug)]
pub(crate) struct Ring {
    layout: Layout,
    /// Transitions that may be in the ring.
    capacity: usize,
    /// Transitions that are.
    transitions: usize,
    /// Row after row.
    values: Vec<f32>,
    /// Rows that `values` has room for.
    slots: usize,
    segments: VecDeque<Entry>,
    /// Number of the oldest segment.
    first_segment: u64,
    /// Numbers of the rows in the ring.
    live: Range<u64>,
    /// Slot of the oldest row.
    first_slot: usize,
    /// The newest segment of each episode that may go on.
    unfinished: HashMap<Lane, u64>,
    /// None where any row may be drawn any number of times.
    selector: Option<Selector>,
    /// Key of the next transition that is pushed: the transitions ever stored before it.
    next_key: u64,
}

/// A transition that was drawn.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Drawn {
    /// Where it begins.
    pub(crate) row: Row,
    /// With which it was drawn.
    pub(crate) probability: f64,
}

/// Where each column of the spec lies in a row.
#[derive(Debug)]
pub(crate) struct Layout {
    /// In the spec's order.
    pub(crate) columns: Vec<LayoutColumn>,
    /// Values a row, the number of steps that follow it included.
    stride: usize,
}

#[derive(Debug)]
pub(crate) struct LayoutColumn {
    pub(crate) name: String,
    pub(crate) rows: Rows,
    /// Place in the row.
    pub(crate) at: Range<usize>,
}

/// A lane, among those of all writers.
type Lane = (u64, u32);

/// A segment in the ring.
#[derive(Clone, Debug)]
pub(crate) struct Entry {
    pub(crate) first_row: Row,
    /// Key of its first transition.
    first_key: u64,
    pub(crate) steps: usize,
    pub(crate) terminal: bool,
    truncated: bool,
    /// Number of the segment that continues the episode.
    continued_by: Option<u64>,
    lane: Lane,
    episode: u64,
    /// Index in the episode of the step after the last.
    next_step: u64,
}

impl Ring {
    /// An empty ring for `config.capacity` transitions, drawn as `config` says. Memory is taken as it fills.
    pub(crate) fn new(spec: &RunSpec, config: &ReplayConfig) -> Self {
        let capacity = config.capacity;
        let layout = Layout::new(spec);
        // One row more a segment: enough where segments have 8 steps on average. Below that rows run out before
        // transitions do, and the ring holds somewhat fewer.
        let slots = capacity + capacity / 8 + spec.max_segment_steps + 1;
        Self {
            values: vec![0.0; slots * layout.stride],
            slots,
            layout,
            capacity,
            transitions: 0,
            segments: VecDeque::new(),
            first_segment: 0,
            live: 0..0,
            first_slot: 0,
            unfinished: HashMap::new(),
            selector: Selector::new(config.sampler, config.max_times_sampled, slots),
            next_key: 0,
        }
    }

    /// Adds a segment that follows the ring's spec, and drops the oldest ones to make room.
    pub(crate) fn push(&mut self, segment: &Segment) {
        let rows = segment.steps as u64 + 1;
        while self.transitions + segment.steps > self.capacity || self.rows() + rows > self.slots as u64 {
            self.evict();
        }
        let number = self.first_segment + self.segments.len() as u64;
        let first_row = Row(self.live.end);
        self.live.end += rows;
        self.write_rows(first_row, segment);
        if let Some(selector) = &mut self.selector {
            for step in 0..segment.steps as u64 {
                let slot = self.first_slot + (first_row.0 + step - self.live.start) as usize;
                selector.insert(slot % self.slots);
            }
        }
        self.link(number, segment);
        self.transitions += segment.steps;
        self.segments.push_back(Entry {
            first_row,
            first_key: self.next_key,
            steps: segment.steps,
            terminal: segment.terminal,
            truncated: segment.truncated,
            continued_by: None,
            lane: (segment.writer, segment.lane),
            episode: segment.episode,
            next_step: u64::from(segment.first_step) + segment.steps as u64,
        });
        self.next_key += segment.steps as u64;
    }

    /// Transitions in the ring.
    pub(crate) fn len(&self) -> usize {
        self.transitions
    }

    /// Rows in the ring.
    pub(crate) fn rows(&self) -> u64 {
        self.live.end - self.live.start
    }

    /// Bytes that a full ring takes.
    pub(crate) fn memory_bytes(&self) -> usize {
        size_of_val(self.values.as_slice())
    }

    /// Numbers the transitions so that so many were ever stored: keys are the same after a restart.
    pub(crate) fn set_stored(&mut self, transitions: u64) {
        let shift = transitions - self.next_key;
        self.next_key = transitions;
        self.segments.iter_mut().for_each(|entry| entry.first_key += shift);
    }

    /// Whether draws leave a trace, or depend on more than the rows: [`Ring::draw`] then, and not
    /// [`Ring::draw_uniformly`].
    pub(crate) fn selects(&self) -> bool {
        self.selector.is_some()
    }

    /// How many draws are left before transitions must come; None where there is no limit.
    pub(crate) fn available(&self) -> Option<u64> {
        if self.transitions == 0 { Some(0) } else { self.selector.as_ref().and_then(Selector::available) }
    }

    /// Draws a transition, each with the same probability.
    ///
    /// # Panics
    /// If the ring is empty.
    pub(crate) fn draw_uniformly(&self, rng: &mut impl Rng) -> Drawn {
        loop {
            // Rows are uniform, and so are those of them that begin a transition: all but one a segment.
            let row = self.nth_row(rng.random_range(0..self.rows()));
            if self.steps_from(self.slot(row)) > 0 {
                return Drawn { row, probability: 1.0 / self.transitions as f64 };
            }
        }
    }

    /// Draws a transition as the store's sampler does.
    ///
    /// # Panics
    /// If there is none that can be drawn.
    pub(crate) fn draw(&mut self, rng: &mut impl Rng) -> Drawn {
        let Some(selector) = &mut self.selector else { return self.draw_uniformly(rng) };
        let (slot, probability) = selector.draw(rng, self.first_slot);
        let from_oldest = (slot + self.slots - self.first_slot) % self.slots;
        Drawn { row: Row(self.live.start + from_oldest as u64), probability }
    }

    /// What names a transition for as long as it is stored, also after a restart.
    pub(crate) fn key(&self, row: Row) -> u64 {
        let entry = self.entry_of(row);
        entry.first_key + (row.0 - entry.first_row.0)
    }

    /// Gives a transition a priority; false if it is gone, or priorities do not count.
    pub(crate) fn set_priority(&mut self, key: u64, priority: f32) -> bool {
        let Some(place) = self.segments.partition_point(|entry| entry.first_key <= key).checked_sub(1) else {
            return false;
        };
        let entry = &self.segments[place];
        let step = key - entry.first_key;
        if step >= entry.steps as u64 {
            return false;
        }
        let slot = self.slot(Row(entry.first_row.0 + step));
        self.selector.as_mut().is_some_and(|selector| selector.set_priority(slot, priority))
    }

    pub(crate) fn layout(&self) -> &Layout {
        &self.layout
    }

    /// The `n`th of the rows in the ring, from the oldest.
    pub(crate) fn nth_row(&self, n: u64) -> Row {
        Row(self.live.start + n)
    }

    /// Steps of the row's segment from the row in `slot` on; a transition begins where there are some.
    pub(crate) fn steps_from(&self, slot: usize) -> usize {
        self.values[slot * self.layout.stride] as usize
    }

    /// The segment that a row belongs to.
    pub(crate) fn entry_of(&self, row: Row) -> &Entry {
        &self.segments[self.segments.partition_point(|entry| entry.first_row.0 <= row.0) - 1]
    }

    /// The segment that a row belongs to, as samplers are told of it.
    pub(crate) fn segment_of(&self, row: Row) -> SampledSegment {
        let entry = self.entry_of(row);
        SampledSegment {
            writer: entry.lane.0,
            lane: entry.lane.1,
            episode: entry.episode,
            first_step: (entry.next_step - entry.steps as u64) as u32,
            steps: entry.steps as u32,
            terminal: entry.terminal,
            truncated: entry.truncated,
        }
    }

    /// The segment that continues the episode, where it is there.
    pub(crate) fn continuation(&self, entry: &Entry) -> Option<&Entry> {
        entry.continued_by.map(|number| &self.segments[(number - self.first_segment) as usize])
    }

    /// Where in the buffer a row lies.
    pub(crate) fn slot(&self, row: Row) -> usize {
        let slot = self.first_slot + (row.0 - self.live.start) as usize;
        if slot < self.slots { slot } else { slot - self.slots }
    }

    /// The slot of the row after the one in `slot`.
    pub(crate) fn slot_after(&self, slot: usize) -> usize {
        if slot + 1 == self.slots { 0 } else { slot + 1 }
    }

    /// The values of the row in `slot`.
    pub(crate) fn values(&self, slot: usize) -> &[f32] {
        &self.values[slot * self.layout.stride..][..self.layout.stride]
    }

    fn evict(&mut self) {
        let entry = self.segments.pop_front().expect("a ring has room for its longest segment");
        if let Some(selector) = &mut self.selector {
            (0..entry.steps).for_each(|step| selector.remove((self.first_slot + step) % self.slots));
        }
        self.transitions -= entry.steps;
        self.live.start += entry.steps as u64 + 1;
        self.first_slot = (self.first_slot + entry.steps + 1) % self.slots;
        if self.unfinished.get(&entry.lane) == Some(&self.first_segment) {
            self.unfinished.remove(&entry.lane);
        }
        self.first_segment += 1;
    }

    fn write_rows(&mut self, first_row: Row, segment: &Segment) {
        let stride = self.layout.stride;
        let mut slot = self.slot(first_row);
        for step in 0..=segment.steps {
            let row = &mut self.values[slot * stride..][..stride];
            // A segment has at most 2^16 steps: exact.
            row[0] = (segment.steps - step) as f32;
            for (column, bytes) in self.layout.columns.iter().zip(&segment.columns) {
                let from = match column.rows {
                    Rows::Once => 0,
                    // The last row has no step.
                    Rows::Steps if step == segment.steps => continue,
                    Rows::Steps | Rows::StepsPlusOne => step,
                };
                let row_bytes = column.at.len() * columns::VALUE_BYTES;
                columns::decode_into(&bytes[from * row_bytes..][..row_bytes], &mut row[column.at.clone()]);
            }
            slot = self.slot_after(slot);
        }
    }

    /// Notes that `segment`, which is about to be pushed as `number`, goes on where an earlier one ended.
    fn link(&mut self, number: u64, segment: &Segment) {
        let lane = (segment.writer, segment.lane);
        if let Some(previous) = self.unfinished.remove(&lane) {
            let previous = &mut self.segments[(previous - self.first_segment) as usize];
            if previous.episode == segment.episode && previous.next_step == u64::from(segment.first_step) {
                previous.continued_by = Some(number);
            }
        }
        if !segment.terminal && !segment.truncated {
            self.unfinished.insert(lane, number);
        }
    }
}

impl Layout {
    fn new(spec: &RunSpec) -> Self {
        let place = |column: &ColumnSpec| LayoutColumn {
            name: column.name.clone(),
            rows: column.rows,
            at: 0..column.width,
        };
        let mut columns: Vec<LayoutColumn> = spec.columns.iter().map(place).collect();
        // Narrow columns first: the reward lies beside the number of steps, on the same cache line.
        let mut by_width: Vec<&mut LayoutColumn> = columns.iter_mut().collect();
        by_width.sort_by_key(|column| column.at.len());
        let mut stride = 1;
        for column in by_width {
            column.at = stride..stride + column.at.len();
            stride = column.at.end;
        }
        Self { columns, stride }
    }
}

#[cfg(test)]
#[path = "ring_tests.rs"]
mod tests;
