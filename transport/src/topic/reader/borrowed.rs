// SPDX-License-Identifier: MIT OR Apache-2.0
//! Samples that may be dropped in any thread, without a lock.
//!
//! A sample that came through a queue goes back through a queue, and both queues have one user on this side: the thread that takes.
//! So a borrowed sample never leaves its subscription. It stays in a table, and the user holds its index and the address of its
//! body. Dropping the sample sets a bit; the subscription removes the marked samples from the table at its next take.
//!
//! ```text
//!             lend (subscription)       drop BorrowedSample (any thread)      reclaim (subscription)
//!    free ----------------------> out ----------------------> back -----------------------> free
//! ```

use crate::sync::{AtomicU32, AtomicU64, Ordering};
use std::any::Any;
use std::cell::{RefCell, UnsafeCell};
use std::sync::Arc;
use std::task::Waker;
use tautline_rt::{WakerCell, full_fence};

/// The table of one subscription's borrowed samples.
pub(crate) struct BorrowTable<S> {
    state: Arc<BorrowTableState<S>>,
    free: RefCell<Vec<usize>>,
}

// SAFETY: see BorrowTableState; the rest is plain data.
unsafe impl<S> Send for BorrowTable<S> {}

struct BorrowTableState<S> {
    /// An entry is accessed by the BorrowTable while it is free or returned, and by no thread while its sample is
    /// borrowed.
    places: Box<[UnsafeCell<Option<S>>]>,
    back: Box<[AtomicU64]>,
    /// A task was refused a sample because all entries are in use: each sample that is returned wakes it, until it looks. Whoever returns
    /// one relies on no other thread, which may be preempted before its wake.
    starved: AtomicU32,
    waker: WakerCell,
    /// Dropped after all samples, when the table and the last borrowed sample have been dropped.
    _end: Box<dyn Any + Send + Sync>,
}

// SAFETY: through a shared reference a BorrowedSample only sets bits and wakes. Places are accessed by the BorrowTable, which is not Sync,
// or by the last owner's drop. State that the samples share belongs to one subscription, as the BorrowTable does, so one thread at a time
// uses it; if only BorrowedSamples are left, only the drop of the last one does.
unsafe impl<S> Send for BorrowTableState<S> {}
// SAFETY: as above.
unsafe impl<S> Sync for BorrowTableState<S> {}

impl<S> BorrowTable<S> {
    /// `end` is dropped when the table and all samples that were ever in it have been dropped.
    pub(crate) fn new(places: usize, end: impl Any + Send + Sync) -> Self {
        let state = BorrowTableState {
            places: (0..places).map(|_| UnsafeCell::new(None)).collect(),
            back: (0..places.div_ceil(64)).map(|_| AtomicU64::new(0)).collect(),
            starved: AtomicU32::new(0),
            waker: WakerCell::default(),
            _end: Box::new(end),
        };
        BorrowTable { state: Arc::new(state), free: RefCell::new((0..places).rev().collect()) }
    }

    /// Drops the samples that were returned. Returns false if all entries are still in use.
    ///
    /// # Real-time
    /// Wait-free, O(places / 64 + samples back); no allocation; no syscall.
    pub(crate) fn reclaim(&self) -> bool {
        let mut free = self.free.borrow_mut();
        for (index, word) in self.state.back.iter().enumerate() {
            if word.load(Ordering::Relaxed) == 0 {
                continue;
            }
            // Acquire: pairs with the Release in BorrowedSample::drop; its reads of the sample are over.
            let mut bits = word.swap(0, Ordering::Acquire);
            while bits != 0 {
                let place = index * 64 + bits.trailing_zeros() as usize;
                bits &= bits - 1;
                if let Some(cell) = self.state.places.get(place) {
                    // SAFETY: the place is back, so it is the BorrowTable's alone.
                    drop(unsafe { (*cell.get()).take() });
                    free.push(place); // never more than there are places: does not allocate
                }
            }
        }
        if !free.is_empty() && self.state.starved.load(Ordering::Relaxed) != 0 {
            self.state.starved.store(0, Ordering::Relaxed);
        }
        !free.is_empty()
    }

    /// Puts a sample into the table. `None` if all entries are in use: see [`reclaim`](Self::reclaim).
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn lend(&self, sample: S) -> Option<BorrowedSample<S>> {
        let place = self.free.borrow_mut().pop()?;
        // SAFETY: the place is free, so it is the BorrowTable's alone.
        unsafe { *self.state.places.get(place)?.get() = Some(sample) };
        Some(BorrowedSample { state: self.state.clone(), place })
    }

    /// Wakes `waker` when samples are returned, until [`reclaim`](Self::reclaim). True if one was returned meanwhile: try again.
    pub(crate) fn wake_when_back(&self, waker: &Waker) -> bool {
        self.state.waker.register(waker);
        self.state.starved.store(1, Ordering::Relaxed);
        // Either the dropping thread sees `starved`, or this thread sees its bit.
        full_fence();
        self.state.back.iter().any(|word| word.load(Ordering::Relaxed) != 0)
    }
}

/// One borrowed sample. May be dropped in any thread, also after its subscription.
pub(crate) struct BorrowedSample<S> {
    state: Arc<BorrowTableState<S>>,
    place: usize,
}

