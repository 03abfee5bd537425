//! What somebody on the path does to packets on purpose: for the tests of the bridge's security.
//!
//! The adversary sits where packets arrive: it sees what the network left of them, and a packet that was dropped
//! before is out of its reach.

use std::ops::RangeInclusive;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Impairment, LinkSettings, Streams};
use crate::checks::{
    LinkSettingsError, MAX_DELAY_S, MAX_PAYLOAD, MAX_TIME_S, nanoseconds, probability, within,
};
use crate::damage::{
    Alteration, Checksum, Damage, Edit, Flips, MAX_EDITS, MAX_FLIPS, NUMBER_BYTES, bytes, offset,
};
use crate::packet::Packet;
use crate::random::{Event, Stream};
use crate::rule::{ArrivalRule, Extras, MAX_EXTRAS, add_extra};
use crate::verdict::{DropCause, ExtraCause, Verdict};

/// Each attack of a link has a stream of its own.
const MAX_ATTACKS: usize = 256;

/// Something done to packets on purpose, where they arrive: what was lost before is out of its reach.
///
/// Attacks act in the order of their list. What changes or takes a packet does so to the copies that the network
/// made of it too; what adds one acts once. Of several attacks that flip bits of the same packet the last one does, and
/// of several that alter it.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Attack {
    /// What is done.
    pub action: Action,
    /// To which packets.
    #[serde(default)]
    pub target: Target,
}

/// What is done to packets on purpose.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Action {
    /// A copy arrives `after_s` later.
    Replay {
        /// How much later, in s.
        after_s: f64,
    },
    /// A packet of the same size arrives beside it, with random bytes from `keep_bytes` on.
    Forge {
        /// How many bytes at its start are those of the packet seen.
        #[serde(default)]
        keep_bytes: usize,
    },
    /// Bits of its header are flipped.
    BitFlip {
        /// How many.
        bits: u32,
        /// Within which bytes.
        within: ByteRange,
    },
    /// A copy arrives beside it whose sequence, a little-endian u64, is ahead.
    SequenceLead {
        /// By how much.
        lead: u64,
        /// First byte of the sequence.
        offset: usize,
    },
    /// Numbers in it are changed by somebody who knows where they stand.
    Alter {
        /// Which numbers and how, one after the other: at most 4.
        #[serde(default)]
        edits: Vec<Edit>,
        /// What is put right afterwards.
        #[serde(default)]
        checksum: Option<Checksum>,
        /// Whether an altered copy arrives beside the packet, which itself stays as it is.
        #[serde(default)]
        inject: bool,
    },
    /// It is held back.
    HoldBack {
        /// For how long, in s.
        by_s: f64,
    },
    /// It does not arrive.
    Drop,
    /// A copy goes back to its sender.
    Mirror,
    /// A copy arrives from another source address; in virtual time, which has no addresses, it is a duplicate.
    SecondSource,
}

/// Bytes from `start` up to but not including `end`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ByteRange {
    /// First byte.
    pub start: usize,
    /// First byte after it.
    pub end: usize,
}

/// Which packets: those sent at the given times, every n-th of them, each with a probability.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Target {
    /// From when on, in s since the link began.
    pub from_s: f64,
    /// Until when, in s; without it, for ever.
    pub until_s: Option<f64>,
    /// Only packets whose index is a multiple of it.
    pub every: u64,
    /// Smallest payload in bytes.
    pub least_bytes: usize,
    /// Largest payload in bytes.
    pub most_bytes: Option<usize>,
    /// With which probability.
    pub probability: f64,
}

impl Default for Target {
    fn default() -> Self {
        Self { from_s: 0.0, until_s: None, every: 1, least_bytes: 0, most_bytes: None, probability: 1.0 }
    }
}

