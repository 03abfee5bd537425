//! The key that both people share, and the keys of one epoch that come of it.

use ring::hmac;
use zeroize::Zeroizing;

use super::aead::Key;
use crate::wire::Role;

/// Different byte values in a key at least. Of 32 random bytes fewer are different once in 1e36 keys.
const MIN_DISTINCT: usize = 8;
const KEY_BYTES: usize = 32;

/// Why bytes are no shared key.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum KeyError {
    /// Of another length.
    #[error("key of {0} bytes: must have {KEY_BYTES}")]
    Length(usize),
    /// Zeros, or hardly more: nobody drew it at random.
    #[error(
        "weak key, {0} different byte values: must be {KEY_BYTES} random bytes, `haptether keygen` makes one"
    )]
    Weak(usize),
}

/// The 32 bytes that both sides hold from the start. They stay at one place in memory and are wiped on drop.
pub struct PreSharedKey(Box<Zeroizing<[u8; KEY_BYTES]>>);

impl PreSharedKey {
    /// A key of 32 random bytes, of which this makes the one copy.
    pub fn new(bytes: &[u8]) -> Result<Self, KeyError> {
        if bytes.len() != KEY_BYTES {
            return Err(KeyError::Length(bytes.len()));
        }
        let distinct = bytes.iter().enumerate().filter(|(n, byte)| !bytes[..*n].contains(byte)).count();
        if distinct < MIN_DISTINCT {
            return Err(KeyError::Weak(distinct));
        }
        let mut key = Self::zeros();
        key.0.copy_from_slice(bytes);
        Ok(key)
    }

    /// The same of bytes that are wiped, be they a key or not.
    pub fn of_vec(bytes: Vec<u8>) -> Result<Self, KeyError> {
        Self::new(&Zeroizing::new(bytes))
    }

    fn zeros() -> Self {
        Self(Box::new(Zeroizing::new([0; KEY_BYTES])))
    }

    pub(super) fn bytes(&self) -> &[u8; KEY_BYTES] {
        &self.0
    }

    /// The key that authenticates a handshake within a living session: `HMAC-SHA-256(key, chain)`.
    ///
    /// Only the two ends of that session have the chain; another who holds the shared key has not.
    pub(super) fn within(&self, chain: &Chain) -> Self {
        let mut key = Self::zeros();
        digest(&self.0, &[chain.0.as_slice()], &mut key.0);
        key
    }

    /// The key of the MAC over handshake messages: `HMAC-SHA-256(key, "haptether handshake mac")`.
    pub(super) fn mac(&self) -> MacKey {
        let mut bytes = Zeroizing::new([0; KEY_BYTES]);
        digest(&self.0, &[b"haptether handshake mac"], &mut bytes);
        MacKey(hmac::Key::new(hmac::HMAC_SHA256, bytes.as_slice()))
    }
}

impl std::fmt::Debug for PreSharedKey {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("PreSharedKey(..)")
    }
}

/// Tells handshake messages of who has the shared key from garbage, at the cost of one HMAC.
///
/// It opens nothing: `HMAC-SHA-256(mac key, message)` says only that its maker had the key.
///
/// Source: Donenfeld, *`WireGuard`: Next Generation Kernel Network Tunnel*, 2017, section 5.4.4 (`mac1`).
pub(super) struct MacKey(hmac::Key);

impl MacKey {
    pub(super) fn sign(&self, message: &[u8]) -> [u8; MAC] {
        let mut mac = [0; MAC];
        mac.copy_from_slice(hmac::sign(&self.0, message).as_ref());
        mac
    }

    pub(super) fn fits(&self, message: &[u8], mac: &[u8]) -> bool {
        hmac::verify(&self.0, message, mac).is_ok()
    }
}

impl std::fmt::Debug for MacKey {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("MacKey(..)")
    }
}

/// Bytes of the MAC over a handshake message.
pub(super) const MAC: usize = 32;

/// A secret of one epoch that the handshake of the next is bound to.
#[derive(PartialEq, Eq)]
pub(super) struct Chain(Zeroizing<[u8; 32]>);

impl Chain {
    /// The same secret for the handshake's thread.
    pub(super) fn copied(&self) -> Self {
        Self(self.0.clone())
    }
}

impl std::fmt::Debug for Chain {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Chain(..)")
    }
}

fn digest(key: &[u8; 32], parts: &[&[u8]], into: &mut [u8; 32]) {
    let mut context = hmac::Context::with_key(&hmac::Key::new(hmac::HMAC_SHA256, key));
    for part in parts {
        context.update(part);
    }
    into.copy_from_slice(context.sign().as_ref());
}

/// Which keys: those of a session's n-th handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct EpochId {
    pub(super) session: u64,
    pub(super) epoch: u32,
}

/// The keys of one epoch, as a handshake gives them; not to be cloned: a key and its counter exist once.
#[derive(Debug)]
pub struct Epoch {
    pub(super) id: EpochId,
    pub(super) send: Key,
    pub(super) receive: Key,
    pub(super) chain: Chain,
    /// When the keys were made here, in ns.
    pub(super) born_ns: u64,
    /// What the peer drew when it started.
    pub(super) peer_run: u64,
    /// Datagrams sealed: the next counter.
    pub(super) sealed: u64,
}

impl Epoch {
    /// Keys from the two halves of the handshake's split: the first is the initiator's, the master's, to send with.
    pub(super) fn new(
        id: EpochId,
        role: Role,
        (from_master, from_slave): (&[u8; 32], &[u8; 32]),
        (born_ns, peer_run): (u64, u64),
    ) -> Option<Self> {
        let (send, receive) = match role {
            Role::Master => (from_master, from_slave),
            Role::Slave => (from_slave, from_master),
        };
        let mut chain = Chain(Zeroizing::new([0; 32]));
        digest(from_master, &[b"haptether chain", from_slave], &mut chain.0);
        Some(Self {
            id,
            send: Key::new(send)?,
            receive: Key::new(receive)?,
            chain,
            born_ns,
            peer_run,
            sealed: 0,
        })
    }

    pub(super) fn age_ns(&self, now_ns: u64) -> u64 {
        now_ns.saturating_sub(self.born_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_that_nobody_drew_are_refused() {
        let mut one_bit = [0; 32];
        one_bit[31] = 1;
        let pattern: Vec<u8> = [1, 2, 3, 4].repeat(8);
        for (bytes, distinct) in [(&[0; 32][..], 1), (&[0x42; 32], 1), (&one_bit, 2), (&pattern, 4)] {
            let error = PreSharedKey::new(bytes).unwrap_err();
            assert_eq!(error, KeyError::Weak(distinct));
            assert!(error.to_string().contains("weak key"), "{error}");
        }
        assert_eq!(PreSharedKey::new(&[1; 31]).unwrap_err(), KeyError::Length(31));
        let good: Vec<u8> = (0..32).collect();
        assert_eq!(PreSharedKey::new(&good).unwrap().bytes().as_slice(), good);
    }

    #[test]
    fn a_mac_fits_its_message_and_key_alone() {
        let keys = [0, 1].map(|first| {
            let bytes: Vec<u8> = (first..first + 32).collect();
            PreSharedKey::new(&bytes).unwrap().mac()
        });
        let mac = keys[0].sign(b"message");
        assert!(keys[0].fits(b"message", &mac));
        assert!(!keys[1].fits(b"message", &mac) && !keys[0].fits(b"massage", &mac));
        assert!(!keys[0].fits(b"message", &mac[..16]), "no shorter one");
    }
}
