//! Reordering: frequency, and number of overtaken packets.

use super::chains::{MANY, SEED};
use crate::{Direction, Link, LinkSettings, Packet, Verdict};

const MILLISECOND: u64 = 1_000_000;
const DELAY: u64 = 20 * MILLISECOND;

fn dues(settings: &LinkSettings, packets: u64) -> Vec<u64> {
    let mut link = Link::new(Direction::Forward, SEED, settings).unwrap();
    let due = |index| {
        let sent_ns = index * MILLISECOND;
        let packet = Packet { direction: Direction::Forward, sent_ns, size: 64, index };
        match link.judge(&packet).verdict {
            Verdict::Deliver { at_ns } => at_ns,
            Verdict::Drop { .. } => panic!("nothing is lost here"),
        }
    };
    (0..packets).map(due).collect()
}

/// Number of earlier packets that arrive after a time; looks back 64 packets, which covers all.
fn later(dues: &[u64], index: usize, than_ns: u64) -> usize {
    dues[index.saturating_sub(64)..index].iter().filter(|&&due_ns| due_ns > than_ns).count()
}

fn overtaken(dues: &[u64], index: usize) -> usize {
    later(dues, index, dues[index])
}

fn settings(reorder: f64, reorder_depth: usize) -> LinkSettings {
    LinkSettings { delay_s: 0.02, reorder, reorder_depth, ..LinkSettings::default() }
}

#[test]
fn reordering_overtakes_the_given_number_and_delays_no_other() {
    for (reorder, depth) in [(0.01, 1), (0.01, 3), (0.2, 1), (0.2, 5), (0.5, 17)] {
        let dues = dues(&settings(reorder, depth), MANY);
        let mut reordered = 0;
        let mut enough = 0;
        for (index, &due_ns) in dues.iter().enumerate() {
            let undisturbed = index as u64 * MILLISECOND + DELAY;
            if due_ns < undisturbed {
                assert!(due_ns >= undisturbed - DELAY, "before it was sent");
                reordered += 1;
                let under_way = later(&dues, index, undisturbed - DELAY);
                assert_eq!(overtaken(&dues, index), depth.min(under_way), "packet {index}");
                // If every second packet jumps, most have arrived early.
                enough += u32::from(under_way >= depth);
            } else {
                assert_eq!(due_ns, undisturbed);
            }
        }
        let expected = reorder * MANY as f64;
        let sigma = (expected * (1.0 - reorder)).sqrt();
        assert!((f64::from(reordered) - expected).abs() < 3.0 * sigma + 1.0, "{reordered}");
        assert!(reorder > 0.2 || enough + 10 > reordered, "{enough} of {reordered}");
    }
}

/// Reordered packets in order of arrival, with their extents. A packet is reordered if a later one arrived
/// before it. Its extent is the number of arrivals between it and the first such packet.
///
/// Source: RFC 4737, 3.4 and 4.2.
fn extents(dues: &[u64]) -> Vec<(usize, usize)> {
    let mut arrivals: Vec<_> = (0..dues.len()).collect();
    arrivals.sort_by_key(|&index| (dues[index], index));
    let extent = |(position, &index): (usize, &usize)| {
        let earlier = &arrivals[..position];
        earlier.iter().position(|&other| other > index).map(|first| (index, position - first))
    };
    arrivals.iter().enumerate().filter_map(extent).collect()
}

#[test]
fn the_extents_of_rfc_4737_are_those_of_a_swap() {
    for depth in [1, 2, 3, 8] {
        let dues = dues(&settings(0.002, depth), 3000);
        let jumps: Vec<_> =
            (0..dues.len()).filter(|&index| dues[index] < index as u64 * MILLISECOND + DELAY).collect();
        assert!(jumps.len() > 1 && jumps.windows(2).all(|pair| pair[1] - pair[0] > depth), "{jumps:?}");
        let expected: Vec<_> = jumps
            .iter()
            .flat_map(|&jump| (1..=depth).map(move |extent| (jump - depth + extent - 1, extent)))
            .collect();
        assert_eq!(extents(&dues), expected);
    }
}

#[test]
fn no_packet_overtakes_more_than_are_under_way() {
    let dues = dues(&LinkSettings { delay_s: 0.0025, ..settings(1e-2, 1024) }, 100_000);
    let jumps = (2..dues.len()).filter(|&index| dues[index] < index as u64 * MILLISECOND + MILLISECOND);
    let mut count = 0;
    for jump in jumps {
        // The last two packets, sent 1 ms and 2 ms before, are under way; the third last has arrived.
        assert!((1..=2).contains(&overtaken(&dues, jump)), "{jump}");
        assert!(dues[jump] >= jump as u64 * MILLISECOND);
        count += 1;
    }
    assert!(count > 800, "{count}");
}

#[test]
fn a_held_packet_delays_no_other() {
    let hold = LinkSettings { reorder_hold_s: Some(0.0055), ..settings(0.05, 1) };
    let dues = dues(&LinkSettings { delay_s: 0.0, ..hold }, MANY);
    let mut held = 0;
    for (index, &due_ns) in (0..).zip(&dues) {
        let late_ns = due_ns - index * MILLISECOND;
        assert!(late_ns == 0 || late_ns == 5_500_000);
        held += u64::from(late_ns > 0);
    }
    let expected = 0.05 * MANY as f64;
    assert!((held as f64 - expected).abs() < 3.0 * (expected * 0.95).sqrt(), "{held}");
}
