//! Effects on arrival: copies, flipped bits, truncation, and the MTU.

use super::chains::{MANY, SEED};
use crate::{Damage, Direction, DropCause, Extra, ExtraCause, Link, LinkSettings, Packet, Verdict};

fn packet(index: u64, size: usize) -> Packet {
    Packet { direction: Direction::Forward, sent_ns: index * 1_000_000, size, index }
}

fn judged(link: &mut Link, packet: &Packet) -> (Verdict, Damage, Vec<Extra>) {
    let judgement = link.judge(packet);
    (judgement.verdict, *judgement.damage, judgement.extras.to_vec())
}

fn check_binomial(count: u64, probability: f64) {
    let expected = probability * MANY as f64;
    let sigma = (expected * (1.0 - probability)).sqrt();
    assert!((count as f64 - expected).abs() < 3.0 * sigma, "{count}, expected {expected} +- {sigma}");
}

#[test]
fn duplicates_are_as_frequent_as_asked_and_come_after_the_gap() {
    let settings =
        LinkSettings { delay_s: 0.01, duplicate: 0.03, duplicate_gap_s: 0.002, ..LinkSettings::default() };
    let mut link = Link::new(Direction::Forward, SEED, &settings).unwrap();
    for index in 0..MANY {
        let packet = packet(index, 64);
        let (verdict, damage, extras) = judged(&mut link, &packet);
        assert_eq!(verdict, Verdict::Deliver { at_ns: packet.sent_ns + 10_000_000 });
        assert!(damage.is_none() && extras.len() <= 1);
        if let [copy] = extras[..] {
            let at_ns = packet.sent_ns + 12_000_000;
            assert_eq!(copy, Extra { at_ns, cause: ExtraCause::Duplicate, damage: Damage::NONE });
        }
    }
    check_binomial(link.counters().extras, 0.03);
}

#[test]
fn a_packet_and_its_copy_are_damaged_independently() {
    let settings = LinkSettings {
        duplicate: 1.0,
        corrupt: 0.1,
        corrupt_bits: 2,
        truncate: 0.2,
        truncate_bytes: 20,
        ..LinkSettings::default()
    };
    let mut link = Link::new(Direction::Forward, SEED, &settings).unwrap();
    let [mut corrupted, mut copies_corrupted, mut both_corrupted] = [0; 3];
    let [mut cut, mut copies_cut, mut both_cut] = [0; 3];
    for index in 0..MANY {
        let (_, damage, extras) = judged(&mut link, &packet(index, 64));
        let copy = extras[0].damage;
        corrupted += u64::from(damage.corrupts());
        copies_corrupted += u64::from(copy.corrupts());
        if damage.corrupts() && copy.corrupts() {
            both_corrupted += 1;
            let flipped = |damage: Damage| {
                let mut payload = [0_u8; 64];
                damage.apply(&mut payload);
                payload
            };
            // The same two of 512 bits by chance: probability 1 / 131 000 in each of about 10 000 cases.
            assert_ne!(flipped(damage), flipped(copy));
        }
        let cut_by = |damage: Damage| u64::from(damage.truncates_to() == Some(20));
        cut += cut_by(damage);
        copies_cut += cut_by(copy);
        both_cut += cut_by(damage) * cut_by(copy);
    }
    for (count, probability) in [
        (corrupted, 0.1),
        (copies_corrupted, 0.1),
        (both_corrupted, 0.01),
        (cut, 0.2),
        (copies_cut, 0.2),
        (both_cut, 0.04),
    ] {
        check_binomial(count, probability);
    }
}

#[test]
fn flipped_bits_are_uniform_over_the_payload() {
    const BITS: usize = 128;
    for corrupt_bits in [1, 3] {
        let settings = LinkSettings { corrupt: 1.0, corrupt_bits, ..LinkSettings::default() };
        let mut link = Link::new(Direction::Forward, SEED, &settings).unwrap();
        let mut counts = [0_u32; BITS];
        let packets = 200_000;
        for index in 0..packets {
            let damage = link.judge(&packet(index, BITS / 8)).damage;
            let mut payload = [0; BITS / 8];
            assert_eq!(damage.apply(&mut payload), payload.len());
            let payload = u128::from_le_bytes(payload);
            assert_eq!(payload.count_ones(), corrupt_bits, "the flipped bits of packet {index} are distinct");
            for (bit, count) in counts.iter_mut().enumerate() {
                *count += u32::from(payload >> bit & 1 == 1);
            }
        }
        let drawn = f64::from(corrupt_bits);
        let expected = packets as f64 * drawn / BITS as f64;
        // For b of B bits without replacement, the sum is (B - b) / (B - 1) of chi-square.
        let finite = (BITS as f64 - drawn) / (BITS as f64 - 1.0);
        let sum: f64 = counts.iter().map(|&seen| (f64::from(seen) - expected).powi(2) / expected).sum();
        let freedom = BITS as f64 - 1.0;
        let chi_square = sum / finite;
        assert!((chi_square - freedom).abs() < 4.0 * (2.0 * freedom).sqrt(), "{chi_square}");
    }
}

#[test]
fn short_and_empty_packets_stay_unchanged() {
    let settings =
        LinkSettings { corrupt: 1.0, truncate: 1.0, truncate_bytes: 10, ..LinkSettings::default() };
    let mut link = Link::new(Direction::Forward, 0, &settings).unwrap();
    for (size, corrupts, cut) in [(0, false, None), (10, true, None), (11, true, Some(10))] {
        let damage = link.judge(&packet(size as u64, size)).damage;
        assert_eq!((damage.corrupts(), damage.truncates_to()), (corrupts, cut), "{size} bytes");
        assert_eq!(damage.apply(&mut vec![7; size]), size.min(10));
    }
}

#[test]
fn packet_above_the_mtu_is_dropped() {
    let settings = LinkSettings { mtu: Some(1200), ..LinkSettings::default() };
    let mut link = Link::new(Direction::Forward, 0, &settings).unwrap();
    assert_eq!(link.judge(&packet(0, 1200)).verdict, Verdict::Deliver { at_ns: 0 });
    assert_eq!(link.judge(&packet(1, 1201)).verdict, Verdict::Drop { cause: DropCause::Mtu });
}
