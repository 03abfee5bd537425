//! Recording of a run in virtual time, which waits for the disk.

use std::{fs::File, io, marker::PhantomData};

use super::{CHUNK, Note, Recorded, RecorderSettings, file, file::McapFile};
use crate::ladder::{Diagnosis, DiagnosisReport};

/// Recorder that writes every record and waits for the disk.
pub(crate) struct WaitingRecorder<R> {
    file: McapFile<File>,
    taken: u64,
    refused: Option<i32>,
    diagnosis: DiagnosisReport,
    records: PhantomData<R>,
}

impl<R: Recorded> WaitingRecorder<R> {
    /// Open the file and write its head; log times count from the start of the run.
    pub(crate) fn begin(settings: &RecorderSettings) -> io::Result<Self> {
        let out = file::create(&settings.path)?;
        let mut file = McapFile::begin(out, &R::any(), settings.security, &settings.scene);
        file.begin_at_zero();
        let diagnosis = DiagnosisReport::new(0);
        Ok(Self { file, taken: 0, refused: None, diagnosis, records: PhantomData })
    }

    /// Write a record, and the reason why the sides are not coupled.
    pub(crate) fn take(&mut self, record: &R, newest: Option<&Diagnosis>) {
        self.file.write(record);
        self.note(record.time_ns(), newest, false);
        self.taken += 1;
        if self.taken.is_multiple_of(CHUNK) {
            self.refused = self.refused.or(self.file.flush());
        }
    }

    fn note(&mut self, time_ns: u64, newest: Option<&Diagnosis>, is_end: bool) {
        if let Some(diagnosis) = self.diagnosis.settled(time_ns, newest, is_end) {
            self.file.note(&Note { time_ns, diagnosis });
        }
    }

    /// Write the end.
    pub(crate) fn finish(mut self, time_ns: u64, newest: Option<&Diagnosis>) -> io::Result<()> {
        self.note(time_ns, newest, true);
        let refused = self.refused;
        match refused.or(self.file.finish()) {
            Some(number) => Err(io::Error::from_raw_os_error(number)),
            None => Ok(()),
        }
    }
}
