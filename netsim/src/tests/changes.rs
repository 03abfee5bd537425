//! Changes of settings while packets are in flight, and bounds on observed delays.

use crate::{DelayChange, Direction, Distribution, Judgement, Link, LinkSettings, Packet, Verdict};

const MS: u64 = 1_000_000;

fn arrival(link: &mut Link, sent_ns: u64, index: u64) -> u64 {
    let packet = Packet { direction: Direction::Forward, sent_ns, size: 64, index };
    let Judgement { verdict: Verdict::Deliver { at_ns }, .. } = link.judge(&packet) else {
        panic!("nothing is lost here");
    };
    at_ns
}

fn link(settings: &LinkSettings) -> Link {
    Link::new(Direction::Forward, 7, settings).unwrap()
}

#[test]
fn after_a_change_packets_keep_their_order() {
    let slow = LinkSettings { delay_s: 0.1, ..LinkSettings::default() };
    let mut link = link(&slow);
    assert_eq!(arrival(&mut link, 0, 0), 100 * MS);
    link.change(&LinkSettings::default()).unwrap();
    assert_eq!(arrival(&mut link, MS, 1), 100 * MS);
    assert_eq!(arrival(&mut link, 200 * MS, 2), 200 * MS);
}

#[test]
fn a_reorder_hold_does_not_delay_packets_after_a_change() {
    let holding = LinkSettings { reorder: 1.0, reorder_hold_s: Some(1.5), ..LinkSettings::default() };
    let mut link = link(&holding);
    assert_eq!(arrival(&mut link, 0, 0), 1500 * MS);
    link.change(&LinkSettings::default()).unwrap();
    assert_eq!(arrival(&mut link, MS, 1), MS);
}

#[test]
fn a_change_to_netem_adds_its_delay_once() {
    let slow = LinkSettings { delay_s: 0.5, ..LinkSettings::default() };
    let mut link = link(&slow);
    assert_eq!(arrival(&mut link, 0, 0), 500 * MS);
    link.change(&LinkSettings { netem: Some("delay 300ms".into()), ..LinkSettings::default() }).unwrap();
    assert_eq!(arrival(&mut link, 100 * MS, 1), 400 * MS);
}

#[test]
fn table_delays_stay_within_the_longest_delay() {
    let table = (-50..=50).collect();
    let settings = LinkSettings {
        delay_s: 0.1,
        jitter_s: 0.02,
        distribution: Distribution::Table(table),
        ..LinkSettings::default()
    };
    let mut link = link(&settings);
    let longest = (0..100_000).map(|index| arrival(&mut link, index * MS, index) - index * MS).max().unwrap();
    let bound_ns = settings.longest_delay_s() * 1e9;
    assert!(longest as f64 <= bound_ns && longest as f64 > 0.95 * bound_ns, "{longest} {bound_ns}");
}

#[test]
fn timeline_delay_below_the_jitter_is_refused_by_its_key() {
    let settings = |delay_s| LinkSettings {
        delay_s: 0.1,
        jitter_s: 0.01,
        timeline: vec![DelayChange { at_s: 1.0, delay_s, ramp_s: 0.0 }],
        ..LinkSettings::default()
    };
    assert_eq!(settings(0.07).validate(), Ok(()));
    let error = settings(0.03).validate().unwrap_err().to_string();
    assert!(error.starts_with("timeline.0.delay_s: 0.03 s is less than the jitter reaches below"), "{error}");
}
