//! Pre-shared key, keys of one epoch that derive from it, and their cipher.

use ring::{
    aead::{Aad, CHACHA20_POLY1305, LessSafeKey, Nonce, UnboundKey},
    hmac,
};
use zeroize::Zeroizing;

use crate::wire::Role;

/// Smallest number of distinct byte values in a key. 32 random bytes have fewer once in 1e36 keys.
const MIN_DISTINCT: usize = 8;
const KEY_BYTES: usize = 32;

/// Invalid shared key.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum KeyError {
    /// Wrong length.
    #[error("key of {0} bytes: must have {KEY_BYTES}")]
    Length(usize),
    /// All zeros, or too few distinct bytes: not a random key.
    #[error(
        "weak key, {0} different byte values: must be {KEY_BYTES} random bytes, `haptether keygen` makes one"
    )]
    Weak(usize),
}

/// Pre-shared key: 32 bytes that both sides hold from the start. It stays at one place in memory and is wiped
/// on drop.
pub struct PreSharedKey(Box<Zeroizing<[u8; KEY_BYTES]>>);

impl PreSharedKey {
    /// Build a key from 32 random bytes. It copies the bytes once; the caller wipes its own.
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

    /// Build a key from bytes, and wipe the bytes whether or not the key is valid.
    pub fn of_vec(bytes: Vec<u8>) -> Result<Self, KeyError> {
        Self::new(&Zeroizing::new(bytes))
    }

    fn zeros() -> Self {
        Self(Box::new(Zeroizing::new([0; KEY_BYTES])))
    }

    pub(super) fn bytes(&self) -> &[u8; KEY_BYTES] {
        &self.0
    }

    /// Key that authenticates a handshake within a present session: `HMAC-SHA-256(key, chain)`.
    ///
    /// Only the two ends of that session have the chain; another holder of the shared key does not.
    pub(super) fn within(&self, chain: &Chain) -> Self {
        let mut key = Self::zeros();
        digest(&self.0, &[chain.0.as_slice()], &mut key.0);
        key
    }

    /// Key of the MAC over handshake messages: `HMAC-SHA-256(key, "haptether handshake mac")`.
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

/// MAC key that separates handshake messages of a holder of the shared key from garbage, at the cost of one
/// HMAC.
///
/// It encrypts nothing: `HMAC-SHA-256(mac key, message)` proves only that the sender had the key.
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

/// Secret of one epoch to which the next handshake is bound.
#[derive(PartialEq, Eq)]
pub(super) struct Chain(Zeroizing<[u8; 32]>);

impl Chain {
    /// Copy the secret for the handshake's thread.
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

/// Id of keys: session, and index of the handshake within it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct EpochId {
    pub(super) session: u64,
    pub(super) epoch: u32,
}

/// Keys of one epoch, made by a handshake. Never clone them: a key and its counter must exist once.
#[derive(Debug)]
pub struct Epoch {
    pub(super) id: EpochId,
    pub(super) send: Key,
    pub(super) receive: Key,
    pub(super) chain: Chain,
    /// Time in ns at which this side made the keys.
    pub(super) born_ns: u64,
    /// Run id of the peer, drawn at its start.
    pub(super) peer_run: u64,
    /// Number of sealed datagrams, which is the next counter.
    pub(super) sealed: u64,
}

impl Epoch {
    /// Build the keys from the two halves of the handshake's split. The first half is the sending key of the
    /// initiator, the master.
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

pub(super) const TAG: usize = 16;

/// Key of one direction of one epoch.
///
/// The nonce is four zero bytes and the counter, little-endian. No counter is used twice: only the session
/// assigns counters, and each key starts at 0.
///
/// Source: RFC 8439, section 2.8; Noise Protocol Framework rev. 34, section 12.3 (the nonce).
///
/// Never clone a key: two copies would seal twice with one counter. Its bytes are wiped on drop.
pub(super) struct Key(LessSafeKey);

impl Drop for Key {
    fn drop(&mut self) {
        if let Some(blank) = UnboundKey::new(&CHACHA20_POLY1305, &[0; 32]).ok().map(LessSafeKey::new) {
            self.0 = blank;
            // Keeps the compiler from removing the store, which nothing reads.
            std::hint::black_box(&self.0);
        }
    }
}

impl std::fmt::Debug for Key {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Key(..)")
    }
}

fn nonce(counter: u64) -> Nonce {
    let mut bytes = [0; 12];
    bytes[4..].copy_from_slice(&counter.to_le_bytes());
    Nonce::assume_unique_for_key(bytes)
}

impl Key {
    /// Build a key from 32 bytes; `None` only if the cipher required another length.
    pub(super) fn new(bytes: &[u8; 32]) -> Option<Self> {
        UnboundKey::new(&CHACHA20_POLY1305, bytes).ok().map(|key| Self(LessSafeKey::new(key)))
    }

