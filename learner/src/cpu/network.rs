//! A body with its heads, forward and backward, on what [`super::factors`] and [`super::weights`] lay out.
//!
//! A [`Network`] is the shape and where each parameter lies in the flat buffer; a [`Trace`] is what one pass over R
//! transitions leaves for its way back. Nothing is allocated in a pass.

use std::ops::Range;

use getup_policy::Body;

use super::factors::{Factors, Purpose, Right};
use super::kernels;
use super::layout::{self, CHUNK, chunks};
use super::memory::Memory;
use super::product::Format;
use super::rows::{AsTheyAre, BiasRelu, Gradient, Normal, Passed};
use super::trace::{SavedNorm, Scratch, Trace, features};
use super::weights::Weights;

/// `y = W·x + b`.
#[derive(Clone, Debug)]
pub(super) struct Linear {
    pub(super) format: Format,
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    /// Where `W` and then `b` lie.
    pub(super) range: Range<usize>,
}

/// A layer norm.
#[derive(Clone, Debug)]
pub(super) struct Norm {
    pub(super) width: usize,
    /// Where weight and then bias lie.
    range: Range<usize>,
}

#[derive(Clone, Debug)]
pub(super) enum Layer {
    Dense { linear: Linear, relu: bool },
    Block { norm: Norm, up: Linear, down: Linear },
    Norm(Norm),
}

