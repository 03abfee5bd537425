//! Handshakes, off the tick: they take a millisecond and allocate.
//!
//! [`Handshake`] holds the shared key and derives epoch keys. [`super::Session`] holds those keys and seals
//! with them. [`Handshake`] takes a [`SessionStatus`] and a datagram and returns an [`Outcome`], so the two may
//! run on different threads.

use std::net::SocketAddr;

use super::{
    budget::{Bucket, Shares},
    keys::{Epoch, EpochId, MacKey, PreSharedKey},
    noise::{Entropy, HandshakeError, MESSAGE, Noise},
    session::SessionStatus,
    settings::SessionSettings,
    wire::{
        EPHEMERAL, HANDSHAKE_LENGTH, HandshakeDecision, HandshakePayload, Header, Kind, NO_TICKET, Rejection,
        Rejections, SESSION_HEADER, Ticket, write_mac,
    },
};
use crate::wire::{FrameForm, Role};

/// Handshake message with its header.
pub type HandshakeDatagram = [u8; HANDSHAKE_LENGTH];

/// Result of a handshake message.
#[derive(Debug, Default)]
pub struct Outcome {
    /// Datagram to send.
    pub reply: Option<HandshakeDatagram>,
    /// True if the reply goes to the address of the peer's frames instead of the request's address. So a
    /// replay of the peer's message from elsewhere does not divert the reply.
    pub to_peer: bool,
    /// Keys for [`super::Session::install`].
    pub keys: Option<Epoch>,
    /// Event for the screen and the log.
    pub event: Option<HandshakeEvent>,
}

/// Handshake without resulting keys, for the screen and the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HandshakeEvent {
    /// The slave refused the handshake. The slave reports this only for differing payload forms. The master
    /// reports every reason, except a lease that may be its own.
    Refused {
        /// Reason of the refusal.
        decision: HandshakeDecision,
        /// Form of the peer's payloads.
        form: FrameForm,
    },
    /// The slave refused another master with the key, because a master holds the lease. The other master is
    /// live: it returned the ticket of an earlier refusal; a recorded message cannot.
    SecondMaster {
        /// Run id of that master, drawn at its start.
        run: u64,
    },
}

/// Build a datagram: header, handshake message, MAC.
pub(super) fn message(kind: Kind, id: EpochId, said: &[u8; MESSAGE], mac: &MacKey) -> HandshakeDatagram {
    let mut datagram = [0; HANDSHAKE_LENGTH];
    let header = Header { kind, epoch: id.epoch, session: id.session, counter: 0 };
    datagram[..SESSION_HEADER].copy_from_slice(&header.to_bytes());
    datagram[SESSION_HEADER..SESSION_HEADER + MESSAGE].copy_from_slice(said);
    write_mac(&mut datagram, mac);
    datagram
}

/// Return session and epoch in the header of a handshake datagram.
pub(crate) fn session_and_epoch(datagram: &HandshakeDatagram) -> (u64, u32) {
    let [_, _, _, _, e0, e1, e2, e3, s0, s1, s2, s3, s4, s5, s6, s7, ..] = *datagram;
    (u64::from_le_bytes([s0, s1, s2, s3, s4, s5, s6, s7]), u32::from_le_bytes([e0, e1, e2, e3]))
}

/// Return whether a handshake datagram is the slave's answer.
pub(crate) fn message_is_answer(datagram: &HandshakeDatagram) -> bool {
    datagram[3] == Kind::Answer.byte()
}

/// Return the ephemeral key of a handshake datagram, and the whole message between header and MAC.
pub(super) fn parts(datagram: &[u8]) -> (&[u8], &[u8]) {
    (
        &datagram[SESSION_HEADER..SESSION_HEADER + EPHEMERAL],
        &datagram[SESSION_HEADER..SESSION_HEADER + MESSAGE],
    )
}

#[allow(clippy::large_enum_variant)] // one per run
#[derive(Debug)]
enum Side {
    Master(Initiator),
    Slave(Responder),
}

/// Handshakes of one side.
#[derive(Debug)]
pub struct Handshake {
    role: Role,
    side: Side,
    rejections: Rejections,
}

impl Handshake {
    /// Build the handshakes of the side of `settings`, with the shared key; `entropy` draws the id of this
    /// run.
    pub fn new(
        settings: SessionSettings,
        key: PreSharedKey,
        entropy: &mut dyn Entropy,
    ) -> Result<Self, HandshakeError> {
        let run = entropy.number()?;
        let side = match settings.role {
            Role::Master => Side::Master(Initiator::new(settings, key, run)),
            Role::Slave => Side::Slave(Responder::new(settings, key, run)),
        };
        Ok(Self { role: settings.role, side, rejections: Rejections::default() })
    }

