// SPDX-License-Identifier: MIT OR Apache-2.0
//! What tf2 documents, case by case. Stamps are in nanoseconds.

mod support;

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4};
use std::time::Duration;

use support::{assert_near, at_x, matrix, set, set_static, yaw};
use tautline_tf::{
    Buffer, Kind, Limits, LookupError, SetError, Stamped, Time, Transform, TransformStamped, Writer,
};

fn buffer() -> (Writer, Buffer) {
    Buffer::new(Limits { frames: 16, samples: 128, ..Limits::default() }).unwrap()
}

fn x(found: Result<Stamped, LookupError>) -> f64 {
    found.unwrap().transform.translation[0]
}

#[test]
fn interpolates_between_two_samples_and_is_exact_at_them() {
    let (mut writer, buffer) = buffer();
    set(&mut writer, "map", "base", 200, Transform::new([1.0, -2.0, 0.0], yaw(0.0))).unwrap();
    set(&mut writer, "map", "base", 300, Transform::new([3.0, 2.0, 8.0], yaw(FRAC_PI_2))).unwrap();
    for (stamp_ns, wanted) in [
        (200, Transform::new([1.0, -2.0, 0.0], yaw(0.0))),
        (225, Transform::new([1.5, -1.0, 2.0], yaw(FRAC_PI_4 / 2.0))),
        (250, Transform::new([2.0, 0.0, 4.0], yaw(FRAC_PI_4))),
        (300, Transform::new([3.0, 2.0, 8.0], yaw(FRAC_PI_2))),
    ] {
        let found = buffer.lookup("map", "base", Time::At(stamp_ns)).unwrap();
        assert_eq!(found.stamp_ns, Some(stamp_ns));
        assert_near(&matrix(&found.transform), &matrix(&wanted));
        let back = buffer.lookup("base", "map", Time::At(stamp_ns)).unwrap();
        assert_near(&matrix(&back.transform), &matrix(&wanted.inverse()));
    }
}

#[test]
fn does_not_extrapolate() {
    let (mut writer, buffer) = buffer();
    let span = |time_ns| match buffer.lookup("map", "base", Time::At(time_ns)) {
        Err(LookupError::Extrapolation { oldest_ns, newest_ns, asked_ns, .. }) if asked_ns == time_ns => {
            Some((oldest_ns, newest_ns))
        }
        found => {
            found.unwrap();
            None
        }
    };
    set(&mut writer, "map", "base", 2, at_x(2.0)).unwrap();
    assert_eq!([1, 2, 4].map(span), [Some((2, 2)), None, Some((2, 2))]);
    set(&mut writer, "map", "base", 3, at_x(3.0)).unwrap();
    assert_eq!([1, 2, 3, 4].map(span), [Some((2, 3)), None, None, Some((2, 3))]);
}

#[test]
fn the_latest_common_time_is_the_oldest_of_the_newest_on_the_way() {
    let (mut writer, buffer) = buffer();
    for stamp_ns in 0..=10 {
        set(&mut writer, "map", "odom", stamp_ns * 5, at_x(100.0)).unwrap();
        set(&mut writer, "odom", "base", stamp_ns, at_x(stamp_ns as f64)).unwrap();
        set(&mut writer, "base", "arm", stamp_ns * 2, at_x(0.5)).unwrap();
    }
    set_static(&mut writer, "arm", "tool", at_x(0.25)).unwrap();
    for (target, source, stamp_ns, wanted) in [
        ("map", "tool", 10, 110.75),
        ("base", "tool", 20, 0.75),
        ("map", "odom", 50, 100.0),
        ("tool", "odom", 10, -10.75),
    ] {
        let found = buffer.lookup(target, source, Time::Latest).unwrap();
        assert_eq!(
            (found.stamp_ns, found.transform.translation[0]),
            (Some(stamp_ns), wanted),
            "{target} {source}"
        );
    }
    let fixed = buffer.lookup("tool", "arm", Time::Latest).unwrap();
    assert_eq!((fixed.stamp_ns, fixed.transform.translation[0]), (None, -0.25));
    // Stands still for the newest of others: then there is no common time.
    set(&mut writer, "odom", "old", 0, at_x(0.0)).unwrap();
    for stamp_ns in 11..200 {
        set(&mut writer, "odom", "base", stamp_ns, at_x(0.0)).unwrap();
    }
    let error = buffer.lookup("old", "base", Time::Latest).unwrap_err();
    assert!(matches!(error, LookupError::Extrapolation { asked_ns: 0, oldest_ns: 72, .. }), "{error}");
}

