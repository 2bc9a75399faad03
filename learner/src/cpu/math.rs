//! exp, log, tanh and softplus in float32 without branches, so that loops over them become vector code: the standard
//! library's are calls. Polynomials and ranges are those of Moshier's Cephes (`expf`, `logf`); errors stay under
//! 3e-7, relative for `exp` and `tanh`, absolute for `softplus`.

use std::f32::consts::LOG2_E;

/// 1.5 · 2²³: adding it rounds to a whole number, which the lowest bits then hold.
const ROUNDER: f32 = 12_582_912.0;

/// eˣ; over 88 and under −87 it stays at what they give. NaN gives NaN.
#[inline(always)]
pub(super) fn exp(x: f32) -> f32 {
    let x = x.clamp(-87.0, 88.0);
    let shifted = x * LOG2_E + ROUNDER;
    let whole = shifted - ROUNDER;
    // ln 2 in two parts: the first times a whole number is exact.
    let r = (x - whole * 0.693_359_4) + whole * 2.121_944_4e-4;
    let mut p = 1.987_569_2e-4;
    for coefficient in [1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 0.166_666_65, 0.5] {
        p = p * r + coefficient;
    }
    let power = f32::from_bits(shifted.to_bits().wrapping_add(127) << 23);
    (p * r * r + r + 1.0) * power
}

/// log x for x in [1, 2].
#[inline(always)]
fn log_from_one_to_two(x: f32) -> f32 {
    // Around 1 the polynomial is at its best: above √2, halve and add log 2.
    let halve = x > std::f32::consts::SQRT_2;
    let m = if halve { x * 0.5 } else { x } - 1.0;
    let offset = if halve { std::f32::consts::LN_2 } else { 0.0 };
    let mut p = 7.037_683_6e-2;
    for coefficient in [
        -0.115_146_1,
        0.116_769_984,
        -0.124_201_41,
        0.142_493_23,
        -0.166_680_57,
        0.200_007_15,
        -0.249_999_94,
        0.333_333_3,
    ] {
        p = p * m + coefficient;
    }
    let z = m * m;
    p * m * z - 0.5 * z + m + offset
}

/// log(1 + eˣ).
#[inline(always)]
pub(super) fn softplus(x: f32) -> f32 {
    let positive = if x > 0.0 { x } else { 0.0 };
    positive + log_from_one_to_two(1.0 + exp(-x.abs()))
}

/// tanh x.
#[inline(always)]
pub(super) fn tanh(x: f32) -> f32 {
    // Near 0 the quotient loses digits: a polynomial there (Cephes, `tanhf`).
    let z = x * x;
    let mut p = -5.704_988_7e-3;
    for coefficient in [2.063_908_8e-2, -5.373_971_5e-2, 0.133_314_42, -0.333_332_8] {
        p = p * z + coefficient;
    }
    let near = p * z * x + x;
    let e = exp(-2.0 * x.abs());
    let far = ((1.0 - e) / (1.0 + e)).copysign(x);
    if x.abs() < 0.625 { near } else { far }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_agree_with_double_precision_over_their_range() {
        for i in -400_000..=400_000 {
            let x = i as f32 * 2e-4;
            let exact = f64::from(x);
            let relative =
                |ours: f32, theirs: f64| ((f64::from(ours) - theirs) / theirs.abs().max(1e-30)).abs();
            assert!(relative(exp(x), exact.exp()) < 3e-7, "exp {x}: {}", exp(x));
            assert!(relative(tanh(x), exact.tanh()) < 3e-7 || x == 0.0, "tanh {x}: {}", tanh(x));
            let wanted = exact.max(0.0) + (-exact.abs()).exp().ln_1p();
            let error = (f64::from(softplus(x)) - wanted).abs();
            assert!(error < 3e-7 * wanted.max(1.0), "softplus {x}: {}", softplus(x));
        }
        assert!(exp(f32::NAN).is_nan() && tanh(f32::NAN).is_nan() && softplus(f32::NAN).is_nan());
    }
}
