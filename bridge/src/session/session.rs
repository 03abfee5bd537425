//! One end of a session, as a tick uses it: seals outgoing payloads and opens arrivals.

use std::collections::VecDeque;

use super::{
    epochs::{Arrival, Epochs, KeyChange, Slot},
    keys::{Chain, Epoch, EpochId, MacKey, PreSharedKey},
    settings::{SessionSettings, SettingsError},
    wire::{Header, Kind, MAX_DATAGRAM, Rejection, Rejections, SESSION_HEADER, mac_fits, sealed_length},
};
use crate::wire::Role;

/// Master that the slave obeys. The lease outlives the keys: a silent master keeps it until an operator frees
/// it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Lease {
    session: u64,
    run: u64,
}

/// Progress of the newest keys towards their renewal.
#[allow(clippy::struct_excessive_bools)] // steps in any order
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Renewal {
    /// The peer has used the keys.
    confirmed: bool,
    /// This side requests new keys before their time.
    asked_here: bool,
    /// The peer requests new keys before their time.
    asked_there: bool,
    /// The operators have been warned about a missing renewal.
    warned: bool,
}

/// Accepted datagram, by type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Judged {
    Handshake { is_renewal: bool },
    Payload(Arrival),
    Release,
}

/// Capacity in events that wait for a reader; further events are dropped.
const MAX_EVENTS: usize = 32;

/// One end of a session. It owns no clock, no socket and no randomness; sealing and opening allocate nothing.
///
/// It cannot be cloned: two copies would seal different payloads with the same key and counter.
#[derive(Debug)]
pub struct Session {
    settings: SessionSettings,
    /// Key of the MAC over handshake messages; none in an insecure session.
    mac: Option<MacKey>,
    epochs: Epochs,
    /// Time in ns of the newest authentic datagram of the peer.
    heard_ns: u64,
    renewal: Renewal,
    /// Number of forgeries against the keys of this session.
    forged: u64,
    /// Lease of the master; only at the slave.
    lease: Option<Lease>,
    rejections: Rejections,
    events: VecDeque<SessionEvent>,
}

impl Session {
    /// Build an end that waits for keys of a [`super::Handshake`].
    pub fn secure(settings: SessionSettings, key: &PreSharedKey) -> Result<Self, SettingsError> {
        Self::new(settings, Some(key.mac()))
    }

    /// Build an end without encryption and authentication: payloads are the datagrams, and anybody may send
    /// them.
    ///
    /// [`Session::is_secure`] returns false; records and the screen must show it.
    pub fn insecure(settings: SessionSettings) -> Result<Self, SettingsError> {
        Self::new(settings, None)
    }

    fn new(settings: SessionSettings, mac: Option<MacKey>) -> Result<Self, SettingsError> {
        settings.check()?;
        Ok(Self {
            settings,
            mac,
            epochs: Epochs::new(&settings),
            heard_ns: 0,
            renewal: Renewal::default(),
            forged: 0,
            lease: None,
            rejections: Rejections::default(),
            events: VecDeque::with_capacity(MAX_EVENTS),
        })
    }

    /// Return whether the session authenticates and encrypts.
    pub fn is_secure(&self) -> bool {
        self.mac.is_some()
    }

    /// Return whether the session can seal at `now_ns`.
    pub fn is_open(&self, now_ns: u64) -> bool {
        !self.is_secure()
            || self.epochs.current.as_ref().is_some_and(|epoch| self.check(now_ns, epoch).is_ok())
    }

    /// Number of the present session.
    pub fn session(&self) -> Option<u64> {
        self.epochs.current.as_ref().map(|epoch| epoch.id.session)
    }

    /// Bytes of every sealed datagram, in both directions.
    pub fn datagram_length(&self) -> usize {
        let payload = self.settings.payload_length;
        if self.is_secure() { sealed_length(payload) } else { payload }
    }

    /// Rejected datagrams, by cause.
    pub fn rejections(&self) -> Rejections {
        self.rejections
    }

    /// Take the oldest waiting event.
    pub fn poll_event(&mut self) -> Option<SessionEvent> {
        self.events.pop_front()
    }

    fn report(&mut self, event: SessionEvent) {
        if self.events.len() < MAX_EVENTS {
            self.events.push_back(event);
        }
    }

    fn check(&self, now_ns: u64, epoch: &Epoch) -> Result<(), SealError> {
        let (age_ns, sealed) = (epoch.age_ns(now_ns), epoch.sealed);
        if age_ns >= self.settings.refuse_ns || sealed >= self.settings.max_sealed {
            return Err(SealError::UsedUp { age_ns, sealed });
        }
        Ok(())
    }

