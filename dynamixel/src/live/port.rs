//! A serial port that nobody else of ours has, or a socket in its place, and the clock of its deadlines.

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
/// Bytes. Source: Linux, `N_TTY_BUF_SIZE`.
const TERMINAL_KEEPS: usize = 4096;

/// Time of the system's monotonic clock in ns.
pub(super) fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    #[allow(clippy::cast_sign_loss)] // the monotonic clock starts at boot
    let (seconds, nanoseconds) = (now.tv_sec as u64, now.tv_nsec as u64);
    seconds * SECOND_NS + nanoseconds
}

/// Waits for a while, or until a signal.
pub(super) fn sleep_ns(duration_ns: u64) {
    #[allow(clippy::cast_possible_wrap)] // 292 years
    let duration =
        Timespec { tv_sec: (duration_ns / SECOND_NS) as i64, tv_nsec: (duration_ns % SECOND_NS) as i64 };
    // One that a signal ends is short: what follows is sent the sooner.
    let _ = nanosleep(&duration);
}

/// A serial port: raw, 8 bits, no parity, one stop bit; or a Unix socket that hands the same bytes on.
///
/// A pseudo-terminal hands bytes on by threads of the kernel without priority, a socket by those that send and receive.
#[derive(Debug)]
pub(super) struct SerialPort {
    descriptor: OwnedFd,
    is_socket: bool,
}

impl SerialPort {
    /// Opens it at a rate in bit/s; [`Errno::WOULDBLOCK`] if another process of ours has it.
    ///
    /// Behind a socket is whoever has bound it: he says who else may have it, and at which rate.
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

    /// Forgets what has arrived; whether that was all. Of a socket no more is read than a terminal keeps.
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

    /// Sends all bytes before a deadline; [`Errno::TIMEDOUT`] otherwise.
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

    /// Bytes that arrive within a while; 0 if none do, or if a signal ends the wait.
    pub(super) fn receive(&self, buffer: &mut [u8], wait_ns: u64) -> Result<usize, Errno> {
        if !self.wait(PollFlags::IN, wait_ns)? {
            return Ok(0);
        }
        match read(&self.descriptor, buffer) {
            // The end of a file: the adapter is gone.
            Ok(0) => Err(Errno::IO),
            Ok(count) => Ok(count),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(error) => Err(error),
        }
    }

    /// Whether the port is ready within a while; not if a signal ends the wait.
    fn wait(&self, flags: PollFlags, wait_ns: u64) -> Result<bool, Errno> {
        #[allow(clippy::cast_possible_wrap)] // 292 years
        let timeout =
            Timespec { tv_sec: (wait_ns / SECOND_NS) as i64, tv_nsec: (wait_ns % SECOND_NS) as i64 };
        let mut waited = [PollFd::new(&self.descriptor, flags)];
        match poll(&mut waited, Some(&timeout)) {
            Ok(0) | Err(Errno::INTR) => Ok(false),
            // What went wrong is what the call says that comes next.
            Ok(_) => Ok(true),
            Err(error) => Err(error),
        }
    }
}
