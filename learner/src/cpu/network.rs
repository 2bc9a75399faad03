//! A body with its heads, forward and backward, on the layouts of `operand`.
//!
//! A [`Network`] is the shape and where each parameter lies in the flat buffer; [`Trace`] is what one pass over R
//! transitions leaves for its way back. Nothing is allocated in a pass.

use std::ops::Range;

use getup_policy::Body;

use super::kernels::{self, BiasRelu, Gradient, Normal};
use super::layout::{self, AsTheyAre};
use super::memory::{Buffer, Memory};
use super::operand::{Numbers, Operand, Weights, weight_gradient, weight_gradient_transposed};
use super::product::Format;

/// `y = W·x + b`.
#[derive(Clone, Debug)]
pub(super) struct Linear {
    format: Format,
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    /// Where `W` and then `b` lie.
    pub(super) range: Range<usize>,
}

/// A layer norm.
#[derive(Clone, Debug)]
struct Norm {
    width: usize,
    /// Where weight and then bias lie.
    range: Range<usize>,
}

#[derive(Clone, Debug)]
enum Layer {
    Dense { linear: Linear, relu: bool },
    Block { norm: Norm, up: Linear, down: Linear },
    Norm(Norm),
}

/// A body and its heads over one flat run of parameters.
#[derive(Clone, Debug)]
pub(super) struct Network {
    layers: Vec<Layer>,
    heads: Vec<Linear>,
    pub(super) inputs: usize,
    pub(super) width: usize,
    /// Numbers in all parameters.
    pub(super) length: usize,
}

impl Linear {
    fn weight(&self) -> Range<usize> {
        self.range.start..self.range.start + self.inputs * self.outputs
    }

    fn bias(&self) -> Range<usize> {
        self.range.start + self.inputs * self.outputs..self.range.end
    }
}

impl Norm {
    fn split<'a>(&self, values: &'a [f32]) -> (&'a [f32], &'a [f32]) {
        values[self.range.clone()].split_at(self.width)
    }

    fn forward<'a>(&self, values: &'a [f32], x: &'a [f32], saved: &'a mut SavedNorm) -> Normal<'a> {
        let (weight, bias) = self.split(values);
        let SavedNorm { mean, inverse, normal } = saved;
        kernels::moments(x, mean, inverse);
        Normal { x, mean, inverse, weight, bias, normal }
    }

    /// Adds the gradient of the norm's input to `to`.
    fn backward(
        &self,
        values: &[f32],
        saved: &SavedNorm,
        from: &[f32],
        to: &mut [f32],
        gradient: Option<&mut [f32]>,
    ) {
        let (weight, _) = self.split(values);
        let parameters = gradient.map(|gradient| gradient[self.range.clone()].split_at_mut(self.width));
        kernels::layer_norm_gradient(from, weight, &saved.normal, &saved.inverse, to, parameters);
    }
}

impl Network {
    /// The parameters lie in the order of [`Body::tensors`], the heads (`outputs` numbers each) after them. The
    /// body's products are in `format`, the heads' in float32.
    pub(super) fn new(body: &Body, inputs: usize, heads: &[usize], format: Format) -> Self {
        let mut length = 0;
        let mut take = |count: usize| {
            length += count;
            length - count..length
        };
        let mut linear = |format: Format, inputs: usize, outputs: usize| {
            let range = take((inputs + 1) * outputs);
            Linear { format, inputs, outputs, range }
        };
        let mut layers = Vec::new();
        match body {
            Body::Mlp { hidden } => {
                let mut width = inputs;
                for outputs in hidden {
                    layers.push(Layer::Dense { linear: linear(format, width, *outputs), relu: true });
                    width = *outputs;
                }
            }
            Body::Simba { width, blocks } => {
                let width = *width;
                layers.push(Layer::Dense { linear: linear(format, inputs, width), relu: false });
                for _ in 0..*blocks {
                    // A norm's weight and bias take as much room as a layer with one input.
                    let norm = Norm { width, range: linear(format, 1, width).range };
                    let up = linear(format, width, 4 * width);
                    let down = linear(format, 4 * width, width);
                    layers.push(Layer::Block { norm, up, down });
                }
                layers.push(Layer::Norm(Norm { width, range: linear(format, 1, width).range }));
            }
        }
        let width = body.output_width(inputs);
        let heads = heads.iter().map(|outputs| linear(Format::F32, width, *outputs)).collect();
        Self { layers, heads, inputs, width, length }
    }

    /// All linear layers, in the order of their parameters.
    fn linears(&self) -> impl Iterator<Item = &Linear> {
        let body = self.layers.iter().flat_map(|layer| match layer {
            Layer::Dense { linear, .. } => vec![linear],
            Layer::Block { up, down, .. } => vec![up, down],
            Layer::Norm(_) => vec![],
        });
        body.chain(&self.heads)
    }