    /// Seal `payload` into `buffer` and return the datagram to send.
    pub fn seal<'a>(
        &mut self,
        now_ns: u64,
        payload: &[u8],
        buffer: &'a mut [u8; MAX_DATAGRAM],
    ) -> Result<&'a [u8], SealError> {
        let (seen, allowed) = (payload.len(), self.settings.payload_length);
        if seen != allowed {
            return Err(SealError::Length { seen, allowed });
        }
        if !self.is_secure() {
            buffer[..seen].copy_from_slice(payload);
            return Ok(&buffer[..seen]);
        }
        buffer[SESSION_HEADER..SESSION_HEADER + seen].copy_from_slice(payload);
        let kind = if self.renewal.asked_here { Kind::SealedAndDue } else { Kind::Sealed };
        self.finish(now_ns, kind, buffer)
    }

    /// Write the datagram that ends the session at the peer and frees the lease.
    ///
    /// Datagrams get lost: call this several times and send each result, then call [`Session::end`].
    pub fn release<'a>(
        &mut self,
        now_ns: u64,
        buffer: &'a mut [u8; MAX_DATAGRAM],
    ) -> Result<&'a [u8], SealError> {
        if !self.is_secure() {
            return Err(SealError::NoSession);
        }
        buffer.fill(0);
        self.finish(now_ns, Kind::Release, buffer)
    }

    fn finish<'a>(
        &mut self,
        now_ns: u64,
        kind: Kind,
        buffer: &'a mut [u8; MAX_DATAGRAM],
    ) -> Result<&'a [u8], SealError> {
        let payload_end = SESSION_HEADER + self.settings.payload_length;
        let length = self.datagram_length();
        self.check(now_ns, self.epochs.current.as_ref().ok_or(SealError::NoSession)?)?;
        let epoch = self.epochs.current.as_mut().ok_or(SealError::NoSession)?;
        let EpochId { session, epoch: number } = epoch.id;
        let counter = epoch.sealed;
        // Incremented before use, so that no error path can reuse the counter.
        epoch.sealed += 1;
        let header = Header { kind, epoch: number, session, counter }.to_bytes();
        buffer[..SESSION_HEADER].copy_from_slice(&header);
        let tag = epoch
            .send
            .seal(counter, &header, &mut buffer[SESSION_HEADER..payload_end])
            .ok_or(SealError::NoSession)?;
        buffer[payload_end..length].copy_from_slice(&tag);
        Ok(&buffer[..length])
    }

    /// Open a datagram that arrived at `now_ns`, in place.
    ///
    /// A rejected datagram changes nothing but counters. The checks come in this order: length, version,
    /// kind. For a handshake then its usefulness and its MAC; for others session and epoch, counter, and tag.
    /// A duplicate is [`Rejection::Repeated`] only if it is authentic.
    pub fn open<'a>(&mut self, now_ns: u64, datagram: &'a mut [u8]) -> Result<Incoming<'a>, Rejection> {
        match self.judge(now_ns, datagram) {
            Ok(Judged::Handshake { is_renewal }) => Ok(Incoming::Handshake { datagram, is_renewal }),
            Ok(Judged::Release) => Ok(Incoming::Release),
            Ok(Judged::Payload(arrival)) => {
                let start = if self.is_secure() { SESSION_HEADER } else { 0 };
                Ok(Incoming::Payload {
                    payload: &datagram[start..start + self.settings.payload_length],
                    arrival,
                })
            }
            Err(rejection) => {
                self.rejections.count(rejection);
                Err(rejection)
            }
        }
    }

    fn judge(&mut self, now_ns: u64, datagram: &mut [u8]) -> Result<Judged, Rejection> {
        if !self.is_secure() {
            let fits = datagram.len() == self.settings.payload_length;
            return fits.then_some(Judged::Payload(Arrival::Newer)).ok_or(Rejection::Length);
        }
        let header = Header::read(datagram, self.settings.role, self.datagram_length())?;
        if header.kind.is_handshake() {
            return self
                .judge_handshake(&header, datagram)
                .map(|is_renewal| Judged::Handshake { is_renewal });
        }
        let (slot, arrival) = self.epochs.find(now_ns, &header, &self.settings)?;
        let (cleartext, sealed) = datagram.split_at_mut(SESSION_HEADER);
        let is_authentic =
            self.epochs.get(slot).is_some_and(|epoch| epoch.receive.open(header.counter, cleartext, sealed));
        if !is_authentic {
            self.count_forgery();
            return Err(Rejection::Forged);
        }
        if arrival == Arrival::Duplicate {
            return Err(Rejection::Repeated);
        }
        // Two masters may both have been offered keys: the first to use them holds the lease.
        if matches!(slot, Slot::Offered(_)) && self.lease.is_some_and(|lease| lease.session != header.session)
        {
            return Err(Rejection::Leased);
        }
        let change = self.epochs.mark(now_ns, slot, header.counter, &self.settings);
        self.keys_changed(change);
        self.heard_ns = self.heard_ns.max(now_ns);
        if slot != Slot::Previous {
            self.renewal.confirmed = true;
            self.renewal.asked_there = header.kind == Kind::SealedAndDue;
        }
        if header.kind == Kind::Release {
            self.lease = None;
            self.stop(SessionEvent::Released);
            return Ok(Judged::Release);
        }
        Ok(Judged::Payload(arrival))
    }

    /// Pass on a handshake message if it has a valid MAC and is useful. Garbage ends here.
    fn judge_handshake(&self, header: &Header, datagram: &[u8]) -> Result<bool, Rejection> {
        let id = EpochId { session: header.session, epoch: header.epoch };
        let is_renewal = header.kind == Kind::Hello && is_renewal(self.epochs.id(), id)?;
        let fits = self.mac.as_ref().is_some_and(|key| mac_fits(datagram, key));
        fits.then_some(is_renewal).ok_or(Rejection::Forged)
    }

    /// Count a forgery.
    ///
    /// Source: RFC 9001, section 6.6: all forgeries against a session count, over all its keys.
    fn count_forgery(&mut self) {
        self.forged += 1;
        if self.forged >= self.settings.max_forged {
            self.stop(SessionEvent::Forgeries);
        }
    }

    fn keys_changed(&mut self, change: Option<KeyChange>) {
        let (Some(change), Some(epoch)) = (change, &self.epochs.current) else { return };
        let event = match change {
            KeyChange::Began => {
                let (session, run) = (epoch.id.session, epoch.peer_run);
                self.forged = 0;
                if self.settings.role == Role::Slave {
                    self.lease = Some(Lease { session, run });
                }
                SessionEvent::Began { session }
            }
            KeyChange::Rekeyed(epoch) => SessionEvent::Rekeyed { epoch },
        };
        self.renewal = Renewal::default();
        self.report(event);
    }

    fn stop(&mut self, why: SessionEvent) {
        self.forged = 0;
        self.renewal = Renewal::default();
        if self.epochs.id().is_some() {
            self.report(why);
        }
        self.epochs.clear();
    }

    /// Install the keys of a handshake. The master uses them at once, the slave once the master has used
    /// them.
    pub fn install(&mut self, now_ns: u64, epoch: Epoch) {
        if !self.is_secure() {
            return;
        }
        let change = self.epochs.install(now_ns, epoch, &self.settings);
        if change.is_some() {
            self.heard_ns = now_ns;
        }
        self.keys_changed(change);
    }

    /// Advance the time; once per tick is enough.
    pub fn advance(&mut self, now_ns: u64) {
        if self.epochs.advance(now_ns, &self.settings) {
            self.renewal = Renewal::default();
            self.report(SessionEvent::Expired);
        }
        let age_ns = self.epochs.current.as_ref().map_or(0, |epoch| epoch.age_ns(now_ns));
        if age_ns >= self.settings.warn_ns() && !std::mem::replace(&mut self.renewal.warned, true) {
            self.report(SessionEvent::Aging { left_ns: self.settings.refuse_ns.saturating_sub(age_ns) });
        }
    }

    /// Request new keys before their time; the master's handshake makes them.
    pub fn rekey(&mut self) {
        self.renewal.asked_here = self.epochs.current.is_some();
    }

    /// End the session on this side, as after [`Session::release`]; the peer notices only the silence.
    pub fn end(&mut self) {
        self.lease = None;
        self.epochs.clear();
        self.renewal = Renewal::default();
    }

    /// Let another master begin, on behalf of the operator at the slave: ends the session of a silent master.
    pub fn allow_takeover(&mut self, now_ns: u64) -> Result<(), StillHeard> {
        let (ago_ns, silence_ns) = (now_ns.saturating_sub(self.heard_ns), self.settings.silence_ns);
        if self.lease.is_none() {
            return Ok(());
        }
        if ago_ns < silence_ns {
            return Err(StillHeard { ago_ns, silence_ns });
        }
        self.lease = None;
        self.stop(SessionEvent::TakenOver);
        Ok(())
    }

    /// Return whether a master, heard or silent, holds the lease.
    pub fn is_leased(&self) -> bool {
        self.lease.is_some()
    }

    /// State of the session for the handshake.
    pub fn status(&self, now_ns: u64) -> SessionStatus {
        let live = match (&self.epochs.current, &self.epochs.lapsed) {
            (Some(epoch), _) => Some(Live {
                id: epoch.id,
                chain: epoch.chain.copied(),
                age_ns: epoch.age_ns(now_ns),
                confirmed: self.renewal.confirmed,
            }),
            (None, Some((id, chain))) => {
                Some(Live { id: *id, chain: chain.copied(), age_ns: u64::MAX, confirmed: true })
            }
            (None, None) => None,
        };
        SessionStatus {
            live,
            silent_ns: now_ns.saturating_sub(self.heard_ns),
            holder: self.lease.map(|lease| lease.run),
            due: self.renewal.asked_here || self.renewal.asked_there,
        }
    }
}

