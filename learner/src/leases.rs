//! Evaluations on lease: a state machine without a clock or a network of its own.
//!
//! An evaluation is offered, leased to one actor, kept alive by that actor's heartbeats, and reported once; a
//! lease whose holder falls silent is offered again under a new number, so that a late report of the old one is
//! refused. Results leave in the order in which their evaluations were offered, which is the order of versions.
//!
//! One that nobody holds when the next is offered is superseded by it: where actors cannot evaluate as often as they are
//! asked to, they evaluate the newest, and nothing piles up.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Why a report is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LeaseError {
    /// The lease was never given, was reported, or went to another holder.
    #[error(
        "lease {0} is not held: it was reported already, or its holder was silent and it went to another actor"
    )]
    NotHeld(u64),
    /// The report has another number of episodes than the lease.
    #[error("lease {lease} asks for {wanted} episodes, the report has {got}")]
    Episodes {
        /// The lease.
        lease: u64,
        /// Episodes asked for.
        wanted: usize,
        /// Episodes reported.
        got: usize,
    },
}

#[derive(Debug)]
enum State<R> {
    Offered,
    Leased { id: u64, holder: String, expires: Instant },
    Reported(R),
}

/// What [`Leases::counts`] counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LeaseCounts {
    /// Evaluations on offer now.
    pub offered: usize,
    /// Evaluations on lease now.
    pub leased: usize,
    /// Leases lost by their holders' silence, ever.
    pub expirations: u64,
    /// Evaluations that nobody held when the next was offered, ever.
    pub superseded: u64,
}

/// The table: `T` is an evaluation, `R` its result.
#[derive(Debug)]
pub struct Leases<T, R> {
    keep_alive: Duration,
    next_id: u64,
    expirations: u64,
    superseded: u64,
    table: VecDeque<(T, State<R>)>,
}

impl<T, R> Leases<T, R> {
    /// A table whose leases last `keep_alive` beyond the last heartbeat.
    pub fn new(keep_alive: Duration) -> Self {
        Self { keep_alive, next_id: 1, expirations: 0, superseded: 0, table: VecDeque::new() }
    }

    /// Evaluations that are offered, leased, or reported and not yet taken.
    pub fn len(&self) -> usize {
        self.table.len()
    }

    /// Whether nothing is outstanding.
    pub fn is_empty(&self) -> bool {
        self.table.is_empty()
    }

    /// Offers an evaluation, in place of those that nobody holds.
    pub fn offer(&mut self, evaluation: T) {
        let before = self.table.len();
        self.table.retain(|(_, state)| !matches!(state, State::Offered));
        self.superseded += (before - self.table.len()) as u64;
        self.table.push_back((evaluation, State::Offered));
    }

    /// The oldest evaluation nobody holds, now leased to `holder`, with the lease's number. One who holds a lease already did
    /// not hear of it: it is told again, for what is left of the lease.
    pub fn acquire(&mut self, holder: &str, now: Instant) -> Option<(u64, &T)> {
        self.expire(now);
        let held = self.table.iter().enumerate().find_map(|(index, (_, state))| match state {
            State::Leased { id, holder: held_by, .. } if held_by == holder => Some((*id, index)),
            _ => None,
        });
        if let Some((id, index)) = held {
            return Some((id, &self.table[index].0));
        }
        let (evaluation, state) = self.table.iter_mut().find(|(_, state)| matches!(state, State::Offered))?;
        let id = self.next_id;
        self.next_id += 1;
        *state = State::Leased { id, holder: holder.to_owned(), expires: now + self.keep_alive };
        Some((id, evaluation))
    }

    /// Prolongs a lease; false where it is not held by `holder` any more.
    pub fn keep_alive(&mut self, lease: u64, holder: &str, now: Instant) -> bool {
        let until = now + self.keep_alive;
        self.expire(now);
        self.table.iter_mut().any(|(_, state)| match state {
            State::Leased { id, holder: held_by, expires } if *id == lease && held_by == holder => {
                *expires = until;
                true
            }
            _ => false,
        })
    }

