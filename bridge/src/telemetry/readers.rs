//! Readers of the telemetry of a loop, each at its own speed.

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

/// Maximum number of readers; a further one is sent `refused` and closed.
const MAX_READERS: usize = 16;
/// Backlog in bytes beyond which a reader loses samples.
const MAX_BACKLOG: usize = 1 << 18;
/// Backlog in bytes beyond which a reader is closed: it has lost seconds of samples and takes no events.
const MAX_EVENTS: usize = 1 << 20;

struct Reader {
    stream: UnixStream,
    backlog: Vec<u8>,
    /// Ticks of lost samples, not reported yet.
    lost: u64,
}

impl Reader {
    /// Report lost ticks, if any.
    fn count_lost(&mut self) {
        if self.lost > 0 {
            let lost = format!("{{\"kind\":\"lost\",\"ticks\":{}}}\n", std::mem::take(&mut self.lost));
            self.backlog.extend_from_slice(lost.as_bytes());
        }
    }

    /// Send as much backlog as possible. Returns whether the reader is there.
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

/// Readers of a loop, and the socket for new ones.
pub(super) struct Readers {
    socket: LiveSocket,
    hello: Vec<u8>,
    /// Newest cause, for later readers; empty without one.
    cause: Vec<u8>,
    connected: Vec<Reader>,
}

impl Readers {
    /// Listens at `path`; each reader gets `hello` first.
    pub(super) fn listen(path: &Path, hello: Vec<u8>) -> io::Result<Self> {
        let socket = LiveSocket::listen(path, "another run sends its telemetry there")?;
        Ok(Self { socket, hello, cause: Vec::new(), connected: Vec::new() })
    }

    /// Accept waiting readers, a limited number per frame.
    pub(super) fn accept(&mut self) {
        for _ in 0..MAX_READERS {
            let Ok(Some(stream)) = self.socket.accept() else { return };
            if self.connected.len() == MAX_READERS {
                // Some may have gone.
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

    /// Send all readers the reason why the sides are not coupled.
    pub(super) fn cause(&mut self, cause: Vec<u8>) {
        self.events(&cause);
        self.cause = cause;
    }

    /// Send all readers the end of the cause, if one was sent.
    pub(super) fn cleared(&mut self, cleared: &[u8]) {
        if !std::mem::take(&mut self.cause).is_empty() {
            self.events(cleared);
        }
    }

    /// Send lines to all, closing readers more than a megabyte behind.
    pub(super) fn events(&mut self, lines: &[u8]) {
        self.connected.retain_mut(|reader| {
            reader.backlog.extend_from_slice(lines);
            reader.backlog.len() <= MAX_EVENTS
        });
    }

    /// Send a sample of `ticks` ticks; a reader with a large backlog loses it.
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

    /// Send as much backlog as possible to all.
    pub(super) fn flush(&mut self) {
        self.connected.retain_mut(Reader::flush);
    }

    /// Remove the socket file, send the last line, and wait up to `patience` for slow readers.
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