/// A body and its heads over one flat run of parameters.
#[derive(Clone, Debug)]
pub(super) struct Network {
    pub(super) layers: Vec<Layer>,
    pub(super) heads: Vec<Linear>,
    pub(super) inputs: usize,
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
        Self { layers, heads, inputs, length }
    }

    /// All linear layers, in the order of their parameters.
    pub(super) fn linears(&self) -> impl Iterator<Item = &Linear> {
        let body = self.layers.iter().flat_map(|layer| match layer {
            Layer::Dense { linear, .. } => vec![linear],
            Layer::Block { up, down, .. } => vec![up, down],
            Layer::Norm(_) => vec![],
        });
        body.chain(&self.heads)
    }

    /// The layers' parameters, in order: each linear layer's and each norm's, and whether they are a linear layer's.
    pub(super) fn pieces(&self) -> Vec<(Range<usize>, bool)> {
        let linear = |linear: &Linear| (linear.range.clone(), true);
        let mut pieces = Vec::new();
        for layer in &self.layers {
            match layer {
                Layer::Dense { linear: dense, .. } => pieces.push(linear(dense)),
                Layer::Block { norm, up, down } => {
                    pieces.extend([(norm.range.clone(), false), linear(up), linear(down)]);
                }
                Layer::Norm(norm) => pieces.push((norm.range.clone(), false)),
            }
        }
        pieces.extend(self.heads.iter().map(linear));
        pieces
    }

    /// Numbers in the longest gradient that is made at a time.
    pub(super) fn longest_gradient(&self) -> usize {
        let linear = |linear: &Linear| {
            (linear.inputs * linear.outputs.min(Format::MOST_AT_A_TIME)).max(linear.outputs)
        };
        let norms = self.pieces().into_iter().filter(|(_, is_linear)| !is_linear);
        let norms = norms.map(|(range, _)| range.len());
        self.linears().map(linear).chain(norms).chain(self.head_weights()).max().unwrap_or(0)
    }

    /// Numbers in each head's weights.
    pub(super) fn head_weights(&self) -> impl Iterator<Item = usize> {
        self.heads.iter().map(|head| head.inputs * head.outputs)
    }

    /// How many of the linear layers are the body's, which come first.
    pub(super) fn body_linears(&self) -> usize {
        self.linears().count() - self.heads.len()
    }

    /// Room for the weights in the products' layout, a linear layer each, with `values` in it.
    pub(super) fn weights(&self, values: &[f32], differentiated: bool, memory: &mut Memory) -> Vec<Weights> {
        let pack = |linear: &Linear| {
            let Linear { format, inputs, outputs, .. } = *linear;
            let mut weights = Weights::new(format, inputs, outputs, differentiated, memory);
            let mut values = AsTheyAre { first: 0, values: &values[linear.weight()], length: inputs };
            for part in &mut weights.parts {
                chunks(part.outputs.clone(), CHUNK).for_each(|outputs| part.pack(outputs, &mut values));
            }
            weights
        };
        self.linears().map(pack).collect()
    }

    /// Evaluates `input`, `[inputs, R]`; the heads' results are in [`Trace::outputs`].
    pub(super) fn forward(
        &self,
        values: &[f32],
        weights: &[Weights],
        input: &[f32],
        trace: &mut Trace,
        scratch: &mut Scratch,
        purpose: Purpose,
    ) {
        let Trace { layers, factors, outputs, rows, .. } = trace;
        let Scratch { product, here, there, .. } = scratch;
        let rows = *rows;
        let (mut weights, mut factors) = (weights.iter(), factors.iter_mut().peekable());
        let mut next_weights = || weights.next().expect(EVERY_LINEAR);
        for (index, layer) in self.layers.iter().enumerate() {
            let (before, after) = layers.split_at_mut(index);
            let x: &[f32] = before.last().map_or(input, |saved| &saved.result);
            let saved = &mut after[0];
            match layer {
                Layer::Dense { linear, relu } => {
                    let own = factors.next().expect(EVERY_LINEAR);
                    // The input of a later one was laid out by the ReLU before it.
                    if index == 0 {
                        let mut x = AsTheyAre { first: 0, values: x, length: rows };
                        own.pack_input(0..linear.inputs, &mut x, purpose, here);
                    }
                    let bias = &values[linear.bias()];
                    match factors.peek_mut() {
                        Some(next) if *relu => {
                            apply_relu(next_weights(), here, bias, next, purpose, there, product);
                            std::mem::swap(here, there);
                        }
                        _ => {
                            let all = 0..linear.outputs;
                            next_weights().apply(all, here.words(), rows, false, &mut saved.result);
                            match relu {
                                true => kernels::add_bias_relu(&mut saved.result, bias, rows),
                                false => kernels::add_bias(&mut saved.result, bias, rows),
                            }
                        }
                    }
                }
                Layer::Block { norm, up, down } => {
                    let mut normal = norm.forward(values, x, &mut saved.norm);
                    let own = factors.next().expect(EVERY_LINEAR);
                    own.pack_input(0..up.inputs, &mut normal, purpose, here);
                    let wide = factors.next().expect(EVERY_LINEAR);
                    apply_relu(next_weights(), here, &values[up.bias()], wide, purpose, there, product);
                    kernels::copy_with_bias(x, &values[down.bias()], rows, &mut saved.result);
                    next_weights().apply(0..down.outputs, there.words(), rows, true, &mut saved.result);
                }
                Layer::Norm(norm) => {
                    let mut normal = norm.forward(values, x, &mut saved.norm);
                    layout::write(&mut normal, 0..norm.width, rows, &mut saved.result, &mut []);
                }
            }
        }
        let features = bytemuck::cast_slice(features(layers));
        for (head, output) in self.heads.iter().zip(outputs) {
            next_weights().apply(0..head.outputs, features, rows, false, output);
            kernels::add_bias(output, &values[head.bias()], rows);
        }
    }

    /// The way back from [`Trace::output_gradients`] after [`Network::forward`] on the same trace.
    ///
    /// `gradient` receives the gradients of biases and of norms, and the trace the factors of the weights', if the pass
    /// forward was for learning; `input` receives those of the inputs from an index on, `[inputs − index, R]`, added to what
    /// is there.
    pub(super) fn backward(
        &self,
        values: &[f32],
        weights: &[Weights],
        trace: &mut Trace,
        scratch: &mut Scratch,
        mut gradient: Option<&mut [f32]>,
        input: Option<(usize, &mut [f32])>,
    ) {
        let Trace { layers, factors, heads, output_gradients, rows, .. } = trace;
        let Scratch { product, here, there, front, back } = scratch;
        let (rows, learns) = (*rows, gradient.is_some());
        if let Some(gradient) = gradient.as_deref_mut() {
            for ((head, output), factors) in self.heads.iter().zip(&*output_gradients).zip(heads) {
                factors.pack_gradient(output);
                kernels::row_sums(output, rows, &mut gradient[head.bias()]);
            }
        }
        let (weights, head_weights) = weights.split_at(weights.len() - self.heads.len());
        // The gradient of some of what the heads read.
        let turn_back_heads = |features: Range<usize>, to: &mut [f32]| {
            for (index, (weights, output)) in head_weights.iter().zip(&*output_gradients).enumerate() {
                let output = bytemuck::cast_slice(output);
                weights.apply_transposed(features.clone(), output, rows, index > 0, to);
            }
        };
        let mut weights = weights.iter().rev();
        let mut next_weights = || weights.next().expect(EVERY_LINEAR);
        // Those of the layers before.
        let mut factors = &mut factors[..];
        for (index, layer) in self.layers.iter().enumerate().rev() {
            let saved = &layers[index];
            match layer {
                Layer::Norm(norm) => {
                    turn_back_heads(0..norm.width, back);
                    front[..saved.result.len()].fill(0.0);
                    norm.backward(values, &saved.norm, back, front, gradient.as_deref_mut());
                }
                Layer::Block { norm, up, down } => {
                    let [before @ .., own, wide] = factors else { unreachable!("{EVERY_LINEAR}") };
                    let sums = gradient.as_deref_mut().map(|gradient| &mut gradient[down.bias()]);
                    let mut whole = Gradient { first: 0, values: front, passed: Passed::All, rows, sums };
                    wide.pack_gradient(0..down.outputs, &mut whole, learns, here);
                    let sums = gradient.as_deref_mut().map(|gradient| &mut gradient[up.bias()]);
                    turn_back_relu(next_weights(), here, wide.passed(), own, sums, there, product);
                    next_weights().apply_transposed(0..up.inputs, there.words(), rows, false, back);
                    norm.backward(values, &saved.norm, back, front, gradient.as_deref_mut());
                    factors = before;
                }
                Layer::Dense { linear, relu } => {
                    let [before @ .., own] = factors else { unreachable!("{EVERY_LINEAR}") };
                    // The gradient of an earlier one's result was laid out by the one after it.
                    let mut sums = gradient.as_deref_mut().map(|gradient| &mut gradient[linear.bias()]);
                    if !relu {
                        let mut whole = Gradient { first: 0, values: front, passed: Passed::All, rows, sums };
                        own.pack_gradient(0..linear.outputs, &mut whole, learns, here);
                    } else if index + 1 == self.layers.len() {
                        for features in chunks(0..linear.outputs, Format::F32.at_a_time(1, rows)) {
                            let values = &mut product[..features.len() * rows];
                            turn_back_heads(features.clone(), values);
                            let (passed, sums) = (Passed::Positive(&saved.result), sums.as_deref_mut());
                            let mut chunk = Gradient { first: features.start, values, passed, rows, sums };
                            own.pack_gradient(features, &mut chunk, learns, here);
                        }
                    }
                    match (before.last_mut(), self.layers[..index].last()) {
                        (Some(before), Some(Layer::Dense { linear, .. })) => {
                            let sums = gradient.as_deref_mut().map(|gradient| &mut gradient[linear.bias()]);
                            turn_back_relu(next_weights(), here, own.passed(), before, sums, there, product);
                            std::mem::swap(here, there);
                        }
                        _ => {
                            let Some((first, to)) = input else { return };
                            let inputs = first..linear.inputs;
                            next_weights().apply_transposed(inputs, here.words(), rows, true, to);
                            return;
                        }
                    }
                    factors = before;
                }
            }
        }
    }
}