/// Opened datagram of the peer.
#[derive(Debug, PartialEq, Eq)]
pub enum Incoming<'a> {
    /// Payload sealed by the peer; authentic and not seen before.
    Payload {
        /// Bytes of the payload.
        payload: &'a [u8],
        /// [`Arrival::Newer`] or [`Arrival::Late`]; without security always `Newer`.
        arrival: Arrival,
    },
    /// Message for the handshake from a holder of the shared key; it may be recorded.
    Handshake {
        /// The whole datagram.
        datagram: &'a [u8],
        /// True if it is the first message for the next keys of the present session.
        is_renewal: bool,
    },
    /// The peer has ended the session.
    Release,
}

/// Event of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SessionEvent {
    /// A session began; earlier state of the peer belongs to another session.
    Began {
        /// Its number.
        session: u64,
    },
    /// The session continues with new keys.
    Rekeyed {
        /// Epoch of the keys, from 1.
        epoch: u32,
    },
    /// The peer ended the session; the lease is free.
    Released,
    /// The renewal of the newest keys is overdue.
    Aging {
        /// Time in ns until they seal nothing more.
        left_ns: u64,
    },
    /// The newest keys expired without a renewal.
    Expired,
    /// The number of forgeries reached its limit.
    Forgeries,
    /// The operator at the slave ended the session of a silent master.
    TakenOver,
}

