//! One end of a session, as a tick uses it: seal what is sent, open what arrives.

use std::collections::VecDeque;

use super::{
    epochs::{Epochs, Slot, Turn},
    header::{Header, Kind, MAX_DATAGRAM, SESSION_HEADER, mac_fits, sealed_length},
    keys::{Epoch, EpochId, MacKey, PreSharedKey},
    rejection::{Rejection, Rejections},
    report::{Incoming, Live, SealError, SessionEvent, Standing, StillHeard, is_renewal},
    settings::{SessionSettings, SettingsError},
    window::Arrival,
};
use crate::wire::Role;

/// Whom the slave obeys. It outlives the keys: a master that fell silent keeps it until a person says otherwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Lease {
    session: u64,
    run: u64,
}

/// Where the newest keys stand on their way to the next.
#[allow(clippy::struct_excessive_bools)] // steps, in any order
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Renewal {
    /// The peer has used them.
    confirmed: bool,
    /// This side asks for others before their time.
    asked_here: bool,
    /// The peer does.
    asked_there: bool,
    /// People know that they should have given way to others.
    warned: bool,
}

/// What a datagram is that was not refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Judged {
    Handshake { is_renewal: bool },
    Payload(Arrival),
    Release,
}

/// Events that wait for a reader; further ones are dropped.
const MAX_EVENTS: usize = 32;

/// One end of a session. It owns no clock, no socket and no randomness; sealing and opening allocate nothing.
///
/// It cannot be cloned: two of it would seal different payloads with the same key and counter.
///
/// ```compile_fail
/// fn needs_clone<T: Clone>() {}
/// needs_clone::<haptether_bridge::session::Session>();
/// ```
#[derive(Debug)]
pub struct Session {
    settings: SessionSettings,
    /// Of handshake messages; none of an insecure session.
    mac: Option<MacKey>,
    epochs: Epochs,
    /// When the peer was last heard; the newest authentic datagram.
    heard_ns: u64,
    renewal: Renewal,
    /// Forgeries against the keys of this session.
    forged: u64,
    /// The master that holds the lease, at the slave.
    lease: Option<Lease>,
    rejections: Rejections,
    events: VecDeque<SessionEvent>,
}

impl Session {
    /// An end that waits for keys of a [`super::Handshake`].
    pub fn secure(settings: SessionSettings, key: &PreSharedKey) -> Result<Self, SettingsError> {
        Self::new(settings, Some(key.mac()))
    }

    /// An end that neither encrypts nor authenticates: payloads are the datagrams, and anybody may send them.
    ///
    /// [`Session::is_secure`] says so; records and the screen must show it.
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

    /// Whether what it opens is authenticated and what it seals encrypted.
    pub fn is_secure(&self) -> bool {
        self.mac.is_some()
    }

    /// Whether it can seal at `now_ns`.
    pub fn is_open(&self, now_ns: u64) -> bool {
        !self.is_secure()
            || self.epochs.current.as_ref().is_some_and(|epoch| self.check(now_ns, epoch).is_ok())
    }

    /// The number of the living session.
    pub fn session(&self) -> Option<u64> {
        self.epochs.current.as_ref().map(|epoch| epoch.id.session)
    }

    /// Bytes of every sealed datagram, both ways.
    pub fn datagram_length(&self) -> usize {
        let payload = self.settings.payload_length;
        if self.is_secure() { sealed_length(payload) } else { payload }
    }

    /// Datagrams not taken, by cause.
    pub fn rejections(&self) -> Rejections {
        self.rejections
    }

    /// Takes the oldest event that waits.
    pub fn poll_event(&mut self) -> Option<SessionEvent> {
        self.events.pop_front()
    }

    fn tell(&mut self, event: SessionEvent) {
        if self.events.len() < MAX_EVENTS {
            self.events.push_back(event);
        }
    }

    fn check(&self, now_ns: u64, epoch: &Epoch) -> Result<(), SealError> {
        let (age_ns, sealed) = (epoch.age_ns(now_ns), epoch.sealed);
        if age_ns >= self.settings.refuse_ns || sealed >= self.settings.most_sealed {
            return Err(SealError::UsedUp { age_ns, sealed });
        }
        Ok(())
    }

    /// Seals `payload` into `buffer` and gives the datagram to send.
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

