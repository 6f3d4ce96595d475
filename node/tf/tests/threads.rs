// SPDX-License-Identifier: MIT OR Apache-2.0
//! One writer and several readers: what is found is a function of its stamp, whatever the writer does meanwhile.

mod support;

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use support::{Random, at_x, set, set_static, yaw};
use tautline_tf::{Buffer, Limits, LookupError, Time, Transform, WaitFor, Writer};

const SETS: i64 = if cfg!(miri) { 100 } else { 200_000 };

/// One sixth of a turn in 1 ms, so that it is interpolated exactly; `run` tells apart what is before and after a `clear`.
fn pose(stamp_ns: i64, run: i64) -> Transform {
    let turns = stamp_ns as f64 / 6e6;
    Transform::new([stamp_ns as f64 * 1e-3, run as f64, 0.0], yaw(std::f64::consts::TAU * turns))
}

/// Stops the readers, also when the writer fails.
struct Done<'d>(&'d AtomicBool);

impl Drop for Done<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Release);
    }
}

fn assert_pose(found: &Transform, stamp_ns: i64) {
    let wanted = pose(stamp_ns, 0);
    let turned = (0..4).map(|k| found.rotation[k] * wanted.rotation[k]).sum::<f64>().abs();
    assert!((found.translation[0] - wanted.translation[0]).abs() < 1e-6, "{found:?} at {stamp_ns}");
    assert!((turned - 1.0).abs() < 1e-9, "{found:?} at {stamp_ns}");
}

#[test]
fn each_transform_is_that_of_its_stamp() {
    // A short ring, so that readers see samples leave it.
    let limits = Limits { frames: 8, samples: 8, cache_time: Duration::from_secs(1), waiters: 0 };
    let (mut writer, buffer) = Buffer::new(limits).unwrap();
    set_static(&mut writer, "map", "odom", at_x(0.0)).unwrap();
    for stamp_ns in [0, 1_000_000] {
        set(&mut writer, "odom", "base", stamp_ns, pose(stamp_ns, 0)).unwrap();
        set(&mut writer, "odom", "other", stamp_ns, pose(stamp_ns, 0)).unwrap();
    }
    let (mut random, mut seeds) = (Random::new(), Random::new());
    let done = AtomicBool::new(false);
    let found = std::thread::scope(|scope| {
        let readers = [0, 1].map(|_| {
            let (buffer, done, mut random) = (buffer.clone(), &done, Random::seeded(seeds.next()));
            scope.spawn(move || {
                let (base, map) = (buffer.frame("base").unwrap(), buffer.frame("map").unwrap());
                let (mut found, mut missed, mut last_ns) = (0_u64, 0_u64, 0);
                while !done.load(Ordering::Acquire) || found == 0 {
                    // Overtaken is right here, if others use the processors: a ring is 8 samples.
                    if let Ok(latest) = buffer.lookup(map, base, Time::Latest) {
                        let stamp_ns = latest.stamp_ns.unwrap();
                        assert!(stamp_ns >= last_ns, "{stamp_ns} after {last_ns}");
                        last_ns = stamp_ns;
                        assert_pose(&latest.transform, stamp_ns);
                    }
                    let asked_ns = last_ns - random.below(8_000_000) as i64;
                    match buffer.lookup(map, base, Time::At(asked_ns)) {
                        Ok(at) => {
                            assert_eq!(at.stamp_ns, Some(asked_ns));
                            assert_pose(&at.transform, asked_ns);
                            found += 1;
                        }
                        Err(LookupError::Extrapolation { asked_ns: asked, .. }) if asked == asked_ns => {
                            missed += 1
                        }
                        Err(LookupError::Overtaken { .. }) => missed += 1,
                        Err(error) => panic!("{error}"),
                    }
                    // Both move alike: nothing is between them, at any time that both have.
                    if let Ok(at) = buffer.lookup("other", "base", Time::Latest) {
                        assert!(at.transform.translation.iter().all(|x| x.abs() < 1e-6), "{at:?}");
                    }
                }
                (found, missed)
            })
        });
        let stop = Done(&done);
        for n in 2..SETS {
            let late = random.below(4) == 0;
            let stamp_ns = n * 1_000_000;
            for child in ["base", "other"] {
                set(&mut writer, "odom", child, stamp_ns, pose(stamp_ns, 0)).unwrap();
                if late {
                    let stamp_ns = stamp_ns - random.below(2_000_000) as i64;
                    // Refused if that one is there, or next to leave.
                    let _ = set(&mut writer, "odom", child, stamp_ns, pose(stamp_ns, 0));
                }
            }
        }
        drop(stop);
        readers.map(|reader| reader.join().unwrap())
    });
    println!("found and missed: {found:?}, late: {}", buffer.counters().out_of_order);
}

#[test]
fn each_side_may_move_to_another_thread_and_buffers_are_shared() {
    fn sent<T: Send>() {}
    fn shared<T: Clone + Send + Sync>() {}
    sent::<Writer>();
    sent::<WaitFor>();
    sent::<LookupError>();
    shared::<Buffer>();
}

#[test]
fn nothing_is_found_that_is_half_from_before_a_clear() {
    let limits = Limits { frames: 8, samples: 8, cache_time: Duration::from_secs(1), waiters: 0 };
    let (mut writer, buffer) = Buffer::new(limits).unwrap();
    let (done, found) = (AtomicBool::new(false), AtomicU64::new(0));
    std::thread::scope(|scope| {
        let reader = scope.spawn(|| {
            while !done.load(Ordering::Acquire) {
                for time in [Time::At(1_500_000), Time::Latest] {
                    match buffer.lookup("left", "right", time) {
                        Ok(at) => {
                            // Both are of the same run, if nothing is between them in y.
                            assert_eq!(at.transform.translation[1], 0.0, "{at:?}");
                            found.fetch_add(1, Ordering::Relaxed);
                        }
                        Err(LookupError::Cycle { .. } | LookupError::InvalidArgument { .. }) => panic!(),
                        Err(_) => (),
                    }
                }
            }
        });
        let stop = Done(&done);
        // Time begins again and again.
        for run in 0.. {
            if run >= SETS / 4 && (found.load(Ordering::Relaxed) > 0 || reader.is_finished()) {
                break;
            }
            for stamp_ns in [1_000_000, 2_000_000] {
                for child in ["left", "right"] {
                    let moved = Transform::new([0.0, run as f64, 0.0], yaw(0.0));
                    set(&mut writer, "map", child, stamp_ns, moved).unwrap();
                }
            }
            writer.clear();
        }
        drop(stop);
        reader.join().unwrap();
    });
    println!("found: {found:?}");
}