    /// Take a datagram from [`super::Session::open`] that was sent from `from`.
    ///
    /// A rejected datagram changes only a counter, with two exceptions. An authentic message that a slave cannot
    /// answer ([`Rejection::Unable`]) uses up budget, `seen` and possibly a ticket. An authentic answer with an
    /// invalid payload makes a master's pending handshake unusable.
    pub fn receive(
        &mut self,
        now_ns: u64,
        from: SocketAddr,
        datagram: &[u8],
        status: &SessionStatus,
        entropy: &mut dyn Entropy,
    ) -> Result<Outcome, Rejection> {
        let outcome = Header::read(datagram, self.role, HANDSHAKE_LENGTH).and_then(|header| {
            let datagram: &HandshakeDatagram = datagram.try_into().map_err(|_| Rejection::Length)?;
            match &mut self.side {
                Side::Master(initiator) => initiator.receive(now_ns, &header, datagram, status),
                Side::Slave(responder) => responder.receive(now_ns, from, &header, datagram, status, entropy),
            }
        });
        outcome.inspect_err(|rejection| self.rejections.count(*rejection))
    }

    /// Return the message to send at `now_ns`, if any: a first message, or its retry. A slave never has one.
    ///
    /// Call this every 10 ms or so.
    pub fn poll(
        &mut self,
        now_ns: u64,
        status: &SessionStatus,
        entropy: &mut dyn Entropy,
    ) -> Result<Option<HandshakeDatagram>, HandshakeError> {
        match &mut self.side {
            Side::Master(initiator) => initiator.poll(now_ns, status, entropy),
            Side::Slave(_) => Ok(None),
        }
    }

    /// Rejected handshake messages, by cause.
    pub fn rejections(&self) -> Rejections {
        self.rejections
    }
}

/// First retry interval in ns: short, because an operator is waiting. A longer round trip costs some retries
/// but no time: every retry is the same message, and any answer to it is valid.
const RETRY_NS: u64 = 250 * MS;
/// Largest timeout in ns; it doubles up to this. A missing slave is not flooded, and a slave that starts is
/// found soon.
const MAX_RETRY_NS: u64 = 2000 * MS;
/// Time in ns after which a handshake without an answer is dropped and one with new keys begins. It covers
/// seven sendings, and any round trip in teleoperation.
const ATTEMPT_NS: u64 = 8000 * MS;
/// Wait in ns after a refusal before the next request for a new session. Usually a person must act first: end
/// the lease, or change a scene.
const REFUSED_NS: u64 = 1000 * MS;

/// Handshake that waits for its answer.
#[derive(Debug)]
struct Pending {
    noise: Noise,
    id: EpochId,
    datagram: HandshakeDatagram,
    begun_ns: u64,
    next_ns: u64,
    wait_ns: u64,
}

#[derive(Debug)]
pub(super) struct Initiator {
    settings: SessionSettings,
    key: PreSharedKey,
    mac: MacKey,
    run: u64,
    pending: Option<Pending>,
    /// Newest requested epoch; every handshake has its own number.
    newest: Option<EpochId>,
    refused_until_ns: u64,
    /// True if the slave refused a new session because of a lease while this side still has its session. If
    /// the slave has used the present keys, the next attempt is a renewal, which succeeds only if the lease
    /// is ours.
    renews: bool,
    /// True if that renewal got no answer: the lease belongs to another master, so the refusal is reported.
    has_failed: bool,
    /// Ticket of the last refusal.
    ticket: Ticket,
}

impl Initiator {
    pub(super) fn new(settings: SessionSettings, key: PreSharedKey, run: u64) -> Self {
        Self {
            settings,
            mac: key.mac(),
            key,
            run,
            pending: None,
            newest: None,
            refused_until_ns: 0,
            renews: false,
            has_failed: false,
            ticket: NO_TICKET,
        }
    }

    /// Return the handshake that the session needs now: a new session, or new keys for the present one.
    fn needed_handshake(&self, status: &SessionStatus) -> Option<HandshakePurpose> {
        let Some(live) = &status.live else { return Some(HandshakePurpose::Session) };
        if status.silent_ns >= self.settings.silence_ns {
            // The slave may have restarted without this session. A slave that still has it answers `Leased`,
            // unless its frames arrive again first.
            return Some(if self.renews && live.confirmed {
                HandshakePurpose::Keys
            } else {
                HandshakePurpose::Session
            });
        }
        let is_due = status.due || live.age_ns >= self.settings.rekey_ns;
        // A renewal is keyed by the chain of the live keys. Until the slave has used them, it may still have
        // older ones.
        (is_due && live.confirmed).then_some(HandshakePurpose::Keys)
    }

