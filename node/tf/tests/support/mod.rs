// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rigid transforms as 4x4 matrices, by formulas of their own, and random numbers.
#![allow(dead_code)]

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use tautline_tf::{Kind, SetError, Transform, TransformStamped, Writer};

pub type Matrix = [[f64; 4]; 4];

pub struct Random(StdRng);

impl Random {
    pub fn new() -> Random {
        Random(tautline_seed::random())
    }

    pub fn seeded(seed: u64) -> Random {
        Random(StdRng::seed_from_u64(seed))
    }

    pub fn next(&mut self) -> u64 {
        self.0.random()
    }

    pub fn below(&mut self, end: u64) -> u64 {
        self.0.random_range(0..end)
    }

    /// From -1 to 1.
    pub fn unit(&mut self) -> f64 {
        self.0.random_range(-1.0..1.0)
    }

    /// With angles that keep any two of them less than 2.4 rad apart, where the shorter way is clear.
    pub fn transform(&mut self) -> Transform {
        let axis = [self.unit(), self.unit(), self.unit() + 2.0];
        let translation = [self.unit() * 5.0, self.unit() * 5.0, self.unit() * 5.0];
        Transform::new(translation, about(axis, self.unit() * 1.2))
    }
}

/// The quaternion of a rotation about an axis.
pub fn about(axis: [f64; 3], angle: f64) -> [f64; 4] {
    let length = axis.iter().map(|x| x * x).sum::<f64>().sqrt();
    let [x, y, z] = axis.map(|x| x / length * (angle / 2.0).sin());
    [x, y, z, (angle / 2.0).cos()]
}

pub fn yaw(angle: f64) -> [f64; 4] {
    about([0.0, 0.0, 1.0], angle)
}

pub fn at_x(x: f64) -> Transform {
    Transform::new([x, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
}

pub fn set(
    writer: &mut Writer,
    parent: &str,
    child: &str,
    stamp_ns: i64,
    transform: Transform,
) -> Result<(), SetError> {
    writer.set(&TransformStamped { parent, child, stamp_ns, transform }, Kind::Dynamic)
}

pub fn set_static(
    writer: &mut Writer,
    parent: &str,
    child: &str,
    transform: Transform,
) -> Result<(), SetError> {
    writer.set(&TransformStamped { parent, child, stamp_ns: 0, transform }, Kind::Static)
}

pub fn identity() -> Matrix {
    std::array::from_fn(|row| std::array::from_fn(|column| f64::from(row == column)))
}

pub fn matrix(transform: &Transform) -> Matrix {
    let [x, y, z, w] = transform.rotation;
    let [a, b, c] = transform.translation;
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w), a],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w), b],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y), c],
        [0.0, 0.0, 0.0, 1.0],
    ]
}

pub fn times(left: &Matrix, right: &Matrix) -> Matrix {
    std::array::from_fn(|row| {
        std::array::from_fn(|column| (0..4).map(|k| left[row][k] * right[k][column]).sum())
    })
}

/// The rotation transposed, and the translation back along it.
pub fn inverse(of: &Matrix) -> Matrix {
    let mut inverse = identity();
    for row in 0..3 {
        for column in 0..3 {
            inverse[row][column] = of[column][row];
        }
        inverse[row][3] = -(0..3).map(|k| of[k][row] * of[k][3]).sum::<f64>();
    }
    inverse
}

/// Straight translation; rotation about one axis by a part of the angle (Rodrigues' formula).
pub fn interpolate(from: &Matrix, to: &Matrix, ratio: f64) -> Matrix {
    let mut turned = *from;
    for row in &mut turned {
        row[3] = 0.0;
    }
    turned[3][3] = 1.0;
    let change = times(&inverse(&turned), to);
    let cosine = ((change[0][0] + change[1][1] + change[2][2] - 1.0) / 2.0).clamp(-1.0, 1.0);
    let twice = [change[2][1] - change[1][2], change[0][2] - change[2][0], change[1][0] - change[0][1]];
    let sine = twice.iter().map(|x| x * x).sum::<f64>().sqrt() / 2.0;
    let angle = sine.atan2(cosine) * ratio;
    let mut part = identity();
    if sine > 1e-12 {
        let [x, y, z] = twice.map(|x| x / (2.0 * sine));
        let cross = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]];
        for row in 0..3 {
            for column in 0..3 {
                let square: f64 = (0..3).map(|k| cross[row][k] * cross[k][column]).sum();
                part[row][column] += angle.sin() * cross[row][column] + (1.0 - angle.cos()) * square;
            }
        }
    }
    let mut between = times(&turned, &part);
    for row in 0..3 {
        between[row][3] = from[row][3] + (to[row][3] - from[row][3]) * ratio;
    }
    between
}

#[track_caller]
pub fn assert_near(one: &Matrix, other: &Matrix) {
    for (one, other) in one.iter().flatten().zip(other.iter().flatten()) {
        assert!((one - other).abs() < 1e-9, "{one} is not {other}");
    }
}
