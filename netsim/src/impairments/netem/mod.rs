//! Linux `tc netem`, with its quirks, for settings that were published for it.
//!
//! Order per packet: draw of duplication; draw of loss (both together cancel: the packet passes once); the
//! copy, through all later steps with its own loss draw; corruption of one bit; limit of held packets. Then
//! follows either reordering, which sends the packet at once, or delay. Consequences:
//!
//! - A negative delay is no delay: normal 10 ms +-10 ms becomes 10.83 ms +-8.66 ms.
//! - Tables end at four standard deviations.
//! - Correlated draws are `y = (1 - rho) u + rho y_prev`, narrower than u, so rare events almost vanish (a
//!   loss of 1 % with 25 % becomes 0.0003 %). Delays take such a draw modulo twice the jitter, or modulo the
//!   table length. This makes it uniform and independent again unless the jitter is of the order of seconds:
//!   delay correlation has no effect.
//! - Jitter larger than the packet spacing reorders packets. With a rate it does not, because each packet
//!   leaves after the previous one.
//! - The delay elapses while a packet waits for the rate.
//! - If more than `limit` packets are held, 1000 by default, further ones are dropped; packets in delay
//!   count.
//!
//! Differences: netem draws everything from one generator. Here each draw belongs to a packet, so runs repeat
//! and an additional packet shifts only the correlated states. For `rate`, packet length is the payload plus
//! 42 bytes of headers (Ethernet, IPv4, UDP). A draw exactly at a bound, one in 2^32, may count for the other
//! side. `slot` and `seed` are refused.
//!
//! Source: `sch_netem.c` of Linux 6.18; `tc-netem(8)`.

mod arguments;
mod table;
mod translate;

#[cfg(test)]
mod tests;

use std::cmp::Reverse;
use std::collections::BinaryHeap;

pub use translate::{Asked, translate};

use self::arguments::{Arguments, Chance, Loss, Rate, Table};
use crate::checks::LinkSettingsError;
use crate::damage::{Damage, Flips};
use crate::impairments::Impairment;
use crate::impairments::LinkSettings;
use crate::impairments::Streams;
use crate::packet::Packet;
use crate::random::Stream;
use crate::rule::{ArrivalRule, Extras};
use crate::verdict::{DropCause, Extra, ExtraCause, Verdict};

/// Size of Ethernet, IPv4 and UDP headers in bytes, which count for the rate.
const HEADERS: i64 = 42;
const NS_PER_S: u64 = 1_000_000_000;

/// Substreams; each packet has two draws, for itself and for its copy.
const DUPLICATE: u8 = 0;
const LOSS: u8 = 1;
const STATE: u8 = 2;
const CORRUPT: u8 = 3;
const REORDER: u8 = 4;
const DELAY: u8 = 5;
const BIT: u8 = 6;
const COPY_BIT: u8 = 7;
const FIRST_STATE: u8 = 8;

#[derive(Clone, Copy, Debug)]
struct Draws {
    stream: Stream,
    index: u64,
    is_copy: bool,
}

impl Draws {
    fn of(&self, usage: u8) -> u32 {
        upper(self.stream.nth(usage).pair(self.index)[usize::from(self.is_copy)])
    }
}

#[derive(Clone, Copy, Debug)]
struct Correlated {
    rho: u32,
    last: u32,
}

impl Correlated {
    /// Next number, from a uniform one; in units of 2^-32, as the kernel computes it.
    fn next(&mut self, uniform: u32) -> u32 {
        if self.rho == 0 {
            return uniform;
        }
        let rho = u64::from(self.rho) + 1;
        let mixed = u64::from(uniform) * ((1 << 32) - rho) + u64::from(self.last) * rho;
        self.last = upper(mixed);
        self.last
    }
}

#[derive(Clone, Copy, Debug)]
struct Event {
    probability: u32,
    draws: Correlated,
}

impl Event {
    fn new(chance: Chance, first: u32) -> Self {
        Self { probability: chance.probability, draws: Correlated { rho: chance.rho, last: first } }
    }

    fn occurs(&mut self, draws: &Draws, usage: u8) -> bool {
        self.probability > 0 && self.probability >= self.draws.next(draws.of(usage))
    }
}

