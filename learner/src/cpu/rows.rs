//! What a pass between two products computes, on its way into the layout that the next one reads ([`super::layout`]).

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

use super::kernels::row_sum;
use super::layout::LANES;

/// Numbers on their way into a layout, part of a row after part: what a pass between two products computes, so that it need
/// not be written to memory and read again.
pub(super) trait Rows {
    /// The numbers from `at` on of a row, as many as there is `room` for where they have to be computed. Parts of a row come in
    /// order.
    fn part<'a>(&mut self, row: usize, at: usize, room: &'a mut [f32]) -> &'a [f32]
    where
        Self: 'a;

    /// [`LANES`] of them, by the processor's own instructions.
    ///
    /// # Safety
    /// The processor has AVX-512 F.
    #[cfg(target_arch = "x86_64")]
    unsafe fn lanes(&mut self, row: usize, at: usize) -> __m512;

    /// Whether it wants to know the sums of rows whose numbers came by [`Rows::lanes`].
    const SUMS: bool = false;

    /// The sum of a row.
    fn sum(&mut self, _row: usize, _sum: f32) {}
}

/// Rows as they are, from one on.
pub(super) struct AsTheyAre<'a> {
    pub(super) first: usize,
    pub(super) values: &'a [f32],
    /// Of a row.
    pub(super) length: usize,
}

impl Rows for AsTheyAre<'_> {
    #[inline(always)]
    fn part<'a>(&mut self, row: usize, at: usize, room: &'a mut [f32]) -> &'a [f32]
    where
        Self: 'a,
    {
        &self.values[(row - self.first) * self.length + at..][..room.len()]
    }

    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    unsafe fn lanes(&mut self, row: usize, at: usize) -> __m512 {
        // SAFETY: as the caller promises.
        unsafe { load(self.values, (row - self.first) * self.length + at) }
    }
}

/// [`LANES`] numbers from `at` on.
///
/// # Safety
/// The processor has AVX-512 F.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
pub(super) unsafe fn load(values: &[f32], at: usize) -> __m512 {
    let lanes: &[f32; LANES] = values[at..].first_chunk().expect("rows are whole lanes");
    // SAFETY: as the caller promises; 16 numbers are the 64 bytes that are read.
    unsafe { _mm512_loadu_ps(lanes.as_ptr()) }
}

/// Writes [`LANES`] numbers from `at` on.
///
/// # Safety
/// The processor has AVX-512 F.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
pub(super) unsafe fn store(to: &mut [f32], at: usize, values: __m512) {
    let lanes: &mut [f32; LANES] = to[at..].first_chunk_mut().expect("rows are whole lanes");
    // SAFETY: as the caller promises; 16 numbers are the 64 bytes that are written.
    unsafe { _mm512_storeu_ps(lanes.as_mut_ptr(), values) }
}

/// Rows of a matrix, `[F, R]`, from one on, plus a number for every row, as far as it is positive.
pub(super) struct BiasRelu<'a> {
    pub(super) first: usize,
    /// From row `first` on.
    pub(super) values: &'a [f32],
    /// `[F]`.
    pub(super) bias: &'a [f32],
    pub(super) rows: usize,
}

impl Rows for BiasRelu<'_> {
    #[inline(always)]
    fn part<'a>(&mut self, row: usize, at: usize, to: &'a mut [f32]) -> &'a [f32]
    where
        Self: 'a,
    {
        let bias = self.bias[row];
        let values = &self.values[(row - self.first) * self.rows + at..][..to.len()];
        for (to, value) in to.iter_mut().zip(values) {
            let sum = *value + bias;
            // NaN stays NaN, as it must to be noticed: `max` would drop it.
            *to = if sum < 0.0 { 0.0 } else { sum };
        }
        to
    }

    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    unsafe fn lanes(&mut self, row: usize, at: usize) -> __m512 {
        // SAFETY: as the caller promises.
        unsafe {
            let values = load(self.values, (row - self.first) * self.rows + at);
            let sum = _mm512_add_ps(values, _mm512_set1_ps(self.bias[row]));
            // The second operand where the first is NaN or they are equal.
            _mm512_max_ps(_mm512_setzero_ps(), sum)
        }
    }
}

