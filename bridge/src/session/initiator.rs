//! The master's side of handshakes: when to begin one, when to send again, when to give up.

use super::{
    entropy::Entropy,
    handshake::{HandshakeDatagram, HandshakeEvent, Outcome, message, parts},
    header::{Header, Kind},
    keys::{EpochId, MacKey, PreSharedKey},
    noise::{HandshakeError, Noise},
    rejection::Rejection,
    report::Standing,
    settings::SessionSettings,
    told::{NO_TICKET, Ticket, Told, Verdict},
};

const MS: u64 = 1_000_000;

/// First wait for an answer. A person waits for this; a link with a longer round trip costs some repeats and no time,
/// because every repeat is the same message and any answer to it will do.
const RETRY_NS: u64 = 250 * MS;
/// The wait doubles up to this, so that a slave that is not there is not flooded and one that comes is found soon.
const MAX_RETRY_NS: u64 = 2000 * MS;
/// A handshake without an answer is given up, and one with new keys begun: seven sendings, and longer than any
/// round trip that anybody teleoperates over.
const ATTEMPT_NS: u64 = 8000 * MS;
/// Wait after the slave has refused: the person at the slave has to do something first.
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
    /// The newest epoch asked for: a number stands for one handshake, never for two.
    asked: Option<EpochId>,
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
            asked: None,
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
                let before = self.asked.filter(|asked| asked.session == live.id.session);
                let epoch = before.map_or(live.id.epoch, |asked| asked.epoch.max(live.id.epoch));
                let epoch = epoch.checked_add(1).ok_or(HandshakeError::Noise)?;
                (EpochId { session: live.id.session, epoch }, Some(self.key.within(&live.chain)))
            }
            _ => (EpochId { session: entropy.number()?, epoch: 0 }, None),
        };
        let mut noise = Noise::new(self.settings.role, id, key.as_ref().unwrap_or(&self.key), entropy)?;
        let told = Told::new(self.run, self.settings.payload_length, Verdict::Accepted).with(self.ticket);
        let datagram = message(Kind::Hello, id, &noise.write(&told.to_bytes())?, &self.mac);
        self.asked = Some(id);
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
        let told = pending.noise.read(parts(datagram).1).map_err(|_| Rejection::Forged)?;
        let told = Told::from_bytes(told).ok_or(Rejection::Forged)?;
        let Some(pending) = self.pending.take() else { return Err(Rejection::Unexpected) };
        if told.verdict != Verdict::Accepted {
            self.refused_until_ns = now_ns.saturating_add(REFUSED_NS);
            self.ticket = told.ticket;
            self.renews = id.epoch == 0 && told.verdict == Verdict::Leased && standing.live.is_some();
            if self.renews && !self.has_failed {
                return Ok(Outcome::default());
            }
            let event =
                HandshakeEvent::Refused { verdict: told.verdict, payload_length: told.payload_length };
            return Ok(Outcome { event: Some(event), ..Outcome::default() });
        }
        let keys = pending.noise.keys(now_ns, told.run).map_err(|_| Rejection::Forged)?;
        (self.renews, self.has_failed) = (false, false);
        Ok(Outcome { keys: Some(keys), ..Outcome::default() })
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Wish {
    Session,
    Keys,
}
