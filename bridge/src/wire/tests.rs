//! Bytes of a frame, and rejection of invalid ones.

use super::*;
use crate::coupling::drawn::orientation;
use proptest::prelude::*;

const LAYOUT: FrameLayout = FrameLayout { coupling: CouplingKind::PdDamped, ..FrameLayout::of(1) };

fn message(vector: f64) -> CouplingMessage {
    CouplingMessage { epoch: 0x0207, vector: padded(&Axes::<1>::new(vector)), ..CouplingMessage::ZERO }
}

fn frame() -> Frame {
    Frame {
        role: Role::Slave,
        axes: 1,
        kind: SideKind::Linear,
        coupling: CouplingKind::PdDamped,
        message: message(0.125),
        state: 2,
        hears_peer: true,
        clutch: true,
        run_id: 0x1122_3344_5566_7788,
        sequence: 5,
        sent_ns: 1_000_000,
        echo: Some(Echo { run_id: 11, sequence: 3, sent_ns: 7, held_ns: 9 }),
        position: padded(&Axes::<1>::new(-0.5)),
        velocity: padded(&Axes::<1>::new(0.25)),
        force: padded(&Axes::<1>::new(2.0)),
        energy: PortEnergy { in_j: 1.5, out_j: 0.25 },
        rotation: None,
        gripper: None,
        buttons: None,
        ending: true,
        reason: 4,
        fault: 11,
        text: TextPiece { number: 3, index: 1, bytes: *b"bus is down\0" },
    }
}

/// Known answer, written by hand from the table in `wire.rs`.
#[test]
fn bytes_are_those_of_the_table() {
    let mut buffer = [0; MAX_FRAME];
    let bytes = frame().encode(&mut buffer);
    let mut expected = Vec::new();
    expected.extend_from_slice(b"HT\x07\x02\x11\x02\x0F\x03");
    expected.extend_from_slice(&[0x88, 0x77, 0x66, 0x55, 0x44, 0x33, 0x22, 0x11]);
    for number in [5_u64, 3, 1_000_000, 7, 9, 11] {
        expected.extend_from_slice(&number.to_le_bytes());
    }
    expected.extend_from_slice(&[0, 0, 0, 0, 0, 0, 0xE0, 0xBF]); // -0.5
    expected.extend_from_slice(&[0, 0, 0, 0, 0, 0, 0xD0, 0x3F]); // 0.25
    expected.extend_from_slice(&[0, 0, 0, 0, 0, 0, 0x00, 0x40]); // 2.0
    expected.extend_from_slice(&[0, 0, 0, 0, 0, 0, 0xF8, 0x3F]); // 1.5
    expected.extend_from_slice(&[0, 0, 0, 0, 0, 0, 0xD0, 0x3F]); // 0.25
    expected.extend_from_slice(&[0, 0, 0, 0, 0, 0, 0xC0, 0x3F]); // 0.125
    expected.extend_from_slice(&[0; 16]);
    expected.extend_from_slice(b"\x07\x02");
    expected.extend_from_slice(b"\x04\x0B\x03\x01bus is down\x00");
    expected.extend_from_slice(&crc32fast::hash(&expected).to_le_bytes());
    assert_eq!(bytes, expected);
    assert_eq!(Frame::decode(bytes, Role::Slave, LAYOUT), Ok(frame()));
}

