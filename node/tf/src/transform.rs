// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rigid transforms.

use std::ops::Mul;

use glam::{DMat3, DQuat, DVec3};

/// A rigid transform: a rotation, then a translation. In f64; rotations are unit quaternions.
///
/// A lookup from frame `source` to frame `target` gives the transform that takes coordinates in `source` to coordinates
/// in `target`; it is also the pose of `source` in `target`. So `map_base * base_laser == map_laser`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Transform {
    /// x, y, z in metres.
    pub translation: [f64; 3],
    /// x, y, z, w, of length 1.
    pub rotation: [f64; 4],
}

impl Transform {
    /// The transform that changes nothing.
    pub const IDENTITY: Transform = Transform { translation: [0.0; 3], rotation: [0.0, 0.0, 0.0, 1.0] };

    /// A transform with a translation in metres and a unit quaternion (x, y, z, w).
    pub const fn new(translation: [f64; 3], rotation: [f64; 4]) -> Transform {
        Transform { translation, rotation }
    }

    /// The inverse transform: `t * t.inverse()` is the identity.
    #[must_use = "it returns another transform, and leaves this one as it is"]
    pub fn inverse(&self) -> Transform {
        let rotation = self.quat().conjugate();
        Transform::of(-(rotation * self.vec()), rotation)
    }

    /// Transforms a point: rotated, then moved.
    #[must_use = "it returns the result, and changes nothing in place"]
    pub fn point(&self, point: [f64; 3]) -> [f64; 3] {
        (self.quat() * DVec3::from(point) + self.vec()).to_array()
    }

    /// Transforms a free vector, such as a velocity: only rotated.
    #[must_use = "it returns the result, and changes nothing in place"]
    pub fn vector(&self, vector: [f64; 3]) -> [f64; 3] {
        (self.quat() * DVec3::from(vector)).to_array()
    }

    /// Transforms a pose, which is a position and an orientation (x, y, z, w).
    #[must_use = "it returns the result, and changes nothing in place"]
    pub fn pose(&self, position: [f64; 3], orientation: [f64; 4]) -> ([f64; 3], [f64; 4]) {
        let pose = *self * Transform::new(position, orientation);
        (pose.translation, pose.rotation)
    }

    /// Transforms the points of a cloud in place. Each is computed in f64, and rounded once.
    ///
    /// ```
    /// # use tautline_tf::Transform;
    /// let mut cloud = [[1.0, 2.0, 3.0], [0.0, 0.0, 0.0_f32]];
    /// Transform::new([10.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]).points_in_place(&mut cloud);
    /// assert_eq!(cloud, [[9.0, -2.0, 3.0], [10.0, 0.0, 0.0]]);
    /// ```
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Nine multiplications per point.
    pub fn points_in_place(&self, points: &mut [[f32; 3]]) {
        let (rotation, translation) = (DMat3::from_quat(self.quat()), self.vec());
        for point in points {
            let moved = rotation * DVec3::from(point.map(f64::from)) + translation;
            *point = moved.to_array().map(|coordinate| coordinate as f32);
        }
    }

    /// From this transform (0.0) to `other` (1.0): translations on a straight line, rotations at constant angular
    /// velocity along the shorter way (slerp), as tf2.
    #[must_use = "it returns another transform, and leaves both as they are"]
    pub fn interpolate(&self, other: &Transform, ratio: f64) -> Transform {
        Transform::of(self.vec().lerp(other.vec(), ratio), self.quat().slerp(other.quat(), ratio))
    }

    pub(crate) fn is_finite(&self) -> bool {
        self.vec().is_finite() && self.quat().is_finite()
    }

    pub(crate) fn rotation_squared(&self) -> f64 {
        self.quat().length_squared()
    }

    pub(crate) fn normalized(&self) -> Transform {
        Transform::of(self.vec(), self.quat().normalize())
    }

    fn of(translation: DVec3, rotation: DQuat) -> Transform {
        Transform::new(translation.to_array(), rotation.to_array())
    }

    fn vec(&self) -> DVec3 {
        self.translation.into()
    }

    fn quat(&self) -> DQuat {
        DQuat::from_array(self.rotation)
    }
}

impl Default for Transform {
    fn default() -> Transform {
        Transform::IDENTITY
    }
}

impl Mul for Transform {
    type Output = Transform;

    /// The transform that does what the right one does, then what the left one does.
    fn mul(self, right: Transform) -> Transform {
        Transform::of(self.quat() * right.vec() + self.vec(), self.quat() * right.quat())
    }
}
