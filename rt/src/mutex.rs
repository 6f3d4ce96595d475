// SPDX-License-Identifier: MIT OR Apache-2.0
//! A mutex for threads of different priorities: its holder runs at the highest priority of all threads that wait
//! for it (`PTHREAD_PRIO_INHERIT`), so that no thread between the two priorities can delay the waiting one.

use std::cell::UnsafeCell;
use std::mem::MaybeUninit;
use std::ops::{Deref, DerefMut};

/// Protects a value that threads of different priorities use. Unlike the standard library's mutex it inherits priority, and
/// remains usable after a panic.
///
/// ```
/// let counted = tautline_rt::PiMutex::new(0);
/// *counted.lock() += 1;
/// assert_eq!(*counted.lock(), 1);
/// ```
pub struct PiMutex<T> {
    /// Boxed, because a locked mutex must not move; only a mutex that no thread waits for may.
    raw: Box<UnsafeCell<libc::pthread_mutex_t>>,
    value: UnsafeCell<T>,
}

// SAFETY: the mutex gives one thread at a time access to the value.
unsafe impl<T: Send> Send for PiMutex<T> {}
// SAFETY: as above.
unsafe impl<T: Send> Sync for PiMutex<T> {}

impl<T> PiMutex<T> {
    /// An unlocked mutex.
    ///
    /// # Real-time
    /// Setup only: allocates.
    ///
    /// # Panics
    /// If the C library has no mutexes with priority inheritance; those of Linux have had it since 2006.
    pub fn new(value: T) -> Self {
        let mut raw = MaybeUninit::uninit();
        // SAFETY: `raw` can be written, and no thread uses it yet.
        assert!(unsafe { make(raw.as_mut_ptr()) }, "no mutex that inherits priority");
        // SAFETY: initialised above. It may move: nobody has locked it yet.
        let raw = Box::new(UnsafeCell::new(unsafe { raw.assume_init() }));
        PiMutex { raw, value: UnsafeCell::new(value) }
    }

    /// Locks the mutex; waits until no other thread holds it.
    ///
    /// # Real-time
    /// No allocation; no syscall if no thread holds it. Waits at most once for the longest critical section of the threads that
    /// lock it; the holder runs at this thread's priority meanwhile.
    ///
    /// # Panics
    /// If this thread already holds it.
    pub fn lock(&self) -> PiGuard<'_, T> {
        // SAFETY: initialised, and not destroyed before `self` is dropped. It fails only if this thread holds it already, which would be
        // a bug here and not to be waited for.
        let locked = unsafe { libc::pthread_mutex_lock(self.raw.get()) };
        assert!(locked == 0, "a thread locks a mutex that it holds");
        PiGuard { mutex: self }
    }
}

/// Makes an unlocked mutex; false if the C library has none that inherits priority.
///
/// # Safety
/// `raw` can be written, and no thread uses a mutex there.
unsafe fn make(raw: *mut libc::pthread_mutex_t) -> bool {
    let mut attributes = MaybeUninit::uninit();
    // SAFETY: the attributes are written before they are read and destroyed once; the caller vouches for `raw`.
    unsafe {
        libc::pthread_mutexattr_init(attributes.as_mut_ptr()) == 0
            && libc::pthread_mutexattr_setprotocol(attributes.as_mut_ptr(), libc::PTHREAD_PRIO_INHERIT) == 0
            && libc::pthread_mutexattr_settype(attributes.as_mut_ptr(), libc::PTHREAD_MUTEX_ERRORCHECK) == 0
            && libc::pthread_mutex_init(raw, attributes.as_ptr()) == 0
            && libc::pthread_mutexattr_destroy(attributes.as_mut_ptr()) == 0
    }
}

impl<T: Default> Default for PiMutex<T> {
    fn default() -> Self {
        PiMutex::new(T::default())
    }
}

impl<T> Drop for PiMutex<T> {
    fn drop(&mut self) {
        // SAFETY: initialised, and nobody holds it: guards borrow `self`.
        unsafe { libc::pthread_mutex_destroy(self.raw.get()) };
    }
}

crate::debug_fields!([T] PiMutex<T>);

/// The right to use the value of a [`PiMutex`], until it is dropped.
#[must_use = "the mutex is unlocked when this is dropped"]
pub struct PiGuard<'m, T> {
    mutex: &'m PiMutex<T>,
}

impl<T> PiGuard<'_, T> {
    /// Unlocks the mutex in a forked child, where the thread that locked it has another id, by which the kernel identifies owners.
    ///
    /// # Safety
    /// This is the child's only thread.
    pub(crate) unsafe fn unlock_in_child(guard: Self) {
        let raw = guard.mutex.raw.get();
        std::mem::forget(guard);
        // SAFETY: this is the only thread, as the caller promises.
        unsafe { make(raw) };
    }
}

impl<T> Deref for PiGuard<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        // SAFETY: the mutex is held.
        unsafe { &*self.mutex.value.get() }
    }
}

impl<T> DerefMut for PiGuard<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        // SAFETY: the mutex is held, and `&mut self` is the only way to the value.
        unsafe { &mut *self.mutex.value.get() }
    }
}

impl<T> Drop for PiGuard<'_, T> {
    /// # Real-time
    /// No allocation; a syscall if somebody waits.
    fn drop(&mut self) {
        // SAFETY: this thread locked it.
        unsafe { libc::pthread_mutex_unlock(self.mutex.raw.get()) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    #[test]
    fn one_at_a_time() {
        let count = Arc::new(PiMutex::new(0));
        let threads: Vec<_> = (0..4)
            .map(|_| {
                let count = count.clone();
                std::thread::spawn(move || (0..1000).for_each(|_| *count.lock() += 1))
            })
            .collect();
        threads.into_iter().for_each(|thread| thread.join().unwrap());
        assert_eq!(*count.lock(), 4000);
    }

    #[test]
    #[should_panic(expected = "that it holds")]
    fn who_holds_it_does_not_wait_for_itself() {
        let value = PiMutex::new(1);
        let _first = value.lock();
        let _second = value.lock();
    }

    #[test]
    fn a_panic_leaves_it_unlocked() {
        let value = Arc::new(PiMutex::new(1));
        let shared = value.clone();
        let panics = std::thread::spawn(move || {
            let _guard = shared.lock();
            panic!("on purpose");
        });
        assert!(panics.join().is_err());
        assert_eq!(*value.lock(), 1);
    }
}
