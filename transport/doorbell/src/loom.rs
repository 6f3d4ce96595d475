// SPDX-License-Identifier: MIT OR Apache-2.0
//! Every interleaving of ringers and a sampler: no ring is lost, whatever else the memory model allows.
//! Run by `cargo xtask test` (`RUSTFLAGS="--cfg taut_loom" cargo test -p tautline-doorbell --lib loom`).

use crate::hot::{Bell, BellBit, BellRouting, Flags, Woken, drain_bits, mark_in};
use crate::places::FreePlaces;
use crate::sync::AtomicU64;
use crate::{Signal, Wakeable};
use loom::cell::UnsafeCell;
use loom::sync::Arc;
use loom::sync::atomic::{AtomicU32, Ordering, fence};
use loom::thread;

/// Starts a thread that does `what` with a clone of `shared`.
fn spawn_with<S: Clone + 'static, T: 'static>(
    shared: &S,
    what: impl FnOnce(S) -> T + 'static,
) -> thread::JoinHandle<T> {
    let shared = shared.clone();
    thread::spawn(move || what(shared))
}

/// The sampler, which takes no notice of slots, sleeps until `is_done`.
fn sleep_until<const WORDS: usize>(bell: &Bell<WORDS>, is_done: impl Fn() -> bool) {
    while !is_done() {
        if bell.drain(|_| {}) == 0 {
            bell.sleep(None);
        }
    }
}

/// The sampler sleeps until it has seen `wanted` slots. A lost wake-up would be a deadlock, which loom reports.
fn sample_until<const WORDS: usize>(bell: &Bell<WORDS>, wanted: u64) {
    let mut seen = 0u64;
    while seen != wanted {
        if bell.drain(|slot| seen |= 1 << slot) == 0 {
            bell.sleep(None);
        }
    }
}

fn model(f: impl Fn() + Sync + Send + 'static) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(3);
    builder.check(f);
}

#[test]
fn loom_one_ring_is_never_lost() {
    model(|| {
        let bell = Arc::new(Bell::<1>::new());
        let ringer = spawn_with(&bell, |bell| bell.ring(1));
        sample_until(&bell, 0b10);
        ringer.join().unwrap();
    });
}

#[test]
fn loom_two_ringers_of_different_slots() {
    model(|| {
        let bell = Arc::new(Bell::<1>::new());
        let ringers = [0usize, 1].map(|slot| spawn_with(&bell, move |bell| bell.ring(slot)));
        sample_until(&bell, 0b11);
        ringers.into_iter().for_each(|ringer| ringer.join().unwrap());
    });
}

#[test]
fn loom_the_second_ring_of_a_slot_shows_the_second_message() {
    // What is written before a ring is visible after the drain that took the bit, also when bits coalesce.
    model(|| {
        let bell = Arc::new(Bell::<1>::new());
        let written = Arc::new(AtomicU32::new(0));
        let ringer = {
            let (bell, written) = (bell.clone(), written.clone());
            thread::spawn(move || {
                for message in 1..=2 {
                    written.store(message, Ordering::Relaxed);
                    bell.ring(0);
                }
            })
        };
        sleep_until(&bell, || written.load(Ordering::Relaxed) == 2);
        ringer.join().unwrap();
    });
}

#[test]
fn loom_slots_that_are_marked_together_need_one_wake() {
    model(|| {
        let bell = Arc::new(Bell::<1>::new());
        let ringer = spawn_with(&bell, |bell| {
            bell.mark(0);
            bell.mark(1);
            fence(Ordering::SeqCst);
            bell.wake_if_sleeping(0, &Woken::new());
        });
        sample_until(&bell, 0b11);
        ringer.join().unwrap();
    });
}

/// Rings as a process does that remembers from which sleep it has woken the sampler.
fn ring(bell: &Bell<1>, slot: usize, woken: &Woken) {
    bell.mark(slot);
    fence(Ordering::SeqCst);
    bell.wake_if_sleeping(0, woken);
}

#[test]
fn loom_a_process_that_has_woken_the_sampler_need_not_do_so_again() {
    // The sampler may have run and begun another sleep between the two rings, or between a ring's look at the state and its wake.
    model(|| {
        let bell = Arc::new(Bell::<1>::new());
        let ringer = spawn_with(&bell, |bell| {
            let woken = Woken::new();
            ring(&bell, 0, &woken);
            ring(&bell, 1, &woken);
        });
        sample_until(&bell, 0b11);
        ringer.join().unwrap();
    });
}