/// What a ReLU let through.
#[derive(Clone, Copy)]
pub(super) enum Passed<'a> {
    /// There was none.
    All,
    /// What was positive of its result, `[F, R]`.
    Positive(&'a [f32]),
    /// The same, by its signs as in [`super::layout::Places`].
    Signs(&'a [u32]),
}

/// Rows of the gradient of a layer's result, `[F, R]`, from one on, where its ReLU let through; and their sums, which are
/// the gradient of the layer's bias.
pub(super) struct Gradient<'a> {
    pub(super) first: usize,
    /// From row `first` on.
    pub(super) values: &'a [f32],
    pub(super) passed: Passed<'a>,
    pub(super) rows: usize,
    /// `[F]`, where they are asked for.
    pub(super) sums: Option<&'a mut [f32]>,
}

impl Rows for Gradient<'_> {
    #[inline(always)]
    fn part<'a>(&mut self, row: usize, at: usize, to: &'a mut [f32]) -> &'a [f32]
    where
        Self: 'a,
    {
        let values = &self.values[(row - self.first) * self.rows + at..][..to.len()];
        let gradient = match self.passed {
            Passed::All => values,
            Passed::Positive(result) => {
                let result = &result[row * self.rows + at..][..to.len()];
                for ((to, value), result) in to.iter_mut().zip(values).zip(result) {
                    *to = if *result > 0.0 { *value } else { 0.0 };
                }
                to
            }
            Passed::Signs(signs) => {
                let signs = &signs[(row / 2 * self.rows + at) / LANES..];
                let shift = row % 2 * LANES;
                let lanes = to.as_chunks_mut::<LANES>().0.iter_mut().zip(values.as_chunks::<LANES>().0);
                for ((to, values), word) in lanes.zip(signs) {
                    // Arrays and masks, not conditions: vectors come of them.
                    let (bits, values) = (word >> shift, *values);
                    let passed: [u32; LANES] =
                        std::array::from_fn(|lane| 0u32.wrapping_sub(bits >> lane & 1));
                    *to = std::array::from_fn(|lane| f32::from_bits(values[lane].to_bits() & passed[lane]));
                }
                to
            }
        };
        if let Some(sums) = &mut self.sums {
            let before = if at == 0 { 0.0 } else { sums[row] };
            sums[row] = before + row_sum(gradient);
        }
        gradient
    }

    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    unsafe fn lanes(&mut self, row: usize, at: usize) -> __m512 {
        let place = row * self.rows + at;
        // SAFETY: as the caller promises.
        unsafe {
            let values = load(self.values, place - self.first * self.rows);
            match self.passed {
                Passed::All => values,
                Passed::Positive(result) => {
                    let result = load(result, place);
                    let passed = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(result, _mm512_setzero_ps());
                    _mm512_maskz_mov_ps(passed, values)
                }
                Passed::Signs(signs) => {
                    let word = signs[(row / 2 * self.rows + at) / LANES];
                    _mm512_maskz_mov_ps((word >> (row % 2 * LANES)) as u16, values)
                }
            }
        }
    }

    const SUMS: bool = true;

    fn sum(&mut self, row: usize, sum: f32) {
        if let Some(sums) = &mut self.sums {
            sums[row] = sum;
        }
    }
}

/// A layer norm over the features of every transition: `normal = (x − mean) / √(variance + ε)`, which is kept, and
/// `normal · weight + bias`.
pub(super) struct Normal<'a> {
    pub(super) x: &'a [f32],
    pub(super) mean: &'a [f32],
    pub(super) inverse: &'a [f32],
    pub(super) weight: &'a [f32],
    pub(super) bias: &'a [f32],
    pub(super) normal: &'a mut [f32],
}

impl Rows for Normal<'_> {
    #[inline(always)]
    fn part<'a>(&mut self, row: usize, at: usize, to: &'a mut [f32]) -> &'a [f32]
    where
        Self: 'a,
    {
        let (rows, count) = (self.mean.len(), to.len());
        let (x, normal) = (&self.x[row * rows + at..][..count], &mut self.normal[row * rows + at..][..count]);
        let (mean, inverse) = (&self.mean[at..][..count], &self.inverse[at..][..count]);
        let (weight, bias) = (self.weight[row], self.bias[row]);
        for i in 0..count {
            normal[i] = (x[i] - mean[i]) * inverse[i];
            to[i] = normal[i] * weight + bias;
        }
        to
    }

    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    unsafe fn lanes(&mut self, row: usize, at: usize) -> __m512 {
        let place = row * self.mean.len() + at;
        // SAFETY: as the caller promises.
        unsafe {
            let deviation = _mm512_sub_ps(load(self.x, place), load(self.mean, at));
            let normal = _mm512_mul_ps(deviation, load(self.inverse, at));
            store(self.normal, place, normal);
            _mm512_fmadd_ps(normal, _mm512_set1_ps(self.weight[row]), _mm512_set1_ps(self.bias[row]))
        }
    }
}
