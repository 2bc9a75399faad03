//! The parameters of a network in one flat buffer, so that Adam, Polyak averaging and a checkpoint are each one
//! pass over contiguous memory.

use tch::{Device, Kind, Tensor};

/// Named parameters that share one flat storage. Each is a leaf of autograd and a view into [`Parameters::flat`].
pub(crate) struct Parameters {
    /// `[n]`: all parameters, one after another.
    flat: Tensor,
    leaves: Vec<(String, Tensor)>,
}

impl Parameters {
    /// Lays out parameters with the given names, shapes and values (row-major).
    pub(crate) fn new(values: Vec<(String, Vec<usize>, Vec<f32>)>, device: Device) -> Self {
        let all: Vec<f32> = values.iter().flat_map(|(_, _, values)| values).copied().collect();
        let flat = Tensor::from_slice(&all).to_device(device);
        let mut start = 0;
        let leaves = values
            .into_iter()
            .map(|(name, shape, values)| {
                let shape: Vec<i64> = shape.into_iter().map(|side| side as i64).collect();
                let length = values.len() as i64;
                let leaf = flat.narrow(0, start, length).view(shape.as_slice()).detach();
                start += length;
                (name, leaf.set_requires_grad(true))
            })
            .collect();
        Self { flat, leaves }
    }

    /// Another set of the same names, shapes and values, in storage of its own.
    pub(crate) fn duplicate(&self) -> Self {
        Self::new(self.to_values(), self.flat.device())
    }

    /// `[n]`, sharing its storage with every parameter.
    pub(crate) fn flat(&self) -> &Tensor {
        &self.flat
    }

    /// The parameters, in order.
    pub(crate) fn leaves(&self) -> impl Iterator<Item = &Tensor> {
        self.leaves.iter().map(|(_, leaf)| leaf)
    }

    /// Names, shapes and values, in order: what [`Parameters::new`] takes.
    pub(crate) fn to_values(&self) -> Vec<(String, Vec<usize>, Vec<f32>)> {
        let shape = |leaf: &Tensor| leaf.size().into_iter().map(|side| side as usize).collect();
        self.leaves.iter().map(|(name, leaf)| (name.clone(), shape(leaf), to_vec(leaf))).collect()
    }

    /// Gradient of `loss` (a scalar) with respect to every parameter, flattened to `[n]`.
    pub(crate) fn gradient(&self, loss: &Tensor) -> Tensor {
        let leaves: Vec<&Tensor> = self.leaves().collect();
        let gradients = Tensor::run_backward(&[loss], &leaves, false, false);
        Tensor::cat(&gradients.iter().map(|gradient| gradient.reshape([-1])).collect::<Vec<_>>(), 0)
    }

    /// Overwrites all values. The length is the caller's to check.
    #[cfg(test)]
    pub(crate) fn copy_from(&mut self, values: &[f32]) {
        let _guard = tch::no_grad_guard();
        self.flat.copy_(&Tensor::from_slice(values));
    }
}

/// The numbers of a tensor, row-major, on the host.
pub(crate) fn to_vec(tensor: &Tensor) -> Vec<f32> {
    let tensor = tensor.detach().to_device(Device::Cpu).to_kind(Kind::Float).contiguous().view([-1]);
    let mut values = vec![0.0; tensor.numel()];
    let length = values.len();
    tensor.copy_data(&mut values, length);
    values
}

/// The numbers of a contiguous float32 tensor on the CPU, in place.
///
/// The tensor must not be touched otherwise while the slice lives, which the `&mut` on it keeps to.
pub(crate) fn as_slice_mut(tensor: &mut Tensor) -> &mut [f32] {
    assert!(tensor.device() == Device::Cpu && tensor.kind() == Kind::Float && tensor.is_contiguous());
    let length = tensor.numel();
    // SAFETY: the tensor is contiguous float32 in host memory (asserted), so its data pointer is valid for
    // `numel` reads and writes for as long as the tensor is borrowed, and libtorch aligns it for f32.
    unsafe { std::slice::from_raw_parts_mut(tensor.data_ptr().cast::<f32>(), length) }
}
