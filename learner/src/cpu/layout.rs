//! The layouts that products read: rows rounded to bfloat16, two rows interleaved, rows turned into columns. What is
//! laid out comes from [`Rows`], straight from the pass that computes it.

use multiversion::multiversion;

use super::kernels::LANES;

/// The rows of a matrix and of its packed form, in numbers.
#[derive(Clone, Copy)]
pub(super) struct Layout {
    /// Of a row.
    pub(super) length: usize,
    /// From one packed row to the next.
    pub(super) stride: usize,
}

/// Numbers on their way into a layout, row by row: what a pass between two products computes, so that it need not
/// be written to memory and read again.
pub(super) trait Rows {
    /// Numbers `at..at + LANES` of a row; those past its end do not matter.
    fn lanes(&mut self, row: usize, at: usize) -> [f32; LANES];

    /// All of a row was asked for.
    fn end(&mut self, _row: usize) {}
}

/// Rows as they are.
pub(super) struct AsTheyAre<'a> {
    pub(super) values: &'a [f32],
    /// Of a row.
    pub(super) length: usize,
}

impl Rows for AsTheyAre<'_> {
    #[inline(always)]
    fn lanes(&mut self, row: usize, at: usize) -> [f32; LANES] {
        let rest = &self.values[row * self.length + at..];
        match rest.first_chunk() {
            Some(lanes) => *lanes,
            None => std::array::from_fn(|lane| rest.get(lane).copied().unwrap_or(0.0)),
        }
    }
}

/// The upper half of a float32, rounded to nearest, ties to even. A NaN stays one: only those with a payload that
/// no operation makes would carry over.
#[inline(always)]
fn bf16(value: f32) -> u16 {
    let bits = value.to_bits();
    ((bits.wrapping_add(0x7fff + ((bits >> 16) & 1))) >> 16) as u16
}

/// [`bf16`] by the processor's own instruction.
///
/// # Safety
/// The processor has AVX-512 F and AVX512-BF16.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bf16")]
#[inline]
unsafe fn bf16_native(values: &[f32; LANES]) -> [u16; LANES] {
    use std::arch::x86_64::*;
    // SAFETY: as the caller promises; 16 numbers are read, and 16 of bfloat16 are 32 bytes either way.
    unsafe { std::mem::transmute(_mm512_cvtneps_pbh(_mm512_loadu_ps(values.as_ptr()))) }
}

/// Rounds `count` rows to bfloat16: as they are (`plain`), and two rows interleaved (`pairs`, where there is room). An
/// odd last row pairs with zeros.
#[multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx512bf16",
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl",
    "x86_64+avx2+fma"
))]
pub(super) fn pack_bf16<R: Rows>(
    rows: &mut R,
    count: usize,
    layout: Layout,
    plain: &mut [u16],
    pairs: &mut [u32],
) {
    const NATIVE: bool = multiversion::target::selected_target!().supports_feature_str("avx512bf16");
    let round = |values: [f32; LANES]| {
        #[cfg(target_arch = "x86_64")]
        if NATIVE {
            // SAFETY: this is the version for processors with AVX-512 F and AVX512-BF16.
            return unsafe { bf16_native(&values) };
        }
        values.map(bf16)
    };
    let Layout { length, stride } = layout;
    assert!(length <= stride, "rows of {length} numbers, {stride} apart");
    for row in 0..count {
        let (before, this) = plain.split_at_mut(row * stride);
        let this = &mut this[..length];
        let (whole, tail) = this.as_chunks_mut();
        for (index, to) in whole.iter_mut().enumerate() {
            *to = round(rows.lanes(row, index * LANES));
        }
        if !tail.is_empty() {
            let lanes = round(rows.lanes(row, whole.len() * LANES));
            tail.copy_from_slice(&lanes[..tail.len()]);
        }
        rows.end(row);
        if pairs.is_empty() {
            continue;
        }
        let pairs = &mut pairs[row / 2 * length..][..length];
        if row % 2 == 1 {
            let even = &before[(row - 1) * stride..][..length];
            for ((pair, even), odd) in pairs.iter_mut().zip(even).zip(&*this) {
                *pair = u32::from(*odd) << 16 | u32::from(*even);
            }
        } else if row + 1 == count {
            pairs.iter_mut().zip(&*this).for_each(|(pair, even)| *pair = u32::from(*even));
        }
    }
}

/// Writes rows of `length` numbers as they are.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn write<R: Rows>(rows: &mut R, length: usize, to: &mut [f32]) {
    for (row, to) in to.chunks_exact_mut(length).enumerate() {
        let (whole, tail) = to.as_chunks_mut();
        for (index, to) in whole.iter_mut().enumerate() {
            *to = rows.lanes(row, index * LANES);
        }
        if !tail.is_empty() {
            tail.copy_from_slice(&rows.lanes(row, whole.len() * LANES)[..tail.len()]);
        }
        rows.end(row);
    }
}