    /// Runs of parameters that can be updated apart from each other, in order: each linear layer and each norm.
    /// With a linear layer, the number of its weights.
    pub(super) fn pieces(&self) -> Vec<(Range<usize>, Option<usize>)> {
        let linear = |linear: &Linear| (linear.range.clone(), Some(linear.inputs * linear.outputs));
        let mut pieces = Vec::new();
        for layer in &self.layers {
            match layer {
                Layer::Dense { linear: dense, .. } => pieces.push(linear(dense)),
                Layer::Block { norm, up, down } => {
                    pieces.extend([(norm.range.clone(), None), linear(up), linear(down)]);
                }
                Layer::Norm(norm) => pieces.push((norm.range.clone(), None)),
            }
        }
        pieces.extend(self.heads.iter().map(linear));
        pieces
    }

    /// Room for the weights in the products' layout, a linear layer each, with `values` in it.
    pub(super) fn weights(&self, values: &[f32], differentiated: bool, memory: &mut Memory) -> Vec<Weights> {
        let pack = |linear: &Linear| {
            let Linear { format, inputs, outputs, .. } = *linear;
            let mut weights = Weights::new(format, inputs, outputs, differentiated, memory);
            let values = &values[linear.weight()];
            weights.chunks().for_each(|(first, range)| weights.pack(first, &values[range]));
            weights
        };
        self.linears().map(pack).collect()
    }

    /// Evaluates `input`, `[inputs, R]`; the heads' results are in [`Trace::outputs`].
    pub(super) fn forward(&self, values: &[f32], weights: &[Weights], input: &[f32], trace: &mut Trace) {
        let mut weights = weights.iter();
        let mut next_weights = || weights.next().expect("one for every linear layer");
        for (index, layer) in self.layers.iter().enumerate() {
            let (before, after) = trace.layers.split_at_mut(index);
            let x: &[f32] = before.last().map_or(input, |saved| &saved.result);
            let [saved, after @ ..] = after else { unreachable!("one for every layer") };
            let rows = saved.rows;
            match layer {
                Layer::Dense { linear, relu } => {
                    // The input of a later one was laid out by the ReLU before it.
                    if index == 0 {
                        saved.input.pack(&mut AsTheyAre { values: x, length: rows });
                    }
                    next_weights().apply(saved.input.right(), rows, false, &mut saved.result);
                    let bias = &values[linear.bias()];
                    match (relu, after.first_mut()) {
                        (true, Some(next)) => {
                            next.input.pack(&mut BiasRelu { values: &saved.result, bias, rows });
                        }
                        (true, None) => kernels::add_bias_relu(&mut saved.result, bias, rows),
                        (false, _) => kernels::add_bias(&mut saved.result, bias, rows),
                    }
                }
                Layer::Block { norm, up, down } => {
                    saved.input.pack(&mut norm.forward(values, x, &mut saved.norm));
                    next_weights().apply(saved.input.right(), rows, false, &mut saved.wide);
                    let bias = &values[up.bias()];
                    saved.activated.pack(&mut BiasRelu { values: &saved.wide, bias, rows });
                    kernels::copy_with_bias(x, &values[down.bias()], rows, &mut saved.result);
                    next_weights().apply(saved.activated.right(), rows, true, &mut saved.result);
                }
                Layer::Norm(norm) => {
                    layout::write(&mut norm.forward(values, x, &mut saved.norm), rows, &mut saved.result);
                }
            }
        }
        let features = features(&trace.layers);
        for (head, output) in self.heads.iter().zip(&mut trace.outputs) {
            next_weights().apply(bytemuck::cast_slice(features), trace.rows, false, output);
            kernels::add_bias(output, &values[head.bias()], trace.rows);
        }
    }

