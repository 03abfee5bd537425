//! Where randomness comes from: an argument, as time is.

use ring::rand::{SecureRandom, SystemRandom};

/// No randomness was to be had.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the system gave no random bytes")]
pub struct NoEntropy;

/// A source of random bytes. Only handshakes draw from it, never a tick.
pub trait Entropy {
    /// Fills `bytes`, or leaves them unusable.
    fn fill(&mut self, bytes: &mut [u8]) -> Result<(), NoEntropy>;

    /// A random number, such as marks a run of a side.
    fn number(&mut self) -> Result<u64, NoEntropy> {
        let mut bytes = [0; 8];
        self.fill(&mut bytes).map(|()| u64::from_le_bytes(bytes))
    }
}

/// The operating system's generator, for all that is not a test.
#[derive(Clone, Debug)]
pub struct SystemEntropy(SystemRandom);

impl SystemEntropy {
    /// The generator of this system.
    pub fn new() -> Self {
        Self(SystemRandom::new())
    }
}

impl Default for SystemEntropy {
    fn default() -> Self {
        Self::new()
    }
}

impl Entropy for SystemEntropy {
    fn fill(&mut self, bytes: &mut [u8]) -> Result<(), NoEntropy> {
        self.0.fill(bytes).map_err(|_| NoEntropy)
    }
}
