//! A trained actor meets a replay that holds too little of it: what follows from few transitions, all alike, unlearns
//! within minutes what took an hour. So updates wait until the replay is filled again.
//!
//! Minibatches are drawn meanwhile and left unused: the rate limiter lets nobody run ahead of samples.

use std::collections::BTreeMap;

use getup_replay::ReplayCounters;
use getup_telemetry::{Waiting, Waits};

pub(super) struct Refill {
    /// What each replay has to hold, in transitions.
    share: u64,
    replays: u64,
    /// What those that were seen have to hold, by the store's name; 0 once they do.
    wanted: BTreeMap<u64, u64>,
    wait: Waiting,
}

impl Refill {
    /// For a run in so many replays, which are to hold `steps` transitions together.
    pub(super) fn new(steps: u64, replays: usize, waits: &Waits) -> Self {
        let replays = replays.max(1) as u64;
        Self { share: steps / replays, replays, wanted: BTreeMap::new(), wait: waits.waiting("learner") }
    }

    /// Whether any replay is being filled.
    pub(super) fn is_going_on(&self) -> bool {
        self.wait.is_under_way()
    }

    /// Whether a minibatch of that replay comes too early.
    ///
    /// `made` are the env steps of the run so far, none where its actor is untrained: a replay that is new to the learner
    /// has to hold its part of them, or of the configured ones where these are fewer.
    pub(super) fn goes_on(&mut self, counters: &ReplayCounters, made: u64) -> bool {
        let part = self.share.min(made / self.replays);
        if !self.wanted.contains_key(&counters.store) && self.wanted.len() as u64 >= self.replays {
            // It is in the place of another, which may have been lost before it was full. One that was not comes anew.
            self.wanted.retain(|_, wanted| *wanted == 0);
        }
        let entry = self.wanted.entry(counters.store).or_insert(part);
        if counters.held >= *entry {
            *entry = 0;
        }
        let wanted = *entry;
        let goes_on = wanted > 0;
        if self.wanted.values().all(|wanted| *wanted == 0) {
            self.wait.over();
        } else if goes_on {
            let held = counters.held;
            self.wait
                .because(format!("the replay fills before updates go on: {held} of {wanted} transitions"));
        }
        goes_on
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use getup_telemetry::Registry;

    fn held(store: u64, held: u64) -> ReplayCounters {
        ReplayCounters { store, held, ..ReplayCounters::default() }
    }

    #[test]
    fn a_replay_that_is_new_to_a_trained_actor_is_filled_once() {
        let waits = Waits::new(&Registry::new());
        let mut refill = Refill::new(1000, 1, &waits);
        assert!(refill.goes_on(&held(7, 1), u64::MAX));
        assert!(refill.goes_on(&held(7, 999), u64::MAX));
        let shown: Vec<String> = waits.current().iter().map(ToString::to_string).collect();
        assert!(shown.len() == 1 && shown[0].contains("999 of 1000 transitions"), "{shown:?}");
        assert!(!refill.goes_on(&held(7, 1000), u64::MAX));
        assert!(waits.current().is_empty());
        assert!(!refill.goes_on(&held(7, 3), u64::MAX), "removed since");
        assert!(refill.goes_on(&held(8, 3), u64::MAX), "another in its place");
    }

    #[test]
    fn a_replay_that_is_lost_before_it_is_full_is_not_waited_for() {
        let waits = Waits::new(&Registry::new());
        let mut refill = Refill::new(1000, 1, &waits);
        assert!(refill.goes_on(&held(7, 1), u64::MAX));
        assert!(refill.goes_on(&held(8, 1), u64::MAX) && refill.is_going_on());
        assert!(!refill.goes_on(&held(8, 1000), u64::MAX) && !refill.is_going_on());
    }

    #[test]
    fn no_more_is_wanted_than_the_run_has_made() {
        let waits = Waits::new(&Registry::new());
        assert!(!Refill::new(1000, 1, &waits).goes_on(&held(7, 1), 0), "an untrained actor");
        let mut refill = Refill::new(1000, 1, &waits);
        assert!(refill.goes_on(&held(7, 39), 40) && !refill.goes_on(&held(7, 40), 40));
    }

    #[test]
    fn each_of_several_replays_is_filled_with_its_part() {
        let waits = Waits::new(&Registry::new());
        let mut refill = Refill::new(1000, 4, &waits);
        assert!(refill.goes_on(&held(1, 249), 5000));
        assert!(!refill.goes_on(&held(2, 250), 5000));
        assert!(!waits.current().is_empty(), "one is still filling");
        assert!(!refill.goes_on(&held(1, 250), 5000) && waits.current().is_empty());
    }
}
