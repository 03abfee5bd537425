//! Cryptography of the handshake: `Noise_NNpsk0_25519_ChaChaPoly_SHA256`.
//!
//! ```text
//! -> psk, e
//! <- e, ee
//! ```
//!
//! Both sides hold one shared key and nothing else, so they have no static keys.
//!
//! The key is mixed in before the first message (`psk0`, not `psk2`). So the slave can check whether the
//! first message derives from the key, before any curve arithmetic and before an answer.
//!
//! The ephemeral keys give forward secrecy: a later disclosure of the shared key opens no recorded session.
//!
//! Source: Perrin, *The Noise Protocol Framework*, rev. 34, 2018, sections 7.4 and 9.

use ring::{
    digest::{Context, SHA256},
    rand::{SecureRandom, SystemRandom},
};
use snow::{
    Builder, HandshakeState,
    params::{CipherChoice, DHChoice, HashChoice, NoiseParams},
    resolvers::{CryptoResolver, DefaultResolver},
    types::{Cipher, Dh, Hash, Random},
};
use zeroize::Zeroizing;

use super::{
    keys::{Epoch, EpochId, PreSharedKey, TAG},
    wire::{EPHEMERAL, HANDSHAKE_PAYLOAD},
};
use crate::wire::Role;

const PATTERN: &str = "Noise_NNpsk0_25519_ChaChaPoly_SHA256";
/// Bytes of a handshake message after the header.
pub(super) const MESSAGE: usize = EPHEMERAL + HANDSHAKE_PAYLOAD + TAG;

/// Failure of a handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HandshakeError {
    /// No randomness.
    #[error(transparent)]
    Entropy(#[from] NoEntropy),
    /// Message, key or state of the handshake does not match.
    #[error("handshake failed: its message, key or state does not match")]
    Noise,
}

impl From<snow::Error> for HandshakeError {
    fn from(_: snow::Error) -> Self {
        Self::Noise
    }
}

/// Primitives of `snow`, with 32 random bytes drawn in advance for the ephemeral key.
struct Drawn(Zeroizing<[u8; 32]>);

impl CryptoResolver for Drawn {
    fn resolve_rng(&self) -> Option<Box<dyn Random>> {
        Some(Box::new(Once(Some(self.0.clone()))))
    }

    fn resolve_dh(&self, choice: &DHChoice) -> Option<Box<dyn Dh>> {
        DefaultResolver.resolve_dh(choice)
    }

    fn resolve_hash(&self, choice: &HashChoice) -> Option<Box<dyn Hash>> {
        DefaultResolver.resolve_hash(choice)
    }

    fn resolve_cipher(&self, choice: &CipherChoice) -> Option<Box<dyn Cipher>> {
        DefaultResolver.resolve_cipher(choice)
    }
}

/// Returns its bytes once. A second request would repeat a key, so it fails.
struct Once(Option<Zeroizing<[u8; 32]>>);

impl Random for Once {
    fn try_fill_bytes(&mut self, bytes: &mut [u8]) -> Result<(), snow::Error> {
        let drawn = self.0.take().ok_or(snow::Error::Rng)?;
        if bytes.len() != drawn.len() {
            return Err(snow::Error::Rng);
        }
        bytes.copy_from_slice(drawn.as_slice());
        Ok(())
    }
}

/// One side of one handshake.
#[derive(Debug)]
pub(super) struct Noise {
    state: Box<HandshakeState>,
    id: EpochId,
    role: Role,
}

impl Drop for Noise {
    fn drop(&mut self) {
        // Covers a handshake dropped before its first message, or after an invalid message.
        let _ = self.forget_key();
    }
}

impl Noise {
    /// Begin a handshake for the keys of `id`; its prologue contains `id`.
    pub(super) fn new(
        role: Role,
        id: EpochId,
        key: &PreSharedKey,
        entropy: &mut dyn Entropy,
    ) -> Result<Self, HandshakeError> {
        let mut prologue = *b"haptether session 2\0____________";
        prologue[20..28].copy_from_slice(&id.session.to_le_bytes());
        prologue[28..].copy_from_slice(&id.epoch.to_le_bytes());
        Self::with_prologue(role, id, key, &prologue, entropy)
    }

