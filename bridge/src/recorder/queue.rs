//! Records of any type in a ring.

use super::Recorded;

/// Consumer of a ring of records, without their type: its users are compiled once.
pub(crate) trait WaitingRecords: Send {
    /// Pass on at most `most` records, the oldest first.
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
