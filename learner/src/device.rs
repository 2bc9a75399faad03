//! The device that networks live on. CUDA's library is opened by name, before libtorch is used for anything
//! else: the build links the CPU's alone.

use std::ffi::CStr;

use crate::config::Device as Configured;

/// Why CUDA was asked for and cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// Its library does not load.
    #[error(
        "--device cuda: libtorch_cuda.so does not load ({0}); install its libraries with `cargo xtask setup \
         --cuda`, or point LD_LIBRARY_PATH at those of a PyTorch 2.11, or use --device cpu"
    )]
    Library(String),
    /// There is no device.
    #[error(
        "--device cuda: libtorch sees no NVIDIA device (is the driver loaded? see nvidia-smi); use --device cpu"
    )]
    NoDevice,
    /// It computes nonsense.
    #[error(
        "libtorch sums four ones to {0}: its installation is broken; remove .native and run `cargo xtask setup`"
    )]
    Wrong(f64),
}

pub use tch::Device;

/// Opens the device, and gives libtorch `threads` threads; for CUDA this must come before any other use of libtorch
/// in the process.
pub fn open(device: Configured, threads: usize) -> Result<Device, DeviceError> {
    let opened = match device {
        Configured::Cpu => return Ok(cpu(threads)),
        Configured::Cuda => {
            open_library(c"libtorch_cuda.so")?;
            if !tch::Cuda::is_available() {
                return Err(DeviceError::NoDevice);
            }
            Device::Cuda(0)
        }
    };
    tch::set_num_threads(threads.try_into().unwrap_or(i32::MAX));
    Ok(opened)
}

/// The processor, with `threads` threads for libtorch: what needs no opening.
pub fn cpu(threads: usize) -> Device {
    tch::set_num_threads(threads.try_into().unwrap_or(i32::MAX));
    Device::Cpu
}

/// Opens the device and lets it compute something; says what it found.
pub fn check(device: Configured) -> Result<String, DeviceError> {
    let opened = open(device, 1)?;
    let sum = tch::Tensor::ones([2, 2], (tch::Kind::Float, opened)).sum(tch::Kind::Float).double_value(&[]);
    if sum == 4.0 { Ok(format!("libtorch works on {opened:?}")) } else { Err(DeviceError::Wrong(sum)) }
}

fn open_library(name: &CStr) -> Result<(), DeviceError> {
    // SAFETY: `name` is NUL-terminated; loading libtorch_cuda runs its initialisers, which register kernels with
    // the libtorch that is loaded already, and the handle is never closed.
    let handle = unsafe { libc::dlopen(name.as_ptr(), libc::RTLD_NOW | libc::RTLD_GLOBAL) };
    if !handle.is_null() {
        return Ok(());
    }
    // SAFETY: after a failed dlopen, dlerror gives a NUL-terminated message that lives until the next call.
    let reason = unsafe {
        let message = libc::dlerror();
        if message.is_null() { "no reason given".into() } else { CStr::from_ptr(message).to_string_lossy() }
    };
    Err(DeviceError::Library(reason.into_owned()))
}
