//! A fully connected layer for few rows: products whose sums run over the inputs in order, one by one, whatever the
//! number of rows, so that a row's result does not depend on the rows beside it. A matrix-product library chooses other
//! orders for other sizes, and is made for more rows than an actor has lanes.

use multiversion::multiversion;

use crate::Policy;

/// Outputs that are summed up together: a few vectors.
const WIDTH: usize = 32;
/// Rows that share a pass over the weights.
const ROWS: usize = 4;

/// A layer, laid out for [`Layer::apply`].
pub(crate) struct Layer {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    /// Blocks of [`WIDTH`] outputs, `[inputs, WIDTH]` each, the last one padded with zeros.
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Layer {
    /// The layer whose tensors are called `name.weight`, `[outputs, inputs]`, and `name.bias`.
    pub(crate) fn new(name: &str, inputs: usize, policy: &Policy) -> Self {
        let bias = policy.tensor(&format!("{name}.bias")).to_vec();
        let outputs = bias.len();
        let mut weight = vec![0.0; outputs.div_ceil(WIDTH) * WIDTH * inputs];
        let rows = policy.tensor(&format!("{name}.weight")).chunks_exact(inputs);
        for (output, row) in rows.enumerate() {
            let block = &mut weight[output / WIDTH * WIDTH * inputs..][..WIDTH * inputs];
            let column = block.iter_mut().skip(output % WIDTH).step_by(WIDTH);
            column.zip(row).for_each(|(to, value)| *to = *value);
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
fn multiply(from: &[f32], inputs: usize, weight: &[f32], outputs: usize, to: &mut [f32]) {
    for (block, weight) in weight.chunks_exact(WIDTH * inputs).enumerate() {
        let first = block * WIDTH;
        let tiles = from.chunks(ROWS * inputs).zip(to.chunks_mut(ROWS * outputs));
        for (from, to) in tiles {
            match from.len() / inputs {
                1 => tile::<1>(from, inputs, weight, outputs, first, to),
                2 => tile::<2>(from, inputs, weight, outputs, first, to),
                3 => tile::<3>(from, inputs, weight, outputs, first, to),
                _ => tile::<ROWS>(from, inputs, weight, outputs, first, to),
            }
        }
    }
}

/// The outputs from `first` on that one block of weights gives, for `R` rows.
#[inline(always)]
fn tile<const R: usize>(
    from: &[f32],
    inputs: usize,
    weight: &[f32],
    outputs: usize,
    first: usize,
    to: &mut [f32],
) {
    let rows: [&[f32]; R] = std::array::from_fn(|row| &from[row * inputs..][..inputs]);
    let mut sums = [[0.0f32; WIDTH]; R];
    for (input, weight) in weight.chunks_exact(WIDTH).take(inputs).enumerate() {
        for (sums, row) in sums.iter_mut().zip(&rows) {
            let x = row[input];
            (0..WIDTH).for_each(|output| sums[output] += x * weight[output]);
        }
    }
    for (sums, row) in sums.iter().zip(to.chunks_exact_mut(outputs)) {
        row[first..].iter_mut().zip(sums).for_each(|(to, sum)| *to += sum);
    }
}
