//! Those who read the telemetry of a loop, each at its own speed.

use std::{
    fs::File,
    io,
    os::{
        fd::OwnedFd,
        unix::{
            fs::{FileTypeExt, MetadataExt},
            net::{UnixListener, UnixStream},
        },
    },
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    fs::{FlockOperation, flock},
    io::Errno,
    net::{
        AddressFamily, SendFlags, SocketAddrUnix, SocketFlags, SocketType, bind, connect, listen, send,
        socket_with,
    },
};

use super::frame;

/// At once; another is sent `refused` and closed.
const MAX_READERS: usize = 16;
/// Bytes that may wait for a reader before it loses samples.
const MAX_BACKLOG: usize = 1 << 18;
/// Bytes that may wait for a reader before it is closed: by then it has lost seconds of samples, and takes no events.
const MAX_EVENTS: usize = 1 << 20;
/// The longest path that a Unix socket can have, in bytes; Linux, `struct sockaddr_un`.
const MAX_PATH: usize = 107;
/// How long another run may take to make its socket.
const LOCK_PATIENCE: Duration = Duration::from_secs(1);

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

/// The file of a socket that listens, for as long as this is there.
struct SocketFile {
    path: PathBuf,
    /// Another that has taken its place is left alone; none once it was removed.
    inode: Option<u64>,
}

impl SocketFile {
    /// That to which a socket has just been bound.
    fn bound(path: &Path) -> io::Result<Self> {
        match std::fs::symlink_metadata(path) {
            Ok(found) => Ok(Self { path: path.to_owned(), inode: Some(found.ino()) }),
            Err(error) => {
                let _ = std::fs::remove_file(path);
                Err(error)
            }
        }
    }

    fn remove(&mut self) {
        let is_own = |inode| std::fs::symlink_metadata(&self.path).is_ok_and(|found| found.ino() == inode);
        if self.inode.take().is_some_and(is_own) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        self.remove();
    }
}

fn refused(text: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, text)
}

fn unix_socket() -> io::Result<OwnedFd> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    Ok(socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?)
}

/// The folder of `path`, in which no other run makes or removes a socket while this is held.
fn locked_folder(path: &Path) -> io::Result<File> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let folder = File::open(folder)?;
    let end = Instant::now() + LOCK_PATIENCE;
    loop {
        match flock(&folder, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => return Ok(folder),
            Err(Errno::INTR) => {}
            Err(Errno::WOULDBLOCK) if Instant::now() < end => thread::sleep(Duration::from_millis(5)),
            Err(Errno::WOULDBLOCK) => return Err(refused("another program holds its folder locked")),
            Err(error) => return Err(error.into()),
        }
    }
}

/// Removes a socket that a killed run has left behind; refuses what is anything else.
fn remove_stale(path: &Path, address: &SocketAddrUnix) -> io::Result<()> {
    match std::fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error),
        Ok(found) if !found.file_type().is_socket() => {
            return Err(refused("is there and is no socket: name another path"));
        }
        Ok(_) => {}
    }
    // It never waits: where too many wait to be accepted, it is said at once.
    match connect(&unix_socket()?, address) {
        Err(Errno::CONNREFUSED) => std::fs::remove_file(path),
        Err(Errno::NOENT) => Ok(()),
        Ok(()) | Err(Errno::AGAIN) => Err(refused("another run sends its telemetry there")),
        Err(error) => Err(refused(&format!("is another program's socket ({error}): name another path"))),
    }
}

/// The readers of a loop, and the socket at which more may come.
pub(super) struct Readers {
    listener: UnixListener,
    file: SocketFile,
    hello: Vec<u8>,
    /// The newest, for those that come later; empty where there is none.
    cause: Vec<u8>,
    connected: Vec<Reader>,
}

impl Readers {
    /// Listens at `path`; each reader gets `hello` first.
    pub(super) fn listen(path: &Path, hello: Vec<u8>) -> io::Result<Self> {
        let length = path.as_os_str().len();
        if length > MAX_PATH {
            return Err(refused(&format!(
                "a path of {length} bytes, must be at most {MAX_PATH} for a Unix socket"
            )));
        }
        let address = SocketAddrUnix::new(path)?;
        // Another run that begins now would take a socket that does not listen yet for one that was left behind.
        let _alone = locked_folder(path)?;
        remove_stale(path, &address)?;
        let socket = unix_socket()?;
        // Before it has a name: there is no moment in which others may connect.
        rustix::fs::fchmod(&socket, 0o600.into())?;
        bind(&socket, &address)?;
        let file = SocketFile::bound(path)?;
        listen(&socket, 16)?;
        let listener = UnixListener::from(socket);
        Ok(Self { listener, file, hello, cause: Vec::new(), connected: Vec::new() })
    }

    /// Lets those in who wait; not more than one frame's worth.
    pub(super) fn accept(&mut self) {
        for _ in 0..MAX_READERS {
            let Ok((stream, _)) = self.listener.accept() else { return };
            if stream.set_nonblocking(true).is_err() {
                continue;
            }
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
        self.file.remove();
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
