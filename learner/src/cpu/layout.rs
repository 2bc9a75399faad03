//! The layouts that products read: rows as they are, rounded to bfloat16, two rows interleaved. What is
//! laid out comes from [`Rows`], straight from the pass that computes it.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;
use std::ops::Range;

use multiversion::multiversion;

use super::rows::Rows;
#[cfg(target_arch = "x86_64")]
use super::rows::store;

/// Numbers of the widest vector; R is a multiple of it.
pub(super) const LANES: usize = 16;

/// Rows that are laid out at a time: whole blocks of the transposition.
pub(super) const CHUNK: usize = 32;

/// A range, cut every `length` numbers.
pub(super) fn chunks(range: Range<usize>, length: usize) -> impl Iterator<Item = Range<usize>> {
    let end = range.end;
    range.step_by(length).map(move |first| first..end.min(first + length))
}

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
fn bf16(value: f32) -> u16 {
    let bits = value.to_bits();
    ((bits.wrapping_add(0x7fff + ((bits >> 16) & 1))) >> 16) as u16
}

/// Where parts of two rows go in bfloat16: as they are, and interleaved, the even row's numbers in the words' lower halves;
/// and their signs. A slice is as long as the part, or empty where that is not asked for.
struct Rounded<'a> {
    even: &'a mut [u16],
    odd: &'a mut [u16],
    pairs: &'a mut [u32],
    signs: &'a mut [u32],
}

/// Which of the lanes are positive: a bit each. A NaN counts as positive, so that it goes on and is noticed.
#[inline(always)]
fn signs(values: &[f32; LANES]) -> u32 {
    let mut bits = [0; LANES];
    for (lane, bits) in bits.iter_mut().enumerate() {
        *bits = u32::from(values[lane] > 0.0 || values[lane].is_nan()) << lane;
    }
    bits.into_iter().fold(0, |all, bit| all | bit)
}

/// Rounds two parts.
#[inline(always)]
fn round(even: &[f32], odd: &[f32], to: &mut Rounded<'_>) {
    let lanes = even.as_chunks().0.iter().zip(odd.as_chunks().0);
    for (to, (even, odd)) in to.signs.iter_mut().zip(lanes) {
        *to = signs(even) | signs(odd) << LANES;
    }
    for (to, values) in [(&mut *to.even, even), (&mut *to.odd, odd)] {
        to.iter_mut().zip(values).for_each(|(to, value)| *to = bf16(*value));
    }
    for ((to, even), odd) in to.pairs.iter_mut().zip(even).zip(odd) {
        *to = u32::from(bf16(*odd)) << 16 | u32::from(bf16(*even));
    }
}

/// Numbers of a row that are computed at a time.
const PART: usize = 256;

/// Room for a part, at a cache line.
#[repr(align(64))]
struct Part([f32; PART]);

/// Where rows of a range go; each begins with the range's first row and may be empty. An odd last row pairs with zeros.
pub(super) struct Places<'a> {
    /// Row after row, at the layout's stride.
    pub(super) plain: &'a mut [u16],
    /// Two rows interleaved, the even row's number in a word's lower half.
    pub(super) pairs: &'a mut [u32],
    /// Two rows' positive numbers, a bit each, [`LANES`] of the even row in a word's lower half; rows are whole lanes then.
    pub(super) signs: &'a mut [u32],
}

/// Rounds the rows of `range`, whose first is even, to bfloat16.
pub(super) fn pack_bf16<R: Rows>(rows: &mut R, range: Range<usize>, layout: Layout, mut places: Places<'_>) {
    let Layout { length, stride } = layout;
    let count = range.len();
    let room = |rows: usize, numbers: usize| rows.saturating_sub(1) * numbers + length;
    let fits = |have: usize, need: usize| have == 0 || have >= need;
    assert!(
        length <= stride && range.start.is_multiple_of(2),
        "rows {range:?} of {length} numbers, {stride} apart"
    );
    assert!(fits(places.plain.len(), room(count, stride)), "{} plain numbers", places.plain.len());
    assert!(fits(places.pairs.len(), room(count.div_ceil(2), length)), "{} pairs", places.pairs.len());
    assert!(
        fits(places.signs.len() * LANES, room(count.div_ceil(2), length)),
        "{} signs",
        places.signs.len()
    );
    if range.is_empty() {
        return;
    }
    let mut done = 0;
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512bf16") && is_x86_feature_detected!("avx512bw") {
        // SAFETY: the processor has what it needs, and there is room for whole lanes of all rows (asserted).
        done = unsafe { pack_lanes(rows, range.clone(), layout, &mut places) };
    }
    if done < length {
        pack_parts(rows, range, layout, done, places);
    }
}

