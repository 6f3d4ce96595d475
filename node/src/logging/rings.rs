// SPDX-License-Identifier: MIT OR Apache-2.0
//! Passes log lines out of real-time threads: a ring of fixed size for each thread, which only that thread
//! fills.
//!
//! Rings are created ahead of time, by threads that may wait; a real-time thread claims one with its first line. When the
//! ring of an ended thread is empty, another thread may claim it.

use super::line::{FixedLine, Line};
use super::severity::LogSeverity;
use rtrb::{Consumer, Producer, RingBuffer};
use std::cell::Cell;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};
use tautline_rt::FutexWord;
use tautline_rt::fork::ProcessMutex;

/// Lines of one thread that wait to be written: 32 KiB.
pub(super) const LINES: usize = 64;
/// Most threads that log in real time.
const RINGS: usize = 64;
/// Rings that are kept ready for threads to come.
const SPARE: usize = 4;

struct Ring {
    /// The thread that fills it; zero: none.
    tid: AtomicU32,
    /// Whether its memory is allocated.
    ready: AtomicBool,
    /// Try-locked only by its thread, after its memory is allocated; so the try-lock always succeeds.
    producer: ProcessMutex<Option<Producer<FixedLine>>>,
    lost: AtomicU64,
}

static RINGS_OF_THREADS: [Ring; RINGS] = [const {
    Ring {
        tid: AtomicU32::new(0),
        ready: AtomicBool::new(false),
        producer: ProcessMutex::new(None, || None),
        lost: AtomicU64::new(0),
    }
}; RINGS];

/// Lines of threads for which there was no ring.
static WITHOUT_RING: AtomicU64 = AtomicU64::new(0);

thread_local! {
    // Without a destructor, which the first use would have to allocate for.
    static MINE: Cell<Option<u8>> = const { Cell::new(None) };
}

/// Whether the current thread fills a ring.
pub(super) fn is_mine() -> bool {
    MINE.try_with(Cell::get).ok().flatten().is_some_and(|index| claimed(index).is_some())
}

/// The ring of this number, unless it belonged to the parent of this process.
fn claimed(index: u8) -> Option<&'static Ring> {
    RINGS_OF_THREADS.get(usize::from(index)).filter(|ring| ring.tid.load(Ordering::Relaxed) != 0)
}

/// The futex of the thread that writes lines: the lowest bit is set while that thread sleeps, the others count wakes.
static BELL: FutexWord = FutexWord::new(0);
const SLEEPING: u32 = 1;

/// Puts a line into the current thread's ring; it is counted as lost if the ring is full, or if there is none.
///
/// # Real-time
/// Wait-free; no allocation; one syscall with a thread's first line, and one for a line after a silence of all threads, to wake the one
/// that writes.
pub(super) fn push(line: FixedLine) {
    keep(line);
    // Either this thread sees that the other one sleeps, or the other one sees the line before it sleeps.
    fence(Ordering::SeqCst);
    if BELL.0.load(Ordering::Relaxed) & SLEEPING != 0 {
        BELL.0.fetch_add(SLEEPING << 1, Ordering::Relaxed);
        BELL.wake();
    }
}

/// Sleeps until a thread has pushed a line since `is_empty` returned that none waits. For the one thread that writes.
pub(super) fn sleep(is_empty: impl FnOnce() -> bool) {
    let asleep = BELL.0.fetch_or(SLEEPING, Ordering::SeqCst) | SLEEPING;
    fence(Ordering::SeqCst);
    if is_empty() {
        BELL.wait(asleep, None);
    }
    BELL.0.fetch_and(!SLEEPING, Ordering::SeqCst);
}

fn keep(line: FixedLine) {
    let Some(ring) = mine() else {
        WITHOUT_RING.fetch_add(1, Ordering::Relaxed);
        return;
    };
    let pushed = match ring.producer.try_lock() {
        Some(mut producer) => producer.as_mut().is_some_and(|producer| producer.push(line).is_ok()),
        None => false,
    };
    if !pushed {
        ring.lost.fetch_add(1, Ordering::Relaxed);
    }
}

fn mine() -> Option<&'static Ring> {
    // Without thread-locals, the thread is shutting down.
    let known = MINE.try_with(Cell::get).ok()?;
    if let Some(ring) = known.and_then(claimed) {
        return Some(ring);
    }
    let tid = tautline_rt::current_tid();
    let (index, ring) = RINGS_OF_THREADS.iter().enumerate().find(|(_, ring)| {
        // Acquire: pairs with the Releases in `prepare`, which made the ring, and in `reclaim`, which freed it.
        ring.ready.load(Ordering::Acquire)
            && ring.tid.compare_exchange(0, tid, Ordering::Acquire, Ordering::Relaxed).is_ok()
    })?;
    let _ = MINE.try_with(|mine| mine.set(Some(index as u8)));
    Some(ring)
}

/// The consumers of the rings. There is one `Drain`.
pub(super) struct Drain {
    consumers: Vec<Consumer<FixedLine>>,
    batch: Vec<FixedLine>,
}

#[derive(Debug, PartialEq, Eq)]
pub(super) struct Lost {
    pub(super) lines: u64,
    /// The thread; zero: all threads that found no ring.
    pub(super) tid: u32,
}

impl Drain {
    pub(super) const fn new() -> Drain {
        Drain { consumers: Vec::new(), batch: Vec::new() }
    }