    /// Encrypt `payload` in place and return the tag over it and `header`; `None` if the payload is too long
    /// for the cipher.
    pub(super) fn seal(&self, counter: u64, header: &[u8], payload: &mut [u8]) -> Option<[u8; TAG]> {
        let tag = self.0.seal_in_place_separate_tag(nonce(counter), Aad::from(header), payload).ok()?;
        tag.as_ref().try_into().ok()
    }

    /// Decrypt `sealed`, payload and tag, in place; return whether the tag matches it and `header`.
    pub(super) fn open(&self, counter: u64, header: &[u8], sealed: &mut [u8]) -> bool {
        self.0.open_in_place(nonce(counter), Aad::from(header), sealed).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weak_keys_are_refused() {
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
    fn mac_matches_only_its_message_and_key() {
        let keys = [0, 1].map(|first| {
            let bytes: Vec<u8> = (first..first + 32).collect();
            PreSharedKey::new(&bytes).unwrap().mac()
        });
        let mac = keys[0].sign(b"message");
        assert!(keys[0].fits(b"message", &mac));
        assert!(!keys[1].fits(b"message", &mac) && !keys[0].fits(b"massage", &mac));
        assert!(!keys[0].fits(b"message", &mac[..16]), "a shorter MAC is invalid");
    }

    fn bytes(hex: &str) -> Vec<u8> {
        let digits: Vec<_> = hex.chars().filter(|c| !c.is_whitespace()).collect();
        digits
            .chunks(2)
            .map(|pair| u8::from_str_radix(&pair.iter().collect::<String>(), 16).unwrap())
            .collect()
    }

    /// The nonce of this vector begins with four zero bytes, like ours.
    ///
    /// Source: RFC 8439, appendix A.5.
    #[test]
    fn the_known_answer_of_the_standard() {
        let key: [u8; 32] =
            bytes("1c9240a5eb55d38af333888604f6b5f0473917c1402b80099dca5cbc207075c0").try_into().unwrap();
        let counter = u64::from_le_bytes([1, 2, 3, 4, 5, 6, 7, 8]);
        let header = bytes("f33388860000000000004e91");
        let plain = "Internet-Drafts are draft documents valid for a maximum of six months and may be updated, \
                     replaced, or obsoleted by other documents at any time. It is inappropriate to use \
                     Internet-Drafts as reference material or to cite them other than as \
                     /\u{201c}work in progress./\u{201d}";
        let sealed = bytes(
            "64a0861575861af460f062c79be643bd 5e805cfd345cf389f108670ac76c8cb2
             4c6cfc18755d43eea09ee94e382d26b0 bdb7b73c321b0100d4f03b7f355894cf
             332f830e710b97ce98c8a84abd0b9481 14ad176e008d33bd60f982b1ff37c855
             9797a06ef4f0ef61c186324e2b350638 3606907b6a7c02b0f9f6157b53c867e4
             b9166c767b804d46a59b5216cde7a4e9 9040c5a40433225ee282a1b0a06c523e
             af4534d7f83fa1155b0047718cbc546a 0d072b04b3564eea1b422273f548271a
             0bb2316053fa76991955ebd63159434e cebb4e466dae5a1073a6727627097a10
             49e617d91d361094fa68f0ff77987130 305beaba2eda04df997b714d6c6f2c29
             a6ad5cb4022b02709b",
        );
        let key = Key::new(&key).unwrap();
        let mut buffer = plain.as_bytes().to_vec();
        let tag = key.seal(counter, &header, &mut buffer).unwrap();
        assert_eq!(tag.to_vec(), bytes("eead9d67890cbb22392336fea1851f38"));
        assert_eq!(buffer, sealed);
        buffer.extend_from_slice(&tag);
        assert!(key.open(counter, &header, &mut buffer));
        assert_eq!(&buffer[..plain.len()], plain.as_bytes());
    }
}