/// Failure to seal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SealError {
    /// There are no keys yet.
    #[error("no session: the handshake has not ended")]
    NoSession,
    /// The newest keys are too old, or have sealed too many datagrams.
    #[error("the keys are used up: {age_ns} ns old, {sealed} datagrams sealed")]
    UsedUp {
        /// Age of the keys in ns.
        age_ns: u64,
        /// Number of datagrams that they have sealed.
        sealed: u64,
    },
    /// Payload of another length; all payloads have the same.
    #[error("payload of {seen} bytes: must have {allowed}")]
    Length {
        /// Given length.
        seen: usize,
        /// Required length.
        allowed: usize,
    },
}

/// Failure to free a lease: the master is still heard.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the master was heard {ago_ns} ns ago: a lease can be taken over after {silence_ns} ns of silence")]
pub struct StillHeard {
    /// Time in ns since the master was last heard.
    pub ago_ns: u64,
    /// Required silence in ns.
    pub silence_ns: u64,
}

/// State of the session for the handshake; it may pass to another thread.
#[derive(Debug, PartialEq, Eq)]
pub struct SessionStatus {
    pub(super) live: Option<Live>,
    /// Time in ns since the peer was heard, or since the master installed its keys.
    pub(super) silent_ns: u64,
    /// Run id of the master that holds the lease.
    pub(super) holder: Option<u64>,
    /// True if either side requests new keys before their time.
    pub(super) due: bool,
}

impl SessionStatus {
    /// Return whether a first message is for the next keys of the present session, and not for a new session.
    /// An error if it is for neither, or for keys that the peer already has.
    pub(super) fn is_renewal(&self, id: EpochId) -> Result<bool, Rejection> {
        is_renewal(self.live.as_ref().map(|live| live.id), id)
    }
}

/// Largest number of failed handshakes of a session between two answered ones.
const MAX_SKIPPED: u32 = 1024;

/// See [`SessionStatus::is_renewal`].
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

/// Newest keys, or the expired keys of a session that still has the lease.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Live {
    pub(super) id: EpochId,
    pub(super) chain: Chain,
    pub(super) age_ns: u64,
    /// True if the peer has used the keys.
    pub(super) confirmed: bool,
}
