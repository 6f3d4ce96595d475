// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the car perceives of a step: with noise from the seed, lines by a curve fit.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use crate::CRUISE_MPS;
use crate::road::{LANE_M, Road};
use crate::signals::{
    Driver, Fast, Gps, Imu, LINES, Line, Lines, MAX_VEHICLES, Pose, Slow, Vehicle, Vehicles,
};
use crate::traffic::Other;
use crate::vehicle::{Car, MAX_BRAKING, STEERING_RATIO, WHEEL_M};

/// Points of a line, two metres apart.
const POINTS: usize = 56;
const POINT_M: f64 = 2.0;
/// Standard deviations.
const LINE_NOISE_M: f64 = 0.04;
const VEHICLE_NOISE_M: f64 = 0.15;
const SPEED_NOISE: f64 = 0.03;
const GPS_NOISE_M: f64 = 0.5;
/// Half the track, in m.
const TRACK_M: f64 = 0.83;
/// Metres of a degree of latitude, and where the road begins: in Prague.
const DEGREE_M: f64 = 111_320.0;
const LATITUDE_DEG: f64 = 50.08;
const LONGITUDE_DEG: f64 = 14.42;

#[derive(Debug)]
pub struct Sensors {
    rng: StdRng,
    start: Pose,
}

impl Sensors {
    pub fn new(seed: u64, start: Pose) -> Sensors {
        Sensors { rng: StdRng::seed_from_u64(seed), start }
    }

    pub fn fast(&mut self, car: &Car) -> Fast {
        let speed_mps = car.speed_mps + self.noise(SPEED_NOISE);
        let wheel = |side: f64| (car.speed_mps - side * TRACK_M * car.yaw_rate_radps) / WHEEL_M;
        let (east, north) = (car.pose.x + self.noise(GPS_NOISE_M), car.pose.y + self.noise(GPS_NOISE_M));
        let pedal = |acceleration: f64, most: f64| (acceleration / most).clamp(0.0, 1.0);
        Fast {
            speed_mps,
            steering_wheel_rad: car.steering_rad * STEERING_RATIO,
            gps: Gps {
                latitude_deg: LATITUDE_DEG + north / DEGREE_M,
                longitude_deg: LONGITUDE_DEG + east / (DEGREE_M * LATITUDE_DEG.to_radians().cos()),
            },
            odometry: car.pose.seen_from(self.start),
            imu: Imu {
                acceleration_mps2: car.acceleration_mps2 + self.noise(SPEED_NOISE),
                lateral_mps2: car.speed_mps * car.yaw_rate_radps + self.noise(SPEED_NOISE),
                yaw_rate_radps: car.yaw_rate_radps + self.noise(0.001),
            },
            wheels_radps: [wheel(1.0), wheel(-1.0), wheel(1.0), wheel(-1.0)],
            pedals: [pedal(car.acceleration_mps2, 2.5), pedal(-car.acceleration_mps2, MAX_BRAKING)],
            status: 0b1001,
            driver: Driver { set_speed_mps: CRUISE_MPS, hands_on: 0.0 },
        }
    }

    /// Of each second step: `s` is where the car is on the road.
    pub fn slow(&mut self, car: &Car, road: &Road, s: f64, others: &[Other]) -> Slow {
        let mut vehicles = Vehicles::default();
        for other in others.iter().take(MAX_VEHICLES) {
            let seen = road.pose(other.s, other.across).seen_from(car.pose);
            let (x, y) = (seen.x + self.noise(VEHICLE_NOISE_M), seen.y + self.noise(VEHICLE_NOISE_M));
            let (speed_mps, across_mps) =
                (other.speed_mps + self.noise(SPEED_NOISE), other.across_mps + self.noise(SPEED_NOISE));
            vehicles.of[vehicles.count] = Vehicle { x, y, speed_mps, across_mps };
            vehicles.count += 1;
        }
        let lines = std::array::from_fn(|index| {
            self.line(car, road, s, (index as f64 - LINES as f64 / 2.0 + 0.5) * LANE_M)
        });
        Slow { vehicles, lines: Lines { of: lines } }
    }

    /// The line `across` m to the left of the centre.
    fn line(&mut self, car: &Car, road: &Road, s: f64, across: f64) -> Line {
        let mut points = [(0.0, 0.0); POINTS];
        for (index, point) in points.iter_mut().enumerate() {
            let seen = road.pose(s + index as f64 * POINT_M, across).seen_from(car.pose);
            *point = (seen.x, seen.y + self.noise(LINE_NOISE_M));
        }
        let range_m = points[POINTS - 1].0;
        // Points a metre apart and more always determine a cubic.
        fit(&points).map_or(Line::default(), |coefficients| Line { coefficients, range_m })
    }

    /// Normally distributed (Box and Muller 1958).
    fn noise(&mut self, deviation: f64) -> f64 {
        let (a, b): (f64, f64) = (self.rng.random(), self.rng.random());
        deviation * (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
    }
}

/// The cubic with the least squares of distances, from `c0`: the normal equations, of x in hundreds of metres, by elimination with pivots.
/// `None` if the points do not determine one.
pub fn fit(points: &[(f64, f64)]) -> Option<[f64; 4]> {
    const SCALE: f64 = 100.0;
    let mut rows = [[0.0; 5]; 4];
    for &(x, y) in points {
        let powers = [1.0, x / SCALE, (x / SCALE).powi(2), (x / SCALE).powi(3)];
        for (row, factor) in rows.iter_mut().zip(powers) {
            for (sum, power) in row.iter_mut().zip(powers.iter().chain([&y])) {
                *sum += factor * power;
            }
        }
    }
    for step in 0..4 {
        let pivot = (step..4).max_by(|&a, &b| rows[a][step].abs().total_cmp(&rows[b][step].abs()))?;
        rows.swap(step, pivot);
        let pivot = rows[step];
        if pivot[step].abs() < 1e-12 {
            return None;
        }
        for (_, row) in rows.iter_mut().enumerate().filter(|(index, _)| *index != step) {
            let factor = row[step] / pivot[step];
            row.iter_mut().zip(pivot).for_each(|(value, of_pivot)| *value -= factor * of_pivot);
        }
    }
    let coefficient = |index: usize| rows[index][4] / rows[index][index] / SCALE.powi(index as i32);
    Some(std::array::from_fn(coefficient))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fit_finds_the_cubic_that_made_its_points() {
        let line = Line { coefficients: [1.9, -0.01, 4e-4, -2e-6], range_m: 110.0 };
        let points: Vec<_> = (0..POINTS).map(|i| i as f64 * POINT_M).map(|x| (x, line.y(x))).collect();
        let found = fit(&points).unwrap();
        for (found, made) in found.iter().zip(line.coefficients) {
            assert!((found - made).abs() <= 1e-9 * made.abs().max(1e-3), "{found} for {made}");
        }
        assert_eq!(fit(&points[..3]), None, "three points are too few");
        assert_eq!(fit(&[(5.0, 1.0); 9]), None, "all at one place");
        assert_eq!(fit(&[]), None);
    }

    #[test]
    fn noise_is_as_large_as_said() {
        let mut sensors = Sensors::new(5, Pose::default());
        let values: Vec<_> = (0..10_000).map(|_| sensors.noise(2.0)).collect();
        let mean = values.iter().sum::<f64>() / 1e4;
        let deviation = (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / 1e4).sqrt();
        assert!(mean.abs() < 0.1 && (deviation - 2.0).abs() < 0.1, "{mean} {deviation}");
    }
}
