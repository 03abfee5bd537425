//! Known answers: effects on the first packets of a seed, which code changes must preserve.
//!
//! This test wrote the file. `tests/netsim/test_vectors.py` checked it: an independent implementation of
//! Philox4x32-10 and of these models in Python integers, which runs with the Python tests.

use std::fmt::Write as _;

use crate::{Direction, Judgement, Link, LinkSettings, Packet, Verdict};

const KNOWN: &str = include_str!("verdicts.txt");
const SEED: u64 = 0x0123_4567_89AB_CDEF;
const PACKETS: u64 = 256;

fn is_lost(judgement: &Judgement) -> bool {
    matches!(judgement.verdict, Verdict::Drop { .. })
}

/// Name, settings, and the observed event per packet.
type Case = (&'static str, &'static str, fn(&Judgement) -> bool);

const CASES: &[Case] = &[
    ("bernoulli", r#"{"loss": 0.1}"#, is_lost),
    ("gilbert", r#"{"loss": 0.1, "mean_burst": 4}"#, is_lost),
    ("gilbert_in_time", r#"{"loss": 0.1, "mean_burst_s": 0.004}"#, is_lost),
    (
        "gilbert_elliott",
        r#"{"gilbert_elliott": {"to_bad": 0.05, "to_good": 0.2, "loss_good": 0.01, "loss_bad": 0.7}}"#,
        is_lost,
    ),
    (
        "four_state",
        r#"{"four_state": {"p13": 0.05, "p31": 0.2, "p32": 0.1, "p23": 0.5, "p14": 0.02}}"#,
        is_lost,
    ),
    (
        "outage",
        r#"{"outages": [
            {"times": {"kind": "once", "at_s": 1000, "duration_s": 1}},
            {"times": {"kind": "random", "mean_up_s": 0.03, "mean_down_s": 0.01}}
        ]}"#,
        is_lost,
    ),
    (
        "reorder",
        r#"{"reorder": 0.1, "reorder_hold_s": 5}"#,
        |judgement| matches!(judgement.verdict, Verdict::Deliver { at_ns } if at_ns > 4_000_000_000),
    ),
    ("duplicate", r#"{"duplicate": 0.1}"#, |judgement| !judgement.extras.is_empty()),
    ("corrupt", r#"{"corrupt": 0.1}"#, |judgement| judgement.damage.corrupts()),
    ("corrupt_copy", r#"{"duplicate": 1, "corrupt": 0.1}"#, |judgement| {
        judgement.extras[0].damage.corrupts()
    }),
    ("truncate", r#"{"truncate": 0.1}"#, |judgement| judgement.damage.truncates_to() == Some(0)),
    (
        "attack",
        r#"{"attacks": [
            {"action": {"kind": "mirror"}, "target": {"probability": 0}},
            {"action": {"kind": "drop"}, "target": {"probability": 0.1}}
        ]}"#,
        is_lost,
    ),
];

fn judge<T>(direction: Direction, settings: &str, look: impl Fn(&Judgement) -> T) -> Vec<T> {
    let settings: LinkSettings = serde_json::from_str(settings).unwrap();
    let mut link = Link::new(direction, SEED, &settings).unwrap();
    let packet = |index| Packet { direction, sent_ns: index * 1_000_000, size: 64, index };
    (0..PACKETS).map(|index| look(&link.judge(&packet(index)))).collect()
}

fn text() -> String {
    let mut text =
        String::from("# Packets of 64 bytes sent every ms, seed 0x0123456789ABCDEF: 1 where it happens.\n");
    for &(name, settings, look) in CASES {
        for direction in [Direction::Forward, Direction::Backward] {
            let happens = judge(direction, settings, look);
            let digits: String = happens.iter().map(|&happens| if happens { '1' } else { '0' }).collect();
            writeln!(text, "{name} {direction} {digits}").unwrap();
        }
    }
    text.push_str("# Numbers of the bits that are flipped, three in each packet, in order.\n");
    let flipped = judge(Direction::Forward, r#"{"corrupt": 1, "corrupt_bits": 3}"#, |judgement| {
        let mut payload = [0; 64];
        judgement.damage.apply(&mut payload);
        let is_flipped = |bit: &usize| payload[bit / 8] >> (bit % 8) & 1 == 1;
        (0..512).filter(is_flipped).collect::<Vec<_>>()
    });
    let bits: Vec<_> = flipped.concat().iter().map(ToString::to_string).collect();
    writeln!(text, "flipped forward {}", bits.join(" ")).unwrap();
    text
}

#[test]
fn the_first_verdicts_of_a_seed_are_known() {
    let text = text();
    for (known, seen) in KNOWN.lines().zip(text.lines()) {
        assert_eq!(known, seen);
    }
    assert_eq!(KNOWN, text);
}