/// The gripper follows the energies of the coupling and lengthens every frame by 24 bytes.
#[test]
fn a_gripper_is_three_numbers_and_three_flags() {
    let state = GripperState {
        position: Some(0.5),
        velocity: -0.25,
        force_n: 2.0,
        holds_object: true,
        follows: true,
    };
    let mut buffer = [0; MAX_FRAME];
    let without = frame().encode(&mut buffer).to_vec();
    let framed = Frame { gripper: Some(state), ..frame() };
    let bytes = framed.encode(&mut buffer).to_vec();
    let mut expected = without[..128].to_vec();
    expected[6] |= 0x70;
    for number in [0.5_f64, -0.25, 2.0] {
        expected.extend_from_slice(&number.to_le_bytes());
    }
    expected.extend_from_slice(&without[128..146]);
    expected.extend_from_slice(&crc32fast::hash(&expected).to_le_bytes());
    assert_eq!(bytes, expected);
    let layout = FrameLayout { has_gripper: true, ..LAYOUT };
    assert_eq!(Frame::decode(&bytes, Role::Slave, layout), Ok(framed));
    let resealed = |change: &dyn Fn(&mut [u8])| {
        let mut bytes = bytes[..bytes.len() - CHECKSUM].to_vec();
        change(&mut bytes);
        bytes.extend_from_slice(&crc32fast::hash(&bytes).to_le_bytes());
        Frame::decode(&bytes, Role::Slave, layout)
    };
    let unknown = Frame { gripper: Some(GripperState::default()), ..frame() };
    let blank = |bytes: &mut [u8]| {
        bytes[6] &= 0x0F;
        bytes[128..152].fill(0);
    };
    assert_eq!(resealed(&blank), Ok(unknown));
    for change in [
        &(|b: &mut [u8]| b[6] &= !0x10) as &dyn Fn(&mut [u8]),
        &|b| b[128..136].copy_from_slice(&1.001_f64.to_le_bytes()),
        &|b| b[128..136].copy_from_slice(&f64::NAN.to_le_bytes()),
        &|b| b[136..144].copy_from_slice(&101.0_f64.to_le_bytes()),
        &|b| b[144..152].copy_from_slice(&(-1.0_f64).to_le_bytes()),
        &|b| {
            blank(b);
            b[6] |= 0x20;
        },
        &|b| {
            blank(b);
            b[6] |= 0x40;
        },
        &|b| {
            blank(b);
            b[135] = 0x80; // -0.0
        },
    ] {
        assert!(matches!(resealed(change), Err(WireError::Gripper { sequence: 5, .. })));
    }
}

#[test]
fn only_a_slave_gripper_follows() {
    let follows = GripperState { position: Some(0.5), follows: true, ..GripperState::default() };
    let framed = Frame { role: Role::Master, gripper: Some(follows), ..frame() };
    let mut buffer = [0; MAX_FRAME];
    let layout = FrameLayout { has_gripper: true, ..LAYOUT };
    let refused = Frame::decode(framed.encode(&mut buffer), Role::Master, layout);
    assert_eq!(refused, Err(WireError::Flags(0x35F)));
}