#[test]
fn loom_threads_that_share_a_wake_do_not_rely_on_one_that_is_not_over() {
    model(|| {
        let (bell, woken) = (Arc::new(Bell::<1>::new()), Arc::new(Woken::new()));
        let ringers = [0usize, 1].map(|slot| {
            let (bell, woken) = (bell.clone(), woken.clone());
            thread::spawn(move || ring(&bell, slot, &woken))
        });
        sample_until(&bell, 0b11);
        ringers.into_iter().for_each(|ringer| ringer.join().unwrap());
    });
}

/// Queues a sample as a publisher does, and rings if its reader wants that of one of its participant (`is_own`) or of another. Returns
/// whether it has.
fn publish(bell: &Bell<1>, flags: &Flags, queued: &AtomicU32, sample: u32, is_own: bool) -> bool {
    queued.store(sample, Ordering::Release);
    fence(Ordering::SeqCst);
    let rings = flags.wants_ring(is_own);
    if rings {
        bell.ring(0);
    }
    rings
}

#[test]
fn loom_a_sample_that_nobody_rang_for_is_seen_before_its_reader_sleeps() {
    // Two samples, for the first may come while the reader still drains and the second when it does no longer.
    model(|| {
        let bell = Arc::new(Bell::<1>::new());
        let flags = Arc::new(Flags::new());
        let queued = Arc::new(AtomicU32::new(0));
        flags.start_draining();
        let publisher = {
            let (bell, flags, queued) = (bell.clone(), flags.clone(), queued.clone());
            thread::spawn(move || {
                (1..=2).for_each(|sample| _ = publish(&bell, &flags, &queued, sample, false))
            })
        };
        let all = || queued.load(Ordering::Acquire) == 2;
        if !all() {
            flags.stop_draining();
            sleep_until(&bell, all);
        }
        publisher.join().unwrap();
    });
}

#[test]
fn loom_a_sample_is_seen_by_a_reader_that_no_longer_polls_by_itself() {
    model(|| {
        let (bell, flags) = (Arc::new(Bell::<1>::new()), Arc::new(Flags::new()));
        let queued = Arc::new(AtomicU32::new(0));
        flags.set_quiet(true);
        let publisher = {
            let (bell, flags, queued) = (bell.clone(), flags.clone(), queued.clone());
            thread::spawn(move || publish(&bell, &flags, &queued, 1, false))
        };
        flags.set_quiet(false);
        sleep_until(&bell, || queued.load(Ordering::Acquire) == 1);
        publisher.join().unwrap();
    });
}

#[test]
fn loom_a_sample_is_seen_by_whoever_published_it_or_by_who_asks_for_that() {
    model(|| {
        let (bell, flags) = (Arc::new(Bell::<1>::new()), Arc::new(Flags::new()));
        let queued = Arc::new(AtomicU32::new(0));
        let publisher = {
            let (bell, flags, queued) = (bell.clone(), flags.clone(), queued.clone());
            // Whoever does not ring looks itself.
            thread::spawn(move || !publish(&bell, &flags, &queued, 1, true))
        };
        flags.set_own_look(true);
        let is_seen = queued.load(Ordering::Acquire) == 1;
        let has_looked = publisher.join().unwrap();
        assert!(is_seen || has_looked || bell.is_pending());
    });
}

#[test]
fn loom_a_ring_in_a_window_is_never_lost() {
    // Two ringers of one window: the bits of both may be taken for the first one's mark.
    model(|| {
        let bell = Arc::new(Bell::<1>::new());
        let window = Arc::new([AtomicU64::new(0)]);
        let ringers = [0usize, 1].map(|slot| {
            let (bell, window) = (bell.clone(), window.clone());
            thread::spawn(move || {
                mark_in(&window[..], slot);
                bell.mark_window(3);
                fence(Ordering::SeqCst);
                bell.wake_if_sleeping(0, &Woken::new());
            })
        });
        let mut seen = 0u64;
        while seen != 0b11 {
            let windows = bell.take_windows();
            assert!(windows == 0 || windows == 1 << 3);
            if windows == 0 || drain_bits(&window[..], |slot| seen |= 1 << slot) == 0 {
                bell.sleep(None);
            }
        }
        ringers.into_iter().for_each(|ringer| ringer.join().unwrap());
    });
}

#[test]
fn loom_a_sample_is_seen_by_a_reader_that_changes_its_bell() {
    // As a subscription that a directly woken thread begins to poll.
    model(|| {
        let (own, sampler) = (Arc::new(Bell::<1>::new()), Arc::new(Bell::<1>::new()));
        let route = Arc::new(BellRouting::new());
        let queued = Arc::new(AtomicU32::new(0));
        let publisher = {
            let (own, sampler, route, queued) = (own.clone(), sampler.clone(), route.clone(), queued.clone());
            thread::spawn(move || {
                queued.store(1, Ordering::Release);
                fence(Ordering::SeqCst);
                match route.get() {
                    None => sampler.ring(0),
                    Some(BellBit { bit, .. }) => own.ring(bit),
                }
            })
        };
        route.set(Some(BellBit { thread: 0, bit: 5 }));
        sleep_until(&own, || queued.load(Ordering::Acquire) == 1);
        publisher.join().unwrap();
    });
}

