//! Matrix products of the update, by oneDNN's kernels in libtorch.
//!
//! A product reads its operands in *words* of 32 bits: one float32, or two bfloat16 that are neighbours along the summed
//! side. [`super::factors`] and [`super::weights`] lay them out.

use std::sync::LazyLock;
use std::time::{Duration, Instant};

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

    /// Rows that a product with a right factor `[k, n]` had better make at a time for what reads them next: few, which stay
    /// in the fastest cache, where the right factor stays in the second one from rows to rows.
    pub(super) fn at_a_time(self, k: usize, n: usize) -> usize {
        if k * n / self.per_word() <= (512 << 10) / size_of::<u32>() { 64 } else { Self::MOST_AT_A_TIME }
    }

    /// The most that [`Format::at_a_time`] gives.
    pub(super) const MOST_AT_A_TIME: usize = 256;

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

/// Whether oneDNN's float32 kernels are those for AVX-512.
fn has_avx512() -> bool {
    #[cfg(target_arch = "x86_64")]
    let has = is_x86_feature_detected!("avx512f");
    #[cfg(not(target_arch = "x86_64"))]
    let has = false;
    has
}

/// A block of a right factor with its rows beside each other, in the first cache. oneDNN's kernels for AVX2 take twice as long
/// for a factor whose rows are 1024 numbers apart.
#[repr(align(64))]
pub(super) struct Panel([u32; Self::TERMS * Self::COLUMNS]);

impl Panel {
    const TERMS: usize = 256;
    const COLUMNS: usize = 32;

    /// Zeros.
    pub(super) fn new() -> Self {
        Self([0; Self::TERMS * Self::COLUMNS])
    }

    /// One where it is worth the copies, found by measuring on a Zen 3.
    fn for_product(format: Format, Size { m, n, k }: Size) -> Option<Self> {
        let worth = format == Format::F32 && m >= 16 && n >= 256 && k >= 256 && !has_avx512();
        worth.then(Self::new)
    }

    /// Takes `[terms, columns]` words of a factor whose rows are `stride` apart; them, and their own stride.
    fn copy(&mut self, from: &[u32], stride: usize, [terms, columns]: [usize; 2]) -> (&[u32], usize) {
        for (to, from) in self.0.chunks_exact_mut(columns).zip(from.chunks(stride)).take(terms) {
            to.copy_from_slice(&from[..columns]);
        }
        (&self.0, columns)
    }
}

/// Whether this processor multiplies bfloat16 faster than float32, by a third at least, found by multiplying, once. With AMX
/// it does so many times, AMD's with AVX512-BF16 twice; Intel's AVX512-BF16 alone takes twice as long as its float32. So no
/// processor that is known comes near the margin, where chance would decide in which precision a run goes on.
pub(crate) fn bf16_is_faster() -> bool {
    /// The shortest of so many turns: what else runs on the machine makes a turn longer, never shorter.
    const TURNS: usize = 8;
    const SIDE: usize = 256;
    static FASTER: LazyLock<bool> = LazyLock::new(|| {
        let formats = [Format::F32, Format::Bf16];
        if !formats.iter().all(|format| format.works()) {
            return false;
        }
        let (words, mut result) = (vec![0u32; SIDE * SIDE], vec![0.0; SIDE * SIDE]);
        let mut shortest = [Duration::MAX; 2];
        for _ in 0..TURNS {
            for (format, shortest) in formats.into_iter().zip(&mut shortest) {
                let size = Size { m: SIDE, n: SIDE, k: SIDE };
                let product = Product { format, size, lda: SIDE, ldb: SIDE, ldc: SIDE, accumulate: false };
                let start = Instant::now();
                product.run(&words, &words, &mut result);
                *shortest = start.elapsed().min(*shortest);
            }
        }
        let [fp32, bf16] = shortest;
        tracing::debug!(?fp32, ?bf16, "a product of {SIDE} × {SIDE} × {SIDE}");
        bf16 < fp32 * 3 / 4
    });
    *FASTER
}

/// A side of a product, cut every `longest` numbers: where each part begins, and its length.
fn cut(side: usize, longest: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..side).step_by(longest).map(move |first| (first, longest.min(side - first)))
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
        self.run_by_blocks(a, b, c, Panel::for_product(self.format, self.size))
    }

    /// [`Product::run`], by a panel where there is one, in float32; whether libtorch has a kernel.
    pub(super) fn run_by_blocks(
        &self,
        a: &[u32],
        b: &[u32],
        c: &mut [f32],
        mut panel: Option<Panel>,
    ) -> bool {
        let Self { format, size: Size { m, n, k }, lda, ldb, ldc, accumulate } = *self;
        if m * n * k == 0 {
            return true;
        }
        let per_word = format.per_word();
        assert!(k % per_word == 0 && lda % per_word == 0 && k <= lda && n <= ldb && n <= ldc, "{self:?}");
        assert!(panel.is_none() || format == Format::F32, "a panel holds float32: {self:?}");
        let [rows, columns, terms] = match &panel {
            Some(_) => [format.block()[0], Panel::COLUMNS, Panel::TERMS],
            None => format.block(),
        };
        cut(k, terms).all(|(k, terms)| {
            cut(n, columns).all(|(n, columns)| {
                let b = &b[k / per_word * ldb + n..];
                let (b, ldb) = match &mut panel {
                    Some(panel) => panel.copy(b, ldb, [terms, columns]),
                    None => (b, ldb),
                };
                cut(m, rows).all(|(m, rows)| {
                    let block = Self {
                        size: Size { m: rows, n: columns, k: terms },
                        accumulate: accumulate || k > 0,
                        ldb,
                        ..*self
                    };
                    block.run_block(&a[(m * lda + k) / per_word..], b, &mut c[m * ldc + n..])
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
