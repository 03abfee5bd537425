//! Measurements of IRTT, the isochronous round-trip tester.

use std::fmt;

use serde::Deserialize;
use serde::de::{self, SeqAccess, Visitor};

use super::{DelayTrace, MAX_RECORDS, ParseError};
use crate::checks::MAX_DELAY_S;
use crate::packet::Direction;

const MAX_SPAN_NS: i64 = 1_000_000_000_000_000_000;

/// Kind of delays in an [`IrttRecording`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IrttDelay {
    /// One-way delays between two clocks. Plausible values do not prove that the clocks agree.
    OneWay,
    /// Half of each round trip: one-way delays are missing, or some are negative.
    HalfRoundTrip,
}

/// Delays of one direction, measured by IRTT.
#[derive(Clone, Debug, PartialEq)]
pub struct IrttRecording {
    /// Delays and losses, in s since the first packet.
    pub delays: DelayTrace,
    /// Kind of delays.
    pub measured: IrttDelay,
}

/// Maximum length of a repeated error text, which contains the file's own words.
const MAX_SHOWN: usize = 200;

fn shortened(problem: &str) -> String {
    match problem.char_indices().nth(MAX_SHOWN) {
        Some((end, _)) => format!("{}...", &problem[..end]),
        None => problem.to_owned(),
    }
}

/// Read the output of `irtt client -o`.
///
/// One-way delays are used if every reply has both and none is negative; otherwise half of the round trip. If
/// IRTT knows the direction of a loss, the loss counts only there. The other direction then has no record:
/// its delay is unknown, or the packet was never sent. A loss of unknown direction counts for both.
///
/// Times are the client's sending times: the monotonic clock, else the wall clock, else sequence times
/// interval. At most ten million round trips.
///
/// Source: `irtt-client(1)`, version 0.9, JSON format 1.
pub fn parse_irtt(bytes: &[u8], direction: Direction) -> Result<IrttRecording, ParseError> {
    if bytes.starts_with(&[0x1F, 0x8B]) {
        return Err(ParseError::new(1, 1, "compressed by gzip; unpack it first"));
    }
    let file: File = serde_json::from_slice(bytes).map_err(|error| {
        let problem = error.to_string();
        // Line and column are separate fields.
        let end = problem.rfind(" at line ").unwrap_or(problem.len());
        ParseError::new(error.line().max(1), error.column().max(1), shortened(&problem[..end]))
    })?;
    file.recording(direction).map_err(|problem| ParseError::new(1, 1, problem))
}

#[derive(Debug, Deserialize)]
struct File {
    #[serde(default)]
    config: Config,
    round_trips: Sent,
}

#[derive(Debug, Default, Deserialize)]
struct Config {
    #[serde(default)]
    params: Params,
}

#[derive(Debug, Default, Deserialize)]
struct Params {
    interval: Option<i64>,
}

