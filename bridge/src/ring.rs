//! Preallocated rings between threads.

use std::mem::MaybeUninit;

use crate::recorder::Recorded;

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

/// Records of any type in a ring, to compile the consumer once.
pub(crate) trait WaitingRecords: Send {
    /// Passes on at most `most` records, the oldest first.
    fn take(&mut self, most: usize, each: &mut dyn FnMut(&dyn Recorded));

    fn waiting(&self) -> usize;

    /// Return whether the producer is gone.
    fn is_abandoned(&self) -> bool;
}

impl<R: Recorded> WaitingRecords for rtrb::Consumer<R> {
    fn take(&mut self, most: usize, each: &mut dyn FnMut(&dyn Recorded)) {
        for _ in 0..most {
            let Ok(record) = self.pop() else { break };
            each(&record);
        }
    }

    fn waiting(&self) -> usize {
        self.slots()
    }

    fn is_abandoned(&self) -> bool {
        rtrb::Consumer::is_abandoned(self)
    }
}