    /// The way back from [`Trace::output_gradients`] after [`Network::forward`] on the same trace.
    ///
    /// `gradient` receives the parameters' gradients, `input` those of the inputs from an index on, `[inputs − index,
    /// R]`, added to what is there.
    pub(super) fn backward(
        &self,
        values: &[f32],
        weights: &[Weights],
        trace: &mut Trace,
        mut gradient: Option<&mut [f32]>,
        input: Option<(usize, &mut [f32])>,
    ) {
        let mut weights = weights.iter().rev();
        let mut next_weights = || weights.next().expect("one for every linear layer");
        let Trace { layers, output_gradients, head_gradients, head_weights, front, back, wide, .. } = trace;
        let heads = self.heads.iter().zip(output_gradients).zip(head_gradients);
        for (index, ((head, output), operand)) in heads.rev().enumerate() {
            operand.pack(&mut AsTheyAre { values: output, length: operand.rows });
            if let Some(gradient) = gradient.as_deref_mut() {
                operand.transpose();
                let turned = &mut head_weights[..head.inputs * head.outputs];
                weight_gradient_transposed(operand, features(layers), turned);
                let to = bytemuck::cast_slice_mut(&mut gradient[head.weight()]);
                layout::transpose(bytemuck::cast_slice(turned), head.inputs, head.outputs, to, head.inputs);
                kernels::row_sums(output, operand.rows, &mut gradient[head.bias()]);
            }
            next_weights().apply_transposed(operand, 0, index > 0, front);
        }
        for (index, layer) in self.layers.iter().enumerate().rev() {
            let [saved, after @ ..] = &mut layers[index..] else { unreachable!("one for every layer") };
            let rows = saved.rows;
            match layer {
                Layer::Norm(norm) => {
                    back[..saved.result.len()].fill(0.0);
                    norm.backward(values, &saved.norm, front, back, gradient.as_deref_mut());
                    std::mem::swap(front, back);
                }
                Layer::Block { norm, up, down } => {
                    let sums = gradient.as_deref_mut().map(|gradient| &mut gradient[down.bias()]);
                    saved.result_gradient.pack(&mut Gradient::new(front, None, rows, sums));
                    if let Some(gradient) = gradient.as_deref_mut() {
                        saved.activated.transpose();
                        let to = &mut gradient[down.weight()];
                        weight_gradient(&saved.result_gradient, &saved.activated, to);
                    }
                    let wide = &mut wide[..saved.wide.len()];
                    next_weights().apply_transposed(&saved.result_gradient, 0, false, wide);
                    let sums = gradient.as_deref_mut().map(|gradient| &mut gradient[up.bias()]);
                    let result = Some(saved.activated.numbers());
                    saved.wide_gradient.pack(&mut Gradient::new(wide, result, rows, sums));
                    if let Some(gradient) = gradient.as_deref_mut() {
                        saved.input.transpose();
                        weight_gradient(&saved.wide_gradient, &saved.input, &mut gradient[up.weight()]);
                    }
                    next_weights().apply_transposed(&saved.wide_gradient, 0, false, back);
                    norm.backward(values, &saved.norm, back, front, gradient.as_deref_mut());
                }
                Layer::Dense { linear, relu } => {
                    let result = match after.first() {
                        _ if !relu => None,
                        Some(next) => Some(next.input.numbers()),
                        None => Some(Numbers::F32(&saved.result)),
                    };
                    let sums = gradient.as_deref_mut().map(|gradient| &mut gradient[linear.bias()]);
                    saved.result_gradient.pack(&mut Gradient::new(front, result, rows, sums));
                    if let Some(gradient) = gradient.as_deref_mut() {
                        saved.input.transpose();
                        let to = &mut gradient[linear.weight()];
                        weight_gradient(&saved.result_gradient, &saved.input, to);
                    }
                    let weights = next_weights();
                    if index > 0 {
                        weights.apply_transposed(&saved.result_gradient, 0, false, back);
                        std::mem::swap(front, back);
                    } else if let Some((first, to)) = input {
                        weights.apply_transposed(&saved.result_gradient, first, true, to);
                        return;
                    }
                }
            }
        }
    }
}

/// Which of an update's products are asked for: see [`Network::multiply`].
#[derive(Clone, Copy)]
pub(super) struct Ways {
    /// Times forward.
    pub(super) forward: usize,
    /// Times back to the weights.
    pub(super) weights: usize,
    /// Times back to every layer's input.
    pub(super) inputs: usize,
    /// The first input whose gradient is asked for; none where it ends at the first layer.
    pub(super) first: Option<usize>,
}

impl Network {
    /// The products of passes over a trace and nothing else, on whatever lies there: what an update cannot do without.
    pub(super) fn multiply(&self, weights: &[Weights], trace: &mut Trace, ways: Ways, gradient: &mut [f32]) {
        let Trace { layers, head_gradients, head_weights, front, back, .. } = trace;
        let mut weights = weights.iter();
        let mut pass = |linear: &Linear, x: &Operand, y: &Operand, first: Option<usize>| {
            let weights = weights.next().expect("one for every linear layer");
            (0..ways.forward).for_each(|_| weights.apply(x.right(), x.rows, false, back));
            (0..ways.weights).for_each(|_| weight_gradient(y, x, &mut gradient[linear.weight()]));
            let Some(first) = first else { return };
            (0..ways.inputs).for_each(|_| weights.apply_transposed(y, first, false, front));
        };
        for (index, (layer, saved)) in self.layers.iter().zip(&*layers).enumerate() {
            match layer {
                Layer::Dense { linear, .. } => {
                    let first = if index == 0 { ways.first } else { Some(0) };
                    pass(linear, &saved.input, &saved.result_gradient, first);
                }
                Layer::Block { up, down, .. } => {
                    pass(up, &saved.input, &saved.wide_gradient, Some(0));
                    pass(down, &saved.activated, &saved.result_gradient, Some(0));
                }
                Layer::Norm(_) => {}
            }
        }
        let x = features(layers);
        for (y, weights) in head_gradients.iter().zip(weights) {
            (0..ways.forward).for_each(|_| weights.apply(bytemuck::cast_slice(x), y.rows, false, back));
            let turned = &mut head_weights[..x.len() / y.rows * y.features];
            (0..ways.weights).for_each(|_| weight_gradient_transposed(y, x, turned));
            (0..ways.inputs).for_each(|_| weights.apply_transposed(y, 0, false, front));
        }
    }
}

