//! Pictures of a character, drawn offscreen by MuJoCo through EGL: no display is needed, and no GPU.

use std::sync::Arc;

use mujoco_rs::prelude::{MjData, MjModel, MjvCamera};
use mujoco_rs::renderer::MjRenderer;

use crate::character::Character;
use crate::error::SimError;
use crate::world::{Body, World};

/// From the camera to what it looks at, in metres.
const DISTANCE: f64 = 3.4;
/// How far the camera looks down, in degrees.
const ELEVATION: f64 = -12.0;
/// The height that it looks at, in metres.
const LOOK_HEIGHT: f64 = 0.75;

/// Why a picture cannot be drawn.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// The character's model.
    #[error(transparent)]
    Sim(#[from] SimError),
    /// No offscreen context.
    #[error(
        "cannot draw offscreen: {0}; install EGL and a driver (Debian: apt-get install libegl1 libgl1-mesa-dri libgles2)"
    )]
    Egl(String),
    /// The context was there, and drawing failed.
    #[error("cannot draw: {0}")]
    Draw(String),
}

/// Draws poses of one character, all of one size.
pub struct Painter {
    renderer: MjRenderer,
    data: MjData<Arc<MjModel>>,
    world: World,
    torso: Body,
}

impl Painter {
    /// A painter of pictures of `width` × `height` pixels, at most 1920 × 1080.
    ///
    /// # Errors
    /// [`PictureError::Egl`] where the machine has no EGL, or it opens no context of that size.
    pub fn new(character: Character, width: usize, height: usize) -> Result<Self, PictureError> {
        let world = World::new(character, 200, 1.0)?;
        let data = world.mujoco().clone();
        let renderer = MjRenderer::new(data.model(), width, height, 0);
        let renderer = renderer.map_err(|error| PictureError::Egl(error.to_string()))?;
        Ok(Self { renderer, data, torso: world.body("torso")?, world })
    }

    /// The heading of the torso in a pose, in degrees about the vertical from the x axis.
    ///
    /// # Errors
    /// [`PictureError::Sim`] for a pose of another character.
    pub fn heading(&mut self, qpos: &[f64]) -> Result<f64, PictureError> {
        self.world.set(qpos, &vec![0.0; self.world.nv()])?;
        let axes = self.world.rotation(self.torso);
        Ok(axes[3].atan2(axes[0]).to_degrees())
    }

    /// Draws a pose, seen along the direction `azimuth` (degrees about the vertical from the x axis). The picture is
    /// `[height, width, 3]`, red, green, blue, and follows the character over the floor.
    ///
    /// # Errors
    /// [`PictureError::Sim`] for a pose of another character.
    pub fn paint(&mut self, qpos: &[f64], azimuth: f64) -> Result<&[u8], PictureError> {
        self.world.set(qpos, &vec![0.0; self.world.nv()])?;
        self.data.qpos_mut().copy_from_slice(qpos);
        self.data.forward();
        let [x, y, _] = self.world.centre_of_mass(self.torso);
        let mut camera = MjvCamera::new_free(self.data.model());
        camera.lookat = [x, y, LOOK_HEIGHT];
        (camera.distance, camera.azimuth, camera.elevation) = (DISTANCE, azimuth, ELEVATION);
        self.renderer.set_camera(camera);
        let drawn = self.renderer.sync_data(&mut self.data).and_then(|()| self.renderer.render());
        drawn.map_err(|error| PictureError::Draw(error.to_string()))?;
        Ok(self.renderer.rgb_flat().expect("a renderer draws colours unless told otherwise"))
    }
}
