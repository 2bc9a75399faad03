//! Rows of words turned into columns, by blocks that fit into the processor's registers.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;
use std::ops::Range;

/// Turns `[rows, columns]` words into `[columns, rows]`, by blocks that fit into registers; `stride` words of `to` lie
/// from one of its rows to the next.
pub(super) fn transpose(from: &[u32], rows: usize, columns: usize, to: &mut [u32], stride: usize) {
    if rows * columns == 0 {
        return;
    }
    let room = (columns - 1) * stride + rows;
    assert!(from.len() >= rows * columns && to.len() >= room && rows <= stride, "{rows} × {columns} words");
    #[cfg(target_arch = "x86_64")]
    // SAFETY: the processor has what is asked for, and both slices hold rows × columns words at their strides (asserted).
    unsafe {
        if is_x86_feature_detected!("avx512f") {
            return transpose_avx512(from, rows, columns, to, stride);
        }
        if is_x86_feature_detected!("avx2") {
            return transpose_avx2(from, rows, columns, to, stride);
        }
    }
    transpose_by_words(from, columns, to, stride, 0..rows, 0..columns);
}

/// The same, word by word, for some rows and columns.
pub(super) fn transpose_by_words(
    from: &[u32],
    columns: usize,
    to: &mut [u32],
    stride: usize,
    row_range: Range<usize>,
    column_range: Range<usize>,
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
    // SAFETY: as the caller promises, of the whole and so of every block.
    unsafe {
        by_blocks::<16>([rows, columns], from, to, stride, |from, to| block_of_16(from, columns, to, stride))
    }
}

/// # Safety
/// The processor has AVX2, and both slices hold `rows · columns` words at their strides.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
pub(super) unsafe fn transpose_avx2(
    from: &[u32],
    rows: usize,
    columns: usize,
    to: &mut [u32],
    stride: usize,
) {
    // SAFETY: as the caller promises, of the whole and so of every block.
    unsafe {
        by_blocks::<8>([rows, columns], from, to, stride, |from, to| block_of_8(from, columns, to, stride))
    }
}

/// Gives `block` where each whole block of `N` × `N` words is and where it goes; the rest word by word.
///
/// # Safety
/// Both slices hold `rows · columns` words at their strides.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn by_blocks<const N: usize>(
    [rows, columns]: [usize; 2],
    from: &[u32],
    to: &mut [u32],
    stride: usize,
    block: impl Fn(*const u32, *mut u32),
) {
    let (whole_rows, whole_columns) = (rows - rows % N, columns - columns % N);
    for row in (0..whole_rows).step_by(N) {
        for column in (0..whole_columns).step_by(N) {
            // SAFETY: the block's last word is (row + N − 1) · columns + column + N − 1 of `from` and its mirror of `to`,
            // which are inside.
            unsafe {
                let source = from.as_ptr().add(row * columns + column);
                let target = to.as_mut_ptr().add(column * stride + row);
                block(source, target);
            }
        }
    }
    transpose_by_words(from, columns, to, stride, 0..rows, whole_columns..columns);
    transpose_by_words(from, columns, to, stride, whole_rows..rows, 0..whole_columns);
}

/// A block of 8 × 8 words.
///
/// # Safety
/// The processor has AVX2; 8 rows of 8 words at the given strides are readable and writable.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn block_of_8(from: *const u32, from_stride: usize, to: *mut u32, to_stride: usize) {
    // SAFETY: as the caller promises.
    let row = |i: usize| unsafe { _mm256_loadu_si256(from.add(i * from_stride).cast()) };
    // Afterwards register 4g + c holds, in each half p, column 4p + c of rows 4g..4g + 4.
    let mut quads = [_mm256_setzero_si256(); 8];
    for group in 0..2 {
        let [a, b, c, d] = std::array::from_fn(|i| row(4 * group + i));
        let (ab_low, ab_high) = (_mm256_unpacklo_epi32(a, b), _mm256_unpackhi_epi32(a, b));
        let (cd_low, cd_high) = (_mm256_unpacklo_epi32(c, d), _mm256_unpackhi_epi32(c, d));
        quads[4 * group] = _mm256_unpacklo_epi64(ab_low, cd_low);
        quads[4 * group + 1] = _mm256_unpackhi_epi64(ab_low, cd_low);
        quads[4 * group + 2] = _mm256_unpacklo_epi64(ab_high, cd_high);
        quads[4 * group + 3] = _mm256_unpackhi_epi64(ab_high, cd_high);
    }
    for c in 0..4 {
        let (top, bottom) = (quads[c], quads[4 + c]);
        // SAFETY: as the caller promises: columns c and 4 + c are two of 8.
        unsafe {
            let low = _mm256_permute2x128_si256::<0x20>(top, bottom);
            _mm256_storeu_si256(to.add(c * to_stride).cast(), low);
            let high = _mm256_permute2x128_si256::<0x31>(top, bottom);
            _mm256_storeu_si256(to.add((4 + c) * to_stride).cast(), high);
        }
    }
}

/// A block of 16 × 16 words.
///
/// # Safety
/// The processor has AVX-512 F; 16 rows of 16 words at the given strides are readable and writable.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn block_of_16(from: *const u32, from_stride: usize, to: *mut u32, to_stride: usize) {
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
