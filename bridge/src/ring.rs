//! Rings between threads whose memory is there from the start.

use std::mem::MaybeUninit;

use crate::recorder::Recorded;

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

/// Records that wait in a ring, of any type: who writes them is compiled once.
pub(crate) trait WaitingRecords: Send {
    /// Hands over at most `most` records, the oldest first.
    fn take(&mut self, most: usize, each: &mut dyn FnMut(&dyn Recorded));

    /// Number of records that wait.
    fn waiting(&self) -> usize;

    /// Whether no more will come.
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