#[derive(Clone, Debug)]
struct Adversary(Vec<(Aim, Box<dyn ArrivalRule>)>);

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn ArrivalRule>>, LinkSettingsError> {
    within("attacks", settings.attacks.len() as f64, 0.0, MAX_ATTACKS as f64)?;
    let copies = settings.attacks.iter().filter(|attack| copies(&attack.action)).count();
    if copies + usize::from(settings.duplicate > 0.0) > MAX_EXTRAS {
        let problem =
            format!("{copies} of them add a packet: at most {MAX_EXTRAS} may, a duplicate among them");
        return Err(LinkSettingsError::contradiction("attacks", problem));
    }
    let stream = streams.of(Impairment::Attack);
    let mut attacks = Vec::new();
    for (position, attack) in (0..=u8::MAX).zip(&settings.attacks) {
        let stream = stream.nth(position);
        let aim = Aim::new(&format!("attacks.{position}.target"), &attack.target, stream)?;
        attacks.push((aim, build_action(&format!("attacks.{position}.action"), &attack.action, stream)?));
    }
    Ok((!attacks.is_empty()).then(|| Box::new(Adversary(attacks)) as Box<dyn ArrivalRule>))
}

/// Whether something arrives beside the packet.
fn copies(action: &Action) -> bool {
    !matches!(
        action,
        Action::BitFlip { .. } | Action::Alter { inject: false, .. } | Action::HoldBack { .. } | Action::Drop
    )
}

/// Builds an action whose settings are found under a key.
fn build_action(
    key: &str,
    action: &Action,
    stream: Stream,
) -> Result<Box<dyn ArrivalRule>, LinkSettingsError> {
    match *action {
        Action::Alter { ref edits, checksum, inject } => alter(key, edits, checksum, inject),
        Action::HoldBack { by_s } => hold_back(key, by_s),
        Action::Replay { after_s } => replay(key, after_s),
        Action::Forge { keep_bytes } => forge(key, keep_bytes, stream),
        Action::BitFlip { bits, within } => bit_flip(key, bits, within, stream),
        Action::SequenceLead { lead, offset } => sequence_lead(key, lead, offset),
        Action::Drop => Ok(Box::new(SelectiveDrop)),
        Action::Mirror => Ok(copy_at_once(ExtraCause::Mirror)),
        Action::SecondSource => Ok(copy_at_once(ExtraCause::SecondSource)),
    }
}

impl ArrivalRule for Adversary {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        let mut at_ns = at_ns;
        for (aim, action) in &mut self.0 {
            if aim.takes(packet) {
                match action.end(packet, at_ns, damage, extras) {
                    Verdict::Deliver { at_ns: later } => at_ns = later,
                    drop @ Verdict::Drop { .. } => return drop,
                }
            }
        }
        Verdict::Deliver { at_ns }
    }
}

/// A checked [`Target`].
///
/// The time that counts is that of sending, so that what the network adds to it changes no attack.
#[derive(Clone, Debug)]
struct Aim {
    from_ns: u64,
    until_ns: u64,
    every: u64,
    bytes: RangeInclusive<usize>,
    chosen: Event,
}

impl Aim {
    /// Checks the target found under a key.
    fn new(key: &str, target: &Target, stream: Stream) -> Result<Self, LinkSettingsError> {
        let at = |name| format!("{key}.{name}");
        within(&at("from_s"), target.from_s, 0.0, MAX_TIME_S)?;
        if let Some(until_s) = target.until_s {
            within(&at("until_s"), until_s, 0.0, MAX_TIME_S)?;
            if until_s <= target.from_s {
                return Err(LinkSettingsError::contradiction(
                    at("until_s"),
                    format!("{until_s} is not after from_s = {}: no packet would be met", target.from_s),
                ));
            }
        }
        within(&at("every"), target.every as f64, 1.0, u64::MAX as f64)?;
        if let Some(most) = target.most_bytes
            && most < target.least_bytes
        {
            return Err(LinkSettingsError::contradiction(
                at("most_bytes"),
                format!("{most} is below least_bytes = {}: no packet would be met", target.least_bytes),
            ));
        }
        probability(&at("probability"), target.probability)?;
        Ok(Self {
            from_ns: nanoseconds(target.from_s),
            until_ns: target.until_s.map_or(u64::MAX, nanoseconds),
            every: target.every,
            bytes: target.least_bytes..=target.most_bytes.unwrap_or(usize::MAX),
            chosen: Event::new(target.probability, stream),
        })
    }

    /// Whether a packet is met.
    fn takes(&self, packet: &Packet) -> bool {
        self.from_ns <= packet.sent_ns
            && packet.sent_ns < self.until_ns
            && packet.index.is_multiple_of(self.every)
            && self.bytes.contains(&packet.size)
            && self.chosen.occurs(packet.index)
    }
}

