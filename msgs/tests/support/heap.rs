// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tests of several crates count what their threads ask of the heap.

use std::alloc::{GlobalAlloc, Layout, System};

/// The system's allocator, which tells a function of each call: the bytes that are allocated, `None` for a free.
pub struct Watched(pub fn(Option<usize>));

// SAFETY: every call is handed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Watched {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        (self.0)(Some(layout.size()));
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        (self.0)(None);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(block, layout) }
    }
    unsafe fn realloc(&self, block: *mut u8, layout: Layout, bytes: usize) -> *mut u8 {
        (self.0)(Some(bytes));
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(block, layout, bytes) }
    }
}
