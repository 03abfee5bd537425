//! Independence of impairments, over all pairs: enabling another does not change the effect of one.

use super::chains::SEED;
use crate::{
    Action, Attack, Direction, DropCause, Extra, ExtraCause, FourState, GilbertElliott, Judgement, Link,
    LinkSettings, Outage, OutageEffect, OutageTimes, Packet, Target, Verdict,
};

const PACKETS: u64 = 20_000;

/// Observed effect of one impairment on a packet; `None` if another impairment hides it.
type Seen = Option<u64>;

struct Case {
    name: &'static str,
    add: fn(&mut LinkSettings),
    see: fn(&Packet, &Judgement) -> Seen,
}

/// Drop by this cause; `None` for another cause, which precedes this rule or follows it.
fn dropped(judgement: &Judgement, by: DropCause) -> Seen {
    match judgement.verdict {
        Verdict::Drop { cause } => (cause == by).then_some(1),
        Verdict::Deliver { .. } => Some(0),
    }
}

fn lost(_: &Packet, judgement: &Judgement) -> Seen {
    dropped(judgement, DropCause::Loss)
}

fn outage(_: &Packet, judgement: &Judgement) -> Seen {
    dropped(judgement, DropCause::Outage)
}

/// Lateness in whole s, rounded: 0 or some seconds.
fn held(packet: &Packet, judgement: &Judgement) -> Seen {
    match judgement.verdict {
        Verdict::Deliver { at_ns } => Some((at_ns - packet.sent_ns + 500_000_000) / 1_000_000_000),
        Verdict::Drop { .. } => None,
    }
}

fn extra(judgement: &Judgement, cause: ExtraCause) -> Seen {
    let delivered = matches!(judgement.verdict, Verdict::Deliver { .. });
    let count = |extra: &&Extra| extra.cause == cause;
    delivered.then(|| judgement.extras.iter().filter(count).count() as u64)
}

fn random_outage() -> Outage {
    let times = OutageTimes::Random { mean_up_s: 0.1, mean_down_s: 0.02 };
    Outage { times, effect: OutageEffect::Drop }
}

fn attack(settings: &mut LinkSettings, action: Action) {
    let target = Target { probability: 0.1, ..Target::default() };
    settings.attacks.push(Attack { action, target });
}

const CASES: &[Case] = &[
    Case { name: "mtu", add: |s| s.mtu = Some(95), see: |_, j| dropped(j, DropCause::Mtu) },
    Case { name: "bernoulli", add: |s| s.loss = 0.1, see: lost },
    Case { name: "gilbert", add: |s| (s.loss, s.mean_burst) = (0.1, Some(4.0)), see: lost },
    Case { name: "gilbert in time", add: |s| (s.loss, s.mean_burst_s) = (0.1, Some(0.004)), see: lost },
    Case {
        name: "gilbert-elliott",
        add: |s| {
            s.gilbert_elliott =
                Some(GilbertElliott { to_bad: 0.02, to_good: 0.2, loss_good: 0.01, loss_bad: 0.7 });
        },
        see: lost,
    },
    Case {
        name: "four states",
        add: |s| {
            s.four_state = Some(FourState { p13: 0.02, p31: 0.2, p32: 0.1, p23: 0.5, p14: 0.01 });
        },
        see: lost,
    },
    Case { name: "outage", add: |s| s.outages.push(random_outage()), see: outage },
    Case {
        name: "hold",
        add: |s| {
            let times = OutageTimes::Periodic { at_s: 0.3, period_s: 1.0, duration_s: 0.05 };
            s.outages.push(Outage { times, effect: OutageEffect::Hold });
        },
        // Held for at most 50 ms, similar to other delays: observe only the delivery.
        see: |_, j| matches!(j.verdict, Verdict::Deliver { .. }).then_some(1),
    },
    Case { name: "jitter", add: |s| s.jitter_s = 0.003, see: |_, _| None },
    Case { name: "reorder", add: |s| (s.reorder, s.reorder_hold_s) = (0.1, Some(3.0)), see: held },
    Case { name: "duplicate", add: |s| s.duplicate = 0.1, see: |_, j| extra(j, ExtraCause::Duplicate) },
    Case {
        name: "corrupt",
        add: |s| (s.corrupt, s.corrupt_bits) = (0.1, 3),
        see: |packet, j| {
            // Flipped bits of the first eight bytes, unless the packet is dropped.
            let mut payload = vec![0; packet.size];
            j.damage.apply(&mut payload);
            let first = payload.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
            matches!(j.verdict, Verdict::Deliver { .. }).then_some(first)
        },
    },
    Case {
        name: "truncate",
        add: |s| (s.truncate, s.truncate_bytes) = (0.1, 20),
        see: |_, j| {
            matches!(j.verdict, Verdict::Deliver { .. })
                .then(|| j.damage.truncates_to().map_or(0, |bytes| bytes as u64))
        },
    },
    Case {
        name: "replay",
        add: |s| attack(s, Action::Replay { after_s: 0.1 }),
        see: |_, j| extra(j, ExtraCause::Replay),
    },
];

