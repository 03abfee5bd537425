//! Where the records of a loop go: to whoever polls, and to the recorder.

use crate::{
    ladder::Diagnosis,
    recorder::{Recorder, RecordingReport},
};

/// Both ways out of the loop; neither is ever waited for.
#[derive(Debug)]
pub(super) struct RecordSinks<R> {
    polled: rtrb::Producer<R>,
    recorder: Option<Recorder<R>>,
}

impl<R: Copy> RecordSinks<R> {
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

    /// Hands the recording why the two sides are not coupled, since `time_ns` after the start or shortly before.
    pub(super) fn note(&mut self, time_ns: u64, diagnosis: &Diagnosis) {
        if let Some(recorder) = &mut self.recorder {
            recorder.note(time_ns, diagnosis);
        }
    }

    /// Ends the recording.
    pub(super) fn end(self) -> Option<RecordingReport> {
        self.recorder.map(Recorder::end)
    }
}
