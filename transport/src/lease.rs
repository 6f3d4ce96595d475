// SPDX-License-Identifier: MIT OR Apache-2.0
//! Moving an iceoryx2 port between threads without a lock.
//!
//! A port of `ipc::Service` and the samples it gives out share an `Rc`: neither is `Send`. iceoryx2's alternative guards
//! that state with a mutex that does not inherit priority. Here the port itself may move, as long as nothing that it
//! lent out is alive in another thread, which a counter tells:
//!
//! ```text
//!             lend          give back
//!   lent = 0 ------> lent = n --------> lent = 0
//!      |  get() in any thread:            get() in another thread: WrongThread
//!      |  that thread becomes the owner
//!      v  drop in any thread              drop in another thread: ABANDONED, the last lease drops the port
//! ```

use crate::sync::{AtomicU64, AtomicUsize, Ordering};
use futures::task::AtomicWaker;
use std::cell::{Cell, UnsafeCell};
use std::marker::PhantomData;
use std::mem::ManuallyDrop;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

const ABANDONED: usize = 1 << (usize::BITS - 1);

/// A port that lives in one thread at a time.
///
/// Invariant: clones of the port's inner `Rc` exist only in the port and in what is kept together with a [`Lease`];
/// leases never leave the thread that was the owner when they were made, and the owner changes only while none is out.
pub(crate) struct Bound<P> {
    shared: Arc<Shared<P>>,
    /// Not `Sync`: `get` must not run in two threads at once.
    _not_sync: PhantomData<Cell<()>>,
}

struct Shared<P> {
    owner: AtomicU64,
    /// Leases that are out, and the [`ABANDONED`] bit.
    lent: AtomicUsize,
    port: UnsafeCell<ManuallyDrop<P>>,
    /// Set by who was refused something because leases are out; the next lease given back wakes it.
    starved: AtomicBool,
    waker: AtomicWaker,
}

/// The port was lent out in another thread and not all came back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct WrongThread;

// SAFETY: moving a Bound moves the port. `get` and `drop` touch the port only if no lease is out or in the thread of all
// leases (invariant), so the `Rc` inside is never used by two threads at once; `lent` orders the two threads' uses.
unsafe impl<P> Send for Bound<P> {}

impl<P> Bound<P> {
    pub(crate) fn new(port: P) -> Self {
        let shared = Shared {
            owner: AtomicU64::new(this_thread()),
            lent: AtomicUsize::new(0),
            port: UnsafeCell::new(ManuallyDrop::new(port)),
            starved: AtomicBool::new(false),
            waker: AtomicWaker::new(),
        };
        #[allow(clippy::arc_with_non_send_sync, reason = "the point of this type: see its invariant")]
        Bound { shared: Arc::new(shared), _not_sync: PhantomData }
    }

    /// The port, for this thread, which becomes the owner.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn get(&self) -> Result<&P, WrongThread> {
        let me = this_thread();
        if self.shared.owner.load(Ordering::Relaxed) != me {
            // Acquire: pairs with the Release in Lease::drop; all uses by the former owner are over.
            if self.shared.lent.load(Ordering::Acquire) != 0 {
                return Err(WrongThread);
            }
            self.shared.owner.store(me, Ordering::Relaxed);
        }
        // SAFETY: this thread is the owner, so every lease is in this thread; Bound is not Sync, so nobody else is here;
        // the port is dropped only by Bound::drop or after it.
        Ok(unsafe { &*self.shared.port.get() })
    }

    /// Notes that something of the port, got in this thread, is given out. Keep the lease next to it and drop it after.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn lend(&self) -> Lease<P> {
        self.shared.lent.fetch_add(1, Ordering::Relaxed);
        Lease { shared: self.shared.clone() }
    }

    /// Wakes `waker` when the next lease is given back. Returns false if none is out any more.
    pub(crate) fn wake_when_given_back(&self, waker: &std::task::Waker) -> bool {
        self.shared.waker.register(waker);
        self.shared.starved.store(true, Ordering::SeqCst);
        self.shared.lent.load(Ordering::SeqCst) != 0
    }
}

