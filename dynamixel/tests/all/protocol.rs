//! Packets byte for byte: those of the e-manual, and those of an independent encoder.
#![allow(clippy::unwrap_used)]

use haptether_dynamixel::{
    BROADCAST, BulkItem, FrameError, Instruction, MAX_ID, Packet, Progress, Received, Refusal, RequestError,
    StatusError, StatusParser, SyncRead, SyncReadError, crc16,
};
use proptest::{collection::vec, prelude::*};

fn slow_crc(bytes: &[u8]) -> u16 {
    let mut crc = 0_u16;
    for &byte in bytes {
        crc ^= u16::from(byte) << 8;
        for _ in 0..8 {
            crc = if crc & 0x8000 == 0 { crc << 1 } else { (crc << 1) ^ 0x8005 };
        }
    }
    crc
}

fn stuffed(bytes: &[u8]) -> Vec<u8> {
    let mut out: Vec<u8> = Vec::new();
    for &byte in bytes {
        out.push(byte);
        if out.ends_with(&[0xFF, 0xFF, 0xFD]) {
            out.push(0xFD);
        }
    }
    out
}

fn framed(id: u8, body: &[u8]) -> Vec<u8> {
    let mut out = vec![0xFF, 0xFF, 0xFD, 0x00, id];
    out.extend(u16::try_from(body.len() + 2).unwrap().to_le_bytes());
    out.extend(body);
    out.extend(slow_crc(&out).to_le_bytes());
    out
}

fn status(id: u8, error: u8, parameters: &[u8]) -> Vec<u8> {
    framed(id, &stuffed(&[&[0x55, error], parameters].concat()))
}

/// Fast reply; each part ends with the checksum of everything before it.
fn fast(parts: &[(u8, u8, &[u8])]) -> Vec<u8> {
    let body: usize = parts.iter().map(|(_, _, data)| data.len() + 4).sum();
    let mut out = vec![0xFF, 0xFF, 0xFD, 0x00, 0xFE];
    out.extend(u16::try_from(body + 1).unwrap().to_le_bytes());
    out.push(0x55);
    for &(id, error, data) in parts {
        out.extend([error, id]);
        out.extend(data);
        out.extend(slow_crc(&out).to_le_bytes());
    }
    out
}

fn hex(text: &str) -> Vec<u8> {
    text.split_whitespace().map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect()
}

#[derive(Debug, PartialEq)]
enum Got {
    Status(u8, u8, Vec<u8>),
    Fast,
    Refused(FrameError),
}

fn received(parser: &mut StatusParser, pieces: &[&[u8]]) -> Vec<Got> {
    let mut out = Vec::new();
    for piece in pieces {
        let mut rest = *piece;
        while let Some(next) = parser.next(&mut rest) {
            out.push(match next {
                Ok(Received::Status(one)) => Got::Status(one.id, one.error.byte(), one.parameters.to_vec()),
                Ok(Received::Fast(_)) => Got::Fast,
                Err(error) => Got::Refused(error),
            });
        }
        assert!(rest.is_empty());
    }
    out
}

