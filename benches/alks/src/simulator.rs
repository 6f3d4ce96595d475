// SPDX-License-Identifier: MIT OR Apache-2.0
//! The car on the road among others, a step of 20 ms at a time: the same from the same seed and commands.

use serde::{Deserialize, Serialize};

use crate::road::{LANE_M, Road};
use crate::sensors::Sensors;
use crate::signals::{Command, Fast, Slow};
use crate::traffic::Traffic;
use crate::vehicle::{Car, LENGTH_M};
use crate::{CRUISE_MPS, SLOW_EVERY, START, STEP_S};

/// The wind's push, in m/s², and the length of a gust and its pause, in s.
const GUST: f64 = 0.25;
const GUST_S: f64 = 7.0;
const WIDTH_M: f64 = 1.95;

/// All that is outside of the controller.
#[derive(Debug)]
pub struct Simulator {
    road: Road,
    car: Car,
    traffic: Traffic,
    sensors: Sensors,
    /// Along the road, in m.
    s: f64,
    across: f64,
    steps: u64,
    collisions: u32,
    touches: bool,
}

/// What is true of a step, whatever the sensors say.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    pub time_s: f64,
    /// To the left of the lane's centre, in m.
    pub lateral_m: f64,
    pub speed_mps: f64,
    /// Of the road, in 1/m.
    pub curvature: f64,
    /// To the nearest car ahead in the lane, bumper to bumper, in m.
    pub gap_m: Option<f64>,
    /// Whether a car that has cut in is ahead.
    pub cut_in: bool,
    pub cut_ins: u32,
    pub collisions: u32,
}

impl Simulator {
    /// With room for `minutes` at the speed that is wanted. The car drives at 120 km/h.
    pub fn new(seed: u64, minutes: f64) -> Simulator {
        let road = Road::new(seed, CRUISE_MPS * 60.0 * minutes + 1_000.0);
        // The first stretch is straight.
        let (s, speed_mps) = (START.x, 120.0 / 3.6);
        Simulator {
            car: Car::new(START, speed_mps),
            traffic: Traffic::new(seed ^ 1, s, CRUISE_MPS),
            sensors: Sensors::new(seed ^ 2, START),
            road,
            s,
            across: 0.0,
            steps: 0,
            collisions: 0,
            touches: false,
        }
    }

    /// Moves all by 20 ms, and says what the fast sensors say then.
    pub fn step(&mut self, command: &Command) -> Fast {
        let gust = (self.time_s() / GUST_S) as u64 % 3;
        self.car.step(command, GUST * (gust as f64 - 1.0));
        (self.s, self.across) = self.road.project(self.car.pose, self.s + self.car.speed_mps * STEP_S);
        self.traffic.step(self.s, self.car.speed_mps);
        self.steps += 1;
        let touches =
            self.traffic.cars().iter().any(|other| {
                (other.s - self.s).abs() < LENGTH_M && (other.across - self.across).abs() < WIDTH_M
            });
        self.collisions += u32::from(touches && !self.touches);
        self.touches = touches;
        self.sensors.fast(&self.car)
    }

    /// Whether the slow sensors have something to say of this step.
    pub fn is_slow_due(&self) -> bool {
        self.steps.is_multiple_of(SLOW_EVERY)
    }

    pub fn slow(&mut self) -> Slow {
        self.sensors.slow(&self.car, &self.road, self.s, self.traffic.cars())
    }

    pub fn time_s(&self) -> f64 {
        self.steps as f64 * STEP_S
    }

    pub fn truth(&self) -> Truth {
        let ahead = self
            .traffic
            .cars()
            .iter()
            .filter(|other| other.s > self.s && (other.across - self.across).abs() < LANE_M / 2.0);
        let gap_m = ahead.map(|other| other.s - self.s - LENGTH_M).min_by(f64::total_cmp);
        Truth {
            time_s: self.time_s(),
            lateral_m: self.across,
            speed_mps: self.car.speed_mps,
            curvature: self.road.curvature(self.s),
            gap_m,
            cut_in: self.traffic.has_guest(),
            cut_ins: self.traffic.cut_ins(),
            collisions: self.collisions,
        }
    }
}