/// The rotation precedes the energies. The buttons follow the gripper and precede the epoch.
#[test]
fn a_pose_is_ten_numbers_and_buttons_are_a_word() {
    let [x, y] = [0.6, 0.8];
    let state = RotationState {
        // -q of (0, 0.6, 0.8, 0): the sent quaternion has a positive first non-zero component.
        orientation: nalgebra::Unit::new_unchecked(nalgebra::Quaternion::new(0.0, -x, -y, 0.0)),
        angular_velocity: Axes::<3>::new(1.0, -2.0, 3.0),
        torque: Axes::<3>::new(0.5, 0.25, -0.125),
    };
    let turned =
        CouplingMessage { epoch: 1, turned: Axes::<3>::new(0.5, -1.5, 3.0), ..CouplingMessage::ZERO };
    let point = Frame {
        role: Role::Master,
        kind: SideKind::Linear,
        coupling: CouplingKind::PdDamped,
        message: CouplingMessage { epoch: 1, ..CouplingMessage::ZERO },
        state: 2,
        hears_peer: true,
        clutch: true,
        run_id: 1,
        sequence: 5,
        sent_ns: 7,
        echo: None,
        axes: 3,
        position: padded(&Axes::<3>::new(1.0, 2.0, 3.0)),
        velocity: padded(&Axes::<3>::new(4.0, 5.0, 6.0)),
        force: padded(&Axes::<3>::new(7.0, 8.0, 9.0)),
        rotation: None,
        energy: PortEnergy { in_j: 1.5, out_j: 0.25 },
        gripper: None,
        buttons: None,
        ending: false,
        reason: 0,
        fault: 0,
        text: TextPiece::default(),
    };
    let mut buffer = [0; MAX_FRAME];
    let without = point.encode(&mut buffer).to_vec();
    let framed = Frame {
        kind: SideKind::Pose,
        message: turned,
        rotation: Some(state),
        buttons: Some(0x8000_0005),
        ..point
    };
    let bytes = framed.encode(&mut buffer).to_vec();
    let mut expected = without[..136].to_vec();
    expected[4] = 0x33;
    for number in [0.0, 0.6, 0.8, 0.0, 1.0, -2.0, 3.0, 0.5, 0.25, -0.125_f64] {
        expected.extend_from_slice(&number.to_le_bytes());
    }
    expected.extend_from_slice(&without[136..176]);
    for number in [0.5, -1.5, 3.0_f64] {
        expected.extend_from_slice(&number.to_le_bytes());
    }
    expected.extend_from_slice(&without[176..192]);
    expected.extend_from_slice(&[5, 0, 0, 0x80]);
    expected.extend_from_slice(&without[192..210]);
    expected.extend_from_slice(&crc32fast::hash(&expected).to_le_bytes());
    assert_eq!(bytes, expected);
    let layout = framed.layout();
    assert_eq!((layout.length(), without.len()), (322, 214));
    let decoded = Frame::decode(&bytes, Role::Master, layout).unwrap();
    assert_eq!(decoded.encode(&mut buffer), bytes);
    assert_eq!(decoded.buttons, Some(0x8000_0005));
    let resealed = |role: u8, change: &dyn Fn(&mut [u8])| {
        let mut bytes = bytes[..bytes.len() - CHECKSUM].to_vec();
        bytes[3] = role;
        change(&mut bytes);
        bytes.extend_from_slice(&crc32fast::hash(&bytes).to_le_bytes());
        let from = if role == 1 { Role::Master } else { Role::Slave };
        Frame::decode(&bytes, from, layout).unwrap_err()
    };
    let put = |at: usize, value: f64| move |b: &mut [u8]| b[at..at + 8].copy_from_slice(&value.to_le_bytes());
    for (at, value) in [(144, 0.601), (144, -0.6), (136, -0.0), (136, f64::NAN), (152, f64::INFINITY)] {
        let error = resealed(1, &put(at, value));
        assert!(matches!(error, WireError::Orientation { sequence: 5, .. }), "{at} {value}: {error}");
    }
    assert_eq!(resealed(1, &put(168, 1001.0)).to_string(), "frame 5: angular velocity exceeds 1000 rad/s");
    assert_eq!(
        resealed(1, &put(192, f64::NAN)).to_string(),
        "frame 5: rendered torque is not a finite number"
    );
    assert_eq!(resealed(2, &|_| {}), WireError::Buttons { sequence: 5, buttons: 0x8000_0005 });
    let torque = |b: &mut [u8]| {
        put(192, -1e5)(b);
        b[296..300].fill(0);
    };
    assert_eq!(resealed(2, &torque).to_string(), "frame 5: environment torque exceeds 10000 N m");
    let kind = resealed(1, &|b| b[4] = 0x13);
    assert_eq!(kind.to_string(), "frame of kind 1: must be 3, pose");
}

#[test]
fn checksum_is_crc32() {
    assert_eq!(crc32fast::hash(b"123456789"), 0xCBF4_3926);
}

