//! A body with its heads, forward and backward, on the layouts of `product`.
//!
//! A [`Network`] is the shape and where each parameter lies in the flat buffer; [`Trace`] is what one pass over R
//! transitions leaves for its way back. Nothing is allocated in a pass.

use std::ops::Range;

use getup_policy::Body;

use super::kernels;
use super::product::{Aligned, Format, Operand, Weights, weight_gradient, zeros};

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
    pub(super) fn weights(&self, values: &[f32], differentiated: bool) -> Vec<Weights> {
        let pack = |linear: &Linear| {
            let mut weights = Weights::new(linear.format, linear.inputs, linear.outputs, differentiated);
            weights.pack(&values[linear.weight()]);
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
            let saved = &mut after[0];
            let rows = saved.rows;
            match layer {
                Layer::Dense { linear, relu } => {
                    saved.input.pack(&x[..linear.inputs * rows]);
                    next_weights().apply(&saved.input, false, &mut saved.result);
                    let bias = &values[linear.bias()];
                    match relu {
                        true => kernels::add_bias_relu(&mut saved.result, bias, rows),
                        false => kernels::add_bias(&mut saved.result, bias, rows),
                    }
                }
                Layer::Block { norm, up, down } => {
                    let (weight, bias) = norm.split(values);
                    let hidden = &mut saved.result;
                    kernels::layer_norm(x, weight, bias, &mut saved.normal, &mut saved.inverse, hidden);
                    saved.input.pack(hidden);
                    next_weights().apply(&saved.input, false, &mut saved.wide);
                    kernels::add_bias_relu(&mut saved.wide, &values[up.bias()], rows);
                    saved.activated.pack(&saved.wide);
                    saved.result.copy_from_slice(x);
                    next_weights().apply(&saved.activated, true, &mut saved.result);
                    kernels::add_bias(&mut saved.result, &values[down.bias()], rows);
                }
                Layer::Norm(norm) => {
                    let (weight, bias) = norm.split(values);
                    let Saved { normal, inverse, result, .. } = saved;
                    kernels::layer_norm(x, weight, bias, normal, inverse, result);
                }
            }
        }
        let features: &[f32] = trace.layers.last().map_or(input, |saved| &saved.result);
        trace.features.pack(features);
        for (head, output) in self.heads.iter().zip(&mut trace.outputs) {
            next_weights().apply(&trace.features, false, output);
            kernels::add_bias(output, &values[head.bias()], trace.features.rows);
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
        let Trace { layers, features, output_gradients, head_gradients, front, back, wide, .. } = trace;
        let heads = self.heads.iter().zip(output_gradients).zip(head_gradients);
        if gradient.is_some() {
            features.transpose();
        }
        for (index, ((head, output), operand)) in heads.rev().enumerate() {
            operand.pack(output);
            if let Some(gradient) = gradient.as_deref_mut() {
                linear_gradient(head, operand, output, features, gradient);
            }
            next_weights().apply_transposed(operand, 0, index > 0, front);
        }
        for (index, (layer, saved)) in self.layers.iter().zip(layers).enumerate().rev() {
            match layer {
                Layer::Norm(norm) => {
                    back.fill(0.0);
                    norm_gradient(norm, values, saved, front, back, gradient.as_deref_mut());
                    std::mem::swap(front, back);
                }
                Layer::Block { norm, up, down } => {
                    let from = &front[..saved.result.len()];
                    saved.result_gradient.pack(from);
                    if let Some(gradient) = gradient.as_deref_mut() {
                        saved.activated.transpose();
                        linear_gradient(down, &saved.result_gradient, from, &saved.activated, gradient);
                    }
                    let wide = &mut wide[..saved.wide.len()];
                    next_weights().apply_transposed(&saved.result_gradient, 0, false, wide);
                    kernels::relu_gradient(wide, &saved.wide);
                    saved.wide_gradient.pack(wide);
                    if let Some(gradient) = gradient.as_deref_mut() {
                        saved.input.transpose();
                        linear_gradient(up, &saved.wide_gradient, wide, &saved.input, gradient);
                    }
                    next_weights().apply_transposed(&saved.wide_gradient, 0, false, back);
                    norm_gradient(norm, values, saved, back, front, gradient.as_deref_mut());
                }
                Layer::Dense { linear, relu } => {
                    let front_part = &mut front[..saved.result.len()];
                    if *relu {
                        kernels::relu_gradient(front_part, &saved.result);
                    }
                    saved.result_gradient.pack(front_part);
                    if let Some(gradient) = gradient.as_deref_mut() {
                        saved.input.transpose();
                        linear_gradient(linear, &saved.result_gradient, front_part, &saved.input, gradient);
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
        let Trace { layers, features, head_gradients, front, back, .. } = trace;
        let mut weights = weights.iter();
        let mut pass = |linear: &Linear, x: &Operand, y: &Operand, first: Option<usize>| {
            let weights = weights.next().expect("one for every linear layer");
            (0..ways.forward).for_each(|_| weights.apply(x, false, back));
            (0..ways.weights).for_each(|_| weight_gradient(y, x, &mut gradient[linear.weight()]));
            let Some(first) = first else { return };
            (0..ways.inputs).for_each(|_| weights.apply_transposed(y, first, false, front));
        };
        for (index, (layer, saved)) in self.layers.iter().zip(layers).enumerate() {
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
        for (head, y) in self.heads.iter().zip(head_gradients) {
            pass(head, features, y, Some(0));
        }
    }
}

/// The gradients of a linear layer's parameters.
fn linear_gradient(linear: &Linear, packed: &Operand, values: &[f32], x: &Operand, gradient: &mut [f32]) {
    weight_gradient(packed, x, &mut gradient[linear.weight()]);
    kernels::row_sums(values, packed.rows, &mut gradient[linear.bias()]);
}

/// Adds the gradient of a norm's input to `to`.
fn norm_gradient(
    norm: &Norm,
    values: &[f32],
    saved: &Saved,
    from: &[f32],
    to: &mut [f32],
    gradient: Option<&mut [f32]>,
) {
    let (weight, _) = norm.split(values);
    let parameters = gradient.map(|gradient| gradient[norm.range.clone()].split_at_mut(norm.width));
    kernels::layer_norm_gradient(from, weight, &saved.normal, &saved.inverse, to, parameters);
}

/// What a pass through one layer leaves for the way back; buffers a layer does not need are empty.
struct Saved {
    rows: usize,
    /// What the first product reads.
    input: Operand,
    /// A block's inner activations, as numbers and as the second product reads them.
    wide: Aligned<f32>,
    activated: Operand,
    /// A norm's normalised input, and the inverse of its standard deviation.
    normal: Aligned<f32>,
    inverse: Aligned<f32>,
    result: Aligned<f32>,
    /// Gradients as the products read them.
    result_gradient: Operand,
    wide_gradient: Operand,
}

impl Saved {
    fn new(layer: &Layer, rows: usize) -> Self {
        let (inputs, width, wide, norm, format) = match layer {
            Layer::Dense { linear, .. } => (linear.inputs, linear.outputs, 0, 0, linear.format),
            Layer::Block { norm, up, .. } => (norm.width, norm.width, up.outputs, norm.width, up.format),
            Layer::Norm(norm) => (0, norm.width, 0, norm.width, Format::F32),
        };
        let packed = if matches!(layer, Layer::Norm(_)) { 0 } else { width };
        Self {
            rows,
            input: Operand::new(format, inputs, rows),
            wide: zeros(wide * rows),
            activated: Operand::new(format, wide, rows),
            normal: zeros(norm * rows),
            inverse: zeros(if norm > 0 { rows } else { 0 }),
            result: zeros(width * rows),
            result_gradient: Operand::new(format, packed, rows),
            wide_gradient: Operand::new(format, wide, rows),
        }
    }
}

/// One pass over R transitions, R a multiple of [`kernels::LANES`].
pub(super) struct Trace {
    layers: Vec<Saved>,
    /// What the heads read.
    features: Operand,
    /// The heads' results, `[outputs, R]` each.
    pub(super) outputs: Vec<Aligned<f32>>,
    /// Where the gradients of the loss by the heads' results go before the way back.
    pub(super) output_gradients: Vec<Aligned<f32>>,
    head_gradients: Vec<Operand>,
    /// The gradient on its way back: of a layer's result, and of its input.
    front: Aligned<f32>,
    back: Aligned<f32>,
    wide: Aligned<f32>,
}

impl Trace {
    pub(super) fn new(network: &Network, rows: usize) -> Self {
        let layers: Vec<Saved> = network.layers.iter().map(|layer| Saved::new(layer, rows)).collect();
        let results = layers.iter().map(|saved| saved.result.len()).max().unwrap_or(0);
        let wide = layers.iter().map(|saved| saved.wide.len()).max().unwrap_or(0);
        let widest = results.max(network.width * rows).max(network.inputs * rows).max(wide);
        let outputs = || network.heads.iter().map(|head| zeros(head.outputs * rows)).collect();
        Self {
            features: Operand::new(Format::F32, network.width, rows),
            outputs: outputs(),
            output_gradients: outputs(),
            head_gradients: network
                .heads
                .iter()
                .map(|head| Operand::new(Format::F32, head.outputs, rows))
                .collect(),
            front: zeros(widest),
            back: zeros(widest),
            wide: zeros(wide),
            layers,
        }
    }
}
