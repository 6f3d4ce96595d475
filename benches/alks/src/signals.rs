// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is exchanged: plain data of a fixed size.

pub const MAX_VEHICLES: usize = 8;
/// Lines in a message: the ego lane's two and the next ones on either side.
pub const LINES: usize = 4;
/// Points of a plan.
pub const PLAN_POINTS: usize = 60;

/// What the topics of 50 Hz say of one step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Fast {
    /// Over the ground, in m/s.
    pub speed_mps: f64,
    /// At the wheel, in rad; positive to the left.
    pub steering_wheel_rad: f64,
    pub gps: Gps,
    /// Where it has come since it started.
    pub odometry: Pose,
    pub imu: Imu,
    /// Front left, front right, rear left, rear right, in rad/s.
    pub wheels_radps: [f64; 4],
    /// Throttle and brake, 0 to 1.
    pub pedals: [f64; 2],
    /// Bits: 0 the system may be on, 1 turn signal left, 2 right, 3 stability control works.
    pub status: u32,
    pub driver: Driver,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Gps {
    pub latitude_deg: f64,
    pub longitude_deg: f64,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose {
    pub x: f64,
    pub y: f64,
    /// In rad, counter-clockwise.
    pub yaw: f64,
}

impl Pose {
    /// This place, which is relative to `origin`, in the frame of `origin`.
    #[must_use = "it returns the place"]
    pub fn from(self, origin: Pose) -> Pose {
        let (sin, cos) = origin.yaw.sin_cos();
        Pose {
            x: origin.x + cos * self.x - sin * self.y,
            y: origin.y + sin * self.x + cos * self.y,
            yaw: wrap(origin.yaw + self.yaw),
        }
    }

    /// This place as seen from `origin`: the inverse of [`from`](Self::from).
    #[must_use = "it returns the place"]
    pub fn seen_from(self, origin: Pose) -> Pose {
        let (sin, cos) = origin.yaw.sin_cos();
        let (dx, dy) = (self.x - origin.x, self.y - origin.y);
        Pose { x: cos * dx + sin * dy, y: -sin * dx + cos * dy, yaw: wrap(self.yaw - origin.yaw) }
    }
}

/// An angle between -pi and pi.
pub fn wrap(angle: f64) -> f64 {
    let turn = std::f64::consts::TAU;
    angle - turn * (angle / turn).round()
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Imu {
    /// Ahead, in m/s².
    pub acceleration_mps2: f64,
    /// To the left, in m/s².
    pub lateral_mps2: f64,
    pub yaw_rate_radps: f64,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Driver {
    pub set_speed_mps: f64,
    /// Whether hands are at the wheel: 0 or 1.
    pub hands_on: f64,
}

/// What the topics of 25 Hz say.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Slow {
    pub vehicles: Vehicles,
    pub lines: Lines,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Vehicles {
    /// How many of `of` there are.
    pub count: usize,
    pub of: [Vehicle; MAX_VEHICLES],
}

impl Vehicles {
    pub fn as_slice(&self) -> &[Vehicle] {
        &self.of[..self.count.min(MAX_VEHICLES)]
    }
}

/// A car, seen from this one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Vehicle {
    /// Ahead, centre to centre, in m.
    pub x: f64,
    /// To the left, in m.
    pub y: f64,
    /// Its speed over the ground along the road, in m/s.
    pub speed_mps: f64,
    /// Its speed across the road, positive to the left, in m/s.
    pub across_mps: f64,
}

/// The lines from right to left.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lines {
    pub of: [Line; LINES],
}

/// A line in the car's frame: y = c0 + c1 x + c2 x² + c3 x³.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Line {
    /// From `c0`.
    pub coefficients: [f64; 4],
    /// How far it is seen, in m; 0: not at all.
    pub range_m: f64,
}

impl Line {
    pub fn y(&self, x: f64) -> f64 {
        self.coefficients.iter().rev().fold(0.0, |sum, c| sum * x + c)
    }

    /// Its curvature at x, in 1/m, for slopes that are small.
    pub fn curvature(&self, x: f64) -> f64 {
        2.0 * self.coefficients[2] + 6.0 * self.coefficients[3] * x
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Command {
    pub acceleration_mps2: f64,
    /// At the road wheels, in rad; positive to the left.
    pub steering_rad: f64,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct State {
    /// See [`Mode`](crate::control::Mode): its number.
    pub mode: u8,
    /// Distance from the lane's centre as perceived, in m; positive: the car is left of it.
    pub lateral_m: f64,
    pub target_mps: f64,
    /// To the vehicle ahead in the lane, in m; infinite: none.
    pub gap_m: f64,
    pub unsolved: u32,
}

/// What the planner wants for the next seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trajectory {
    /// Distance from the lane's centre at each point, in m.
    pub lateral_m: [f64; PLAN_POINTS],
    /// Curvature to drive, in 1/m.
    pub curvature: [f64; PLAN_POINTS],
    pub speed_mps: [f64; PLAN_POINTS],
    pub acceleration_mps2: [f64; PLAN_POINTS],
}

impl Default for Trajectory {
    fn default() -> Self {
        let none = [0.0; PLAN_POINTS];
        Trajectory { lateral_m: none, curvature: none, speed_mps: none, acceleration_mps2: none }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_is_found_again() {
        let origin = Pose { x: 3.0, y: -2.0, yaw: 2.5 };
        let place = Pose { x: 10.0, y: 4.0, yaw: -1.0 };
        let there = place.from(origin);
        let back = there.seen_from(origin);
        for (a, b) in [(place.x, back.x), (place.y, back.y), (place.yaw, back.yaw)] {
            assert!((a - b).abs() < 1e-12);
        }
        assert!((wrap(4.0) - (4.0 - std::f64::consts::TAU)).abs() < 1e-12);
    }

    #[test]
    fn a_line_is_its_cubic() {
        let line = Line { coefficients: [1.0, 0.5, 0.25, -0.125], range_m: 10.0 };
        assert_eq!(line.y(2.0), 1.0 + 1.0 + 1.0 - 1.0);
        assert_eq!(line.curvature(1.0), 0.5 - 0.75);
    }
}
