//! Matrix products of the update, by oneDNN's kernels in libtorch, and the layouts that they read.
//!
//! Activations lie feature by feature: row f of a matrix holds one number for every transition. A product reads its
//! operands in *words* of 32 bits: one float32, or two bfloat16 that are neighbours along the summed side.
//!
//! | layout of `X`, `[F, R]` | words | serves as |
//! | --- | --- | --- |
//! | plain | row f, R numbers | left factor, summed over R |
//! | pairs | rows f and f + 1 interleaved | right factor, summed over F |
//! | columns | the transposed plain words | right factor `Xᵀ`, summed over R |

use super::layout::{self, AsTheyAre, Layout, Rows};
use super::memory::{Buffer, Memory};

/// What the numbers of a product's operands are; its result is float32.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Format {
    /// float32.
    F32,
    /// bfloat16, rounded to nearest, ties to even.
    Bf16,
}

impl Format {
    /// Numbers in a word.
    pub(super) fn per_word(self) -> usize {
        match self {
            Self::F32 => 1,
            Self::Bf16 => 2,
        }
    }

    /// The longest sides, `[m, n, k]`, of the blocks that a product is made of: two operands and a result that fit into
    /// a core's second cache. Found by measuring 2×1024 on a Xeon with AMX.
    fn block(self) -> [usize; 3] {
        match self {
            Self::F32 => [256; 3],
            Self::Bf16 => [512; 3],
        }
    }

    /// `length` rounded up to whole words.
    pub(super) fn padded(self, length: usize) -> usize {
        length.next_multiple_of(self.per_word())
    }

    /// Whether this processor and this libtorch can multiply it, found by multiplying.
    pub(super) fn works(self) -> bool {
        let one = match self {
            Self::F32 => 1.0f32.to_bits(),
            Self::Bf16 => 0x3f80_3f80,
        };
        let (words, mut result) = (vec![one; 16 * 16], vec![0.0; 16 * 16]);
        let size = Size { m: 16, n: 16, k: 16 };
        let product = Product { format: self, size, lda: 16, ldb: 16, ldc: 16, accumulate: false };
        product.try_run(&words, &words, &mut result) && result.iter().all(|value| *value == 16.0)
    }
}

/// The sides of a product: `[m, k] · [k, n]`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Size {
    pub(super) m: usize,
    pub(super) n: usize,
    pub(super) k: usize,
}

/// `C = A·B`, or `C += A·B`. Leading dimensions are in numbers, not words.
#[derive(Clone, Copy, Debug)]
pub(super) struct Product {
    pub(super) format: Format,
    pub(super) size: Size,
    pub(super) lda: usize,
    pub(super) ldb: usize,
    pub(super) ldc: usize,
    pub(super) accumulate: bool,
}

unsafe extern "C" {
    fn getup_brgemm_bf16(
        m: i64,
        n: i64,
        k: i64,
        lda: i64,
        ldb: i64,
        ldc: i64,
        accumulate: bool,
        a: *const u32,
        b: *const u32,
        c: *mut f32,
    ) -> i32;
    fn getup_brgemm_f32(
        m: i64,
        n: i64,
        k: i64,
        lda: i64,
        ldb: i64,
        ldc: i64,
        accumulate: bool,
        a: *const u32,
        b: *const u32,
        c: *mut f32,
    ) -> i32;
}

impl Product {
    /// `a`: plain words, `[m, lda]`; `b`: pairs, `[k / per word, ldb]` words; `c`: `[m, ldc]`.
    ///
    /// # Panics
    /// Where a slice is too short, or libtorch has no kernel: [`Format::works`] was asked before.
    pub(super) fn run(&self, a: &[u32], b: &[u32], c: &mut [f32]) {
        assert!(self.try_run(a, b, c), "libtorch multiplied {:?} before and now refuses", self.format);
    }

    fn try_run(&self, a: &[u32], b: &[u32], c: &mut [f32]) -> bool {
        let Self { format, size: Size { m, n, k }, lda, ldb, ldc, accumulate } = *self;
        if m * n * k == 0 {
            return true;
        }
        let per_word = format.per_word();
        assert!(k % per_word == 0 && lda % per_word == 0 && k <= lda && n <= ldb && n <= ldc, "{self:?}");
        let [rows, columns, terms] = format.block();
        let blocks = |side: usize, longest: usize| {
            (0..side).step_by(longest).map(move |first| (first, longest.min(side - first)))
        };
        blocks(k, terms).all(|(k, terms)| {
            blocks(n, columns).all(|(n, columns)| {
                blocks(m, rows).all(|(m, rows)| {
                    let block = Self {
                        size: Size { m: rows, n: columns, k: terms },
                        accumulate: accumulate || k > 0,
                        ..*self
                    };
                    let a = &a[(m * lda + k) / per_word..];
                    block.run_block(a, &b[k / per_word * ldb + n..], &mut c[m * ldc + n..])
                })
            })
        })
    }

    fn run_block(&self, a: &[u32], b: &[u32], c: &mut [f32]) -> bool {
        let Self { format, size: Size { m, n, k }, lda, ldb, ldc, accumulate } = *self;
        let per_word = format.per_word();
        assert!(a.len() >= ((m - 1) * lda + k) / per_word, "left factor of {} words: {self:?}", a.len());
        assert!(b.len() >= (k / per_word - 1) * ldb + n, "right factor of {} words: {self:?}", b.len());
        assert!(c.len() >= (m - 1) * ldc + n, "result of {} numbers: {self:?}", c.len());
        let run = match format {
            Format::F32 => getup_brgemm_f32,
            Format::Bf16 => getup_brgemm_bf16,
        };
        let [m, n, k, lda, ldb, ldc] = [m, n, k, lda, ldb, ldc].map(|side| side as i64);
        // SAFETY: the kernel reads m × k and k × n numbers and writes m × n, at the strides given; the slices hold
        // them (asserted), and `c` is borrowed alone. Any bits are a number. No exception leaves the shim.
        unsafe { run(m, n, k, lda, ldb, ldc, accumulate, a.as_ptr(), b.as_ptr(), c.as_mut_ptr()) == 0 }
    }
}

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
    pub(super) fn chunks(&self) -> impl Iterator<Item = (usize, std::ops::Range<usize>)> + use<> {
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