/// [`pack_bf16`] by the processor's own instructions, as far as whole lanes go; how far that is.
///
/// # Safety
/// The processor has AVX-512 F, AVX-512 BW and AVX512-BF16; a place is empty, or has room for the rows.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn pack_lanes<R: Rows>(
    rows: &mut R,
    range: Range<usize>,
    Layout { length, stride }: Layout,
    places: &mut Places<'_>,
) -> usize {
    // Numbers 0, 16, 1, 17, … of a vector of 32.
    const INTERLEAVED: [u16; 2 * LANES] = {
        let mut places = [0; 2 * LANES];
        let mut place = 0;
        while place < 2 * LANES {
            places[place] = (place / 2 + place % 2 * LANES) as u16;
            place += 1;
        }
        places
    };
    let whole = length - length % LANES;
    let Places { plain, pairs, signs } = places;
    let (plains, paired, signed) = (!plain.is_empty(), !pairs.is_empty(), !signs.is_empty());
    let (plain, pairs, signs) = (plain.as_mut_ptr(), pairs.as_mut_ptr(), signs.as_mut_ptr());
    // SAFETY: numbers at..at + 16 are a row's, and each place that is not empty has room for all rows, as the caller
    // promises: 32 bytes of bfloat16, 64 of words, 4 of signs.
    unsafe {
        let interleaved = _mm512_loadu_si512(INTERLEAVED.as_ptr().cast());
        for row in range.clone().step_by(2) {
            let place = row - range.start;
            let two = row + 1 < range.end;
            let (mut even_sum, mut odd_sum) = (_mm512_setzero_ps(), _mm512_setzero_ps());
            for at in (0..whole).step_by(LANES) {
                let even = rows.lanes(row, at);
                let odd = if two { rows.lanes(row + 1, at) } else { _mm512_setzero_ps() };
                if R::SUMS {
                    even_sum = _mm512_add_ps(even_sum, even);
                    odd_sum = _mm512_add_ps(odd_sum, odd);
                }
                let both: __m512i = std::mem::transmute(_mm512_cvtne2ps_pbh(odd, even));
                let pair_at = place / 2 * length + at;
                if paired {
                    let words = _mm512_permutexvar_epi16(interleaved, both);
                    _mm512_storeu_si512(pairs.add(pair_at).cast(), words);
                }
                if plains {
                    let to = plain.add(place * stride + at);
                    _mm256_storeu_si256(to.cast(), _mm512_castsi512_si256(both));
                    if two {
                        _mm256_storeu_si256(to.add(stride).cast(), _mm512_extracti64x4_epi64::<1>(both));
                    }
                }
                if signed {
                    // As whole numbers of 16 bits they have the sign of what they are in bfloat16.
                    *signs.add(pair_at / LANES) = _mm512_cmpgt_epi16_mask(both, _mm512_setzero_si512());
                }
            }
            if R::SUMS {
                rows.sum(row, _mm512_reduce_add_ps(even_sum));
                if two {
                    rows.sum(row + 1, _mm512_reduce_add_ps(odd_sum));
                }
            }
        }
    }
    whole
}

