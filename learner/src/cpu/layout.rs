//! The layouts that products read: rows rounded to bfloat16, two rows interleaved, rows turned into columns. Each is
//! written for AVX-512 and plainly, and chosen at run time.

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

/// The upper half of a float32, rounded to nearest, ties to even. A NaN stays one: only those with a payload that
/// no operation makes would carry over.
#[inline(always)]
fn bf16(value: f32) -> u32 {
    let bits = value.to_bits();
    (bits.wrapping_add(0x7fff + ((bits >> 16) & 1))) >> 16
}

/// Rounds rows to bfloat16: as they are (`plain`), and two rows interleaved (`pairs`, where there is room). An odd
/// last row pairs with zeros.
pub(super) fn pack_bf16(values: &[f32], layout: Layout, plain: &mut [u16], pairs: &mut [u32]) {
    let Layout { length, stride } = layout;
    assert!(
        values.len().is_multiple_of(length) && length <= stride,
        "rows of {length} in {} numbers",
        values.len()
    );
    #[cfg(target_arch = "x86_64")]
    let native = is_x86_feature_detected!("avx512bf16") && is_x86_feature_detected!("avx512vl");
    let mut pairs = pairs.chunks_exact_mut(length);
    for (from, plain) in values.chunks(2 * length).zip(plain.chunks_mut(2 * stride)) {
        let (even, odd) = from.split_at(length);
        let (plain_even, plain_odd) = plain.split_at_mut(stride);
        let plain_even = &mut plain_even[..length];
        let rows = match (odd.is_empty(), pairs.next()) {
            (false, Some(pairs)) => [(even, odd, plain_even, &mut plain_odd[..length], pairs)],
            (true, Some(pairs)) => {
                round_row(even, plain_even);
                plain_even.iter().zip(pairs).for_each(|(plain, pair)| *pair = u32::from(*plain));
                continue;
            }
            (lone, None) => {
                round_row(even, plain_even);
                if !lone {
                    round_row(odd, &mut plain_odd[..length]);
                }
                continue;
            }
        };
        let [(even, odd, plain_even, plain_odd, pairs)] = rows;
        #[cfg(target_arch = "x86_64")]
        if native {
            // SAFETY: the processor has AVX512-BF16 and AVX512-VL, and with them AVX-512 F; all five have `length`.
            unsafe { pack_rows_avx512(even, odd, plain_even, plain_odd, pairs) };
            continue;
        }
        pack_rows(even, odd, plain_even, plain_odd, pairs);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn round_row(values: &[f32], plain: &mut [u16]) {
    plain.iter_mut().zip(values).for_each(|(plain, value)| *plain = bf16(*value) as u16);
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn pack_rows(even: &[f32], odd: &[f32], plain_even: &mut [u16], plain_odd: &mut [u16], pairs: &mut [u32]) {
    let rows = even.iter().zip(odd).zip(plain_even).zip(plain_odd).zip(pairs);
    for ((((even, odd), plain_even), plain_odd), pair) in rows {
        let (low, high) = (bf16(*even), bf16(*odd));
        *plain_even = low as u16;
        *plain_odd = high as u16;
        *pair = low | (high << 16);
    }
}

/// # Safety
/// The processor has AVX-512 F and VL and AVX512-BF16; all five slices have the length of the first.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl,avx512bf16")]
unsafe fn pack_rows_avx512(
    even: &[f32],
    odd: &[f32],
    plain_even: &mut [u16],
    plain_odd: &mut [u16],
    pairs: &mut [u32],
) {
    use std::arch::x86_64::*;
    let whole = even.len() - even.len() % LANES;
    for i in (0..whole).step_by(LANES) {
        // SAFETY: as the caller promises, 16 numbers from i on are in every slice; the two vectors of bfloat16 are 32
        // bytes either way.
        unsafe {
            let round = |values: &[f32]| -> __m256i {
                std::mem::transmute(_mm512_cvtneps_pbh(_mm512_loadu_ps(values.as_ptr().add(i))))
            };
            let (low, high) = (round(even), round(odd));
            _mm256_storeu_si256(plain_even.as_mut_ptr().add(i).cast(), low);
            _mm256_storeu_si256(plain_odd.as_mut_ptr().add(i).cast(), high);
            let high = _mm512_slli_epi32::<16>(_mm512_cvtepu16_epi32(high));
            let pair = _mm512_or_si512(_mm512_cvtepu16_epi32(low), high);
            _mm512_storeu_si512(pairs.as_mut_ptr().add(i).cast(), pair);
        }
    }
    let (plain_even, plain_odd) = (&mut plain_even[whole..], &mut plain_odd[whole..]);
    pack_rows(&even[whole..], &odd[whole..], plain_even, plain_odd, &mut pairs[whole..]);
}

/// Turns `[rows, columns]` words into `[columns, rows]`, by blocks that fit into registers.
pub(super) fn transpose(from: &[u32], rows: usize, columns: usize, to: &mut [u32]) {
    assert!(from.len() >= rows * columns && to.len() >= rows * columns, "{rows} × {columns} words");
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the processor has AVX-512 F, and both slices hold rows × columns words (asserted).
        unsafe { transpose_avx512(from, rows, columns, to) };
        return;
    }
    transpose_by_words(from, rows, columns, to, 0..rows, 0..columns);
}

/// The same, word by word, for some rows and columns.
pub(super) fn transpose_by_words(
    from: &[u32],
    rows: usize,
    columns: usize,
    to: &mut [u32],
    row_range: std::ops::Range<usize>,
    column_range: std::ops::Range<usize>,
) {
    for column in column_range {
        for row in row_range.clone() {
            to[column * rows + row] = from[row * columns + column];
        }
    }
}

/// # Safety
/// The processor has AVX-512 F, and both slices hold `rows · columns` words.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn transpose_avx512(from: &[u32], rows: usize, columns: usize, to: &mut [u32]) {
    let (whole_rows, whole_columns) = (rows - rows % LANES, columns - columns % LANES);
    for row in (0..whole_rows).step_by(LANES) {
        for column in (0..whole_columns).step_by(LANES) {
            // SAFETY: the block's last word is (row + 15) · columns + column + 15 of `from` and its mirror of `to`,
            // which are inside.
            unsafe {
                let source = from.as_ptr().add(row * columns + column);
                let target = to.as_mut_ptr().add(column * rows + row);
                transpose_block(source, columns, target, rows);
            }
        }
    }
    transpose_by_words(from, rows, columns, to, 0..rows, whole_columns..columns);
    transpose_by_words(from, rows, columns, to, whole_rows..rows, 0..whole_columns);
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
