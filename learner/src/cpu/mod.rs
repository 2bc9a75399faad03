//! The update of SAC written out for processors: the same mathematics as [`crate::sac`]'s, without autograd.
//!
//! A minibatch is divided over the threads by transitions. Each goes forward and back through its own ([`network`]) on
//! products in bfloat16 or float32 ([`product`], of [`operand`]s). What is computed between two products ([`kernels`], [`math`]) goes
//! straight into the layout that the next one reads ([`layout`]), in memory on huge pages ([`memory`]). The threads'
//! gradients are added in a fixed order, and one pass over the flat buffers does AdamW, Polyak and the layout of the new
//! weights, few outputs at a time ([`step`]); [`update`] is the whole. The heads, the losses and all that is kept stay
//! float32.
//!
//! Given the same number of threads, the same minibatches give the same bits.

mod kernels;
mod layout;
mod math;
mod memory;
mod network;
mod operand;
mod product;
mod step;
mod update;

#[cfg(test)]
mod tests;

pub(crate) use kernels::AdamStep;
pub(crate) use step::Flat;
pub(crate) use update::{CpuUpdate, Inputs, Values};