/// [`pack_bf16`] part after part, from number `from` of every row on.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn pack_parts<R: Rows>(
    rows: &mut R,
    range: Range<usize>,
    Layout { length, stride }: Layout,
    from: usize,
    Places { plain, pairs, signs }: Places<'_>,
) {
    let (mut even, mut odd) = (Part([0.0; PART]), Part([0.0; PART]));
    for row in range.clone().step_by(2) {
        let place = row - range.start;
        let paired = row + 1 < range.end;
        if !paired {
            odd.0.fill(0.0);
        }
        for at in (from..length).step_by(PART) {
            let count = PART.min(length - at);
            let even = rows.part(row, at, &mut even.0[..count]);
            let odd = &mut odd.0[..count];
            let odd = if paired { rows.part(row + 1, at, odd) } else { odd };
            let mut to = Rounded { even: &mut [], odd: &mut [], pairs: &mut [], signs: &mut [] };
            if !plain.is_empty() {
                let (first, second) = plain[place * stride + at..].split_at_mut(count);
                to.even = first;
                to.odd = if paired { &mut second[stride - count..][..count] } else { &mut [] };
            }
            if !pairs.is_empty() {
                to.pairs = &mut pairs[place / 2 * length + at..][..count];
            }
            if !signs.is_empty() {
                to.signs = &mut signs[(place / 2 * length + at) / LANES..][..count / LANES];
            }
            round(even, odd, &mut to);
        }
    }
}

/// Writes the rows of `range`, whose first is even, as they are, `length` numbers each; and their signs, as in [`Places`].
pub(super) fn write<R: Rows>(
    rows: &mut R,
    range: Range<usize>,
    length: usize,
    to: &mut [f32],
    signs: &mut [u32],
) {
    let numbers = range.len() * length;
    assert!(range.start.is_multiple_of(2), "rows {range:?} begin in the middle of two");
    assert!(to.len() >= numbers, "{range:?} × {length} numbers into {}", to.len());
    assert!(signs.is_empty() || signs.len() * LANES >= range.len().div_ceil(2) * length);
    let mut done = 0;
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the processor has it.
        unsafe { write_lanes(rows, range.clone(), length, to, signs) };
        done = length - length % LANES;
    }
    if done < length {
        write_parts(rows, range, length, done, to, signs);
    }
}

/// [`write()`] by the processor's own instructions, as far as whole lanes go.
///
/// # Safety
/// The processor has AVX-512 F.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn write_lanes<R: Rows>(
    rows: &mut R,
    range: Range<usize>,
    length: usize,
    to: &mut [f32],
    signs: &mut [u32],
) {
    for row in range.clone() {
        let place = row - range.start;
        // SAFETY: as the caller promises.
        unsafe {
            let mut sum = _mm512_setzero_ps();
            for at in (0..length - length % LANES).step_by(LANES) {
                let values = rows.lanes(row, at);
                store(to, place * length + at, values);
                if R::SUMS {
                    sum = _mm512_add_ps(sum, values);
                }
                if !signs.is_empty() {
                    let positive = _mm512_cmp_ps_mask::<_CMP_NLE_UQ>(values, _mm512_setzero_ps());
                    let word = &mut signs[(place / 2 * length + at) / LANES];
                    let bits = u32::from(positive);
                    *word = if row % 2 == 0 { bits } else { *word | bits << LANES };
                }
            }
            if R::SUMS {
                rows.sum(row, _mm512_reduce_add_ps(sum));
            }
        }
    }
}

/// [`write()`] part after part, from number `from` of every row on.
#[multiversion(targets("x86_64+avx2+fma"))]
pub(super) fn write_parts<R: Rows>(
    rows: &mut R,
    range: Range<usize>,
    length: usize,
    from: usize,
    to: &mut [f32],
    sign_words: &mut [u32],
) {
    let mut room = Part([0.0; PART]);
    for (row, to) in range.clone().zip(to.chunks_exact_mut(length)) {
        for (index, to) in to[from..].chunks_mut(PART).enumerate() {
            let at = from + index * PART;
            let values = rows.part(row, at, &mut room.0[..to.len()]);
            to.copy_from_slice(values);
            if sign_words.is_empty() {
                continue;
            }
            let first = ((row - range.start) / 2 * length + at) / LANES;
            for (word, values) in sign_words[first..].iter_mut().zip(values.as_chunks().0) {
                *word = if row % 2 == 0 { signs(values) } else { *word | signs(values) << LANES };
            }
        }
    }
}
