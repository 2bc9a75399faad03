//! `getup render`: a strip of frames of one get-up, left to right.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use getup_actor::evaluate::{EvaluatedEpisode, Evaluator};
use getup_sim::picture::Painter;
use getup_sim::{Character, UP_HEIGHT};

use crate::evaluate::{Actor, unseen_falls};
use crate::output::{check_place, say, write_file};

/// Control steps a second.
const HZ: f64 = 40.0;
/// What is shown after the head is first up, where the end is not given, in seconds.
const AFTER: f64 = 0.75;
/// From the character's final heading to the direction of view, in degrees: it is seen from the side, a bit from the
/// front.
const VIEW: f64 = 125.0;

/// Draw a strip of frames of one get-up, from the fallen state on.
///
/// The fall is the first that `getup evaluate` plays under the same seed. MuJoCo draws through EGL, offscreen: no
/// display and no GPU is needed (Debian: libegl1 libgl1-mesa-dri libgles2).
#[derive(clap::Args)]
pub(crate) struct Args {
    /// A model file, such as models/strong.safetensors.
    model: PathBuf,
    /// The picture to write, a PNG.
    #[arg(long, value_name = "FILE", default_value = "strip.png")]
    output: PathBuf,
    /// Seed of the fall, under 2^32.
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..1 << 32))]
    seed: u64,
    /// Frames of the strip.
    #[arg(long, default_value_t = 9)]
    frames: usize,
    /// Seconds of the episode that are shown, at most 6.25. [default: until shortly after it is up]
    #[arg(long)]
    seconds: Option<f64>,
    /// Height of the strip in pixels, from 16 to 1080; a frame is three quarters as wide.
    #[arg(long, default_value_t = 320)]
    height: usize,
    /// Torque-limit multiplier, over 0 and at most 4. [default: the model's own]
    #[arg(long, allow_negative_numbers = true)]
    beta: Option<f64>,
    /// standard, cast or one_arm. [default: the model's own]
    #[arg(long)]
    character: Option<Character>,
}

pub(crate) fn run(arguments: Args) -> Result<()> {
    let Args { frames, height, .. } = arguments;
    ensure!((1..=100).contains(&frames), "--frames {frames}: from 1 to 100");
    ensure!((16..=1080).contains(&height), "--height {height}: from 16 to 1080");
    check_place(&arguments.output)?;
    let actor = Actor::load(&arguments.model, arguments.beta, arguments.character)?;
    let (episode, poses) = play(&actor, arguments.seed)?;
    let last = last_step(&episode, arguments.seconds, poses.len())?;

    let (width, count) = (height * 3 / 4, frames.max(2) - 1);
    let mut painter = Painter::new(actor.task.character, width, height)?;
    let azimuth = painter.heading(&poses[last])? + VIEW;
    let mut strip = vec![0; frames * width * height * 3];
    let mut seconds = Vec::new();
    for frame in 0..frames {
        let step = frame * last / count;
        seconds.push(format!("{:.2}", step as f64 / HZ));
        let picture = painter.paint(&poses[step], azimuth)?;
        let columns = strip.chunks_exact_mut(width * 3).skip(frame).step_by(frames);
        columns.zip(picture.chunks_exact(width * 3)).for_each(|(to, from)| to.copy_from_slice(from));
    }
    write_png(&arguments.output, frames * width, height, &strip)?;
    let verdict = match (episode.rises(), episode.stands()) {
        (_, true) => "it rises and stands",
        (true, false) => "it rises",
        (false, false) => "it does not rise",
    };
    say!(
        "{}: seconds {} of fall {}, β = {}; {verdict}, return {:.1}",
        arguments.output.display(),
        seconds.join(", "),
        arguments.seed,
        actor.beta,
        episode.episode_return
    );
    Ok(())
}

/// One episode, and its poses from the fallen one on.
fn play(actor: &Actor, seed: u64) -> Result<(EvaluatedEpisode, Vec<Vec<f64>>)> {
    let mut evaluator = Evaluator::new(&actor.task, actor.beta.max(1.0), 1)?;
    let seeds = unseen_falls(seed, 1);
    let (mut episodes, mut file) =
        evaluator.record(&actor.policy, actor.beta, &seeds, |_| ControlFlow::Continue(()))?;
    let episode = episodes.pop().context("an evaluation of one fall has one episode")?;
    let Some(rollout) = file.rollouts.pop() else {
        let cause = episode.diverged.unwrap_or_default();
        bail!("the simulation of fall {seed} failed ({cause}): take another --seed");
    };
    let poses = [vec![rollout.qpos0], rollout.qpos].concat();
    Ok((episode, poses))
}

/// The step that the strip ends with.
fn last_step(episode: &EvaluatedEpisode, seconds: Option<f64>, poses: usize) -> Result<usize> {
    let longest = poses - 1;
    if let Some(seconds) = seconds {
        ensure!(seconds > 0.0 && seconds.is_finite(), "--seconds {seconds}: over 0");
        return Ok(((seconds * HZ).round() as usize).clamp(1, longest.max(1)).min(longest));
    }
    let up = episode.head_heights.iter().position(|height| *height >= UP_HEIGHT);
    Ok(up.map_or(longest, |step| (step + 1 + (AFTER * HZ) as usize).min(longest)))
}

fn write_png(path: &Path, width: usize, height: usize, pixels: &[u8]) -> Result<()> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width as u32, height as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().context("the strip is too large for a PNG")?;
    writer.write_image_data(pixels)?;
    writer.finish()?;
    write_file(path, bytes)
}
