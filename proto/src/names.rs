//! Names inside messages of the learner's: of networks, values and scenarios.

/// The network that acts, among those of a policy update.
pub const POLICY_NETWORK: &str = "policy";
/// The value of a policy update that holds the curriculum's β^i.
pub const BETA_VALUE: &str = "beta";
/// The values that hold the standard deviation of β̂ around β^i, and its floor; where one is absent, an actor goes by its
/// own configuration.
pub const BETA_STD_VALUE: &str = "beta_std";
/// See [`BETA_STD_VALUE`].
pub const BETA_FLOOR_VALUE: &str = "beta_floor";
/// The value that holds the share of episodes that begin high; none where it is absent.
pub const HIGH_STARTS_VALUE: &str = "high_starts";
/// The evaluation scenario of the get-up task: falls that their seeds alone determine.
pub const FALLS_SCENARIO: &str = "falls";
