//! A fully connected layer for few rows: products whose sums run over the inputs in order, one by one, whatever the
//! number of rows, so that a row's result does not depend on the rows beside it. A matrix-product library chooses other
//! orders for other sizes, and is made for more rows than an actor has lanes.

use multiversion::multiversion;
use multiversion::target::selected_target;

use crate::Policy;

/// Outputs that are summed up together: a few vectors.
const WIDTH: usize = 32;

/// What one input weighs in [`WIDTH`] outputs. A vector of it lies in one line of the cache.
#[derive(Clone, Copy)]
#[repr(align(64))]
struct Weights([f32; WIDTH]);

/// A layer, laid out for [`Layer::apply`].
pub(crate) struct Layer {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    /// Blocks of [`WIDTH`] outputs, `[inputs, WIDTH]` each, the last one padded with zeros.
    weight: Vec<Weights>,
    bias: Vec<f32>,
}

impl Layer {
    /// The layer whose tensors are called `name.weight`, `[outputs, inputs]`, and `name.bias`.
    pub(crate) fn new(name: &str, inputs: usize, policy: &Policy) -> Self {
        let bias = policy.tensor(&format!("{name}.bias")).to_vec();
        let outputs = bias.len();
        let mut weight = vec![Weights([0.0; WIDTH]); outputs.div_ceil(WIDTH) * inputs];
        let rows = policy.tensor(&format!("{name}.weight")).chunks_exact(inputs);
        for (output, row) in rows.enumerate() {
            let block = weight[output / WIDTH * inputs..].iter_mut();
            block.zip(row).for_each(|(weights, value)| weights.0[output % WIDTH] = *value);
        }
        Self { inputs, outputs, weight, bias }
    }

    /// `to = from · Wᵀ + b`, or `to += from · Wᵀ + b`: `from` begins with `[rows, inputs]`, `to` with `[rows, outputs]`.
    pub(crate) fn apply(&self, rows: usize, from: &[f32], to: &mut [f32], add: bool) {
        let Self { inputs, outputs, weight, bias } = self;
        let to = &mut to[..rows * outputs];
        for row in to.chunks_exact_mut(*outputs) {
            match add {
                true => row.iter_mut().zip(bias).for_each(|(x, bias)| *x += bias),
                false => row.copy_from_slice(bias),
            }
        }
        multiply(&from[..rows * inputs], *inputs, weight, *outputs, to);
    }
}

/// `to += from · Wᵀ`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn multiply(from: &[f32], inputs: usize, weight: &[Weights], outputs: usize, to: &mut [f32]) {
    // Elsewhere a fused product and sum would be a call of a function.
    const FUSED: bool = selected_target!().supports_feature_str("fma") || cfg!(target_arch = "aarch64");
    // Sums that the registers hold: of 32 vectors of 16, or of 16 vectors of 8.
    const MANY: bool = selected_target!().supports_feature_str("avx512f");
    for (block, weight) in weight.chunks_exact(inputs).enumerate() {
        let first = block * WIDTH;
        let (mut from, mut to) = (from, &mut *to);
        while !from.is_empty() {
            let rows = match from.len() / inputs {
                8.. if MANY => tile::<8, WIDTH, FUSED>(from, weight, outputs, first, to),
                6.. if !MANY => tile::<6, { WIDTH / 2 }, FUSED>(from, weight, outputs, first, to),
                4.. if MANY => tile::<4, WIDTH, FUSED>(from, weight, outputs, first, to),
                4.. => tile::<4, { WIDTH / 2 }, FUSED>(from, weight, outputs, first, to),
                2.. => tile::<2, WIDTH, FUSED>(from, weight, outputs, first, to),
                _ => tile::<1, WIDTH, FUSED>(from, weight, outputs, first, to),
            };
            (from, to) = (&from[rows * inputs..], &mut to[rows * outputs..]);
        }
    }
}

/// The outputs from `first` on that one block of weights gives, `N` at a time, for the first `R` rows; `R`.
#[inline(always)]
fn tile<const R: usize, const N: usize, const FUSED: bool>(
    from: &[f32],
    weight: &[Weights],
    outputs: usize,
    first: usize,
    to: &mut [f32],
) -> usize {
    let inputs = weight.len();
    let from = &from[..R * inputs];
    for part in 0..WIDTH / N {
        let part = part * N;
        if first + part >= outputs {
            break;
        }
        let mut sums = [[0.0f32; N]; R];
        #[expect(
            clippy::needless_range_loop,
            reason = "by index, it is unrolled, and the sums stay in registers"
        )]
        for (input, Weights(weight)) in weight.iter().enumerate() {
            let weight: &[f32; N] = weight[part..].first_chunk().expect("a part of the width");
            for row in 0..R {
                // SAFETY: `row` is under `R`, `input` under `inputs`, and `from` has `R * inputs` numbers.
                let x = unsafe { *from.get_unchecked(row * inputs + input) };
                for output in 0..N {
                    let (weight, sum) = (weight[output], &mut sums[row][output]);
                    *sum = if FUSED { x.mul_add(weight, *sum) } else { *sum + x * weight };
                }
            }
        }
        for (sums, row) in sums.iter().zip(to.chunks_exact_mut(outputs)) {
            for (to, sum) in row[first + part..].iter_mut().zip(sums) {
                *to += sum;
            }
        }
    }
    R
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_gets_the_same_numbers_from_every_tile() {
        /// One row after another, by itself; and all of them by tiles of `R` rows and `N` outputs.
        fn check<const R: usize, const N: usize>(outputs: usize) {
            const INPUTS: usize = 7;
            let number = |seed: usize| (seed * 37 % 101) as f32 * 0.0173 - 0.8;
            let weight: Vec<Weights> = (0..INPUTS)
                .map(|i| Weights(std::array::from_fn(|output| number(i * WIDTH + output))))
                .collect();
            let from: Vec<f32> = (0..R * INPUTS).map(|i| number(i + 5)).collect();
            let (mut alone, mut together) = (vec![0.5; R * outputs], vec![0.5; R * outputs]);
            for (from, to) in from.chunks_exact(INPUTS).zip(alone.chunks_exact_mut(outputs)) {
                assert_eq!(tile::<1, WIDTH, false>(from, &weight, outputs, 0, to), 1);
            }
            assert_eq!(tile::<R, N, false>(&from, &weight, outputs, 0, &mut together), R);
            assert_eq!(alone, together, "{R} rows, {N} of {outputs} outputs");
            let exact: f64 = (0..INPUTS).map(|i| f64::from(from[i]) * f64::from(weight[i].0[0])).sum();
            assert!((f64::from(alone[0]) - 0.5 - exact).abs() < 1e-5, "{} for {exact}", alone[0]);
        }
        for outputs in [1, 15, 16, 21, WIDTH] {
            check::<8, WIDTH>(outputs);
            check::<6, { WIDTH / 2 }>(outputs);
            check::<4, { WIDTH / 2 }>(outputs);
            check::<2, WIDTH>(outputs);
        }
    }
}
