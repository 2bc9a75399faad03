//! The forward pass, in plain Rust on `gemm`: what actors run thousands of times a second.
//!
//! A batch is worked through in tiles of [`TILE`] rows, the last one padded with zeros. Every row thus goes
//! through the same arithmetic whatever the batch, so an evaluation gives the same bits on eight lanes as on one.

use gemm::Parallelism;

use crate::{LOG_STD_MAX, LOG_STD_MIN, Linear, ObservationStatistics, Policy};

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
    layers: Vec<Layer>,
    statistics: Option<ObservationStatistics>,
    observation: usize,
    action: usize,
    /// Two tiles of the widest layer: a layer reads one and writes the other.
    front: Vec<f32>,
    back: Vec<f32>,
    mean: Vec<f32>,
    log_std: Vec<f32>,
}

/// A layer whose weights lie `[inputs, outputs]`, so that the product's left factor is contiguous.
struct Layer {
    inputs: usize,
    outputs: usize,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Forward {
    /// Lays out `policy` for batches of up to `max_batch` rows (more are possible, and allocate once).
    pub fn new(policy: &Policy, max_batch: usize) -> Self {
        let layers: Vec<Layer> =
            policy.shape.layers().iter().map(|layer| Layer::new(layer, policy)).collect();
        let widest = layers.iter().map(|layer| layer.inputs.max(layer.outputs)).max().unwrap_or(0);
        let (observation, action) = (policy.shape.observation, policy.shape.action);
        Self {
            statistics: policy.statistics.clone(),
            observation,
            action,
            front: vec![0.0; TILE * widest],
            back: vec![0.0; TILE * widest],
            mean: Vec::with_capacity(max_batch * action),
            log_std: Vec::with_capacity(max_batch * action),
            layers,
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
        self.front[observations.len()..TILE * self.observation].fill(0.0);
        let (body, heads) = self.layers.split_at(self.layers.len() - 2);
        for layer in body {
            layer.apply(&self.front, &mut self.back);
            self.back[..TILE * layer.outputs].iter_mut().for_each(|x| *x = x.max(0.0));
            std::mem::swap(&mut self.front, &mut self.back);
        }
        let outputs = rows * self.action;
        heads[0].apply(&self.front, &mut self.back);
        self.mean.extend_from_slice(&self.back[..outputs]);
        heads[1].apply(&self.front, &mut self.back);
        let squashed = |x: &f32| LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (x.tanh() + 1.0);
        self.log_std.extend(self.back[..outputs].iter().map(squashed));
    }
}

impl Layer {
    fn new(layer: &Linear, policy: &Policy) -> Self {
        let (inputs, outputs) = (layer.inputs, layer.outputs);
        let weight = policy.tensor(&format!("{}.weight", layer.name));
        let mut transposed = vec![0.0; weight.len()];
        for (row, values) in weight.chunks_exact(inputs).enumerate() {
            for (column, value) in values.iter().enumerate() {
                transposed[column * outputs + row] = *value;
            }
        }
        let bias = policy.tensor(&format!("{}.bias", layer.name)).to_vec();
        Self { inputs, outputs, weight: transposed, bias }
    }

    /// `to = from · W + b` for one tile: `from` is `[TILE, inputs]`, `to` is `[TILE, outputs]`.
    fn apply(&self, from: &[f32], to: &mut [f32]) {
        let (inputs, outputs) = (self.inputs, self.outputs);
        let from = &from[..TILE * inputs];
        let to = &mut to[..TILE * outputs];
        for row in to.chunks_exact_mut(outputs) {
            row.copy_from_slice(&self.bias);
        }
        // SAFETY: seen as column-major, `to` is outputs × TILE, the weights outputs × inputs, `from` inputs × TILE;
        // the three slices have exactly these sizes and `to` overlaps neither of the others.
        unsafe {
            gemm::gemm(
                outputs,
                TILE,
                inputs,
                to.as_mut_ptr(),
                outputs as isize,
                1,
                true,
                self.weight.as_ptr(),
                outputs as isize,
                1,
                from.as_ptr(),
                inputs as isize,
                1,
                1.0,
                1.0,
                false,
                false,
                false,
                Parallelism::None,
            );
        }
    }
}
