// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the eleven subscriptions keep for the controller: each its own part.

use crate::signals::{Driver, Fast, Gps, Imu, Lines, Pose, Slow, Vehicles};

/// The internal representation; each field is one subscription's.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Inputs {
    pub speed_mps: f64,
    /// Of the road wheels, in rad.
    pub steering_rad: f64,
    pub gps: Gps,
    /// On the map: what comes is relative to the start.
    pub odometry: Pose,
    pub imu: Imu,
    /// By the wheels' speeds, in m/s: the mean.
    pub wheel_speed_mps: f64,
    /// Throttle and brake, 0 to 1.
    pub pedals: [f64; 2],
    pub status: u32,
    pub driver: Driver,
    pub vehicles: Vehicles,
    pub lines: Lines,
    /// When the lines came, in s of any clock; 0: never.
    pub lines_at_s: f64,
}

/// Of the wheel's angle at the driver's hands that of the road wheels.
pub fn road_wheels(steering_wheel_rad: f64) -> f64 {
    steering_wheel_rad / crate::vehicle::STEERING_RATIO
}

pub fn wheel_speed(wheels_radps: &[f64; 4]) -> f64 {
    wheels_radps.iter().sum::<f64>() / 4.0 * crate::vehicle::WHEEL_M
}

impl Inputs {
    /// All that one step of the fast topics changes, as its subscriptions would.
    pub fn take_fast(&mut self, fast: &Fast, start: Pose) {
        self.speed_mps = fast.speed_mps;
        self.steering_rad = road_wheels(fast.steering_wheel_rad);
        self.gps = fast.gps;
        self.odometry = fast.odometry.from(start);
        self.imu = fast.imu;
        self.wheel_speed_mps = wheel_speed(&fast.wheels_radps);
        self.pedals = fast.pedals;
        self.status = fast.status;
        self.driver = fast.driver;
    }

    pub fn take_slow(&mut self, slow: &Slow, now_s: f64) {
        self.vehicles = slow.vehicles;
        self.lines = slow.lines;
        self.lines_at_s = now_s;
    }
}
