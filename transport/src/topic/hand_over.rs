// SPDX-License-Identifier: MIT OR Apache-2.0
//! Ownership of one side's half of a connection, without a lock: it belongs either to the thread that publishes or takes, or to the
//! setup code.
//!
//! ```text
//!                adopt (thread)                 finish (thread)
//!       NEW ----------------------> LIVE ---------------------------> DONE
//!     setup's                  the thread's                         setup's
//!      |  ^ |                                                          ^
//!      |  | +---------------------- retire (setup) --------------------+
//!      |  +--- give_back (setup)
//!      +-----> HELD
//!   hold (setup)
//! ```
//!
//! A new half belongs to the setup code until it is in a table that was handed over to the thread. After that, setup code can
//! take it for a moment ([`hold`](HandOver::hold)); this may fail. Then it hands over a table again, because the thread may
//! have skipped the half meanwhile. If setup code [retires](HandOver::retire) a half that belongs to the thread, the thread
//! finishes it when it next gets a table.

use crate::sync::{AtomicU32, Ordering};

/// The bits of the word that hold the phase.
const PHASE: u32 = 0b11;
const NEW: u32 = 0;
const HELD: u32 = 1;
const LIVE: u32 = 2;
const DONE: u32 = 3;
/// The setup code takes the half back for good.
const RETIRED: u32 = 0b100;

/// The owner of a half.
pub(crate) struct HandOver(AtomicU32);

/// The result of a [`retire`](HandOver::retire).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Retired {
    /// The half was not retired before.
    pub(crate) is_first: bool,
    /// The half belonged to the setup code, which must finish it.
    pub(crate) is_setups: bool,
}

impl HandOver {
    pub(crate) fn new() -> Self {
        HandOver(AtomicU32::new(NEW))
    }

    /// The word. Acquire: pairs with the Release of the side that handed the half over.
    fn word(&self) -> u32 {
        self.0.load(Ordering::Acquire)
    }

    fn is_in(&self, phase: u32) -> bool {
        self.word() & PHASE == phase
    }

    /// Changes the state from `from` to `to`. Returns false if it is another one.
    fn transition(&self, from: u32, to: u32) -> bool {
        self.0.compare_exchange(from, to, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }

    /// Whether no thread has adopted it.
    pub(crate) fn is_new(&self) -> bool {
        self.is_in(NEW)
    }

    /// Whether the half belongs to the thread.
    pub(crate) fn is_live(&self) -> bool {
        self.is_in(LIVE)
    }

    /// Whether the half belongs to the setup code for good.
    pub(crate) fn is_done(&self) -> bool {
        self.is_in(DONE)
    }

    pub(crate) fn is_retired(&self) -> bool {
        self.word() & RETIRED != 0
    }

    /// Setup: takes the half for a moment. Returns false if it belongs to the thread, or is retired.
    pub(crate) fn hold(&self) -> bool {
        self.transition(NEW, HELD)
    }

    /// Setup: gives back the half that it holds.
    pub(crate) fn give_back(&self) {
        let is_given = self.transition(HELD, NEW);
        debug_assert!(is_given, "setup holds it, under its lock");
    }

    /// Thread: takes the half over, if it is new and not retired. Returns whether it did.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn adopt(&self) -> bool {
        self.word() == NEW && self.transition(NEW, LIVE)
    }

    /// Thread: returns the half to the setup code for good.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn finish(&self) {
        self.0.store(DONE | RETIRED, Ordering::Release);
    }

    /// Setup: takes the half back. If it belongs to the thread, the thread finishes it when it next finds a table.
    pub(crate) fn retire(&self) -> Retired {
        let is_first = self.0.fetch_or(RETIRED, Ordering::AcqRel) & RETIRED == 0;
        Retired { is_first, is_setups: self.transition(NEW | RETIRED, DONE | RETIRED) }
    }

    /// Setup: takes the half back when no thread uses it any more.
    pub(crate) fn retire_finally(&self) -> Retired {
        let before = self.0.swap(DONE | RETIRED, Ordering::AcqRel);
        Retired { is_first: before & RETIRED == 0, is_setups: before & PHASE != DONE }
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn from_setup_to_the_thread_and_back() {
        let half = HandOver::new();
        assert!(half.is_new() && half.hold() && !half.adopt() && !half.is_live());
        half.give_back();
        assert!(half.adopt() && half.is_live() && !half.adopt() && !half.hold());
        assert_eq!(half.retire(), Retired { is_first: true, is_setups: false });
        assert_eq!(half.retire(), Retired { is_first: false, is_setups: false });
        assert!(half.is_live() && half.is_retired() && !half.is_done());
        half.finish();
        assert!(half.is_done() && half.is_retired());
        assert_eq!(half.retire_finally(), Retired { is_first: false, is_setups: false });

        let unseen = HandOver::new();
        assert_eq!(unseen.retire(), Retired { is_first: true, is_setups: true });
        assert!(unseen.is_done() && !unseen.adopt() && !unseen.hold());
        let used = HandOver::new();
        assert!(used.adopt());
        assert_eq!(used.retire_finally(), Retired { is_first: true, is_setups: true });
        assert!(used.is_done());
    }
}

#[cfg(all(test, taut_loom))]
mod loom_tests {
    use super::*;
    use crate::sync::{AtomicU64, fence};
    use loom::cell::UnsafeCell;
    use loom::sync::Arc;
    use tautline_rt::latest;