    /// Return the message to send at `now_ns`, if any.
    pub(super) fn poll(
        &mut self,
        now_ns: u64,
        status: &SessionStatus,
        entropy: &mut dyn Entropy,
    ) -> Result<Option<HandshakeDatagram>, HandshakeError> {
        let Some(purpose) = self.needed_handshake(status) else {
            self.pending = None;
            return Ok(None);
        };
        let living = status.live.as_ref().map(|live| live.id);
        let over = self.pending.take_if(|pending| {
            let is_other = match purpose {
                HandshakePurpose::Session => pending.id.epoch != 0,
                HandshakePurpose::Keys => living.is_none_or(|living| living.session != pending.id.session),
            };
            is_other || now_ns.saturating_sub(pending.begun_ns) >= ATTEMPT_NS
        });
        if over.is_some_and(|over| over.id.epoch != 0) && self.renews {
            // No answer: the next attempt is a new session.
            self.renews = false;
            self.has_failed = true;
            return Ok(None);
        }
        if let Some(pending) = &mut self.pending {
            if now_ns < pending.next_ns {
                return Ok(None);
            }
            pending.wait_ns = (2 * pending.wait_ns).min(MAX_RETRY_NS);
            pending.next_ns = now_ns + pending.wait_ns;
            return Ok(Some(pending.datagram));
        }
        if now_ns < self.refused_until_ns && purpose == HandshakePurpose::Session {
            return Ok(None);
        }
        self.begin(now_ns, purpose, status, entropy).map(Some)
    }

    fn begin(
        &mut self,
        now_ns: u64,
        purpose: HandshakePurpose,
        status: &SessionStatus,
        entropy: &mut dyn Entropy,
    ) -> Result<HandshakeDatagram, HandshakeError> {
        let (id, key) = match (purpose, &status.live) {
            (HandshakePurpose::Keys, Some(live)) => {
                let before = self.newest.filter(|newest| newest.session == live.id.session);
                let epoch = before.map_or(live.id.epoch, |newest| newest.epoch.max(live.id.epoch));
                let epoch = epoch.checked_add(1).ok_or(HandshakeError::Noise)?;
                (EpochId { session: live.id.session, epoch }, Some(self.key.within(&live.chain)))
            }
            _ => (EpochId { session: entropy.number()?, epoch: 0 }, None),
        };
        let mut noise = Noise::new(self.settings.role, id, key.as_ref().unwrap_or(&self.key), entropy)?;
        let payload = HandshakePayload::new(self.run, self.settings.form, HandshakeDecision::Accepted)
            .with(self.ticket);
        let datagram = message(Kind::Hello, id, &noise.write(&payload.to_bytes())?, &self.mac);
        self.newest = Some(id);
        self.pending = Some(Pending {
            noise,
            id,
            datagram,
            begun_ns: now_ns,
            next_ns: now_ns + RETRY_NS,
            wait_ns: RETRY_NS,
        });
        Ok(datagram)
    }

