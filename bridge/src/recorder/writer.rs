//! The thread that writes: it may wait for a disk, the loop may not.

use std::{io::Write, sync::atomic::Ordering, thread, time::Duration};

use super::{McapFile, Note, Progress, Recorded, RecordingEnd};

/// How long an empty ring is left alone: a small part of the time in which it fills.
const PAUSE: Duration = Duration::from_millis(20);

/// Records of a chunk of the file, after which the disk is looked at; a run that is killed loses one.
pub(super) const CHUNK: u64 = 256;

/// Chunks of one size; those that follow are twice as large, up to [`MAX_CHUNK`]. The index of the file is kept in
/// memory until its end, some 750 bytes a chunk: 3 MB in the first hour at 1 kHz, then 0.7 MB an hour.
const CHUNKS_OF_A_SIZE: u64 = 1024;
/// Records of the largest chunk, 4 s at 1 kHz.
const MAX_CHUNK: u64 = 4096;

/// Writes records until the other end of the ring is gone and all are written, or the disk has had enough.
pub(super) fn write_while_open<R: Recorded>(
    file: McapFile<impl Write>,
    (mut records, mut notes): (rtrb::Consumer<R>, rtrb::Consumer<Note>),
    progress: &Progress,
    is_full: &dyn Fn() -> bool,
) {
    let mut file = Some(file);
    let (mut taken, mut chunks, mut chunk_end) = (0, 0, CHUNK);
    loop {
        // Looked at first: what was pushed before the end is seen below.
        let is_last = records.is_abandoned();
        while let Ok(record) = records.pop() {
            if let Some(open) = &mut file {
                open.write(&record);
                taken += 1;
                if taken == chunk_end {
                    look_at_disk(&mut file, taken, progress, is_full);
                    chunks += 1;
                    chunk_end += (CHUNK << (chunks / CHUNKS_OF_A_SIZE).min(8)).min(MAX_CHUNK);
                }
            }
        }
        while let Ok(note) = notes.pop() {
            if let Some(open) = &mut file {
                open.note(&note);
            }
        }
        if is_last {
            look_at_disk(&mut file, taken, progress, is_full);
            break;
        }
        thread::sleep(PAUSE);
    }
    if let Some(open) = file {
        match open.finish() {
            Some(number) => progress.set_end(RecordingEnd::Refused(number)),
            None => progress.written.store(taken, Ordering::Relaxed),
        }
    }
}

/// Has what was written so far taken by the system; closes the file where that fails or little space is left.
fn look_at_disk(
    file: &mut Option<McapFile<impl Write>>,
    taken: u64,
    progress: &Progress,
    is_full: &dyn Fn() -> bool,
) {
    if taken == progress.written.load(Ordering::Relaxed) {
        return;
    }
    let Some(open) = file else { return };
    if let Some(number) = open.flush() {
        progress.set_end(RecordingEnd::Refused(number));
        *file = None;
        return;
    }
    progress.written.store(taken, Ordering::Relaxed);
    if is_full() {
        progress.set_end(RecordingEnd::LowSpace);
        // What is there becomes a whole file: the index at its end is small.
        let _ = file.take().map(McapFile::finish);
    }
}
