// SPDX-License-Identifier: MIT OR Apache-2.0
//! The fence between a store and a load of two words that two threads write and read the other way round.

/// Does what `fence(Ordering::SeqCst)` does. On x86-64 that is compiled to `mfence`, which takes about three times as long as a locked
/// instruction, and orders more than memory that is cached.
///
/// # Real-time
/// Wait-free; no syscall.
#[inline(always)]
pub fn full_fence() {
    #[cfg(all(target_arch = "x86_64", not(any(taut_loom, miri))))]
    // SAFETY: it changes no bit of the thread's own stack. A locked instruction is not reordered with any load or store of cached memory
    // (AMD64 manual 2, 7.4.2; Intel SDM 3, 9.2.2); and as the memory that this changes is not stated, the compiler moves none across it.
    unsafe {
        core::arch::asm!("lock or dword ptr [rsp], 0", options(nostack));
    }
    #[cfg(taut_loom)]
    loom::sync::atomic::fence(core::sync::atomic::Ordering::SeqCst);
    #[cfg(not(any(taut_loom, all(target_arch = "x86_64", not(miri)))))]
    core::sync::atomic::fence(core::sync::atomic::Ordering::SeqCst);
}