/// Source: ROBOTIS e-Manual, Protocol 2.0, the examples of the instructions.
#[test]
fn packets_are_those_of_the_manual() {
    let cases: [(Instruction<'_>, &str); 10] = [
        (Instruction::Ping { id: 1 }, "FF FF FD 00 01 03 00 01 19 4E"),
        (Instruction::Ping { id: BROADCAST }, "FF FF FD 00 FE 03 00 01 31 42"),
        (Instruction::Read { id: 1, address: 132, length: 4 }, "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
        (
            Instruction::Write { id: 1, address: 116, data: &512_u32.to_le_bytes() },
            "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89",
        ),
        (Instruction::Action { id: 1 }, "FF FF FD 00 01 03 00 05 02 CE"),
        (Instruction::Reboot { id: 1 }, "FF FF FD 00 01 03 00 08 2F 4E"),
        (
            Instruction::SyncRead { address: 132, length: 4, ids: &[1, 2] },
            "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
        ),
        (
            Instruction::FastSyncRead { address: 132, length: 4, ids: &[3, 7, 4] },
            "FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2",
        ),
        (
            Instruction::SyncWrite {
                address: 116,
                length: 4,
                ids: &[1, 2],
                data: &[0x96, 0, 0, 0, 0xAA, 0, 0, 0],
            },
            "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
        ),
        (
            Instruction::BulkRead {
                items: &[
                    BulkItem { id: 1, address: 144, length: 2 },
                    BulkItem { id: 2, address: 146, length: 1 },
                ],
            },
            "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
        ),
    ];
    let mut packet = Packet::default();
    for (instruction, bytes) in cases {
        packet.encode(&instruction).unwrap();
        assert_eq!(packet.bytes(), hex(bytes), "{instruction:?}");
    }
}

#[test]
fn the_checksum_has_its_known_answers() {
    assert_eq!(crc16(b"123456789"), 0xFEE8);
    assert_eq!(crc16(&[]), 0);
    assert_eq!(crc16(&hex("FF FF FD 00 01 03 00 01")), 0x4E19);
}

#[test]
fn answers_are_those_of_the_manual() {
    let mut parser = StatusParser::default();
    let ping = hex("FF FF FD 00 01 07 00 55 00 06 04 26 65 5D");
    assert_eq!(received(&mut parser, &[&ping]), [Got::Status(1, 0, vec![0x06, 0x04, 0x26])]);
    let voltage = hex("FF FF FD 00 01 06 00 55 00 77 00 C3 69");
    let temperature = hex("FF FF FD 00 02 05 00 55 00 24 8B A9");
    assert_eq!(
        received(&mut parser, &[&voltage, &temperature]),
        [Got::Status(1, 0, vec![0x77, 0]), Got::Status(2, 0, vec![0x24])]
    );
}

#[test]
fn the_fast_reply_of_the_manual_is_read() {
    let mut read = SyncRead::new(true, 132, 4, &[3, 7, 4]).unwrap();
    read.begin();
    let reply = hex("FF FF FD 00 FE 19 00 55 00 03 A6 00 00 00 84 08 \
                     00 07 1F 08 00 00 16 CA 00 04 FF 03 00 00 D1 9E");
    assert_eq!(read.receive(&reply), Ok(Progress::Complete));
    let positions: Vec<_> = read
        .replies()
        .unwrap()
        .map(|one| (one.id, one.alert, u32::from_le_bytes(one.data.try_into().unwrap())))
        .collect();
    assert_eq!(positions, [(3, false, 166), (7, false, 2079), (4, false, 1023)]);
}

#[test]
fn a_header_inside_is_stuffed() {
    let mut packet = Packet::default();
    packet.encode(&Instruction::Write { id: 1, address: 116, data: &[0xFF, 0xFF, 0xFD, 0x00] }).unwrap();
    assert_eq!(packet.bytes()[7..15], hex("03 74 00 FF FF FD FD 00"));
    assert_eq!(packet.bytes()[5..7], [10, 0]);
    // At the end of the packet, and before another FD.
    packet.encode(&Instruction::Write { id: 1, address: 116, data: &[0xFF, 0xFF, 0xFD] }).unwrap();
    assert_eq!(packet.bytes()[10..14], hex("FF FF FD FD"));
    packet.encode(&Instruction::Write { id: 1, address: 116, data: &[0xFF, 0xFF, 0xFD, 0xFD] }).unwrap();
    assert_eq!(packet.bytes()[10..15], hex("FF FF FD FD FD"));
    // Addresses are stuffed too.
    packet.encode(&Instruction::Read { id: 1, address: 0xFFFF, length: 1 }).unwrap();
    assert_eq!(packet.bytes()[8..12], hex("FF FF 01 00"));
}

#[test]
fn unencodable_instructions_are_refused() {
    let cases: [(Instruction<'_>, &str); 11] = [
        (Instruction::Ping { id: 253 }, "id 253: must be 0 to 252"),
        (Instruction::Read { id: BROADCAST, address: 0, length: 1 }, "id 254: must be 0 to 252"),
        (Instruction::Read { id: 1, address: 0, length: 0 }, "length 0: must be at least one byte"),
        (Instruction::Write { id: 1, address: 0, data: &[] }, "length 0: must be at least one byte"),
        (
            Instruction::Read { id: 1, address: 65535, length: 2 },
            "2 bytes from address 65535: must end at 65535",
        ),
        (Instruction::SyncRead { address: 0, length: 1, ids: &[] }, "no servo is named"),
        (Instruction::SyncRead { address: 0, length: 1, ids: &[1, 2, 1] }, "id 1 is named twice"),
        (Instruction::FastSyncRead { address: 0, length: 1, ids: &[255] }, "id 255: must be"),
        (
            Instruction::SyncWrite { address: 0, length: 2, ids: &[1, 2], data: &[0; 3] },
            "3 bytes for the servos of a sync write: must be 4",
        ),
        (Instruction::BulkRead { items: &[] }, "no servo is named"),
        (Instruction::Write { id: 1, address: 0, data: &[0; 1024] }, "must be at most 1024"),
    ];
    let mut packet = Packet::default();
    for (instruction, said) in cases {
        let error = packet.encode(&instruction).unwrap_err();
        assert!(error.to_string().contains(said), "{error}");
        assert!(packet.bytes().is_empty());
    }
    assert!(matches!(SyncRead::new(true, 0, 200, &[1, 2, 3, 4, 5, 6]), Err(RequestError::TooLong { .. })));
}

#[test]
fn error_bytes_have_names() {
    let cases = [
        (0, None, false, "no error"),
        (0x80, None, true, "hardware error (see address 70)"),
        (4, Some(Refusal::DataRange), false, "data range error (4)"),
        (0x87, Some(Refusal::Access), true, "access error (7), and hardware error (see address 70)"),
        (0x48, Some(Refusal::Unknown(0x48)), false, "unknown error (72)"),
    ];
    for (byte, refusal, alert, said) in cases {
        let error = StatusError::new(byte);
        assert_eq!((error.refusal(), error.alert(), error.to_string().as_str()), (refusal, alert, said));
    }
}

#[test]
fn impossible_lengths_and_codes_are_garbage() {
    let mut parser = StatusParser::default();
    let good = status(5, 0, &[1]);
    for bad in
        ["FF FF FD 00 01 03 00 55", "FF FF FD 00 01 FF FF 55", "FF FF FD 00 01 04 00 01", "FF FF FD 00 FD"]
    {
        let bytes = [hex(bad), good.clone()].concat();
        assert_eq!(received(&mut parser, &[&bytes]), [Got::Status(5, 0, vec![1])], "{bad}");
    }
    assert!(parser.dropped() > 0);
}

#[test]
fn a_packet_inside_a_broken_one_is_found() {
    let mut parser = StatusParser::default();
    let mut broken = status(1, 0, &[1, 2, 3, 4]);
    broken.truncate(9);
    let bytes = [broken, status(2, 0, &[7, 8]), status(3, 0, &[9])].concat();
    let got = received(&mut parser, &[&bytes]);
    assert!(matches!(got[0], Got::Refused(FrameError::Crc { id: 1, .. })));
    assert_eq!(got[1..], [Got::Status(2, 0, vec![7, 8]), Got::Status(3, 0, vec![9])]);
}

#[test]
fn missing_stuffing_is_refused_though_the_checksum_is_right() {
    let bytes = framed(1, &[0x55, 0, 0xFF, 0xFF, 0xFD, 0x01]);
    let got = received(&mut StatusParser::default(), &[&bytes]);
    assert_eq!(got, [Got::Refused(FrameError::Stuffing { id: 1 })]);
}

#[test]
fn a_read_gives_all_or_nothing() {
    let ids = [1, 2, 3];
    let parts: Vec<(u8, u8, &[u8])> = vec![(1, 0, &[1, 0]), (2, 0x80, &[2, 0]), (3, 0, &[3, 0])];
    let separate = |parts: &[(u8, u8, &[u8])]| -> Vec<u8> {
        parts.iter().flat_map(|&(id, error, data)| status(id, error, data)).collect()
    };
    for is_fast in [true, false] {
        let mut read = SyncRead::new(is_fast, 132, 2, &ids).unwrap();
        let reply = |parts: &[(u8, u8, &[u8])]| if is_fast { fast(parts) } else { separate(parts) };
        read.begin();
        assert!(read.replies().is_none());
        assert_eq!(read.receive(&reply(&parts)), Ok(Progress::Complete));
        let alerts: Vec<_> = read.replies().unwrap().map(|one| (one.id, one.alert, one.data[0])).collect();
        assert_eq!(alerts, [(1, false, 1), (2, true, 2), (3, false, 3)]);

        // The next read discards these values, even after a part of its answer.
        read.begin();
        assert!(read.replies().is_none());
        assert_eq!(read.unanswered(), ids);
        let whole = reply(&parts);
        assert_eq!(read.receive(&whole[..whole.len() - 1]), Ok(Progress::Waiting));
        assert!(read.replies().is_none());
        assert_eq!(read.unanswered(), if is_fast { &ids[..] } else { &ids[2..] });

        // One silent servo leaves no values.
        read.begin();
        let silent = &whole[..if is_fast { 24 } else { 26 }];
        assert_eq!(read.receive(silent), Ok(Progress::Waiting));
        assert!(read.replies().is_none());

        // A refusal or a wrong servo is an error until the next read begins.
        let bad: [&[(u8, u8, &[u8])]; 4] = [
            &[(1, 0, &[1, 0]), (2, 7, &[2, 0]), (3, 0, &[3, 0])],
            &[(1, 0, &[1, 0]), (3, 0, &[2, 0]), (2, 0, &[3, 0])],
            &[(1, 0, &[1, 0]), (2, 0, &[2, 0, 0]), (3, 0, &[3, 0])],
            &[(1, 0, &[1, 0]), (2, 0, &[2]), (3, 0, &[3, 0, 0])],
        ];
        for parts in bad {
            read.begin();
            let error = read.receive(&reply(parts)).unwrap_err();
            assert!(read.replies().is_none());
            assert_eq!(read.receive(&whole), Err(error));
            assert!(read.replies().is_none());
        }
    }
}

#[test]
fn the_other_kind_of_answer_is_refused() {
    let mut read = SyncRead::new(true, 132, 1, &[1]).unwrap();
    read.begin();
    let error = read.receive(&status(1, 0, &[5])).unwrap_err();
    assert_eq!(error, SyncReadError::Kind { fast: false });
    assert_eq!(error.to_string(), "a packet of one servo answered: must be a packet of several servos");
    let mut read = SyncRead::new(false, 132, 1, &[1]).unwrap();
    read.begin();
    assert_eq!(read.receive(&fast(&[(1, 0, &[5])])), Err(SyncReadError::Kind { fast: true }));
}

/// Bytes with frequent header and stuffing values.
fn payload(max: usize) -> impl Strategy<Value = Vec<u8>> {
    vec(prop_oneof![Just(0xFF), Just(0xFD), Just(0x00), any::<u8>()], 0..max)
}

fn pieces<'a>(mut bytes: &'a [u8], sizes: &[usize]) -> Vec<&'a [u8]> {
    let mut out = Vec::new();
    for &size in sizes.iter().cycle() {
        if bytes.is_empty() {
            break;
        }
        let (piece, rest) = bytes.split_at(size.clamp(1, bytes.len()));
        out.push(piece);
        bytes = rest;
    }
    out
}

proptest! {
    #[test]
    fn the_checksum_is_that_of_its_definition(bytes in vec(any::<u8>(), 0..300)) {
        prop_assert_eq!(crc16(&bytes), slow_crc(&bytes));
    }

    #[test]
    fn a_write_is_what_another_encoder_makes(
        id in 0..=MAX_ID, address in any::<u16>(), data in payload(80).prop_filter("some", |data| !data.is_empty()),
    ) {
        prop_assume!(usize::from(address) + data.len() <= 65536);
        let mut packet = Packet::default();
        packet.encode(&Instruction::Write { id, address, data: &data }).unwrap();
        let body = [&[0x03][..], &address.to_le_bytes(), &data].concat();
        prop_assert_eq!(packet.bytes(), framed(id, &stuffed(&body)));
    }

    #[test]
    fn any_answer_in_any_pieces_is_read(
        answers in vec((0..=MAX_ID, any::<u8>(), payload(60)), 1..5), sizes in vec(1_usize..40, 1..6),
    ) {
        let bytes: Vec<u8> = answers.iter().flat_map(|(id, error, data)| status(*id, *error, data)).collect();
        let got = received(&mut StatusParser::default(), &pieces(&bytes, &sizes));
        let expected: Vec<_> =
            answers.into_iter().map(|(id, error, data)| Got::Status(id, error, data)).collect();
        prop_assert_eq!(got, expected);
    }

    #[test]
    fn after_garbage_without_a_header_the_packet_is_found(
        garbage in payload(60), data in payload(20), sizes in vec(1_usize..9, 1..6),
    ) {
        // Garbage with a header would make the parser wait for its end.
        prop_assume!(!garbage.windows(3).any(|three| three == [0xFF, 0xFF, 0xFD]));
        let good = status(9, 0, &data);
        let joined = [&garbage[..], &good].concat();
        prop_assume!(joined.windows(4).filter(|four| *four == [0xFF, 0xFF, 0xFD, 0x00]).count() == 1);
        let got = received(&mut StatusParser::default(), &pieces(&joined, &sizes));
        prop_assert_eq!(got, [Got::Status(9, 0, data)]);
    }

    #[test]
    fn garbage_never_gives_a_packet_with_a_wrong_checksum(
        bytes in vec(prop_oneof![
            6 => payload(12),
            1 => Just(vec![0xFF, 0xFF, 0xFD, 0x00, 0x01, 0x05, 0x00, 0x55]),
            1 => Just(status(3, 0, &[1, 2])),
        ], 0..20),
        sizes in vec(1_usize..50, 1..4),
    ) {
        let bytes = bytes.concat();
        for got in received(&mut StatusParser::default(), &pieces(&bytes, &sizes)) {
            if let Got::Status(id, error, data) = got {
                let packet = status(id, error, &data);
                prop_assert!(bytes.windows(packet.len()).any(|window| window == packet));
            }
        }
    }

    #[test]
    fn a_fast_reply_is_read_in_any_pieces(
        length in 1_usize..12, seeds in vec((0..=MAX_ID, any::<bool>(), payload(12)), 1..8), sizes in vec(1_usize..30, 1..5),
    ) {
        let mut parts: Vec<(u8, u8, Vec<u8>)> = Vec::new();
        for (id, alert, mut data) in seeds {
            if parts.iter().all(|part| part.0 != id) {
                data.resize(length, 0xFF);
                parts.push((id, u8::from(alert) << 7, data));
            }
        }
        let ids: Vec<u8> = parts.iter().map(|part| part.0).collect();
        let slices: Vec<(u8, u8, &[u8])> = parts.iter().map(|(id, error, data)| (*id, *error, &data[..])).collect();
        let mut read = SyncRead::new(true, 126, u16::try_from(length).unwrap(), &ids).unwrap();
        read.begin();
        let mut progress = Progress::Waiting;
        for piece in pieces(&fast(&slices), &sizes) {
            progress = read.receive(piece).unwrap();
        }
        prop_assert_eq!(progress, Progress::Complete);
        let got: Vec<_> = read.replies().unwrap().map(|one| (one.id, u8::from(one.alert) << 7, one.data.to_vec())).collect();
        prop_assert_eq!(got, parts);
    }

    #[test]
    fn a_fast_reply_with_any_one_byte_changed_gives_nothing(
        at in any::<prop::sample::Index>(), change in 1_u8..=255, is_fast in any::<bool>(),
    ) {
        let parts: [(u8, u8, &[u8]); 3] = [(1, 0, &[1, 2]), (2, 0, &[3, 4]), (3, 0, &[5, 6])];
        let mut bytes = if is_fast {
            fast(&parts)
        } else {
            parts.iter().flat_map(|&(id, error, data)| status(id, error, data)).collect()
        };
        let index = at.index(bytes.len());
        bytes[index] ^= change;
        let mut read = SyncRead::new(is_fast, 132, 2, &[1, 2, 3]).unwrap();
        read.begin();
        prop_assert_ne!(read.receive(&bytes), Ok(Progress::Complete));
        prop_assert!(read.replies().is_none());
    }

    #[test]
    fn a_fast_reply_whose_servos_are_not_those_asked_gives_nothing(drop in 0_usize..3, swap in any::<bool>()) {
        let mut parts: Vec<(u8, u8, &[u8])> = vec![(1, 0, &[1, 2]), (2, 0, &[3, 4]), (3, 0, &[5, 6])];
        if swap {
            parts.swap(drop, (drop + 1) % 3);
        } else {
            parts.remove(drop);
        }
        let mut read = SyncRead::new(true, 132, 2, &[1, 2, 3]).unwrap();
        read.begin();
        let error = read.receive(&fast(&parts)).unwrap_err();
        let named = matches!(
            error,
            SyncReadError::Frame(FrameError::FastId { .. } | FrameError::FastLength { .. })
        );
        prop_assert!(named, "{}", error);
        prop_assert!(read.replies().is_none());
    }
}
