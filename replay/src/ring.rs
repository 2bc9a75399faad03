//! The transitions that can be sampled, in memory: [`Ring`].
//!
//! A segment of T steps takes T + 1 rows. A row holds, side by side, everything that belongs to one step: the
//! observation before it, its action, its reward, and the episode's β̂; the last row holds the final observation
//! alone. So a transition is two neighbouring rows, no next state is stored twice, and sampling one touches one
//! place in memory. In front of each row stands how many steps follow it in its segment, which is all that most
//! samples need to know of the segment. [`Slots`] says where in the buffer rows lie.
//!
//! Segments leave, whole, when a new one would exceed the capacity: the oldest, or those of the lowest priority. Where
//! the oldest leave, what is in the ring is a function of the segments pushed most recently, however many were pushed
//! before: a ring that is rebuilt from the log equals the one that was lost. Where priorities decide, a rebuilt ring
//! begins with the newest segments, as none has a priority yet.

use crate::config::ReplayConfig;
use crate::minibatch::SampledSegment;
use crate::remover::{Lowest, Remover};
use crate::selector::Selector;
use crate::slots::Slots;
use getup_proto::{ColumnSpec, Rows, RunSpec, Segment, columns};
use rand::Rng;
use std::collections::{HashMap, VecDeque};
use std::ops::Range;

/// The transitions that can be sampled, up to a capacity.
#[derive(Debug)]
pub(crate) struct Ring {
    layout: Layout,
    /// Transitions that may be in the ring.
    capacity: usize,
    /// Transitions since a segment began, after which it leaves at the latest: as many as the log keeps.
    window: u64,
    /// Transitions that are in the ring.
    transitions: usize,
    /// A row in each slot.
    values: Vec<f32>,
    slots: Slots,
    /// From the oldest that is in the ring on; those after it that have left keep their places, with no steps. All are
    /// within the window.
    segments: VecDeque<Entry>,
    /// Number of the oldest segment.
    first_segment: u64,
    /// None where the oldest leave first.
    lowest: Option<Lowest>,
    /// The newest segment of each episode that may go on.
    unfinished: HashMap<Lane, u64>,
    /// None where any row may be drawn any number of times.
    selector: Option<Selector>,
    /// Transitions ever pushed.
    pushed: u64,
    /// Transitions that were stored before the first of these.
    stored_before: u64,
}

/// A transition that was drawn.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Drawn {
    /// Slot of the row where it begins.
    pub(crate) slot: usize,
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
    /// Of its first row.
    pub(crate) slot: usize,
    /// Transitions pushed before its first.
    pushed_before: u64,
    /// 0 where it has left.
    pub(crate) steps: usize,
    pub(crate) terminal: bool,
    truncated: bool,
    /// Number of the segment that continues the episode; it may have left.
    continued_by: Option<u64>,
    lane: Lane,
    episode: u64,
    /// Index in the episode of the step after the last.
    next_step: u64,
}

impl Ring {
    /// An empty ring for `config.capacity` transitions, drawn and removed as `config` says. Memory is taken as it fills.
    pub(crate) fn new(spec: &RunSpec, config: &ReplayConfig) -> Self {
        let capacity = config.capacity;
        let layout = Layout::new(spec);
        let slots = slots(spec, config);
        Self {
            values: vec![0.0; slots * layout.stride],
            slots: Slots::new(slots, config.remover == Remover::Fifo),
            layout,
            capacity,
            window: config.kept(),
            transitions: 0,
            segments: VecDeque::new(),
            first_segment: 0,
            lowest: (config.remover != Remover::Fifo).then(Lowest::default),
            unfinished: HashMap::new(),
            selector: Selector::new(config.sampler, config.max_times_sampled, slots),
            pushed: 0,
            stored_before: 0,
        }
    }

    /// Transitions that a ring holds at least from its first removal on, however long its segments are.
    ///
    /// With segments of up to L steps: one is removed where a new one has no room, so that afterwards less than L
    /// transitions lack to the capacity, or at most L slots are free; and at least half of the rows begin a transition.
    /// Where not the oldest leave first, age may remove up to L − 1 transitions more than come.
    pub(crate) fn held_at_least(spec: &RunSpec, config: &ReplayConfig) -> usize {
        let longest = spec.max_segment_steps;
        let by_transitions = config.capacity - (longest - 1);
        let by_rows = (slots(spec, config) - longest).div_ceil(2);
        let by_age = if config.remover == Remover::Fifo { 0 } else { longest - 1 };
        by_transitions.min(by_rows) - by_age
    }

