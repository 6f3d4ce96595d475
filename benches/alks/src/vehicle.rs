// SPDX-License-Identifier: MIT OR Apache-2.0
//! The car: a dynamic bicycle model with linear tyres, and actuators that lag and have limits.
//!
//! Lateral velocity v and yaw rate r at a longitudinal speed u and a steering angle d (Rajamani, Vehicle Dynamics and Control, ch. 2):
//! ```text
//! m  (v' + u r) = Cf (d - (v + lf r) / u) - Cr (v - lr r) / u
//! Iz r'         = lf Cf (d - (v + lf r) / u) + lr Cr (v - lr r) / u
//! ```

use crate::STEP_S;
use crate::signals::{Command, Pose, wrap};

const MASS_KG: f64 = 2_200.0;
/// About the vertical axis, in kg m².
const INERTIA: f64 = 3_900.0;
/// Centre of gravity to the front and to the rear axle, in m.
const FRONT_M: f64 = 1.42;
const REAR_M: f64 = 1.48;
/// Cornering stiffness of the front and of the rear axle, in N/rad.
const FRONT_STIFFNESS: f64 = 150_000.0;
const REAR_STIFFNESS: f64 = 190_000.0;
const WHEELBASE_M: f64 = FRONT_M + REAR_M;
/// Of a wheel, in m.
pub const WHEEL_M: f64 = 0.36;
pub const LENGTH_M: f64 = 4.9;
/// Turns of the steering wheel for one of the road wheels.
pub const STEERING_RATIO: f64 = 14.0;
/// Of the road wheels, in rad and rad/s.
const MAX_STEERING: f64 = 0.5;
const MAX_STEERING_RATE: f64 = 0.35;
pub const MAX_BRAKING: f64 = 8.0;
const MAX_ACCELERATION: f64 = 2.5;
/// Time constants of the actuators, in s.
const STEERING_LAG_S: f64 = 0.08;
const DRIVE_LAG_S: f64 = 0.25;
/// Below it the tyre model is none.
const SLOWEST: f64 = 3.0;
/// Integration steps within a step of the simulation.
const SUBSTEPS: u32 = 20;

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Car {
    /// Of its centre of gravity.
    pub pose: Pose,
    pub speed_mps: f64,
    /// To the left, in m/s.
    pub lateral_mps: f64,
    pub yaw_rate_radps: f64,
    /// What it really has, in m/s².
    pub acceleration_mps2: f64,
    /// Of the road wheels, in rad.
    pub steering_rad: f64,
}

impl Car {
    /// One that drives straight ahead.
    pub fn new(pose: Pose, speed_mps: f64) -> Car {
        Car { pose, speed_mps, ..Car::default() }
    }

    /// What a step of 20 ms makes of it, with `push` m/s² of wind from the right.
    pub fn step(&mut self, command: &Command, push: f64) {
        let dt = STEP_S / f64::from(SUBSTEPS);
        for _ in 0..SUBSTEPS {
            self.actuate(command, dt);
            self.integrate(push, dt);
        }
    }

    fn actuate(&mut self, command: &Command, dt: f64) {
        let finite = |value: f64| if value.is_finite() { value } else { 0.0 };
        let wanted = finite(command.steering_rad).clamp(-MAX_STEERING, MAX_STEERING);
        let rate =
            ((wanted - self.steering_rad) / STEERING_LAG_S).clamp(-MAX_STEERING_RATE, MAX_STEERING_RATE);
        self.steering_rad += rate * dt;
        let wanted = finite(command.acceleration_mps2).clamp(-MAX_BRAKING, MAX_ACCELERATION);
        self.acceleration_mps2 += (wanted - self.acceleration_mps2) / DRIVE_LAG_S * dt;
    }

    fn integrate(&mut self, push: f64, dt: f64) {
        self.speed_mps = (self.speed_mps + self.acceleration_mps2 * dt).max(0.0);
        let u = self.speed_mps.max(SLOWEST);
        let (v, r, steering) = (self.lateral_mps, self.yaw_rate_radps, self.steering_rad);
        let front = FRONT_STIFFNESS * (steering - (v + FRONT_M * r) / u);
        let rear = -REAR_STIFFNESS * (v - REAR_M * r) / u;
        self.lateral_mps += ((front + rear) / MASS_KG - u * r + push) * dt;
        self.yaw_rate_radps += (FRONT_M * front - REAR_M * rear) / INERTIA * dt;
        let (sin, cos) = self.pose.yaw.sin_cos();
        self.pose.x += (cos * self.speed_mps - sin * self.lateral_mps) * dt;
        self.pose.y += (sin * self.speed_mps + cos * self.lateral_mps) * dt;
        self.pose.yaw = wrap(self.pose.yaw + self.yaw_rate_radps * dt);
    }
}

/// The steering angle of a steady curve: `curvature` (L + K u²), with the understeer gradient K = m (lr Cr - lf Cf) / (L Cf Cr).
pub fn steering_of(curvature: f64, speed_mps: f64) -> f64 {
    let gradient = MASS_KG * (REAR_M * REAR_STIFFNESS - FRONT_M * FRONT_STIFFNESS)
        / (WHEELBASE_M * FRONT_STIFFNESS * REAR_STIFFNESS);
    curvature * (WHEELBASE_M + gradient * speed_mps * speed_mps)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_steady_curve_is_the_circle_of_the_formula() {
        for (speed, curvature) in [(10.0, 1.0 / 100.0), (36.0, 1.0 / 800.0), (36.0, -1.0 / 1500.0)] {
            let mut car = Car::new(Pose::default(), speed);
            let command = Command { acceleration_mps2: 0.0, steering_rad: steering_of(curvature, speed) };
            for _ in 0..500 {
                car.step(&command, 0.0);
            }
            let driven = car.yaw_rate_radps / car.speed_mps;
            assert!((driven / curvature - 1.0).abs() < 1e-3, "{speed} m/s: {driven} for {curvature}");
        }
    }

    #[test]
    fn actuators_have_limits_and_nonsense_moves_nothing() {
        let mut car = Car::new(Pose::default(), 30.0);
        car.step(&Command { acceleration_mps2: -100.0, steering_rad: 10.0 }, 0.0);
        assert!(car.steering_rad <= MAX_STEERING_RATE * STEP_S + 1e-12);
        for _ in 0..500 {
            car.step(&Command { acceleration_mps2: -100.0, steering_rad: 0.0 }, 0.0);
            assert!(car.acceleration_mps2 >= -MAX_BRAKING);
        }
        assert_eq!(car.speed_mps, 0.0);
        let mut car = Car::new(Pose::default(), 30.0);
        car.step(&Command { acceleration_mps2: f64::NAN, steering_rad: f64::INFINITY }, 0.0);
        assert_eq!((car.steering_rad, car.speed_mps), (0.0, 30.0));
    }
}
