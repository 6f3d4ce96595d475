// SPDX-License-Identifier: MIT OR Apache-2.0
//! Our bytes are CDR: an independent writer (`cdr-encoding`) produces the same from the same values.
#![forbid(unsafe_code)]

use rand::RngExt;
use rand::rngs::StdRng;
use serde::{Serialize, Serializer};
use tautline_msgs::{Message, Plain, from_bytes, write_cdr};

#[derive(Message, Serialize, Clone, Copy, Debug, PartialEq)]
#[message(name = "test_msgs/msg/Odometry", crate = "tautline_msgs")]
#[repr(C)]
struct Odometry {
    sec: i32,
    nanosec: u32,
    pose: Pose,
    covariance: [f64; 12],
    valid: bool,
}

#[derive(Message, Serialize, Clone, Copy, Debug, PartialEq)]
#[message(nested, crate = "tautline_msgs")]
#[repr(C)]
struct Pose {
    position: [f64; 3],
    orientation: [f64; 4],
}

/// Padding of every width, and a nested struct that ends in padding at the end.
#[derive(Message, Serialize, Clone, Copy, Debug, PartialEq)]
#[message(name = "test_msgs/msg/Gaps", crate = "tautline_msgs")]
#[repr(C)]
struct Gaps {
    a: u8,
    b: u16,
    c: i8,
    d: f32,
    e: bool,
    f: u64,
    g: char,
    modes: [Mode; 3],
    last: [Entry; 4],
}

#[derive(Message, Serialize, Clone, Copy, Debug, PartialEq)]
#[message(nested, crate = "tautline_msgs")]
#[repr(C)]
struct Entry {
    key: i64,
    mode: Mode,
    set: bool,
}

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(crate = "tautline_msgs")]
#[repr(i16)]
enum Mode {
    Off,
    Back = -2,
    Go = 300,
}

impl Serialize for Mode {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_i16(*self as i16)
    }
}

#[derive(Message, Serialize, Clone, Copy, Debug, PartialEq)]
#[message(name = "test_msgs/msg/Integers", crate = "tautline_msgs")]
#[repr(C)]
struct Integers {
    a: [u8; 3],
    b: [i16; 3],
    c: [u16; 2],
    d: [i32; 3],
    e: u32,
    f: [i64; 2],
    g: [[u16; 2]; 3],
    h: u8,
}

trait Random {
    fn random(rng: &mut StdRng) -> Self;
}

impl Random for Pose {
    fn random(rng: &mut StdRng) -> Self {
        Self { position: rng.random(), orientation: rng.random() }
    }
}

impl Random for Odometry {
    fn random(rng: &mut StdRng) -> Self {
        Self {
            sec: rng.random(),
            nanosec: rng.random(),
            pose: Pose::random(rng),
            covariance: rng.random(),
            valid: rng.random(),
        }
    }
}

impl Random for Mode {
    fn random(rng: &mut StdRng) -> Self {
        [Self::Off, Self::Back, Self::Go][rng.random_range(0..3)]
    }
}

impl Random for Entry {
    fn random(rng: &mut StdRng) -> Self {
        Self { key: rng.random(), mode: Mode::random(rng), set: rng.random() }
    }
}

impl Random for Gaps {
    fn random(rng: &mut StdRng) -> Self {
        Self {
            a: rng.random(),
            b: rng.random(),
            c: rng.random(),
            d: rng.random(),
            e: rng.random(),
            f: rng.random(),
            g: rng.random(),
            modes: std::array::from_fn(|_| Mode::random(rng)),
            last: std::array::from_fn(|_| Entry::random(rng)),
        }
    }
}

impl Random for Integers {
    fn random(rng: &mut StdRng) -> Self {
        Self {
            a: rng.random(),
            b: rng.random(),
            c: rng.random(),
            d: rng.random(),
            e: rng.random(),
            f: rng.random(),
            g: rng.random(),
            h: rng.random(),
        }
    }
}

/// A message body's place: 8-byte aligned.
#[repr(align(8))]
struct Body([u8; 512]);

fn agrees<T>(rng: &mut StdRng)
where
    T: Message + Plain + Random + Serialize + PartialEq + std::fmt::Debug,
{
    let value = T::random(rng);
    let theirs = cdr_encoding::to_vec::<_, byteorder::LittleEndian>(&value).expect("a serialised body");
    assert_eq!(theirs.len(), T::CDR_SIZE, "{}", T::TYPE_NAME);

    let mut ours = Body([0xAA; 512]);
    assert_eq!(write_cdr(&value, &mut ours.0), Ok(T::CDR_SIZE));
    assert_eq!(&ours.0[..T::CDR_SIZE], theirs, "{value:?}");
    assert!(ours.0[T::CDR_SIZE..].iter().all(|&byte| byte == 0xAA), "nothing is written past the body");

    let mut received = Body([0xAA; 512]);
    received.0[..theirs.len()].copy_from_slice(&theirs);
    assert_eq!(from_bytes::<T>(&received.0), Ok(&value));
}

#[test]
fn an_independent_writer_writes_the_same_bytes() {
    let mut rng = tautline_seed::random();
    for _ in 0..if cfg!(miri) { 10 } else { 1000 } {
        agrees::<Odometry>(&mut rng);
        agrees::<Gaps>(&mut rng);
        agrees::<Integers>(&mut rng);
    }
}

#[test]
fn sizes_follow_from_the_format() {
    assert_eq!((Odometry::CDR_SIZE, size_of::<Odometry>()), (161, 168));
    assert_eq!((Entry::CDR_SIZE, size_of::<Entry>()), (11, 16));
    assert_eq!((Integers::FIRST_ALIGN, Mode::FIRST_ALIGN, Odometry::FIRST_ALIGN), (1, 2, 4));
    const { assert!(Integers::ALWAYS_VALID && !Odometry::ALWAYS_VALID && !Gaps::ALWAYS_VALID) };
}
