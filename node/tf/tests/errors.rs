// SPDX-License-Identifier: MIT OR Apache-2.0
//! Each error, and what it says.
#![allow(clippy::result_large_err)]

mod support;

use support::{at_x, set, set_static};
use tautline_tf::{
    Buffer, FrameName, Kind, Limits, LookupError, MAX_DEPTH, SetError, Time, Transform, TransformStamped,
};

const LIMITS: Limits =
    Limits { frames: 8, samples: 4, cache_time: std::time::Duration::from_secs(10), waiters: 2 };

#[track_caller]
fn assert_says(error: impl std::error::Error, text: &str) {
    assert_eq!(error.to_string(), text);
}

#[test]
fn lookups() {
    let (mut writer, buffer) = Buffer::new(LIMITS).unwrap();
    set(&mut writer, "map", "base", 2_000_000_000, at_x(1.0)).unwrap();
    let lookup = |target: &str, source: &str, time| buffer.lookup(target, source, time).unwrap_err();
    let at = |seconds: i64| Time::At(seconds * 1_000_000_000);
    assert_says(
        lookup("map", "", at(2)),
        "'' is not a frame name: use one of 1 to 64 bytes without a zero byte",
    );
    assert_says(
        lookup("map", "laser", at(2)),
        "frame 'laser' does not exist: no transform has named it as parent or child. Check its spelling, or wait for it (Buffer::wait_for)",
    );
    assert_says(
        lookup("map", "base", at(4)),
        "no transform from 'base' to 'map' at 4.000000000 s: that is in the future of frame 'base', which has one sample at 2.000000000 s. Wait for it (Buffer::wait_for), or ask for Time::Latest",
    );
    set(&mut writer, "map", "base", 3_000_000_001, at_x(1.0)).unwrap();
    assert_says(
        lookup("map", "base", at(-1)),
        "no transform from 'base' to 'map' at -1.000000000 s: that is in the past of frame 'base', which has samples from 2.000000000 s to 3.000000001 s. Raise Limits::cache_time and Limits::samples, or ask for a later time",
    );
    set_static(&mut writer, "world", "other", at_x(1.0)).unwrap();
    assert_says(
        lookup("other", "base", at(2)),
        "no transform from 'base' to 'other': they are not in one tree. See Buffer::frames for the parents, and who should broadcast the missing one",
    );
    set_static(&mut writer, "other", "world", at_x(1.0)).unwrap();
    for (target, source) in [("base", "world"), ("world", "base")] {
        assert!(
            matches!(lookup(target, source, Time::Latest), LookupError::Cycle { .. }),
            "{target} {source}"
        );
    }
    assert_says(
        lookup("map", "world", at(2)),
        "no transform from 'world' to 'map': the tree has a cycle through 'world'. Two broadcasters disagree about a frame's parent: see Buffer::frames",
    );
}

#[test]
fn trees_are_walked_to_a_depth_and_no_further() {
    let (mut writer, buffer) = Buffer::new(Limits { frames: 2 * MAX_DEPTH, ..LIMITS }).unwrap();
    for depth in 0..=MAX_DEPTH {
        set_static(&mut writer, &format!("f{depth}"), &format!("f{}", depth + 1), at_x(1.0)).unwrap();
    }
    let (root, deepest) = (format!("f{}", 1), format!("f{}", MAX_DEPTH + 1));
    let x = |target: &str, source: &str| {
        buffer.lookup(target, source, Time::Latest).map(|found| found.transform.translation[0])
    };
    assert_eq!(x(&root, &deepest), Ok(MAX_DEPTH as f64));
    assert_eq!(x(&deepest, &root), Ok(-(MAX_DEPTH as f64)));
    assert_says(
        x("f0", &deepest).unwrap_err(),
        &format!(
            "no transform from '{deepest}' to 'f0': more than 64 transforms to the root (MAX_DEPTH). Join fixed frames into one static transform"
        ),
    );
    assert!(matches!(x(&deepest, "f0"), Err(LookupError::TooDeep { .. })));
}

