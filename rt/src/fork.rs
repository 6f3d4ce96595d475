// SPDX-License-Identifier: MIT OR Apache-2.0
//! The resources that a forked child does not keep of its parent: locks, pipes and shared memory.
//!
//! A lock of `flock` belongs to the open file, which descriptors and mappings of a child keep open. So a child would keep its parent's
//! files locked when that has died, and write into them. Therefore in a child, before `fork` returns there,
//!
//! - each [`ProcessFd`] is `/dev/null`, so that its owner may close it as ever;
//! - each shared mapping ([`Mapping`](crate::shm::Mapping)) is zeros of the child's own;
//! - each [`ProcessMutex`] is free and has its first value, whichever thread of the parent held it;
//! - a [`ProcessMark`] made before the fork belongs to another process.
//!
//! `vfork` and `posix_spawn` are not concerned: their children only `exec`, which closes all of it.

use crate::{PiGuard, PiMutex};
use std::cell::UnsafeCell;
use std::collections::{BTreeMap, BTreeSet};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{LazyLock, Mutex, MutexGuard, Once, PoisonError, TryLockError};

/// The resources that this process does not share with its children.
struct List {
    /// `/dev/null`, which replaces the descriptors in a child.
    null: Option<OwnedFd>,
    files: BTreeSet<RawFd>,
    /// The length of each mapping, by its address.
    mappings: BTreeMap<usize, usize>,
    mutexes: Vec<&'static (dyn Renew + Sync)>,
}

/// Locked by threads of all priorities: the last owner of a mapping may be a callback's thread.
static LIST: LazyLock<PiMutex<List>> = LazyLock::new(|| {
    let (files, mappings) = (BTreeSet::new(), BTreeMap::new());
    PiMutex::new(List { null: None, files, mappings, mutexes: Vec::new() })
});
/// The number of forks that led to this process.
static FORKS: AtomicU32 = AtomicU32::new(0);

/// Held while the process forks, and in [`without_forks`].
static FORKING: Mutex<()> = Mutex::new(());

/// The locks while the process forks.
struct Held(UnsafeCell<Option<(MutexGuard<'static, ()>, PiGuard<'static, List>)>>);

// SAFETY: accessed only by the thread that holds the lock of `LIST`, or has just got it.
unsafe impl Sync for Held {}

static HELD: Held = Held(UnsafeCell::new(None));

fn list() -> PiGuard<'static, List> {
    static REGISTERED: Once = Once::new();
    REGISTERED.call_once(|| {
        // Created before a handler uses it.
        LazyLock::force(&LIST);
        // SAFETY: these may be called at any time, and do not unwind. Should there be no memory for them, a child keeps what it inherits.
        unsafe { libc::pthread_atfork(Some(before), Some(in_parent), Some(in_child)) };
    });
    LIST.lock()
}

unsafe extern "C" fn before() {
    let forking = FORKING.lock().unwrap_or_else(PoisonError::into_inner);
    let list = LIST.lock();
    // SAFETY: this thread has the lock.
    unsafe { *HELD.0.get() = Some((forking, list)) };
}

unsafe extern "C" fn in_parent() {
    // SAFETY: this thread has the lock, and releases it here.
    drop(unsafe { (*HELD.0.get()).take() });
}

/// Does only what a signal handler may do: other threads of the parent may have been anywhere.
unsafe extern "C" fn in_child() {
    FORKS.fetch_add(1, Ordering::Relaxed);
    // SAFETY: the child's only thread is the one that took the lock.
    let Some((forking, list)) = (unsafe { (*HELD.0.get()).take() }) else { return };
    drop(forking);
    if let Some(null) = &list.null {
        for file in &list.files {
            // SAFETY: replaces what a ProcessFd owns by something else that it then owns.
            unsafe { libc::dup3(null.as_raw_fd(), *file, libc::O_CLOEXEC) };
        }
    }
    for (address, len) in &list.mappings {
        let flags = libc::MAP_PRIVATE | libc::MAP_ANONYMOUS | libc::MAP_FIXED | libc::MAP_NORESERVE;
        let at = std::ptr::without_provenance_mut(*address);
        // SAFETY: over a mapping whose content may change at any time anyway, to zeros now.
        unsafe { libc::mmap(at, *len, libc::PROT_READ | libc::PROT_WRITE, flags, -1, 0) };
    }
    for mutex in &list.mutexes {
        // SAFETY: this is the child's only thread.
        unsafe { mutex.renew() };
    }
    // SAFETY: the child's only thread has the lock, and there is no other guard.
    unsafe { PiGuard::unlock_in_child(list) };
}

trait Renew {
    /// # Safety
    /// This is the only thread of a child that was just forked, and it holds no guard.
    unsafe fn renew(&self);
}

/// A mutex for a static. In a forked child it is free and has its first value again: another thread of the parent may have held it, and
/// may have changed half of the value. A panic does not poison it.
///
/// A thread that holds it must not fork, unless the child only calls `exec`.
#[derive(Debug)]
pub struct ProcessMutex<T: 'static> {
    mutex: UnsafeCell<Mutex<T>>,
    first: fn() -> T,
    is_listed: AtomicBool,
}

