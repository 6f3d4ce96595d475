// SPDX-License-Identifier: MIT OR Apache-2.0
//! Transforms against rotation matrices.

mod support;

use std::f64::consts::{FRAC_1_SQRT_2, FRAC_PI_2, FRAC_PI_4, PI};

use support::{Random, about, assert_near, identity, interpolate, inverse, matrix, times, yaw};
use tautline_tf::Transform;

fn rotated(by: &support::Matrix, v: [f64; 3], w: f64) -> [f64; 3] {
    std::array::from_fn(|row| (0..3).map(|k| by[row][k] * v[k]).sum::<f64>() + by[row][3] * w)
}

#[test]
fn composition_inverse_points_and_poses_are_as_with_matrices() {
    let mut random = Random::new();
    for _ in 0..2_000 {
        let (a, b) = (random.transform(), random.transform());
        let (ma, mb) = (matrix(&a), matrix(&b));
        assert_near(&matrix(&(a * b)), &times(&ma, &mb));
        assert_near(&matrix(&a.inverse()), &inverse(&ma));
        assert_near(&matrix(&(a * a.inverse())), &identity());
        assert_near(&matrix(&(a.inverse() * a)), &identity());
        let p = b.translation;
        for (got, wanted) in [(a.point(p), rotated(&ma, p, 1.0)), (a.vector(p), rotated(&ma, p, 0.0))] {
            assert!((0..3).all(|k| (got[k] - wanted[k]).abs() < 1e-12), "{got:?} is not {wanted:?}");
        }
        let (position, orientation) = a.pose(b.translation, b.rotation);
        assert_near(&matrix(&Transform::new(position, orientation)), &times(&ma, &mb));
        let mut cloud = [p.map(|x| x as f32); 3];
        a.points_in_place(&mut cloud);
        let wanted = rotated(&ma, p.map(|x| f64::from(x as f32)), 1.0).map(|x| x as f32);
        for point in cloud {
            assert!((0..3).all(|k| (point[k] - wanted[k]).abs() <= 1e-6), "{point:?} is not {wanted:?}");
        }
    }
}

#[test]
fn interpolation_is_as_with_matrices() {
    let mut random = Random::new();
    for _ in 0..2_000 {
        let (a, b, ratio) = (random.transform(), random.transform(), random.unit().abs());
        let between = interpolate(&matrix(&a), &matrix(&b), ratio);
        assert_near(&matrix(&a.interpolate(&b, ratio)), &between);
        // The same rotation by the other quaternion.
        let negative = Transform::new(b.translation, b.rotation.map(|x| -x));
        assert_near(&matrix(&a.interpolate(&negative, ratio)), &between);
        assert_near(&matrix(&a.interpolate(&b, 0.0)), &matrix(&a));
        assert_near(&matrix(&a.interpolate(&b, 1.0)), &matrix(&b));
    }
}

#[test]
fn known_values() {
    let quarter = Transform::new([1.0, 2.0, 3.0], yaw(FRAC_PI_2));
    let point = quarter.point([1.0, 0.0, 0.0]);
    assert!((point[0] - 1.0).abs() < 1e-15 && (point[1] - 3.0).abs() < 1e-15 && point[2] == 3.0);
    // Half of a quarter turn, and of a turn by nearly half, the shorter way.
    let half = Transform::IDENTITY.interpolate(&quarter, 0.5);
    assert_near(&matrix(&half), &matrix(&Transform::new([0.5, 1.0, 1.5], yaw(FRAC_PI_4))));
    let far = Transform::new([0.0; 3], yaw(-0.9 * PI));
    let near = Transform::new([0.0; 3], yaw(0.9 * PI));
    assert_near(&matrix(&far.interpolate(&near, 0.5)), &matrix(&Transform::new([0.0; 3], yaw(PI))));
    // Three axes in turn: x to y to z to x is a third of a turn about (1, 1, 1).
    let (x, y) = (about([1.0, 0.0, 0.0], FRAC_PI_2), about([0.0, 1.0, 0.0], FRAC_PI_2));
    let both = Transform::new([0.0; 3], x) * Transform::new([0.0; 3], y);
    let third = about([1.0, 1.0, 1.0], 2.0 * PI / 3.0);
    assert_near(&matrix(&both), &matrix(&Transform::new([0.0; 3], third)));
    assert!((yaw(FRAC_PI_2)[2] - FRAC_1_SQRT_2).abs() < 1e-15);
    assert_eq!(Transform::default(), Transform::IDENTITY);
}