/// Attacks that send what they saw once more: later, back to its sender, or from another address.
#[derive(Clone, Copy, Debug)]
struct Copying {
    after_ns: u64,
    cause: ExtraCause,
}

/// A replay some time after the packet arrived.
fn replay(key: &str, after_s: f64) -> Result<Box<dyn ArrivalRule>, LinkSettingsError> {
    within(&format!("{key}.after_s"), after_s, 0.0, MAX_DELAY_S)?;
    Ok(Box::new(Copying { after_ns: nanoseconds(after_s), cause: ExtraCause::Replay }))
}

/// A copy at the time the packet arrives.
fn copy_at_once(cause: ExtraCause) -> Box<dyn ArrivalRule> {
    Box::new(Copying { after_ns: 0, cause })
}

impl ArrivalRule for Copying {
    fn end(&mut self, _: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        add_extra(extras, at_ns.saturating_add(self.after_ns), self.cause, *damage);
        Verdict::Deliver { at_ns }
    }
}

/// An attack that sends made-up bytes behind a genuine beginning.
#[derive(Clone, Copy, Debug)]
struct Forge {
    keep_bytes: usize,
    stream: Stream,
}

fn forge(key: &str, keep_bytes: usize, stream: Stream) -> Result<Box<dyn ArrivalRule>, LinkSettingsError> {
    within(&format!("{key}.keep_bytes"), keep_bytes as f64, 0.0, MAX_PAYLOAD as f64)?;
    Ok(Box::new(Forge { keep_bytes, stream }))
}

impl ArrivalRule for Forge {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        let forged = Some((bytes(self.keep_bytes), self.stream));
        let damage = Damage { forged, index: packet.index, ..*damage };
        add_extra(extras, at_ns, ExtraCause::Forge, damage);
        Verdict::Deliver { at_ns }
    }
}

/// An attack that flips bits at a chosen place, such as the header.
#[derive(Clone, Copy, Debug)]
struct BitFlip(Flips);

fn bit_flip(
    key: &str,
    bits: u32,
    range: ByteRange,
    stream: Stream,
) -> Result<Box<dyn ArrivalRule>, LinkSettingsError> {
    let ByteRange { start, end } = range;
    within(&format!("{key}.within.end"), end as f64, 0.0, MAX_PAYLOAD as f64)?;
    if start >= end {
        return Err(LinkSettingsError::contradiction(
            format!("{key}.within.start"),
            format!("{start} is not below end = {end}: there is no byte in between"),
        ));
    }
    let most = (8 * (end - start)).min(MAX_FLIPS as usize);
    within(&format!("{key}.bits"), f64::from(bits), 1.0, most as f64)?;
    Ok(Box::new(BitFlip(Flips { bits, start: bytes(start), end: bytes(end), stream })))
}

impl ArrivalRule for BitFlip {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        // A packet that is too short has no such bytes.
        if packet.size > self.0.start as usize {
            let duplicates = extras.iter_mut().filter(|extra| extra.cause == ExtraCause::Duplicate);
            for damage in std::iter::once(damage).chain(duplicates.map(|extra| &mut extra.damage)) {
                damage.attacked = self.0;
                damage.index = packet.index;
            }
        }
        Verdict::Deliver { at_ns }
    }
}

/// Bytes of a sequence.
const SEQUENCE_BYTES: usize = 8;

/// An attack that sends a copy whose sequence is ahead, so that what is genuine would look old.
#[derive(Clone, Copy, Debug)]
struct SequenceLead {
    lead: u64,
    offset: usize,
}

fn sequence_lead(key: &str, lead: u64, offset: usize) -> Result<Box<dyn ArrivalRule>, LinkSettingsError> {
    within(&format!("{key}.lead"), lead as f64, 1.0, u64::MAX as f64)?;
    within(&format!("{key}.offset"), offset as f64, 0.0, (MAX_PAYLOAD - SEQUENCE_BYTES) as f64)?;
    Ok(Box::new(SequenceLead { lead, offset }))
}

impl ArrivalRule for SequenceLead {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        // A packet that is too short has no sequence to change.
        if packet.size >= self.offset + SEQUENCE_BYTES {
            let damage = Damage { lead: Some((bytes(self.offset), self.lead)), ..*damage };
            add_extra(extras, at_ns, ExtraCause::SequenceLead, damage);
        }
        Verdict::Deliver { at_ns }
    }
}

