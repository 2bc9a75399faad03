//! The passes over memory between two products, compiled for AVX-512, AVX2 and the baseline and chosen at run time.
//!
//! Matrices lie feature by feature, `[F, R]`: vectors run along the R transitions, so that a layer norm's sums need
//! no shuffles. Sums over transitions go through [`LANES`] partial sums in a fixed order: the same numbers give the
//! same bits every time.

use getup_policy::NORM_EPSILON;
use multiversion::multiversion;

use super::math;

/// Numbers of the widest vector; R is a multiple of it.
pub(super) const LANES: usize = 16;

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

/// Keeps the gradient where the ReLU's result was positive.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn relu_gradient(gradient: &mut [f32], result: &[f32]) {
    for (gradient, result) in gradient.iter_mut().zip(result) {
        *gradient = if *result > 0.0 { *gradient } else { 0.0 };
    }
}

/// The sum of every row: the gradient of a bias.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn row_sums(values: &[f32], rows: usize, sums: &mut [f32]) {
    for (row, sum) in values.chunks_exact(rows).zip(sums) {
        let mut lanes = [0.0f32; LANES];
        for part in row.chunks_exact(LANES) {
            (0..LANES).for_each(|lane| lanes[lane] += part[lane]);
        }
        *sum = total(&lanes);
    }
}

/// The sum of partial sums, in a fixed order.
#[inline(always)]
fn total(lanes: &[f32; LANES]) -> f32 {
    let mut lanes = *lanes;
    for half in [8, 4, 2, 1] {
        (0..half).for_each(|lane| lanes[lane] += lanes[lane + half]);
    }
    lanes[0]
}

/// Layer norm over the features of every transition: `normal = (x − mean) / √(variance + ε)`,
/// `result = normal · weight + bias`; `inverse`, `[R]`, receives 1 / √(variance + ε).
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn layer_norm(
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    normal: &mut [f32],
    inverse: &mut [f32],
    result: &mut [f32],
) {
    let rows = inverse.len();
    let scale = 1.0 / weight.len() as f32;
    for start in (0..rows).step_by(LANES) {
        let part = |row: usize| row * rows + start..row * rows + start + LANES;
        let mut mean = [0.0f32; LANES];
        for row in 0..weight.len() {
            let x = &x[part(row)];
            (0..LANES).for_each(|lane| mean[lane] += x[lane]);
        }
        (0..LANES).for_each(|lane| mean[lane] *= scale);
        let mut squares = [0.0f32; LANES];
        for row in 0..weight.len() {
            let x = &x[part(row)];
            (0..LANES).for_each(|lane| {
                let deviation = x[lane] - mean[lane];
                squares[lane] += deviation * deviation;
            });
        }
        let inverse = &mut inverse[start..start + LANES];
        (0..LANES).for_each(|lane| inverse[lane] = 1.0 / (squares[lane] * scale + NORM_EPSILON).sqrt());
        for row in 0..weight.len() {
            let (weight, bias) = (weight[row], bias[row]);
            let (x, normal, result) = (&x[part(row)], &mut normal[part(row)], &mut result[part(row)]);
            (0..LANES).for_each(|lane| {
                normal[lane] = (x[lane] - mean[lane]) * inverse[lane];
                result[lane] = normal[lane] * weight + bias;
            });
        }
    }
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
    let rows = inverse.len();
    let scale = 1.0 / weight.len() as f32;
    for start in (0..rows).step_by(LANES) {
        let part = |row: usize| row * rows + start..row * rows + start + LANES;
        let (mut sums, mut products) = ([0.0f32; LANES], [0.0f32; LANES]);
        for row in 0..weight.len() {
            let (weight, gradient, normal) = (weight[row], &gradient[part(row)], &normal[part(row)]);
            (0..LANES).for_each(|lane| {
                let weighted = gradient[lane] * weight;
                sums[lane] += weighted;
                products[lane] += weighted * normal[lane];
            });
        }
        let inverse = &inverse[start..start + LANES];
        for row in 0..weight.len() {
            let (weight, gradient, normal) = (weight[row], &gradient[part(row)], &normal[part(row)]);
            let to = &mut to[part(row)];
            (0..LANES).for_each(|lane| {
                let centred = gradient[lane] * weight - (sums[lane] + normal[lane] * products[lane]) * scale;
                to[lane] += inverse[lane] * centred;
            });
        }
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

/// The factors of one step of Adam.
#[derive(Clone, Copy)]
pub(crate) struct AdamStep {
    /// Learning rate over the first moment's bias correction.
    pub(crate) rate: f32,
    /// The inverse root of the second moment's bias correction.
    pub(crate) root: f32,
    /// Share of every parameter that decays: learning rate × weight decay.
    pub(crate) decay: f32,
    pub(crate) beta1: f32,
    pub(crate) beta2: f32,
    pub(crate) epsilon: f32,
}

/// One step of AdamW (Loshchilov & Hutter 2019) on a run of parameters.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn adam(
    step: AdamStep,
    values: &mut [f32],
    gradient: &[f32],
    first: &mut [f32],
    second: &mut [f32],
) {
    let length = values.len();
    let (gradient, first, second) = (&gradient[..length], &mut first[..length], &mut second[..length]);
    for i in 0..length {
        let g = gradient[i];
        first[i] = step.beta1 * first[i] + (1.0 - step.beta1) * g;
        second[i] = step.beta2 * second[i] + (1.0 - step.beta2) * g * g;
        let change = step.rate * first[i] / (second[i].sqrt() * step.root + step.epsilon);
        values[i] = values[i] - step.decay * values[i] - change;
    }
}

/// `target ← target + τ (source − target)`, Polyak averaging.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn polyak(target: &mut [f32], source: &[f32], tau: f32) {
    for (target, source) in target.iter_mut().zip(source) {
        *target += tau * (source - *target);
    }
}

/// `to += from`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn add(to: &mut [f32], from: &[f32]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += from;
    }
}