    /// Offers again what `holder` holds: it ends.
    pub fn release(&mut self, holder: &str) {
        for (_, state) in &mut self.table {
            if matches!(state, State::Leased { holder: held_by, .. } if held_by == holder) {
                *state = State::Offered;
            }
        }
    }

    /// How things stand.
    pub fn counts(&self) -> LeaseCounts {
        let count =
            |wanted: fn(&State<R>) -> bool| self.table.iter().filter(|(_, state)| wanted(state)).count();
        LeaseCounts {
            offered: count(|state| matches!(state, State::Offered)),
            leased: count(|state| matches!(state, State::Leased { .. })),
            expirations: self.expirations,
            superseded: self.superseded,
        }
    }

    /// Takes the report of a lease.
    pub fn report(&mut self, lease: u64, result: R) -> Result<(), LeaseError> {
        let held = self
            .table
            .iter_mut()
            .find(|(_, state)| matches!(state, State::Leased { id, .. } if *id == lease));
        match held {
            Some((_, state)) => {
                *state = State::Reported(result);
                Ok(())
            }
            None => Err(LeaseError::NotHeld(lease)),
        }
    }

    /// The evaluation of a lease that is held.
    pub fn held(&self, lease: u64) -> Option<&T> {
        let held =
            self.table.iter().find(|(_, state)| matches!(state, State::Leased { id, .. } if *id == lease));
        held.map(|(evaluation, _)| evaluation)
    }

    /// The oldest evaluation with its result, once it is reported; a younger one waits for it.
    pub fn take_reported(&mut self) -> Option<(T, R)> {
        match self.table.pop_front()? {
            (evaluation, State::Reported(result)) => Some((evaluation, result)),
            unreported => {
                self.table.push_front(unreported);
                None
            }
        }
    }

