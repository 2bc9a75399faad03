//! A fully connected layer for few rows: products whose sums run over the inputs in order, one by one, whatever the
//! number of rows, so that a row's result does not depend on the rows beside it. A matrix-product library chooses other
//! orders for other sizes, and is made for more rows than an actor has lanes.

use multiversion::multiversion;
use multiversion::target::selected_target;

use crate::Policy;

/// Outputs that are summed up together: a few vectors.
const WIDTH: usize = 32;

/// Rows that share a pass over the weights.
const ROWS: usize = 16;
/// Inputs whose weights, 16 KiB, stay in the first cache from rows to rows.
const INPUTS: usize = 128;

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
        for (from, to) in from.chunks(ROWS * inputs).zip(to.chunks_mut(ROWS * outputs)) {
            let (rows, mut sums) = (to.len() / outputs, [[0.0; WIDTH]; ROWS]);
            for (index, weight) in weight.chunks(INPUTS).enumerate() {
                let mut row = 0;
                while row < rows {
                    let (from, sums) = (&from[row * inputs + index * INPUTS..], &mut sums[row..rows]);
                    // The first rows fetch the next inputs' weights, so that nobody waits for memory.
                    let fetches = row == 0;
                    row += match sums.len() {
                        8.. if MANY => tile::<8, WIDTH, FUSED>(from, inputs, weight, sums, fetches),
                        6.. if !MANY => tile::<6, { WIDTH / 2 }, FUSED>(from, inputs, weight, sums, fetches),
                        4.. if MANY => tile::<4, WIDTH, FUSED>(from, inputs, weight, sums, fetches),
                        4.. => tile::<4, { WIDTH / 2 }, FUSED>(from, inputs, weight, sums, fetches),
                        2.. => tile::<2, WIDTH, FUSED>(from, inputs, weight, sums, fetches),
                        _ => tile::<1, WIDTH, FUSED>(from, inputs, weight, sums, fetches),
                    };
                }
            }
            for (sums, row) in sums.iter().zip(to.chunks_exact_mut(outputs)) {
                row[first..].iter_mut().zip(sums).for_each(|(to, sum)| *to += sum);
            }
        }
    }
}

/// Adds what some inputs weigh to the first `R` rows' sums, `N` outputs at a time; `R`. `from` begins with the first of these
/// inputs; its rows are `inputs` apart.
#[inline(always)]
fn tile<const R: usize, const N: usize, const FUSED: bool>(
    from: &[f32],
    inputs: usize,
    weight: &[Weights],
    sums: &mut [[f32; WIDTH]],
    fetches: bool,
) -> usize {
    let from = &from[..(R - 1) * inputs + weight.len()];
    let sums: &mut [[f32; WIDTH]; R] = sums.first_chunk_mut().expect("as many rows");
    for part in 0..WIDTH / N {
        let mut now: [[f32; N]; R] =
            std::array::from_fn(|row| *sums[row][part * N..].first_chunk().expect("a part"));
        #[expect(
            clippy::needless_range_loop,
            reason = "by index, it is unrolled, and the sums stay in registers"
        )]
        for (input, Weights(weight)) in weight.iter().enumerate() {
            let weight: &[f32; N] = weight[part * N..].first_chunk().expect("a part");
            if fetches {
                fetch(weight.as_ptr().wrapping_add(INPUTS * WIDTH), N);
            }
            for row in 0..R {
                // SAFETY: `row` is under `R`, `input` under `weight.len()`, and `from` reaches to the last of both.
                let x = unsafe { *from.get_unchecked(row * inputs + input) };
                for output in 0..N {
                    let (weight, sum) = (weight[output], &mut now[row][output]);
                    *sum = if FUSED { x.mul_add(weight, *sum) } else { *sum + x * weight };
                }
            }
        }
        for (sums, now) in sums.iter_mut().zip(now) {
            sums[part * N..][..N].copy_from_slice(&now);
        }
    }
    R
}

/// Asks for some weights, wherever that is: they come into the first cache while other work goes on.
#[inline(always)]
fn fetch(weights: *const f32, count: usize) {
    /// Numbers in a line of the cache.
    const LINE: usize = 16;
    #[cfg(target_arch = "x86_64")]
    for line in (0..count).step_by(LINE) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a hint that reads nothing: any address will do.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(weights.wrapping_add(line).cast()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (weights, count, LINE);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_gets_the_same_numbers_from_every_tile() {
        /// One row after another, by itself; and `R` rows together, `N` outputs at a time.
        fn check<const R: usize, const N: usize>() {
            const INPUTS: usize = 7;
            let number = |seed: usize| (seed * 37 % 101) as f32 * 0.0173 - 0.8;
            let weights = |i: usize| Weights(std::array::from_fn(|output| number(i * WIDTH + output)));
            let weights: Vec<Weights> = (0..INPUTS).map(weights).collect();
            let from: Vec<f32> = (0..R * INPUTS).map(|i| number(i + 5)).collect();
            let (mut alone, mut together) = ([[0.5; WIDTH]; R], [[0.5; WIDTH]; R]);
            for (from, sums) in from.chunks_exact(INPUTS).zip(&mut alone) {
                let sums = std::slice::from_mut(sums);
                assert_eq!(tile::<1, WIDTH, false>(from, INPUTS, &weights, sums, false), 1);
            }
            assert_eq!(tile::<R, N, false>(&from, INPUTS, &weights, &mut together, true), R);
            assert_eq!(alone, together, "{R} rows, {N} outputs at a time");
            let exact: f64 = (0..INPUTS).map(|i| f64::from(from[i]) * f64::from(weights[i].0[0])).sum();
            assert!((f64::from(alone[0][0]) - 0.5 - exact).abs() < 1e-5, "{} for {exact}", alone[0][0]);
        }
        check::<8, WIDTH>();
        check::<6, { WIDTH / 2 }>();
        check::<4, WIDTH>();
        check::<4, { WIDTH / 2 }>();
        check::<2, WIDTH>();
    }
}