#[test]
fn sets() {
    let (mut writer, buffer) = Buffer::new(LIMITS).unwrap();
    let long = "n".repeat(FrameName::MAX_BYTES + 1);
    let mut try_set =
        |parent: &str, child: &str, stamp_ns, transform| set(&mut writer, parent, child, stamp_ns, transform);
    let nan = Transform::new([0.0, f64::NAN, 0.0], [0.0, 0.0, 0.0, 1.0]);
    assert_says(
        try_set("map", &long, 0, at_x(0.0)).unwrap_err(),
        &format!("'{}' is not a frame name: use one of 1 to 64 bytes without a zero byte", &long[1..]),
    );
    assert!(matches!(try_set("", "base", 0, at_x(0.0)), Err(SetError::InvalidName { .. })));
    assert_says(
        try_set("map", "map", 0, at_x(0.0)).unwrap_err(),
        "frame 'map' cannot be its own parent: name another parent or child",
    );
    assert_says(
        try_set("map", "base", 0, nan).unwrap_err(),
        "the transform of 'base' has a number that is not finite: check what computes it",
    );
    assert_says(
        try_set("map", "base", 0, Transform::new([0.0; 3], [0.0, 0.0, 0.0, 2.0])).unwrap_err(),
        "the rotation of 'base' has the squared length 4, which is off 1 by 0.01 or more: normalise it",
    );
    assert_eq!(buffer.frame("base"), None, "what was refused named no frame");
    try_set("map", "base", 20_000_000_000, at_x(0.0)).unwrap();
    assert_says(
        try_set("map", "base", 20_000_000_000, at_x(0.0)).unwrap_err(),
        "there is a transform of 'base' at 20.000000000 s already: the first one stays. Let one broadcaster send it, once per stamp",
    );
    assert_says(
        try_set("map", "base", 9_999_999_999, at_x(0.0)).unwrap_err(),
        "the transform of 'base' at 9.999999999 s is too old: only samples after 9.999999999 s are kept. Send it sooner, or raise Limits::cache_time and Limits::samples; after time was set back, call Writer::clear",
    );
    for child in ["a", "b", "c", "d", "e"] {
        try_set("map", child, 0, at_x(0.0)).unwrap();
    }
    // Both are new, and there is room for one.
    assert_says(
        try_set("g", "f", 0, at_x(0.0)).unwrap_err(),
        "no room for frame 'f' beside 8 others: raise Limits::frames",
    );
    try_set("map", "f", 0, at_x(0.0)).unwrap();
    let counted = buffer.counters();
    assert_eq!((counted.set, counted.out_of_order, counted.invalid), (7, 0, 5));
    assert_eq!((counted.old, counted.repeated, counted.frames_full), (1, 1, 1));
}

#[test]
fn limits() {
    for (limits, text) in [
        (Limits { frames: 1, ..LIMITS }, "Limits::frames is 1: use a value from 2 to 16777216"),
        (Limits { samples: 0, ..LIMITS }, "Limits::samples is 0: use a value from 2 to 16777216"),
        (
            Limits { waiters: 1 << 30, ..LIMITS },
            "Limits::waiters is 1073741824: use a value from 0 to 16777216",
        ),
    ] {
        assert_says(Buffer::new(limits).err().unwrap(), text);
    }
    let (mut writer, larger) = Buffer::new(Limits { frames: 16, ..LIMITS }).unwrap();
    let transform = TransformStamped { parent: "a", child: "b", stamp_ns: 0, transform: at_x(0.0) };
    writer.set(&transform, Kind::Static).unwrap();
    let (_, other) = Buffer::new(LIMITS).unwrap();
    // A frame's number is of one buffer.
    let foreign = larger.frame("b").unwrap();
    assert_says(
        other.lookup(foreign, foreign, Time::Latest).unwrap_err(),
        "frame '(a FrameId of another buffer)' does not exist: no transform has named it as parent or child. Check its spelling, or wait for it (Buffer::wait_for)",
    );
    assert_eq!((other.name(foreign), larger.name(foreign).unwrap().as_str()), (None, "b"));
}