impl File {
    fn recording(self, direction: Direction) -> Result<IrttRecording, String> {
        let Self { config, round_trips: Sent { packets, clock } } = self;
        let Some(first) = packets.first().map(|packet| packet.tick) else {
            return Err("no round trips".into());
        };
        let ns_per_tick = match (clock, config.params.interval) {
            (Clock::Monotonic | Clock::Wall, _) => 1,
            (Clock::Sequence, Some(interval_ns)) if interval_ns > 0 => interval_ns,
            (Clock::Sequence, _) => {
                return Err("neither times of sending nor config.params.interval above 0".into());
            }
        };
        let measured = if packets.iter().all(|packet| packet.outcome.has_one_way()) {
            IrttDelay::OneWay
        } else {
            IrttDelay::HalfRoundTrip
        };
        let mut delays =
            DelayTrace { time_s: Vec::new(), delay_s: Vec::new(), interpolate: true, repeat: true };
        for packet in &packets {
            let delay_s = match packet.outcome.of(direction, measured) {
                None => continue,
                Some(Seen::Lost) => None,
                Some(Seen::Delayed { delay_s }) => Some(delay_s),
            };
            let since_ns = packet.tick.checked_sub(first).and_then(|ticks| ticks.checked_mul(ns_per_tick));
            let Some(since_ns) = since_ns.filter(|since_ns| *since_ns <= MAX_SPAN_NS) else {
                return Err(format!("round trips span more than {MAX_SPAN_NS} ns"));
            };
            delays.time_s.push(since_ns as f64 / 1e9);
            delays.delay_s.push(delay_s);
        }
        let (Some(&begun_s), Some(&held_s)) = (delays.time_s.first(), delays.delay_s.first()) else {
            return Err("no round trips of this direction".into());
        };
        // Both directions begin with the first packet, even if one has no record of it.
        if begun_s > 0.0 {
            delays.time_s.insert(0, 0.0);
            delays.delay_s.insert(0, held_s);
        }
        Ok(IrttRecording { delays, measured })
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Clock {
    Monotonic,
    Wall,
    Sequence,
}

/// Packets and their common clock.
#[derive(Debug)]
struct Sent {
    packets: Vec<SentPacket>,
    clock: Clock,
}

#[derive(Clone, Copy, Debug)]
struct SentPacket {
    tick: i64,
    outcome: Outcome,
}

/// Outcome of a packet; times in ns.
#[derive(Clone, Copy, Debug)]
enum Outcome {
    LostForward,
    LostBackward,
    LostSomewhere,
    Returned { forward_ns: Option<i64>, backward_ns: Option<i64>, round_trip_ns: i64 },
}

impl Outcome {
    /// Test if the packet permits the use of one-way delays.
    fn has_one_way(&self) -> bool {
        match self {
            Self::LostForward | Self::LostBackward | Self::LostSomewhere => true,
            Self::Returned { forward_ns, backward_ns, .. } => {
                let plausible = |ns: &Option<i64>| ns.is_some_and(|ns| ns >= 0);
                plausible(forward_ns) && plausible(backward_ns)
            }
        }
    }

    /// Effect of one direction on the packet, if known.
    fn of(self, direction: Direction, measured: IrttDelay) -> Option<Seen> {
        let (forward_ns, backward_ns, round_trip_ns) = match (self, direction) {
            (Self::LostForward, Direction::Forward)
            | (Self::LostBackward, Direction::Backward)
            | (Self::LostSomewhere, _) => return Some(Seen::Lost),
            (Self::LostForward | Self::LostBackward, _) => return None,
            (Self::Returned { forward_ns, backward_ns, round_trip_ns }, _) => {
                (forward_ns, backward_ns, round_trip_ns)
            }
        };
        let delay_ns = match (measured, direction) {
            (IrttDelay::HalfRoundTrip, _) => round_trip_ns as f64 / 2.0,
            (IrttDelay::OneWay, Direction::Forward) => forward_ns? as f64,
            (IrttDelay::OneWay, Direction::Backward) => backward_ns? as f64,
        };
        Some(Seen::Delayed { delay_s: delay_ns / 1e9 })
    }
}

/// Effect of one direction on a packet.
#[derive(Clone, Copy, Debug)]
enum Seen {
    Lost,
    Delayed { delay_s: f64 },
}

#[derive(Debug, Deserialize)]
struct RoundTrip {
    seqno: u32,
    lost: Lost,
    #[serde(default)]
    timestamps: Timestamps,
    #[serde(default)]
    delay: Delay,
}

/// Written as a word; older versions write a boolean.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Lost {
    No,
    Yes,
    Up,
    Down,
}

impl<'de> Deserialize<'de> for Lost {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(LostVisitor)
    }
}

struct LostVisitor;

impl Visitor<'_> for LostVisitor {
    type Value = Lost;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("false, true, true_up or true_down")
    }

    fn visit_bool<E: de::Error>(self, lost: bool) -> Result<Lost, E> {
        Ok(if lost { Lost::Yes } else { Lost::No })
    }

    fn visit_str<E: de::Error>(self, lost: &str) -> Result<Lost, E> {
        match lost {
            "false" => Ok(Lost::No),
            "true" => Ok(Lost::Yes),
            "true_up" => Ok(Lost::Up),
            "true_down" => Ok(Lost::Down),
            _ => Err(E::invalid_value(de::Unexpected::Str(lost), &self)),
        }
    }
}

