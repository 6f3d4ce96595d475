// SPDX-License-Identifier: MIT OR Apache-2.0
//! Claims memory before it is needed.

use std::hint::black_box;
use std::mem::MaybeUninit;
use std::ptr;

use rustix::mm::{Advice, MlockAllFlags, madvise, mlockall};
use rustix::process::{Resource, getrlimit};

use crate::RtError;
use crate::refusal::current_exe;
use crate::shm::page_bytes;

/// How memory is locked, now and for every later mapping.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum MemoryLock {
    /// A page stays once it has been touched (`MCL_ONFAULT`).
    ///
    /// The default, because the transport reserves sparse segments sized for the worst case: with
    /// [`MemoryLock::Resident`] all of their pages would be brought in. The cost: code that needs a page in
    /// bounded time must touch it during set-up, as [`prefault_stack`] does for stacks.
    #[default]
    OnFault,
    /// Every page of every mapping is brought in at once and stays.
    Resident,
}

/// Page faults of a thread since it started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PageFaults {
    /// Served from memory.
    pub minor: u64,
    /// Served from a disk.
    pub major: u64,
}

/// Keeps all memory of this process, present and future, from being paged out (`mlockall`).
///
/// # Errors
/// [`RtError::MemoryLock`] with the limit and the line that raises it.
pub fn lock_memory(lock: MemoryLock) -> Result<(), RtError> {
    let all = MlockAllFlags::CURRENT | MlockAllFlags::FUTURE;
    let flags = match lock {
        MemoryLock::OnFault => all | MlockAllFlags::ONFAULT,
        MemoryLock::Resident => all,
    };
    mlockall(flags).map_err(|errno| RtError::MemoryLock {
        limit: match getrlimit(Resource::Memlock).current {
            Some(bytes) => format!("{} KiB", bytes / 1024),
            None => "unlimited".to_owned(),
        },
        exe: current_exe(),
        source: errno.into(),
    })
}

/// Touches the next `bytes` of the current thread's stack, so that their later use causes no page fault. Returns how
/// many bytes were touched: fewer if the stack ends earlier, minus a margin of 4 pages (at least 16 KiB) that is not
/// touched.
pub fn prefault_stack(bytes: usize) -> usize {
    let here = (&raw const bytes).addr();
    let margin = (4 * page_bytes()).max(16 * 1024);
    let end = here.saturating_sub(bytes).max(stack_end(here).saturating_add(margin));
    if end < here && !populate(end, here) {
        touch(end);
    }
    here.saturating_sub(end)
}

/// Makes the allocator keep its memory: freed memory is not returned to the system, and large blocks come from the heap
/// instead of new mappings. So reused memory causes no page fault. Memory use stays at its highest level. Returns false
/// where the allocator has no such settings (other C libraries than glibc).
pub fn keep_freed_memory() -> bool {
    #[cfg(target_env = "gnu")]
    {
        set_malloc(&[(libc::M_TRIM_THRESHOLD, -1), (libc::M_MMAP_MAX, 0)])
    }
    #[cfg(not(target_env = "gnu"))]
    {
        false
    }
}

/// Like [`keep_freed_memory`], but all threads also share one arena, whose lock does not inherit priority: for processes
/// whose hot paths do not allocate.
pub fn tune_malloc() -> bool {
    #[cfg(target_env = "gnu")]
    {
        keep_freed_memory() && set_malloc(&[(libc::M_ARENA_MAX, 1)])
    }
    #[cfg(not(target_env = "gnu"))]
    {
        false
    }
}

#[cfg(target_env = "gnu")]
fn set_malloc(options: &[(libc::c_int, libc::c_int)]) -> bool {
    options.iter().all(
        // SAFETY: mallopt takes any two integers and locks the allocator while it applies them.
        |(option, value)| unsafe { libc::mallopt(*option, *value) == 1 },
    )
}

/// The page faults of the current thread since it started.
pub fn page_faults() -> PageFaults {
    let usage = thread_usage();
    PageFaults { minor: usage.ru_minflt.cast_unsigned(), major: usage.ru_majflt.cast_unsigned() }
}

/// Returns the kernel's counters of the current thread since its start; zeros if the call fails.
pub(crate) fn thread_usage() -> libc::rusage {
    let mut usage = MaybeUninit::<libc::rusage>::zeroed();
    // SAFETY: `usage` is writable for a whole rusage; all-zero bytes are a valid one, should the call fail.
    unsafe {
        libc::getrusage(libc::RUSAGE_THREAD, usage.as_mut_ptr());
        usage.assume_init()
    }
}

/// Has the kernel bring in all pages of the current thread's stack from `end` up to that of `here`, without a fault for
/// each. False where it cannot: before Linux 5.14, and below what the first thread's stack has grown to.
fn populate(end: usize, here: usize) -> bool {
    let page = page_bytes();
    let (from, to) = (end / page * page, here / page * page);
    // SAFETY: of the current thread's stack, below all frames that are in use; bringing pages in changes nothing that lies there.
    unsafe { madvise(ptr::with_exposed_provenance_mut(from), to - from, Advice::LinuxPopulateWrite) }.is_ok()
}

/// Descends until a frame lies below `end`: bounded by addresses, so it holds whatever a frame's size is.
#[inline(never)]
fn touch(end: usize) {
    // A step that is not longer than a page of any system.
    let mut step = [0u8; 4096];
    black_box(&mut step);
    if (&raw const step).addr() > end {
        touch(end);
    }
    // Used after the call, so that it cannot become a loop within one frame.
    black_box(&mut step);
}

/// The lowest address of the current thread's stack; `here` (nothing left) when unknown.
fn stack_end(here: usize) -> usize {
    let mut attr = MaybeUninit::<libc::pthread_attr_t>::uninit();
    let (mut lowest, mut size) = (ptr::null_mut(), 0);
    // SAFETY: on success pthread_getattr_np initialises `attr`, which is then read and destroyed exactly once.
    unsafe {
        if libc::pthread_getattr_np(libc::pthread_self(), attr.as_mut_ptr()) != 0 {
            return here;
        }
        let read = libc::pthread_attr_getstack(attr.as_ptr(), &raw mut lowest, &raw mut size);
        libc::pthread_attr_destroy(attr.as_mut_ptr());
        if read == 0 { lowest.addr() } else { here }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[inline(never)]
    fn use_stack() {
        let mut buffer = [0u8; 200 * 1024];
        black_box(&mut buffer);
    }

    #[test]
    fn a_touched_stack_faults_no_more() {
        let faults = |prefault: bool| {
            let body = move || {
                let touched = if prefault { prefault_stack(1 << 19) } else { 0 };
                let before = page_faults();
                use_stack();
                (touched, page_faults().minor - before.minor)
            };
            std::thread::Builder::new().stack_size(1 << 20).spawn(body).unwrap().join().unwrap()
        };
        let (touched, faults_after) = faults(true);
        assert_eq!((touched, faults_after), (1 << 19, 0));
        assert!(faults(false).1 > 0, "a fresh stack must fault, or the test proves nothing");
    }

    #[test]
    fn more_than_the_stack_is_cut_to_the_stack() {
        let touched = |bytes| {
            let body = move || prefault_stack(bytes);
            std::thread::Builder::new().stack_size(256 * 1024).spawn(body).unwrap().join().unwrap()
        };
        // No upper bound: the C library may hand out a larger stack that it has kept.
        assert!(touched(usize::MAX) >= 128 * 1024);
        assert_eq!(touched(0), 0);
    }
}
