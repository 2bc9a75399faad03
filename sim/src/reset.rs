//! Where episodes begin: a weighted list of [`Source`]s, of which a fall is the only one so far; and, for training
//! alone, high starts: [`Standing`].

use rand::Rng;
use rand::seq::IndexedRandom;
use rand_distr::StandardNormal;

use crate::error::ConfigError;
use crate::world::World;

/// The sources of a task's episodes, each with its weight: the share of episodes it begins.
#[derive(Clone, PartialEq, Debug)]
pub struct Resets(Vec<(f64, Source)>);

/// A way to begin an episode.
#[derive(Clone, PartialEq, Debug)]
pub enum Source {
    /// Dropped in a random pose, limp until it lies (§7).
    Fall(Fall),
}

/// The paper's reset: a random pose in the air, then a limp fall.
#[derive(Clone, PartialEq, Debug)]
pub struct Fall {
    /// Height of the root above the floor at first, in metres.
    pub height: f64,
    /// Control steps of the fall.
    pub limp_steps: usize,
    /// Standard deviation of the normal draw that is each component of a limp step's action.
    pub limp_std: f64,
}

impl Resets {
    /// A list of weights and sources.
    ///
    /// # Errors
    /// [`ConfigError::Resets`] unless the weights are finite, none is negative and one at least is above 0.
    pub fn new(weighted: Vec<(f64, Source)>) -> Result<Resets, ConfigError> {
        let weights = || weighted.iter().map(|(weight, _)| *weight);
        if weights().all(|weight| weight.is_finite() && weight >= 0.0) && weights().sum::<f64>() > 0.0 {
            Ok(Resets(weighted))
        } else {
            Err(ConfigError::Resets(weights().collect()))
        }
    }

    /// Draws a source by weight.
    pub fn draw(&self, rng: &mut impl Rng) -> &Source {
        let (_, source) =
            self.0.choose_weighted(rng, |(weight, _)| *weight).expect("`new` refuses bad weights");
        source
    }

    /// The longest reset, in control steps.
    pub fn longest(&self) -> usize {
        let steps = |(_, source): &(f64, Source)| match source {
            Source::Fall(fall) => fall.limp_steps,
        };
        self.0.iter().map(steps).max().unwrap_or(0)
    }
}

impl Fall {
    /// Draws a pose that touches nothing into `qpos`: the first [`proposal`](Fall::propose) in which no geom touches
    /// another or the floor. Returns the number of proposals it took: 1.33 on average on the standard character.
    /// The world's own state is left between poses: set it next.
    ///
    /// From 1.5 m nothing reaches the floor, so only hinges are rejected, never orientations: those stay uniform.
    /// Most distorted are the knees (their most flexed tenth is kept 0.58 times as often as the average) and the
    /// shoulders (the arm across the chest, 0.77); ankles, waist twist and waist tilt stay within 4 %.
    ///
    /// # Panics
    /// If `qpos` is not the world's `nq` long.
    pub fn draw_pose(&self, world: &mut World, rng: &mut impl Rng, qpos: &mut [f64]) -> usize {
        for draws in 1.. {
            self.propose(world, rng, qpos);
            if !world.touches_at(qpos) {
                return draws;
            }
        }
        unreachable!("the loop above ends only by returning")
    }

    /// Draws a pose, touching or not: the orientation uniform on SO(3), every hinge uniform in its range.
    pub fn propose(&self, world: &World, rng: &mut impl Rng, qpos: &mut [f64]) {
        qpos[..3].copy_from_slice(&[0.0, 0.0, self.height]);
        qpos[3..7].copy_from_slice(&unit_quaternion(rng));
        for (angle, [lower, upper]) in qpos[7..].iter_mut().zip(world.hinge_ranges()) {
            *angle = rng.random_range(*lower..=*upper);
        }
    }

    /// Draws the action of one limp step.
    pub fn draw_action(&self, rng: &mut impl Rng, action: &mut [f32]) {
        for component in action {
            *component = (self.limp_std * rng.sample::<f64, _>(StandardNormal)) as f32;
        }
    }
}

/// A high start: the standing pose, disturbed, on its feet; often limp for some steps, so that training sees all there
/// is between standing and lying. Evaluations never begin so.
#[derive(Clone, PartialEq, Debug)]
pub struct Standing {
    /// The pose's hinge angles, in qpos order, in radians.
    pub hinges: Vec<f64>,
    /// Standard deviation of the noise on every hinge, in radians; the hinge's range clamps it.
    pub hinge_std: f64,
    /// Standard deviation of the tilt about each horizontal axis, in radians. The heading is uniform.
    pub tilt_std: f64,
    /// Share of the starts that are limp at first.
    pub limp_share: f64,
    /// These are limp for 0 to this many control steps, uniformly.
    pub limp_steps: usize,
}

impl Standing {
    /// Draws a pose into `qpos`, its lowest point on the floor. The world's own state is left between poses: set it
    /// next.
    ///
    /// # Panics
    /// If `qpos` is not the world's `nq` long.
    pub fn draw_pose(&self, world: &mut World, rng: &mut impl Rng, qpos: &mut [f64]) {
        let mut normal = |std: f64| std * rng.sample::<f64, _>(StandardNormal);
        let [tilt_x, tilt_y] = [normal(self.tilt_std), normal(self.tilt_std)];
        let ranges = world.hinge_ranges().iter().zip(&self.hinges);
        for (angle, ([lower, upper], mean)) in qpos[7..].iter_mut().zip(ranges) {
            *angle = (mean + normal(self.hinge_std)).clamp(*lower, *upper);
        }
        let yaw = rng.random_range(-std::f64::consts::PI..std::f64::consts::PI);
        // Heading ∘ tilt: (cos, 0, 0, sin) of half the yaw times the small rotation (1, x/2, y/2, 0), normalised.
        let (sin, cos) = (yaw / 2.0).sin_cos();
        let (x, y) = (tilt_x / 2.0, tilt_y / 2.0);
        let length = (1.0 + x * x + y * y).sqrt();
        qpos[..3].copy_from_slice(&[0.0; 3]);
        qpos[3..7].copy_from_slice(&[cos, cos * x - sin * y, cos * y + sin * x, sin].map(|q| q / length));
        qpos[2] = -world.lowest_point_at(qpos);
    }

    /// Draws how many control steps the start is limp for.
    pub fn draw_limp_steps(&self, rng: &mut impl Rng) -> usize {
        if rng.random_bool(self.limp_share) { rng.random_range(0..=self.limp_steps) } else { 0 }
    }
}

/// A rotation uniform on SO(3): four independent normal draws, scaled to length 1.
fn unit_quaternion(rng: &mut impl Rng) -> [f64; 4] {
    let draw: [f64; 4] = std::array::from_fn(|_| rng.sample(StandardNormal));
    let length = draw.iter().map(|x| x * x).sum::<f64>().sqrt();
    draw.map(|x| x / length)
}
