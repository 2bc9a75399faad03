//! One pass over a network's parameters: the weights' gradients, AdamW, Polyak, and the layout of the new weights, in
//! pieces that threads share.
//!
//! A gradient is made for a few outputs at a time, over all workers' transitions, and used up while it is in the cache.

use std::ops::Range;

use super::kernels;
use super::layout::{CHUNK, chunks};
use super::memory::{Buffer, Memory};
use super::network::Network;
use super::optimizer::{self, AdamRows, AdamStep, PolyakRows};
use super::trace::Trace;
use super::weights::{Part, Weights};

/// The flat buffers of networks and of their optimizer.
pub(crate) struct Flat<'a> {
    pub(crate) values: &'a mut [f32],
    pub(crate) first: &'a mut [f32],
    pub(crate) second: &'a mut [f32],
}

/// What the workers left of a network's gradient.
pub(super) struct Gradients<'a> {
    /// Of each worker: the factors of the weights' gradients.
    pub(super) traces: Vec<&'a Trace>,
    /// Of each worker: those of biases and norms, where they lie among the parameters.
    pub(super) vectors: Vec<&'a [f32]>,
}

/// The first `length` numbers of `rest`, which keeps the others.
fn take<'a>(rest: &mut &'a mut [f32], length: usize) -> &'a mut [f32] {
    let (taken, kept) = std::mem::take(rest).split_at_mut(length);
    *rest = kept;
    taken
}

/// A run of parameters that is updated apart from the others: some outputs of a linear layer, with its bias after the last
/// of them, or a norm.
pub(super) struct Piece<'a> {
    /// Where it lies.
    range: Range<usize>,
    flat: Flat<'a>,
    gradients: &'a Gradients<'a>,
    target: Option<&'a mut [f32]>,
    linear: Option<LinearPiece<'a>>,
    /// The sum of the squares of its gradient, after a step.
    squares: f64,
}

/// What a piece of a linear layer has besides.
struct LinearPiece<'a> {
    /// The layer's place among the network's.
    index: usize,
    is_head: bool,
    weights: &'a mut Part,
    target: Option<&'a mut Part>,
}

/// Cuts a network into pieces.
pub(super) fn cut<'a>(
    network: &Network,
    flat: Flat<'a>,
    gradients: &'a Gradients<'a>,
    weights: &'a mut [Weights],
    target: Option<(&'a mut [f32], &'a mut Vec<Weights>)>,
    pieces: &mut Vec<Piece<'a>>,
) {
    let Flat { mut values, mut first, mut second } = flat;
    let mut weights = weights.iter_mut().enumerate();
    let (mut targets, target_weights) = target.unzip();
    let mut target_weights = target_weights.map(|weights| weights.iter_mut());
    let body_linears = network.body_linears();
    let mut add = |range: Range<usize>, linear| {
        let length = range.len();
        let flat = Flat {
            values: take(&mut values, length),
            first: take(&mut first, length),
            second: take(&mut second, length),
        };
        let target = targets.as_mut().map(|rest| take(rest, length));
        pieces.push(Piece { range, flat, gradients, target, linear, squares: 0.0 });
    };
    for (range, is_linear) in network.pieces() {
        if !is_linear {
            add(range, None);
            continue;
        }
        let (index, weights) = weights.next().expect("one for every linear layer");
        let is_head = index >= body_linears;
        let mut targets =
            target_weights.as_mut().and_then(Iterator::next).map(|weights| weights.parts.iter_mut());
        let mut parts = weights.parts.iter_mut().peekable();
        let mut start = range.start;
        while let Some(weights) = parts.next() {
            let end = start + weights.outputs.len() * weights.inputs;
            let end = if parts.peek().is_some() { end } else { range.end };
            let target = targets.as_mut().and_then(Iterator::next);
            add(start..end, Some(LinearPiece { index, is_head, weights, target }));
            start = end;
        }
    }
}

/// What a thread needs for a step.
pub(super) struct Room {
    /// The gradient of a few outputs.
    gradient: Buffer<f32>,
    /// That of a head, turned.
    turned: Buffer<f32>,
}

impl Room {
    pub(super) fn new(networks: [&Network; 2], memory: &mut Memory) -> Self {
        let longest = networks.into_iter().map(Network::longest_gradient).max().unwrap_or(0);
        let heads = networks.into_iter().flat_map(Network::head_weights).max().unwrap_or(0);
        Self { gradient: memory.zeros(longest), turned: memory.zeros(heads) }
    }
}

impl Piece<'_> {
    /// A step of AdamW, then of Polyak averaging for the target, and the layout of what came of it: all of it for a few
    /// outputs at a time, which stay in the cache meanwhile.
    pub(super) fn step(&mut self, room: &mut Room, step: AdamStep, tau: f32) {
        let Self { range, flat: Flat { values, first, second }, gradients, target, linear, squares } = self;
        let mut weights_end = 0;
        if let Some(LinearPiece { index, is_head, weights, target: target_weights }) = linear {
            let (inputs, outputs) = (weights.inputs, weights.outputs.clone());
            weights_end = inputs * outputs.len();
            let (turned, at_a_time) = match is_head {
                true => (weights_end, outputs.len()),
                false => (0, gradients.traces[0].outputs_at_a_time(*index)),
            };
            for made in chunks(outputs.clone(), at_a_time) {
                let place = (made.start - outputs.start) * inputs..(made.end - outputs.start) * inputs;
                let (start, values) = (made.start, &mut values[place.clone()]);
                let (first, second) = (&mut first[place.clone()], &mut second[place.clone()]);
                let gradient = &mut room.gradient[..place.len()];
                let turned = &mut room.turned[..turned];
                Trace::weight_gradient(&gradients.traces, *index, made.clone(), gradient, turned);
                *squares += f64::from(kernels::squares(gradient));
                for outputs in chunks(made, CHUNK) {
                    let rows = &mut AdamRows { step, inputs, start, values, first, second, gradient };
                    weights.pack(outputs.clone(), rows);
                    if let (Some(weights), Some(target)) = (&mut *target_weights, &mut *target) {
                        let target = &mut target[place.clone()];
                        weights.pack(outputs, &mut PolyakRows { tau, inputs, start, target, values });
                    }
                }
            }
        }
        // The bias, or the norm.
        let vector = weights_end..range.len();
        let sum = &mut room.gradient[..vector.len()];
        sum.fill(0.0);
        for worker in &gradients.vectors {
            kernels::add(sum, &worker[range.start + vector.start..range.end]);
        }
        *squares += f64::from(kernels::squares(sum));
        let values = &mut values[vector.clone()];
        optimizer::adam(step, values, sum, &mut first[vector.clone()], &mut second[vector.clone()]);
        if let Some(target) = target {
            optimizer::polyak(&mut target[vector], values, tau);
        }
    }

    /// The sum of the squares of its gradient, after a step.
    pub(super) fn squares(&self) -> f64 {
        self.squares
    }
}