#[test]
fn refusals_name_what_was_seen() {
    let mut buffer = [0; MAX_FRAME];
    let good = frame().encode(&mut buffer).to_vec();
    let refuse = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = good.clone();
        change(&mut bytes);
        Frame::decode(&bytes, Role::Slave, LAYOUT).unwrap_err()
    };
    assert_eq!(refuse(&|b| b.truncate(10)), WireError::Length { seen: 10, allowed: 150 });
    assert_eq!(refuse(&|b| b[0] = b'X'), WireError::Magic(*b"XT"));
    assert_eq!(refuse(&|b| b[2] = 9), WireError::Version(9));
    assert_eq!(refuse(&|b| b[3] = 1), WireError::Role(1));
    assert_eq!(refuse(&|b| b[4] = 0x13), WireError::Axes { seen: 3, allowed: 1 });
    assert_eq!(refuse(&|b| b[4] = 0x21), WireError::Kind { seen: 2, allowed: SideKind::Linear });
    let coupling = refuse(&|b| b[7] = 2);
    assert_eq!(coupling, WireError::Coupling { seen: 2, allowed: CouplingKind::PdDamped });
    assert_eq!(coupling.to_string(), "frame of coupling 2: must be 3, pd-damped");
    assert!(matches!(refuse(&|b| b[60] ^= 4), WireError::Checksum { .. }));
    let resealed = |change: &dyn Fn(&mut [u8])| {
        let mut bytes = good[..good.len() - CHECKSUM].to_vec();
        change(&mut bytes);
        bytes.extend_from_slice(&crc32fast::hash(&bytes).to_le_bytes());
        Frame::decode(&bytes, Role::Slave, LAYOUT)
    };
    assert_eq!(resealed(&|b| b[6] = 0x1F), Err(WireError::Flags(0x31F)));
    assert_eq!(resealed(&|b| b[7] = 0x13), Err(WireError::Flags(0x130F)));
    assert_eq!(resealed(&|b| b[6] = 2), Err(WireError::Flags(0x302)));
    let silent = resealed(&|b| {
        b[6] = 14;
        b[24..32].fill(0);
        b[40..64].fill(0);
    });
    assert_eq!(silent, Ok(Frame { echo: None, ..frame() }));
    // Codes that this version does not know are passed on, because they control nothing.
    let unknown = resealed(&|b| (b[130], b[131]) = (255, 254));
    assert_eq!(unknown, Ok(Frame { reason: 255, fault: 254, ..frame() }));
    let text = |number, index| Err(WireError::Text { sequence: 5, number, index });
    assert_eq!(resealed(&|b| b[132] = 0), text(0, 1));
    assert_eq!(resealed(&|b| b[133] = 20), text(3, 20));
    assert_eq!(resealed(&|b| b[136] = 0), text(3, 1));
    // The last piece contains the end.
    assert_eq!(resealed(&|b| (b[133], b[145]) = (19, b'!')), text(3, 19));
    assert_eq!(resealed(&|b| b[132..146].fill(0)), Ok(Frame { text: TextPiece::default(), ..frame() }));
    // A motion since the engagement is a position; there is none, and no energy, while not engaged.
    let put = |at: usize, value: f64| move |b: &mut [u8]| b[at..at + 8].copy_from_slice(&value.to_le_bytes());
    for (at, value) in [(104, 1000.1), (104, f64::NAN), (112, 1.0), (120, -0.0)] {
        let refused = resealed(&put(at, value)).unwrap_err();
        assert!(matches!(refused, WireError::Message { sequence: 5, .. }), "{at} {value}: {refused}");
    }
    assert_eq!(resealed(&put(104, -1000.0)), Ok(Frame { message: message(-1000.0), ..frame() }));
    let refused = resealed(&|b| b[128..130].fill(0)).unwrap_err();
    assert!(matches!(refused, WireError::Message { .. }), "{refused}");
    let idle = resealed(&|b| (b[104..112].fill(0), b[128..130].fill(0)).0);
    assert_eq!(idle, Ok(Frame { message: CouplingMessage::ZERO, ..frame() }));
    let mut bad = frame();
    bad.force[0] = f64::NAN;
    let error = Frame::decode(bad.encode(&mut buffer), Role::Slave, LAYOUT).unwrap_err();
    assert_eq!(error.to_string(), "frame 5: environment force is not a finite number");
}

