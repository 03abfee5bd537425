//! What is left of a disk, and what it has refused.

use std::{
    fs::File,
    io::{self, Write},
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicI32, Ordering},
    },
};

use rustix::fs::fstatvfs;

/// The disk that a file lies on.
#[derive(Debug)]
pub(super) struct FreeSpace(File);

impl FreeSpace {
    /// Of the disk that a file at `path` lies on, whether it is there or not.
    pub(super) fn beside(path: &Path) -> io::Result<Self> {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        Ok(Self(File::open(folder.unwrap_or(Path::new(".")))?))
    }

    /// Bytes that an ordinary user may still write; of a disk that does not say, all there are.
    pub(super) fn bytes(&self) -> u64 {
        fstatvfs(&self.0).map_or(u64::MAX, |disk| disk.f_bavail.saturating_mul(disk.f_frsize))
    }
}

/// A sink whose first error ends it: what comes after is thrown away, and the error is kept.
///
/// MCAP's writer goes on writing when it is dropped; on a disk that refuses, that must do nothing.
#[derive(Debug)]
pub(super) struct Sink<W> {
    out: W,
    refusal: Refusal,
}

/// The number of a sink's first error, once there was one.
#[derive(Clone, Debug, Default)]
pub(super) struct Refusal(Arc<AtomicI32>);

impl Refusal {
    pub(super) fn number(&self) -> Option<i32> {
        let number = self.0.load(Ordering::Relaxed);
        (number != 0).then_some(number)
    }
}

impl<W: Write> Sink<W> {
    pub(super) fn new(out: W) -> (Self, Refusal) {
        let refusal = Refusal::default();
        (Self { out, refusal: refusal.clone() }, refusal)
    }

    fn try_to<T>(&mut self, instead: T, act: impl FnOnce(&mut W) -> io::Result<T>) -> io::Result<T> {
        if self.refusal.number().is_some() {
            return Ok(instead);
        }
        match act(&mut self.out) {
            Err(error) if error.kind() != io::ErrorKind::Interrupted => {
                let number = error.raw_os_error().unwrap_or(rustix::io::Errno::IO.raw_os_error());
                self.refusal.0.store(number, Ordering::Relaxed);
                Ok(instead)
            }
            result => result,
        }
    }
}

impl<W: Write> Write for Sink<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.try_to(bytes.len(), |out| match out.write(bytes)? {
            0 if !bytes.is_empty() => Err(rustix::io::Errno::NOSPC.into()),
            taken => Ok(taken),
        })
    }

    fn flush(&mut self) -> io::Result<()> {
        self.try_to((), Write::flush)
    }
}
