//! Handshakes, off the tick: they cost a millisecond and allocate.
//!
//! [`Handshake`] holds the shared key and makes keys; [`super::Session`] holds the keys and seals. Between them go
//! only values: a [`Standing`] and a datagram in, an [`Outcome`] out. So they may live on two threads.

use std::net::SocketAddr;

use super::{
    budget::{Bucket, Shares},
    keys::{Epoch, EpochId, MacKey, PreSharedKey},
    noise::{Entropy, HandshakeError, MESSAGE, Noise},
    session::Standing,
    settings::SessionSettings,
    wire::{
        EPHEMERAL, HANDSHAKE_LENGTH, HandshakeDecision, HandshakePayload, Header, Kind, NO_TICKET, Rejection,
        Rejections, SESSION_HEADER, Ticket, write_mac,
    },
};
use crate::wire::{FrameForm, Role};

/// A handshake message with its header.
pub type HandshakeDatagram = [u8; HANDSHAKE_LENGTH];

/// The result of a handshake message.
#[derive(Debug, Default)]
pub struct Outcome {
    /// To send: back, or to the peer.
    pub reply: Option<HandshakeDatagram>,
    /// Whether it goes to the address of the peer's frames, not to that of the request: who repeats the peer's message
    /// from elsewhere does not draw the answer away.
    pub to_peer: bool,
    /// For [`super::Session::install`].
    pub keys: Option<Epoch>,
    /// For the screen and the log.
    pub event: Option<HandshakeEvent>,
}

/// A handshake that does not end in keys, for the screen and the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HandshakeEvent {
    /// There will be no session. Reported at both sides when the payloads differ, at the master for any reason.
    Refused {
        /// Why.
        decision: HandshakeDecision,
        /// What stands in the peer's payloads.
        form: FrameForm,
    },
    /// Reported at the slave: another master with the key was refused, because one holds the lease. It lives: it has
    /// sent back what the first refusal had for it, which no recorded message does.
    SecondMaster {
        /// What that master drew when it started.
        run: u64,
    },
}

/// Puts a header before a handshake message and its MAC behind it.
pub(super) fn message(kind: Kind, id: EpochId, said: &[u8; MESSAGE], mac: &MacKey) -> HandshakeDatagram {
    let mut datagram = [0; HANDSHAKE_LENGTH];
    let header = Header { kind, epoch: id.epoch, session: id.session, counter: 0 };
    datagram[..SESSION_HEADER].copy_from_slice(&header.to_bytes());
    datagram[SESSION_HEADER..SESSION_HEADER + MESSAGE].copy_from_slice(said);
    write_mac(&mut datagram, mac);
    datagram
}

/// Session and epoch in the header of a handshake datagram.
pub(crate) fn session_and_epoch(datagram: &HandshakeDatagram) -> (u64, u32) {
    let [_, _, _, _, e0, e1, e2, e3, s0, s1, s2, s3, s4, s5, s6, s7, ..] = *datagram;
    (u64::from_le_bytes([s0, s1, s2, s3, s4, s5, s6, s7]), u32::from_le_bytes([e0, e1, e2, e3]))
}

/// Whether a handshake datagram is the slave's.
pub(crate) fn message_is_answer(datagram: &HandshakeDatagram) -> bool {
    datagram[3] == Kind::Answer.byte()
}

/// The ephemeral key of a handshake datagram, and all of the message between header and MAC.
pub(super) fn parts(datagram: &[u8]) -> (&[u8], &[u8]) {
    (
        &datagram[SESSION_HEADER..SESSION_HEADER + EPHEMERAL],
        &datagram[SESSION_HEADER..SESSION_HEADER + MESSAGE],
    )
}

#[allow(clippy::large_enum_variant)] // one for a whole run
#[derive(Debug)]
enum Side {
    Master(Initiator),
    Slave(Responder),
}

/// The handshakes of one side.
#[derive(Debug)]
pub struct Handshake {
    role: Role,
    side: Side,
    rejections: Rejections,
}

impl Handshake {
    /// The handshakes of the side of `settings`, with the shared key; `entropy` marks this run of it.
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

    /// Takes a datagram that [`super::Session::open`] handed on, and that was sent from `from`. One that is refused
    /// changes nothing but a count.
    pub fn receive(
        &mut self,
        now_ns: u64,
        from: SocketAddr,
        datagram: &[u8],
        standing: &Standing,
        entropy: &mut dyn Entropy,
    ) -> Result<Outcome, Rejection> {
        let outcome = Header::read(datagram, self.role, HANDSHAKE_LENGTH).and_then(|header| {
            let datagram: &HandshakeDatagram = datagram.try_into().map_err(|_| Rejection::Length)?;
            match &mut self.side {
                Side::Master(initiator) => initiator.receive(now_ns, &header, datagram, standing),
                Side::Slave(responder) => {
                    responder.receive(now_ns, from, &header, datagram, standing, entropy)
                }
            }
        });
        outcome.inspect_err(|rejection| self.rejections.count(*rejection))
    }

