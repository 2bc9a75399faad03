//! The passes over memory between two products, compiled for AVX-512, AVX2 and the baseline and chosen at run time.
//!
//! Matrices lie feature by feature, `[F, R]`: vectors run along the R transitions, so that a layer norm's sums need
//! no shuffles. Sums over transitions go through [`LANES`] partial sums in a fixed order: the same numbers give the
//! same bits every time.

use getup_policy::NORM_EPSILON;
use multiversion::multiversion;

use super::layout::LANES;
use super::math;

/// Adds a number to every row.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn add_bias(values: &mut [f32], bias: &[f32], rows: usize) {
    for (row, bias) in values.chunks_exact_mut(rows).zip(bias) {
        row.iter_mut().for_each(|value| *value += *bias);
    }
}

/// Adds a number to every row and keeps what is positive.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn add_bias_relu(values: &mut [f32], bias: &[f32], rows: usize) {
    for (row, bias) in values.chunks_exact_mut(rows).zip(bias) {
        // NaN stays NaN, as it must to be noticed: `max` would drop it.
        row.iter_mut().for_each(|value| {
            let sum = *value + *bias;
            *value = if sum < 0.0 { 0.0 } else { sum };
        });
    }
}

/// `to = from + bias`, row by row.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn copy_with_bias(from: &[f32], bias: &[f32], rows: usize, to: &mut [f32]) {
    for ((to, from), bias) in to.chunks_exact_mut(rows).zip(from.chunks_exact(rows)).zip(bias) {
        to.iter_mut().zip(from).for_each(|(to, from)| *to = *from + *bias);
    }
}

/// `N` numbers of a matrix whose rows are whole lanes.
#[inline(always)]
fn part<T, const N: usize>(values: &[T], start: usize) -> &[T; N] {
    values[start..].first_chunk().expect("rows are whole lanes")
}

/// The sum of every row: the gradient of a bias.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn row_sums(values: &[f32], rows: usize, sums: &mut [f32]) {
    for (row, sum) in values.chunks_exact(rows).zip(sums) {
        *sum = row_sum(row);
    }
}

/// The sum of squares, in a fixed order.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn squares(values: &[f32]) -> f32 {
    let (parts, rest) = values.as_chunks::<{ 4 * LANES }>();
    let mut sums = [0.0f32; 4 * LANES];
    for part in parts {
        for i in 0..4 * LANES {
            sums[i] += part[i] * part[i];
        }
    }
    total(&sums) + rest.iter().map(|value| value * value).sum::<f32>()
}

/// The sum of numbers, in a fixed order.
#[inline(always)]
pub(super) fn row_sum(values: &[f32]) -> f32 {
    let (parts, rest) = values.as_chunks::<{ 4 * LANES }>();
    let mut sums = [0.0f32; 4 * LANES];
    for part in parts {
        for i in 0..4 * LANES {
            sums[i] += part[i];
        }
    }
    for (sum, value) in sums.iter_mut().zip(rest) {
        *sum += value;
    }
    total(&sums)
}

/// The sum of partial sums, in a fixed order. On its own: what is inlined around it would else be compiled to vectors of
/// its last steps.
#[inline(never)]
fn total<const N: usize>(sums: &[f32; N]) -> f32 {
    let mut sums = *sums;
    let mut length = N;
    while length > 1 {
        length /= 2;
        for i in 0..length {
            sums[i] += sums[i + length];
        }
    }
    sums[0]
}

/// What a layer norm needs to know of every transition: `mean` over the features, and `inverse` = 1 / √(variance + ε),
/// `[R]` each.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn moments(x: &[f32], mean: &mut [f32], inverse: &mut [f32]) {
    let rows = mean.len();
    let scale = 1.0 / (x.len() / rows) as f32;
    mean.fill(0.0);
    for x in x.chunks_exact(rows) {
        mean.iter_mut().zip(x).for_each(|(mean, x)| *mean += x);
    }
    mean.iter_mut().for_each(|mean| *mean *= scale);
    inverse.fill(0.0);
    for x in x.chunks_exact(rows) {
        for ((sum, mean), x) in inverse.iter_mut().zip(&*mean).zip(x) {
            let deviation = x - mean;
            *sum += deviation * deviation;
        }
    }
    inverse.iter_mut().for_each(|sum| *sum = 1.0 / (*sum * scale + NORM_EPSILON).sqrt());
}

/// Adds the gradient of a layer norm's input to `to`, given that of its result. `parameters` receives the gradients
/// of weight and bias, where they are asked for.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn layer_norm_gradient(
    gradient: &[f32],
    weight: &[f32],
    normal: &[f32],
    inverse: &[f32],
    to: &mut [f32],
    parameters: Option<(&mut [f32], &mut [f32])>,
) {
    /// A few vectors side by side, so that one sum need not wait for another.
    const WIDE: usize = 4 * LANES;
    let rows = inverse.len();
    let wide = rows - rows % WIDE;
    for start in (0..wide).step_by(WIDE) {
        input_gradient::<WIDE>(gradient, weight, normal, inverse, to, start);
    }
    for start in (wide..rows).step_by(LANES) {
        input_gradient::<LANES>(gradient, weight, normal, inverse, to, start);
    }
    let Some((weights, biases)) = parameters else { return };
    for row in 0..weight.len() {
        let (mut weight, mut bias) = ([0.0f32; LANES], [0.0f32; LANES]);
        let (gradient, normal) = (&gradient[row * rows..][..rows], &normal[row * rows..][..rows]);
        for (gradient, normal) in gradient.chunks_exact(LANES).zip(normal.chunks_exact(LANES)) {
            (0..LANES).for_each(|lane| {
                weight[lane] += gradient[lane] * normal[lane];
                bias[lane] += gradient[lane];
            });
        }
        weights[row] = total(&weight);
        biases[row] = total(&bias);
    }
}

