//! The actor and the critics on libtorch, built from the same shapes as `getup-policy`'s forward pass.

use getup_policy::{Body, LOG_STD_MAX, LOG_STD_MIN, Policy, PolicyShape, init};
use rand::Rng;
use tch::{Device, Kind, Tensor};

use getup_policy::NORM_EPSILON;

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
        let hidden = forward(&self.shape.body, observation, body, self.products);
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
    pub(crate) body: Body,
    pub(crate) parameters: Parameters,
    /// Precision of the body's matrix products; the head's are float32, for Q must tell rewards apart.
    products: Kind,
}

impl Critics {
    /// Critics drawn by [`init::body`], with orthogonal heads of gain 1 and zero biases (App. D).
    pub(crate) fn new(
        count: usize,
        body: Body,
        inputs: usize,
        rng: &mut impl Rng,
        products: Kind,
        device: Device,
    ) -> Self {
        let width = body.output_width(inputs);
        let mut values = Vec::new();
        for critic in 0..count {
            let named = |(name, shape, data): (String, Vec<usize>, Vec<f32>)| {
                (format!("{critic}.{name}"), shape, data)
            };
            values.extend(init::body(&body, inputs, rng).into_iter().map(named));
            let head = init::orthogonal(1, width, 1.0, rng);
            values.push((format!("{critic}.head.value.weight"), vec![1, width], head));
            values.push((format!("{critic}.head.value.bias"), vec![1], vec![0.0]));
        }
        Self { count, body, parameters: Parameters::new(values, device), products }
    }

    pub(crate) fn duplicate(&self) -> Self {
        let Self { count, body, parameters, products } = self;
        Self { count: *count, body: body.clone(), parameters: parameters.duplicate(), products: *products }
    }

    /// Q of every critic, `[critics, B]`.
    pub(crate) fn forward(&self, observation: &Tensor, action: &Tensor) -> Tensor {
        let input = Tensor::cat(&[observation, action], 1);
        let leaves: Vec<&Tensor> = self.parameters.leaves().collect();
        let values: Vec<Tensor> = leaves
            .chunks(leaves.len() / self.count)
            .map(|critic| {
                let (body, head) = critic.split_at(critic.len() - 2);
                let features = forward(&self.body, &input, body, self.products);
                features.linear(head[0], Some(head[1])).squeeze_dim(1)
            })
            .collect();
        Tensor::stack(&values, 0)
    }

    /// The minimum over the critics, `[B]`.
    pub(crate) fn minimum(&self, observation: &Tensor, action: &Tensor) -> Tensor {
        self.forward(observation, action).amin(&[0i64][..], false)
    }
}

/// A body over the parameters that [`Body::tensors`] names, with matrix products of `products` and a float32 result.
fn forward(body: &Body, input: &Tensor, parameters: &[&Tensor], products: Kind) -> Tensor {
    let mut pairs = parameters.chunks_exact(2);
    let mut next = || pairs.next().expect("a pair of tensors for every layer of the body");
    let linear = |x: &Tensor, pair: &[&Tensor]| {
        x.to_kind(products).linear(&pair[0].to_kind(products), Some(pair[1].to_kind(products)))
    };
    let norm = |x: &Tensor, pair: &[&Tensor]| {
        x.layer_norm(pair[0].size(), Some(pair[0]), Some(pair[1]), f64::from(NORM_EPSILON), false)
    };
    match body {
        Body::Mlp { hidden } => {
            let layer = |x: Tensor, _: &usize| linear(&x, next()).relu();
            hidden.iter().fold(input.shallow_clone(), layer).to_kind(Kind::Float)
        }
        Body::Simba { blocks, .. } => {
            let mut x = linear(input, next()).to_kind(Kind::Float);
            for _ in 0..*blocks {
                let hidden = norm(&x, next());
                let inner = linear(&hidden, next()).relu();
                // Not `+=`, which would change in place what autograd has kept.
                x = linear(&inner, next()).to_kind(Kind::Float) + &x;
            }
            norm(&x, next())
        }
    }
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
