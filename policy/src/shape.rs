//! What a network looks like: its layers, in order, with the names of their tensors.
//!
//! The learner's network and the actor's forward pass are both built from [`PolicyShape::tensors`].

use std::fmt;

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

impl fmt::Display for PolicyShape {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { observation, action, body } = self;
        write!(formatter, "{observation} numbers in, {action} motors, ")?;
        match body {
            Body::Mlp { hidden } => write!(formatter, "hidden layers of {hidden:?}"),
            Body::Simba { width, blocks } => write!(formatter, "SimBa of width {width}, {blocks} blocks"),
        }
    }
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
        let mut add = |name: &str, weight: Vec<usize>| {
            let outputs = weight[0];
            tensors.push((format!("{name}.weight"), weight));
            tensors.push((format!("{name}.bias"), vec![outputs]));
        };
        match self {
            Body::Mlp { hidden } => {
                let widths = std::iter::once(&inputs).chain(hidden);
                for (index, (from, to)) in widths.zip(hidden).enumerate() {
                    add(&format!("body.{index}"), vec![*to, *from]);
                }
            }
            Body::Simba { width, blocks } => {
                add("body.embed", vec![*width, inputs]);
                for block in 0..*blocks {
                    add(&format!("body.{block}.norm"), vec![*width]);
                    add(&format!("body.{block}.up"), vec![4 * width, *width]);
                    add(&format!("body.{block}.down"), vec![*width, 4 * width]);
                }
                add("body.norm", vec![*width]);
            }
        }
        tensors
    }
}

impl PolicyShape {
    /// What is wrong with a shape that no learner makes, such as one read from a damaged file: a width of 0 or more
    /// than 16384, or more than 64 layers.
    pub fn fault(&self) -> Option<String> {
        let (widths, layers) = match &self.body {
            Body::Mlp { hidden } => (hidden.clone(), hidden.len()),
            Body::Simba { width, blocks } => (vec![*width], *blocks),
        };
        let mut widths = widths.into_iter().chain([self.observation, self.action]);
        match widths.find(|width| !(1..=16_384).contains(width)) {
            Some(width) => Some(format!("its shape has a width of {width}, which is not from 1 to 16384")),
            None if layers > 64 => Some(format!("its shape has {layers} layers or blocks, more than 64")),
            None => None,
        }
    }

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
