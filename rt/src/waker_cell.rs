// SPDX-License-Identifier: MIT OR Apache-2.0
//! The waker of a task that threads of different priorities wake.
//!
//! `futures`' `AtomicWaker` hands the waker to whoever wakes first. If that is a thread of low priority that is preempted before its wake,
//! the task sleeps on although a thread of higher priority wakes it. Here a waker stays registered, and each thread calls it by itself.
//!
//! The waker is in one of a few slots. Another one is put into a slot that is neither the current one nor in use:
//!
//! ```text
//!  waking (any thread)                             registering (one thread at a time)
//!  1 fence; slot = current                         1 a slot that is not current and has no users: fill it
//!  2 users of the slot += 1                        2 current = that slot
//!  3 fence                                         3 fence
//!  4 slot is still current? call its waker         4 look for what is waited for
//!  5 users of the slot -= 1
//! ```
//!
//! If step 4 of a wake finds the slot current, then `current` is moved away after that, and who registers finds the user before it fills the
//! slot again. Otherwise another waker was registered after step 1: its step 4 sees what happened before the wake.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::full_fence;
use crate::sync::{AtomicBool, AtomicU32, AtomicUsize, Ordering, UnsafeCell};
use std::task::Waker;

/// One is current, one is filled, and threads may be in the middle of a wake in the others.
const SLOTS: usize = 4;
/// The number of no slot.
const NONE: usize = SLOTS;

/// Holds the waker of a task. Many threads may wake it at once, and none relies on another one's wake.
pub struct WakerCell {
    slots: [Slot; SLOTS],
    current: AtomicUsize,
    /// Whether a thread registers, or clears.
    is_changing: AtomicBool,
}

struct Slot {
    /// Threads that may call the waker.
    users: AtomicU32,
    /// Changed by the thread that has set `is_changing`, while the slot is not current and has no users.
    waker: UnsafeCell<Option<Waker>>,
}

// SAFETY: a waker may be called by several threads; the comment on `Slot::waker` says who changes it, and the module's why nobody calls it
// meanwhile.
unsafe impl Sync for WakerCell {}

impl Default for WakerCell {
    /// Without a waker.
    fn default() -> Self {
        let slot = |_| Slot { users: AtomicU32::new(0), waker: UnsafeCell::new(None) };
        let (current, is_changing) = (AtomicUsize::new(NONE), AtomicBool::new(false));
        WakerCell { slots: core::array::from_fn(slot), current, is_changing }
    }
}

impl WakerCell {
    /// Registers a waker in place of the former one, until [`clear`](Self::clear). Check what is waited for after this call.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. If another thread registers at the same time, or if threads are in the middle of a wake of
    /// three wakers before this one, it wakes `waker` instead, so that the task is polled again.
    pub fn register(&self, waker: &Waker) {
        if !self.change(|| self.fill(waker)) {
            waker.wake_by_ref();
        }
    }

    /// Removes the waker. If a thread is in the middle of its wake, it is dropped later: with the next ones, or with this.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Drops the waker.
    pub fn clear(&self) {
        self.change(|| {
            if self.current.load(Ordering::Relaxed) != NONE {
                self.current.store(NONE, Ordering::Release);
                full_fence();
                // Acquire: pairs with the Release in `wake`; those wakes are over.
                for slot in self.slots.iter().filter(|slot| slot.users.load(Ordering::Acquire) == 0) {
                    // SAFETY: only this thread changes wakers, and no slot is current.
                    slot.waker.with_mut(|own| unsafe { *own = None });
                }
            }
            true
        });
    }

    /// Wakes the task, if one is registered.
    ///
    /// # Real-time
    /// Wait-free; no allocation; a syscall if the task's thread sleeps.
    pub fn wake(&self) {
        full_fence();
        let current = self.current.load(Ordering::Acquire);
        let Some(slot) = self.slots.get(current) else { return };
        slot.users.fetch_add(1, Ordering::Relaxed);
        full_fence();
        // Acquire: pairs with the Release in `fill`; the waker is there.
        if self.current.load(Ordering::Acquire) == current {
            slot.waker.with(|own| {
                // SAFETY: the slot was current while it had this user, so nobody changes it until the user has gone.
                if let Some(own) = unsafe { &*own } {
                    own.wake_by_ref();
                }
            });
        }
        slot.users.fetch_sub(1, Ordering::Release);
    }

    /// Runs `change` and returns its result; false if another thread is in here.
    fn change(&self, change: impl FnOnce() -> bool) -> bool {
        // Acquire: pairs with the Release below; who was in here before has finished.
        if self.is_changing.swap(true, Ordering::Acquire) {
            return false;
        }
        let is_done = change();
        self.is_changing.store(false, Ordering::Release);
        is_done
    }

    /// Makes `waker` the current one. False: no slot is free.
    fn fill(&self, waker: &Waker) -> bool {
        let current = self.current.load(Ordering::Relaxed);
        let has_it = |own: *const Option<Waker>| {
            // SAFETY: only this thread changes wakers.
            unsafe { &*own }.as_ref().is_some_and(|own| own.will_wake(waker))
        };
        if self.slots.get(current).is_some_and(|slot| slot.waker.with(has_it)) {
            return true;
        }
        // Acquire: as in `clear`.
        let is_free =
            |(index, slot): &(usize, &Slot)| *index != current && slot.users.load(Ordering::Acquire) == 0;
        let Some((index, slot)) = self.slots.iter().enumerate().find(is_free) else { return false };
        // SAFETY: only this thread changes wakers; the slot is not current and has no users.
        slot.waker.with_mut(|own| unsafe { *own = Some(waker.clone()) });
        self.current.store(index, Ordering::Release);
        full_fence();
        true
    }
}

