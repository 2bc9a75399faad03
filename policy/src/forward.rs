//! The forward pass, in plain Rust: what actors run thousands of times a second.
//!
//! A batch is worked through in tiles of [`TILE`] rows. Every row goes through the same arithmetic whatever the batch
//! (see [`Layer`]), so an evaluation gives the same bits on eight lanes as on one.

use crate::layer::Layer;
use crate::{Body, LOG_STD_MAX, LOG_STD_MIN, NORM_EPSILON, ObservationStatistics, Policy};

/// Rows of one matrix product.
const TILE: usize = 16;

/// Turns a pre-tanh sample `u` into an action: `β̂ · tanh(u)`, in `[-β̂, β̂]`.
pub fn squash(u: f32, beta: f32) -> f32 {
    beta * u.tanh()
}

/// What the network says of a batch of `n` observations.
#[derive(Clone, Copy, Debug)]
pub struct Heads<'a> {
    /// `[n, action]`: means of the Gaussian, before the tanh.
    pub mean: &'a [f32],
    /// `[n, action]`: log standard deviations, in `[LOG_STD_MIN, LOG_STD_MAX]`.
    pub log_std: &'a [f32],
}

/// A policy laid out for evaluation, with its scratch memory: nothing is allocated in [`Forward::run`] but where
/// a batch is larger than any before.
pub struct Forward {
    body: Vec<Step>,
    /// Means and log standard deviations.
    heads: [Layer; 2],
    statistics: Option<ObservationStatistics>,
    observation: usize,
    action: usize,
    /// Two tiles of the widest layer: a layer reads one and writes the other.
    front: Vec<f32>,
    back: Vec<f32>,
    /// A tile of the widest block's inner activations.
    inner: Vec<f32>,
    mean: Vec<f32>,
    log_std: Vec<f32>,
}

/// A step through the body.
enum Step {
    /// A layer, and whether a ReLU follows.
    Dense(Layer, bool),
    /// A residual block: `x + down(relu(up(norm(x))))`.
    Block { norm: Norm, up: Layer, down: Layer },
    /// The layer norm at the end.
    Norm(Norm),
}

/// A layer norm.
struct Norm {
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Forward {
    /// Lays out `policy` for batches of up to `max_batch` rows (more are possible, and allocate once).
    pub fn new(policy: &Policy, max_batch: usize) -> Self {
        let body = steps(policy);
        let width = policy.shape.body.output_width(policy.shape.observation);
        let heads = ["head.mean", "head.log_std"].map(|name| Layer::new(name, width, policy));
        let inner = body.iter().map(Step::widest).max().unwrap_or(0);
        let widest = inner.max(width).max(policy.shape.observation).max(policy.shape.action);
        let (observation, action) = (policy.shape.observation, policy.shape.action);
        Self {
            statistics: policy.statistics.clone(),
            observation,
            action,
            front: vec![0.0; TILE * widest],
            back: vec![0.0; TILE * widest],
            mean: Vec::with_capacity(max_batch * action),
            log_std: Vec::with_capacity(max_batch * action),
            inner: vec![0.0; TILE * inner],
            body,
            heads,
        }
    }

    /// Evaluates `observations`, `[n, observation]` as the task gives them: normalisation happens here.
    ///
    /// # Panics
    /// Where the length is no multiple of the observation's width.
    pub fn run(&mut self, observations: &[f32]) -> Heads<'_> {
        assert_eq!(observations.len() % self.observation, 0, "observations are rows of {}", self.observation);
        self.mean.clear();
        self.log_std.clear();
        for tile in observations.chunks(TILE * self.observation) {
            self.run_tile(tile);
        }
        Heads { mean: &self.mean, log_std: &self.log_std }
    }

