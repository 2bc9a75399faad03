//! The actor and the critics on libtorch, built from the same shapes as `getup-policy`'s forward pass.

use getup_policy::{LOG_STD_MAX, LOG_STD_MIN, Policy, PolicyShape, init};
use rand::Rng;
use tch::{Device, Kind, Tensor};

use crate::parameters::Parameters;

/// ln √(2π), of the Gaussian's density.
const LOG_SQRT_2PI: f64 = 0.918_938_533_204_672_7;

/// The squashed Gaussian policy.
pub(crate) struct Actor {
    pub(crate) shape: PolicyShape,
    pub(crate) parameters: Parameters,
    /// Precision of the body's matrix products; the heads' are float32.
    products: Kind,
}

/// Mean and log standard deviation of a Gaussian, `[B, action]` each.
pub(crate) struct Gaussian {
    mean: Tensor,
    log_std: Tensor,
}

/// Actions, `[B, action]`, and their log-probability, `[B]`.
pub(crate) struct Sample {
    pub(crate) action: Tensor,
    pub(crate) log_prob: Tensor,
}

impl Actor {
    pub(crate) fn new(policy: &Policy, products: Kind, device: Device) -> Self {
        let values = policy.shape.tensors().into_iter().map(|(name, shape)| {
            let values = policy.tensor(&name).to_vec();
            (name, shape, values)
        });
        Self { shape: policy.shape.clone(), parameters: Parameters::new(values.collect(), device), products }
    }

    /// The Gaussian at observations `[B, observation]`, normalised before where the run normalises.
    pub(crate) fn forward(&self, observation: &Tensor) -> Gaussian {
        let leaves: Vec<&Tensor> = self.parameters.leaves().collect();
        let (body, heads) = leaves.split_at(leaves.len() - 4);
        let hidden = relu_layers(observation, body, self.products);
        let log_std = hidden.linear(heads[2], Some(heads[3])).tanh();
        let half = f64::from(LOG_STD_MAX - LOG_STD_MIN) / 2.0;
        Gaussian {
            mean: hidden.linear(heads[0], Some(heads[1])),
            log_std: (log_std + 1.0) * half + f64::from(LOG_STD_MIN),
        }
    }
}

impl Gaussian {
    #[cfg(test)]
    pub(crate) fn mean(&self) -> &Tensor {
        &self.mean
    }

    #[cfg(test)]
    pub(crate) fn log_std(&self) -> &Tensor {
        &self.log_std
    }

    /// `a = β̂·tanh(u)`, `u = mean + std·noise`, and `log π(a) = log N(u) − Σ log(β̂·(1 − tanh²u))` (App. D: the
    /// change of variables counts β̂). `beta` is `[B, 1]`, `noise` is `[B, action]`, standard normal.
    pub(crate) fn sample(&self, beta: &Tensor, noise: &Tensor) -> Sample {
        let u = &self.mean + self.log_std.exp() * noise;
        let log_normal = noise.square() * -0.5 - &self.log_std - LOG_SQRT_2PI;
        // log(1 − tanh²u) = 2 (log 2 − u − softplus(−2u)), which does not round to log 0.
        let log_slope = (u.neg() - (&u * -2.0).softplus() + std::f64::consts::LN_2) * 2.0;
        let log_prob = log_normal - log_slope - beta.log();
        let sum = log_prob.sum_dim_intlist(&[1i64][..], false, tch::Kind::Float);
        Sample { action: beta * u.tanh(), log_prob: sum }
    }
}

/// Q functions over (observation, action), each a network of its own.
pub(crate) struct Critics {
    count: usize,
    pub(crate) parameters: Parameters,
    /// Precision of the body's matrix products; the head's are float32, for Q must tell rewards apart.
    products: Kind,
}

impl Critics {
    /// Orthogonal weights with gain 1, zero biases (App. D).
    pub(crate) fn new(
        count: usize,
        policy: &PolicyShape,
        rng: &mut impl Rng,
        products: Kind,
        device: Device,
    ) -> Self {
        let body = &policy.body;
        let inputs = policy.observation + policy.action;
        let mut values = Vec::new();
        for critic in 0..count {
            let mut add = |name: String, from: usize, to: usize| {
                let weight = init::orthogonal(to, from, 1.0, rng);
                values.push((format!("{critic}.{name}.weight"), vec![to, from], weight));
                values.push((format!("{critic}.{name}.bias"), vec![to], vec![0.0; to]));
            };
            for layer in body.layers(inputs) {
                add(layer.name, layer.inputs, layer.outputs);
            }
            add("head.value".into(), body.output_width(inputs), 1);
        }
        Self { count, parameters: Parameters::new(values, device), products }
    }

    pub(crate) fn duplicate(&self) -> Self {
        Self { count: self.count, parameters: self.parameters.duplicate(), products: self.products }
    }

    /// Q of every critic, `[critics, B]`.
    pub(crate) fn forward(&self, observation: &Tensor, action: &Tensor) -> Tensor {
        let input = Tensor::cat(&[observation, action], 1);
        let leaves: Vec<&Tensor> = self.parameters.leaves().collect();
        let values: Vec<Tensor> = leaves
            .chunks(leaves.len() / self.count)
            .map(|critic| {
                let (body, head) = critic.split_at(critic.len() - 2);
                relu_layers(&input, body, self.products).linear(head[0], Some(head[1])).squeeze_dim(1)
            })
            .collect();
        Tensor::stack(&values, 0)
    }

    /// The minimum over the critics, `[B]`.
    pub(crate) fn minimum(&self, observation: &Tensor, action: &Tensor) -> Tensor {
        self.forward(observation, action).amin(&[0i64][..], false)
    }
}

/// Pairs of weight and bias, each followed by a ReLU, with matrix products of `products` and a float32 result.
fn relu_layers(input: &Tensor, layers: &[&Tensor], products: Kind) -> Tensor {
    let layer = |x: Tensor, pair: &[&Tensor]| {
        x.linear(&pair[0].to_kind(products), Some(pair[1].to_kind(products))).relu()
    };
    layers.chunks(2).fold(input.to_kind(products), layer).to_kind(Kind::Float)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_probability_of_all_actions_is_one_for_every_beta() {
        // ∫ π(a) da over (−β̂, β̂), by the midpoint rule; the density is evaluated through the same change of
        // variables that an update uses.
        for (mean, log_std, beta) in [(0.0, -1.0, 1.0), (0.8, -2.0, 0.4), (-1.2, 0.0, 0.7), (0.3, -0.5, 1.6)]
        {
            let cells = 200_000;
            let action: Vec<f64> =
                (0..cells).map(|i| beta * (2.0 * (i as f64 + 0.5) / cells as f64 - 1.0)).collect();
            let u: Vec<f32> = action.iter().map(|a| (a / beta).atanh() as f32).collect();
            let noise: Vec<f32> = u.iter().map(|u| (u - mean as f32) / (log_std as f32).exp()).collect();
            let constant = |value: f64| Tensor::full([cells, 1], value, (Kind::Float, Device::Cpu));
            let gaussian = Gaussian { mean: constant(mean), log_std: constant(log_std) };
            let sample = gaussian.sample(&constant(beta), &Tensor::from_slice(&noise).view([cells, 1]));
            let total = sample.log_prob.exp().sum(Kind::Double).double_value(&[]) * 2.0 * beta / cells as f64;
            assert!((total - 1.0).abs() < 2e-3, "mean {mean}, log std {log_std}, β̂ {beta}: {total}");
        }
    }
}