/// Largest number that an edit names: what a unit slipped by a million still fits in.
const MAX_VALUE: f64 = 1e12;

/// An attack that changes numbers in a packet and repairs its checksum: what nothing but a key keeps out.
///
/// Source: T. Bonaci et al., "To make a robot secure: an experimental analysis of cyber security threats against
/// teleoperated surgical robotics", arXiv 1504.04339, intent manipulation and hijacking.
#[derive(Clone, Copy, Debug)]
struct Alter {
    alteration: Alteration,
    inject: bool,
}

fn alter(
    key: &str,
    edits: &[Edit],
    checksum: Option<Checksum>,
    inject: bool,
) -> Result<Box<dyn ArrivalRule>, LinkSettingsError> {
    within(&format!("{key}.edits"), edits.len() as f64, 0.0, MAX_EDITS as f64)?;
    if edits.is_empty() && checksum.is_none() {
        return Err(LinkSettingsError::contradiction(
            format!("{key}.edits"),
            "is empty, and no checksum is put right: nothing would be altered",
        ));
    }
    let mut alteration = Alteration { checksum, ..Alteration::NONE };
    for (position, (slot, edit)) in alteration.edits.iter_mut().zip(edits).enumerate() {
        let key = format!("{key}.edits.{position}");
        let most = MAX_PAYLOAD - NUMBER_BYTES;
        within(&format!("{key}.offset"), offset(edit) as f64, 0.0, most as f64)?;
        if let Edit::F64 { value, .. } = *edit {
            within(&format!("{key}.value"), value, -MAX_VALUE, MAX_VALUE)?;
        }
        *slot = Some(*edit);
    }
    Ok(Box::new(Alter { alteration, inject }))
}

impl ArrivalRule for Alter {
    fn end(&mut self, packet: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        // From a packet that is too short nothing is taken, and no copy is made.
        let size = packet.size.min(damage.truncates_to().unwrap_or(usize::MAX));
        if size >= self.alteration.least_bytes() {
            if self.inject {
                let damage = Damage { altered: self.alteration, ..*damage };
                add_extra(extras, at_ns, ExtraCause::Alter, damage);
            } else {
                let duplicates = extras.iter_mut().filter(|extra| extra.cause == ExtraCause::Duplicate);
                for damage in std::iter::once(damage).chain(duplicates.map(|extra| &mut extra.damage)) {
                    damage.altered = self.alteration;
                }
            }
        }
        Verdict::Deliver { at_ns }
    }
}

/// An attack that holds chosen packets back, with the copies that the network made of them.
///
/// Packets that are not met pass those that are: aimed at each n-th packet, it reorders.
#[derive(Clone, Copy, Debug)]
struct HoldBack {
    by_ns: u64,
}

fn hold_back(key: &str, by_s: f64) -> Result<Box<dyn ArrivalRule>, LinkSettingsError> {
    within(&format!("{key}.by_s"), by_s, 0.0, MAX_DELAY_S)?;
    Ok(Box::new(HoldBack { by_ns: nanoseconds(by_s) }))
}

impl ArrivalRule for HoldBack {
    fn end(&mut self, _: &Packet, at_ns: u64, _: &mut Damage, extras: &mut Extras) -> Verdict {
        for extra in extras.iter_mut().filter(|extra| extra.cause == ExtraCause::Duplicate) {
            extra.at_ns = extra.at_ns.saturating_add(self.by_ns);
        }
        Verdict::Deliver { at_ns: at_ns.saturating_add(self.by_ns) }
    }
}

/// An attack that takes chosen packets, with the copies that the network made of them.
#[derive(Clone, Copy, Debug)]
struct SelectiveDrop;

impl ArrivalRule for SelectiveDrop {
    fn end(&mut self, _: &Packet, _: u64, _: &mut Damage, extras: &mut Extras) -> Verdict {
        // What the adversary recorded before stays in its hands: with a replay before it, a drop is a delay.
        extras.retain(|extra| extra.cause != ExtraCause::Duplicate);
        Verdict::Drop { cause: DropCause::Attack }
    }
}
