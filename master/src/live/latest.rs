//! The newest value of an array of words, with one writer and many readers; nobody blocks.

use std::sync::atomic::{
    AtomicU64,
    Ordering::{Acquire, Relaxed, Release},
    fence,
};

/// Retries of a read that a write interrupts.
const TRIES: u32 = 64;

/// A sequence lock with one writer.
///
/// Source: Boehm 2012, Can seqlocks get along with programming language memory models?, Fig. 6.
#[derive(Debug)]
pub(super) struct Latest<const N: usize> {
    /// Odd during a write.
    version: AtomicU64,
    words: [AtomicU64; N],
}

impl<const N: usize> Latest<N> {
    pub(super) fn new() -> Self {
        Self { version: AtomicU64::new(0), words: std::array::from_fn(|_| AtomicU64::new(0)) }
    }

    /// Replace the words. Only one thread may write.
    pub(super) fn write(&self, words: &[u64; N]) {
        let version = self.version.load(Relaxed);
        self.version.store(version + 1, Relaxed);
        fence(Release);
        for (own, word) in self.words.iter().zip(words) {
            own.store(*word, Relaxed);
        }
        self.version.store(version + 2, Release);
    }

    /// The newest words; none before the first write, or if writes interrupt every attempt.
    pub(super) fn read(&self) -> Option<[u64; N]> {
        for _ in 0..TRIES {
            let before = self.version.load(Acquire);
            if before == 0 {
                return None;
            }
            if before.is_multiple_of(2) {
                let words = std::array::from_fn(|index| self.words[index].load(Relaxed));
                fence(Acquire);
                if self.version.load(Relaxed) == before {
                    return Some(words);
                }
            }
            std::hint::spin_loop();
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::*;

    #[test]
    fn nothing_is_read_before_the_first_write() {
        let latest = Latest::<3>::new();
        assert_eq!(latest.read(), None);
        latest.write(&[1, 2, 3]);
        assert_eq!(latest.read(), Some([1, 2, 3]));
    }

    #[test]
    fn read_never_mixes_two_writes() {
        let latest = Latest::<16>::new();
        let done = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for number in 1..200_000 {
                    latest.write(&[number; 16]);
                }
                done.store(true, Release);
            });
            let mut newest = 0;
            while !done.load(Acquire) {
                let Some(words) = latest.read() else { continue };
                assert!(words.iter().all(|word| *word == words[0]), "{words:?}");
                assert!(words[0] >= newest);
                newest = words[0];
            }
        });
        assert_eq!(latest.read(), Some([199_999; 16]));
    }

    #[test]
    fn read_does_not_wait_for_an_unfinished_write() {
        let latest = Latest::<1>::new();
        latest.write(&[7]);
        // As if the writing thread stopped during a write.
        latest.version.store(3, Relaxed);
        assert_eq!(latest.read(), None);
    }
}
