//! Where randomness comes from: an argument, as time is.

use ring::{
    digest::{Context, SHA256},
    rand::{SecureRandom, SystemRandom},
};

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

/// A generator whose numbers a seed decides: for simulation, where the same seed must give the same bytes, and for
/// nothing else.
///
/// Block n is SHA-256 of side, seed and n.
#[derive(Clone, Debug)]
pub struct SeededEntropy {
    seed: u64,
    side: u8,
    drawn: u64,
}

impl SeededEntropy {
    /// The numbers of one side of a run.
    pub fn new(seed: u64, role: crate::wire::Role) -> Self {
        Self { seed, side: role.byte(), drawn: 0 }
    }
}

impl Entropy for SeededEntropy {
    fn fill(&mut self, bytes: &mut [u8]) -> Result<(), NoEntropy> {
        for chunk in bytes.chunks_mut(32) {
            let mut context = Context::new(&SHA256);
            context.update(&[self.side]);
            context.update(&self.seed.to_le_bytes());
            context.update(&self.drawn.to_le_bytes());
            self.drawn += 1;
            chunk.copy_from_slice(&context.finish().as_ref()[..chunk.len()]);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::Role;

    /// SHA-256 of seventeen known bytes, from another implementation.
    #[test]
    fn a_seed_decides_the_numbers() {
        let mut entropy = SeededEntropy::new(7, Role::Master);
        let (mut bytes, mut again) = ([0; 40], [0; 40]);
        entropy.fill(&mut bytes).unwrap();
        SeededEntropy::new(7, Role::Master).fill(&mut again).unwrap();
        assert_eq!(bytes, again);
        assert_eq!(bytes[..8], [0x31, 0x85, 0x7D, 0xFD, 0x4A, 0x37, 0xA0, 0x8D]);
        for (seed, role) in [(8, Role::Master), (7, Role::Slave)] {
            SeededEntropy::new(seed, role).fill(&mut again).unwrap();
            assert_ne!(bytes, again);
        }
        entropy.fill(&mut again).unwrap();
        assert_ne!(bytes, again, "never the same twice");
    }
}
