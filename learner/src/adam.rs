//! AdamW (Kingma & Ba 2015, Loshchilov & Hutter 2019), in PyTorch's form, on flat buffers of our own: tch's optimizers hide their moments,
//! and a checkpoint must hold them.

use serde::{Deserialize, Serialize};
use tch::Tensor;

use crate::cpu::AdamStep;
use crate::parameters::{Parameters, as_slice_mut};

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

/// The state of AdamW for one [`Parameters`].
pub(crate) struct Adam {
    pub(crate) learning_rate: f64,
    /// Share of every parameter that decays with a step, in units of the learning rate.
    pub(crate) weight_decay: f64,
    /// Steps taken.
    pub(crate) steps: u64,
    /// `[n]`, running mean of the gradient.
    pub(crate) first: Tensor,
    /// `[n]`, running mean of its square.
    pub(crate) second: Tensor,
}

/// The factors of one step that depend on the number of steps alone.
struct Factors {
    /// Learning rate over the first moment's bias correction.
    step: f64,
    /// Square root of the second moment's bias correction.
    root: f64,
}

fn factors(learning_rate: f64, steps: u64) -> Factors {
    let power = |beta: f64| 1.0 - beta.powf(steps as f64);
    Factors { step: learning_rate / power(BETA1), root: power(BETA2).sqrt() }
}

impl Adam {
    pub(crate) fn new(parameters: &Parameters, learning_rate: f64, weight_decay: f64) -> Self {
        let zeros = || parameters.flat().zeros_like();
        Self { learning_rate, weight_decay, steps: 0, first: zeros(), second: zeros() }
    }

    /// Counts a step; its factors, for who takes it on slices.
    pub(crate) fn begin_step(&mut self) -> AdamStep {
        self.steps += 1;
        let Factors { step, root } = factors(self.learning_rate, self.steps);
        AdamStep {
            rate: step as f32,
            root: (1.0 / root) as f32,
            decay: (self.learning_rate * self.weight_decay) as f32,
            beta1: BETA1 as f32,
            beta2: BETA2 as f32,
            epsilon: EPSILON as f32,
        }
    }

    /// The moments, `[n]` each, where they are on the host.
    pub(crate) fn moments(&mut self) -> (&mut [f32], &mut [f32]) {
        (as_slice_mut(&mut self.first), as_slice_mut(&mut self.second))
    }

    /// One step along `gradient`, `[n]`.
    pub(crate) fn step(&mut self, parameters: &mut Parameters, gradient: &Tensor) {
        self.steps += 1;
        let factors = factors(self.learning_rate, self.steps);
        let mut flat = parameters.flat().shallow_clone();
        let _guard = tch::no_grad_guard();
        let _ = self.first.g_mul_scalar_(BETA1).g_add_(&(gradient * (1.0 - BETA1)));
        let _ = self.second.g_mul_scalar_(BETA2).g_add_(&(gradient.square() * (1.0 - BETA2)));
        let change = &self.first * factors.step / (self.second.sqrt() / factors.root + EPSILON);
        let _ = flat.g_mul_scalar_(1.0 - self.learning_rate * self.weight_decay).g_sub_(&change);
    }
}

/// Adam for a single number, such as the temperature's logarithm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct ScalarAdam {
    pub(crate) learning_rate: f64,
    steps: u64,
    first: f64,
    second: f64,
}

impl ScalarAdam {
    pub(crate) fn new(learning_rate: f64) -> Self {
        Self { learning_rate, steps: 0, first: 0.0, second: 0.0 }
    }

    /// The value after one step along `gradient`.
    pub(crate) fn step(&mut self, value: f64, gradient: f64) -> f64 {
        self.steps += 1;
        self.first = BETA1 * self.first + (1.0 - BETA1) * gradient;
        self.second = BETA2 * self.second + (1.0 - BETA2) * gradient * gradient;
        let factors = factors(self.learning_rate, self.steps);
        value - factors.step * self.first / (self.second.sqrt() / factors.root + EPSILON)
    }
}

/// `target ← target + τ (source − target)`, Polyak averaging.
pub(crate) fn polyak(target: &mut Parameters, source: &Parameters, tau: f64) {
    let _guard = tch::no_grad_guard();
    let _ = target.flat().shallow_clone().lerp_(source.flat(), tau);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parabola_is_descended_to_its_minimum() {
        let mut adam = ScalarAdam::new(0.05);
        let mut value = 3.0;
        for _ in 0..1000 {
            value = adam.step(value, 2.0 * (value - 1.0));
        }
        assert!((value - 1.0).abs() < 1e-3, "{value}");
    }
}
