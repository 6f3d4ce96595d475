// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rings from four processes, `TAUT_STRESS_RINGS` in number: none may be lost. loom proves the algorithm; this test
//! checks it with the kernel's futex and the machine's memory.
//!
//! Each ringer writes a message's number, rings, and waits until the sampler acknowledged it. So a lost wake-up is
//! visible: the sampler's time-out passes although something is pending. No janitor runs, because it could hide a lost
//! wake-up.

use crate::{Arena, ArenaId, MAIN_BYTES};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::path::Path;
use std::process::{Child, Command};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tautline_rt::clock::{monotonic_ns, nanoseconds, test_time};
use tautline_rt::shm::{Mapping, OwnFile, PeerFile, Region};

const RINGERS: usize = 4;
const DEFAULT_RINGS: u64 = 100_000;
/// Longer than a ringer waits for a core between setting its bit and waking the sampler.
const TIMEOUT: Duration = Duration::from_secs(2);
/// Set for the children: file, ringer's number, rings, seed.
const RINGER: &str = "TAUT_STRESS_RINGER";

#[test]
fn stress_no_ring_is_lost() {
    let rings = std::env::var("TAUT_STRESS_RINGS").map_or(DEFAULT_RINGS, |rings| rings.parse().unwrap());
    let each = rings / RINGERS as u64;
    let seed = tautline_seed::seed();
    let file = OwnFile::create("taut_stress_").unwrap();
    file.claim(0, FILE_BYTES as u64).unwrap();
    let memory = StressMemory::of(Mapping::new(&file, 0, FILE_BYTES, true).unwrap());
    let arena = Arena::create(ArenaId(1), memory.arena.clone());
    let mut ringers: Vec<_> = (0..RINGERS).map(|number| spawn(file.path(), number, each, seed)).collect();

    let timeout_ns = nanoseconds(test_time(TIMEOUT));
    let (mut sleeps, mut lost, mut last) = (0u64, 0u64, [0u64; RINGERS]);
    let start_ns = monotonic_ns();
    while last.iter().any(|last| *last < each) {
        let drained = arena.drain(|slot| {
            let [sent, taken] = memory.words(slot);
            // The drain's Acquire shows at least the message whose ring it took.
            last[slot] = sent.load(Ordering::Relaxed);
            taken.store(last[slot], Ordering::Release);
        });
        if drained == 0 {
            let deadline_ns = monotonic_ns() + timeout_ns;
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
    file.retire();
    println!("rings {} sleeps {sleeps} lost {lost} seconds {seconds:.1} seed {seed}", each * RINGERS as u64);
    assert_eq!(lost, 0);
    assert_eq!(last, [each; RINGERS], "every message was seen");
}

/// The child's part; without its variable it is no test.
#[test]
fn ringer() {
    let Ok(arguments) = std::env::var(RINGER) else { return };
    let (path, numbers) = arguments.split_once(',').unwrap();
    let numbers: Vec<u64> = numbers.split(',').map(|number| number.parse().unwrap()).collect();
    let [number, rings, seed] = numbers[..] else { panic!("{arguments}") };
    let file = PeerFile::open(path.into(), true).unwrap();
    let memory = StressMemory::of(Mapping::new(&file, 0, FILE_BYTES, true).unwrap());
    let arena = Arena::open(ArenaId(1), memory.arena.clone()).unwrap();
    let [sent, taken] = memory.words(number as usize);
    let mut random = StdRng::seed_from_u64(seed ^ number);
    let parent = rustix::process::getppid();
    for message in 1..=rings {
        sent.store(message, Ordering::Relaxed);
        arena.ring(number as usize);
        let mut turns = 0u64;
        while taken.load(Ordering::Acquire) < message {
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

fn spawn(file: &Path, number: usize, rings: u64, seed: u64) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "stress::ringer", "--nocapture"])
        .env(RINGER, format!("{},{number},{rings},{seed}", file.display()))
        .stdout(std::process::Stdio::null())
        .spawn()
        .unwrap()
}

/// An arena, and behind it words of what each ringer and the sampler tell each other: the number sent last, and taken last.
struct StressMemory {
    arena: Region,
    words: Region,
}

const WORDS_AT: usize = MAIN_BYTES.next_multiple_of(64);
const WORDS_BYTES: usize = 4096;
const FILE_BYTES: usize = WORDS_AT + WORDS_BYTES;

impl StressMemory {
    fn of(map: Mapping) -> Self {
        let map = Arc::new(map);
        let part = |at, len| Region::new(&map, at, len).unwrap();
        StressMemory { arena: part(0, MAIN_BYTES), words: part(WORDS_AT, WORDS_BYTES) }
    }

    fn words(&self, ringer: usize) -> &[AtomicU64; 2] {
        // SAFETY: within the region, for there are few ringers; any bytes are valid atomics.
        unsafe { self.words.start().cast::<[AtomicU64; 2]>().add(ringer).as_ref() }
    }
}
