//! Attacks: effect on a packet, and selection of packets.

use crate::{
    Action, Attack, ByteRange, Checksum, Direction, DropCause, Edit, ExtraCause, Link, LinkSettings,
    Operation, Packet, Target, Verdict,
};

const SENT_NS: u64 = 5_000_000;

fn packet(index: u64, size: usize) -> Packet {
    Packet { direction: Direction::Forward, sent_ns: SENT_NS, size, index }
}

fn attacks(actions: &[Action]) -> LinkSettings {
    let attacks =
        actions.iter().cloned().map(|action| Attack { action, target: Target::default() }).collect();
    LinkSettings { delay_s: 0.01, attacks, ..LinkSettings::default() }
}

/// Delay after sending, cause and bytes of an additional packet.
type Beside = (u64, ExtraCause, Vec<u8>);

/// Outcome for a packet of 32 ones: itself if delivered, and additional packets.
fn outcome(settings: &LinkSettings) -> (Option<Vec<u8>>, Vec<Beside>) {
    let mut link = Link::new(Direction::Forward, 3, settings).unwrap();
    let judgement = link.judge(&packet(7, 32));
    let changed = |damage: crate::Damage| {
        let mut payload = vec![1; 32];
        let left = damage.apply(&mut payload);
        payload.truncate(left);
        payload
    };
    let itself = match judgement.verdict {
        Verdict::Deliver { at_ns } => {
            assert_eq!(at_ns, SENT_NS + 10_000_000);
            Some(changed(*judgement.damage))
        }
        Verdict::Drop { cause } => {
            assert_eq!(cause, DropCause::Attack);
            None
        }
    };
    let extras = judgement.extras.iter();
    let beside = extras.map(|extra| (extra.at_ns - SENT_NS, extra.cause, changed(extra.damage))).collect();
    (itself, beside)
}

#[test]
fn copies_arrive_as_the_packet_did_or_later() {
    let ones = vec![1; 32];
    for (action, after_ns, cause) in [
        (Action::Replay { after_s: 0.25 }, 250_000_000, ExtraCause::Replay),
        (Action::Mirror, 0, ExtraCause::Mirror),
        (Action::SecondSource, 0, ExtraCause::SecondSource),
    ] {
        let (itself, beside) = outcome(&attacks(&[action]));
        assert_eq!(itself.as_ref(), Some(&ones));
        assert_eq!(beside, [(10_000_000 + after_ns, cause, ones.clone())]);
    }
}

#[test]
fn a_forged_packet_keeps_its_beginning_only() {
    let (itself, beside) = outcome(&attacks(&[Action::Forge { keep_bytes: 12 }]));
    assert_eq!(itself, Some(vec![1; 32]));
    let [(10_000_000, ExtraCause::Forge, forged)] = &beside[..] else { panic!("{beside:?}") };
    assert_eq!(forged[..12], [1; 12]);
    assert!(forged.len() == 32 && forged[12..] != [1; 20]);
}

#[test]
fn flipped_bits_lie_within_the_range() {
    let within = ByteRange { start: 4, end: 6 };
    for bits in [1, 5, 16] {
        let (itself, beside) = outcome(&attacks(&[Action::BitFlip { bits, within }]));
        let itself = itself.unwrap();
        let flipped: u32 = itself.iter().map(|byte| (byte ^ 1).count_ones()).sum();
        let inside: u32 = itself[4..6].iter().map(|byte| (byte ^ 1).count_ones()).sum();
        assert_eq!((flipped, inside, beside.len()), (bits, bits, 0));
    }
}

#[test]
fn a_sequence_that_is_ahead_wraps() {
    let lead = u64::MAX;
    let (itself, beside) = outcome(&attacks(&[Action::SequenceLead { lead, offset: 8 }]));
    assert_eq!(itself, Some(vec![1; 32]));
    let mut expected = vec![1; 32];
    // One less, modulo 2^64.
    expected[8] = 0;
    assert_eq!(beside, [(10_000_000, ExtraCause::SequenceLead, expected)]);
}

/// Set the u64 at byte 8 to 5. Tests beside `Alteration` compare the checksum with its definition.
fn to_five(inject: bool) -> Action {
    let edits = vec![Edit::U64 { offset: 8, operation: Operation::Set, value: 5 }];
    Action::Alter { edits, checksum: Some(Checksum::Crc32), inject }
}