    /// Writes the datagram that ends the session at the peer and frees the lease.
    ///
    /// Datagrams get lost: send several, each written anew, then [`Session::end`].
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
        // Counted before it is used: whatever follows, this counter is never sealed with again.
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

    /// Opens a datagram that arrived at `now_ns`, in place.
    ///
    /// What is not taken changes nothing but counts. The order: length, version and kind; of a handshake whether it can
    /// be of use, and its MAC; of others session and epoch, counter, and the tag. One that was there before is
    /// [`Rejection::Repeated`] only if it is authentic.
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
        let turn = self.epochs.mark(now_ns, slot, header.counter, &self.settings);
        self.turned(turn);
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

    /// What goes on to the handshake: what has the shared key's MAC and can be of use. Garbage ends here.
    fn judge_handshake(&self, header: &Header, datagram: &[u8]) -> Result<bool, Rejection> {
        let id = EpochId { session: header.session, epoch: header.epoch };
        let is_renewal = header.kind == Kind::Hello && is_renewal(self.epochs.id(), id)?;
        let fits = self.mac.as_ref().is_some_and(|key| mac_fits(datagram, key));
        fits.then_some(is_renewal).ok_or(Rejection::Forged)
    }

    /// Source: RFC 9001, section 6.6: all forgeries against a session count, whatever its keys.
    fn count_forgery(&mut self) {
        self.forged += 1;
        if self.forged >= self.settings.most_forged {
            self.stop(SessionEvent::Forgeries);
        }
    }

    fn turned(&mut self, turn: Option<Turn>) {
        let (Some(turn), Some(epoch)) = (turn, &self.epochs.current) else { return };
        let event = match turn {
            Turn::Began => {
                let (session, run) = (epoch.id.session, epoch.peer_run);
                self.forged = 0;
                if self.settings.role == Role::Slave {
                    self.lease = Some(Lease { session, run });
                }
                SessionEvent::Began { session }
            }
            Turn::Rekeyed(epoch) => SessionEvent::Rekeyed { epoch },
        };
        self.renewal = Renewal::default();
        self.tell(event);
    }

    fn stop(&mut self, why: SessionEvent) {
        self.forged = 0;
        self.renewal = Renewal::default();
        if self.epochs.id().is_some() {
            self.tell(why);
        }
        self.epochs.clear();
    }

    /// Takes the keys that a handshake gave. The master uses them from here on, the slave once the master has.
    pub fn install(&mut self, now_ns: u64, epoch: Epoch) {
        if !self.is_secure() {
            return;
        }
        let turn = self.epochs.install(now_ns, epoch, &self.settings);
        if turn.is_some() {
            self.heard_ns = now_ns;
        }
        self.turned(turn);
    }

    /// Lets time pass; once a tick is enough.
    pub fn advance(&mut self, now_ns: u64) {
        if self.epochs.advance(now_ns, &self.settings) {
            self.renewal = Renewal::default();
            self.tell(SessionEvent::Expired);
        }
        let age_ns = self.epochs.current.as_ref().map_or(0, |epoch| epoch.age_ns(now_ns));
        if age_ns >= self.settings.warn_ns() && !std::mem::replace(&mut self.renewal.warned, true) {
            self.tell(SessionEvent::Aging { left_ns: self.settings.refuse_ns.saturating_sub(age_ns) });
        }
    }

    /// Asks for new keys before their time; the master's handshake sees to it.
    pub fn rekey(&mut self) {
        self.renewal.asked_here = self.epochs.current.is_some();
    }

    /// Ends the session here, as after [`Session::release`]; the peer notices by silence alone.
    pub fn end(&mut self) {
        self.lease = None;
        self.epochs.clear();
        self.renewal = Renewal::default();
    }

    /// A person at the slave lets another master begin: ends the session of one that has fallen silent.
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

    /// Whether a master holds the lease, living or silent.
    pub fn is_leased(&self) -> bool {
        self.lease.is_some()
    }

    /// What the handshake needs to know.
    pub fn standing(&self, now_ns: u64) -> Standing {
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
        Standing {
            live,
            silent_ns: now_ns.saturating_sub(self.heard_ns),
            holder: self.lease.map(|lease| lease.run),
            due: self.renewal.asked_here || self.renewal.asked_there,
        }
    }
}
