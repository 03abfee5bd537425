//! The slave's side of handshakes: whom to answer, how often, and with what word.

use super::{
    entropy::Entropy,
    handshake::{HandshakeDatagram, HandshakeEvent, Outcome, message, parts},
    header::{EPHEMERAL, HANDSHAKE_LENGTH, Header, Kind},
    keys::{EpochId, PreSharedKey},
    noise::{HandshakeError, Noise},
    rejection::Rejection,
    report::Standing,
    settings::SessionSettings,
    told::{Told, Verdict},
};

const MS: u64 = 1_000_000;

/// First messages answered at once; each costs the slave one multiplication on the curve.
const BURST: u64 = 8;
/// One more each.
const ANSWER_NS: u64 = 250 * MS;
/// Repeats of one first message that are answered, with the same bytes: as often as a master sends it.
const REPEATS: u32 = 7;
/// And no faster than this: what comes sooner is a copy that the network made.
const REPEAT_NS: u64 = 100 * MS;
/// How long a master repeats one first message, and a little.
const REPEATED_NS: u64 = 10_000 * MS;
/// Answers kept for repeats.
const ANSWERS: usize = 4;
/// Ephemeral keys kept against replay.
const SEEN: usize = 256;
/// Handshakes of a session that may have failed before one is answered.
const MOST_SKIPPED: u32 = 1024;

/// An answer that its question, repeated, gets again.
#[derive(Clone, Copy, Debug)]
struct Answered {
    hello: HandshakeDatagram,
    answer: HandshakeDatagram,
    first_ns: u64,
    next_ns: u64,
    left: u32,
}

#[derive(Debug)]
pub(super) struct Responder {
    settings: SessionSettings,
    key: PreSharedKey,
    run: u64,
    answered: [Option<Answered>; ANSWERS],
    next_answer: usize,
    /// Ephemeral keys of first messages that were authentic, the oldest overwritten first.
    seen: Box<[[u8; EPHEMERAL]]>,
    next_seen: usize,
    /// When the budget of answers is full again.
    full_ns: u64,
}

impl Responder {
    pub(super) fn new(settings: SessionSettings, key: PreSharedKey, run: u64) -> Self {
        Self {
            settings,
            key,
            run,
            answered: [None; ANSWERS],
            next_answer: 0,
            seen: vec![[0; EPHEMERAL]; SEEN].into_boxed_slice(),
            next_seen: 0,
            full_ns: 0,
        }
    }

    /// Takes a first message.
    pub(super) fn receive(
        &mut self,
        now_ns: u64,
        header: &Header,
        datagram: &HandshakeDatagram,
        standing: &Standing,
        entropy: &mut dyn Entropy,
    ) -> Result<Outcome, Rejection> {
        let id = EpochId { session: header.session, epoch: header.epoch };
        let living = standing.live.map(|live| live.id);
        let (ephemeral, said) = parts(datagram);
        let is_known = self.seen.iter().any(|seen| seen == ephemeral);
        if is_known {
            // The peer has these keys already: nothing is left to answer.
            let is_over =
                living.is_some_and(|living| living.session == id.session && living.epoch >= id.epoch);
            return if is_over { Err(Rejection::Replayed) } else { self.repeat(now_ns, datagram) };
        }
        let key = match standing.live {
            _ if id.epoch == 0 && living.is_none_or(|living| living.session != id.session) => {
                self.key.clone()
            }
            Some(live) if live.id.session == id.session => {
                let skipped = id.epoch.checked_sub(live.id.epoch).ok_or(Rejection::Epoch)?;
                if skipped == 0 || skipped > MOST_SKIPPED {
                    return Err(Rejection::Epoch);
                }
                self.key.within(&live.chain)
            }
            _ => return Err(Rejection::Session),
        };
        let mut noise = Noise::new(self.settings.role, id, &key, entropy).map_err(|error| match error {
            HandshakeError::Entropy(_) => Rejection::Unable,
            HandshakeError::Noise => Rejection::Forged,
        })?;
        let told = noise.read(said).map_err(|_| Rejection::Forged)?;
        let told = Told::from_bytes(told).ok_or(Rejection::Forged)?;
        // Authentic from here on, though perhaps recorded: what follows is bounded in rate and in memory.
        self.spend(now_ns)?;
        self.seen[self.next_seen].copy_from_slice(ephemeral);
        self.next_seen = (self.next_seen + 1) % SEEN;
        let verdict = self.judge(id, &told, standing);
        let word = Told::new(self.run, self.settings.payload_length, verdict);
        let answer = noise.write(&word.to_bytes()).map_err(|_| Rejection::Unable)?;
        let answer = message(Kind::Answer, id, &answer);
        self.answered[self.next_answer] = Some(Answered {
            hello: *datagram,
            answer,
            first_ns: now_ns,
            next_ns: now_ns.saturating_add(REPEAT_NS),
            left: REPEATS,
        });
        self.next_answer = (self.next_answer + 1) % ANSWERS;
        let keys = match verdict {
            Verdict::Accepted => Some(noise.keys(now_ns, told.run).map_err(|_| Rejection::Unable)?),
            _ => None,
        };
        let event = match verdict {
            Verdict::Accepted => None,
            // The holder itself, which has lost touch, is no second master.
            Verdict::Leased if standing.holder == Some(told.run) => None,
            Verdict::Leased => Some(HandshakeEvent::SecondMaster { run: told.run }),
            Verdict::PayloadLength => {
                Some(HandshakeEvent::Refused { verdict, payload_length: told.payload_length })
            }
        };
        Ok(Outcome { reply: Some(answer), keys, event })
    }

    fn judge(&self, id: EpochId, told: &Told, standing: &Standing) -> Verdict {
        if id.epoch == 0 && standing.holder.is_some() {
            Verdict::Leased
        } else if usize::from(told.payload_length) != self.settings.payload_length {
            Verdict::PayloadLength
        } else {
            Verdict::Accepted
        }
    }

    /// The answer to a first message that was answered before, if it is due again.
    fn repeat(&mut self, now_ns: u64, datagram: &HandshakeDatagram) -> Result<Outcome, Rejection> {
        let answered = self
            .answered
            .iter_mut()
            .flatten()
            .find(|answered| answered.hello == *datagram)
            .filter(|answered| answered.left > 0 && now_ns >= answered.next_ns)
            .filter(|answered| now_ns.saturating_sub(answered.first_ns) < REPEATED_NS)
            .ok_or(Rejection::Replayed)?;
        answered.left -= 1;
        answered.next_ns = now_ns.saturating_add(REPEAT_NS);
        Ok(Outcome { reply: Some(answered.answer), ..Outcome::default() })
    }

    /// Takes one answer from the budget: [`BURST`] at once, one more each [`ANSWER_NS`].
    fn spend(&mut self, now_ns: u64) -> Result<(), Rejection> {
        let full_ns = self.full_ns.max(now_ns).saturating_add(ANSWER_NS);
        if full_ns - now_ns > BURST * ANSWER_NS {
            return Err(Rejection::Busy);
        }
        self.full_ns = full_ns;
        Ok(())
    }
}

const _: () = assert!(HANDSHAKE_LENGTH == std::mem::size_of::<HandshakeDatagram>());