#[test]
fn static_transforms_hold_at_every_time_and_the_last_one_counts() {
    let (mut writer, buffer) = buffer();
    set_static(&mut writer, "base", "laser", at_x(1.0)).unwrap();
    for time in [Time::At(i64::MIN), Time::At(0), Time::At(i64::MAX), Time::Latest] {
        assert_eq!(x(buffer.lookup("base", "laser", time)), 1.0);
    }
    set_static(&mut writer, "base", "laser", at_x(2.0)).unwrap();
    assert_eq!(x(buffer.lookup("base", "laser", Time::At(5))), 2.0);
    // Not even 1000 times at one stamp.
    (0..1_000).for_each(|n| set_static(&mut writer, "base", "laser", at_x(f64::from(n))).unwrap());
    assert_eq!(x(buffer.lookup("base", "laser", Time::At(5))), 999.0);
}

#[test]
fn a_frame_that_changes_its_kind_forgets_what_it_had() {
    let (mut writer, buffer) = buffer();
    set(&mut writer, "base", "laser", 10, at_x(1.0)).unwrap();
    set_static(&mut writer, "base", "laser", at_x(2.0)).unwrap();
    assert_eq!(x(buffer.lookup("base", "laser", Time::At(10))), 2.0);
    set(&mut writer, "base", "laser", 5, at_x(3.0)).unwrap();
    assert_eq!(x(buffer.lookup("base", "laser", Time::At(5))), 3.0);
    assert!(!buffer.can_transform("base", "laser", Time::At(10)));
}

#[test]
fn nothing_is_interpolated_from_one_parent_to_another() {
    let (mut writer, buffer) = buffer();
    set_static(&mut writer, "world", "table", at_x(10.0)).unwrap();
    set_static(&mut writer, "world", "hand", at_x(20.0)).unwrap();
    set(&mut writer, "table", "cup", 100, at_x(1.0)).unwrap();
    set(&mut writer, "hand", "cup", 200, at_x(2.0)).unwrap();
    for (stamp_ns, wanted) in [(100, 11.0), (150, 11.0), (199, 11.0), (200, 22.0)] {
        assert_eq!(x(buffer.lookup("world", "cup", Time::At(stamp_ns))), wanted);
    }
}

#[test]
fn what_comes_late_is_put_in_its_place() {
    let (mut writer, buffer) = buffer();
    // Backwards, as tf2's test of repeatability.
    for stamp_ns in (0..100).rev() {
        set(&mut writer, "a", "b", stamp_ns, at_x(stamp_ns as f64 * 2.0)).unwrap();
    }
    for stamp_ns in 0..100 {
        assert_eq!(x(buffer.lookup("a", "b", Time::At(stamp_ns))), stamp_ns as f64 * 2.0);
    }
    assert_eq!(buffer.counters().out_of_order, 99);
    assert_eq!(x(buffer.lookup("a", "b", Time::Latest)), 198.0);
}

#[test]
fn the_cache_ends_at_the_cache_time_and_at_the_ring() {
    let limits = Limits { frames: 2, samples: 4, cache_time: Duration::from_nanos(10), waiters: 0 };
    let (mut writer, buffer) = Buffer::new(limits).unwrap();
    for stamp_ns in [0, 5, 10] {
        set(&mut writer, "a", "b", stamp_ns, at_x(0.0)).unwrap();
    }
    assert!(buffer.can_transform("a", "b", Time::At(0)));
    set(&mut writer, "a", "b", 11, at_x(0.0)).unwrap();
    assert!(!buffer.can_transform("a", "b", Time::At(4)) && buffer.can_transform("a", "b", Time::At(5)));
    assert!(matches!(set(&mut writer, "a", "b", 0, at_x(0.0)), Err(SetError::Old { above_ns: 0, .. })));
    // Takes the place of 0, and the next one that of 5.
    set(&mut writer, "a", "b", 7, at_x(0.0)).unwrap();
    assert!(buffer.can_transform("a", "b", Time::At(5)));
    set(&mut writer, "a", "b", 12, at_x(0.0)).unwrap();
    assert!(!buffer.can_transform("a", "b", Time::At(6)) && buffer.can_transform("a", "b", Time::At(7)));
    // 10 would have to leave for 8, and 8 with it.
    assert!(matches!(set(&mut writer, "a", "b", 8, at_x(0.0)), Err(SetError::Old { above_ns: 10, .. })));
    assert_eq!(buffer.counters().old, 2);
}

