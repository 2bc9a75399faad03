//! Which policy is meant: [`PolicyVersion`].

use crate::v1;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Of which learner process, and which of its broadcasts.
///
/// Ordered by incarnation first: a resumed learner counts from 1 again under a greater incarnation, so what it
/// sends is newer than all that came before. The default, `0.0`, is older than any.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default, Serialize, Deserialize)]
pub struct PolicyVersion {
    /// Counts the learner processes of a run, from 1.
    pub incarnation: u64,
    /// Counts the broadcasts of that process; 0 is the untrained network.
    pub counter: u64,
}

/// As `incarnation.counter`: `3.120`.
impl fmt::Display for PolicyVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.incarnation, self.counter)
    }
}

impl From<v1::PolicyVersion> for PolicyVersion {
    fn from(wire: v1::PolicyVersion) -> Self {
        Self { incarnation: wire.incarnation, counter: wire.counter }
    }
}

impl From<PolicyVersion> for v1::PolicyVersion {
    fn from(version: PolicyVersion) -> Self {
        Self { incarnation: version.incarnation, counter: version.counter }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_resumed_learner_is_newer_than_all_its_predecessors() {
        let before = PolicyVersion { incarnation: 3, counter: 120 };
        let resumed = PolicyVersion { incarnation: 4, counter: 1 };
        assert!(resumed > before);
        assert_eq!(before.to_string(), "3.120");
    }
}
