//! What somebody on the path does to packets on purpose: for the tests of the bridge's security.
//!
//! The adversary sits where packets arrive: it sees what the network left of them, and a packet that was dropped
//! before is out of its reach.

mod alter;
mod bit_flip;
mod copies;
mod forge;
mod hold_back;
mod selective_drop;
mod sequence_lead;
mod target;

use crate::damage::Damage;
use crate::random::{Impairment, Stream};
use crate::rule::{Ending, Extras, MAX_EXTRAS, Streams};
use crate::settings::{Action, LinkError, LinkSettings, within};
use crate::verdict::{ExtraCause, Packet, Verdict};

use target::Aim;

/// Most attacks of a link: each has a stream of its own.
const MOST: usize = 256;

#[derive(Debug)]
struct Adversary(Vec<(Aim, Box<dyn Ending>)>);

pub(crate) fn build(
    settings: &LinkSettings,
    streams: &Streams,
) -> Result<Option<Box<dyn Ending>>, LinkError> {
    within("attacks", settings.attacks.len() as f64, 0.0, MOST as f64)?;
    let copies = settings.attacks.iter().filter(|attack| copies(&attack.action)).count();
    if copies + usize::from(settings.duplicate > 0.0) > MAX_EXTRAS {
        let problem =
            format!("{copies} of them add a packet: at most {MAX_EXTRAS} may, a duplicate among them");
        return Err(LinkError::contradiction("attacks", problem));
    }
    let stream = streams.of(Impairment::Attack);
    let mut attacks = Vec::new();
    for (position, attack) in (0..=u8::MAX).zip(&settings.attacks) {
        let stream = stream.nth(position);
        let aim = Aim::new(&format!("attacks.{position}.target"), &attack.target, stream)?;
        attacks.push((aim, act(&format!("attacks.{position}.action"), &attack.action, stream)?));
    }
    Ok((!attacks.is_empty()).then(|| Box::new(Adversary(attacks)) as Box<dyn Ending>))
}

/// Whether something arrives beside the packet.
fn copies(action: &Action) -> bool {
    !matches!(
        action,
        Action::BitFlip { .. } | Action::Alter { inject: false, .. } | Action::HoldBack { .. } | Action::Drop
    )
}

/// Builds an action whose settings are found under a key.
fn act(key: &str, action: &Action, stream: Stream) -> Result<Box<dyn Ending>, LinkError> {
    match *action {
        Action::Alter { ref edits, checksum, inject } => alter::build(key, edits, checksum, inject),
        Action::HoldBack { by_s } => hold_back::build(key, by_s),
        Action::Replay { after_s } => copies::replay(key, after_s),
        Action::Forge { keep_bytes } => forge::build(key, keep_bytes, stream),
        Action::BitFlip { bits, within } => bit_flip::build(key, bits, within, stream),
        Action::SequenceLead { lead, offset } => sequence_lead::build(key, lead, offset),
        Action::Drop => Ok(selective_drop::build()),
        Action::Mirror => Ok(copies::at_once(ExtraCause::Mirror)),
        Action::SecondSource => Ok(copies::at_once(ExtraCause::SecondSource)),
    }
}

impl Ending for Adversary {
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