    fn with_prologue(
        role: Role,
        id: EpochId,
        key: &PreSharedKey,
        prologue: &[u8],
        entropy: &mut dyn Entropy,
    ) -> Result<Self, HandshakeError> {
        let mut drawn = Zeroizing::new([0; 32]);
        entropy.fill(drawn.as_mut_slice())?;
        let pattern: NoiseParams = PATTERN.parse()?;
        let builder = Builder::with_resolver(pattern, Box::new(Drawn(drawn))).prologue(prologue)?;
        let mut state = Box::new(match role {
            Role::Master => builder.build_initiator()?,
            Role::Slave => builder.build_responder()?,
        });
        // Set only after the last move: `snow` wipes nothing, and each move would leave a copy of the key.
        state.set_psk(0, key.bytes())?;
        Ok(Self { state, id, role })
    }

    /// Wipe the key, which is mixed in with the first message and not needed after it.
    fn forget_key(&mut self) -> Result<(), HandshakeError> {
        Ok(self.state.set_psk(0, &[0; 32])?)
    }

    /// Write this side's message with `payload` encrypted.
    pub(super) fn write(
        &mut self,
        payload: &[u8; HANDSHAKE_PAYLOAD],
    ) -> Result<[u8; MESSAGE], HandshakeError> {
        let mut message = [0; MESSAGE];
        self.state.write_message(payload, &mut message)?;
        self.forget_key()?;
        Ok(message)
    }

    /// Read the peer's message; an invalid message leaves the handshake unchanged.
    pub(super) fn read(&mut self, message: &[u8]) -> Result<[u8; HANDSHAKE_PAYLOAD], HandshakeError> {
        let mut payload = [0; HANDSHAKE_PAYLOAD];
        if self.state.read_message(message, &mut payload)? == HANDSHAKE_PAYLOAD {
            self.forget_key()?;
            Ok(payload)
        } else {
            Err(HandshakeError::Noise)
        }
    }

    /// Return the keys, with the peer's run id, once both messages have passed.
    pub(super) fn keys(mut self, now_ns: u64, peer_run: u64) -> Result<Epoch, HandshakeError> {
        if !self.state.is_handshake_finished() {
            return Err(HandshakeError::Noise);
        }
        let (from_master, from_slave) = self.state.dangerously_get_raw_split();
        let (from_master, from_slave) = (Zeroizing::new(from_master), Zeroizing::new(from_slave));
        Epoch::new(self.id, self.role, (&from_master, &from_slave), (now_ns, peer_run))
            .ok_or(HandshakeError::Noise)
    }
}

/// No randomness available.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the system gave no random bytes")]
pub struct NoEntropy;

/// Source of random bytes. Only handshakes draw from it, never a tick.
pub trait Entropy {
    /// Fill `bytes`; after an error they are unusable.
    fn fill(&mut self, bytes: &mut [u8]) -> Result<(), NoEntropy>;

    /// Draw a random number, such as the id of a run.
    fn number(&mut self) -> Result<u64, NoEntropy> {
        let mut bytes = [0; 8];
        self.fill(&mut bytes).map(|()| u64::from_le_bytes(bytes))
    }
}

/// Generator of the operating system, for everything but tests.
#[derive(Clone, Debug)]
pub struct SystemEntropy(SystemRandom);

impl SystemEntropy {
    /// Build the generator of this system.
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

/// Generator with a seed. Use it only for simulation, where the same seed must yield the same bytes.
///
/// Block n is SHA-256 of side, seed and n.
#[derive(Clone, Debug)]
pub struct SeededEntropy {
    seed: u64,
    side: u8,
    drawn: u64,
}

impl SeededEntropy {
    /// Build the generator of one side of a run.
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