    pub(super) fn receive(
        &mut self,
        now_ns: u64,
        header: &Header,
        datagram: &[u8],
        status: &SessionStatus,
    ) -> Result<Outcome, Rejection> {
        let id = EpochId { session: header.session, epoch: header.epoch };
        let pending =
            self.pending.as_mut().filter(|pending| pending.id == id).ok_or(Rejection::Unexpected)?;
        let payload = pending.noise.read(parts(datagram).1).map_err(|_| Rejection::Forged)?;
        let payload = HandshakePayload::from_bytes(payload).ok_or(Rejection::Forged)?;
        let Some(pending) = self.pending.take() else { return Err(Rejection::Unexpected) };
        if payload.decision != HandshakeDecision::Accepted {
            self.refused_until_ns = now_ns.saturating_add(REFUSED_NS);
            self.ticket = payload.ticket;
            self.renews =
                id.epoch == 0 && payload.decision == HandshakeDecision::Leased && status.live.is_some();
            if self.renews && !self.has_failed {
                return Ok(Outcome::default());
            }
            let event = HandshakeEvent::Refused { decision: payload.decision, form: payload.form };
            return Ok(Outcome { event: Some(event), ..Outcome::default() });
        }
        let keys = pending.noise.keys(now_ns, payload.run).map_err(|_| Rejection::Forged)?;
        (self.renews, self.has_failed) = (false, false);
        Ok(Outcome { keys: Some(keys), ..Outcome::default() })
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum HandshakePurpose {
    Session,
    Keys,
}

const MS: u64 = 1_000_000;

/// Refill interval in ns of two answer budgets: all requests for new sessions, and the peer of the present
/// session. A new answer costs the slave two multiplications on the curve, a repeated one none.
const ANSWER_NS: u64 = 250 * MS;
/// Burst of the renewal budget: for a new first message, and for a repeated one (lower).
const RENEWALS: u64 = 8;
const REPEATS: u64 = 4;
/// Time in ns for which a master retries one first message, with a margin.
const REPEATED_NS: u64 = 10_000 * MS;
/// Number of stored answers: the most that the budget grants to new sessions within [`REPEATED_NS`], a burst
/// of 8 and 40 more.
const ANSWERS: usize = 48;
/// Capacity in ephemeral keys remembered against replay.
const SEEN: usize = 256;
/// Number of issued tickets remembered; the oldest is overwritten first.
const TICKETS: usize = 4;

/// Answer that is sent again if its first message is repeated.
#[derive(Clone, Copy, Debug)]
struct Answered {
    id: EpochId,
    hello: HandshakeDatagram,
    answer: HandshakeDatagram,
    first_ns: u64,
}

#[derive(Debug)]
pub(super) struct Responder {
    settings: SessionSettings,
    key: PreSharedKey,
    mac: MacKey,
    run: u64,
    /// Answers to first messages of new sessions; the oldest is overwritten first.
    answered: Vec<Answered>,
    next_answer: usize,
    /// Answer to the peer's last renewal request. Stored apart, so that requests for new sessions cannot
    /// overwrite it.
    renewed: Option<Answered>,
    /// Ephemeral keys of authentic first messages; the oldest is overwritten first.
    seen: Box<[[u8; EPHEMERAL]]>,
    next_seen: usize,
    answers: Shares,
    renewals: Bucket,
    tickets: [Option<Ticket>; TICKETS],
    next_ticket: usize,
}

impl Responder {
    pub(super) fn new(settings: SessionSettings, key: PreSharedKey, run: u64) -> Self {
        Self {
            settings,
            mac: key.mac(),
            key,
            run,
            answered: Vec::with_capacity(ANSWERS),
            next_answer: 0,
            renewed: None,
            seen: vec![[0; EPHEMERAL]; SEEN].into_boxed_slice(),
            next_seen: 0,
            answers: Shares::new(ANSWER_NS),
            renewals: Bucket::default(),
            tickets: [None; TICKETS],
            next_ticket: 0,
        }
    }

    /// Take a first message that was sent from `from`.
    pub(super) fn receive(
        &mut self,
        now_ns: u64,
        from: SocketAddr,
        header: &Header,
        datagram: &HandshakeDatagram,
        status: &SessionStatus,
        entropy: &mut dyn Entropy,
    ) -> Result<Outcome, Rejection> {
        let id = EpochId { session: header.session, epoch: header.epoch };
        let is_renewal = status.is_renewal(id)?;
        // While the peer is heard, or was heard recently, the answer goes to the address of its frames.
        let to_peer = is_renewal && status.silent_ns < self.settings.silence_ns;
        let (ephemeral, said) = parts(datagram);
        if let Some(answered) = self.answered(datagram, is_renewal) {
            if now_ns.saturating_sub(answered.first_ns) >= REPEATED_NS {
                return Err(Rejection::Replayed);
            }
            let reply = Some(answered.answer);
            self.spend(now_ns, from, is_renewal, REPEATS)?;
            return Ok(Outcome { reply, to_peer, ..Outcome::default() });
        }
        // A master requests each epoch once, in increasing order; a lower or equal one in another message is
        // a recording of an abandoned request.
        let is_given_up = self.renewed.is_some_and(|renewed| {
            is_renewal && renewed.id.session == id.session && id.epoch <= renewed.id.epoch
        });
        if is_given_up || self.seen.iter().any(|seen| seen == ephemeral) {
            return Err(Rejection::Replayed);
        }
        let renewal_key = match &status.live {
            Some(live) if is_renewal => Some(self.key.within(&live.chain)),
            _ => None,
        };
        let key = renewal_key.as_ref().unwrap_or(&self.key);
        let mut noise = Noise::new(self.settings.role, id, key, entropy).map_err(|error| match error {
            HandshakeError::Entropy(_) => Rejection::Unable,
            HandshakeError::Noise => Rejection::Forged,
        })?;
        let payload = noise.read(said).map_err(|_| Rejection::Forged)?;
        let payload = HandshakePayload::from_bytes(payload).ok_or(Rejection::Forged)?;
        // From here the message is authentic but may be a replay, so rate and memory are bounded.
        self.spend(now_ns, from, is_renewal, RENEWALS)?;
        self.seen[self.next_seen].copy_from_slice(ephemeral);
        self.next_seen = (self.next_seen + 1) % SEEN;
        let decision = self.admit(is_renewal, &payload, status);
        let mut word = HandshakePayload::new(self.run, self.settings.form, decision);
        // A holder of the lease that lost its session is not a second master.
        let is_other = decision == HandshakeDecision::Leased && status.holder != Some(payload.run);
        let mut lives = false;
        if is_other {
            lives = self.redeem(payload.ticket);
            word = word.with(self.issue(entropy)?);
        }
        let answer = noise.write(&word.to_bytes()).map_err(|_| Rejection::Unable)?;
        let answer = message(Kind::Answer, id, &answer, &self.mac);
        self.keep(Answered { id, hello: *datagram, answer, first_ns: now_ns }, is_renewal);
        let keys = match decision {
            HandshakeDecision::Accepted => {
                Some(noise.keys(now_ns, payload.run).map_err(|_| Rejection::Unable)?)
            }
            _ => None,
        };
        let event = match decision {
            HandshakeDecision::Leased if lives => Some(HandshakeEvent::SecondMaster { run: payload.run }),
            HandshakeDecision::PayloadForm => Some(HandshakeEvent::Refused { decision, form: payload.form }),
            HandshakeDecision::Accepted | HandshakeDecision::Leased => None,
        };
        Ok(Outcome { reply: Some(answer), to_peer, keys, event })
    }

    fn admit(
        &self,
        is_renewal: bool,
        payload: &HandshakePayload,
        status: &SessionStatus,
    ) -> HandshakeDecision {
        if !is_renewal && status.holder.is_some() {
            HandshakeDecision::Leased
        } else if payload.form != self.settings.form {
            HandshakeDecision::PayloadForm
        } else {
            HandshakeDecision::Accepted
        }
    }

    /// Find the earlier answer to the same first message.
    fn answered(&self, datagram: &HandshakeDatagram, is_renewal: bool) -> Option<&Answered> {
        let kept = if is_renewal { self.renewed.as_slice() } else { self.answered.as_slice() };
        kept.iter().find(|answered| answered.hello == *datagram)
    }

    #[allow(clippy::large_types_passed_by_value)] // moved into its slot
    fn keep(&mut self, answered: Answered, is_renewal: bool) {
        if is_renewal {
            self.renewed = Some(answered);
        } else if self.answered.len() < ANSWERS {
            self.answered.push(answered);
        } else {
            self.answered[self.next_answer] = answered;
            self.next_answer = (self.next_answer + 1) % ANSWERS;
        }
    }

    /// Charge one answer, first or repeated, to the sender's budget. `burst` applies to renewals only.
    fn spend(
        &mut self,
        now_ns: u64,
        from: SocketAddr,
        is_renewal: bool,
        burst: u64,
    ) -> Result<(), Rejection> {
        let is_granted = if is_renewal {
            self.renewals.take(now_ns, ANSWER_NS, burst)
        } else {
            self.answers.take(now_ns, from)
        };
        is_granted.then_some(()).ok_or(Rejection::Busy)
    }

    fn issue(&mut self, entropy: &mut dyn Entropy) -> Result<Ticket, Rejection> {
        let mut ticket = NO_TICKET;
        entropy.fill(&mut ticket).map_err(|_| Rejection::Unable)?;
        self.tickets[self.next_ticket] = Some(ticket);
        self.next_ticket = (self.next_ticket + 1) % TICKETS;
        Ok(ticket)
    }

    /// Return whether a ticket is one of ours and unused; it is then used.
    fn redeem(&mut self, ticket: Ticket) -> bool {
        ticket != NO_TICKET
            && self.tickets.iter_mut().any(|issued| issued.take_if(|issued| *issued == ticket).is_some())
    }
}

const _: () = assert!(HANDSHAKE_LENGTH == std::mem::size_of::<HandshakeDatagram>());
