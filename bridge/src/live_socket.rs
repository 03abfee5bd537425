//! The Unix sockets of a live side, for its owner alone: of telemetry, and of control.

use std::{
    fs::File,
    io,
    os::{
        fd::{AsFd, BorrowedFd, OwnedFd},
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
    fs::{FlockOperation, flock},
    io::Errno,
    net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, listen, socket_with},
};

/// The longest path that a Unix socket can have, in bytes; Linux, `struct sockaddr_un`.
const MAX_PATH: usize = 107;
/// How long another run may take to make its socket.
const LOCK_PATIENCE: Duration = Duration::from_secs(1);

/// The file of a socket that listens, for as long as this is there.
struct SocketFile {
    path: PathBuf,
    /// Another that has taken its place is left alone; none once it was removed.
    inode: Option<u64>,
    /// That made it: a process forked from it leaves the file alone.
    process: u32,
}

impl SocketFile {
    /// That to which a socket has just been bound.
    fn bound(path: &Path) -> io::Result<Self> {
        match std::fs::symlink_metadata(path) {
            Ok(found) => {
                Ok(Self { path: path.to_owned(), inode: Some(found.ino()), process: std::process::id() })
            }
            Err(error) => {
                let _ = std::fs::remove_file(path);
                Err(error)
            }
        }
    }

    fn remove(&mut self) {
        let is_own = |inode| std::fs::symlink_metadata(&self.path).is_ok_and(|found| found.ino() == inode);
        if self.inode.take().is_some_and(is_own) && self.process == std::process::id() {
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

fn is_exhausted(error: &io::Error) -> bool {
    matches!(Errno::from_io_error(error), Some(Errno::MFILE | Errno::NFILE))
}

fn unix_socket() -> io::Result<OwnedFd> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    Ok(socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?)
}

/// The folder of `path`, in which no other run makes or removes a socket while this is held.
///
/// In a folder that others may enter, anybody may hold the lock: there the socket is made without it.
fn locked_folder(path: &Path) -> io::Result<File> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let folder = File::open(folder)?;
    let end = Instant::now() + LOCK_PATIENCE;
    loop {
        match flock(&folder, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => return Ok(folder),
            Err(Errno::INTR) => {}
            Err(Errno::WOULDBLOCK) if Instant::now() < end => thread::sleep(Duration::from_millis(5)),
            Err(Errno::WOULDBLOCK) if is_shared(&folder)? => return Ok(folder),
            Err(Errno::WOULDBLOCK) => return Err(refused("another program holds its folder locked")),
            Err(error) => return Err(error.into()),
        }
    }
}

/// True if users other than this one may open a folder.
fn is_shared(folder: &File) -> io::Result<bool> {
    let found = folder.metadata()?;
    Ok(found.mode() & 0o077 != 0 || found.uid() != rustix::process::geteuid().as_raw())
}

/// Removes a socket that a killed run has left behind; refuses what is anything else.
fn remove_stale(path: &Path, address: &SocketAddrUnix, taken: &str) -> io::Result<()> {
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
        Ok(()) | Err(Errno::AGAIN) => Err(refused(taken)),
        Err(error) => Err(refused(&format!("is another program's socket ({error}): name another path"))),
    }
}

/// A socket that listens at a path, whose file is gone with it.
pub(crate) struct LiveSocket {
    listener: UnixListener,
    file: SocketFile,
}

impl LiveSocket {
    /// Listens at `path`. A socket that nobody listens at is replaced, anything else refused; where another run listens
    /// the refusal says `taken`.
    pub(crate) fn listen(path: &Path, taken: &str) -> io::Result<Self> {
        let length = path.as_os_str().len();
        if length > MAX_PATH {
            return Err(refused(&format!(
                "a path of {length} bytes, must be at most {MAX_PATH} for a Unix socket"
            )));
        }
        let address = SocketAddrUnix::new(path)?;
        // Another run that begins now would take a socket that does not listen yet for one that was left behind.
        let _alone = locked_folder(path)?;
        remove_stale(path, &address, taken)?;
        let socket = unix_socket()?;
        // Before it has a name: there is no moment in which others may connect.
        rustix::fs::fchmod(&socket, 0o600.into())?;
        bind(&socket, &address)?;
        let file = SocketFile::bound(path)?;
        listen(&socket, 16)?;
        let listener = UnixListener::from(socket);
        Ok(Self { listener, file })
    }

    /// The next program that waits, whose connection never blocks; none at once where none waits. Fails where the process
    /// or the system has no descriptor left.
    pub(crate) fn accept(&self) -> io::Result<Option<UnixStream>> {
        match self.listener.accept() {
            Ok((stream, _)) => {
                stream.set_nonblocking(true)?;
                Ok(Some(stream))
            }
            Err(error) if is_exhausted(&error) => Err(error),
            // None waits, or it is gone already.
            Err(_) => Ok(None),
        }
    }

    /// Removes its file; those that are connected stay so.
    pub(crate) fn remove(&mut self) {
        self.file.remove();
    }
}

impl AsFd for LiveSocket {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.listener.as_fd()
    }
}

#[cfg(test)]
mod tests {
    use std::{
        fs::{Permissions, create_dir, set_permissions},
        os::unix::fs::PermissionsExt,
    };

    use super::*;

    /// Every user may lock a folder that they may open. In a private folder only another run of this user does.
    #[test]
    fn a_lock_in_a_shared_folder_holds_no_socket_up() {
        let base = std::env::temp_dir().join(format!("haptether-lock-{}", std::process::id()));
        create_dir(&base).unwrap();
        for (mode, is_made) in [(0o1777, true), (0o755, true), (0o750, true), (0o700, false)] {
            set_permissions(&base, Permissions::from_mode(mode)).unwrap();
            let theirs = File::open(&base).unwrap();
            flock(&theirs, FlockOperation::NonBlockingLockExclusive).unwrap();
            let made = LiveSocket::listen(&base.join("side.sock"), "another run");
            assert_eq!(made.is_ok(), is_made, "{mode:o}: {:?}", made.err());
        }
        std::fs::remove_dir_all(&base).unwrap();
    }
}