    /// The message to send at `now_ns`, if any: the first of a handshake, or the same again. Never at the slave.
    ///
    /// To be called each 10 ms or so.
    pub fn poll(
        &mut self,
        now_ns: u64,
        standing: &Standing,
        entropy: &mut dyn Entropy,
    ) -> Result<Option<HandshakeDatagram>, HandshakeError> {
        match &mut self.side {
            Side::Master(initiator) => initiator.poll(now_ns, standing, entropy),
            Side::Slave(_) => Ok(None),
        }
    }

    /// Handshake messages not taken, by cause.
    pub fn rejections(&self) -> Rejections {
        self.rejections
    }
}

/// First wait for an answer. The operator waits for this; a link with a longer round trip costs some repeats and no
/// time, because every repeat is the same message and any answer to it will do.
const RETRY_NS: u64 = 250 * MS;
/// The wait doubles up to this, so that a slave that is not there is not flooded and one that starts is found soon.
const MAX_RETRY_NS: u64 = 2000 * MS;
/// A handshake without an answer is given up, and one with new keys begun: seven sendings, and longer than any
/// round trip that anybody teleoperates over.
const ATTEMPT_NS: u64 = 8000 * MS;
/// Wait after the slave has refused: the operator at the slave has to do something first.
const REFUSED_NS: u64 = 1000 * MS;