impl<P> Drop for Bound<P> {
    fn drop(&mut self) {
        let shared = &self.shared;
        let mine = shared.owner.load(Ordering::Relaxed) == this_thread();
        if mine || shared.lent.fetch_or(ABANDONED, Ordering::AcqRel) == 0 {
            // SAFETY: either all leases are in this thread, or none is out; and no lease saw ABANDONED together with
            // itself being the last, so nobody else drops the port.
            unsafe { ManuallyDrop::drop(&mut *shared.port.get()) };
        }
    }
}

/// Something of a port is out in this thread. Not `Send` (through the `UnsafeCell` and the port).
pub(crate) struct Lease<P> {
    shared: Arc<Shared<P>>,
}

impl<P> Drop for Lease<P> {
    fn drop(&mut self) {
        // Release: what this thread did with the port comes before the next owner. Acquire: the last lease drops the
        // port after all that others did.
        let before = self.shared.lent.fetch_sub(1, Ordering::AcqRel);
        if before == ABANDONED | 1 {
            // SAFETY: the Bound is gone and left the port to the last lease, which this is.
            unsafe { ManuallyDrop::drop(&mut *self.shared.port.get()) };
        } else if self.shared.starved.load(Ordering::SeqCst) && self.shared.starved.swap(false, Ordering::SeqCst) {
            self.shared.waker.wake();
        }
    }
}

/// A number for each thread, never used twice.
fn this_thread() -> u64 {
    static NEXT: std::sync::atomic::AtomicU64 = std::sync::atomic::AtomicU64::new(1);
    thread_local!(static ME: Cell<u64> = const { Cell::new(0) });
    ME.with(|me| {
        if me.get() == 0 {
            me.set(NEXT.fetch_add(1, std::sync::atomic::Ordering::Relaxed));
        }
        me.get()
    })
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use std::rc::Rc;

    #[test]
    fn the_port_moves_while_nothing_is_lent() {
        let bound = Bound::new(Rc::new(1));
        drop(bound.lend());
        let sum = std::thread::spawn(move || **bound.get().unwrap() + 1).join().unwrap();
        assert_eq!(sum, 2);
    }

    #[test]
    fn another_thread_is_refused_while_something_is_lent() {
        let bound = Bound::new(Rc::new(1));
        let (kept, lease) = (bound.get().unwrap().clone(), bound.lend());
        let bound = std::thread::spawn(move || {
            assert_eq!(bound.get().err(), Some(WrongThread));
            bound
        })
        .join()
        .unwrap();
        drop((kept, lease));
        assert!(bound.get().is_ok());
    }

    #[test]
    fn the_last_lease_drops_a_port_abandoned_in_another_thread() {
        struct Port(Rc<()>, Arc<AtomicBool>);
        impl Drop for Port {
            fn drop(&mut self) {
                self.1.store(true, std::sync::atomic::Ordering::SeqCst);
            }
        }
        let dropped = Arc::new(AtomicBool::new(false));
        let bound = Bound::new(Port(Rc::new(()), dropped.clone()));
        let (kept, lease) = (bound.get().unwrap().0.clone(), bound.lend());
        std::thread::spawn(move || drop(bound)).join().unwrap();
        assert!(!dropped.load(std::sync::atomic::Ordering::SeqCst), "something of it is still out");
        drop((kept, lease));
        assert!(dropped.load(std::sync::atomic::Ordering::SeqCst));
    }
}

#[cfg(all(test, taut_loom))]
mod loom_tests {
    use super::*;

    #[test]
    fn loom_the_port_is_dropped_exactly_once() {
        loom::model(|| {
            struct Port(Arc<loom::sync::atomic::AtomicU32>);
            impl Drop for Port {
                fn drop(&mut self) {
                    self.0.fetch_add(1, Ordering::Relaxed);
                }
            }
            let drops = Arc::new(loom::sync::atomic::AtomicU32::new(0));
            let bound = Bound::new(Port(drops.clone()));
            let leases = (bound.lend(), bound.lend());
            let other = loom::thread::spawn(move || drop(bound));
            drop(leases);
            other.join().unwrap();
            assert_eq!(drops.load(Ordering::Relaxed), 1);
        });
    }
}
