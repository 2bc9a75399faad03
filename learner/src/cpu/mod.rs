//! The update of SAC written out for processors: the same mathematics as [`crate::sac`]'s, without autograd.
//!
//! A minibatch is divided over the threads ([`team`]) by transitions ([`worker`]). Each goes forward and back through every network
//! ([`network`]; what a pass leaves is a [`trace`]) on products in bfloat16 or float32 ([`product`]). What is computed between
//! two products ([`rows`], [`kernels`], [`math`]) goes straight into the layout that the next one reads ([`layout`], [`transpose`]), for a
//! few features at a time, while they are in the cache; in memory on huge pages ([`memory`]).
//!
//! Passes leave the weights' gradients as their [`factors`]. One pass over the parameters ([`step`]) makes a few outputs'
//! gradient, over all threads' transitions in a fixed order, and uses it up: AdamW, Polyak ([`optimizer`]), the layout of the
//! new [`weights`]. The whole is an [`update`]. The heads, the losses and all that is kept stay float32.
//!
//! Given the same number of threads, the same minibatches give the same bits.

mod factors;
mod kernels;
mod layout;
mod math;
mod memory;
mod network;
mod optimizer;
mod product;
mod rows;
mod step;
mod team;
mod trace;
mod transpose;
mod update;
mod weights;
mod worker;

#[cfg(test)]
mod tests;

pub(crate) use optimizer::AdamStep;
pub(crate) use product::bf16_is_faster;
pub(crate) use step::Flat;
pub(crate) use update::{CpuUpdate, Inputs, Values};
