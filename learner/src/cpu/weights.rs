//! A layer's weights as products read them, in words ([`super::product`]).

use std::ops::Range;

use super::layout::{self, CHUNK, Layout, Places, chunks};
use super::memory::{Buffer, Memory};
use super::product::{Format, Product, Size};
use super::rows::Rows;
use super::transpose;

/// The weights of a layer, `[outputs, inputs]`, laid out for products.
pub(super) struct Weights {
    format: Format,
    inputs: usize,
    outputs: usize,
    /// Some outputs each, in order.
    pub(super) parts: Vec<Part>,
}

/// Some outputs' weights: what one thread updates.
pub(super) struct Part {
    format: Format,
    pub(super) inputs: usize,
    pub(super) outputs: Range<usize>,
    /// `[outputs, inputs]`: the left factor of the layer.
    plain: Buffer<u32>,
    /// Transposed, `[inputs, outputs]`: the left factor of its gradient. Empty where no gradient is asked for.
    transposed: Buffer<u32>,
    /// Scratch for the way there, where a word is not one number: [`CHUNK`] outputs.
    pairs: Buffer<u32>,
}

impl Part {
    /// The most outputs of a part: what a product's sum is cut into on the way back anyway.
    const OUTPUTS: usize = 512;

    fn new(
        format: Format,
        inputs: usize,
        outputs: Range<usize>,
        differentiated: bool,
        memory: &mut Memory,
    ) -> Self {
        let (per_word, count) = (format.per_word(), outputs.len());
        let turned = if differentiated { inputs * format.padded(count) / per_word } else { 0 };
        Self {
            format,
            inputs,
            outputs,
            plain: memory.zeros(count.next_multiple_of(2) * format.padded(inputs) / per_word),
            transposed: memory.zeros(turned),
            pairs: memory.zeros(match format {
                Format::Bf16 if differentiated => CHUNK / 2 * inputs,
                _ => 0,
            }),
        }
    }

    /// Takes new values, rows of `[outputs, inputs]`, of at most [`CHUNK`] outputs, the first of them a multiple of it.
    pub(super) fn pack(&mut self, outputs: Range<usize>, rows: &mut impl Rows) {
        let Self { format, inputs, .. } = *self;
        let (per_word, first, count) = (format.per_word(), outputs.start - self.outputs.start, outputs.len());
        let layout = Layout { length: inputs, stride: format.padded(inputs) };
        let plain = &mut self.plain[first * layout.stride / per_word..];
        match format {
            Format::F32 => layout::write(rows, outputs, inputs, bytemuck::cast_slice_mut(plain), &mut []),
            Format::Bf16 => {
                let plain = bytemuck::cast_slice_mut(&mut *plain);
                let places = Places { plain, pairs: &mut self.pairs, signs: &mut [] };
                layout::pack_bf16(rows, outputs, layout, places);
            }
        }
        if !self.transposed.is_empty() {
            let pairs = if self.pairs.is_empty() { &*plain } else { &self.pairs };
            let stride = format.padded(self.outputs.len()) / per_word;
            let to = &mut self.transposed[first / per_word..];
            transpose::transpose(pairs, format.padded(count) / per_word, inputs, to, stride);
        }
    }
}

impl Weights {
    /// Zeros. Whether they will be `differentiated`: whether their inputs' gradient will be asked for.
    pub(super) fn new(
        format: Format,
        inputs: usize,
        outputs: usize,
        differentiated: bool,
        memory: &mut Memory,
    ) -> Self {
        let part = |outputs| Part::new(format, inputs, outputs, differentiated, memory);
        Self { format, inputs, outputs, parts: chunks(0..outputs, Part::OUTPUTS).map(part).collect() }
    }

    /// Its outputs, as many as a product of `rows` transitions had better make before what it made goes on.
    pub(super) fn output_chunks(&self, rows: usize) -> impl Iterator<Item = Range<usize>> + use<> {
        chunks(0..self.outputs, self.format.at_a_time(self.inputs, rows))
    }

    /// The same of its inputs, for their gradient.
    pub(super) fn input_chunks(&self, rows: usize) -> impl Iterator<Item = Range<usize>> + use<> {
        chunks(0..self.inputs, self.format.at_a_time(self.outputs, rows))
    }

    /// `to = W·x` or `to += W·x` for some outputs, `[outputs, R]`; `x` is a right factor, `[inputs, R]`.
    pub(super) fn apply(
        &self,
        outputs: Range<usize>,
        x: &[u32],
        rows: usize,
        accumulate: bool,
        to: &mut [f32],
    ) {
        let k = self.format.padded(self.inputs);
        for part in &self.parts {
            let (start, end) = (outputs.start.max(part.outputs.start), outputs.end.min(part.outputs.end));
            if start < end {
                let size = Size { m: end - start, n: rows, k };
                let product = Product { format: self.format, size, lda: k, ldb: rows, ldc: rows, accumulate };
                let plain = &part.plain[(start - part.outputs.start) * k / self.format.per_word()..];
                product.run(plain, x, &mut to[(start - outputs.start) * rows..]);
            }
        }
    }

    /// `to = Wᵀ·gradient` or `to += Wᵀ·gradient` for some inputs, `[inputs, R]`; `gradient` is a right factor, `[outputs, R]`.
    pub(super) fn apply_transposed(
        &self,
        inputs: Range<usize>,
        gradient: &[u32],
        rows: usize,
        accumulate: bool,
        to: &mut [f32],
    ) {
        let per_word = self.format.per_word();
        for part in &self.parts {
            let (first, k) = (part.outputs.start, self.format.padded(part.outputs.len()));
            let (size, accumulate) = (Size { m: inputs.len(), n: rows, k }, accumulate || first > 0);
            let product = Product { format: self.format, size, lda: k, ldb: rows, ldc: rows, accumulate };
            let turned = &part.transposed[inputs.start * k / per_word..];
            product.run(turned, &gradient[first * rows / per_word..], to);
        }
    }
}
