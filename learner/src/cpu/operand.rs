//! What products read: activations, their gradients and weights, in words ([`super::product`]).
//!
//! Activations lie feature by feature: row f of a matrix holds one number for every transition.
//!
//! | layout of `X`, `[F, R]` | words | serves as |
//! | --- | --- | --- |
//! | plain | row f, R numbers | left factor, summed over R |
//! | pairs | rows f and f + 1 interleaved | right factor, summed over F |
//! | columns | the transposed plain words | right factor `Xᵀ`, summed over R |

use std::ops::Range;

use super::layout::{self, AsTheyAre, Layout, Rows};
use super::memory::{Buffer, Memory};
use super::product::{Format, Product, Size};

/// An activation or its gradient, `[F, R]`, laid out for products. R is even.
pub(super) struct Operand {
    format: Format,
    pub(super) features: usize,
    pub(super) rows: usize,
    plain: Buffer<u32>,
    /// Empty where a word is one number: pairs are plain then.
    pairs: Buffer<u32>,
    columns: Buffer<u32>,
}

impl Operand {
    pub(super) fn new(format: Format, features: usize, rows: usize, memory: &mut Memory) -> Self {
        let length = format.padded(features) * rows / format.per_word();
        let pairs = if format == Format::F32 { 0 } else { length };
        let [plain, pairs, columns] = [length, pairs, length].map(|length| memory.zeros(length));
        Self { format, features, rows, plain, pairs, columns }
    }

    /// Rounds `rows`, `[F, R]`, into the plain and the paired layout.
    pub(super) fn pack(&mut self, rows: &mut impl Rows) {
        let layout = Layout { length: self.rows, stride: self.rows };
        pack(self.format, rows, self.features, layout, &mut self.plain, &mut self.pairs);
    }

    /// The numbers in the plain layout.
    pub(super) fn numbers(&self) -> Numbers<'_> {
        match self.format {
            Format::F32 => Numbers::F32(bytemuck::cast_slice(&self.plain)),
            Format::Bf16 => Numbers::Bf16(bytemuck::cast_slice(&self.plain)),
        }
    }

    /// Brings the columns up to date with the plain layout: for the gradient of weights.
    pub(super) fn transpose(&mut self) {
        let (features, words) = (self.format.padded(self.features), self.rows / self.format.per_word());
        layout::transpose(&self.plain, features, words, &mut self.columns, features);
    }

    /// As the right factor of a product, summed over F.
    pub(super) fn right(&self) -> &[u32] {
        if self.pairs.is_empty() { &self.plain } else { &self.pairs }
    }

    /// Width of a row of columns, in words.
    fn column_stride(&self) -> usize {
        self.format.padded(self.features)
    }
}

