// SPDX-License-Identifier: MIT OR Apache-2.0
//! Passes the latest value from one thread to another: both sides are wait-free, and only the writer drops values.
//!
//! There are three slots: the writer's, the reader's, and one between them, which each side exchanges for its
//! own.
//!
//! ```text
//!  writer                        between                      reader
//!   fills its slot, then    ---> its number and FRESH   --->   if FRESH: exchanges its slot for this one
//!   exchanges it for this one                                  and reads its own
//! ```
//!
//! The slot that the writer gets back contains an old value. The next write drops it, in the writer's thread.

use crate::sync::{Arc, AtomicU8, Ordering, UnsafeCell};

/// Set if the value between the two sides was written after the reader's last exchange.
const FRESH: u8 = 4;
const SLOT: u8 = 3;

struct TripleBuffer<T> {
    slots: [UnsafeCell<T>; 3],
    between: AtomicU8,
}

// SAFETY: a slot is touched only by the side that has its number, and numbers are exchanged by one AcqRel swap, so each
// of the three is at any time with the writer, with the reader or between them. A value may be read by one thread (as
// `&T`, from which the reader can clone) while another one, which wrote it, holds no reference to it: T: Send will do.
unsafe impl<T: Send> Sync for TripleBuffer<T> {}

/// Writes values; the [`LatestReader`] reads the newest one.
pub struct LatestWriter<T> {
    buffer: Arc<TripleBuffer<T>>,
    slot: u8,
}

/// Reads the newest value that its [`LatestWriter`] has written.
pub struct LatestReader<T> {
    buffer: Arc<TripleBuffer<T>>,
    slot: u8,
}

/// Creates both sides. The value is `first` until another one is written.
///
/// ```
/// let (mut writer, mut reader) = tautline_rt::latest(vec![1, 2]);
/// assert_eq!(*reader.read(), [1, 2]);
/// writer.write(vec![3]);
/// writer.write(vec![4, 5]);
/// assert_eq!(*reader.read(), [4, 5]);
/// ```
pub fn latest<T: Clone>(first: T) -> (LatestWriter<T>, LatestReader<T>) {
    let slots = [first.clone(), first.clone(), first].map(UnsafeCell::new);
    let buffer = Arc::new(TripleBuffer { slots, between: AtomicU8::new(1) });
    (LatestWriter { buffer: buffer.clone(), slot: 0 }, LatestReader { buffer, slot: 2 })
}

impl<T> TripleBuffer<T> {
    fn slot(&self, number: u8) -> &UnsafeCell<T> {
        &self.slots[usize::from(number & SLOT) % 3]
    }
}

impl<T> LatestWriter<T> {
    /// Makes `value` the newest, and drops an older one.
    ///
    /// # Real-time
    /// Wait-free, except for the drop of a value of `T`.
    pub fn write(&mut self, value: T) {
        self.buffer.slot(self.slot).with_mut(|slot| {
            // SAFETY: this slot is the writer's, and `&mut self` is its only user.
            unsafe { *slot = value };
        });
        // AcqRel: the reader that gets this slot sees the value; its accesses to the slot that comes back are over.
        self.slot = self.buffer.between.swap(self.slot | FRESH, Ordering::AcqRel) & SLOT;
    }

    /// Like [`write`](Self::write); then `wake` wakes a waiting reader: see [`LatestReader::is_fresh_after`].
    pub fn write_and_wake(&mut self, value: T, wake: impl FnOnce()) {
        self.write(value);
        wake();
    }

    /// Whether the reader has the newest value, and so none of the former ones.
    pub fn is_read(&self) -> bool {
        // Acquire: pairs with the reader's exchange, after which it does not use the former value.
        self.buffer.between.load(Ordering::Acquire) & FRESH == 0
    }

    /// Whether the reader has been dropped.
    pub fn is_abandoned(&self) -> bool {
        Arc::strong_count(&self.buffer) == 1
    }
}

impl<T> LatestReader<T> {
    /// The newest value.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall; drops nothing. One load, and one exchange if the value is new.
    pub fn read(&mut self) -> &T {
        if self.is_fresh() {
            // AcqRel: as in `write`.
            self.slot = self.buffer.between.swap(self.slot, Ordering::AcqRel) & SLOT;
        }
        self.buffer.slot(self.slot).with(|slot| {
            // SAFETY: this slot is the reader's as long as the reference lives: only `&mut self` exchanges it.
            unsafe { &*slot }
        })
    }