/// [`layer_norm_gradient`] by the input, for `N` transitions from `start` on.
#[inline(always)]
fn input_gradient<const N: usize>(
    gradient: &[f32],
    weight: &[f32],
    normal: &[f32],
    inverse: &[f32],
    to: &mut [f32],
    start: usize,
) {
    let (rows, scale) = (inverse.len(), 1.0 / weight.len() as f32);
    let (mut sums, mut products) = ([0.0f32; N], [0.0f32; N]);
    for (row, weight) in weight.iter().enumerate() {
        let (gradient, normal): (&[f32; N], &[f32; N]) =
            (part(gradient, row * rows + start), part(normal, row * rows + start));
        for i in 0..N {
            let weighted = gradient[i] * weight;
            sums[i] += weighted;
            products[i] += weighted * normal[i];
        }
    }
    let inverse: &[f32; N] = part(inverse, start);
    for i in 0..N {
        sums[i] *= scale;
        products[i] *= scale;
    }
    for (row, weight) in weight.iter().enumerate() {
        let at = row * rows + start;
        let (gradient, normal): (&[f32; N], &[f32; N]) = (part(gradient, at), part(normal, at));
        let to: &mut [f32; N] = to[at..].first_chunk_mut().expect("rows are whole lanes");
        for i in 0..N {
            to[i] += inverse[i] * (gradient[i] * weight - (sums[i] + normal[i] * products[i]));
        }
    }
}

/// Normalises features in place: `(x − mean) / std`, clipped to ±`clip`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn normalize(values: &mut [f32], rows: usize, mean: &[f32], std: &[f32], clip: f32) {
    for ((row, mean), std) in values.chunks_exact_mut(rows).zip(mean).zip(std) {
        row.iter_mut().for_each(|value| *value = ((*value - *mean) / *std).clamp(-clip, clip));
    }
}

/// One motor of a policy over all transitions, `[R]` each: what the heads gave, and the noise.
pub(super) struct Motor<'a> {
    pub(super) mean: &'a [f32],
    /// The head's result, before it is squashed into the range of log standard deviations.
    pub(super) raw_log_std: &'a [f32],
    pub(super) noise: &'a [f32],
    pub(super) beta: &'a [f32],
}

/// ln √(2π), of the Gaussian's density.
const LOG_SQRT_2PI: f32 = 0.918_938_5;
/// Half the range of log standard deviations.
const HALF_RANGE: f32 = (getup_policy::LOG_STD_MAX - getup_policy::LOG_STD_MIN) / 2.0;

#[inline(always)]
fn log_std(raw: f32) -> (f32, f32) {
    let squashed = math::tanh(raw);
    ((squashed + 1.0) * HALF_RANGE + getup_policy::LOG_STD_MIN, squashed)
}

/// `a = β̂·tanh(u)`, `u = mean + std·noise`; adds `log N(u) − log(1 − tanh²u)` to `log_prob`: without −log β̂, which
/// the caller adds for all motors at once.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn sample<'a>(motor: &Motor<'a>, action: &mut [f32], log_prob: &mut [f32]) {
    let rows = action.len();
    let Motor { mean, raw_log_std, noise, beta } = motor;
    let (mean, raw, noise, beta) = (&mean[..rows], &raw_log_std[..rows], &noise[..rows], &beta[..rows]);
    let log_prob = &mut log_prob[..rows];
    for i in 0..rows {
        let (log_std, _) = log_std(raw[i]);
        let u = mean[i] + math::exp(log_std) * noise[i];
        // log(1 − tanh²u) = 2 (log 2 − u − softplus(−2u)), which does not round to log 0.
        let log_slope = 2.0 * (std::f32::consts::LN_2 - u - math::softplus(-2.0 * u));
        log_prob[i] += -0.5 * noise[i] * noise[i] - log_std - LOG_SQRT_2PI - log_slope;
        action[i] = beta[i] * math::tanh(u);
    }
}

/// The gradients of one motor's heads of the loss `α·log π(a|s) / B − Q(s, a) / B`.
///
/// `action`: that of −Q / B by the action; `share`: α / B a transition, 0 for padding.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn sample_gradient<'a>(
    motor: &Motor<'a>,
    action: &[f32],
    share: &[f32],
    mean_gradient: &mut [f32],
    log_std_gradient: &mut [f32],
) {
    let rows = action.len();
    let Motor { mean, raw_log_std, noise, beta } = motor;
    let (mean, raw, noise, beta) = (&mean[..rows], &raw_log_std[..rows], &noise[..rows], &beta[..rows]);
    let (share, mean_gradient) = (&share[..rows], &mut mean_gradient[..rows]);
    let log_std_gradient = &mut log_std_gradient[..rows];
    for i in 0..rows {
        let (log_std, squashed) = log_std(raw[i]);
        let spread = math::exp(log_std) * noise[i];
        let tanh = math::tanh(mean[i] + spread);
        let by_u = share[i] * 2.0 * tanh + action[i] * beta[i] * (1.0 - tanh * tanh);
        mean_gradient[i] = by_u;
        log_std_gradient[i] = (by_u * spread - share[i]) * HALF_RANGE * (1.0 - squashed * squashed);
    }
}

/// `to += from`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn add(to: &mut [f32], from: &[f32]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += from;
    }
}