    /// The drain of a forked child, which has none of its parent's rings.
    pub(super) fn of_child() -> Drain {
        for ring in &RINGS_OF_THREADS {
            ring.ready.store(false, Ordering::Relaxed);
            ring.tid.store(0, Ordering::Relaxed);
        }
        BELL.0.store(0, Ordering::Relaxed);
        Drain::new()
    }

    /// Creates rings, so that some are spare. Allocates and touches their memory.
    pub(super) fn prepare(&mut self) {
        let spare = RINGS_OF_THREADS[..self.consumers.len()].iter();
        let spare = spare.filter(|ring| ring.tid.load(Ordering::Relaxed) == 0).count();
        for ring in RINGS_OF_THREADS.iter().skip(self.consumers.len()).take(SPARE.saturating_sub(spare)) {
            let (mut producer, mut consumer) = RingBuffer::new(LINES);
            // Filled once, so that it causes no page faults later.
            let line =
                Line { time_ns: 0, severity: LogSeverity::Unset, logger: "", text: "", file: "", line: 0 };
            let line = FixedLine::new(line, format_args!(""));
            while producer.push(line.clone()).is_ok() {}
            while consumer.pop().is_ok() {}
            *ring.producer.lock() = Some(producer);
            self.consumers.push(consumer);
            ring.ready.store(true, Ordering::Release);
        }
    }

    /// Passes every waiting line to `write`, oldest first, and then the losses to `lost`. Returns whether there was anything.
    pub(super) fn drain(&mut self, mut write: impl FnMut(&FixedLine), mut lost: impl FnMut(Lost)) -> bool {
        for consumer in &mut self.consumers {
            // At most one ring's length: a thread that fills its ring continuously does not block this one.
            for _ in 0..LINES {
                let Ok(line) = consumer.pop() else { break };
                self.batch.push(line);
            }
        }
        let mut any = !self.batch.is_empty();
        self.batch.sort_by_key(|line| line.as_line().time_ns);
        self.batch.drain(..).for_each(|line| write(&line));
        for ring in &RINGS_OF_THREADS[..self.consumers.len()] {
            let lines = ring.lost.swap(0, Ordering::Relaxed);
            if lines != 0 {
                any = true;
                lost(Lost { lines, tid: ring.tid.load(Ordering::Relaxed) });
            }
        }
        let lines = WITHOUT_RING.swap(0, Ordering::Relaxed);
        if lines != 0 {
            any = true;
            lost(Lost { lines, tid: 0 });
        }
        any
    }

    /// Frees the rings of threads that have ended, once they are empty.
    pub(super) fn reclaim(&mut self) {
        for (ring, consumer) in RINGS_OF_THREADS.iter().zip(&self.consumers) {
            let tid = ring.tid.load(Ordering::Relaxed);
            if tid != 0 && consumer.is_empty() && !Path::new(&format!("/proc/self/task/{tid}")).exists() {
                // Release: pairs with the Acquire in `mine`.
                ring.tid.store(0, Ordering::Release);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(number: usize) -> FixedLine {
        let line = Line {
            time_ns: number as i64,
            severity: LogSeverity::Info,
            logger: "",
            text: "",
            file: "",
            line: 0,
        };
        FixedLine::new(line, format_args!("{number}"))
    }

    /// One test, for the rings are the process's.
    #[test]
    fn a_full_ring_loses_the_newest_lines_and_counts_them() {
        let mut drain = Drain::new();
        let drained = |drain: &mut Drain| {
            let (mut lines, mut losses) = (Vec::new(), Vec::new());
            drain.drain(|line| lines.push(line.as_line().text.to_owned()), |lost| losses.push(lost));
            (lines, losses)
        };
        push(line(0));
        assert_eq!(drained(&mut drain), (vec![], vec![Lost { lines: 1, tid: 0 }]));

        drain.prepare();
        (0..LINES + 3).for_each(|number| push(line(number)));
        assert!(is_mine());
        let (lines, losses) = drained(&mut drain);
        assert_eq!(lines, (0..LINES).map(|number| number.to_string()).collect::<Vec<_>>());
        assert_eq!(losses, [Lost { lines: 3, tid: tautline_rt::current_tid() }]);

        // Each thread has its own; all are ordered by their time; the rings of ended threads are used again.
        for round in 0..3 * RINGS {
            std::thread::spawn(|| push(line(2))).join().unwrap();
            push(line(1));
            drain.reclaim();
            assert_eq!(drained(&mut drain), (vec!["1".into(), "2".into()], vec![]), "{round}");
            drain.reclaim();
            drain.prepare();
        }
        // A thread that was joined may be known to the kernel for a moment more.
        assert!(drain.consumers.len() < 4 * SPARE, "{}", drain.consumers.len());

        // Beside a fast thread, every line is written or counted.
        let total = 100_000;
        let writing = std::thread::spawn(move || (0..total).for_each(|number| push(line(number))));
        let (mut written, mut lost) = (0, 0);
        let mut look = |drain: &mut Drain| {
            drain.drain(|_| written += 1, |loss| lost += loss.lines);
        };
        while !writing.is_finished() {
            look(&mut drain);
        }
        writing.join().unwrap();
        look(&mut drain);
        assert_eq!(written + lost, total as u64);
    }
}
