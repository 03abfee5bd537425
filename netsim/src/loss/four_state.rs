//! Four-state Markov loss: bursts of loss with gaps inside them, and single losses outside.
//!
//! States 1 (good) and 2 (good within a burst) deliver, 3 (lost within a burst) and 4 (lost alone) lose the packet
//! at which they are entered. The stationary law is as `p31 p23 : p13 p32 : p13 p23 : p14 p31 p23`, and the share of
//! lost packets is that of the states 3 and 4.
//!
//! Source: S. Salsano, F. Ludovici, A. Ordine, D. Giannuzzi, "Definition of a general and intuitive loss model for
//! packet networks and its implementation in the Netem module in the Linux kernel", 2012.

use super::chain::Chain;
use crate::random::Impairment;
use crate::rule::{Rule, Streams};
use crate::settings::{FourState, LinkError, probability};
use crate::verdict::{DropCause, Packet, Verdict};

#[derive(Clone, Copy, Debug)]
pub(super) struct FourStateLoss {
    state: Chain<4>,
}

impl FourStateLoss {
    pub(super) fn new(settings: &FourState, streams: &Streams) -> Result<Self, LinkError> {
        let &FourState { p13, p31, p32, p23, p14 } = settings;
        for (key, seen) in [("p13", p13), ("p31", p31), ("p32", p32), ("p23", p23), ("p14", p14)] {
            probability(&format!("four_state.{key}"), seen)?;
        }
        for (first, second, sum) in [("p13", "p14", p13 + p14), ("p31", "p32", p31 + p32)] {
            if sum > 1.0 {
                return Err(LinkError::contradiction(
                    format!("four_state.{first}"),
                    format!("{first} + {second} = {sum}: must be at most 1, since both leave the same state"),
                ));
            }
        }
        // A state that is never entered has no say in how often it is left.
        let p23_if_entered = if p32 == 0.0 { 1.0 } else { p23 };
        let weights = [p31 * p23_if_entered, p13 * p32, p13 * p23_if_entered, p14 * p31 * p23_if_entered];
        let sum: f64 = weights.iter().sum();
        if sum == 0.0 {
            return Err(LinkError::contradiction(
                "four_state.p31",
                "what the link settles in depends on where it starts: a burst must end, \
                 so give p31 above 0, and with p32 also p23 above 0",
            ));
        }
        let rows = [
            [1.0 - p13 - p14, 0.0, p13, p14],
            [0.0, 1.0 - p23, p23, 0.0],
            [p31, p32, 1.0 - p31 - p32, 0.0],
            [1.0, 0.0, 0.0, 0.0],
        ];
        let stationary = weights.map(|weight| weight / sum);
        Ok(Self { state: Chain::new(stationary, rows, streams.of(Impairment::LossState)) })
    }
}

impl Rule for FourStateLoss {
    fn judge(&mut self, packet: &Packet, at_ns: u64) -> Verdict {
        Verdict::unless(self.state.state(packet.index) >= 2, DropCause::Loss, at_ns)
    }
}
