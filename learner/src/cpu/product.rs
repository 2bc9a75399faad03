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

use aligned_vec::{AVec, ConstAlign};

use super::layout;

/// Bytes of a cache line and of the widest vector.
const ALIGNMENT: usize = 64;

/// Numbers in memory aligned for the widest vectors.
pub(super) type Aligned<T> = AVec<T, ConstAlign<ALIGNMENT>>;

/// `length` zeros.
pub(super) fn zeros<T: Default + Clone>(length: usize) -> Aligned<T> {
    let mut values = AVec::new(ALIGNMENT);
    values.resize(length, T::default());
    values
}

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
    pub(super) format: Format,
    pub(super) features: usize,
    pub(super) rows: usize,
    pub(super) plain: Aligned<u32>,
    pub(super) pairs: Aligned<u32>,
    pub(super) columns: Aligned<u32>,
}

impl Operand {
    pub(super) fn new(format: Format, features: usize, rows: usize) -> Self {
        let length = format.padded(features) * rows / format.per_word();
        let [plain, pairs, columns] = std::array::from_fn(|_| zeros(length));
        Self { format, features, rows, plain, pairs, columns }
    }

    /// Rounds `values`, `[F, R]`, into the plain and the paired layout.
    pub(super) fn pack(&mut self, values: &[f32]) {
        let layout = layout::Layout { length: self.rows, stride: self.rows };
        pack(self.format, values, layout, &mut self.plain, &mut self.pairs);
    }

    /// Brings the columns up to date with the plain layout: for the gradient of the weights that read this.
    pub(super) fn transpose(&mut self) {
        let (features, words) = (self.format.padded(self.features), self.rows / self.format.per_word());
        layout::transpose(&self.plain, features, words, &mut self.columns);
    }

    /// Width of a row of columns, in words.
    pub(super) fn column_stride(&self) -> usize {
        self.format.padded(self.features)
    }
}

/// Rounds a matrix into the plain layout (rows of `layout.stride` numbers) and, where there is room, into pairs.
fn pack(format: Format, values: &[f32], layout: layout::Layout, plain: &mut [u32], pairs: &mut [u32]) {
    match format {
        Format::F32 => {
            let words = bytemuck::cast_slice(values);
            plain[..words.len()].copy_from_slice(words);
            if !pairs.is_empty() {
                pairs[..words.len()].copy_from_slice(words);
            }
        }
        Format::Bf16 => layout::pack_bf16(values, layout, bytemuck::cast_slice_mut(plain), pairs),
    }
}

/// The weights of a layer, `[outputs, inputs]`, laid out for products.
pub(super) struct Weights {
    format: Format,
    inputs: usize,
    outputs: usize,
    /// `[outputs, inputs]`: the left factor of the layer.
    plain: Aligned<u32>,
    /// Transposed, `[inputs, outputs]`: the left factor of its gradient. Empty where no gradient is asked for.
    transposed: Aligned<u32>,
    /// Scratch for the way there.
    pairs: Aligned<u32>,
}

impl Weights {
    pub(super) fn new(format: Format, inputs: usize, outputs: usize, differentiated: bool) -> Self {
        let per_word = format.per_word();
        let turned = if differentiated { inputs * format.padded(outputs) / per_word } else { 0 };
        Self {
            format,
            inputs,
            outputs,
            plain: zeros(outputs.next_multiple_of(2) * format.padded(inputs) / per_word),
            transposed: zeros(turned),
            pairs: zeros(if differentiated { format.padded(outputs) / per_word * inputs } else { 0 }),
        }
    }

    /// Takes new values, row-major.
    pub(super) fn pack(&mut self, values: &[f32]) {
        let layout = layout::Layout { length: self.inputs, stride: self.format.padded(self.inputs) };
        pack(self.format, values, layout, &mut self.plain, &mut self.pairs);
        if !self.transposed.is_empty() {
            let words = self.format.padded(self.outputs) / self.format.per_word();
            layout::transpose(&self.pairs, words, self.inputs, &mut self.transposed);
        }
    }

    /// `to = W·x` or `to += W·x`, `[outputs, R]`.
    pub(super) fn apply(&self, x: &Operand, accumulate: bool, to: &mut [f32]) {
        let k = self.format.padded(self.inputs);
        let size = Size { m: self.outputs, n: x.rows, k };
        let product = Product { format: self.format, size, lda: k, ldb: x.rows, ldc: x.rows, accumulate };
        product.run(&self.plain, &x.pairs, to);
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
        product.run(&self.transposed[first * k / self.format.per_word()..], &gradient.pairs, to);
    }
}

/// The gradient of the weights between `x` and a result of the given gradient: `to = gradient·xᵀ`,
/// `[outputs, inputs]`.
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
