//! The device that networks live on. CUDA's library is opened by name, before libtorch is used for anything
//! else: the build links the CPU's alone.

use std::ffi::CStr;

use crate::config::Device;

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
    #[error("--device cuda: libtorch sees no NVIDIA device (is the driver loaded? see nvidia-smi); use --device cpu")]
    NoDevice,
}

/// Opens the device; for CUDA this must come before any other use of libtorch in the process.
pub fn open_device(device: Device) -> Result<tch::Device, DeviceError> {
    match device {
        Device::Cpu => Ok(tch::Device::Cpu),
        Device::Cuda => {
            open_library(c"libtorch_cuda.so")?;
            if tch::Cuda::is_available() { Ok(tch::Device::Cuda(0)) } else { Err(DeviceError::NoDevice) }
        }
    }
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
