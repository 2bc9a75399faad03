//! One pass over a network's parameters: the sum of the workers' gradients, AdamW, Polyak, and the layout of the new
//! weights, in pieces that threads share.

use std::ops::Range;

use super::kernels::{self, AdamStep};
use super::network::Network;
use super::operand::Weights;

/// The flat buffers of networks and of their optimizer.
pub(crate) struct Flat<'a> {
    pub(crate) values: &'a mut [f32],
    pub(crate) first: &'a mut [f32],
    pub(crate) second: &'a mut [f32],
}

/// The first `length` numbers of `rest`, which keeps the others.
pub(super) fn take<'a>(rest: &mut &'a mut [f32], length: usize) -> &'a mut [f32] {
    let (taken, kept) = std::mem::take(rest).split_at_mut(length);
    *rest = kept;
    taken
}

/// A run of parameters that is updated apart from the others: a linear layer or a norm.
pub(super) struct Piece<'a> {
    flat: Flat<'a>,
    /// Of every worker.
    gradients: Vec<&'a mut [f32]>,
    target: Option<&'a mut [f32]>,
    /// The number of weights (the rest is bias), their layout, and that of the target's.
    weights: Option<(usize, &'a mut Weights, Option<&'a mut Weights>)>,
}

/// Cuts a network into pieces.
pub(super) fn cut<'a>(
    network: &Network,
    flat: Flat<'a>,
    mut gradients: Vec<&'a mut [f32]>,
    weights: &'a mut [Weights],
    target: Option<(&'a mut [f32], &'a mut Vec<Weights>)>,
    pieces: &mut Vec<Piece<'a>>,
) {
    let Flat { mut values, mut first, mut second } = flat;
    let mut weights = weights.iter_mut();
    let (mut targets, target_weights) = target.unzip();
    let mut target_weights = target_weights.map(|weights| weights.iter_mut());
    for (range, linear) in network.pieces() {
        let length = range.len();
        pieces.push(Piece {
            flat: Flat {
                values: take(&mut values, length),
                first: take(&mut first, length),
                second: take(&mut second, length),
            },
            gradients: gradients.iter_mut().map(|rest| take(rest, length)).collect(),
            target: targets.as_mut().map(|rest| take(rest, length)),
            weights: linear.map(|count| {
                let own = weights.next().expect("one for every linear layer");
                (count, own, target_weights.as_mut().and_then(Iterator::next))
            }),
        });
    }
}

impl Piece<'_> {
    /// A step of AdamW, then of Polyak averaging for the target, and the layout of what came of it: all of it for a few
    /// outputs at a time, which stay in the cache meanwhile.
    pub(super) fn step(&mut self, step: AdamStep, tau: f32) {
        let length = self.flat.values.len();
        let chunks: Vec<_> = match &self.weights {
            Some((_, weights, _)) => weights.chunks().collect(),
            None => vec![],
        };
        for (first, range) in chunks {
            self.step_range(range.clone(), step, tau);
            let Some((_, weights, target_weights)) = &mut self.weights else { continue };
            weights.pack(first, &self.flat.values[range.clone()]);
            if let (Some(weights), Some(target)) = (target_weights, &self.target) {
                weights.pack(first, &target[range]);
            }
        }
        let weights = self.weights.as_ref().map_or(0, |(count, ..)| *count);
        self.step_range(weights..length, step, tau);
    }

    fn step_range(&mut self, range: Range<usize>, step: AdamStep, tau: f32) {
        let (sum, others) = self.gradients.split_first_mut().expect("a worker at least");
        let sum = &mut sum[range.clone()];
        others.iter().for_each(|gradient| kernels::add(sum, &gradient[range.clone()]));
        let Flat { values, first, second } = &mut self.flat;
        let values = &mut values[range.clone()];
        kernels::adam(step, values, sum, &mut first[range.clone()], &mut second[range.clone()]);
        if let Some(target) = &mut self.target {
            kernels::polyak(&mut target[range], values, tau);
        }
    }
}
