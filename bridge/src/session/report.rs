//! What a session says of itself: to the caller, to people, and to the handshake.

use super::{
    keys::{Chain, EpochId},
    rejection::Rejection,
    responder::MAX_SKIPPED,
    window::Arrival,
};

/// A datagram of the peer, opened.
#[derive(Debug, PartialEq, Eq)]
pub enum Incoming<'a> {
    /// What the peer sealed; authentic and not seen before.
    Payload {
        /// The bytes.
        payload: &'a [u8],
        /// [`Arrival::Newer`] or [`Arrival::Late`]; without security always the former.
        arrival: Arrival,
    },
    /// A message for the handshake, of who has the shared key; perhaps recorded.
    Handshake {
        /// All of it.
        datagram: &'a [u8],
        /// Whether it is the first message for the next keys of the living session.
        is_renewal: bool,
    },
    /// The peer has ended the session.
    Release,
}

/// What happened to a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SessionEvent {
    /// A session began: whatever was known of the peer is of another.
    Began {
        /// Its number.
        session: u64,
    },
    /// The session goes on under new keys.
    Rekeyed {
        /// Their number, from 1.
        epoch: u32,
    },
    /// The peer ended the session; the lease is free.
    Released,
    /// The newest keys should have been renewed and were not.
    Aging {
        /// Until nothing more is sent under them, in ns.
        left_ns: u64,
    },
    /// The newest keys grew too old without others.
    Expired,
    /// More forgeries than the keys bear.
    Forgeries,
    /// A person at the slave ended the session of a silent master.
    TakenOver,
}

/// Why nothing was sealed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SealError {
    /// There are no keys (yet).
    #[error("no session: the handshake has not ended")]
    NoSession,
    /// The newest keys are too old, or have sealed too much.
    #[error("the keys are used up: {age_ns} ns old, {sealed} datagrams sealed")]
    UsedUp {
        /// Their age.
        age_ns: u64,
        /// Datagrams that they sealed.
        sealed: u64,
    },
    /// All payloads have one length.
    #[error("payload of {seen} bytes: must have {allowed}")]
    Length {
        /// As given.
        seen: usize,
        /// As set.
        allowed: usize,
    },
}

/// Why a lease was not freed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the master was heard {ago_ns} ns ago: a lease can be taken over after {silence_ns} ns of silence")]
pub struct StillHeard {
    /// When the master was last heard.
    pub ago_ns: u64,
    /// How long it must be silent.
    pub silence_ns: u64,
}

/// What the handshake needs to know of the session; it may go to another thread.
#[derive(Debug, PartialEq, Eq)]
pub struct Standing {
    pub(super) live: Option<Live>,
    /// Since the peer was heard, or since the master took its keys.
    pub(super) silent_ns: u64,
    /// The run of the master that holds the lease.
    pub(super) holder: Option<u64>,
    /// Whether either side asks for new keys before their time.
    pub(super) due: bool,
}

impl Standing {
    /// Whether a first message is for the next keys of the living session, not for a new one; refused if it is for
    /// neither, or for keys that the peer has already.
    pub(super) fn is_renewal(&self, id: EpochId) -> Result<bool, Rejection> {
        is_renewal(self.live.as_ref().map(|live| live.id), id)
    }
}

/// See [`Standing::is_renewal`].
pub(super) fn is_renewal(living: Option<EpochId>, id: EpochId) -> Result<bool, Rejection> {
    match living {
        Some(living) if living.session == id.session => match id.epoch.checked_sub(living.epoch) {
            None | Some(0) => Err(Rejection::Replayed),
            Some(skipped) if skipped > MAX_SKIPPED => Err(Rejection::Epoch),
            Some(_) => Ok(true),
        },
        _ if id.epoch == 0 => Ok(false),
        _ => Err(Rejection::Session),
    }
}

/// The newest keys, or, of a session that still has the lease, those that grew too old.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Live {
    pub(super) id: EpochId,
    pub(super) chain: Chain,
    pub(super) age_ns: u64,
    /// Whether the peer has used them.
    pub(super) confirmed: bool,
}
