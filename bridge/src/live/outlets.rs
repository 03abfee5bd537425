//! Where the records of a loop go: to whoever polls, and to the recorder.

use crate::recorder::{Recorder, RecordingReport};

/// Both ways out of the loop; neither is ever waited for.
#[derive(Debug)]
pub(super) struct Outlets<R> {
    polled: rtrb::Producer<R>,
    recorder: Option<Recorder<R>>,
}

impl<R: Copy> Outlets<R> {
    pub(super) fn new(polled: rtrb::Producer<R>, recorder: Option<Recorder<R>>) -> Self {
        Self { polled, recorder }
    }

    /// Hands a record to both; gives it back where nobody polls in time.
    pub(super) fn push(&mut self, record: R) -> Result<(), rtrb::PushError<R>> {
        if let Some(recorder) = &mut self.recorder {
            recorder.take(record);
        }
        self.polled.push(record)
    }

    /// Ends the recording.
    pub(super) fn end(self) -> Option<RecordingReport> {
        self.recorder.map(Recorder::end)
    }
}
