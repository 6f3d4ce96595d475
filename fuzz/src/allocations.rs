// SPDX-License-Identifier: MIT OR Apache-2.0
//! How much memory a check takes.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

/// Remembers the largest allocation of this thread, and the most that was in use.
pub struct Counting;

thread_local! {
    static LARGEST: Cell<usize> = const { Cell::new(0) };
    static IN_USE: Cell<isize> = const { Cell::new(0) };
    static PEAK: Cell<isize> = const { Cell::new(0) };
}

// SAFETY: forwards to the system's allocator, unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.set(LARGEST.get().max(layout.size()));
        IN_USE.set(IN_USE.get().wrapping_add_unsigned(layout.size()));
        PEAK.set(PEAK.get().max(IN_USE.get()));
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        IN_USE.set(IN_USE.get().wrapping_sub_unsigned(layout.size()));
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// What a function may allocate, for `input` bytes: `multiple` times as many at once, and `fixed`, which no input
/// changes. In all, four times that: a vector that grows, old and new, and what its elements hold.
pub struct Limit {
    pub multiple: usize,
    pub fixed: usize,
}

impl Limit {
    pub const NONE: Self = Self { multiple: 0, fixed: 0 };

    /// Runs `run` and panics if it took more.
    #[track_caller]
    pub fn check<T>(&self, input: usize, run: impl FnOnce() -> T) -> T {
        LARGEST.set(0);
        IN_USE.set(0);
        PEAK.set(0);
        let result = run();
        let (largest, peak) = (LARGEST.get(), PEAK.get().unsigned_abs());
        let most = self.multiple * input + self.fixed;
        assert!(largest <= most, "{largest} bytes allocated at once for an input of {input}, at most {most}");
        assert!(peak <= 4 * most, "{peak} bytes allocated for an input of {input}, at most 4 times {most}");
        result
    }
}
