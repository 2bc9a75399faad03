//! What products read besides weights: activations and their gradients, in words ([`super::product`]).
//!
//! Activations lie feature by feature: row f of a matrix holds one number for every transition.
//!
//! | layout of `X`, `[F, R]` | words | serves as |
//! | --- | --- | --- |
//! | pairs | rows f and f + 1 interleaved | right factor, summed over F: of the next layer's product, or of the one before on the way back |
//! | plain | row f, R numbers | left factor, summed over R: of the weights' gradient |
//! | columns | the transposed plain words | right factor `Xᵀ`, summed over R: of the same |
//!
//! Pairs are read by the next product and never again: a few buffers serve all layers, and stay in the cache.

use std::ops::Range;

use super::layout::{self, CHUNK, LANES, Layout, Places, chunks};
use super::memory::{Buffer, Memory};
use super::product::{Format, Product, Size};
use super::rows::{Passed, Rows};
use super::transpose;

/// What a pass forward is for, and so what it keeps for the way back.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Purpose {
    /// Its results.
    Results,
    /// The gradient of its input, too.
    InputGradient,
    /// The gradient of its weights, too.
    Learning,
}

/// What a pass keeps at a linear layer `Y = W·X`, for the weights' gradient `dY·Xᵀ` and for the ReLU before.
pub(super) struct Factors {
    format: Format,
    inputs: usize,
    /// R.
    rows: usize,
    /// Of `dY`.
    plain: Buffer<u32>,
    /// Of `X`.
    columns: Buffer<u32>,
    /// Of `X`, where it is a ReLU's result: see [`Places`].
    signs: Buffer<u32>,
}

/// Where a pass lays out what the next product reads.
pub(super) struct Right {
    words: Buffer<u32>,
    /// The way to columns, [`CHUNK`] rows.
    plain: Buffer<u32>,
}

impl Right {
    /// Room for `features` of `rows` transitions.
    pub(super) fn new(features: usize, rows: usize, memory: &mut Memory) -> Self {
        Self { words: memory.zeros(features.next_multiple_of(2) * rows), plain: memory.zeros(CHUNK * rows) }
    }

    pub(super) fn words(&self) -> &[u32] {
        &self.words
    }
}

impl Factors {
    /// `after_relu`: whether `X` is a ReLU's result.
    pub(super) fn new(
        format: Format,
        [inputs, outputs, rows]: [usize; 3],
        after_relu: bool,
        memory: &mut Memory,
    ) -> Self {
        let words = |features: usize| format.padded(features) * rows / format.per_word();
        let signs = if after_relu { inputs.div_ceil(2) * rows / LANES } else { 0 };
        let columns = Self::column_stride(inputs) * rows / format.per_word();
        let [plain, columns, signs] = [words(outputs), columns, signs].map(|length| memory.zeros(length));
        Self { format, inputs, rows, plain, columns, signs }
    }

    /// Lays out some features of `X`, the first of them a multiple of [`CHUNK`]: in `right` for the next product, and here
    /// what the pass is for.
    pub(super) fn pack_input(
        &mut self,
        features: Range<usize>,
        rows: &mut impl Rows,
        purpose: Purpose,
        right: &mut Right,
    ) {
        for features in chunks(features, CHUNK) {
            let signs = if purpose == Purpose::Results { 0..0 } else { 0..self.signs.len() };
            let signs = &mut self.signs[signs];
            let first = if signs.is_empty() { 0 } else { features.start / 2 * self.rows / LANES };
            let learns = purpose == Purpose::Learning;
            let kept = if learns { &mut right.plain[..] } else { &mut [] };
            let (format, to) = (self.format, &mut right.words);
            pack(format, rows, self.rows, features.clone(), to, kept, &mut signs[first..]);
            if learns {
                let words = self.rows / self.format.per_word();
                let to = &mut self.columns[features.start..];
                transpose::transpose(kept, features.len(), words, to, Self::column_stride(self.inputs));
            }
        }
    }