fn ones_with_five() -> Vec<u8> {
    let mut expected = vec![1; 32];
    expected[8..16].copy_from_slice(&5_u64.to_le_bytes());
    let checksum = crc32fast::hash(&expected[..28]);
    expected[28..].copy_from_slice(&checksum.to_le_bytes());
    expected
}

#[test]
fn a_packet_is_altered_in_place_with_the_copies_of_the_network() {
    assert_eq!(outcome(&attacks(&[to_five(false)])), (Some(ones_with_five()), vec![]));
    let twice = LinkSettings { duplicate: 1.0, ..attacks(&[Action::Mirror, to_five(false)]) };
    let beside = [
        (10_000_000, ExtraCause::Duplicate, ones_with_five()),
        // Copied before the alteration.
        (10_000_000, ExtraCause::Mirror, vec![1; 32]),
    ];
    assert_eq!(outcome(&twice), (Some(ones_with_five()), beside.to_vec()));
}

#[test]
fn an_altered_copy_arrives_beside_the_packet() {
    let beside = vec![(10_000_000, ExtraCause::Alter, ones_with_five())];
    assert_eq!(outcome(&attacks(&[to_five(true)])), (Some(vec![1; 32]), beside));
}

#[test]
fn truncated_packet_gets_its_checksum_at_the_end() {
    let cut = LinkSettings { truncate: 1.0, truncate_bytes: 20, ..attacks(&[to_five(false)]) };
    let mut expected = ones_with_five()[..16].to_vec();
    let checksum = crc32fast::hash(&expected);
    expected.extend(checksum.to_le_bytes());
    assert_eq!(outcome(&cut), (Some(expected), vec![]));
    let shorter = LinkSettings { truncate: 1.0, truncate_bytes: 15, ..attacks(&[to_five(true)]) };
    assert_eq!(outcome(&shorter), (Some(vec![1; 15]), vec![]));
}

#[test]
fn held_packets_arrive_later_and_others_pass() {
    let hold = |every| Attack {
        action: Action::HoldBack { by_s: 0.0025 },
        target: Target { every, ..Target::default() },
    };
    let arrivals = |attacks: Vec<Attack>| -> Vec<u64> {
        let settings = LinkSettings { delay_s: 0.01, duplicate: 1.0, attacks, ..LinkSettings::default() };
        let mut link = Link::new(Direction::Forward, 3, &settings).unwrap();
        let arrives = |index| {
            let packet =
                Packet { direction: Direction::Forward, sent_ns: index * 1_000_000, size: 32, index };
            let judgement = link.judge(&packet);
            let Verdict::Deliver { at_ns } = judgement.verdict else { panic!("lost") };
            assert_eq!(judgement.extras[0].at_ns, at_ns, "the network's duplicate is held as well");
            at_ns / 100_000
        };
        (0..6).map(arrives).collect()
    };
    assert_eq!(arrivals(vec![hold(1)]), [125, 135, 145, 155, 165, 175]);
    assert_eq!(arrivals(vec![hold(3)]), [125, 110, 120, 155, 140, 150]);
    // Holds accumulate in order; a copy of a held packet is late too.
    assert_eq!(arrivals(vec![hold(1), hold(3)]), [150, 135, 145, 180, 165, 175]);
}

#[test]
fn drop_removes_network_duplicates_but_no_replays() {
    let settings = LinkSettings { duplicate: 1.0, ..attacks(&[Action::Drop, Action::Mirror]) };
    assert_eq!(outcome(&settings), (None, vec![]));
    let delayed = attacks(&[Action::Replay { after_s: 0.1 }, Action::Drop]);
    assert_eq!(outcome(&delayed), (None, vec![(110_000_000, ExtraCause::Replay, vec![1; 32])]));
}

#[test]
fn adversary_sees_losses_and_damage_of_the_network() {
    let lost = LinkSettings { loss: 1.0, ..attacks(&[Action::Mirror]) };
    let mut link = Link::new(Direction::Forward, 3, &lost).unwrap();
    let judgement = link.judge(&packet(0, 32));
    assert_eq!(judgement.verdict, Verdict::Drop { cause: DropCause::Loss });
    assert!(judgement.extras.is_empty());

    let within = ByteRange { start: 0, end: 1 };
    let flip = Action::BitFlip { bits: 8, within };
    let cut = LinkSettings {
        truncate: 1.0,
        truncate_bytes: 9,
        duplicate: 1.0,
        ..attacks(&[Action::Mirror, flip, Action::Replay { after_s: 0.0 }])
    };
    let mut flipped = vec![1; 9];
    flipped[0] = 0xFE;
    let (itself, beside) = outcome(&cut);
    assert_eq!(itself.as_ref(), Some(&flipped));
    let expected = [
        (10_000_000, ExtraCause::Duplicate, flipped.clone()),
        (10_000_000, ExtraCause::Mirror, vec![1; 9]),
        (10_000_000, ExtraCause::Replay, flipped),
    ];
    assert_eq!(beside, expected);
}

