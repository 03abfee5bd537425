//! Serial port exclusive to one of our processes, or a socket in its place, and the clock of deadlines.

use std::{os::unix::net::UnixStream, path::Path};

use rustix::{
    event::{PollFd, PollFlags, poll},
    fd::OwnedFd,
    fs::{FileType, FlockOperation, Mode, OFlags, flock, open, stat},
    io::{Errno, read, write},
    termios::{ControlModes, OptionalActions, QueueSelector, tcflush, tcgetattr, tcsetattr},
    thread::{ClockId, nanosleep},
    time::{Timespec, clock_gettime},
};

const SECOND_NS: u64 = 1_000_000_000;
/// Buffer of a terminal in bytes. Source: Linux, `N_TTY_BUF_SIZE`.
const TERMINAL_KEEPS: usize = 4096;

/// Monotonic system time in ns.
pub(super) fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    #[allow(clippy::cast_sign_loss)] // the monotonic clock starts at boot
    let (seconds, nanoseconds) = (now.tv_sec as u64, now.tv_nsec as u64);
    seconds * SECOND_NS + nanoseconds
}

/// Sleeps for a duration, or until a signal.
pub(super) fn sleep_ns(duration_ns: u64) {
    #[allow(clippy::cast_possible_wrap)] // 292 years
    let duration =
        Timespec { tv_sec: (duration_ns / SECOND_NS) as i64, tv_nsec: (duration_ns % SECOND_NS) as i64 };
    // A signal shortens the sleep: the caller then sends earlier.
    let _ = nanosleep(&duration);
}

/// Serial port: raw, 8 bits, no parity, one stop bit; or a Unix socket that carries the same bytes.
///
/// A pseudo-terminal forwards bytes by kernel threads without priority; a socket does so in the threads that
/// send and receive.
#[derive(Debug)]
pub(super) struct SerialPort {
    descriptor: OwnedFd,
    is_socket: bool,
}

impl SerialPort {
    /// Open it at a rate in bit/s; [`Errno::WOULDBLOCK`] if another process of ours has it.
    ///
    /// The peer that has bound a socket decides on exclusive access and on the rate.
    pub(super) fn open(path: &Path, baud: u32) -> Result<Self, Errno> {
        if FileType::from_raw_mode(stat(path)?.st_mode) == FileType::Socket {
            let stream = UnixStream::connect(path)
                .and_then(|stream| stream.set_nonblocking(true).map(|()| stream))
                .map_err(|error| Errno::from_io_error(&error).unwrap_or(Errno::IO))?;
            return Ok(Self { descriptor: stream.into(), is_socket: true });
        }
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let descriptor = open(path, flags, Mode::empty())?;
        flock(&descriptor, FlockOperation::NonBlockingLockExclusive)?;
        let mut settings = tcgetattr(&descriptor)?;
        settings.make_raw();
        settings.control_modes |= ControlModes::CREAD | ControlModes::CLOCAL;
        settings.control_modes &= !(ControlModes::CSTOPB | ControlModes::CRTSCTS);
        settings.set_speed(baud)?;
        tcsetattr(&descriptor, OptionalActions::Flush, &settings)?;
        Ok(Self { descriptor, is_socket: false })
    }

    /// Discard received bytes; return true if none remain. A socket is read up to the buffer size of a
    /// terminal.
    pub(super) fn discard(&self) -> Result<bool, Errno> {
        if !self.is_socket {
            return tcflush(&self.descriptor, QueueSelector::IFlush).map(|()| true);
        }
        let mut forgotten = [0; 256];
        for _ in 0..TERMINAL_KEEPS / forgotten.len() {
            match read(&self.descriptor, &mut forgotten) {
                Ok(0) => return Err(Errno::IO),
                Ok(_) | Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return Ok(true),
                Err(error) => return Err(error),
            }
        }
        Ok(false)
    }

    /// Send all bytes before a deadline; [`Errno::TIMEDOUT`] otherwise.
    pub(super) fn send(&self, mut bytes: &[u8], deadline_ns: u64) -> Result<(), Errno> {
        while !bytes.is_empty() {
            match write(&self.descriptor, bytes) {
                Ok(count) => bytes = &bytes[count..],
                Err(Errno::AGAIN | Errno::INTR) => {
                    let left_ns = deadline_ns.saturating_sub(now_ns());
                    if !self.wait(PollFlags::OUT, left_ns)? && left_ns == 0 {
                        return Err(Errno::TIMEDOUT);
                    }
                }
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Receives bytes within a duration; returns 0 if none arrive or a signal ends the wait.
    pub(super) fn receive(&self, buffer: &mut [u8], wait_ns: u64) -> Result<usize, Errno> {
        if !self.wait(PollFlags::IN, wait_ns)? {
            return Ok(0);
        }
        match read(&self.descriptor, buffer) {
            // End of file: the adapter is gone.
            Ok(0) => Err(Errno::IO),
            Ok(count) => Ok(count),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(error) => Err(error),
        }
    }

    /// Waits until the port is ready; returns false on timeout or on a signal.
    fn wait(&self, flags: PollFlags, wait_ns: u64) -> Result<bool, Errno> {
        #[allow(clippy::cast_possible_wrap)] // 292 years
        let timeout =
            Timespec { tv_sec: (wait_ns / SECOND_NS) as i64, tv_nsec: (wait_ns % SECOND_NS) as i64 };
        let mut waited = [PollFd::new(&self.descriptor, flags)];
        match poll(&mut waited, Some(&timeout)) {
            Ok(0) | Err(Errno::INTR) => Ok(false),
            // The next call reports any error.
            Ok(_) => Ok(true),
            Err(error) => Err(error),
        }
    }
}
