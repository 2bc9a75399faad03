//! What a task is: a world to act in, its timing, how its episodes begin, and what is observed and paid.
//!
//! [`Task`] is the one place to add another. A [`Lane`](crate::Lane) plays episodes of any of them; no width or rate
//! is a constant outside its task.

use crate::reset::{Resets, Standing};
use crate::world::World;

/// A task. It holds no episode: many lanes in many threads share one.
pub trait Task: Send + Sync {
    /// A world for one more lane.
    fn world(&self) -> World;

    /// Control steps a second.
    fn control_hz(&self) -> u32;

    /// Physics steps a second: a multiple of [`control_hz`](Task::control_hz).
    fn physics_hz(&self) -> u32;

    /// Control steps after which an episode is cut (`truncated`, not `terminal`), its reset not counted.
    fn episode_steps(&self) -> usize;

    /// The motors' clamp, in units of their torque limits.
    fn control_limit(&self) -> f64;

    /// Where episodes begin.
    fn resets(&self) -> &Resets;

    /// How training's high starts begin.
    fn standing(&self) -> &Standing;

    /// Numbers in an observation.
    fn observation_width(&self) -> usize;

    /// Numbers in an action.
    fn action_width(&self) -> usize;

    /// The names of the reward's terms, each in [0, 1].
    fn term_names(&self) -> &'static [&'static str];

    /// Writes the observation of the world's state under the torque limit `beta` (β̂, in units of the character's).
    fn observe(&self, world: &World, beta: f64, observation: &mut [f64]);

    /// Writes the reward's terms for being in the world's state, and returns the reward.
    fn reward(&self, world: &World, terms: &mut [f64]) -> f64;

    /// Whether the world's state ends the episode for good, so that nothing follows it. `highest` is the highest that
    /// the head was in the control phase, in metres.
    fn is_terminal(&self, _world: &World, _highest: f64) -> bool {
        false
    }

    /// Physics steps in a control step.
    fn substeps(&self) -> usize {
        (self.physics_hz() / self.control_hz()) as usize
    }
}
