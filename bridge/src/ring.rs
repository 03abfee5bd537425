//! Preallocated rings between threads.

use std::mem::MaybeUninit;

/// Create a ring and touches its pages, so that use does not grow the process.
pub(crate) fn ring<T>(capacity: usize) -> (rtrb::Producer<T>, rtrb::Consumer<T>) {
    let (mut producer, consumer) = rtrb::RingBuffer::new(capacity);
    if let Ok(mut room) = producer.write_chunk_uninit(capacity) {
        let (first, second) = room.as_mut_slices();
        for slot in first.iter_mut().chain(second) {
            *slot = MaybeUninit::zeroed();
        }
        // Without a commit: nothing was pushed.
    }
    (producer, consumer)
}
