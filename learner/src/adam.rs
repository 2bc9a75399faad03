//! Adam (Kingma & Ba 2015), in PyTorch's form, on flat buffers of our own: tch's optimizers hide their moments,
//! and a checkpoint must hold them.

use serde::{Deserialize, Serialize};
use tch::{Device, Tensor};

use crate::parameters::{Parameters, as_slice_mut};

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

/// The state of Adam for one [`Parameters`].
pub(crate) struct Adam {
    pub(crate) learning_rate: f64,
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
    pub(crate) fn new(parameters: &Parameters, learning_rate: f64) -> Self {
        let zeros = || parameters.flat().zeros_like();
        Self { learning_rate, steps: 0, first: zeros(), second: zeros() }
    }

    /// One step along `gradient`, `[n]`.
    pub(crate) fn step(&mut self, parameters: &mut Parameters, gradient: &mut Tensor) {
        self.steps += 1;
        let factors = factors(self.learning_rate, self.steps);
        let mut flat = parameters.flat().shallow_clone();
        if flat.device() == Device::Cpu {
            self.step_in_one_pass(&mut flat, gradient, &factors);
        } else {
            self.step_by_tensors(&mut flat, gradient, &factors);
        }
    }

    fn step_in_one_pass(&mut self, flat: &mut Tensor, gradient: &mut Tensor, factors: &Factors) {
        let (step, root) = (factors.step as f32, factors.root as f32);
        let (beta1, beta2, epsilon) = (BETA1 as f32, BETA2 as f32, EPSILON as f32);
        let parameters = as_slice_mut(flat).iter_mut();
        let moments = as_slice_mut(&mut self.first).iter_mut().zip(as_slice_mut(&mut self.second));
        for ((p, g), (m, v)) in parameters.zip(as_slice_mut(gradient)).zip(moments) {
            *m = beta1 * *m + (1.0 - beta1) * *g;
            *v = beta2 * *v + (1.0 - beta2) * *g * *g;
            *p -= step * *m / (v.sqrt() / root + epsilon);
        }
    }

    fn step_by_tensors(&mut self, flat: &mut Tensor, gradient: &Tensor, factors: &Factors) {
        let _guard = tch::no_grad_guard();
        let _ = self.first.g_mul_scalar_(BETA1).g_add_(&(gradient * (1.0 - BETA1)));
        let _ = self.second.g_mul_scalar_(BETA2).g_add_(&(gradient.square() * (1.0 - BETA2)));
        let change = &self.first * factors.step / (self.second.sqrt() / factors.root + EPSILON);
        let _ = flat.g_sub_(&change);
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
    let (mut target, mut source) = (target.flat().shallow_clone(), source.flat().shallow_clone());
    if target.device() == Device::Cpu {
        let tau = tau as f32;
        for (t, s) in as_slice_mut(&mut target).iter_mut().zip(as_slice_mut(&mut source)) {
            *t += tau * (*s - *t);
        }
    } else {
        let _guard = tch::no_grad_guard();
        let _ = target.lerp_(&source, tau);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pass_over_slices_and_the_tensor_operations_take_the_same_step() {
        let values: Vec<f32> = (0..100).map(|i| (i as f32 * 0.7).sin()).collect();
        let make = || Parameters::new(vec![("w".into(), vec![100], values.clone())], Device::Cpu);
        let (a, b) = (make(), make());
        let (mut one, mut other) = (Adam::new(&a, 1e-2), Adam::new(&b, 1e-2));
        for step in 1..=20 {
            let mut gradient = Tensor::from_slice(&values) * f64::from(step).cos();
            let factors = factors(1e-2, step as u64);
            one.step_in_one_pass(&mut a.flat().shallow_clone(), &mut gradient, &factors);
            other.step_by_tensors(&mut b.flat().shallow_clone(), &gradient, &factors);
            let difference = (a.flat() - b.flat()).abs().max().double_value(&[]);
            assert!(difference < 1e-6, "step {step}: {difference}");
        }
    }

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
