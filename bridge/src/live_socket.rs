//! Unix sockets of a live side, for its owner only: telemetry and control.

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

/// Maximum length of a Unix socket's path in bytes; Linux, `struct sockaddr_un`.
const MAX_PATH: usize = 107;
/// Time allowed for another run to create its socket.
const LOCK_PATIENCE: Duration = Duration::from_secs(1);

/// File of a listening socket, removed on drop.
struct SocketFile {
    path: PathBuf,
    /// `None` once removed. A replacement with another inode is kept.
    inode: Option<u64>,
    /// Creating process: a fork leaves the file alone.
    process: u32,
}

impl SocketFile {
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

/// Lock the folder of `path` against other runs that create or remove a socket.
///
/// Anybody may hold the lock of a folder that others may enter: there it is not required.
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

/// True if other users may open the folder.
fn is_shared(folder: &File) -> io::Result<bool> {
    let found = folder.metadata()?;
    Ok(found.mode() & 0o077 != 0 || found.uid() != rustix::process::geteuid().as_raw())
}

/// Remove the socket of a killed run; refuses anything else.
fn remove_stale(path: &Path, address: &SocketAddrUnix, taken: &str) -> io::Result<()> {
    match std::fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error),
        Ok(found) if !found.file_type().is_socket() => {
            return Err(refused("is there and is no socket: name another path"));
        }
        Ok(_) => {}
    }
    // Non-blocking: a full backlog fails at once.
    match connect(&unix_socket()?, address) {
        Err(Errno::CONNREFUSED) => std::fs::remove_file(path),
        Err(Errno::NOENT) => Ok(()),
        Ok(()) | Err(Errno::AGAIN) => Err(refused(taken)),
        Err(error) => Err(refused(&format!("is another program's socket ({error}): name another path"))),
    }
}

/// A listening socket whose file is removed with it.
pub(crate) struct LiveSocket {
    listener: UnixListener,
    file: SocketFile,
}

impl LiveSocket {
    /// Listens at `path`. Replaces a stale socket, and refuses anything else; for another run the error is `taken`.
    pub(crate) fn listen(path: &Path, taken: &str) -> io::Result<Self> {
        let length = path.as_os_str().len();
        if length > MAX_PATH {
            return Err(refused(&format!(
                "a path of {length} bytes, must be at most {MAX_PATH} for a Unix socket"
            )));
        }
        let address = SocketAddrUnix::new(path)?;
        // Another run that starts now would take a bound, silent socket for a stale one.
        let _alone = locked_folder(path)?;
        remove_stale(path, &address, taken)?;
        let socket = unix_socket()?;
        // Before it has a name, so that others can never connect.
        rustix::fs::fchmod(&socket, 0o600.into())?;
        bind(&socket, &address)?;
        let file = SocketFile::bound(path)?;
        listen(&socket, 16)?;
        let listener = UnixListener::from(socket);
        Ok(Self { listener, file })
    }

    /// Accept a waiting client, non-blocking; `None` if nobody waits. Fails without a free descriptor.
    pub(crate) fn accept(&self) -> io::Result<Option<UnixStream>> {
        match self.listener.accept() {
            Ok((stream, _)) => {
                stream.set_nonblocking(true)?;
                Ok(Some(stream))
            }
            Err(error) if is_exhausted(&error) => Err(error),
            // Nobody waits, or the client has gone.
            Err(_) => Ok(None),
        }
    }

    /// Remove the file; open connections stay.
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

    /// Every user may lock a folder that they may open; a private one only this user.
    #[test]
    fn lock_in_shared_folder_does_not_block_socket() {
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
