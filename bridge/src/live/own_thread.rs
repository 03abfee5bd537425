//! A thread that ends with its owner, in the process that started it.

use std::thread::JoinHandle;

/// A thread to be joined. In a forked process it counts as ended.
#[derive(Debug)]
pub(crate) struct OwnThread<T> {
    handle: Option<JoinHandle<T>>,
    process: u32,
}

impl<T> OwnThread<T> {
    pub(crate) fn new(handle: JoinHandle<T>) -> Self {
        Self { handle: Some(handle), process: std::process::id() }
    }

    /// True if it has ended, was joined or belongs to another process.
    pub(crate) fn is_finished(&self) -> bool {
        self.is_elsewhere() || self.handle.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// True if it has ended and was not joined yet; makes no system call.
    pub(crate) fn has_returned(&self) -> bool {
        self.handle.as_ref().is_some_and(JoinHandle::is_finished)
    }

    /// Waits for its end. `None` if joined before, panicked or of another process.
    pub(crate) fn join(&mut self) -> Option<T> {
        let handle = self.handle.take()?;
        if self.is_elsewhere() {
            // Detaching a thread of another process is undefined, too.
            std::mem::forget(handle);
            return None;
        }
        handle.join().ok()
    }

    fn is_elsewhere(&self) -> bool {
        self.process != std::process::id()
    }
}
