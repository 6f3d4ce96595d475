// SPDX-License-Identifier: MIT OR Apache-2.0
//! Every interleaving of ringers and a sampler: no ring is lost, whatever else the memory model allows.
//! Run by `cargo xtask test` (`RUSTFLAGS="--cfg taut_loom" cargo test -p tautline-transport --release loom`).

use super::hot::Bell;
use loom::sync::Arc;
use loom::sync::atomic::{AtomicU32, Ordering};
use loom::thread;

/// The sampler sleeps until it has seen `wanted` slots. A lost wake-up would be a deadlock, which loom reports.
fn sample_until(bell: &Bell, wanted: u64) {
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
        let bell = Arc::new(Bell::new());
        let ringer = {
            let bell = bell.clone();
            thread::spawn(move || bell.ring(1))
        };
        sample_until(&bell, 0b10);
        ringer.join().unwrap();
    });
}

#[test]
fn loom_two_ringers_of_different_slots() {
    model(|| {
        let bell = Arc::new(Bell::new());
        let ringers = [0usize, 1].map(|slot| {
            let bell = bell.clone();
            thread::spawn(move || bell.ring(slot))
        });
        sample_until(&bell, 0b11);
        for ringer in ringers {
            ringer.join().unwrap();
        }
    });
}

#[test]
fn loom_the_second_ring_of_a_slot_shows_the_second_message() {
    // What is written before a ring is visible after the drain that took the bit, also when bits coalesce.
    model(|| {
        let bell = Arc::new(Bell::new());
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
        while written.load(Ordering::Relaxed) != 2 {
            if bell.drain(|_| {}) == 0 {
                bell.sleep(None);
            }
        }
        ringer.join().unwrap();
    });
}

#[test]
fn loom_a_killed_ringer_is_rescued() {
    // A process killed anywhere between setting the bit and waking: the rescue of a low-priority thread completes its
    // ring. Nobody else rings, or that would wake the sampler instead.
    for before_wake in [false, true] {
        model(move || {
            let bell = Arc::new(Bell::new());
            let rescuer = {
                let bell = bell.clone();
                thread::spawn(move || {
                    bell.ring_and_die(0, before_wake);
                    bell.rescue();
                })
            };
            sample_until(&bell, 0b1);
            rescuer.join().unwrap();
        });
    }
}

#[test]
fn loom_a_ringer_that_is_stuck_before_its_wake_holds_up_nobody_else() {
    model(|| {
        let bell = Arc::new(Bell::new());
        let stuck = {
            let bell = bell.clone();
            thread::spawn(move || bell.ring_and_die(0, true))
        };
        let other = {
            let bell = bell.clone();
            thread::spawn(move || bell.ring(1))
        };
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
