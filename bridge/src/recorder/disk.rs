//! What is left of a disk, and what it has refused.

use std::{
    fs::{File, OpenOptions, Permissions},
    io::{self, Write},
    os::unix::fs::{OpenOptionsExt, PermissionsExt},
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicI32, Ordering},
    },
};

use rustix::{
    fs::{OFlags, fstatvfs},
    io::Errno,
};

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

/// Opens a file for its owner alone, from its begin.
///
/// A link is not followed: in a folder that others may write to, it would have this process write where they say.
pub(super) fn create(path: &Path) -> io::Result<File> {
    let nofollow = i32::try_from(OFlags::NOFOLLOW.bits()).unwrap_or(0);
    let mut options = OpenOptions::new();
    let opened =
        options.write(true).create(true).truncate(true).mode(0o600).custom_flags(nofollow).open(path);
    let file = opened.map_err(|error| match error.raw_os_error().map(Errno::from_raw_os_error) {
        Some(Errno::LOOP) => io::Error::new(
            io::ErrorKind::InvalidInput,
            "is a symbolic link, must be a file: a recording follows none",
        ),
        _ => error,
    })?;
    // One that was there has the rights that it had; a pipe or a device is somebody else's.
    if file.metadata()?.is_file() {
        file.set_permissions(Permissions::from_mode(0o600))?;
    }
    Ok(file)
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
