//! Encoding, parsing and reads of several servos do not allocate, as counted by a test allocator.
#![allow(clippy::unwrap_used)] // a test may

use std::{
    env, fs,
    io::{Read, Write},
    os::unix::net::UnixListener,
    process, thread,
};

use haptether_dynamixel::{Bus, Instruction, Packet, Progress, SharedBus, SyncRead};

#[path = "../../numeric/tests/allocations/mod.rs"]
mod allocations;

use allocations::allocations;

/// Source: ROBOTIS e-Manual, "Fast Sync Read", example.
const ANSWER: [u8; 32] = [
    0xFF, 0xFF, 0xFD, 0x00, 0xFE, 0x19, 0x00, 0x55, 0x00, 0x03, 0xA6, 0x00, 0x00, 0x00, 0x84, 0x08, 0x00,
    0x07, 0x1F, 0x08, 0x00, 0x00, 0x16, 0xCA, 0x00, 0x04, 0xFF, 0x03, 0x00, 0x00, 0xD1, 0x9E,
];

#[test]
fn a_cycle_allocates_nothing() {
    let answer = ANSWER;
    let mut broken = answer;
    broken[20] ^= 1;
    let ids = [3, 7, 4];
    let mut read = SyncRead::new(true, 132, 4, &ids).unwrap();
    let mut write = Packet::default();
    let before = allocations();
    for bytes in [&answer, &broken, &answer] {
        assert!(!read.begin().is_empty());
        assert_eq!(read.receive(&bytes[..10]), Ok(Progress::Waiting));
        let complete = read.receive(&bytes[10..]) == Ok(Progress::Complete);
        let sum: u32 = read.replies().into_iter().flatten().map(|one| u32::from(one.data[0])).sum();
        assert_eq!(sum, if complete { 0xA6 + 0x1F + 0xFF } else { 0 });
        write
            .encode(&Instruction::SyncWrite { address: 102, length: 2, ids: &ids, data: &[0xFF; 6] })
            .unwrap();
    }
    assert_eq!(allocations(), before);
    // Check of the counter.
    drop(std::hint::black_box(Box::new(read)));
    assert!(allocations() > before);
}

#[test]
fn a_cycle_of_a_shared_bus_allocates_nothing() {
    let path = env::temp_dir().join(format!("haptether-{}-cycle", process::id()));
    let listener = UnixListener::bind(&path).unwrap();
    let peer = thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut buffer = [0; 1024];
        loop {
            let count = stream.read(&mut buffer).unwrap();
            if count == 0 {
                return;
            }
            // Fast sync read of three servos.
            if buffer[..count].windows(4).any(|bytes| bytes == [0x0A, 0x00, 0x8A, 132]) {
                stream.write_all(&ANSWER).unwrap();
            }
        }
    });
    let bus = SharedBus::new(Bus::open(&path, 4_000_000, 200_000_000).unwrap());
    fs::remove_file(&path).unwrap();
    let ids = [3, 7, 4];
    let mut read = SyncRead::new(true, 132, 4, &ids).unwrap();
    let before = allocations();
    for _ in 0..3 {
        bus.call(|bus| bus.sync_read(&mut read)).unwrap();
        assert_eq!(read.replies().into_iter().flatten().count(), 3);
        bus.call(|bus| bus.sync_write(102, 2, &ids, &[0; 6])).unwrap();
    }
    bus.stop(64, 1, &ids, &[0; 3]).unwrap();
    assert_eq!(allocations(), before);
    bus.close();
    peer.join().unwrap();
}