    fn run_tile(&mut self, observations: &[f32]) {
        let rows = observations.len() / self.observation;
        match &self.statistics {
            Some(statistics) => statistics.normalize_into(observations, &mut self.front),
            None => self.front[..observations.len()].copy_from_slice(observations),
        }
        for step in &self.body {
            match step {
                Step::Dense(layer, relu) => {
                    layer.apply(rows, &self.front, &mut self.back, false);
                    if *relu {
                        self.back[..rows * layer.outputs].iter_mut().for_each(|x| *x = x.max(0.0));
                    }
                    std::mem::swap(&mut self.front, &mut self.back);
                }
                Step::Block { norm, up, down } => {
                    norm.apply(rows, &self.front, &mut self.back);
                    up.apply(rows, &self.back, &mut self.inner, false);
                    self.inner[..rows * up.outputs].iter_mut().for_each(|x| *x = x.max(0.0));
                    down.apply(rows, &self.inner, &mut self.front, true);
                }
                Step::Norm(norm) => {
                    norm.apply(rows, &self.front, &mut self.back);
                    std::mem::swap(&mut self.front, &mut self.back);
                }
            }
        }
        let heads = &self.heads;
        let outputs = rows * self.action;
        heads[0].apply(rows, &self.front, &mut self.back, false);
        self.mean.extend_from_slice(&self.back[..outputs]);
        heads[1].apply(rows, &self.front, &mut self.back, false);
        let squashed = |x: &f32| LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (x.tanh() + 1.0);
        self.log_std.extend(self.back[..outputs].iter().map(squashed));
    }
}

/// The body's steps, in order.
fn steps(policy: &Policy) -> Vec<Step> {
    let inputs = policy.shape.observation;
    match &policy.shape.body {
        Body::Mlp { hidden } => {
            let widths = std::iter::once(&inputs).chain(hidden);
            let layer = |(index, width): (usize, &usize)| {
                Step::Dense(Layer::new(&format!("body.{index}"), *width, policy), true)
            };
            widths.take(hidden.len()).enumerate().map(layer).collect()
        }
        Body::Simba { width, blocks } => {
            let mut steps = vec![Step::Dense(Layer::new("body.embed", inputs, policy), false)];
            steps.extend((0..*blocks).map(|block| Step::Block {
                norm: Norm::new(&format!("body.{block}.norm"), policy),
                up: Layer::new(&format!("body.{block}.up"), *width, policy),
                down: Layer::new(&format!("body.{block}.down"), 4 * width, policy),
            }));
            steps.push(Step::Norm(Norm::new("body.norm", policy)));
            steps
        }
    }
}

impl Step {
    /// The widest row that it reads or writes.
    fn widest(&self) -> usize {
        match self {
            Self::Dense(layer, _) => layer.inputs.max(layer.outputs),
            Self::Block { up, .. } => up.outputs,
            Self::Norm(norm) => norm.weight.len(),
        }
    }
}

impl Norm {
    fn new(name: &str, policy: &Policy) -> Self {
        let tensor = |part: &str| policy.tensor(&format!("{name}.{part}")).to_vec();
        Self { weight: tensor("weight"), bias: tensor("bias") }
    }

    /// Normalises the rows of one tile.
    fn apply(&self, rows: usize, from: &[f32], to: &mut [f32]) {
        let width = self.weight.len();
        let scale = 1.0 / width as f32;
        for (from, to) in from.chunks_exact(width).zip(to.chunks_exact_mut(width)).take(rows) {
            let mean = sum(from.iter().copied()) * scale;
            let variance = sum(from.iter().map(|x| (x - mean) * (x - mean))) * scale;
            let inverse = 1.0 / (variance + NORM_EPSILON).sqrt();
            let parameters = self.weight.iter().zip(&self.bias);
            for ((to, from), (weight, bias)) in to.iter_mut().zip(from).zip(parameters) {
                *to = (from - mean) * inverse * weight + bias;
            }
        }
    }
}

/// A sum in sixteen independent parts, which vectorises.
fn sum(values: impl ExactSizeIterator<Item = f32>) -> f32 {
    let mut parts = [0.0f32; 16];
    values.enumerate().for_each(|(index, value)| parts[index % 16] += value);
    parts.iter().sum()
}