/// Turns `[rows, columns]` words into `[columns, rows]`, by blocks that fit into registers; `stride` words of `to` lie
/// from one of its rows to the next.
pub(super) fn transpose(from: &[u32], rows: usize, columns: usize, to: &mut [u32], stride: usize) {
    if rows * columns == 0 {
        return;
    }
    let room = (columns - 1) * stride + rows;
    assert!(from.len() >= rows * columns && to.len() >= room && rows <= stride, "{rows} × {columns} words");
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the processor has AVX-512 F, and both slices hold rows × columns words at their strides (asserted).
        unsafe { transpose_avx512(from, rows, columns, to, stride) };
        return;
    }
    transpose_by_words(from, columns, to, stride, 0..rows, 0..columns);
}

/// The same, word by word, for some rows and columns.
pub(super) fn transpose_by_words(
    from: &[u32],
    columns: usize,
    to: &mut [u32],
    stride: usize,
    row_range: std::ops::Range<usize>,
    column_range: std::ops::Range<usize>,
) {
    for column in column_range {
        for row in row_range.clone() {
            to[column * stride + row] = from[row * columns + column];
        }
    }
}

/// # Safety
/// The processor has AVX-512 F, and both slices hold `rows · columns` words at their strides.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn transpose_avx512(from: &[u32], rows: usize, columns: usize, to: &mut [u32], stride: usize) {
    let (whole_rows, whole_columns) = (rows - rows % LANES, columns - columns % LANES);
    for row in (0..whole_rows).step_by(LANES) {
        for column in (0..whole_columns).step_by(LANES) {
            // SAFETY: the block's last word is (row + 15) · columns + column + 15 of `from` and its mirror of `to`,
            // which are inside.
            unsafe {
                let source = from.as_ptr().add(row * columns + column);
                let target = to.as_mut_ptr().add(column * stride + row);
                transpose_block(source, columns, target, stride);
            }
        }
    }
    transpose_by_words(from, columns, to, stride, 0..rows, whole_columns..columns);
    transpose_by_words(from, columns, to, stride, whole_rows..rows, 0..whole_columns);
}

/// A block of 16 × 16 words.
///
/// # Safety
/// The processor has AVX-512 F; 16 rows of 16 words at the given strides are readable and writable.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn transpose_block(from: *const u32, from_stride: usize, to: *mut u32, to_stride: usize) {
    use std::arch::x86_64::*;
    // SAFETY: as the caller promises.
    let row = |i: usize| unsafe { _mm512_loadu_si512(from.add(i * from_stride).cast()) };
    // 32-bit, then 64-bit neighbours: afterwards register 4g + c holds, in each 128-bit part p, column 4p + c of
    // rows 4g..4g + 4.
    let mut quads = [_mm512_setzero_si512(); 16];
    for group in 0..4 {
        let [a, b, c, d] = std::array::from_fn(|i| row(4 * group + i));
        let (ab_low, ab_high) = (_mm512_unpacklo_epi32(a, b), _mm512_unpackhi_epi32(a, b));
        let (cd_low, cd_high) = (_mm512_unpacklo_epi32(c, d), _mm512_unpackhi_epi32(c, d));
        quads[4 * group] = _mm512_unpacklo_epi64(ab_low, cd_low);
        quads[4 * group + 1] = _mm512_unpackhi_epi64(ab_low, cd_low);
        quads[4 * group + 2] = _mm512_unpacklo_epi64(ab_high, cd_high);
        quads[4 * group + 3] = _mm512_unpackhi_epi64(ab_high, cd_high);
    }
    for c in 0..4 {
        let [g0, g1, g2, g3] = [quads[c], quads[4 + c], quads[8 + c], quads[12 + c]];
        // 128-bit parts 0 and 2 of two groups, then 1 and 3; and again.
        let (even_01, odd_01) = (_mm512_shuffle_i32x4::<0x88>(g0, g1), _mm512_shuffle_i32x4::<0xdd>(g0, g1));
        let (even_23, odd_23) = (_mm512_shuffle_i32x4::<0x88>(g2, g3), _mm512_shuffle_i32x4::<0xdd>(g2, g3));
        let columns = [
            _mm512_shuffle_i32x4::<0x88>(even_01, even_23),
            _mm512_shuffle_i32x4::<0x88>(odd_01, odd_23),
            _mm512_shuffle_i32x4::<0xdd>(even_01, even_23),
            _mm512_shuffle_i32x4::<0xdd>(odd_01, odd_23),
        ];
        for (part, column) in columns.into_iter().enumerate() {
            // SAFETY: as the caller promises: column 4·part + c is one of 16.
            unsafe { _mm512_storeu_si512(to.add((4 * part + c) * to_stride).cast(), column) };
        }
    }
}
