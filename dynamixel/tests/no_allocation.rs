//! Encoding, parsing and reads of several servos allocate nothing: counted by an allocator of our own.
#![allow(clippy::unwrap_used, unsafe_code)] // a test may; an allocator cannot be had without

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
};

use haptether_dynamixel::{Instruction, Packet, Progress, SyncRead};

thread_local! {
    /// Of this thread alone: the harness allocates in another.
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

fn allocations() -> u64 {
    ALLOCATIONS.with(Cell::get)
}

struct Counting;

// SAFETY: every call goes unchanged to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // A thread that is ending has no counter any more.
        let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
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

#[test]
fn a_cycle_allocates_nothing() {
    // Source: ROBOTIS e-Manual, "Fast Sync Read", example.
    let answer = [
        0xFF, 0xFF, 0xFD, 0x00, 0xFE, 0x19, 0x00, 0x55, 0x00, 0x03, 0xA6, 0x00, 0x00, 0x00, 0x84, 0x08, 0x00,
        0x07, 0x1F, 0x08, 0x00, 0x00, 0x16, 0xCA, 0x00, 0x04, 0xFF, 0x03, 0x00, 0x00, 0xD1, 0x9E,
    ];
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
    // The counter counts.
    drop(Box::new(read));
    assert!(allocations() > before);
}