impl<S> Drop for BorrowedSample<S> {
    /// # Real-time
    /// Wait-free; no allocation; no syscall, unless the subscription's task waits for a sample to come back. If the
    /// subscription was dropped before, dropping its last sample frees the table and everything that it refers to.
    fn drop(&mut self) {
        let Some(word) = self.state.back.get(self.place / 64) else { return };
        word.fetch_or(1 << (self.place % 64), Ordering::Release);
        full_fence();
        if self.state.starved.load(Ordering::Relaxed) != 0 {
            self.state.waker.wake();
        }
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use std::rc::Rc;

    #[test]
    fn places_run_out_and_come_back_from_any_thread() {
        let borrowed = BorrowTable::new(70, ());
        let out: Vec<_> = (0..70).map(|n| borrowed.lend(n).unwrap()).collect();
        assert!(borrowed.lend(70).is_none() && !borrowed.reclaim());
        std::thread::spawn(move || drop(out)).join().unwrap();
        assert!(borrowed.reclaim());
        assert_eq!((0..100).map_while(|n| borrowed.lend(n)).count(), 70);
    }

    #[test]
    fn a_sample_is_dropped_by_the_table_or_by_the_last_holder() {
        let count = Rc::new(());
        let borrowed = BorrowTable::new(2, ());
        let (first, second) = (borrowed.lend(count.clone()).unwrap(), borrowed.lend(count.clone()).unwrap());
        drop(first);
        assert_eq!(Rc::strong_count(&count), 3, "still on the borrowed");
        borrowed.reclaim();
        assert_eq!(Rc::strong_count(&count), 2);
        drop(borrowed);
        assert_eq!(Rc::strong_count(&count), 2, "out, and the borrowed is gone");
        drop(second);
        assert_eq!(Rc::strong_count(&count), 1);
    }

    #[test]
    fn the_end_comes_after_the_last_sample() {
        struct Note(&'static str, Arc<std::sync::Mutex<Vec<&'static str>>>);
        impl Drop for Note {
            fn drop(&mut self) {
                self.1.lock().unwrap().push(self.0);
            }
        }
        let notes = Arc::<std::sync::Mutex<Vec<_>>>::default();
        let note = |what| Note(what, notes.clone());
        let borrowed = BorrowTable::new(2, note("end"));
        let out = [borrowed.lend(note("first")).unwrap(), borrowed.lend(note("second")).unwrap()];
        drop(borrowed);
        std::thread::spawn(move || drop(out)).join().unwrap();
        assert_eq!(*notes.lock().unwrap(), ["first", "second", "end"]);
    }

    #[test]
    fn who_was_refused_is_woken() {
        let (waker, woken) = counting_waker();
        let borrowed = BorrowTable::new(1, ());
        let lent = borrowed.lend(()).unwrap();
        assert!(!borrowed.wake_when_back(&waker));
        drop(lent);
        assert_eq!(woken.load(std::sync::atomic::Ordering::SeqCst), 1);
        assert!(borrowed.wake_when_back(&waker), "one is back already");
    }

    /// A thread of high priority preempts one of low priority that has returned a sample, before its wake.
    #[test]
    fn who_was_refused_is_woken_by_each_thread() {
        struct Preempted(std::sync::Mutex<Option<BorrowedSample<()>>>, std::sync::atomic::AtomicUsize);
        impl std::task::Wake for Preempted {
            fn wake(self: Arc<Self>) {
                self.1.fetch_add(1, std::sync::atomic::Ordering::SeqCst);
                let other = self.0.lock().unwrap().take();
                drop(other);
            }
        }
        let borrowed = BorrowTable::new(2, ());
        let (first, second) = (borrowed.lend(()).unwrap(), borrowed.lend(()).unwrap());
        let task = Arc::new(Preempted(Some(second).into(), 0.into()));
        let woken = || task.1.load(std::sync::atomic::Ordering::SeqCst);
        assert!(!borrowed.wake_when_back(&task.clone().into()));
        drop(first);
        assert_eq!(woken(), 2);
        assert!(borrowed.reclaim());
        drop(borrowed.lend(()));
        assert_eq!(woken(), 2, "it has looked");
    }

    fn counting_waker() -> (Waker, Arc<std::sync::atomic::AtomicUsize>) {
        struct Count(Arc<std::sync::atomic::AtomicUsize>);
        impl std::task::Wake for Count {
            fn wake(self: Arc<Self>) {
                self.0.fetch_add(1, std::sync::atomic::Ordering::SeqCst);
            }
        }
        let count = Arc::<std::sync::atomic::AtomicUsize>::default();
        (Waker::from(Arc::new(Count(count.clone()))), count)
    }
}

#[cfg(all(test, taut_loom))]
mod loom_tests {
    use super::*;
    use loom::cell::Cell as LoomCell;

    /// A sample that loom watches: reading it after it was taken off the borrowed is an error.
    struct DropProbe(loom::sync::Arc<LoomCell<u32>>);
    // SAFETY: for the model; loom checks the accesses.
    unsafe impl Send for DropProbe {}

    impl Drop for DropProbe {
        fn drop(&mut self) {
            self.0.set(1);
        }
    }

    #[test]
    fn loom_a_sample_is_reclaimed_after_its_last_read() {
        loom::model(|| {
            struct Holder(BorrowedSample<DropProbe>, loom::sync::Arc<LoomCell<u32>>);
            // SAFETY: as above.
            unsafe impl Send for Holder {}
            let cell = loom::sync::Arc::new(LoomCell::new(0));
            let borrowed = BorrowTable::new(1, ());
            let holder = Holder(borrowed.lend(DropProbe(cell.clone())).unwrap(), cell);
            let reader = loom::thread::spawn(move || {
                let holder = holder;
                assert_eq!(holder.1.get(), 0);
                drop(holder.0);
            });
            while !borrowed.reclaim() {
                loom::thread::yield_now();
            }
            reader.join().unwrap();
        });
    }
}
