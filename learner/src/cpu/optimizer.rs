//! AdamW and Polyak averaging, on runs of parameters and on rows of weights as they are laid out.

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

use multiversion::multiversion;

#[cfg(target_arch = "x86_64")]
use super::layout::LANES;
use super::rows::Rows;
#[cfg(target_arch = "x86_64")]
use super::rows::{load, store};

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
pub(super) fn adam(
    step: AdamStep,
    values: &mut [f32],
    gradient: &[f32],
    first: &mut [f32],
    second: &mut [f32],
) {
    let length = values.len();
    assert!(gradient.len() == length && first.len() == length && second.len() == length);
    let mut done = 0;
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the processor has it.
        done = unsafe { adam_vectors(step, values, gradient, first, second) };
    }
    adam_numbers(step, &mut values[done..], &gradient[done..], &mut first[done..], &mut second[done..]);
}

#[multiversion(targets("x86_64+avx2+fma"))]
pub(super) fn adam_numbers(
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

/// [`adam`] as far as whole vectors go; how far that is.
///
/// # Safety
/// The processor has AVX-512 F.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn adam_vectors(
    step: AdamStep,
    values: &mut [f32],
    gradient: &[f32],
    first: &mut [f32],
    second: &mut [f32],
) -> usize {
    let whole = values.len() - values.len() % LANES;
    for at in (0..whole).step_by(LANES) {
        // SAFETY: as the caller promises.
        unsafe { adam_lanes(step, values, gradient, first, second, at) };
    }
    whole
}

/// [`adam`] for lanes from `at` on; the new values. The root and the quotient are the processor's estimates, refined by a
/// step of Newton's: to within float32's rounding, in a third of the time.
///
/// # Safety
/// The processor has AVX-512 F.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn adam_lanes(
    step: AdamStep,
    values: &mut [f32],
    gradient: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    at: usize,
) -> __m512 {
    let AdamStep { rate, root, decay, beta1, beta2, epsilon } = step;
    // SAFETY: as the caller promises.
    unsafe {
        let (g, value) = (load(gradient, at), load(values, at));
        let (m, v) = (load(first, at), load(second, at));
        let share = _mm512_mul_ps(_mm512_set1_ps(1.0 - beta1), g);
        let m = _mm512_fmadd_ps(_mm512_set1_ps(beta1), m, share);
        let share = _mm512_mul_ps(_mm512_mul_ps(_mm512_set1_ps(1.0 - beta2), g), g);
        let v = _mm512_fmadd_ps(_mm512_set1_ps(beta2), v, share);
        // √v ≈ v·r, r ≈ 1/√v: plus r (v − (v·r)²) / 2.
        let r = _mm512_rsqrt14_ps(_mm512_max_ps(v, _mm512_set1_ps(f32::MIN_POSITIVE)));
        let estimate = _mm512_mul_ps(v, r);
        let error = _mm512_fnmadd_ps(estimate, estimate, v);
        let deviation = _mm512_fmadd_ps(_mm512_mul_ps(_mm512_set1_ps(0.5), r), error, estimate);
        // 1/d ≈ q: q (2 − d·q).
        let divisor = _mm512_fmadd_ps(deviation, _mm512_set1_ps(root), _mm512_set1_ps(epsilon));
        let q = _mm512_rcp14_ps(divisor);
        let q = _mm512_mul_ps(q, _mm512_fnmadd_ps(divisor, q, _mm512_set1_ps(2.0)));
        let change = _mm512_mul_ps(_mm512_mul_ps(_mm512_set1_ps(rate), m), q);
        let value = _mm512_sub_ps(_mm512_fnmadd_ps(_mm512_set1_ps(decay), value, value), change);
        store(first, at, m);
        store(second, at, v);
        store(values, at, value);
        value
    }
}

/// Rows of weights, `[outputs, inputs]`, as a step of AdamW makes them: asking for a number takes its step.
pub(super) struct AdamRows<'a> {
    pub(super) step: AdamStep,
    pub(super) inputs: usize,
    /// From output `start` on.
    pub(super) start: usize,
    pub(super) values: &'a mut [f32],
    pub(super) first: &'a mut [f32],
    pub(super) second: &'a mut [f32],
    pub(super) gradient: &'a [f32],
}

impl Rows for AdamRows<'_> {
    #[inline(always)]
    fn part<'a>(&mut self, row: usize, at: usize, to: &'a mut [f32]) -> &'a [f32]
    where
        Self: 'a,
    {
        let start = (row - self.start) * self.inputs + at;
        let range = start..start + to.len();
        let (values, gradient) = (&mut self.values[range.clone()], &self.gradient[range.clone()]);
        adam(self.step, values, gradient, &mut self.first[range.clone()], &mut self.second[range]);
        to.copy_from_slice(values);
        to
    }

    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    unsafe fn lanes(&mut self, row: usize, at: usize) -> __m512 {
        let at = (row - self.start) * self.inputs + at;
        // SAFETY: as the caller promises.
        unsafe { adam_lanes(self.step, self.values, self.gradient, self.first, self.second, at) }
    }
}

/// Rows of a target network's weights, `[outputs, inputs]`, as Polyak averaging makes them, likewise.
pub(super) struct PolyakRows<'a> {
    pub(super) tau: f32,
    pub(super) inputs: usize,
    /// From output `start` on.
    pub(super) start: usize,
    pub(super) target: &'a mut [f32],
    pub(super) values: &'a [f32],
}

impl Rows for PolyakRows<'_> {
    #[inline(always)]
    fn part<'a>(&mut self, row: usize, at: usize, to: &'a mut [f32]) -> &'a [f32]
    where
        Self: 'a,
    {
        let start = (row - self.start) * self.inputs + at;
        let target = &mut self.target[start..start + to.len()];
        polyak(target, &self.values[start..start + to.len()], self.tau);
        to.copy_from_slice(target);
        to
    }

    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    unsafe fn lanes(&mut self, row: usize, at: usize) -> __m512 {
        let start = (row - self.start) * self.inputs + at;
        // SAFETY: as the caller promises.
        unsafe {
            let (target, value) = (load(self.target, start), load(self.values, start));
            let target = _mm512_fmadd_ps(_mm512_set1_ps(self.tau), _mm512_sub_ps(value, target), target);
            store(self.target, start, target);
            target
        }
    }
}

/// `target ← target + τ (source − target)`, Polyak averaging.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(super) fn polyak(target: &mut [f32], source: &[f32], tau: f32) {
    for (target, source) in target.iter_mut().zip(source) {
        *target += tau * (source - *target);
    }
}