const EVERY_LINEAR: &str = "there is one for every linear layer";

/// `max(W·x + bias, 0)`, laid out as it is made for the layer whose factors `to` are, in `right`.
fn apply_relu(
    weights: &Weights,
    x: &Right,
    bias: &[f32],
    to: &mut Factors,
    purpose: Purpose,
    right: &mut Right,
    product: &mut [f32],
) {
    let rows = to.rows();
    for outputs in weights.output_chunks(rows) {
        let values = &mut product[..outputs.len() * rows];
        weights.apply(outputs.clone(), x.words(), rows, false, values);
        let mut chunk = BiasRelu { first: outputs.start, values, bias, rows };
        to.pack_input(outputs, &mut chunk, purpose, right);
    }
}

/// `Wᵀ·from` where a ReLU let through, laid out as it is made for the layer whose factors `to` are, in `right`; `sums` are
/// asked for by a pass that learns.
fn turn_back_relu(
    weights: &Weights,
    from: &Right,
    passed: Passed<'_>,
    to: &mut Factors,
    mut sums: Option<&mut [f32]>,
    right: &mut Right,
    product: &mut [f32],
) {
    let (rows, learns) = (to.rows(), sums.is_some());
    for inputs in weights.input_chunks(rows) {
        let values = &mut product[..inputs.len() * rows];
        weights.apply_transposed(inputs.clone(), from.words(), rows, false, values);
        let mut chunk = Gradient { first: inputs.start, values, passed, rows, sums: sums.as_deref_mut() };
        to.pack_gradient(inputs, &mut chunk, learns, right);
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
    /// The products of passes over a trace, each at its whole shape, and nothing else, on whatever lies there.
    pub(super) fn multiply(
        &self,
        weights: &[Weights],
        trace: &mut Trace,
        scratch: &mut Scratch,
        ways: Ways,
        gradient: &mut [f32],
    ) {
        let Trace { layers, factors, heads, output_gradients, rows, .. } = trace;
        let Scratch { here, front, back, .. } = scratch;
        let (x, rows) = (here.words(), *rows);
        for (index, ((linear, weights), factors)) in self.linears().zip(weights).zip(factors).enumerate() {
            let all = || 0..linear.outputs;
            (0..ways.forward).for_each(|_| weights.apply(all(), x, rows, false, back));
            let gradient = &mut gradient[linear.weight()];
            (0..ways.weights).for_each(|_| factors.multiply(all(), false, gradient));
            let Some(first) = (if index == 0 { ways.first } else { Some(0) }) else { continue };
            let inputs = || first..linear.inputs;
            (0..ways.inputs).for_each(|_| weights.apply_transposed(inputs(), x, rows, false, front));
        }
        let features = features(layers);
        let weights = &weights[weights.len() - self.heads.len()..];
        for (((head, weights), output), factors) in
            self.heads.iter().zip(weights).zip(output_gradients).zip(heads)
        {
            let (x, y) = (bytemuck::cast_slice(features), bytemuck::cast_slice(output));
            (0..ways.forward).for_each(|_| weights.apply(0..head.outputs, x, rows, false, back));
            let gradient = &mut gradient[head.weight()];
            (0..ways.weights).for_each(|_| factors.multiply(features, 0..head.outputs, false, gradient));
            (0..ways.inputs).for_each(|_| weights.apply_transposed(0..head.inputs, y, rows, false, front));
        }
    }
}