/// What the heads read, `[width, R]`.
fn features(layers: &[Saved]) -> &[f32] {
    &layers.last().expect("a body has a layer").result
}

/// What a pass through one layer leaves for the way back; buffers a layer does not need are empty.
struct Saved {
    rows: usize,
    /// What the first product reads.
    input: Operand,
    /// A block's inner activations, before bias and ReLU, and as the second product reads them.
    wide: Buffer<f32>,
    activated: Operand,
    norm: SavedNorm,
    /// Of a layer whose ReLU's result another layer reads: before bias and ReLU.
    result: Buffer<f32>,
    /// Gradients as the products read them.
    result_gradient: Operand,
    wide_gradient: Operand,
}

/// What a norm leaves: the input's mean, the inverse of its standard deviation, `[R]` each, and what it makes of it.
struct SavedNorm {
    mean: Buffer<f32>,
    inverse: Buffer<f32>,
    normal: Buffer<f32>,
}

impl Saved {
    fn new(layer: &Layer, rows: usize, memory: &mut Memory) -> Self {
        let (inputs, width, wide, norm, format) = match layer {
            Layer::Dense { linear, .. } => (linear.inputs, linear.outputs, 0, 0, linear.format),
            Layer::Block { norm, up, .. } => (norm.width, norm.width, up.outputs, norm.width, up.format),
            Layer::Norm(norm) => (0, norm.width, 0, norm.width, Format::F32),
        };
        let packed = if matches!(layer, Layer::Norm(_)) { 0 } else { width };
        Self {
            rows,
            input: Operand::new(format, inputs, rows, memory),
            wide: memory.zeros(wide * rows),
            activated: Operand::new(format, wide, rows, memory),
            norm: SavedNorm {
                mean: memory.zeros(if norm > 0 { rows } else { 0 }),
                inverse: memory.zeros(if norm > 0 { rows } else { 0 }),
                normal: memory.zeros(norm * rows),
            },
            result: memory.zeros(width * rows),
            result_gradient: Operand::new(format, packed, rows, memory),
            wide_gradient: Operand::new(format, wide, rows, memory),
        }
    }
}

/// One pass over R transitions, R a multiple of [`kernels::LANES`].
pub(super) struct Trace {
    layers: Vec<Saved>,
    rows: usize,
    /// The heads' results, `[outputs, R]` each.
    pub(super) outputs: Vec<Buffer<f32>>,
    /// Where the gradients of the loss by the heads' results go before the way back.
    pub(super) output_gradients: Vec<Buffer<f32>>,
    head_gradients: Vec<Operand>,
    /// The gradient of a head's weights, transposed.
    head_weights: Buffer<f32>,
    /// The gradient on its way back: of a layer's result, and of its input.
    front: Buffer<f32>,
    back: Buffer<f32>,
    wide: Buffer<f32>,
}

impl Trace {
    pub(super) fn new(network: &Network, rows: usize, memory: &mut Memory) -> Self {
        let layers: Vec<Saved> = network.layers.iter().map(|layer| Saved::new(layer, rows, memory)).collect();
        let results = layers.iter().map(|saved| saved.result.len()).max().unwrap_or(0);
        let wide = layers.iter().map(|saved| saved.wide.len()).max().unwrap_or(0);
        let widest = results.max(network.width * rows).max(network.inputs * rows).max(wide);
        let head_weights = network.heads.iter().map(|head| head.inputs * head.outputs).max().unwrap_or(0);
        let heads = || network.heads.iter().map(|head| head.outputs);
        Self {
            rows,
            outputs: heads().map(|outputs| memory.zeros(outputs * rows)).collect(),
            output_gradients: heads().map(|outputs| memory.zeros(outputs * rows)).collect(),
            head_gradients: heads().map(|outputs| Operand::new(Format::F32, outputs, rows, memory)).collect(),
            head_weights: memory.zeros(head_weights),
            front: memory.zeros(widest),
            back: memory.zeros(widest),
            wide: memory.zeros(wide),
            layers,
        }
    }
}
