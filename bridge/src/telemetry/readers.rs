//! Those who read the telemetry of a loop, each at its own speed.

use std::{
    io,
    os::unix::net::UnixStream,
    path::Path,
    thread,
    time::{Duration, Instant},
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::Errno,
    net::{SendFlags, send},
};

use super::frame;
use crate::live_socket::LiveSocket;

/// At once; another is sent `refused` and closed.
const MAX_READERS: usize = 16;
/// Bytes that may wait for a reader before it loses samples.
const MAX_BACKLOG: usize = 1 << 18;
/// Bytes that may wait for a reader before it is closed: by then it has lost seconds of samples, and takes no events.
const MAX_EVENTS: usize = 1 << 20;

struct Reader {
    stream: UnixStream,
    backlog: Vec<u8>,
    /// Ticks whose samples it has not been sent.
    lost: u64,
}

impl Reader {
    /// Says how much was lost, if anything was.
    fn count_lost(&mut self) {
        if self.lost > 0 {
            let lost = format!("{{\"kind\":\"lost\",\"ticks\":{}}}\n", std::mem::take(&mut self.lost));
            self.backlog.extend_from_slice(lost.as_bytes());
        }
    }

    /// Sends what waits, as far as it goes; whether the reader is still there.
    fn flush(&mut self) -> bool {
        let mut seen = [PollFd::new(&self.stream, PollFlags::empty())];
        let is_gone = poll(&mut seen, Some(&Timespec::default())).is_ok_and(|count| count > 0);
        if is_gone {
            return false;
        }
        let mut sent = 0;
        let is_there = loop {
            if sent == self.backlog.len() {
                break true;
            }
            match send(&self.stream, &self.backlog[sent..], SendFlags::NOSIGNAL | SendFlags::DONTWAIT) {
                Ok(taken) => sent += taken,
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => break true,
                Err(_) => break false,
            }
        };
        self.backlog.drain(..sent);
        is_there
    }
}

/// The readers of a loop, and the socket at which more may come.
pub(super) struct Readers {
    socket: LiveSocket,
    hello: Vec<u8>,
    /// The newest, for those that come later; empty where there is none.
    cause: Vec<u8>,
    connected: Vec<Reader>,
}

impl Readers {
    /// Listens at `path`; each reader gets `hello` first.
    pub(super) fn listen(path: &Path, hello: Vec<u8>) -> io::Result<Self> {
        let socket = LiveSocket::listen(path, "another run sends its telemetry there")?;
        Ok(Self { socket, hello, cause: Vec::new(), connected: Vec::new() })
    }

    /// Lets those in who wait; not more than one frame's worth.
    pub(super) fn accept(&mut self) {
        for _ in 0..MAX_READERS {
            let Ok(Some(stream)) = self.socket.accept() else { return };
            if self.connected.len() == MAX_READERS {
                // Some may have gone since.
                self.flush();
            }
            if self.connected.len() == MAX_READERS {
                let text =
                    format!("{MAX_READERS} programs read already, which is the limit: end one of them");
                let _ = send(&stream, &frame::refused(&text), SendFlags::NOSIGNAL | SendFlags::DONTWAIT);
                continue;
            }
            let backlog = [&self.hello[..], &self.cause].concat();
            self.connected.push(Reader { stream, backlog, lost: 0 });
        }
    }

    /// Hands everybody a line that says why the two sides are not coupled.
    pub(super) fn cause(&mut self, cause: Vec<u8>) {
        self.events(&cause);
        self.cause = cause;
    }

    /// Hands everybody a line that says that the cause of before is over; nothing where none was sent.
    pub(super) fn cleared(&mut self, cleared: &[u8]) {
        if !std::mem::take(&mut self.cause).is_empty() {
            self.events(cleared);
        }
    }

    /// Hands everybody lines; a reader that has not taken a megabyte of before is closed.
    pub(super) fn events(&mut self, lines: &[u8]) {
        self.connected.retain_mut(|reader| {
            reader.backlog.extend_from_slice(lines);
            reader.backlog.len() <= MAX_EVENTS
        });
    }

    /// Hands everybody a sample of so many ticks, but those who have not taken those before: these lose it.
    pub(super) fn sample(&mut self, sample: &[u8], ticks: u64) {
        for reader in &mut self.connected {
            if reader.backlog.len() + sample.len() > MAX_BACKLOG {
                reader.lost += ticks;
                continue;
            }
            reader.count_lost();
            reader.backlog.extend_from_slice(sample);
        }
    }

    /// Sends what waits, as far as each reader takes it at once.
    pub(super) fn flush(&mut self) {
        self.connected.retain_mut(Reader::flush);
    }

    /// Sends the last line and closes; waits for slow readers for so long. Whoever sees the end sees no socket's file.
    pub(super) fn end(mut self, last: &[u8], patience: Duration) {
        self.socket.remove();
        self.connected.iter_mut().for_each(Reader::count_lost);
        self.events(last);
        let end = Instant::now() + patience;
        loop {
            self.flush();
            self.connected.retain(|reader| !reader.backlog.is_empty());
            if self.connected.is_empty() || Instant::now() >= end {
                return;
            }
            thread::sleep(Duration::from_millis(5));
        }
    }
}
