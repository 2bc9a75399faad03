//! Who an actor is, and the random draws that follow from it.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// Who writes segments. All random draws of an actor's episodes derive from it.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Identity {
    /// The actor's name.
    pub name: String,
    /// The run's seed.
    pub run_seed: u64,
    /// Names this start of the actor: segments are numbered from 1 under it, and a restarted actor plays other
    /// episodes than before.
    pub writer: u64,
}

impl Identity {
    /// An actor that starts now as one of several, which know nothing of each other: under a writer id that the operating
    /// system draws.
    pub fn new(name: &str, run_seed: u64) -> Self {
        Self { name: name.to_owned(), run_seed, writer: rand::random() }
    }

    /// The only actor of a run, of the `start`th start of that run: the run's seed decides all its draws. Under a number
    /// that `is_known` to the run's replay already, what it simulates would be taken for what is stored: the next that is
    /// not known is taken.
    pub fn of_start(name: &str, run_seed: u64, start: u64, is_known: impl Fn(u64) -> bool) -> Self {
        let writer = (start..).find(|writer| !is_known(*writer)).expect("fewer writers than numbers");
        Self { name: name.to_owned(), run_seed, writer }
    }

    /// The same actor as the `index`th of several replays knows it: two addresses of one replay are two writers to it.
    pub fn towards(&self, index: usize) -> Self {
        Self { writer: self.writer.wrapping_add(index as u64), ..self.clone() }
    }

    /// The generator of one episode, the same wherever and in whatever company it is played.
    ///
    /// `lane` and `episode` count from 0.
    pub fn episode_rng(&self, lane: u32, episode: u64) -> ChaCha8Rng {
        let parts = [self.run_seed, fnv1a(self.name.as_bytes()), self.writer, episode];
        let mut key = [0; 32];
        for (bytes, part) in key.chunks_exact_mut(8).zip(parts) {
            bytes.copy_from_slice(&part.to_le_bytes());
        }
        let mut rng = ChaCha8Rng::from_seed(key);
        rng.set_stream(lane.into());
        rng
    }
}

/// FNV-1a: a hash that is the same in every build, unlike the standard library's.
fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::Rng;

    #[test]
    fn every_part_of_the_identity_changes_the_draws_and_nothing_else_does() {
        let identity = Identity { name: "actor-1".into(), run_seed: 7, writer: 1 };
        let first = |identity: &Identity, lane, episode| identity.episode_rng(lane, episode).random::<u64>();
        let draw = first(&identity, 0, 0);
        assert_eq!(draw, first(&identity.clone(), 0, 0));
        let others = [
            first(&identity, 1, 0),
            first(&identity, 0, 1),
            first(&Identity { name: "actor-2".into(), ..identity.clone() }, 0, 0),
            first(&Identity { run_seed: 8, ..identity.clone() }, 0, 0),
            first(&Identity { writer: 2, ..identity.clone() }, 0, 0),
        ];
        assert!(others.iter().all(|other| *other != draw));
    }

    #[test]
    fn the_only_actor_of_a_run_takes_the_number_of_its_start_or_the_next_that_is_free() {
        let writer = |start, known: &[u64]| {
            Identity::of_start("actor", 0, start, |writer| known.contains(&writer)).writer
        };
        assert_eq!(writer(3, &[1, 2]), 3);
        assert_eq!(writer(1, &[1, 2]), 3, "the count of starts was lost");
    }

    #[test]
    fn a_restarted_actor_is_another_writer() {
        assert_ne!(Identity::new("actor", 0).writer, Identity::new("actor", 0).writer);
    }
}