debug_fields!(WakerCell);

#[cfg(all(test, not(taut_loom)))]
#[allow(clippy::disallowed_methods, clippy::disallowed_types, reason = "a test")]
#[allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test")]
mod tests {
    use super::*;
    use std::sync::{Arc, Mutex};
    use std::task::Wake;

    /// Runs its steps, one in each call, in the middle of the call.
    #[derive(Default)]
    struct Steps {
        left: Mutex<Vec<Box<dyn FnOnce() + Send>>>,
        calls: AtomicUsize,
    }

    impl Steps {
        fn calls(&self) -> usize {
            self.calls.load(Ordering::Relaxed)
        }
    }

    impl Wake for Steps {
        fn wake(self: Arc<Self>) {
            self.wake_by_ref();
        }

        fn wake_by_ref(self: &Arc<Self>) {
            self.calls.fetch_add(1, Ordering::Relaxed);
            let step = self.left.lock().unwrap().pop();
            if let Some(step) = step {
                step();
            }
        }
    }

    fn steps() -> (Arc<Steps>, Waker) {
        let steps = Arc::<Steps>::default();
        (steps.clone(), Waker::from(steps))
    }

    #[test]
    fn a_waker_that_gets_no_further_keeps_no_other_from_waking() {
        let cell = Arc::new(WakerCell::default());
        cell.wake();
        let (task, waker) = steps();
        cell.register(&waker);
        let preempting = cell.clone();
        task.left.lock().unwrap().push(Box::new(move || preempting.wake()));
        cell.wake();
        assert_eq!(task.calls(), 2);
        cell.wake();
        assert_eq!(task.calls(), 3, "it stays registered");
        cell.clear();
        cell.wake();
        assert_eq!((task.calls(), Arc::strong_count(&task)), (3, 2), "and is dropped");
    }

    /// The thread that wakes is preempted, and the task is registered again and again with other wakers.
    #[test]
    fn a_waker_in_use_stays_while_others_are_registered() {
        let cell = Arc::new(WakerCell::default());
        let (task, waker) = steps();
        cell.register(&waker);
        drop(waker);
        let tasks: Vec<_> = std::iter::repeat_with(steps).take(10).collect();
        let (others, registers) = (tasks.clone(), cell.clone());
        task.left.lock().unwrap().push(Box::new(move || {
            for (other, waker) in &others {
                registers.register(waker);
                registers.wake();
                assert_eq!(other.calls(), 1);
            }
        }));
        cell.wake();
        assert_eq!((task.calls(), Arc::strong_count(&task)), (1, 2), "it is still there");
        cell.clear();
        assert_eq!(Arc::strong_count(&task), 1);
        assert!(tasks.iter().all(|(other, _)| Arc::strong_count(other) == 2));
    }

    #[test]
    fn a_task_for_which_there_is_no_room_is_polled_again() {
        let cell = Arc::new(WakerCell::default());
        let tasks: Vec<_> = std::iter::repeat_with(steps).take(SLOTS + 1).collect();
        cell.register(&tasks[0].1);
        // Each is registered and woken in the middle of the wake before.
        for index in 0..SLOTS {
            let (cell, next) = (cell.clone(), tasks[index + 1].1.clone());
            let step = move || {
                cell.register(&next);
                if index + 1 < SLOTS {
                    cell.wake();
                }
            };
            tasks[index].0.left.lock().unwrap().push(Box::new(step));
        }
        cell.wake();
        assert!(tasks.iter().all(|(task, _)| task.calls() == 1), "the last one by itself");
        cell.clear();
    }
}

#[cfg(all(test, taut_loom))]
#[allow(clippy::disallowed_methods, clippy::unwrap_used, clippy::indexing_slicing, reason = "a test")]
mod loom_tests {
    use super::*;
    use std::sync::Arc;
    use std::task::Wake;

    struct Task(Arc<loom::sync::Notify>);

    impl Wake for Task {
        fn wake(self: Arc<Self>) {
            self.0.notify();
        }
    }

    /// A task that sleeps though it was woken would sleep for ever, which loom finds, as it finds a waker that is changed during its call.
    #[test]
    fn loom_who_registered_last_is_woken() {
        let mut model = loom::model::Builder::new();
        model.preemption_bound = Some(3);
        model.check(|| {
            let cell = loom::sync::Arc::new(WakerCell::default());
            let happened = loom::sync::Arc::new(AtomicBool::new(false));
            let (waking, happens) = (cell.clone(), happened.clone());
            let thread = loom::thread::spawn(move || {
                happens.store(true, Ordering::Relaxed);
                waking.wake();
            });
            // The last one may get the slot of the first.
            let bells = [(); 3].map(|()| Arc::new(loom::sync::Notify::new()));
            for bell in &bells {
                cell.register(&Waker::from(Arc::new(Task(bell.clone()))));
            }
            while !happened.load(Ordering::Relaxed) {
                bells[2].wait();
            }
            thread.join().unwrap();
            cell.clear();
        });
    }
}
