//! One key of one direction: ChaCha20-Poly1305 with the counter as nonce.

use ring::aead::{Aad, CHACHA20_POLY1305, LessSafeKey, Nonce, UnboundKey};

/// Bytes of the tag.
pub(super) const TAG: usize = 16;

/// A key for one direction of one epoch.
///
/// The nonce is four zero bytes and the counter, little-endian. A counter is never used twice for sealing: the
/// session alone counts, and new keys begin with a new count.
///
/// Source: RFC 8439, section 2.8; Noise Protocol Framework rev. 34, section 12.3 (the nonce).
///
/// Not to be cloned: two of one key would seal twice with one counter. Its bytes are wiped on drop.
pub(super) struct Key(LessSafeKey);

impl Drop for Key {
    fn drop(&mut self) {
        if let Some(blank) = UnboundKey::new(&CHACHA20_POLY1305, &[0; 32]).ok().map(LessSafeKey::new) {
            self.0 = blank;
            // The store would else be left out, as nobody reads it.
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
    /// A key of 32 bytes; none only if the cipher were to ask for another length.
    pub(super) fn new(bytes: &[u8; 32]) -> Option<Self> {
        UnboundKey::new(&CHACHA20_POLY1305, bytes).ok().map(|key| Self(LessSafeKey::new(key)))
    }

    /// Encrypts `payload` in place and gives the tag over it and `header`; none if the payload is absurdly long.
    pub(super) fn seal(&self, counter: u64, header: &[u8], payload: &mut [u8]) -> Option<[u8; TAG]> {
        let tag = self.0.seal_in_place_separate_tag(nonce(counter), Aad::from(header), payload).ok()?;
        tag.as_ref().try_into().ok()
    }

    /// Decrypts `sealed`, payload and tag, in place; says whether the tag fits it and `header`.
    pub(super) fn open(&self, counter: u64, header: &[u8], sealed: &mut [u8]) -> bool {
        self.0.open_in_place(nonce(counter), Aad::from(header), sealed).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(hex: &str) -> Vec<u8> {
        let digits: Vec<_> = hex.chars().filter(|c| !c.is_whitespace()).collect();
        digits
            .chunks(2)
            .map(|pair| u8::from_str_radix(&pair.iter().collect::<String>(), 16).unwrap())
            .collect()
    }

    /// The nonce of this vector begins with four zero bytes, as ours do.
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
