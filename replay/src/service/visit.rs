//! A writer's presence: whoever has the [`Visit`] ends it by dropping it.

use crate::store::Store;
use std::sync::Arc;

/// A writer's presence at the store; ends when dropped.
pub(super) struct Visit {
    pub(super) store: Arc<Store>,
    pub(super) writer: u64,
}

impl Visit {
    /// Introduces the writer; how far its segments are durable.
    pub(super) fn begin(store: Arc<Store>, writer: u64, name: &str) -> (Self, u64) {
        let durable = store.introduce(writer, name);
        (Self { store, writer }, durable)
    }
}

impl Drop for Visit {
    fn drop(&mut self) {
        self.store.farewell(self.writer);
    }
}