/// Numbers as a product reads them.
#[derive(Clone, Copy)]
pub(super) enum Numbers<'a> {
    F32(&'a [f32]),
    /// The bits of bfloat16.
    Bf16(&'a [u16]),
}

/// Rounds `count` rows into the plain layout (rows of `layout.stride` numbers) and, where there is room, into pairs.
fn pack(
    format: Format,
    rows: &mut impl Rows,
    count: usize,
    layout: Layout,
    plain: &mut [u32],
    pairs: &mut [u32],
) {
    match format {
        Format::F32 => {
            let plain = &mut plain[..count * layout.length];
            layout::write(rows, layout.length, bytemuck::cast_slice_mut(plain));
        }
        Format::Bf16 => layout::pack_bf16(rows, count, layout, bytemuck::cast_slice_mut(plain), pairs),
    }
}

/// The weights of a layer, `[outputs, inputs]`, laid out for products.
pub(super) struct Weights {
    format: Format,
    inputs: usize,
    outputs: usize,
    /// `[outputs, inputs]`: the left factor of the layer.
    plain: Buffer<u32>,
    /// Transposed, `[inputs, outputs]`: the left factor of its gradient. Empty where no gradient is asked for.
    transposed: Buffer<u32>,
    /// Scratch for the way there, where a word is not one number: [`Weights::CHUNK`] outputs.
    pairs: Buffer<u32>,
}

impl Weights {
    pub(super) fn new(
        format: Format,
        inputs: usize,
        outputs: usize,
        differentiated: bool,
        memory: &mut Memory,
    ) -> Self {
        let per_word = format.per_word();
        let turned = if differentiated { inputs * format.padded(outputs) / per_word } else { 0 };
        Self {
            format,
            inputs,
            outputs,
            plain: memory.zeros(outputs.next_multiple_of(2) * format.padded(inputs) / per_word),
            transposed: memory.zeros(turned),
            pairs: memory.zeros(match format {
                Format::Bf16 if differentiated => Self::CHUNK / 2 * inputs,
                _ => 0,
            }),
        }
    }

    /// Outputs that are packed at a time: whole blocks of the transposition.
    pub(super) const CHUNK: usize = 32;

    /// Takes new values of the outputs from `first` on, a multiple of [`Weights::CHUNK`], and at most so many; row-major.
    pub(super) fn pack(&mut self, first: usize, values: &[f32]) {
        let Self { format, inputs, outputs, .. } = *self;
        let (per_word, count) = (format.per_word(), values.len() / inputs);
        let layout = Layout { length: inputs, stride: format.padded(inputs) };
        let plain = &mut self.plain[first * layout.stride / per_word..];
        pack(format, &mut AsTheyAre { values, length: inputs }, count, layout, plain, &mut self.pairs);
        if !self.transposed.is_empty() {
            let pairs = if self.pairs.is_empty() { &*plain } else { &self.pairs };
            let (words, stride) = (format.padded(count) / per_word, format.padded(outputs) / per_word);
            layout::transpose(pairs, words, inputs, &mut self.transposed[first / per_word..], stride);
        }
    }

    /// Runs of outputs that [`Weights::pack`] takes: their first, and where their values lie.
    pub(super) fn chunks(&self) -> impl Iterator<Item = (usize, Range<usize>)> + use<> {
        let (inputs, outputs) = (self.inputs, self.outputs);
        (0..outputs).step_by(Self::CHUNK).map(move |first| {
            let end = outputs.min(first + Self::CHUNK);
            (first, first * inputs..end * inputs)
        })
    }

    /// `to = W·x` or `to += W·x`, `[outputs, R]`; `x` is a right factor, `[inputs, R]`.
    pub(super) fn apply(&self, x: &[u32], rows: usize, accumulate: bool, to: &mut [f32]) {
        let k = self.format.padded(self.inputs);
        let size = Size { m: self.outputs, n: rows, k };
        let product = Product { format: self.format, size, lda: k, ldb: rows, ldc: rows, accumulate };
        product.run(&self.plain, x, to);
    }

    /// `to = Wᵀ·gradient`, for the inputs from `first` on: `[inputs − first, R]`.
    pub(super) fn apply_transposed(
        &self,
        gradient: &Operand,
        first: usize,
        accumulate: bool,
        to: &mut [f32],
    ) {
        let k = self.format.padded(self.outputs);
        let (m, n) = (self.inputs - first, gradient.rows);
        let product =
            Product { format: self.format, size: Size { m, n, k }, lda: k, ldb: n, ldc: n, accumulate };
        product.run(&self.transposed[first * k / self.format.per_word()..], gradient.right(), to);
    }
}

/// The gradient of the weights between `x` (whose columns are up to date) and a result of the given gradient:
/// `to = gradient·xᵀ`, `[outputs, inputs]`.
pub(super) fn weight_gradient(gradient: &Operand, x: &Operand, to: &mut [f32]) {
    let size = Size { m: gradient.features, n: x.features, k: gradient.rows };
    let product = Product {
        format: x.format,
        size,
        lda: gradient.rows,
        ldb: x.column_stride(),
        ldc: x.features,
        accumulate: false,
    };
    product.run(&gradient.plain, &x.columns, to);
}

/// The same the other way around, `to = x·gradientᵀ`, `[inputs, outputs]`, in float32, for few outputs: the columns of
/// their gradient are cheaper than those of `x`, `[inputs, R]`.
pub(super) fn weight_gradient_transposed(gradient: &Operand, x: &[f32], to: &mut [f32]) {
    let (outputs, rows) = (gradient.features, gradient.rows);
    let size = Size { m: x.len() / rows, n: outputs, k: rows };
    let product =
        Product { format: Format::F32, size, lda: rows, ldb: outputs, ldc: outputs, accumulate: false };
    product.run(bytemuck::cast_slice(x), &gradient.columns, to);
}
