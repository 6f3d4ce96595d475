// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rings from four processes, as many as `TAUT_STRESS_RINGS` says: none may be lost. What loom proves of the algorithm,
//! this tries on the kernel's futex and the machine's memory.
//!
//! Each ringer writes a message's number, rings, and waits until the sampler acknowledged it. So a lost wake-up shows:
//! the sampler's time-out passes although something is pending. No janitor runs, which could hide one.

use super::arena::Arena;
use super::{ArenaId, Link};
use crate::sync::Ordering;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::process::{Child, Command};
use tautline_rt::clock::monotonic_ns;

const RINGERS: usize = 4;
const DEFAULT_RINGS: u64 = 100_000;
const TIMEOUT_NS: u64 = 2_000_000_000;
/// Set for the children: arena, domain, ringer's number, rings, seed.
const RINGER: &str = "TAUT_STRESS_RINGER";

#[test]
fn stress_no_ring_is_lost() {
    let rings = std::env::var("TAUT_STRESS_RINGS").map_or(DEFAULT_RINGS, |rings| rings.parse().unwrap());
    let each = rings / RINGERS as u64;
    let seed: u64 =
        std::env::var("TAUT_STRESS_SEED").map_or_else(|_| rand::random(), |seed| seed.parse().unwrap());
    let domain = 190;
    let arena = Arena::create(domain).unwrap();
    let mut ringers: Vec<_> = (0..RINGERS).map(|number| spawn(&arena, domain, number, each, seed)).collect();

    let (mut sleeps, mut lost, mut last) = (0u64, 0u64, [0u64; RINGERS]);
    let start_ns = monotonic_ns();
    while last.iter().any(|last| *last < each) {
        let drained = arena.bell().drain(|slot| {
            let link = link(&arena, slot);
            // The drain's Acquire shows at least the message whose ring it took.
            last[slot] = link.out.sent.load(Ordering::Relaxed);
            link.taken.0.store(last[slot], Ordering::Release);
        });
        if drained == 0 {
            let deadline_ns = monotonic_ns() + TIMEOUT_NS;
            arena.bell().sleep(Some(deadline_ns));
            sleeps += 1;
            if monotonic_ns() >= deadline_ns {
                lost += u64::from(arena.bell().is_pending());
                // A ringer that failed would leave this loop waiting for ever.
                for ringer in &mut ringers {
                    assert!(
                        ringer.try_wait().unwrap().is_none_or(|status| status.success()),
                        "a ringer failed"
                    );
                }
            }
        }
    }
    let seconds = (monotonic_ns() - start_ns) as f64 / 1e9;
    for mut ringer in ringers {
        assert!(ringer.wait().unwrap().success());
    }
    println!("rings {} sleeps {sleeps} lost {lost} seconds {seconds:.1} seed {seed}", each * RINGERS as u64);
    assert_eq!(lost, 0);
    assert_eq!(last, [each; RINGERS], "every message was seen");
}

/// The child's part; without its variable it is no test.
#[test]
fn ringer() {
    let Ok(arguments) = std::env::var(RINGER) else { return };
    let numbers: Vec<u64> = arguments.split(',').map(|number| number.parse().unwrap()).collect();
    let [arena, domain, number, rings, seed] = numbers[..] else { panic!("{arguments}") };
    let arena = Arena::open(domain as u32, ArenaId(arena)).unwrap();
    let link = link(&arena, number as usize);
    let mut random = StdRng::seed_from_u64(seed ^ number);
    let parent = rustix::process::getppid();
    for message in 1..=rings {
        link.out.sent.store(message, Ordering::Relaxed);
        arena.bell().ring(number as usize);
        let mut turns = 0u64;
        while link.taken.0.load(Ordering::Acquire) < message {
            std::thread::yield_now();
            turns += 1;
            if turns.is_multiple_of(1 << 20) {
                assert_eq!(rustix::process::getppid(), parent, "the sampler's process ended");
            }
        }
        // Now and then all ringers are quiet long enough for the sampler to fall asleep.
        if random.random_ratio(1, 8) {
            let until_ns = monotonic_ns() + random.random_range(0..20_000);
            while monotonic_ns() < until_ns {
                std::thread::yield_now();
            }
        }
    }
}

fn spawn(arena: &Arena, domain: u32, number: usize, rings: u64, seed: u64) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "doorbell::stress::ringer", "--nocapture"])
        .env(RINGER, format!("{},{domain},{number},{rings},{seed}", arena.id().0))
        .stdout(std::process::Stdio::null())
        .spawn()
        .unwrap()
}

fn link(arena: &Arena, slot: usize) -> &Link {
    &arena.links(slot)[0]
}