    /// Adds a segment that follows the ring's spec, and removes others to make room.
    pub(crate) fn push(&mut self, segment: &Segment) {
        self.make_room(segment.steps);
        let number = self.first_segment + self.segments.len() as u64;
        let slot = self.slots.take(segment.steps + 1, number);
        self.write_rows(slot, segment);
        self.link(number, segment);
        self.transitions += segment.steps;
        self.segments.push_back(Entry {
            slot,
            pushed_before: self.pushed,
            steps: segment.steps,
            terminal: segment.terminal,
            truncated: segment.truncated,
            continued_by: None,
            lane: (segment.writer, segment.lane),
            episode: segment.episode,
            next_step: u64::from(segment.first_step) + segment.steps as u64,
        });
        self.pushed += segment.steps as u64;
        if let Some(selector) = &mut self.selector {
            self.slots.walk(slot, segment.steps).for_each(|slot| selector.insert(slot));
        }
        self.weigh(slot);
    }

    /// Transitions in the ring.
    pub(crate) fn len(&self) -> usize {
        self.transitions
    }

    /// Rows in the ring.
    pub(crate) fn rows(&self) -> usize {
        self.slots.rows()
    }

    /// Numbers of the segments in the ring, from the oldest to the one after the newest; some between may have left.
    pub(crate) fn numbers(&self) -> Range<u64> {
        self.first_segment..self.first_segment + self.segments.len() as u64
    }

    /// The number of the segment that the row in `slot` belongs to.
    pub(crate) fn number_of(&self, slot: usize) -> u64 {
        self.first_segment + self.place_of(slot) as u64
    }

    /// Bytes that a full ring takes.
    pub(crate) fn memory_bytes(&self) -> usize {
        size_of_val(self.values.as_slice())
    }

