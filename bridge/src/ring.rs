//! Rings between threads whose memory is there from the start.

use std::mem::MaybeUninit;

/// A ring with room for so many, each of whose pages has been touched: a run does not grow by using it.
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
