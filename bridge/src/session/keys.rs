//! The key that both people share, and the keys of one epoch that come of it.

use ring::hmac;

use super::aead::Key;
use crate::wire::Role;

/// The 32 bytes that both sides hold from the start.
#[derive(Clone)]
pub struct PreSharedKey([u8; 32]);

impl PreSharedKey {
    /// A key of 32 random bytes.
    pub const fn new(bytes: [u8; 32]) -> Self {
        Self(bytes)
    }

    pub(super) const fn bytes(&self) -> &[u8; 32] {
        &self.0
    }

    /// The key that authenticates a handshake within a living session: `HMAC-SHA-256(key, chain)`.
    ///
    /// Only the two ends of that session have the chain; another who holds the shared key has not.
    pub(super) fn within(&self, chain: &Chain) -> Self {
        Self(digest(&self.0, &[&chain.0]))
    }
}

impl std::fmt::Debug for PreSharedKey {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("PreSharedKey(..)")
    }
}

/// A secret of one epoch that the handshake of the next is bound to.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct Chain([u8; 32]);

impl std::fmt::Debug for Chain {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Chain(..)")
    }
}

fn digest(key: &[u8; 32], parts: &[&[u8]]) -> [u8; 32] {
    let mut context = hmac::Context::with_key(&hmac::Key::new(hmac::HMAC_SHA256, key));
    for part in parts {
        context.update(part);
    }
    let mut bytes = [0; 32];
    bytes.copy_from_slice(context.sign().as_ref());
    bytes
}

/// Which keys: those of a session's n-th handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct EpochId {
    pub(super) session: u64,
    pub(super) epoch: u32,
}

/// The keys of one epoch, as a handshake gives them.
#[derive(Clone, Debug)]
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
        let chain = Chain(digest(from_master, &[b"haptether chain", from_slave]));
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