    /// Numbers the transitions so that so many were ever stored: keys are the same after a restart.
    pub(crate) fn set_stored(&mut self, transitions: u64) {
        self.stored_before = transitions - self.pushed;
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

    /// Draws a transition, each with the same probability, where the oldest segments leave first.
    ///
    /// # Panics
    /// If the ring is empty.
    pub(crate) fn draw_uniformly(&self, rng: &mut impl Rng) -> Drawn {
        loop {
            // Rows are uniform, and so are those of them that begin a transition: all but one a segment.
            let slot = self.nth_row(rng.random_range(0..self.rows() as u64) as usize);
            if self.steps_from(slot) > 0 {
                return Drawn { slot, probability: 1.0 / self.transitions as f64 };
            }
        }
    }

    /// Draws a transition as the store's sampler does.
    ///
    /// # Panics
    /// If there is none that can be drawn.
    pub(crate) fn draw(&mut self, rng: &mut impl Rng) -> Drawn {
        let Some(selector) = &mut self.selector else { return self.draw_uniformly(rng) };
        let (slot, probability) = selector.draw(rng, self.slots.nth(0));
        // What can be drawn no more counts for nothing.
        if selector.weight(slot) == 0.0 {
            self.weigh(slot);
        }
        Drawn { slot, probability }
    }

    /// What names the transition that begins in `slot` for as long as it is stored, also after a restart.
    pub(crate) fn key(&self, slot: usize) -> u64 {
        let entry = self.entry_of(slot);
        self.stored_before + entry.pushed_before + (entry.steps - self.steps_from(slot)) as u64
    }

    /// Gives a transition a priority; false if it is gone, or priorities do not count.
    pub(crate) fn set_priority(&mut self, key: u64, priority: f32) -> bool {
        let (Some(slot), Some(selector)) = (self.slot_of(key), &mut self.selector) else { return false };
        let given = selector.set_priority(slot, priority);
        self.weigh(slot);
        given
    }

    /// The slot of the row where the transition begins that this key names, where it is there.
    pub(crate) fn slot_of(&self, key: u64) -> Option<usize> {
        let nth = key.checked_sub(self.stored_before)?;
        let after = self.segments.partition_point(|entry| entry.pushed_before <= nth);
        let entry = &self.segments[after.checked_sub(1)?];
        let step = (nth - entry.pushed_before) as usize;
        (step < entry.steps).then(|| self.slots.ahead(entry.slot, step))
    }

    pub(crate) fn layout(&self) -> &Layout {
        &self.layout
    }

    /// The slot of the `n`th of the rows in the ring, from the oldest, where the oldest segments leave first.
    pub(crate) fn nth_row(&self, n: usize) -> usize {
        self.slots.nth(n)
    }

    /// Steps of the row's segment from the row in `slot` on; a transition begins where there are some.
    pub(crate) fn steps_from(&self, slot: usize) -> usize {
        self.values[slot * self.layout.stride] as usize
    }

    /// The segment that the row in `slot` belongs to.
    pub(crate) fn entry_of(&self, slot: usize) -> &Entry {
        &self.segments[self.place_of(slot)]
    }

    /// The segment that the row in `slot` belongs to, as samplers are told of it.
    pub(crate) fn segment_of(&self, slot: usize) -> SampledSegment {
        let entry = self.entry_of(slot);
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
        let number = entry.continued_by?;
        // It came after the entry, and what comes after one that is there keeps its place.
        self.segments.get((number - self.first_segment) as usize).filter(|entry| entry.steps > 0)
    }

    pub(crate) fn slots(&self) -> &Slots {
        &self.slots
    }

    /// The values of the row in `slot`.
    pub(crate) fn values(&self, slot: usize) -> &[f32] {
        &self.values[slot * self.layout.stride..][..self.layout.stride]
    }

    /// Removes segments until one of so many steps has room.
    fn make_room(&mut self, steps: usize) {
        let pushed = self.pushed + steps as u64;
        while self.segments.front().is_some_and(|oldest| oldest.pushed_before + self.window < pushed) {
            self.remove(self.first_segment);
        }
        while self.transitions + steps > self.capacity || steps + 1 > self.slots.free() {
            let lowest = self.lowest.as_ref().and_then(Lowest::first);
            self.remove(lowest.unwrap_or(self.first_segment));
        }
    }

    fn remove(&mut self, number: u64) {
        let entry = self.segments.get_mut((number - self.first_segment) as usize);
        let entry = entry.expect("a ring has room for its longest segment");
        let (slot, steps, lane) = (entry.slot, std::mem::take(&mut entry.steps), entry.lane);
        if let Some(selector) = &mut self.selector {
            self.slots.walk(slot, steps).for_each(|slot| selector.remove(slot));
        }
        if let Some(lowest) = &mut self.lowest {
            lowest.remove(number);
        }
        self.slots.give_back(slot, steps + 1);
        self.transitions -= steps;
        if self.unfinished.get(&lane) == Some(&number) {
            self.unfinished.remove(&lane);
        }
        while self.segments.front().is_some_and(|entry| entry.steps == 0) {
            self.segments.pop_front();
            self.first_segment += 1;
        }
    }

    /// Finds where the segment that the row in `slot` belongs to comes in the order in which priorities make segments
    /// leave, when the weights of its transitions have changed.
    fn weigh(&mut self, slot: usize) {
        if self.lowest.is_none() {
            return;
        }
        let place = self.place_of(slot);
        if let (Some(lowest), Some(selector)) = (&mut self.lowest, &self.selector) {
            let entry = &self.segments[place];
            let weights = self.slots.walk(entry.slot, entry.steps).map(|slot| selector.weight(slot));
            lowest.set(self.first_segment + place as u64, weights.fold(0.0, f64::max));
        }
    }

    /// The place of the segment that the row in `slot` belongs to.
    fn place_of(&self, slot: usize) -> usize {
        match &self.slots {
            Slots::InOrder(order) => {
                let age = order.age(slot);
                self.segments.partition_point(|entry| order.age(entry.slot) <= age) - 1
            }
            Slots::Linked(linked) => (linked.segment(slot) - self.first_segment) as usize,
        }
    }

    /// Writes the rows of the segment whose first is in `slot`.
    fn write_rows(&mut self, slot: usize, segment: &Segment) {
        let stride = self.layout.stride;
        for (step, slot) in self.slots.walk(slot, segment.steps + 1).enumerate() {
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

/// Rows that a ring has room for. One more a segment than transitions: enough where segments have 8 steps on average. Below
/// that rows run out before transitions do, and the ring holds fewer: see [`Ring::held_at_least`].
fn slots(spec: &RunSpec, config: &ReplayConfig) -> usize {
    config.capacity + config.capacity / 8 + spec.max_segment_steps + 1
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
