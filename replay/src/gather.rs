//! From drawn rows to contiguous columns, with n-step returns.
//!
//! For a transition that begins at step t and spans k steps of one episode,
//!
//! ```text
//! reward   = Σ γⁱ · r(t+i),  i = 0 … k−1
//! discount = γᵏ, or 0 if step t+k−1 ended in a terminal state
//! ```
//!
//! k is n, or less where the episode ends or the ring does not hold what follows: not yet, or not any more. So a one-step target is
//! `reward + discount × V(next)` whatever n is. The sum runs over neighbouring segments of the episode.

use crate::minibatch::{MinibatchColumn, SampleOptions};
use crate::ring::{Drawn, Entry, LayoutColumn, Ring};
use getup_proto::{Rows, columns};
use std::ops::Range;

/// A transition in the ring, and what its n steps amount to.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Transition {
    /// Slot of the row where it begins.
    begin: usize,
    /// Slot of the row where it ends.
    end: usize,
    reward: f32,
    discount: f32,
}

/// Copies the transitions that were drawn into columns, in the order of [`crate::Minibatch`].
pub(crate) fn gather(ring: &Ring, drawn: &[Drawn], options: &SampleOptions) -> Vec<MinibatchColumn> {
    let reward = ring.layout().columns.iter().find(|column| column.name == columns::REWARD);
    let reward = reward.map(|column| column.at.start);
    let span = |drawn: &Drawn| span(ring, drawn.slot, reward, options.n_step, options.gamma);
    let transitions: Vec<Transition> = drawn.iter().map(span).collect();

    let layout = &ring.layout().columns;
    let mut gathered: Vec<MinibatchColumn> = layout
        .iter()
        .map(|column| match reward {
            Some(at) if at == column.at.start => single(columns::REWARD, &transitions, |t| t.reward),
            _ => copy(ring, column.name.clone(), &column.at, transitions.iter().map(|t| t.begin)),
        })
        .collect();
    let with_next = |column: &&LayoutColumn| column.rows == Rows::StepsPlusOne;
    gathered.extend(layout.iter().filter(with_next).map(|column| {
        let name = format!("{}{}", columns::NEXT_PREFIX, column.name);
        copy(ring, name, &column.at, transitions.iter().map(|t| t.end))
    }));
    gathered.push(single(columns::DISCOUNT, &transitions, |t| t.discount));
    gathered
}

/// Copies the whole segments of the transitions that were drawn, column by column, one segment after another.
pub(crate) fn gather_segments(ring: &Ring, drawn: &[Drawn]) -> Vec<MinibatchColumn> {
    let column = |column: &LayoutColumn| {
        let mut data = Vec::new();
        for drawn in drawn {
            let entry = ring.entry_of(drawn.slot);
            let rows = match column.rows {
                Rows::Once => 1,
                Rows::Steps => entry.steps,
                Rows::StepsPlusOne => entry.steps + 1,
            };
            for slot in ring.slots().walk(entry.slot, rows) {
                data.extend_from_slice(&ring.values(slot)[column.at.clone()]);
            }
        }
        MinibatchColumn { name: column.name.clone(), width: column.at.len(), data }
    };
    ring.layout().columns.iter().map(column).collect()
}

/// Follows up to `n` steps of the episode from the row in slot `begin`; `reward` is the place of the reward in a row.
fn span(ring: &Ring, begin: usize, reward: Option<usize>, n: usize, gamma: f32) -> Transition {
    let mut transition = Transition { begin, end: begin, reward: 0.0, discount: 1.0 };
    let steps = ring.steps_from(begin);
    transition.follow(ring, steps.min(n), reward, gamma);
    if n >= steps {
        transition.cross_segments(ring, ring.entry_of(begin), n - steps, reward, gamma);
    }
    transition
}

impl Transition {
    /// Goes on by so many steps, all within one segment.
    fn follow(&mut self, ring: &Ring, steps: usize, reward: Option<usize>, gamma: f32) {
        for _ in 0..steps {
            if let Some(place) = reward {
                self.reward += self.discount * ring.values(self.end)[place];
            }
            self.discount *= gamma;
            self.end = ring.slots().after(self.end);
        }
    }

    /// Goes on by up to `left` steps from the end of the segment `entry`.
    fn cross_segments<'a>(
        &mut self,
        ring: &'a Ring,
        mut entry: &'a Entry,
        mut left: usize,
        reward: Option<usize>,
        gamma: f32,
    ) {
        // The row where a segment ends is the one where its continuation begins.
        while left > 0
            && let Some(continuation) = ring.continuation(entry)
        {
            entry = continuation;
            self.end = entry.slot;
            let steps = entry.steps.min(left);
            self.follow(ring, steps, reward, gamma);
            left -= steps;
            if steps < entry.steps {
                return;
            }
        }
        if entry.terminal {
            self.discount = 0.0;
        }
    }
}

fn copy(ring: &Ring, name: String, at: &Range<usize>, slots: impl Iterator<Item = usize>) -> MinibatchColumn {
    let width = at.len();
    let mut data = Vec::with_capacity(slots.size_hint().0 * width);
    for slot in slots {
        data.extend_from_slice(&ring.values(slot)[at.clone()]);
    }
    MinibatchColumn { name, width, data }
}

fn single(name: &str, transitions: &[Transition], value: impl Fn(&Transition) -> f32) -> MinibatchColumn {
    MinibatchColumn { name: name.to_owned(), width: 1, data: transitions.iter().map(value).collect() }
}

#[cfg(test)]
#[path = "gather_tests.rs"]
mod tests;
