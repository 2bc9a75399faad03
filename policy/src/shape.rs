//! What a network looks like: its layers, in order, with the names of their tensors.
//!
//! The learner's network and the actor's forward pass are both built from [`PolicyShape::tensors`].

use serde::{Deserialize, Serialize};

/// The log standard deviation is squashed by a tanh into this range (App. D).
pub const LOG_STD_MIN: f32 = -5.0;
/// See [`LOG_STD_MIN`].
pub const LOG_STD_MAX: f32 = 2.0;

/// The layers between the observation and the heads.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Body {
    /// Fully connected layers with a ReLU after each.
    Mlp {
        /// Widths of the hidden layers.
        hidden: Vec<usize>,
    },
    /// Residual blocks behind layer norms (SimBa).
    Simba {
        /// Width of the residual stream.
        width: usize,
        /// Blocks.
        blocks: usize,
    },
}

/// LayerNorm epsilon.
pub const NORM_EPSILON: f32 = 1e-5;

/// The shape of a squashed Gaussian policy: observation → body → mean and log standard deviation.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyShape {
    /// Numbers in an observation.
    pub observation: usize,
    /// Numbers in an action.
    pub action: usize,
    /// The layers between.
    pub body: Body,
}

impl Body {
    /// Width of what the body gives to the heads.
    pub fn output_width(&self, inputs: usize) -> usize {
        match self {
            Body::Mlp { hidden } => hidden.last().copied().unwrap_or(inputs),
            Body::Simba { width, .. } => *width,
        }
    }

    /// Names and shapes of the body's tensors, in order.
    pub fn tensors(&self, inputs: usize) -> Vec<(String, Vec<usize>)> {
        let mut tensors = Vec::new();
        let mut linear = |name: &str, from: usize, to: usize| {
            tensors.push((format!("{name}.weight"), if from == 0 { vec![to] } else { vec![to, from] }));
            tensors.push((format!("{name}.bias"), vec![to]));
        };
        match self {
            Body::Mlp { hidden } => {
                let widths = std::iter::once(&inputs).chain(hidden);
                for (index, (from, to)) in widths.zip(hidden).enumerate() {
                    linear(&format!("body.{index}"), *from, *to);
                }
            }
            Body::Simba { width, blocks } => {
                linear("body.embed", inputs, *width);
                for block in 0..*blocks {
                    linear(&format!("body.{block}.norm"), 0, *width);
                    linear(&format!("body.{block}.up"), *width, 4 * width);
                    linear(&format!("body.{block}.down"), 4 * width, *width);
                }
                linear("body.norm", 0, *width);
            }
        }
        tensors
    }
}

impl PolicyShape {
    /// Names and shapes of all tensors, in order.
    pub fn tensors(&self) -> Vec<(String, Vec<usize>)> {
        let mut tensors = self.body.tensors(self.observation);
        let width = self.body.output_width(self.observation);
        for head in ["head.mean", "head.log_std"] {
            tensors.push((format!("{head}.weight"), vec![self.action, width]));
            tensors.push((format!("{head}.bias"), vec![self.action]));
        }
        tensors
    }
}