// SAFETY: shared access goes through the mutex, which is replaced only while the process has one thread.
unsafe impl<T: Send> Sync for ProcessMutex<T> {}

impl<T: Send> ProcessMutex<T> {
    /// A mutex of `value`. `first` returns the same value for a child, where it may neither allocate nor take a lock.
    pub const fn new(value: T, first: fn() -> T) -> ProcessMutex<T> {
        ProcessMutex { mutex: UnsafeCell::new(Mutex::new(value)), first, is_listed: AtomicBool::new(false) }
    }

    /// Locks it; waits until no other thread holds it.
    ///
    /// # Real-time
    /// Setup only: the holder does not inherit the priority of who waits. The first call allocates.
    pub fn lock(&'static self) -> MutexGuard<'static, T> {
        if !self.is_listed.load(Ordering::Acquire) {
            let mut list = list();
            // Listed before it can be held while another thread forks, which waits for the list.
            if !self.is_listed.swap(true, Ordering::Release) {
                list.mutexes.push(self);
            }
        }
        self.mutex().lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Locks it if no thread holds it.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. `None` also before the first [`lock`](Self::lock).
    pub fn try_lock(&'static self) -> Option<MutexGuard<'static, T>> {
        if !self.is_listed.load(Ordering::Acquire) {
            return None;
        }
        match self.mutex().try_lock() {
            Ok(guard) => Some(guard),
            Err(TryLockError::Poisoned(poisoned)) => Some(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => None,
        }
    }

    fn mutex(&'static self) -> &'static Mutex<T> {
        // SAFETY: it is written only by `renew`, when no other thread is there.
        unsafe { &*self.mutex.get() }
    }
}

impl<T: Send> Renew for ProcessMutex<T> {
    unsafe fn renew(&self) {
        // SAFETY: no other thread is there, and no guard. What it protected is not dropped: it may be half changed.
        unsafe { self.mutex.get().write(Mutex::new((self.first)())) };
    }
}

/// Runs `body` while no other thread forks. For code that takes locks of other libraries: a child would find them locked forever. A thread
/// that forks waits for it; `body` itself must not fork.
///
/// # Real-time
/// Not for real-time threads: waits for a fork, and for other threads that are in here.
pub fn without_forks<R>(body: impl FnOnce() -> R) -> R {
    drop(list());
    let _forking = FORKING.lock().unwrap_or_else(PoisonError::into_inner);
    body()
}

/// A descriptor of this process alone.
#[derive(Debug)]
pub struct ProcessFd(Option<OwnedFd>);

impl ProcessFd {
    /// The descriptor that `make` opens, and perhaps locks. No fork comes between that and the entry here: `make` must not wait, and
    /// must make no other `ProcessFd` or mapping.
    ///
    /// # Errors
    /// Those of `make`.
    pub fn make<E>(make: impl FnOnce() -> Result<OwnedFd, E>) -> Result<ProcessFd, E> {
        let mut list = list();
        if list.null.is_none() {
            list.null = std::fs::File::open("/dev/null").ok().map(OwnedFd::from);
        }
        let file = make()?;
        list.files.insert(file.as_raw_fd());
        Ok(ProcessFd(Some(file)))
    }
}

impl AsFd for ProcessFd {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_ref().expect("taken only by drop").as_fd()
    }
}

impl Drop for ProcessFd {
    fn drop(&mut self) {
        let mut list = list();
        if let Some(file) = self.0.take() {
            list.files.remove(&file.as_raw_fd());
            // Closed after the entry was removed: from then on the number may be another file's.
            drop(file);
            if list.files.is_empty() {
                // Nothing stays open once a process has left its last domain.
                list.null = None;
            }
        }
    }
}

/// Maps shared memory by `map`, which returns the address of `len_bytes`: a child has zeros there.
///
/// # Errors
/// Those of `map`.
pub fn map_shared<E>(
    len_bytes: usize,
    map: impl FnOnce() -> Result<*mut std::ffi::c_void, E>,
) -> Result<*mut std::ffi::c_void, E> {
    let mut list = list();
    let address = map()?;
    list.mappings.insert(address.addr(), len_bytes);
    Ok(address)
}

/// Undoes [`map_shared`] by `unmap`; nothing if the memory was not mapped by that.
pub fn unmap_shared(address: *mut std::ffi::c_void, unmap: impl FnOnce()) {
    let mut list = list();
    list.mappings.remove(&address.addr());
    unmap();
}

/// Distinguishes the process that created an object from those that it forks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProcessMark(u32);

impl ProcessMark {
    /// The mark of this process.
    #[allow(clippy::new_without_default, reason = "it is not a neutral value")]
    pub fn new() -> ProcessMark {
        drop(list());
        ProcessMark(FORKS.load(Ordering::Relaxed))
    }

    /// Whether this process made it.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    #[inline]
    pub fn is_here(self) -> bool {
        FORKS.load(Ordering::Relaxed) == self.0
    }
}