/// Loss model and its state: one of 4 states, or good and bad.
#[derive(Clone, Copy, Debug)]
enum Losing {
    Random(Event),
    State { state: u8, p13: u32, p31: u32, p32: u32, p23: u32, p14: u32 },
    Gilbert { is_bad: bool, p: u32, r: u32, loss_bad: u32, loss_good: u32 },
}

impl Losing {
    fn new(loss: Loss, first: u32) -> Self {
        match loss {
            Loss::Random(chance) => Self::Random(Event::new(chance, first)),
            Loss::State { p13, p31, p32, p23, p14 } => Self::State { state: 1, p13, p31, p32, p23, p14 },
            Loss::Gilbert { p, r, loss_bad, loss_good } => {
                Self::Gilbert { is_bad: false, p, r, loss_bad, loss_good }
            }
        }
    }

    fn loses(&mut self, draws: &Draws) -> bool {
        match self {
            Self::Random(event) => event.occurs(draws, LOSS),
            Self::State { state, p13, p31, p32, p23, p14 } => {
                *state = four_state(*state, draws.of(STATE), [*p13, *p31, *p32, *p23, *p14]);
                *state == 3 || *state == 4
            }
            // The state changes first; the previous state decides the loss.
            Self::Gilbert { is_bad, p, r, loss_bad, loss_good } => {
                let was_bad = *is_bad;
                if draws.of(STATE) < if was_bad { *r } else { *p } {
                    *is_bad = !was_bad;
                }
                let uniform = draws.of(LOSS);
                if was_bad { uniform > u32::MAX - *loss_bad } else { uniform < *loss_good }
            }
        }
    }
}

/// Next state; a packet is lost on entering 3 or 4.
fn four_state(state: u8, uniform: u32, [p13, p31, p32, p23, p14]: [u32; 5]) -> u8 {
    match state {
        1 if uniform < p14 => 4,
        1 if uniform < p13.wrapping_add(p14) => 3,
        2 if uniform < p23 => 3,
        2 => 2,
        3 if uniform < p32 => 2,
        3 if uniform < p31.wrapping_add(p32) => 1,
        3 => 3,
        _ => 1,
    }
}

/// Netem as the only rule of a path.
#[derive(Clone, Debug)]
struct Netem {
    limit: usize,
    latency_ns: i64,
    jitter_ns: i64,
    table: Vec<i16>,
    delay: Correlated,
    losing: Losing,
    duplicate: Event,
    corrupt: Event,
    reorder: Event,
    gap: u32,
    rate: Option<Rate>,
    stream: Stream,
    /// Departure times of the held packets.
    held: BinaryHeap<Reverse<u64>>,
    latest_ns: u64,
    since_reordered: u32,
}

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn ArrivalRule>>, LinkSettingsError> {
    let Some(text) = &settings.netem else {
        return Ok(None);
    };
    let alone = LinkSettings { netem: settings.netem.clone(), ..LinkSettings::default() };
    if *settings != alone {
        return Err(LinkSettingsError::contradiction(
            "netem",
            "nothing else may be given for the link beside it",
        ));
    }
    let arguments = Arguments::read(text)?;
    let stream = streams.of(Impairment::Netem);
    // The kernel also starts each correlated generator at a random value.
    let first = |position| upper(stream.nth(FIRST_STATE).bits(position));
    Ok(Some(Box::new(Netem {
        limit: arguments.limit,
        latency_ns: arguments.latency_ns,
        jitter_ns: arguments.jitter_ns,
        table: match arguments.table {
            Table::Uniform => Vec::new(),
            Table::Normal => table::normal(),
            Table::Pareto => table::pareto(),
            Table::ParetoNormal => table::pareto_normal(),
        },
        delay: Correlated { rho: arguments.delay_rho, last: first(0) },
        losing: Losing::new(arguments.loss, first(1)),
        duplicate: Event::new(arguments.duplicate, first(2)),
        corrupt: Event::new(arguments.corrupt, first(3)),
        reorder: Event::new(arguments.reorder, first(4)),
        gap: arguments.gap,
        rate: arguments.rate,
        stream,
        held: BinaryHeap::with_capacity(arguments.limit.min(65_536)),
        latest_ns: 0,
        since_reordered: 0,
    })))
}

