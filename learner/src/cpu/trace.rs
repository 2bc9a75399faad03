//! What a pass through a network leaves, and what it needs meanwhile.

use std::ops::Range;

use super::factors::{Factors, HeadFactors, Right};
use super::memory::{Buffer, Memory};
use super::network::{Layer, Linear, Network};
use super::product::Format;
use super::transpose;

/// What the heads read, `[width, R]`.
pub(super) fn features(layers: &[Saved]) -> &[f32] {
    &layers.last().expect("a body has a layer").result
}

/// What a pass through one layer leaves for the way back; buffers a layer does not need are empty.
pub(super) struct Saved {
    pub(super) norm: SavedNorm,
    /// Empty where it is laid out for the next layer as it is made.
    pub(super) result: Buffer<f32>,
}

/// What a norm leaves: the input's mean, the inverse of its standard deviation, `[R]` each, and what it makes of it.
pub(super) struct SavedNorm {
    pub(super) mean: Buffer<f32>,
    pub(super) inverse: Buffer<f32>,
    pub(super) normal: Buffer<f32>,
}

impl Saved {
    /// Whether its result `goes_on` into the next layer's input as it is made.
    fn new(layer: &Layer, goes_on: bool, rows: usize, memory: &mut Memory) -> Self {
        let (width, norm) = match layer {
            Layer::Dense { linear, .. } => (linear.outputs, 0),
            Layer::Block { norm, .. } | Layer::Norm(norm) => (norm.width, norm.width),
        };
        let each = if norm > 0 { rows } else { 0 };
        let [mean, inverse, normal] = [each, each, norm * rows].map(|length| memory.zeros(length));
        let result = memory.zeros(if goes_on { 0 } else { width * rows });
        Self { norm: SavedNorm { mean, inverse, normal }, result }
    }
}

/// One pass over R transitions, R a multiple of [`super::layout::LANES`].
pub(super) struct Trace {
    pub(super) layers: Vec<Saved>,
    /// Of the body's linear layers.
    pub(super) factors: Vec<Factors>,
    pub(super) heads: Vec<HeadFactors>,
    /// R.
    pub(super) rows: usize,
    /// The heads' results, `[outputs, R]` each.
    pub(super) outputs: Vec<Buffer<f32>>,
    /// Where the gradients of the loss by the heads' results go before the way back.
    pub(super) output_gradients: Vec<Buffer<f32>>,
}

impl Trace {
    pub(super) fn new(network: &Network, rows: usize, memory: &mut Memory) -> Self {
        let last = network.layers.len().saturating_sub(1);
        let (mut layers, mut factors) = (Vec::new(), Vec::new());
        for (index, layer) in network.layers.iter().enumerate() {
            let mut keep = |linear: &Linear, after_relu| {
                let sides = [linear.inputs, linear.outputs, rows];
                factors.push(Factors::new(linear.format, sides, after_relu, memory));
            };
            match layer {
                Layer::Dense { linear, .. } => keep(linear, index > 0),
                Layer::Block { up, down, .. } => {
                    keep(up, false);
                    keep(down, true);
                }
                Layer::Norm(_) => {}
            }
            let goes_on = matches!(layer, Layer::Dense { relu: true, .. }) && index < last;
            layers.push(Saved::new(layer, goes_on, rows, memory));
        }
        let heads = || network.heads.iter().map(|head| head.outputs);
        Self {
            layers,
            factors,
            heads: heads().map(|outputs| HeadFactors::new(outputs, rows, memory)).collect(),
            rows,
            outputs: heads().map(|outputs| memory.zeros(outputs * rows)).collect(),
            output_gradients: heads().map(|outputs| memory.zeros(outputs * rows)).collect(),
        }
    }

    /// How many outputs' weights had better have their gradient made at a time, of one of the body's linear layers.
    pub(super) fn outputs_at_a_time(&self, linear: usize) -> usize {
        self.factors[linear].outputs_at_a_time()
    }

    /// The gradient of a linear layer's weights that a pass for learning left, and those of other transitions, for some
    /// outputs, `[outputs, inputs]`; in `turned` on the way, where need be.
    pub(super) fn weight_gradient(
        traces: &[&Self],
        linear: usize,
        outputs: Range<usize>,
        to: &mut [f32],
        turned: &mut [f32],
    ) {
        for (index, trace) in traces.iter().enumerate() {
            match trace.factors.get(linear) {
                Some(factors) => factors.multiply(outputs.clone(), index > 0, to),
                None => {
                    let head = &trace.heads[linear - trace.factors.len()];
                    head.multiply(features(&trace.layers), outputs.clone(), index > 0, turned);
                }
            }
        }
        if !turned.is_empty() {
            let (columns, rows) = (outputs.len(), turned.len() / outputs.len());
            let (turned, to) = (bytemuck::cast_slice(turned), bytemuck::cast_slice_mut(to));
            transpose::transpose(turned, rows, columns, to, rows);
        }
    }
}

/// What a pass needs meanwhile, whichever the network.
pub(super) struct Scratch {
    /// What a product makes at a time.
    pub(super) product: Buffer<f32>,
    /// What the next product reads, and what is laid out for the one after it.
    pub(super) here: Right,
    pub(super) there: Right,
    /// The gradient on its way back: of a layer's result, and of its input.
    pub(super) front: Buffer<f32>,
    pub(super) back: Buffer<f32>,
}

impl Scratch {
    /// For `rows` transitions through either of the networks.
    pub(super) fn new(networks: [&Network; 2], rows: usize, memory: &mut Memory) -> Self {
        let linears = || networks.into_iter().flat_map(Network::linears);
        let widest = linears().map(|linear| linear.inputs.max(linear.outputs)).max().unwrap_or(0);
        Self {
            product: memory.zeros(widest.min(Format::MOST_AT_A_TIME) * widest.max(rows)),
            here: Right::new(widest, rows, memory),
            there: Right::new(widest, rows, memory),
            front: memory.zeros(widest * rows),
            back: memory.zeros(widest * rows),
        }
    }
}
