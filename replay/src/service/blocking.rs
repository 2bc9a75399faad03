//! Work that blocks, within a task.

use tokio::runtime::{Handle, RuntimeFlavor};

/// Does `work`, which may wait for the disk or a lock. Other tasks go on meanwhile, on another thread; in a runtime of one
/// thread, as a simulation's machines are, those that can go on do so first, and then wait.
pub(super) async fn blocking<T>(work: impl FnOnce() -> T) -> T {
    match Handle::current().runtime_flavor() {
        RuntimeFlavor::CurrentThread => {
            tokio::task::yield_now().await;
            work()
        }
        _ => tokio::task::block_in_place(work),
    }
}
