//! The slave's side of handshakes: whom to answer, how often, and with what word.

use std::net::SocketAddr;

use super::{
    budget::{Bucket, Shares},
    entropy::Entropy,
    handshake::{HandshakeDatagram, HandshakeEvent, Outcome, message, parts},
    header::{EPHEMERAL, HANDSHAKE_LENGTH, Header, Kind},
    keys::{EpochId, MacKey, PreSharedKey},
    noise::{HandshakeError, Noise},
    rejection::Rejection,
    report::Standing,
    settings::SessionSettings,
    told::{NO_TICKET, Ticket, Told, Verdict},
};

const MS: u64 = 1_000_000;

/// Answers, one each: to all who ask for a new session together, and again to the partner of the living one. Each costs the
/// slave one multiplication on the curve.
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
/// Tickets of refusals that have not come back.
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

    /// Takes a first message that came from `from`.
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
        // A master asks for each epoch once, and for none below: what it gave up is recorded.
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
        let told = noise.read(said).map_err(|_| Rejection::Forged)?;
        let told = Told::from_bytes(told).ok_or(Rejection::Forged)?;
        // Authentic from here on, though perhaps recorded: what follows is bounded in rate and in memory.
        self.spend(now_ns, from, is_renewal, RENEWALS)?;
        self.seen[self.next_seen].copy_from_slice(ephemeral);
        self.next_seen = (self.next_seen + 1) % SEEN;
        let verdict = self.judge(is_renewal, &told, standing);
        let mut word = Told::new(self.run, self.settings.payload_length, verdict);
        // The holder itself, which has lost touch, is no second master.
        let is_other = verdict == Verdict::Leased && standing.holder != Some(told.run);
        let mut lives = false;
        if is_other {
            lives = self.redeem(told.ticket);
            word = word.with(self.issue(entropy)?);
        }
        let answer = noise.write(&word.to_bytes()).map_err(|_| Rejection::Unable)?;
        let answer = message(Kind::Answer, id, &answer, &self.mac);
        self.keep(Answered { id, hello: *datagram, answer, first_ns: now_ns }, is_renewal);
        let keys = match verdict {
            Verdict::Accepted => Some(noise.keys(now_ns, told.run).map_err(|_| Rejection::Unable)?),
            _ => None,
        };
        let event = match verdict {
            Verdict::Leased if lives => Some(HandshakeEvent::SecondMaster { run: told.run }),
            Verdict::PayloadLength => {
                Some(HandshakeEvent::Refused { verdict, payload_length: told.payload_length })
            }
            Verdict::Accepted | Verdict::Leased => None,
        };
        Ok(Outcome { reply: Some(answer), to_peer, keys, event })
    }

    fn judge(&self, is_renewal: bool, told: &Told, standing: &Standing) -> Verdict {
        if !is_renewal && standing.holder.is_some() {
            Verdict::Leased
        } else if usize::from(told.payload_length) != self.settings.payload_length {
            Verdict::PayloadLength
        } else {
            Verdict::Accepted
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

    /// Takes one answer, a repeat too, from the budget of who asks.
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
