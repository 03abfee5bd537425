//! Attacks on packets by an adversary on the path, for the tests of the bridge's security.
//!
//! The adversary sits at the receiver: it sees packets after the network impairs them, and never sees dropped
//! packets.

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

/// Maximum number of attacks: each has its own stream.
const MAX_ATTACKS: usize = 256;

/// Attack on packets at their arrival; lost packets are out of reach.
///
/// Attacks act in list order. An attack that changes or drops a packet also affects its network duplicates;
/// an attack that adds a packet acts once. If several attacks flip bits of a packet, only the last counts; the same
/// holds for alterations.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Attack {
    /// Action.
    pub action: Action,
    /// Packets affected.
    #[serde(default)]
    pub target: Target,
}

/// Action of an attack.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Action {
    /// A copy arrives `after_s` later.
    Replay {
        /// Extra delay in s.
        after_s: f64,
    },
    /// An additional packet of the same size arrives, with random bytes from `keep_bytes` on.
    Forge {
        /// Number of leading bytes copied from the genuine packet.
        #[serde(default)]
        keep_bytes: usize,
    },
    /// Bits of the header are flipped.
    BitFlip {
        /// Number of bits.
        bits: u32,
        /// Range of bytes.
        within: ByteRange,
    },
    /// A copy arrives whose sequence, a little-endian u64, is ahead.
    SequenceLead {
        /// Amount added to the sequence.
        lead: u64,
        /// Offset of the sequence's first byte.
        offset: usize,
    },
    /// Numbers at known offsets are changed.
    Alter {
        /// Edits in order, at most 4.
        #[serde(default)]
        edits: Vec<Edit>,
        /// Checksum repaired afterwards.
        #[serde(default)]
        checksum: Option<Checksum>,
        /// Adds an altered copy and leaves the packet itself unchanged.
        #[serde(default)]
        inject: bool,
    },
    /// The packet is held back.
    HoldBack {
        /// Hold time in s.
        by_s: f64,
    },
    /// The packet is dropped.
    Drop,
    /// A copy goes back to its sender.
    Mirror,
    /// A copy arrives from another source address; in virtual time, which has no addresses, it is a
    /// duplicate.
    SecondSource,
}

/// Bytes from `start` up to but not including `end`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ByteRange {
    /// First byte.
    pub start: usize,
    /// First byte after the range.
    pub end: usize,
}

/// Packets that an attack affects. All conditions must hold.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Target {
    /// Start in s since the link began.
    pub from_s: f64,
    /// End in s; unlimited if absent.
    pub until_s: Option<f64>,
    /// Index must be a multiple of this.
    pub every: u64,
    /// Minimum payload in bytes.
    pub least_bytes: usize,
    /// Maximum payload in bytes.
    pub most_bytes: Option<usize>,
    /// Probability per packet.
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

fn copies(action: &Action) -> bool {
    !matches!(
        action,
        Action::BitFlip { .. } | Action::Alter { inject: false, .. } | Action::HoldBack { .. } | Action::Drop
    )
}

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

/// Checked [`Target`].
///
/// The sending time decides, so network delay does not change an attack.
#[derive(Clone, Debug)]
struct Aim {
    from_ns: u64,
    until_ns: u64,
    every: u64,
    bytes: RangeInclusive<usize>,
    chosen: Event,
}

impl Aim {
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

    fn takes(&self, packet: &Packet) -> bool {
        self.from_ns <= packet.sent_ns
            && packet.sent_ns < self.until_ns
            && packet.index.is_multiple_of(self.every)
            && self.bytes.contains(&packet.size)
            && self.chosen.occurs(packet.index)
    }
}

/// Attacks that send a copy: later, to the sender, or from another address.
#[derive(Clone, Copy, Debug)]
struct Copying {
    after_ns: u64,
    cause: ExtraCause,
}

fn replay(key: &str, after_s: f64) -> Result<Box<dyn ArrivalRule>, LinkSettingsError> {
    within(&format!("{key}.after_s"), after_s, 0.0, MAX_DELAY_S)?;
    Ok(Box::new(Copying { after_ns: nanoseconds(after_s), cause: ExtraCause::Replay }))
}

fn copy_at_once(cause: ExtraCause) -> Box<dyn ArrivalRule> {
    Box::new(Copying { after_ns: 0, cause })
}

impl ArrivalRule for Copying {
    fn end(&mut self, _: &Packet, at_ns: u64, damage: &mut Damage, extras: &mut Extras) -> Verdict {
        add_extra(extras, at_ns.saturating_add(self.after_ns), self.cause, *damage);
        Verdict::Deliver { at_ns }
    }
}

/// Attack that sends random bytes after a genuine prefix.
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

/// Attack that flips bits in a chosen range, such as the header.
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
        // A short packet has no bytes in the range.
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

const SEQUENCE_BYTES: usize = 8;

/// Attack that sends a copy with an advanced sequence, so that genuine packets look old.
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
        // A short packet has no sequence.
        if packet.size >= self.offset + SEQUENCE_BYTES {
            let damage = Damage { lead: Some((bytes(self.offset), self.lead)), ..*damage };
            add_extra(extras, at_ns, ExtraCause::SequenceLead, damage);
        }
        Verdict::Deliver { at_ns }
    }
}

/// Maximum magnitude of an edit's value: a unit mistake of a factor of one million fits in it.
const MAX_VALUE: f64 = 1e12;

/// Attack that changes numbers and repairs the checksum; only authentication with a key prevents it.
///
/// Source: T. Bonaci et al., "To make a robot secure: an experimental analysis of cyber security threats
/// against teleoperated surgical robotics", arXiv 1504.04339, intent manipulation and hijacking.
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
        // A short packet stays unchanged, and is not copied.
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

/// Attack that delays chosen packets and their network duplicates.
///
/// Other packets pass them: with every n-th packet as target, it reorders.
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

/// Attack that drops chosen packets and their network duplicates.
#[derive(Clone, Copy, Debug)]
struct SelectiveDrop;

impl ArrivalRule for SelectiveDrop {
    fn end(&mut self, _: &Packet, _: u64, _: &mut Damage, extras: &mut Extras) -> Verdict {
        // Copies of earlier attacks remain: a replay followed by a drop is a delay.
        extras.retain(|extra| extra.cause != ExtraCause::Duplicate);
        Verdict::Drop { cause: DropCause::Attack }
    }
}