#[test]
fn what_is_older_than_what_has_left_the_ring_has_left_with_it() {
    let limits = Limits { frames: 2, samples: 4, waiters: 0, ..Limits::default() };
    let (mut writer, buffer) = Buffer::new(limits).unwrap();
    // 100 and 200 leave; 150 and 120 were set after 200, are in the ring, and do not enclose anything any more.
    for stamp_ns in [100, 200, 150, 120, 300, 400] {
        set(&mut writer, "a", "b", stamp_ns, at_x(stamp_ns as f64)).unwrap();
    }
    for (asked_ns, found) in
        [(110, false), (130, false), (160, false), (250, false), (300, true), (350, true)]
    {
        let at = buffer.lookup("a", "b", Time::At(asked_ns));
        assert_eq!(at.is_ok(), found, "{asked_ns}");
        if let Err(error) = at {
            assert!(
                matches!(error, LookupError::Extrapolation { oldest_ns: 300, newest_ns: 400, .. }),
                "{error}"
            );
        }
    }
    assert_eq!(buffer.frames()[1].stamps_ns, Some((300, 400)));
}

#[test]
fn through_a_fixed_frame_from_time_to_time() {
    let (mut writer, buffer) = buffer();
    for stamp_ns in 0..=10 {
        set(&mut writer, "world", "car", stamp_ns, at_x(stamp_ns as f64)).unwrap();
    }
    set_static(&mut writer, "car", "wheel", at_x(0.5)).unwrap();
    // The wheel of time 2, seen from the car of time 8.
    let seen = buffer.lookup_full("car", Time::At(8), "wheel", Time::At(2), "world").unwrap();
    assert_eq!((seen.stamp_ns, seen.transform.translation[0]), (Some(8), -5.5));
    let latest = buffer.lookup_full("car", Time::Latest, "wheel", Time::At(2), "world").unwrap();
    assert_eq!((latest.stamp_ns, latest.transform.translation[0]), (Some(10), -7.5));
    let error = buffer.lookup_full("car", Time::At(8), "wheel", Time::At(20), "world").unwrap_err();
    assert!(matches!(error, LookupError::Extrapolation { asked_ns: 20, .. }), "{error}");
}

#[test]
fn what_is_above_the_common_frame_does_not_matter() {
    let (mut writer, buffer) = buffer();
    set(&mut writer, "map", "base", 1, at_x(1.0)).unwrap();
    set(&mut writer, "base", "left", 50, at_x(3.0)).unwrap();
    set(&mut writer, "base", "right", 50, at_x(-3.0)).unwrap();
    assert_eq!(x(buffer.lookup("right", "left", Time::At(50))), 6.0);
    assert_eq!(x(buffer.lookup("right", "left", Time::Latest)), 6.0);
    assert_eq!(x(buffer.lookup("left", "base", Time::At(50))), -3.0);
    assert!(!buffer.can_transform("map", "left", Time::At(50)));
}

#[test]
fn a_frame_is_where_it_is_at_any_time() {
    let (mut writer, buffer) = buffer();
    set(&mut writer, "map", "base", 7, at_x(1.0)).unwrap();
    let at = |time| buffer.lookup("base", "base", time).unwrap();
    assert_eq!(at(Time::At(99)), Stamped { stamp_ns: Some(99), transform: Transform::IDENTITY });
    assert_eq!(at(Time::Latest), Stamped { stamp_ns: Some(7), transform: Transform::IDENTITY });
    assert_eq!(buffer.lookup("map", "map", Time::Latest).unwrap().stamp_ns, None);
}

