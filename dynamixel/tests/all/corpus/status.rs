//! Fuzz target: every parsed answer occurs in the input, with its checksum.

use haptether_dynamixel::{Progress, Received, StatusParser, SyncRead, crc16};

fn packet(id: u8, error: u8, parameters: &[u8]) -> Vec<u8> {
    let mut body = Vec::new();
    for byte in [0x55, error].into_iter().chain(parameters.iter().copied()) {
        body.push(byte);
        if body.ends_with(&[0xFF, 0xFF, 0xFD]) {
            body.push(0xFD);
        }
    }
    let mut out = vec![0xFF, 0xFF, 0xFD, 0x00, id];
    out.extend(u16::try_from(body.len() + 2).unwrap_or(u16::MAX).to_le_bytes());
    out.extend(body);
    out.extend(crc16(&out).to_le_bytes());
    out
}

fn contains(bytes: &[u8], part: &[u8]) -> bool {
    bytes.windows(part.len()).any(|window| window == part)
}

/// Parse the input in pieces; the first byte sets their size.
pub(crate) fn check(bytes: &[u8]) {
    let Some((&size, bytes)) = bytes.split_first() else { return };
    let size = usize::from(size).max(1);
    let mut parser = StatusParser::default();
    for piece in bytes.chunks(size) {
        let mut rest = piece;
        while let Some(next) = parser.next(&mut rest) {
            if let Ok(Received::Status(status)) = next {
                let sent = packet(status.id, status.error.byte(), status.parameters);
                assert!(contains(bytes, &sent), "{status:?} was never sent");
            }
        }
        assert!(rest.is_empty());
    }
    assert!(parser.dropped() <= bytes.len() as u64);

    for fast in [true, false] {
        let Ok(mut read) = SyncRead::new(fast, 132, 2, &[1, 2]) else { unreachable!() };
        read.begin();
        let mut complete = false;
        for piece in bytes.chunks(size) {
            complete = read.receive(piece) == Ok(Progress::Complete);
        }
        let Some(replies) = read.replies() else {
            assert!(!complete);
            continue;
        };
        assert!(complete);
        for reply in replies {
            let error = u8::from(reply.alert) << 7;
            let sent = if fast {
                [&[error, reply.id], reply.data].concat()
            } else {
                packet(reply.id, error, reply.data)
            };
            assert!(contains(bytes, &sent), "{reply:?} was never sent");
        }
    }
}
