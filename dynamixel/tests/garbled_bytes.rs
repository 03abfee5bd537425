//! A million garbled bytes: the parser does not allocate or panic, and recovers.
#![allow(clippy::unwrap_used, unsafe_code)] // permitted in a test; an allocator needs unsafe code

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
};

use haptether_dynamixel::{Received, StatusParser};

const BYTES: usize = 1_000_000;

thread_local! {
    /// Per thread: the harness allocates in another.
    static ALLOCATED: Cell<usize> = const { Cell::new(0) };
}

struct Counting;

// SAFETY: every call goes unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = ALLOCATED.try_with(|count| count.set(count.get() + layout.size()));
        // SAFETY: the caller's contract is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's contract is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// Source: G. Marsaglia, J. Statistical Software 8(14), 2003, xorshift64.
fn next(state: &mut u64) -> u64 {
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    *state
}

#[test]
fn a_million_garbled_bytes_take_no_memory() {
    // Source: ROBOTIS e-Manual, "Ping", the answer of id 1.
    let answer = [0xFF, 0xFF, 0xFD, 0x00, 0x01, 0x07, 0x00, 0x55, 0x00, 0x06, 0x04, 0x26, 0x65, 0x5D];
    let mut parser = StatusParser::default();
    let mut state = 0x2545_F491_4F6C_DD1D;
    let (mut fed, mut packets, mut refused) = (0, 0_u32, 0_u32);
    let mut piece = [0_u8; 64];
    let before = ALLOCATED.with(Cell::get);
    while fed < BYTES {
        let length = 1 + usize::try_from(next(&mut state) % 64).unwrap();
        for byte in &mut piece[..length] {
            *byte = next(&mut state).to_le_bytes()[3];
        }
        match next(&mut state) % 4 {
            // Header with a possibly wrong length.
            0 if length > 8 => piece[..5].copy_from_slice(&answer[..5]),
            // Packet with one wrong bit.
            1 if length > 14 => {
                piece[..14].copy_from_slice(&answer);
                piece[usize::try_from(next(&mut state) % 14).unwrap()] ^= 1 << (next(&mut state) % 8);
            }
            2 if length > 14 => piece[..14].copy_from_slice(&answer),
            _ => {}
        }
        fed += length;
        let mut input = &piece[..length];
        while let Some(found) = parser.next(&mut input) {
            if found.is_ok() {
                packets += 1;
            } else {
                refused += 1;
            }
        }
    }
    assert_eq!(ALLOCATED.with(Cell::get), before);
    assert!(packets > 100 && refused > 1000 && parser.dropped() > 100_000, "{packets} {refused}");
    parser.reset();
    let mut input = &answer[..];
    let Some(Ok(Received::Status(status))) = parser.next(&mut input) else { panic!("it was not parsed") };
    assert_eq!((status.id, status.parameters), (1, &answer[9..12]));
    // Check of the counter.
    drop(vec![0_u8; 100]);
    assert!(ALLOCATED.with(Cell::get) >= before + 100);
}