/// A link has at most one loss model.
const LOSSES: [&str; 5] = ["bernoulli", "gilbert", "gilbert in time", "gilbert-elliott", "four states"];

fn excludes(one: &Case, other: &Case) -> bool {
    one.name == other.name || [one, other].iter().all(|case| LOSSES.contains(&case.name))
}

fn run(cases: &[&Case], see: fn(&Packet, &Judgement) -> Seen) -> Vec<Seen> {
    let mut settings = LinkSettings { delay_s: 0.02, ..LinkSettings::default() };
    for case in cases {
        (case.add)(&mut settings);
    }
    let mut link = Link::new(Direction::Forward, SEED, &settings).unwrap();
    let packets = (0..PACKETS).map(|index| {
        let size = 32 + usize::try_from(index % 71).unwrap();
        let packet = Packet { direction: Direction::Forward, sent_ns: index * 1_000_000, size, index };
        see(&packet, &link.judge(&packet))
    });
    packets.collect()
}

#[test]
fn no_impairment_shifts_another() {
    let mut pairs = 0;
    for one in CASES {
        let alone = run(&[one], one.see);
        for other in CASES.iter().filter(|other| !excludes(one, other)) {
            let together = run(&[one, other], one.see);
            let both =
                alone.iter().zip(&together).filter(|(alone, together)| alone.is_some() && together.is_some());
            let mut compared = 0;
            for (alone, together) in both {
                assert_eq!(alone, together, "{} beside {}", one.name, other.name);
                compared += 1;
            }
            if one.name != "jitter" {
                assert!(compared > PACKETS / 2, "{} beside {}: {compared}", one.name, other.name);
                pairs += 1;
            }
        }
    }
    // 13 of 14 are observed, each beside 13 others; 5 loss models exclude each other.
    assert_eq!(pairs, 13 * 13 - 5 * 4);
}

#[test]
fn a_duplicate_leaves_every_verdict_as_it_was() {
    let rough = LinkSettings {
        delay_s: 0.02,
        jitter_s: 0.003,
        loss: 0.05,
        mean_burst: Some(4.0),
        outages: vec![random_outage()],
        reorder: 0.1,
        reorder_depth: 3,
        corrupt: 0.1,
        corrupt_bits: 4,
        truncate: 0.1,
        truncate_bytes: 20,
        ..LinkSettings::default()
    };
    let doubled = LinkSettings { duplicate: 0.3, duplicate_gap_s: 0.001, ..rough.clone() };
    let mut links = [&rough, &doubled].map(|settings| Link::new(Direction::Forward, SEED, settings).unwrap());
    for index in 0..PACKETS {
        let packet = Packet { direction: Direction::Forward, sent_ns: index * 1_000_000, size: 64, index };
        let [one, other] = links.each_mut().map(|link| {
            let judgement = link.judge(&packet);
            (judgement.verdict, *judgement.damage)
        });
        assert_eq!(one, other, "packet {index}");
    }
    assert!(links[1].counters().extras > 4000);
}
