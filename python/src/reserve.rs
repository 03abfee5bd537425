//! Memory that is set aside for the end of a run, and spent where the system grants no more.
//!
//! Rust ends a process whose allocation fails, with whatever force is on. Here the first that fails frees the reserve
//! and has each loop end in good order at its next tick.

#![allow(unsafe_code)] // an allocator, and a mapping that nobody reads
#![allow(clippy::cast_ptr_alignment)] // a block is allocated with the alignment that it needs

use std::{
    alloc::{GlobalAlloc, Layout, System},
    ptr,
    sync::atomic::{AtomicPtr, Ordering},
};

use haptether_bridge::live::{end_for_lack_of_memory, is_exhausted, memory_is_back};

#[global_allocator]
static ALLOCATOR: Reserving = Reserving;

/// Bytes of one block: below the 128 KiB that `malloc` maps by itself, so that a block that is freed stays within the
/// process; above the gaps between used pages that are locked, so that the reserve is not.
const BLOCK: usize = 120 << 10;
/// 16 MiB: the end of a run, its report included.
const BLOCKS: usize = 136;
/// How often an allocation is tried anew: another thread may be about to free the reserve.
const ATTEMPTS: usize = 64;
/// Bytes that must be there to be mapped for a run to go on: what Python allocates at a time.
const PROBE: usize = 1 << 21;

/// First of the blocks that are set aside; each begins with the address of the next.
static RESERVE: AtomicPtr<u8> = AtomicPtr::new(ptr::null_mut());

fn block() -> Layout {
    // As checked by the compiler: a power of two.
    const { Layout::new::<[u64; BLOCK / 8]>() }
}

/// The system's allocator with a reserve.
struct Reserving;

impl Reserving {
    fn tried(size: usize, mut allocate: impl FnMut() -> *mut u8) -> *mut u8 {
        let mut got = allocate();
        if size > BLOCK * BLOCKS {
            // The reserve could not serve it: whoever allocates so much checks whether it is there.
            return got;
        }
        for _ in 0..ATTEMPTS {
            if !got.is_null() {
                break;
            }
            spend();
            got = allocate();
            if got.is_null() {
                std::thread::yield_now();
            }
        }
        got
    }
}

// SAFETY: each call is one of the system's allocator with the same arguments; one that failed is only repeated.
unsafe impl GlobalAlloc for Reserving {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        Self::tried(layout.size(), || unsafe { System.alloc(layout) })
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        Self::tried(layout.size(), || unsafe { System.alloc_zeroed(layout) })
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) };
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        Self::tried(size, || unsafe { System.realloc(pointer, layout, size) })
    }
}

/// Sets the reserve aside, unless it is; false where memory is short already.
pub(crate) fn fill() -> bool {
    if !RESERVE.load(Ordering::Acquire).is_null() {
        return true;
    }
    // Memory that modules have freed while they loaded goes back: it would be locked with the rest.
    #[cfg(target_env = "gnu")]
    // SAFETY: it only gives back what is free.
    unsafe {
        libc::malloc_trim(0);
    }
    let mut first: *mut u8 = ptr::null_mut();
    for _ in 0..BLOCKS {
        // SAFETY: not of size zero; what is written lies within.
        unsafe {
            let next = System.alloc(block());
            if next.is_null() {
                free(first);
                return false;
            }
            next.cast::<*mut u8>().write(first);
            first = next;
        }
    }
    // Kept for ever: at the end of the heap the reserve would go back to the system instead of to this process.
    // SAFETY: not of size zero.
    let _ = unsafe { System.alloc(Layout::new::<[u64; 8]>()) };
    if RESERVE.compare_exchange(ptr::null_mut(), first, Ordering::AcqRel, Ordering::Acquire).is_err() {
        free(first);
    }
    memory_is_back();
    true
}

/// No memory is left: each loop ends, and what was set aside is there for that.
pub(crate) fn spend() {
    end_for_lack_of_memory();
    free(RESERVE.swap(ptr::null_mut(), Ordering::AcqRel));
}

fn free(mut first: *mut u8) {
    while !first.is_null() {
        // SAFETY: as `fill` made it, and nobody else has it.
        unsafe {
            let next = first.cast::<*mut u8>().read();
            System.dealloc(first, block());
            first = next;
        }
    }
}

/// Spends the reserve where nothing more can be mapped, before somebody needs it who cannot handle that.
pub(crate) fn probe() {
    if is_exhausted() || RESERVE.load(Ordering::Acquire).is_null() {
        return;
    }
    // SAFETY: a mapping of its own that nobody may read, gone at once.
    unsafe {
        let (access, kind) = (libc::PROT_NONE, libc::MAP_PRIVATE | libc::MAP_ANONYMOUS | libc::MAP_NORESERVE);
        let mapped = libc::mmap(ptr::null_mut(), PROBE, access, kind, -1, 0);
        if mapped == libc::MAP_FAILED {
            spend();
        } else {
            libc::munmap(mapped, PROBE);
        }
    }
}