    struct Fixed(&'static str);

    impl Entropy for Fixed {
        fn fill(&mut self, out: &mut [u8]) -> Result<(), NoEntropy> {
            out.copy_from_slice(&bytes(self.0));
            Ok(())
        }
    }

    fn bytes(hex: &str) -> Vec<u8> {
        (0..hex.len()).step_by(2).map(|at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap()).collect()
    }

    /// Both messages, the hash of the handshake, and the first sealed messages of each direction, sealed with
    /// our own key objects.
    ///
    /// The payloads of this vector have 16 and 15 bytes; the test passes the second directly to the state.
    ///
    /// Source: the test vectors of *cacophony* (Noise in Haskell), as shipped with `snow` in
    /// `tests/vectors/cacophony.txt`.
    #[test]
    fn the_known_answer_of_another_implementation() {
        let key =
            PreSharedKey::of_vec(bytes("54686973206973206d7920417573747269616e20706572737065637469766521"))
                .unwrap();
        let prologue = b"John Galt";
        let id = EpochId { session: 0, epoch: 0 };
        let side =
            |role, ephemeral| Noise::with_prologue(role, id, &key, prologue, &mut Fixed(ephemeral)).unwrap();
        let mut master =
            side(Role::Master, "893e28b9dc6ca8d611ab664754b8ceb7bac5117349a4439a6b0569da977c464a");
        let mut slave = side(Role::Slave, "bbdb4cdbd309f1a1f2e1456967fe288cadd6f712d65dc7b7793d5e63da6b375b");
        let hello = master.write(b"Ludwig von Mises").unwrap();
        assert_eq!(
            hello.to_vec(),
            bytes(
                "ca35def5ae56cec33dc2036731ab14896bc4c75dbb07a61f879f8e3afa4c7944\
                 79b962b8aff8485742ac32f905ba45369e2465fb59e138a93d67a0d1266b6a54"
            )
        );
        assert_eq!(&slave.read(&hello).unwrap(), b"Ludwig von Mises");
        let mut answer = [0; MESSAGE];
        let length = slave.state.write_message(b"Murray Rothbard", &mut answer).unwrap();
        assert_eq!(
            answer[..length].to_vec(),
            bytes(
                "95ebc60d2b1fa672c1f46a8aa265ef51bfe38e7ccb39ec5be34069f144808843\
                 d6062704d5a9c422a8e834423f8c1feada7e8d0d910a1a2cd030fb584221e3"
            )
        );
        let mut payload = [0; HANDSHAKE_PAYLOAD];
        assert_eq!(master.state.read_message(&answer[..length], &mut payload), Ok(15));
        let hash = bytes("f4d03dc34495c95729ea6de9e1b59004b59733102488b3e24bc441e0be208eaf");
        assert_eq!(master.state.get_handshake_hash(), hash);
        assert_eq!(slave.state.get_handshake_hash(), hash);
        let (master, slave) = (master.keys(0, 1).unwrap(), slave.keys(0, 2).unwrap());
        assert_eq!(master.chain, slave.chain);
        // Direction, counter, payload and sealed message.
        for (from, to, counter, payload, sealed) in [
            (
                &master,
                &slave,
                0,
                "462e20412e20486179656b",
                "e632c3763d7669067383433197a3baddf146e9e70ad4b4e9e59e0f",
            ),
            (
                &slave,
                &master,
                0,
                "4361726c204d656e676572",
                "64c6bee32ea91c8474bb4c21d7a700109ad45af77b29764ba5eb1e",
            ),
            (
                &master,
                &slave,
                1,
                "4a65616e2d426170746973746520536179",
                "e2fa0bed0603b62d3ccac2ecabbf3fe33f3e86514909b323361626266cb2471cc8",
            ),
        ] {
            let mut buffer = bytes(payload);
            let tag = from.send.seal(counter, &[], &mut buffer).unwrap();
            buffer.extend_from_slice(&tag);
            assert_eq!(buffer, bytes(sealed));
            assert!(to.receive.open(counter, &[], &mut buffer));
            assert_eq!(buffer[..payload.len() / 2], bytes(payload));
        }
    }

    #[test]
    fn randomness_is_given_once() {
        let mut once = Once(Some(Zeroizing::new([7; 32])));
        let mut bytes = [0; 32];
        assert_eq!(once.try_fill_bytes(&mut bytes), Ok(()));
        assert_eq!(once.try_fill_bytes(&mut bytes), Err(snow::Error::Rng));
    }

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
        assert_ne!(bytes, again, "draws differ");
    }
}