impl ArrivalRule for Netem {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        while self.held.peek().is_some_and(|Reverse(due_ns)| *due_ns <= at_ns) {
            self.held.pop();
        }
        let draws = Draws { stream: self.stream, index: packet.index, is_copy: false };
        let is_doubled = self.duplicate.occurs(&draws, DUPLICATE);
        let is_lost = self.losing.loses(&draws);
        if is_lost && !is_doubled {
            return Verdict::Drop { cause: DropCause::Loss };
        }
        let copy = Draws { is_copy: true, ..draws };
        if is_doubled
            && !is_lost
            && !self.losing.loses(&copy)
            && let Ok((at_ns, damage)) = self.hold(packet, at_ns, &copy)
        {
            // There is room: it is the only extra.
            let _ = extras.try_push(Extra { at_ns, cause: ExtraCause::Duplicate, damage });
        }
        match self.hold(packet, at_ns, &draws) {
            Ok((at_ns, change)) => {
                *damage = change;
                Verdict::Deliver { at_ns }
            }
            Err(cause) => Verdict::Drop { cause },
        }
    }
}

impl Netem {
    fn hold(&mut self, packet: &Packet, now_ns: u64, draws: &Draws) -> Result<(u64, Damage), DropCause> {
        let mut damage = Damage::NONE;
        if self.corrupt.occurs(draws, CORRUPT) {
            let stream = self.stream.nth(if draws.is_copy { COPY_BIT } else { BIT });
            let corrupted = Flips { bits: 1, stream, ..Flips::NONE };
            damage = Damage { corrupted, index: packet.index, ..Damage::NONE };
        }
        if self.held.len() >= self.limit {
            return Err(DropCause::Queue);
        }
        if self.jumps_ahead(draws) {
            self.since_reordered = 0;
            return Ok((now_ns, damage));
        }
        self.since_reordered = self.since_reordered.saturating_add(1);
        let due_ns = self.due_ns(packet, now_ns, draws);
        self.latest_ns = self.latest_ns.max(due_ns);
        if due_ns > now_ns {
            self.held.push(Reverse(due_ns));
        }
        Ok((due_ns, damage))
    }

    fn jumps_ahead(&mut self, draws: &Draws) -> bool {
        self.gap > 0 && self.since_reordered >= self.gap - 1 && self.reorder.occurs(draws, REORDER)
    }

    fn due_ns(&mut self, packet: &Packet, now_ns: u64, draws: &Draws) -> u64 {
        let delay_ns = self.delay_ns(draws);
        let mut due_ns = i128::from(now_ns) + i128::from(delay_ns);
        if let Some(rate) = self.rate {
            if self.latest_ns > now_ns {
                due_ns = due_ns.max(i128::from(self.latest_ns));
            }
            due_ns += i128::from(rate.transmission_ns(packet.size));
        }
        // A packet that would leave before its arrival leaves at once.
        u64::try_from(due_ns.clamp(i128::from(now_ns), i128::from(u64::MAX))).unwrap_or(u64::MAX)
    }

    fn delay_ns(&mut self, draws: &Draws) -> i64 {
        let sigma = self.jitter_ns;
        if sigma == 0 {
            return self.latency_ns;
        }
        let random = self.delay.next(draws.of(DELAY));
        let Some(length) = u32::try_from(self.table.len()).ok().filter(|length| *length > 0) else {
            return i64::from(random) % (2 * sigma) + self.latency_ns - sigma;
        };
        let point = i64::from(self.table[(random % length) as usize]);
        let part = (sigma % table::SCALE) * point;
        let half = if part >= 0 { table::SCALE / 2 } else { -table::SCALE / 2 };
        (part + half) / table::SCALE + (sigma / table::SCALE) * point + self.latency_ns
    }
}

impl Rate {
    fn transmission_ns(&self, payload: usize) -> u64 {
        let payload = i64::try_from(payload).unwrap_or(i64::MAX / 2);
        let mut bytes = payload.saturating_add(HEADERS + i64::from(self.overhead)).max(0).unsigned_abs();
        if self.cell_size > 0 {
            let cell = i64::from(self.cell_size) + i64::from(self.cell_overhead);
            bytes = bytes.div_ceil(u64::from(self.cell_size)).saturating_mul(cell.max(0).unsigned_abs());
        }
        bytes.saturating_mul(NS_PER_S) / self.bytes_per_s
    }
}

fn upper(bits: u64) -> u32 {
    (bits >> 32) as u32
}