#[test]
fn number_of_additional_packets_is_limited() {
    let eight = [const { Action::Mirror }; 8];
    let (itself, beside) = outcome(&attacks(&eight));
    assert!(itself.is_some());
    assert_eq!(beside.len(), 8);
    let too_many = LinkSettings { duplicate: 0.1, ..attacks(&eight) };
    assert_eq!(
        too_many.validate().unwrap_err().to_string(),
        "attacks: 8 of them add a packet: at most 8 may, a duplicate among them"
    );
}

#[test]
fn packet_too_short_for_an_attack_stays_unchanged() {
    let within = ByteRange { start: 32, end: 40 };
    let edits = vec![Edit::F64 { offset: 25, operation: Operation::Add, value: 1.0 }];
    for action in [
        Action::BitFlip { bits: 1, within },
        Action::SequenceLead { lead: 1, offset: 25 },
        Action::Alter { edits: edits.clone(), checksum: Some(Checksum::Crc32), inject: true },
        Action::Alter { edits, checksum: Some(Checksum::Crc32), inject: false },
    ] {
        assert_eq!(outcome(&attacks(&[action])), (Some(vec![1; 32]), vec![]));
    }
}

#[test]
fn attack_affects_only_its_target() {
    let aimed = |target| {
        let attacks = vec![Attack { action: Action::Drop, target }];
        let settings = LinkSettings { attacks, ..LinkSettings::default() };
        let mut link = Link::new(Direction::Forward, 3, &settings).unwrap();
        let mut met = Vec::new();
        for index in 0..1000 {
            let size = usize::try_from(index % 10).unwrap();
            let packet = Packet { direction: Direction::Forward, sent_ns: index * 1_000_000, size, index };
            if matches!(link.judge(&packet).verdict, Verdict::Drop { .. }) {
                met.push(index);
            }
        }
        met
    };
    let all = Target::default();
    assert_eq!(aimed(all), (0..1000).collect::<Vec<_>>());
    let times = Target { from_s: 0.1, until_s: Some(0.2), ..all };
    assert_eq!(aimed(times), (100..200).collect::<Vec<_>>());
    let every = Target { every: 7, ..all };
    assert_eq!(aimed(every), (0..1000).step_by(7).collect::<Vec<_>>());
    let sizes = Target { least_bytes: 3, most_bytes: Some(4), ..all };
    assert!(aimed(sizes).iter().all(|index| matches!(index % 10, 3 | 4)));
    assert_eq!(aimed(sizes).len(), 200);
    let some = aimed(Target { probability: 0.5, ..all }).len();
    assert!((450..550).contains(&some), "{some}");
}

#[test]
fn attacks_are_read_as_tables() {
    let read = |text: &str| serde_json::from_str::<Attack>(text);
    let flip =
        read(r#"{"action": {"kind": "bit-flip", "bits": 2, "within": {"start": 0, "end": 8}}}"#).unwrap();
    let within = ByteRange { start: 0, end: 8 };
    assert_eq!(flip, Attack { action: Action::BitFlip { bits: 2, within }, target: Target::default() });
    let alter =
        r#"{"kind": "alter", "edits": [{"type": "f64", "offset": 64, "operation": "set", "value": -1}]}"#;
    let edits = vec![Edit::F64 { offset: 64, operation: Operation::Set, value: -1.0 }];
    let alter = format!(r#"{{"action": {alter}}}"#);
    assert_eq!(read(&alter).unwrap().action, Action::Alter { edits, checksum: None, inject: false });
    let drop = read(r#"{"action": {"kind": "drop"}, "target": {"every": 3}}"#).unwrap();
    assert_eq!(drop.target, Target { every: 3, ..Target::default() });
    assert!(read(r#"{"action": {"kind": "replay", "after_s": 1, "before_s": 1}}"#).is_err());
}
