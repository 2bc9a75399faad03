//! Falls by the thousand: what `getup falls` writes, and the check that a fall is the paper's.
//!
//! [`draw`] plays them, [`Falls`] is the file. Fall i depends on the i-th seed alone, never on how many threads played.

use std::num::NonZero;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::config::TaskConfig;
use crate::error::SimError;
use crate::getup::GetUp;
use crate::lane::{Diverged, Lane};
use crate::task::Task;
use crate::world::World;

/// The version of the file's format.
pub const FORMAT: u32 = 1;

/// A file of falls.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
pub struct Falls {
    /// [`FORMAT`].
    pub format: u32,
    /// What was simulated.
    pub task: TaskConfig,
    /// The seed all the falls' seeds come from.
    pub seed: u64,
    /// How many landed supine, prone and lateral.
    pub landings: Landings,
    /// The falls, in the order of their seeds.
    pub falls: Vec<Landed>,
}

/// One fall, from first pose to rest.
#[derive(Clone, PartialEq, Debug, Serialize, Deserialize)]
pub struct Landed {
    /// [`Lane::begin`] with this seed repeats it.
    pub seed: u64,
    /// Positions before the fall: nq numbers. Velocities are zero.
    pub initial_qpos: Vec<f64>,
    /// Positions after it.
    pub qpos: Vec<f64>,
    /// Velocities after it: nv numbers.
    pub qvel: Vec<f64>,
    /// Limp control steps it took.
    pub limp_steps: usize,
    /// How it lies.
    pub landing: Landing,
}

/// Which way the torso faces: its x axis points out of the chest, its y axis to the left. However the fall ends, it is
/// one of these. Of 10,000 falls of the standard character 46 % are supine, 31 % prone and 23 % lateral.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Landing {
    /// On the back: the chest axis points up, more than the side axis points up or down.
    Supine,
    /// On the belly: the chest axis points down, more than the side axis points up or down.
    Prone,
    /// On a side: the side axis is the steeper of the two.
    Lateral,
}

/// Falls by their landing.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, Serialize, Deserialize)]
pub struct Landings {
    /// On the back.
    pub supine: usize,
    /// On the belly.
    pub prone: usize,
    /// On a side.
    pub lateral: usize,
}

/// Why falls could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum FallsError {
    /// A setting of the task is out of range.
    #[error(transparent)]
    Sim(#[from] SimError),
    /// A simulation failed in mid-fall.
    #[error(transparent)]
    Diverged(#[from] Box<Diverged>),
}

impl Landing {
    /// How the torso lies, from its rotation alone.
    ///
    /// # Errors
    /// [`SimError::NoBody`] if the world's character has no torso.
    pub fn of(world: &World) -> Result<Landing, SimError> {
        let axes = world.rotation(world.body("torso")?);
        let [chest_up, side_up] = [axes[6], axes[7]];
        Ok(if chest_up.abs() < side_up.abs() {
            Landing::Lateral
        } else if chest_up > 0.0 {
            Landing::Supine
        } else {
            Landing::Prone
        })
    }
}

impl FromIterator<Landing> for Landings {
    fn from_iter<I: IntoIterator<Item = Landing>>(landings: I) -> Landings {
        landings.into_iter().fold(Landings::default(), |mut count, landing| {
            match landing {
                Landing::Supine => count.supine += 1,
                Landing::Prone => count.prone += 1,
                Landing::Lateral => count.lateral += 1,
            }
            count
        })
    }
}

/// Plays `count` falls, on all cores.
///
/// # Errors
/// [`FallsError::Sim`] for a setting out of range, [`FallsError::Diverged`] if a fall's simulation fails.
pub fn draw(config: &TaskConfig, count: usize, seed: u64) -> Result<Falls, FallsError> {
    let task: Arc<dyn Task> = Arc::new(GetUp::new(config, 1.0)?);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let seeds: Vec<u64> = (0..count).map(|_| rng.next_u64()).collect();
    let falls = play_all(&task, &seeds)?;
    let landings = falls.iter().map(|fall| fall.landing).collect();
    Ok(Falls { format: FORMAT, task: config.clone(), seed, landings, falls })
}

/// Each thread takes the next seed that nobody has, until none is left.
fn play_all(task: &Arc<dyn Task>, seeds: &[u64]) -> Result<Vec<Landed>, FallsError> {
    let next = AtomicUsize::new(0);
    let work = || -> Result<Vec<(usize, Landed)>, FallsError> {
        let mut lane = Lane::new(task.clone());
        let mut done = Vec::new();
        loop {
            let index = next.fetch_add(1, Ordering::Relaxed);
            let Some(&seed) = seeds.get(index) else { return Ok(done) };
            // After a fall that failed nobody begins another.
            let landed = play(&mut lane, seed).inspect_err(|_| next.store(seeds.len(), Ordering::Relaxed))?;
            done.push((index, landed));
        }
    };
    let threads = thread::available_parallelism().map_or(1, NonZero::get).min(seeds.len().max(1));
    let parts = thread::scope(|scope| {
        let handles: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        let join =
            |handle: thread::ScopedJoinHandle<'_, _>| handle.join().expect("playing a fall does not panic");
        handles.into_iter().map(join).collect::<Result<Vec<_>, FallsError>>()
    })?;
    let mut falls: Vec<(usize, Landed)> = parts.into_iter().flatten().collect();
    falls.sort_by_key(|(index, _)| *index);
    Ok(falls.into_iter().map(|(_, fall)| fall).collect())
}

/// Plays one fall to its landing.
fn play(lane: &mut Lane, seed: u64) -> Result<Landed, FallsError> {
    lane.begin(seed, 1.0);
    let initial_qpos = lane.qpos().to_vec();
    let limp_steps = lane.fall().map_err(Box::new)?;
    let [qpos, qvel] = [lane.qpos().to_vec(), lane.qvel().to_vec()];
    Ok(Landed { seed, initial_qpos, qpos, qvel, limp_steps, landing: Landing::of(lane.world())? })
}
