//! Memory of the update: many buffers to a region, and regions on huge pages, since a pass over hundreds of small
//! pages waits for their addresses.

use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};

use bytemuck::Pod;
use bytes::BytesMut;

/// Bytes of a cache line and of the widest vector: where buffers begin.
const ALIGNMENT: usize = 64;
/// Bytes of a huge page.
const HUGE_PAGE: usize = 2 << 20;

/// Where buffers are cut from. What a region's buffers did not need is given back with the last of them.
#[derive(Default)]
pub(super) struct Memory {
    /// What is left of the newest region, at a cache line.
    rest: BytesMut,
}

/// Numbers in memory aligned for the widest vectors.
pub(super) struct Buffer<T> {
    bytes: BytesMut,
    numbers: PhantomData<T>,
}

impl Memory {
    /// `length` zeros.
    pub(super) fn zeros<T: Pod>(&mut self, length: usize) -> Buffer<T> {
        let size = length * size_of::<T>();
        // A cache line apart: buffers of the same power of two would else compete for the same places in the cache.
        let taken = size.next_multiple_of(ALIGNMENT) + ALIGNMENT;
        if taken > self.rest.len() {
            self.rest = region(taken.next_multiple_of(HUGE_PAGE));
        }
        let mut bytes = self.rest.split_to(taken);
        bytes.truncate(size);
        Buffer { bytes, numbers: PhantomData }
    }
}

/// `size` bytes of zeros, whole huge pages.
fn region(size: usize) -> BytesMut {
    // Memory that nothing has touched yet: its pages are made when they are.
    let mut bytes = BytesMut::zeroed(size + HUGE_PAGE);
    let _ = bytes.split_to(bytes.as_ptr().align_offset(HUGE_PAGE));
    bytes.truncate(size);
    #[cfg(target_os = "linux")]
    // SAFETY: the pages from there on are this region's alone; the advice changes nothing of what they hold. Where
    // the kernel declines it, pages stay small.
    unsafe {
        libc::madvise(bytes.as_mut_ptr().cast(), size, libc::MADV_HUGEPAGE);
    }
    bytes
}

impl<T: Pod> Deref for Buffer<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        bytemuck::cast_slice(&self.bytes)
    }
}

impl<T: Pod> DerefMut for Buffer<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        bytemuck::cast_slice_mut(&mut self.bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_are_zeros_of_their_own_at_cache_lines_however_large() {
        let mut memory = Memory::default();
        let lengths = [1, 0, 16, 100, 3 << 19, 7, 3 << 20];
        let mut buffers: Vec<Buffer<u32>> = lengths.iter().map(|length| memory.zeros(*length)).collect();
        drop(memory);
        for (number, (buffer, length)) in buffers.iter_mut().zip(lengths).enumerate() {
            assert_eq!(buffer.len(), length);
            assert!(buffer.as_ptr().addr().is_multiple_of(ALIGNMENT));
            assert!(buffer.iter().all(|value| *value == 0), "buffer {number}");
            buffer.fill(number as u32 + 1);
        }
        for (number, buffer) in buffers.iter().enumerate() {
            assert!(buffer.iter().all(|value| *value == number as u32 + 1), "buffer {number}");
        }
    }
}