    /// Lays out some features of `dY`, the first of them even: in `right` for the next product, and here where the pass
    /// `learns`.
    pub(super) fn pack_gradient(
        &mut self,
        features: Range<usize>,
        rows: &mut impl Rows,
        learns: bool,
        right: &mut Right,
    ) {
        let first = features.start * self.rows / self.format.per_word();
        let kept = if learns { &mut self.plain[first..] } else { &mut [] };
        pack(self.format, rows, self.rows, features, &mut right.words, kept, &mut []);
    }

    /// Words from one row of columns to the next: not a power of two, or all rows would compete for a few places in the cache.
    fn column_stride(inputs: usize) -> usize {
        inputs.next_multiple_of(LANES) + LANES
    }

    /// R.
    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    /// What the ReLU before let through, after a pass for more than its results.
    pub(super) fn passed(&self) -> Passed<'_> {
        Passed::Signs(&self.signs)
    }

    /// The weights' gradient, for some outputs: `to = dY·Xᵀ` or `to += dY·Xᵀ`, `[outputs, inputs]`.
    pub(super) fn multiply(&self, outputs: Range<usize>, accumulate: bool, to: &mut [f32]) {
        let Self { format, inputs, rows, .. } = *self;
        let size = Size { m: outputs.len(), n: inputs, k: rows };
        let ldb = Self::column_stride(inputs);
        let product = Product { format, size, lda: rows, ldb, ldc: inputs, accumulate };
        product.run(&self.plain[outputs.start * rows / format.per_word()..], &self.columns, to);
    }

    /// Outputs whose weights' gradients had better be made at a time.
    pub(super) fn outputs_at_a_time(&self) -> usize {
        self.format.at_a_time(self.rows, self.inputs)
    }
}

/// Lays out some features, the first of them even: in `right`, which holds all of them; from its beginning on in `kept`,
/// plain; and their signs; each where there is room.
fn pack(
    format: Format,
    rows: &mut impl Rows,
    length: usize,
    features: Range<usize>,
    right: &mut [u32],
    kept: &mut [u32],
    signs: &mut [u32],
) {
    let first = features.start;
    match format {
        Format::F32 => {
            let right = &mut right[first * length..features.end * length];
            layout::write(rows, features, length, bytemuck::cast_slice_mut(right), signs);
            if !kept.is_empty() {
                kept[..right.len()].copy_from_slice(right);
            }
        }
        Format::Bf16 => {
            let (plain, pairs) = (bytemuck::cast_slice_mut(kept), &mut right[first / 2 * length..]);
            let places = Places { plain, pairs, signs };
            layout::pack_bf16(rows, features, Layout { length, stride: length }, places);
        }
    }
}

/// What a pass keeps at a head, whose products are in float32, for the weights' gradient `dY·Xᵀ`: `X` lies there as every
/// head reads it, and columns are made of `dY`, which are fewer.
pub(super) struct HeadFactors {
    /// `dYᵀ`, `[R, outputs]`.
    columns: Buffer<u32>,
    outputs: usize,
}

impl HeadFactors {
    pub(super) fn new(outputs: usize, rows: usize, memory: &mut Memory) -> Self {
        Self { columns: memory.zeros(outputs * rows), outputs }
    }

    /// Lays out `dY`, `[outputs, R]`.
    pub(super) fn pack_gradient(&mut self, gradient: &[f32]) {
        let rows = gradient.len() / self.outputs;
        let words = bytemuck::cast_slice(gradient);
        transpose::transpose(words, self.outputs, rows, &mut self.columns, self.outputs);
    }

    /// The weights' gradient, turned, for some outputs: `to = X·dYᵀ` or `to += X·dYᵀ`, `[inputs, outputs]`.
    pub(super) fn multiply(&self, x: &[f32], outputs: Range<usize>, accumulate: bool, to: &mut [f32]) {
        let rows = self.columns.len() / self.outputs;
        let (m, n) = (x.len() / rows, outputs.len());
        let size = Size { m, n, k: rows };
        let product = Product { format: Format::F32, size, lda: rows, ldb: self.outputs, ldc: n, accumulate };
        product.run(bytemuck::cast_slice(x), &self.columns[outputs.start..], to);
    }
}
