//! Batch verdicts and counters equal those of single packets; netem is excluded because it has arrival rules.

use super::{rough, scattered};
use crate::{Direction, Link, LinkSettings, Packet, Verdict};
use proptest::prelude::*;

fn settings() -> Vec<(&'static str, LinkSettings)> {
    let parsed = |text: &str| serde_json::from_str::<LinkSettings>(text).unwrap();
    vec![
        ("perfect", LinkSettings::default()),
        ("in order", rough()),
        ("out of order", scattered()),
        ("bursts", LinkSettings { loss: 0.3, mean_burst: Some(4.0), ..rough() }),
        ("reordered", LinkSettings { reorder: 0.2, reorder_depth: 3, ..rough() }),
        ("a full queue", LinkSettings { rate_bps: Some(4e5), queue_packets: Some(6), ..rough() }),
        (
            "an outage",
            parsed(
                r#"{"delay_s": 0.01, "outages": [{"times": {"kind": "once", "at_s": 0.05, "duration_s": 0.04}}]}"#,
            ),
        ),
        ("a jump", parsed(r#"{"delay_s": 0.05, "timeline": [{"at_s": 0.1, "delay_s": 0.02}]}"#)),
        ("too large", LinkSettings { mtu: Some(200), ..rough() }),
    ]
}

proptest! {
    #[test]
    fn batch_equals_single_packets(
        seed: u64,
        sizes in prop::collection::vec(1_usize..300, 250),
        batches in prop::collection::vec(0_usize..40, 1..20),
    ) {
        for (name, settings) in settings() {
            let direction = Direction::Forward;
            let packets: Vec<_> = sizes
                .iter()
                .zip(0_u64..)
                .map(|(size, index)| Packet { direction, sent_ns: 1_000_000 * index, size: *size, index })
                .collect();
            let mut alone = Link::new(direction, seed, &settings).unwrap();
            let expected: Vec<_> = packets.iter().map(|packet| alone.judge(packet).verdict).collect();
            let mut together = Link::new(direction, seed, &settings).unwrap();
            let mut found = Vec::new();
            let mut verdicts = vec![Verdict::Deliver { at_ns: 7 }; 3];
            let mut left = packets.as_slice();
            for size in batches.iter().chain(std::iter::repeat(&33)) {
                let (batch, rest) = left.split_at((*size).min(left.len()));
                together.judge_all(batch, &mut verdicts);
                found.extend_from_slice(&verdicts);
                left = rest;
                if left.is_empty() {
                    break;
                }
            }
            prop_assert_eq!(&found, &expected, "{}", name);
            prop_assert_eq!(together.counters(), alone.counters(), "{}", name);
            prop_assert_eq!(together.earliest_later_ns(), alone.earliest_later_ns(), "{}", name);
        }
    }
}

#[test]
#[should_panic(expected = "judges them one by one")]
fn a_link_that_changes_packets_is_refused() {
    let settings = LinkSettings { corrupt: 0.1, ..rough() };
    let mut link = Link::new(Direction::Forward, 1, &settings).unwrap();
    link.judge_all(&[], &mut Vec::new());
}