    fn expire(&mut self, now: Instant) {
        for (_, state) in &mut self.table {
            if matches!(state, State::Leased { expires, .. } if *expires <= now) {
                *state = State::Offered;
                self.expirations += 1;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const KEEP_ALIVE: Duration = Duration::from_secs(10);

    #[test]
    fn a_lease_is_given_to_one_actor_and_reported_once() {
        let (mut leases, now) = (Leases::new(KEEP_ALIVE), Instant::now());
        leases.offer("a");
        let (lease, evaluation) = leases.acquire("actor-1", now).unwrap();
        assert_eq!(*evaluation, "a");
        assert!(leases.acquire("actor-2", now).is_none());
        assert_eq!(leases.report(lease, 1), Ok(()));
        assert_eq!(leases.report(lease, 2), Err(LeaseError::NotHeld(lease)));
        assert_eq!(leases.take_reported(), Some(("a", 1)));
        assert!(leases.is_empty());
    }

    #[test]
    fn a_silent_holder_loses_its_lease_and_its_late_report_is_refused() {
        let (mut leases, now) = (Leases::new(KEEP_ALIVE), Instant::now());
        leases.offer("a");
        let (first, _) = leases.acquire("actor-1", now).unwrap();
        assert!(leases.keep_alive(first, "actor-1", now + KEEP_ALIVE / 2));
        assert!(!leases.keep_alive(first, "actor-2", now + KEEP_ALIVE / 2));
        assert!(leases.acquire("actor-2", now + KEEP_ALIVE).is_none());
        let (second, _) = leases.acquire("actor-2", now + KEEP_ALIVE * 3 / 2).unwrap();
        assert_eq!(leases.report(first, 1), Err(LeaseError::NotHeld(first)));
        assert_eq!(leases.report(second, 2), Ok(()));
        assert_eq!(leases.take_reported(), Some(("a", 2)));
    }

    #[test]
    fn a_holder_that_did_not_hear_of_its_lease_is_told_again() {
        let (mut leases, now) = (Leases::<_, ()>::new(KEEP_ALIVE), Instant::now());
        leases.offer("a");
        let (lease, _) = leases.acquire("actor-1", now).unwrap();
        leases.offer("b");
        assert_eq!(leases.acquire("actor-1", now + KEEP_ALIVE / 2), Some((lease, &"a")));
        // One that never hears of it does not keep it for ever.
        let late = now + KEEP_ALIVE;
        let (other, evaluation) = leases.acquire("actor-2", late).unwrap();
        assert!(other != lease && *evaluation == "a");
        assert_eq!(leases.acquire("actor-1", late).unwrap().1, &"b");
    }

    #[test]
    fn results_leave_in_the_order_of_the_offers() {
        let (mut leases, now) = (Leases::new(KEEP_ALIVE), Instant::now());
        leases.offer("a");
        let (first, _) = leases.acquire("actor-1", now).unwrap();
        leases.offer("b");
        let (second, _) = leases.acquire("actor-2", now).unwrap();
        leases.report(second, 2).unwrap();
        assert_eq!(leases.take_reported(), None);
        leases.report(first, 1).unwrap();
        assert_eq!(leases.take_reported(), Some(("a", 1)));
        assert_eq!(leases.take_reported(), Some(("b", 2)));
    }

    #[test]
    fn what_nobody_holds_gives_way_to_the_next() {
        let (mut leases, now) = (Leases::<_, ()>::new(KEEP_ALIVE), Instant::now());
        leases.offer("held");
        leases.acquire("actor-1", now).unwrap();
        for name in ["late", "later", "newest"] {
            leases.offer(name);
        }
        assert_eq!(leases.acquire("actor-2", now).unwrap().1, &"newest");
        assert_eq!(leases.counts(), LeaseCounts { offered: 0, leased: 2, expirations: 0, superseded: 2 });
    }

    proptest! {
        #[test]
        fn whatever_actors_do_each_evaluation_gives_one_result_in_order_or_gives_way(
            moves in proptest::collection::vec((0u8..5, 0u64..4, 0u64..12), 1..300)
        ) {
            let mut leases = Leases::new(KEEP_ALIVE);
            let mut now = Instant::now();
            let (mut offered, mut taken) = (0u64, Vec::new());
            // Leases, and who got them.
            let mut held: Vec<(u64, u64)> = Vec::new();
            for (action, actor, seconds) in moves {
                now += Duration::from_secs(seconds);
                match action {
                    0 => { leases.offer(offered); offered += 1; }
                    1 => if let Some((lease, _)) = leases.acquire(&actor.to_string(), now) {
                        match held.iter().find(|(known, _)| *known == lease) {
                            Some((_, holder)) => prop_assert_eq!(*holder, actor, "a lease's number is used once"),
                            None => held.push((lease, actor)),
                        }
                    },
                    2 => if let Some((lease, _)) = held.get(actor as usize) {
                        leases.keep_alive(*lease, &actor.to_string(), now);
                    },
                    3 => if let Some((lease, _)) = held.get(actor as usize).copied() {
                        let evaluation = leases.held(lease).copied();
                        let accepted = leases.report(lease, evaluation.unwrap_or(u64::MAX)).is_ok();
                        prop_assert_eq!(accepted, evaluation.is_some());
                        prop_assert!(leases.report(lease, 0).is_err(), "never twice");
                    },
                    _ => while let Some((evaluation, result)) = leases.take_reported() {
                        prop_assert_eq!(evaluation, result);
                        prop_assert!(taken.last() < Some(&evaluation), "each once, in order");
                        taken.push(evaluation);
                    },
                }
                let counts = leases.counts();
                prop_assert_eq!(leases.len() as u64, offered - taken.len() as u64 - counts.superseded);
                prop_assert!(counts.offered <= 1 + counts.expirations as usize);
            }
        }
    }
}
