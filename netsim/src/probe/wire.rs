//! Format of probe and answer: 72 bytes each, so that an answer is never longer than its request.
//!
//! Little-endian u64: magic, kind, token, sequence, sent by the client, received by the echo, sent by the
//! echo, newest sequence received, and a mask of the 64 sequences up to it. The echo's four fields are 0 in a
//! probe.

/// Size of a datagram in bytes.
pub(super) const SIZE: usize = 72;
const MAGIC: u64 = u64::from_le_bytes(*b"HAPTPRB1");
const PROBE: u64 = 1;
const ANSWER: u64 = 2;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Request {
    /// Random and constant over a measurement; datagrams with another token are rejected.
    pub(super) token: u64,
    pub(super) sequence: u64,
    /// Client clock in ns.
    pub(super) sent_ns: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Answer {
    pub(super) request: Request,
    /// Echo clock in ns.
    pub(super) received_ns: u64,
    /// Echo clock in ns.
    pub(super) answered_ns: u64,
    pub(super) seen: Seen,
}

/// Sequences that the echo has received.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Seen {
    /// Highest sequence.
    pub(super) newest: u64,
    /// Bit k is set if `newest - k` was received.
    pub(super) before: u64,
}

impl Seen {
    pub(super) fn take(&mut self, sequence: u64) {
        if self.before == 0 {
            *self = Self { newest: sequence, before: 1 };
            return;
        }
        if let Some(ahead) = sequence.checked_sub(self.newest) {
            self.before = shift(self.before, ahead) | 1;
            self.newest = sequence;
        } else if let Ok(behind @ 0..64) = u32::try_from(self.newest - sequence) {
            self.before |= 1 << behind;
        }
    }

    /// Received sequences, newest first.
    pub(super) fn sequences(self) -> impl Iterator<Item = u64> {
        let is_set = move |back: &u64| self.before & (1 << back) != 0;
        (0..64).filter(is_set).map_while(move |back| self.newest.checked_sub(back))
    }
}

fn shift(bits: u64, by: u64) -> u64 {
    u32::try_from(by).ok().and_then(|by| bits.checked_shl(by)).unwrap_or(0)
}

impl Request {
    pub(super) fn encode(&self) -> [u8; SIZE] {
        words([MAGIC, PROBE, self.token, self.sequence, self.sent_ns, 0, 0, 0, 0])
    }

    /// Return `None` for other datagrams.
    pub(super) fn decode(bytes: &[u8]) -> Option<Self> {
        match read(bytes)? {
            [MAGIC, PROBE, token, sequence, sent_ns, 0, 0, 0, 0] => Some(Self { token, sequence, sent_ns }),
            _ => None,
        }
    }
}

impl Answer {
    pub(super) fn encode(&self) -> [u8; SIZE] {
        let Self { request: Request { token, sequence, sent_ns }, received_ns, answered_ns, seen } = *self;
        let Seen { newest, before } = seen;
        words([MAGIC, ANSWER, token, sequence, sent_ns, received_ns, answered_ns, newest, before])
    }

    /// Return `None` for other datagrams.
    pub(super) fn decode(bytes: &[u8]) -> Option<Self> {
        match read(bytes)? {
            [MAGIC, ANSWER, token, sequence, sent_ns, received_ns, answered_ns, newest, before] => {
                let request = Request { token, sequence, sent_ns };
                Some(Self { request, received_ns, answered_ns, seen: Seen { newest, before } })
            }
            _ => None,
        }
    }
}

fn words(words: [u64; SIZE / 8]) -> [u8; SIZE] {
    let mut bytes = [0; SIZE];
    for (cell, word) in bytes.chunks_exact_mut(8).zip(words) {
        cell.copy_from_slice(&word.to_le_bytes());
    }
    bytes
}

fn read(bytes: &[u8]) -> Option<[u64; SIZE / 8]> {
    let bytes: &[u8; SIZE] = bytes.try_into().ok()?;
    let mut words = [0; SIZE / 8];
    for (word, cell) in words.iter_mut().zip(bytes.as_chunks::<8>().0) {
        *word = u64::from_le_bytes(*cell);
    }
    Some(words)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn probe_and_answer_survive_the_wire_and_are_told_apart(
            [token, sequence, sent_ns, received_ns, answered_ns, newest, before] in any::<[u64; 7]>(),
        ) {
            let request = Request { token, sequence, sent_ns };
            let answer = Answer { request, received_ns, answered_ns, seen: Seen { newest, before } };
            prop_assert_eq!(Request::decode(&request.encode()), Some(request));
            prop_assert_eq!(Answer::decode(&answer.encode()), Some(answer));
            prop_assert_eq!(Request::decode(&answer.encode()), None);
            prop_assert_eq!(Answer::decode(&request.encode()), None);
        }

        #[test]
        fn anything_else_is_neither(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            prop_assert_eq!(Request::decode(&bytes), None);
            prop_assert_eq!(Answer::decode(&bytes), None);
        }

        /// Compares with a set of all received sequences.
        #[test]
        fn the_last_64_are_remembered(sequences in prop::collection::vec(0_u64..200, 1..60)) {
            let mut seen = Seen::default();
            for &sequence in &sequences {
                seen.take(sequence);
            }
            let newest = sequences.iter().copied().max().unwrap();
            let reported: Vec<u64> = seen.sequences().collect();
            // Sequences that were too old at their arrival are not reported.
            prop_assert!(reported.iter().all(|sequence| sequences.contains(sequence)));
            let mut so_far = 0;
            for &sequence in &sequences {
                so_far = so_far.max(sequence);
                if so_far - sequence < 64 && newest - sequence < 64 {
                    prop_assert!(reported.contains(&sequence));
                }
            }
        }
    }
}
