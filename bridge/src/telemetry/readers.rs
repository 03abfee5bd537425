//! Those who read the telemetry of a loop, each at its own speed.

use std::{
    io,
    os::unix::{
        fs::{FileTypeExt, MetadataExt, PermissionsExt},
        net::{UnixListener, UnixStream},
    },
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    net::{
        AddressFamily, SendFlags, SocketAddrUnix, SocketFlags, SocketType, bind, listen, send, socket_with,
    },
};

/// At once; another is closed without a line.
const MAX_READERS: usize = 16;
/// Bytes that may wait for a reader before it loses samples.
const MAX_BACKLOG: usize = 1 << 18;
/// Bytes that may wait for a reader before it is closed: by then it has lost seconds of samples, and takes no events.
const MAX_EVENTS: usize = 1 << 20;
/// The longest path that a Unix socket can have, in bytes; Linux, `struct sockaddr_un`.
const MAX_PATH: usize = 107;

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
                Err(rustix::io::Errno::INTR) => {}
                Err(rustix::io::Errno::AGAIN) => break true,
                Err(_) => break false,
            }
        };
        self.backlog.drain(..sent);
        is_there
    }
}

/// The readers of a loop, and the socket at which more may come.
pub(super) struct Readers {
    listener: UnixListener,
    path: PathBuf,
    /// Of the socket's file: another that has taken its place is left alone.
    inode: u64,
    hello: Vec<u8>,
    /// The newest, for those that come later.
    cause: Vec<u8>,
    connected: Vec<Reader>,
}

impl Readers {
    /// Listens at `path`; each reader gets `hello` first.
    pub(super) fn listen(path: &Path, hello: Vec<u8>) -> io::Result<Self> {
        let refused = |text: String| Err(io::Error::new(io::ErrorKind::InvalidInput, text));
        let length = path.as_os_str().len();
        if length > MAX_PATH {
            return refused(format!(
                "a path of {length} bytes, must be at most {MAX_PATH} for a Unix socket"
            ));
        }
        match std::fs::symlink_metadata(path) {
            Ok(found) if !found.file_type().is_socket() => {
                return refused("is there and is no socket: name another path".to_owned());
            }
            Ok(_) if UnixStream::connect(path).is_ok() => {
                return refused("another run sends its telemetry there".to_owned());
            }
            // Left behind by a run that was killed.
            Ok(_) => std::fs::remove_file(path)?,
            Err(_) => {}
        }
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
        // Before it has a name: there is no moment in which others may connect.
        rustix::fs::fchmod(&socket, 0o600.into())?;
        bind(&socket, &SocketAddrUnix::new(path)?)?;
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o600))?;
        listen(&socket, 16)?;
        let inode = std::fs::symlink_metadata(path)?.ino();
        let listener = UnixListener::from(socket);
        Ok(Self { listener, path: path.to_owned(), inode, hello, cause: Vec::new(), connected: Vec::new() })
    }

    /// Lets those in who wait; not more than one frame's worth.
    pub(super) fn accept(&mut self) {
        for _ in 0..MAX_READERS {
            let Ok((stream, _)) = self.listener.accept() else { return };
            if self.connected.len() == MAX_READERS || stream.set_nonblocking(true).is_err() {
                continue;
            }
            let backlog = [&self.hello[..], &self.cause].concat();
            self.connected.push(Reader { stream, backlog, lost: 0 });
        }
    }

    /// Hands everybody a line that says why the two sides are not coupled.
    pub(super) fn cause(&mut self, cause: &[u8]) {
        cause.clone_into(&mut self.cause);
        self.events(cause);
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

    /// Sends the last line and closes; waits for slow readers for so long.
    pub(super) fn end(mut self, last: &[u8], patience: Duration) {
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

impl Drop for Readers {
    fn drop(&mut self) {
        if std::fs::symlink_metadata(&self.path).is_ok_and(|found| found.ino() == self.inode) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}