    /// What belongs to a half: loom reports it if both sides touch it at once, or one before the other's work is seen.
    struct Half(UnsafeCell<Vec<u64>>);
    // SAFETY: for the model; loom checks the accesses.
    unsafe impl Sync for Half {}
    // SAFETY: as above.
    unsafe impl Send for Half {}

    impl Half {
        fn new() -> Self {
            Half(UnsafeCell::new(Vec::new()))
        }

        fn add(&self, what: u64) {
            // SAFETY: for the model.
            self.0.with_mut(|list| unsafe { (*list).push(what) });
        }

        fn last(&self) -> u64 {
            // SAFETY: for the model.
            self.0.with(|list| unsafe { (*list).last().copied().unwrap_or(0) })
        }

        fn list(&self) -> Vec<u64> {
            // SAFETY: for the model.
            self.0.with(|list| unsafe { (*list).clone() })
        }
    }

    /// Adopted, held, retired in any order: one side at a time has the half, and it is finished once.
    #[test]
    fn loom_a_half_is_one_sides_at_a_time_and_finished_once() {
        const FINISHED: u64 = 99;
        loom::model(|| {
            let both = Arc::new((HandOver::new(), Half::new()));
            let thread = {
                let both = both.clone();
                loom::thread::spawn(move || {
                    let (turn, half) = &*both;
                    if turn.adopt() {
                        half.add(1);
                    }
                    // As when it finds a table.
                    if turn.is_live() && turn.is_retired() {
                        half.add(FINISHED);
                        turn.finish();
                    }
                })
            };
            let (turn, half) = &*both;
            if turn.hold() {
                half.add(2);
                turn.give_back();
            }
            if turn.retire().is_setups {
                half.add(FINISHED);
            }
            thread.join().unwrap();
            // The thread found no table since: it finds the next one, or has ended.
            if turn.retire_finally().is_setups {
                half.add(FINISHED);
            }
            let list = half.list();
            assert_eq!(list.iter().filter(|what| **what == FINISHED).count(), 1, "{list:?}");
            assert_eq!(list.last(), Some(&FINISHED), "{list:?}");
        });
    }

    /// A late joiner gets what is kept, and what is published while it is set up: each sample once, in order. As `publish_loan` and
    /// `PublisherCore::connect` do it.
    #[test]
    fn loom_a_late_joiner_gets_each_sample_once() {
        let mut builder = loom::model::Builder::new();
        builder.preemption_bound = Some(4);
        builder.check(|| {
            let both = Arc::new((HandOver::new(), Half::new()));
            let published = Arc::new(AtomicU64::new(0));
            let (mut table, mut tables) = latest(false);
            let thread = {
                let (both, published) = (both.clone(), published.clone());
                loom::thread::spawn(move || {
                    let (turn, half) = &*both;
                    let mut refresh = |sequence_number: u64| {
                        if tables.is_fresh() && *tables.read() && turn.adopt() {
                            (half.last() + 1..=sequence_number).for_each(|number| half.add(number));
                        }
                        turn.is_live()
                    };
                    for number in 1..=2 {
                        if refresh(number - 1) {
                            half.add(number);
                        }
                        published.store(number, Ordering::Release);
                        fence(Ordering::SeqCst);
                        refresh(number);
                    }
                })
            };
            let (turn, half) = &*both;
            let preload = |published: u64| {
                let is_held = turn.hold();
                if is_held {
                    (half.last() + 1..=published).for_each(|number| half.add(number));
                    turn.give_back();
                }
                is_held
            };
            let mut loaded = published.load(Ordering::Acquire);
            assert!(preload(loaded), "nobody has seen it");
            loop {
                table.write(true);
                fence(Ordering::SeqCst);
                let published = published.load(Ordering::Acquire);
                if !turn.is_new() || published == loaded || !preload(published) {
                    break;
                }
                loaded = published;
            }
            thread.join().unwrap();
            assert_eq!(half.list(), [1, 2]);
        });
    }

    /// As above, of a publisher that keeps one sample and overwrites it before setup can give it to the late joiner: that one is taken
    /// over all the same, so that it gets what comes next.
    #[test]
    fn loom_a_late_joiner_is_taken_over_though_nothing_is_left_to_give_it() {
        let mut builder = loom::model::Builder::new();
        builder.preemption_bound = Some(4);
        builder.check(|| {
            let turn = Arc::new(HandOver::new());
            let published = Arc::new(AtomicU64::new(0));
            let (mut table, mut tables) = latest(false);
            let thread = {
                let (turn, published) = (turn.clone(), published.clone());
                loom::thread::spawn(move || {
                    for number in 1..=2 {
                        let _ = tables.is_fresh() && *tables.read() && turn.adopt();
                        published.store(number, Ordering::Release);
                        fence(Ordering::SeqCst);
                        let _ = tables.is_fresh() && *tables.read() && turn.adopt();
                    }
                    tables
                })
            };
            let mut loaded = published.load(Ordering::Acquire);
            loop {
                table.write(true);
                fence(Ordering::SeqCst);
                let now = published.load(Ordering::Acquire);
                if !turn.is_new() || now == loaded || !turn.hold() {
                    break;
                }
                // Whether or not it was still kept.
                loaded = now;
                turn.give_back();
            }
            let mut tables = thread.join().unwrap();
            // When it next publishes.
            let _ = tables.is_fresh() && *tables.read() && turn.adopt();
            assert!(turn.is_live());
        });
    }
}