    /// The value that [`read`](Self::read) returned last, even if there is a newer one.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn current(&self) -> &T {
        self.buffer.slot(self.slot).with(|slot| {
            // SAFETY: this slot is the reader's, and `read`, which exchanges it, needs `&mut self`.
            unsafe { &*slot }
        })
    }

    /// Whether [`read`](Self::read) would return a new value.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn is_fresh(&self) -> bool {
        self.buffer.between.load(Ordering::Relaxed) & FRESH != 0
    }

    /// Like [`is_fresh`](Self::is_fresh), but checked after `register` has registered the task that
    /// [`LatestWriter::write_and_wake`] must wake. A value that is written meanwhile is either seen here, or wakes the task.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall, if `register` is so.
    pub fn is_fresh_after(&self, register: impl FnOnce()) -> bool {
        register();
        self.is_fresh()
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicBool, AtomicUsize};
    use std::thread::ThreadId;

    #[test]
    fn the_newest_value_is_read_and_fresh_once() {
        let (mut writer, mut reader) = latest(0);
        assert!(!reader.is_fresh());
        for value in 1..10 {
            writer.write(value);
            if value % 3 == 0 {
                assert!(reader.is_fresh() && !writer.is_read());
                assert_eq!(*reader.read(), value);
                assert!(!reader.is_fresh() && writer.is_read());
                assert_eq!(*reader.read(), value);
            }
        }
        assert!(!writer.is_abandoned());
        drop(reader);
        assert!(writer.is_abandoned());
        writer.write(11);
    }

    #[test]
    fn values_are_dropped_in_the_writers_thread_only() {
        static DROPPED: AtomicUsize = AtomicUsize::new(0);
        #[derive(Clone)]
        struct Value(ThreadId, u64);
        impl Drop for Value {
            fn drop(&mut self) {
                assert_eq!(std::thread::current().id(), self.0);
                DROPPED.fetch_add(1, Ordering::Relaxed);
            }
        }
        let total = if cfg!(miri) { 100 } else { 100_000 };
        let this = std::thread::current().id();
        let (mut writer, mut reader) = latest(Value(this, 0));
        let done = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let reading = scope.spawn(|| {
                let mut last = 0;
                while !done.load(Ordering::Acquire) || reader.is_fresh() {
                    let value = reader.read().1;
                    assert!(value >= last);
                    last = value;
                }
                (last, reader)
            });
            (1..=total).for_each(|value| writer.write(Value(this, value)));
            done.store(true, Ordering::Release);
            let (last, reader) = reading.join().unwrap();
            assert_eq!(last, total);
            assert_eq!(DROPPED.load(Ordering::Relaxed), total as usize);
            drop((reader, writer));
        });
        assert_eq!(DROPPED.load(Ordering::Relaxed), total as usize + 3);
    }
}

#[cfg(all(test, taut_loom))]
mod loom_tests {
    //! Every interleaving of a writer and a reader. loom's cells detect a slot that both sides access, and its model
    //! would not end if one side waited for the other. Run by `cargo xtask test`.
    use super::*;

    #[test]
    fn loom_no_slot_is_shared_and_the_newest_value_arrives() {
        loom::model(|| {
            // Of two words, so that a torn value would show.
            let (mut writer, mut reader) = latest([0_u64; 2]);
            let writing = loom::thread::spawn(move || {
                (1..=3).for_each(|value| writer.write([value; 2]));
                writer
            });
            let mut last = 0;
            for _ in 0..2 {
                let [a, b] = *reader.read();
                assert!(a == b && a >= last, "{a} {b} after {last}");
                last = a;
            }
            let _writer = writing.join().unwrap();
            assert_eq!(*reader.read(), [3; 2]);
        });
    }

    /// As `futures`' `AtomicWaker`: who registered is woken by the next call, and sees what came before it.
    #[derive(Default)]
    struct TaskWaker {
        registered: loom::sync::Mutex<bool>,
        woken: loom::sync::Notify,
    }

    impl TaskWaker {
        fn register(&self) {
            *self.registered.lock().unwrap() = true;
        }

        fn wake(&self) {
            if std::mem::take(&mut *self.registered.lock().unwrap()) {
                self.woken.notify();
            }
        }
    }

    /// A stream of changes: one that sleeps though there is a new value would sleep for ever, which loom finds.
    #[test]
    fn loom_a_reader_that_waits_is_woken() {
        loom::model(|| {
            let (mut writer, mut reader) = latest(0);
            let bell = Arc::new(TaskWaker::default());
            let of_writer = bell.clone();
            let writing = loom::thread::spawn(move || {
                (1..=2).for_each(|value| writer.write_and_wake(value, || of_writer.wake()));
                writer
            });
            let mut last = 0;
            while last < 2 {
                while !reader.is_fresh_after(|| bell.register()) {
                    bell.woken.wait();
                }
                let value = *reader.read();
                assert!(value > last, "{value} after {last}");
                last = value;
            }
            writing.join().unwrap();
        });
    }
}