/// A handshake that waits for its answer.
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
    /// The newest epoch requested: a number stands for one handshake, never for two.
    newest: Option<EpochId>,
    refused_until_ns: u64,
    /// The slave lives and has refused a new session, as one holds the lease: perhaps ours, whose next keys it gives.
    renews: bool,
    /// That has failed before: the lease is another's.
    has_failed: bool,
    /// Of the last refusal.
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

    /// Which handshake the session needs now: a new session, or new keys within the living one.
    fn wanted(&self, standing: &Standing) -> Option<Wish> {
        let Some(live) = &standing.live else { return Some(Wish::Session) };
        if standing.silent_ns >= self.settings.silence_ns {
            // The slave may have started anew and know nothing of this session. If it does, it refuses, or is heard.
            return Some(if self.renews && live.confirmed { Wish::Keys } else { Wish::Session });
        }
        let is_due = standing.due || live.age_ns >= self.settings.rekey_ns;
        // Keys that the slave has not used yet are not those that it would bind the next handshake to.
        (is_due && live.confirmed).then_some(Wish::Keys)
    }

    /// The message to send at `now_ns`, if any.
    pub(super) fn poll(
        &mut self,
        now_ns: u64,
        standing: &Standing,
        entropy: &mut dyn Entropy,
    ) -> Result<Option<HandshakeDatagram>, HandshakeError> {
        let Some(wish) = self.wanted(standing) else {
            self.pending = None;
            return Ok(None);
        };
        let living = standing.live.as_ref().map(|live| live.id);
        let over = self.pending.take_if(|pending| {
            let is_other = match wish {
                Wish::Session => pending.id.epoch != 0,
                Wish::Keys => living.is_none_or(|living| living.session != pending.id.session),
            };
            is_other || now_ns.saturating_sub(pending.begun_ns) >= ATTEMPT_NS
        });
        if over.is_some_and(|over| over.id.epoch != 0) && self.renews {
            // Without an answer: a new session, next.
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
        if now_ns < self.refused_until_ns && wish == Wish::Session {
            return Ok(None);
        }
        self.begin(now_ns, wish, standing, entropy).map(Some)
    }

    fn begin(
        &mut self,
        now_ns: u64,
        wish: Wish,
        standing: &Standing,
        entropy: &mut dyn Entropy,
    ) -> Result<HandshakeDatagram, HandshakeError> {
        let (id, key) = match (wish, &standing.live) {
            (Wish::Keys, Some(live)) => {
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

    /// Takes the slave's answer.
    pub(super) fn receive(
        &mut self,
        now_ns: u64,
        header: &Header,
        datagram: &[u8],
        standing: &Standing,
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
                id.epoch == 0 && payload.decision == HandshakeDecision::Leased && standing.live.is_some();
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
enum Wish {
    Session,
    Keys,
}

const MS: u64 = 1_000_000;

/// Answers, one each: to all who request a new session together, and again to the partner of the living one. Each costs
/// the slave one multiplication on the curve.
const ANSWER_NS: u64 = 250 * MS;
/// Answers to the partner at once, to a message that was not there before and to a repeat.
const RENEWALS: u64 = 8;
const REPEATS: u64 = 4;
/// How long a master repeats one first message, and a little.
const REPEATED_NS: u64 = 10_000 * MS;
/// Answers kept for repeats: those to new sessions within [`REPEATED_NS`], as often as they are given.
const ANSWERS: usize = 48;
/// Ephemeral keys kept against replay.
const SEEN: usize = 256;
/// Handshakes of a session that may have failed before one is answered.
pub(super) const MAX_SKIPPED: u32 = 1024;
/// Tickets of refusals that have not been returned.
const TICKETS: usize = 4;

/// An answer that its question, repeated, gets again.
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
    /// To first messages of new sessions, the oldest overwritten first.
    answered: Vec<Answered>,
    next_answer: usize,
    /// To the newest first message of the living session's partner: no flood of others overwrites it.
    renewed: Option<Answered>,
    /// Ephemeral keys of first messages that were authentic, the oldest overwritten first.
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

    /// Takes a first message that was sent from `from`.
    pub(super) fn receive(
        &mut self,
        now_ns: u64,
        from: SocketAddr,
        header: &Header,
        datagram: &HandshakeDatagram,
        standing: &Standing,
        entropy: &mut dyn Entropy,
    ) -> Result<Outcome, Rejection> {
        let id = EpochId { session: header.session, epoch: header.epoch };
        let is_renewal = standing.is_renewal(id)?;
        // While the partner is heard, or was lately, its answer goes there.
        let to_peer = is_renewal && standing.silent_ns < self.settings.silence_ns;
        let (ephemeral, said) = parts(datagram);
        if let Some(answered) = self.answered(datagram, is_renewal) {
            if now_ns.saturating_sub(answered.first_ns) >= REPEATED_NS {
                return Err(Rejection::Replayed);
            }
            let reply = Some(answered.answer);
            self.spend(now_ns, from, is_renewal, REPEATS)?;
            return Ok(Outcome { reply, to_peer, ..Outcome::default() });
        }
        // A master requests each epoch once, and for none below: what it gave up is recorded.
        let is_given_up = self.renewed.is_some_and(|renewed| {
            is_renewal && renewed.id.session == id.session && id.epoch <= renewed.id.epoch
        });
        if is_given_up || self.seen.iter().any(|seen| seen == ephemeral) {
            return Err(Rejection::Replayed);
        }
        let renewal_key = match &standing.live {
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
        // Authentic from here on, though perhaps recorded: what follows is bounded in rate and in memory.
        self.spend(now_ns, from, is_renewal, RENEWALS)?;
        self.seen[self.next_seen].copy_from_slice(ephemeral);
        self.next_seen = (self.next_seen + 1) % SEEN;
        let decision = self.admit(is_renewal, &payload, standing);
        let mut word = HandshakePayload::new(self.run, self.settings.form, decision);
        // The holder itself, which has lost touch, is no second master.
        let is_other = decision == HandshakeDecision::Leased && standing.holder != Some(payload.run);
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

    fn admit(&self, is_renewal: bool, payload: &HandshakePayload, standing: &Standing) -> HandshakeDecision {
        if !is_renewal && standing.holder.is_some() {
            HandshakeDecision::Leased
        } else if payload.form != self.settings.form {
            HandshakeDecision::PayloadForm
        } else {
            HandshakeDecision::Accepted
        }
    }

    /// The answer that a first message had before.
    fn answered(&self, datagram: &HandshakeDatagram, is_renewal: bool) -> Option<&Answered> {
        let kept = if is_renewal { self.renewed.as_slice() } else { self.answered.as_slice() };
        kept.iter().find(|answered| answered.hello == *datagram)
    }

    #[allow(clippy::large_types_passed_by_value)] // it is moved into its place
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

    /// Takes one answer, a repeat too, from the budget of its sender.
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

    /// A ticket for who is refused.
    fn issue(&mut self, entropy: &mut dyn Entropy) -> Result<Ticket, Rejection> {
        let mut ticket = NO_TICKET;
        entropy.fill(&mut ticket).map_err(|_| Rejection::Unable)?;
        self.tickets[self.next_ticket] = Some(ticket);
        self.next_ticket = (self.next_ticket + 1) % TICKETS;
        Ok(ticket)
    }

    /// Whether a ticket is one of ours, and was not used.
    fn redeem(&mut self, ticket: Ticket) -> bool {
        ticket != NO_TICKET
            && self.tickets.iter_mut().any(|issued| issued.take_if(|issued| *issued == ticket).is_some())
    }
}

const _: () = assert!(HANDSHAKE_LENGTH == std::mem::size_of::<HandshakeDatagram>());