#[derive(Clone, Copy, Debug, Default, Deserialize)]
struct Timestamps {
    #[serde(default)]
    client: Client,
}

#[derive(Clone, Copy, Debug, Default, Deserialize)]
struct Client {
    #[serde(default)]
    send: Stamp,
}

#[derive(Clone, Copy, Debug, Default, Deserialize)]
struct Stamp {
    wall: Option<i64>,
    monotonic: Option<i64>,
}

#[derive(Clone, Copy, Debug, Default, Deserialize)]
struct Delay {
    receive: Option<i64>,
    rtt: Option<i64>,
    send: Option<i64>,
}

impl RoundTrip {
    fn clock(&self) -> Clock {
        match self.timestamps.client.send {
            Stamp { monotonic: Some(_), .. } => Clock::Monotonic,
            Stamp { wall: Some(_), .. } => Clock::Wall,
            Stamp { .. } => Clock::Sequence,
        }
    }

    fn tick(&self, clock: Clock) -> Option<i64> {
        match clock {
            Clock::Monotonic => self.timestamps.client.send.monotonic,
            Clock::Wall => self.timestamps.client.send.wall,
            Clock::Sequence => Some(i64::from(self.seqno)),
        }
    }

    fn outcome(&self) -> Result<Outcome, String> {
        #[expect(clippy::cast_possible_truncation, reason = "an hour")]
        let longest_ns = (MAX_DELAY_S * 1e9) as i64;
        let Delay { receive: backward_ns, rtt, send: forward_ns } = self.delay;
        match self.lost {
            Lost::Yes => Ok(Outcome::LostSomewhere),
            Lost::Up => Ok(Outcome::LostForward),
            Lost::Down => Ok(Outcome::LostBackward),
            Lost::No => match rtt {
                Some(round_trip_ns) if (0..=longest_ns).contains(&round_trip_ns) => {
                    let short = |ns: &i64| *ns <= longest_ns;
                    let (forward_ns, backward_ns) = (forward_ns.filter(short), backward_ns.filter(short));
                    Ok(Outcome::Returned { forward_ns, backward_ns, round_trip_ns })
                }
                Some(round_trip_ns) => {
                    Err(format!("delay.rtt = {round_trip_ns}: must be from 0 to {longest_ns} ns"))
                }
                None => Err("a packet that was not lost has no delay.rtt".into()),
            },
        }
    }
}

impl<'de> Deserialize<'de> for Sent {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_seq(SentVisitor)
    }
}

/// Reads round trips one by one, so that only used fields are kept and errors have a position.
struct SentVisitor;

impl<'de> Visitor<'de> for SentVisitor {
    type Value = Sent;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list of round trips")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut round_trips: A) -> Result<Sent, A::Error> {
        let mut sent = Sent { packets: Vec::new(), clock: Clock::Sequence };
        while let Some(round_trip) = round_trips.next_element::<RoundTrip>()? {
            sent.push(&round_trip).map_err(|problem| {
                de::Error::custom(format!("round trip {}: {problem}", round_trip.seqno))
            })?;
        }
        Ok(sent)
    }
}

impl Sent {
    fn push(&mut self, round_trip: &RoundTrip) -> Result<(), String> {
        if self.packets.is_empty() {
            self.clock = round_trip.clock();
        }
        let Some(tick) = round_trip.tick(self.clock) else {
            return Err("it has no time of sending where the first one has".into());
        };
        if self.packets.last().is_some_and(|before| tick <= before.tick) {
            return Err("it was not sent after the one before it".into());
        }
        if self.packets.len() == MAX_RECORDS {
            return Err(format!("more than {MAX_RECORDS} round trips"));
        }
        self.packets.push(SentPacket { tick, outcome: round_trip.outcome()? });
        Ok(())
    }
}