#[test]
fn clear_forgets_all_but_static_transforms() {
    let (mut writer, buffer) = buffer();
    set(&mut writer, "map", "base", 1_000, at_x(1.0)).unwrap();
    set_static(&mut writer, "base", "laser", at_x(2.0)).unwrap();
    writer.clear();
    assert!(matches!(buffer.lookup("map", "base", Time::Latest), Err(LookupError::Connectivity { .. })));
    assert_eq!(x(buffer.lookup("base", "laser", Time::At(5))), 2.0);
    // Long before what there was.
    set(&mut writer, "map", "base", -9_000_000_000_000, at_x(3.0)).unwrap();
    assert_eq!(x(buffer.lookup("map", "laser", Time::Latest)), 5.0);
    assert_eq!(buffer.counters().cleared, 1);
}

#[test]
fn slashes_in_front_are_taken_off() {
    let (mut writer, buffer) = buffer();
    set(&mut writer, "/map", "/base", 1, at_x(1.0)).unwrap();
    assert_eq!(buffer.frame("base"), buffer.frame("/base"));
    assert_eq!(x(buffer.lookup("map", "/base", Time::Latest)), 1.0);
    assert!(matches!(set(&mut writer, "/a", "a", 1, at_x(1.0)), Err(SetError::SelfTransform { .. })));
}

#[test]
fn rotations_are_taken_within_a_tolerance_and_normalised() {
    let (mut writer, buffer) = buffer();
    let mut try_w =
        |stamp_ns, w| set(&mut writer, "a", "b", stamp_ns, Transform::new([0.0; 3], [0.0, 0.0, 0.0, w]));
    for (stamp_ns, w) in [(1, 1.0), (2, -1.0), (3, 1.00498), (4, 0.99499)] {
        try_w(stamp_ns, w).unwrap();
        assert_eq!(
            buffer.lookup("a", "b", Time::Latest).unwrap().transform.rotation,
            [0.0, 0.0, 0.0, w.signum()]
        );
    }
    for w in [0.0, 1.00499, 0.99498, 1e300] {
        assert!(matches!(try_w(9, w), Err(SetError::Denormalized { .. })), "{w}");
    }
}

#[test]
fn frames_are_listed_with_parent_span_and_rate() {
    let (mut writer, buffer) = buffer();
    for n in 0..5 {
        set(&mut writer, "map", "base", n * 500_000_000, at_x(0.0)).unwrap();
    }
    set_static(&mut writer, "base", "it's", at_x(0.0)).unwrap();
    let frames = buffer.frames();
    let parents: Vec<_> =
        frames.iter().map(|info| info.parent.map(|(parent, kind)| (parent.to_string(), kind))).collect();
    assert_eq!(parents, [None, Some(("map".into(), Kind::Dynamic)), Some(("base".into(), Kind::Static))]);
    assert_eq!(
        (frames[1].stamps_ns, frames[1].samples, frames[1].rate_hz),
        (Some((0, 2_000_000_000)), 5, 2.0)
    );
    assert_eq!(
        buffer.all_frames_as_yaml(),
        "'base':
  parent: 'map'
  rate: 2.000
  most_recent_transform: 2.000000000
  oldest_transform: 0.000000000
  buffer_length: 2.000000000
'it''s':
  parent: 'base'
  rate: 0.000
  most_recent_transform: 0.000000000
  oldest_transform: 0.000000000
  buffer_length: 0.000000000
"
    );
}

#[test]
fn stamps_may_be_as_far_apart_as_they_can() {
    let limits = Limits { frames: 2, samples: 4, cache_time: Duration::MAX, waiters: 0 };
    let (mut writer, buffer) = Buffer::new(limits).unwrap();
    for stamp_ns in [i64::MIN, i64::MAX] {
        let transform =
            TransformStamped { parent: "a", child: "b", stamp_ns, transform: at_x(stamp_ns as f64) };
        writer.set(&transform, Kind::Dynamic).unwrap();
    }
    // Half of that is the cache time, at most.
    assert_eq!(x(buffer.lookup("a", "b", Time::At(i64::MAX))), i64::MAX as f64);
    let error = buffer.lookup("a", "b", Time::At(-1)).unwrap_err();
    assert!(matches!(error, LookupError::Extrapolation { oldest_ns: i64::MAX, .. }), "{error}");
}
