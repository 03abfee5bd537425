//! Memory reserved for the end of a run, released when the system grants no more.
//!
//! Rust aborts a process whose allocation fails, whatever force is on. Here the first failed allocation
//! releases the reserve, and each loop ends in good order at its next tick.

#![allow(unsafe_code)] // an allocator, and a mapping that is never accessed
#![allow(clippy::cast_ptr_alignment)] // each block has the alignment it needs

use std::{
    alloc::{GlobalAlloc, Layout, System},
    ptr,
    sync::atomic::{AtomicPtr, Ordering},
};

use haptether_bridge::live::{end_for_lack_of_memory, is_exhausted, memory_is_back};

#[global_allocator]
static ALLOCATOR: Reserving = Reserving;

/// Bytes of one block. Below the 128 KiB that `malloc` maps separately, so that a freed block stays in the
/// process. Above the gaps between locked pages in use, so that the reserve is not locked.
const BLOCK: usize = 120 << 10;
/// 16 MiB in total, enough for the end of a run with its report.
const BLOCKS: usize = 136;
/// Retries of an allocation: another thread may be about to free the reserve.
const ATTEMPTS: usize = 64;
/// Bytes that must be mappable for a run to continue; Python allocates this much at a time.
const PROBE: usize = 1 << 21;

/// First reserved block; each block begins with the address of the next.
static RESERVE: AtomicPtr<u8> = AtomicPtr::new(ptr::null_mut());

fn block() -> Layout {
    // A compile-time layout: its alignment is always valid.
    const { Layout::new::<[u64; BLOCK / 8]>() }
}

/// The system's allocator with a reserve.
struct Reserving;

impl Reserving {
    fn tried(size: usize, mut allocate: impl FnMut() -> *mut u8) -> *mut u8 {
        let mut got = allocate();
        if size > BLOCK * BLOCKS {
            // The reserve is too small; callers of large allocations check the result themselves.
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

// SAFETY: each call is a call of the system's allocator with the same arguments; a failed one is repeated.
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

/// Fill the reserve if it is empty; return false if memory is already short.
pub(crate) fn fill() -> bool {
    if !RESERVE.load(Ordering::Acquire).is_null() {
        return true;
    }
    // Return memory freed while modules loaded; it would be locked with the rest.
    #[cfg(target_env = "gnu")]
    // SAFETY: it only returns free memory.
    unsafe {
        libc::malloc_trim(0);
    }
    let mut first: *mut u8 = ptr::null_mut();
    for _ in 0..BLOCKS {
        // SAFETY: the size is not zero, and the write is within the block.
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
    // Never freed: at the end of the heap the reserve would return to the system instead of to this process.
    // SAFETY: the size is not zero.
    let _ = unsafe { System.alloc(Layout::new::<[u64; 8]>()) };
    if RESERVE.compare_exchange(ptr::null_mut(), first, Ordering::AcqRel, Ordering::Acquire).is_err() {
        free(first);
    }
    memory_is_back();
    true
}

/// Out of memory: ends each loop and frees the reserve for that.
pub(crate) fn spend() {
    end_for_lack_of_memory();
    free(RESERVE.swap(ptr::null_mut(), Ordering::AcqRel));
}

fn free(mut first: *mut u8) {
    while !first.is_null() {
        // SAFETY: `fill` made the list, and nothing else refers to it.
        unsafe {
            let next = first.cast::<*mut u8>().read();
            System.dealloc(first, block());
            first = next;
        }
    }
}

/// Release the reserve if nothing more can be mapped, before code without error handling needs memory.
pub(crate) fn probe() {
    if is_exhausted() || RESERVE.load(Ordering::Acquire).is_null() {
        return;
    }
    // SAFETY: a new inaccessible mapping, removed at once.
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