/// Return a message as an engaged side of that coupling may send it, or with numbers out of range.
fn drawn_message(coupling: CouplingKind, epoch: u16, vector: Axes<3>) -> CouplingMessage {
    let idle = CouplingMessage { epoch, ..CouplingMessage::ZERO };
    if coupling.sends(Role::Master).is_none() || epoch == 0 {
        return idle;
    }
    let turned = vector.map(|x| x.clamp(-3.0, 3.0));
    let sums = if coupling.sends_energy() { [vector[0].abs(), vector[1].abs()] } else { [0.0; 2] };
    CouplingMessage { vector: padded(&vector), turned, sums, ..idle }
}

proptest! {
    #[test]
    fn round_trip(
        numbers in prop::array::uniform9(-900.0..900.0f64),
        (run_id, sequence, sent_ns) in any::<(u64, u64, u64)>(),
        echo in prop::option::of(any::<(u64, u64, u64, u64)>()),
        (state, hears_peer, clutch) in any::<(u8, bool, bool)>(),
        (ending, reason, fault, number, index) in any::<(bool, u8, u8, u8, u8)>(),
        gripper in prop::option::of((prop::option::of(0.0..=1.0f64), -100.0..=100.0f64, 0.0..=1e4f64, any::<bool>())),
        (orientation, buttons) in (orientation(), prop::option::of(any::<u32>())),
        (kind, epoch) in (0..CouplingKind::ALL.len(), any::<u16>()),
    ) {
        let part = |i: usize| Axes::<3>::new(numbers[i], numbers[i + 1], numbers[i + 2]);
        let frame = Frame {
            coupling: CouplingKind::ALL[kind], message: drawn_message(CouplingKind::ALL[kind], epoch, part(1)),
            role: Role::Master, axes: 3, kind: SideKind::Pose, state, hears_peer, clutch, run_id, sequence, sent_ns,
            echo: echo.map(|(run_id, sequence, sent_ns, held_ns)| Echo { run_id, sequence, sent_ns, held_ns }),
            position: padded(&part(0)), velocity: padded(&part(3)), force: padded(&part(6)),
            rotation: Some(RotationState {
                orientation, angular_velocity: part(2), torque: part(5),
            }),
            buttons,
            energy: PortEnergy { in_j: numbers[0].abs(), out_j: numbers[1].abs() },
            gripper: gripper.map(|(position, velocity, force_n, holds_object)| match position {
                Some(_) => GripperState { position, velocity, force_n, holds_object, follows: false },
                None => GripperState::default(),
            }),
            ending, reason, fault,
            text: match number {
                0 => TextPiece::default(),
                _ => TextPiece { number, index: index % 19, bytes: [index | 1; PIECE] },
            },
        };
        let mut buffer = [0; MAX_FRAME];
        let decoded = Frame::decode(frame.encode(&mut buffer), Role::Master, frame.layout()).unwrap();
        // The decoded quaternion is the canonical one of q and -q, with the same bits.
        let seen = decoded.rotation.unwrap().orientation;
        prop_assert_eq!(canonical(&seen), canonical(&orientation));
        let frame = Frame { rotation: decoded.rotation, ..frame };
        prop_assert_eq!(decoded, frame);
        prop_assert_eq!(decoded.rotation.unwrap().torque, part(5));
        prop_assert_eq!(decoded.rotation.unwrap().angular_velocity, part(2));
    }

    /// A frame passed without bytes equals the frame passed through bytes. This holds for any content, valid
    /// or not, for any session, and for a frame that returns to its sender.
    #[test]
    fn unencoded_frame_equals_decoded_frame(
        of_slave in any::<bool>(), comes_back in any::<bool>(), is_pose in any::<bool>(),
        numbers in prop::array::uniform5(prop_oneof![
            6 => -900.0..900.0f64, 1 => Just(-0.0), 1 => prop::num::f64::ANY,
        ]),
        echo in prop::option::of(prop_oneof![Just((0, 0, 0, 0)), any::<(u64, u64, u64, u64)>()]),
        (hears_peer, clutch, ending, number, index, letter) in any::<(bool, bool, bool, u8, u8, u8)>(),
        gripper in prop::option::of((
            prop::option::of(-0.1..1.1f64), prop_oneof![Just(0.0), Just(-0.0), -101.0..=101.0f64], -1.0..=1.1e4f64,
            any::<bool>(), any::<bool>(),
        )),
        (orientation, turned) in (orientation(), any::<bool>()),
        buttons in prop::option::of(prop_oneof![Just(0), any::<u32>()]),
        (kind, epoch) in (0..CouplingKind::ALL.len(), prop_oneof![Just(0), any::<u16>()]),
        (energy, session) in (prop_oneof![3 => 0.0..1e9f64, 1 => prop::num::f64::ANY], prop::option::of((any::<bool>(), any::<bool>(), 2..=4_usize))),
    ) {
        let part = |i: usize| Axes::<3>::new(numbers[i], numbers[i + 1], numbers[i + 2]);
        let role = if of_slave { Role::Slave } else { Role::Master };
        let coupling = CouplingKind::ALL[kind];
        let message = CouplingMessage { turned: Axes::zeros(), ..drawn_message(coupling, epoch, part(1)) };
        let frame = Frame {
            coupling, message,
            role, axes: 3, kind: if is_pose { SideKind::Pose } else { SideKind::Linear }, hears_peer, clutch, ending,
            echo: echo.map(|(run_id, sequence, sent_ns, held_ns)| Echo { run_id, sequence, sent_ns, held_ns }),
            position: padded(&part(0)), velocity: padded(&part(1)), force: padded(&part(2)),
            rotation: (is_pose && turned)
                .then(|| RotationState { orientation, angular_velocity: part(1), torque: part(0) }),
            energy: PortEnergy { in_j: energy, out_j: numbers[4].abs() },
            gripper: gripper.map(|(position, velocity, force_n, holds_object, follows)| GripperState {
                position, velocity, force_n, holds_object, follows,
            }),
            buttons,
            text: TextPiece { number: number & 1, index: index % 24, bytes: [letter & 0x41; PIECE] },
            state: number, run_id: 7, sequence: u64::from(index), sent_ns: 3, reason: letter, fault: index,
        };
        let from = if comes_back { role.peer() } else { role };
        let layout = session.map_or(frame.layout(), |(has_gripper, has_buttons, axes)| FrameLayout {
            axes, has_gripper, has_buttons, ..frame.layout()
        });
        let through = Frame::decode(frame.encode(&mut [0; MAX_FRAME]), from, layout);
        let without = frame.received(from, layout);
        // Compared as text, because NaN differs from itself.
        prop_assert_eq!(format!("{without:?}"), format!("{through:?}"));
        // The previous content of an overwritten frame does not matter.
        let plain = Frame { rotation: None, gripper: None, buttons: None, echo: None, ..frame };
        let full = Frame {
            rotation: Some(RotationState { orientation, angular_velocity: part(2), torque: part(1) }),
            gripper: Some(GripperState { position: Some(0.25), velocity: 3.0, force_n: 4.0, holds_object: true, follows: true }),
            role: role.peer(), kind: SideKind::Pose, state: !number, hears_peer: !hears_peer, clutch: !clutch,
            run_id: 8, sequence: 300, sent_ns: 4, echo: Some(Echo { run_id: 1, sequence: 2, sent_ns: 3, held_ns: 4 }),
            axes: 3, position: padded(&part(1)), velocity: padded(&part(2)), force: padded(&part(0)), energy: PortEnergy { in_j: 0.5, out_j: 0.25 },
            buttons: Some(5), ending: !ending, reason: !letter, fault: !index,
            text: TextPiece { number: !number, index: !index, bytes: [letter; PIECE] },
            coupling, message: drawn_message(coupling, !epoch, part(2)),
        };
        for mut before in [plain, full] {
            before.replace(&frame, 3);
            prop_assert_eq!(format!("{before:?}"), format!("{frame:?}"));
        }
    }

    #[test]
    fn noise_is_refused_without_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        prop_assert!(Frame::decode(&bytes, Role::Master, LAYOUT).is_err());
    }

    /// Random bodies with a valid header and checksum: every decoded value is in range, and the rest is
    /// rejected.
    #[test]
    fn well_sealed_garbage_is_refused_or_in_range(
        body in prop::collection::vec(any::<u8>(), 150 - 8 - 4),
        values in prop::array::uniform5(prop::num::f64::ANY),
    ) {
        let mut bytes = vec![b'H', b'T', VERSION, 2, 0x11];
        bytes.extend_from_slice(&[1, 3, 3]);
        bytes.extend_from_slice(&body);
        for (slot, value) in values.iter().enumerate() {
            bytes[64 + 8 * slot..72 + 8 * slot].copy_from_slice(&value.to_le_bytes());
        }
        let checksum = crc32fast::hash(&bytes);
        bytes.extend_from_slice(&checksum.to_le_bytes());
        match Frame::decode(&bytes, Role::Slave, LAYOUT) {
            Ok(frame) => {
                let bounds = [1e3, 1e3, 1e4, 1e9, 1e9];
                let PortEnergy { in_j, out_j } = frame.energy;
                let seen = [frame.position[0], frame.velocity[0], frame.force[0], in_j, out_j];
                prop_assert!(seen.iter().zip(bounds).all(|(x, most)| x.abs() <= most));
                prop_assert_eq!(seen, values);
            }
            Err(error) => prop_assert!(matches!(
                error,
                WireError::Value(..)
                    | WireError::Energy { .. }
                    | WireError::Text { .. }
                    | WireError::Message { .. }
            ), "{error}"),
        }
    }

    #[test]
    fn one_flipped_bit_is_refused(bit in 0usize..150 * 8) {
        let mut buffer = [0; MAX_FRAME];
        let mut bytes = frame().encode(&mut buffer).to_vec();
        bytes[bit / 8] ^= 1 << (bit % 8);
        prop_assert!(Frame::decode(&bytes, Role::Slave, LAYOUT).is_err());
    }
}

#[test]
fn a_peer_of_another_version_is_refused_by_its_version() {
    let ours = FrameLayout { kind: SideKind::Pose, has_gripper: true, ..FrameLayout::of(3) }.form();
    assert_eq!(ours.to_string(), "of kind pose, 3 axes and coupling position-force, with a gripper");
    let damped = FrameLayout { coupling: CouplingKind::PdDamped, ..FrameLayout::of(1) }.form();
    assert_eq!(damped.to_string(), "of kind linear, 1 axes and coupling pd-damped");
    // Before version 5 the number was the length of a frame.
    for (form, version) in
        [(124, "4 or before"), (ours.0 & 0x0FFF | 5 << 12, "5"), (ours.0 & 0x0FFF | 8 << 12, "8")]
    {
        let wanted =
            format!("of version {version}, must be of {VERSION}: install the same Haptether on both sides");
        assert_eq!(FrameForm(form).to_string(), wanted);
    }
    let mut bytes = [0; MAX_FRAME];
    let mut bytes = frame().encode(&mut bytes).to_vec();
    bytes[2] = 5;
    assert_eq!(Frame::decode(&bytes, Role::Slave, LAYOUT), Err(WireError::Version(5)));
}