#[test]
fn loom_a_wake_during_a_turn_is_not_lost_with_those_before_it() {
    // What `ThreadBell::wait` does: the rings that its own turn caused are taken back, and what they tell of is looked at after.
    model(|| {
        let bell = Arc::new(Bell::<1>::new());
        let written = Arc::new(AtomicU32::new(0));
        let others = [1, 2].map(|bit| {
            let (bell, written) = (bell.clone(), written.clone());
            thread::spawn(move || {
                written.fetch_or(bit, Ordering::Relaxed);
                bell.ring(63);
            })
        });
        while written.load(Ordering::Relaxed) != 3 {
            while bell.drain(|_| {}) == 0 {
                bell.sleep(None);
            }
            bell.take(63);
        }
        others.into_iter().for_each(|other| other.join().unwrap());
    });
}

#[test]
fn loom_a_killed_ringer_is_rescued() {
    // A process killed anywhere between setting the bit and waking: the rescue of a low-priority thread completes its
    // ring. Nobody else rings, or that would wake the sampler instead.
    for before_wake in [false, true] {
        model(move || {
            let bell = Arc::new(Bell::<1>::new());
            let rescuer = spawn_with(&bell, move |bell| {
                bell.ring_and_die(0, before_wake);
                bell.rescue();
            });
            sample_until(&bell, 0b1);
            rescuer.join().unwrap();
        });
    }
}

#[test]
fn loom_a_ringer_that_is_stuck_before_its_wake_holds_up_nobody_else() {
    model(|| {
        let bell = Arc::new(Bell::<1>::new());
        let stuck = spawn_with(&bell, |bell| bell.ring_and_die(0, true));
        let other = spawn_with(&bell, |bell| bell.ring(1));
        let mut seen = 0u64;
        while seen & 0b10 == 0 {
            if bell.drain(|slot| seen |= 1 << slot) == 0 {
                bell.sleep(None);
            }
        }
        stuck.join().unwrap();
        other.join().unwrap();
    });
}

#[test]
fn loom_a_place_is_one_owners_at_a_time() {
    /// What belongs to a place: loom reports it if two threads touch it at once, or one before the other's is seen.
    struct Owned(UnsafeCell<u32>);
    // SAFETY: for the model; loom checks the accesses.
    unsafe impl Sync for Owned {}
    // SAFETY: as above.
    unsafe impl Send for Owned {}

    model(|| {
        let places = Arc::new(FreePlaces::new(2));
        let owned = Arc::new([(); 2].map(|()| Owned(UnsafeCell::new(0))));
        let claim_each = {
            let (places, owned) = (places.clone(), owned.clone());
            move || {
                for _ in 0..2 {
                    // None if the other thread has just claimed each that was free.
                    if let Some(place) = places.take() {
                        // SAFETY: the place is this thread's.
                        owned[place].0.with_mut(|count| unsafe { *count += 1 });
                        places.give_back(place);
                    }
                }
            }
        };
        let other = thread::spawn(claim_each.clone());
        claim_each();
        other.join().unwrap();
        let both = [places.take(), places.take(), places.take()];
        assert!(both.iter().flatten().count() == 2 && both[2].is_none(), "both are free: {both:?}");
    });
}

/// A wait set as an RMW has it: it waits for a flag again and again, attached to it meanwhile only.
struct WaitSet(Bell<1>);

impl Wakeable for WaitSet {
    fn wake(&self) {
        self.0.ring(0);
    }
}

#[test]
fn loom_a_flag_ends_each_wait_for_it() {
    model(|| {
        let (signal, set) = (Arc::new(Signal::default()), Arc::new(WaitSet(Bell::new())));
        let written = Arc::new(AtomicU32::new(0));
        let setter = {
            let (signal, written) = (signal.clone(), written.clone());
            thread::spawn(move || {
                for message in 1..=2 {
                    written.store(message, Ordering::Relaxed);
                    signal.set();
                }
            })
        };
        // What was written before the flag was set is seen by who takes it: also of two that were one.
        while written.load(Ordering::Relaxed) != 2 {
            // SAFETY: it lives to the end of the model.
            assert!(unsafe { signal.attach(&*set) });
            sleep_until(&set.0, || signal.is_set());
            signal.detach(&*set);
            assert!(signal.take());
        }
        setter.join().unwrap();
    });
}
