// SPDX-License-Identifier: MIT OR Apache-2.0
//! A motorway of three lanes: straights, clothoids and arcs from a seed.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use crate::signals::{Pose, wrap};

/// Of a lane, in m.
pub const LANE_M: f64 = 3.75;
/// Between two points of the grid, in m.
const GRID_M: f64 = 1.0;
/// The tightest curve, in m: 1.6 m/s² at 130 km/h.
const TIGHTEST_M: f64 = 800.0;
const WIDEST_M: f64 = 3_000.0;

/// The centre of the middle lane.
#[derive(Clone, Debug)]
pub struct Road {
    points: Vec<Point>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Point {
    pose: Pose,
    curvature: f64,
}

impl Road {
    /// At least `length_m` of it; beyond its end it is straight.
    pub fn new(seed: u64, length_m: f64) -> Road {
        let mut rng = StdRng::seed_from_u64(seed);
        let mut curvatures = Vec::new();
        // The first is straight, so that a car can find itself.
        let straight = |curvatures: &mut Vec<f64>, length: f64| {
            curvatures.extend(std::iter::repeat_n(0.0, (length / GRID_M) as usize));
        };
        straight(&mut curvatures, 300.0);
        while (curvatures.len() as f64) * GRID_M < length_m {
            let radius = rng.random_range(TIGHTEST_M..WIDEST_M);
            let curvature = if rng.random_bool(0.5) { 1.0 / radius } else { -1.0 / radius };
            // A clothoid's curvature grows with its length.
            let clothoid = (rng.random_range(120.0..250.0) / GRID_M) as usize;
            let arc = (rng.random_range(200.0..900.0) / GRID_M) as usize;
            let ramp = |i: usize| curvature * i as f64 / clothoid as f64;
            curvatures.extend((0..clothoid).map(ramp));
            curvatures.extend(std::iter::repeat_n(curvature, arc));
            curvatures.extend((0..clothoid).rev().map(ramp));
            let length = rng.random_range(100.0..600.0);
            straight(&mut curvatures, length);
        }
        let mut pose = Pose::default();
        let points = curvatures.iter().map(|&curvature| {
            let point = Point { pose, curvature };
            let yaw = pose.yaw + curvature * GRID_M / 2.0;
            pose.x += yaw.cos() * GRID_M;
            pose.y += yaw.sin() * GRID_M;
            pose.yaw = wrap(pose.yaw + curvature * GRID_M);
            point
        });
        Road { points: points.collect() }
    }

    /// Curvature at `s` m from its begin, in 1/m; positive to the left.
    pub fn curvature(&self, s: f64) -> f64 {
        self.point(s).curvature
    }

    /// The place `across` m to the left of the centre at `s`, heading along the road.
    pub fn pose(&self, s: f64, across: f64) -> Pose {
        let Point { pose, curvature } = self.point(s);
        let along = s - (s / GRID_M).floor().clamp(0.0, (self.points.len() - 1) as f64) * GRID_M;
        let yaw = pose.yaw + curvature * along / 2.0;
        let (x, y) = (pose.x + yaw.cos() * along, pose.y + yaw.sin() * along);
        let yaw = wrap(pose.yaw + curvature * along);
        Pose { x: x - yaw.sin() * across, y: y + yaw.cos() * across, yaw }
    }

    /// Where a place near `guess` lies: along the road, and to the left of its centre. Newton's method; three steps are exact to
    /// less than a millimetre for a guess within 10 m.
    pub fn project(&self, place: Pose, guess: f64) -> (f64, f64) {
        let mut s = guess;
        for _ in 0..3 {
            let seen = place.seen_from(self.pose(s, 0.0));
            s = (s + seen.x / (1.0 - self.curvature(s) * seen.y)).max(0.0);
        }
        (s, place.seen_from(self.pose(s, 0.0)).y)
    }

    fn point(&self, s: f64) -> Point {
        let index = (s / GRID_M).floor().max(0.0) as usize;
        match self.points.get(index) {
            Some(point) if index + 1 < self.points.len() => *point,
            _ => Point { curvature: 0.0, ..*self.points.last().expect("a road has points") },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_projected_to_where_it_was_made() {
        let road = Road::new(7, 5_000.0);
        assert!((road.points.len() - 1) as f64 * GRID_M >= 5_000.0);
        let mut tightest: f64 = 0.0;
        for metres in 0..4_900 {
            let s = f64::from(metres) + 0.3;
            let (found, across) = road.project(road.pose(s, 1.5), s - 3.0);
            assert!((found - s).abs() < 2e-3 && (across - 1.5).abs() < 2e-3, "{s}: {found} {across}");
            tightest = tightest.max(road.curvature(s).abs());
        }
        assert!(tightest > 1.0 / WIDEST_M && tightest <= 1.0 / TIGHTEST_M);
    }

    #[test]
    fn neighbours_on_the_grid_meet() {
        let road = Road::new(3, 3_000.0);
        for metres in 1..2_900 {
            let s = f64::from(metres);
            let (before, after) = (road.pose(s - 1e-9, 0.0), road.pose(s, 0.0));
            assert!((before.x - after.x).hypot(before.y - after.y) < 1e-6, "at {s}");
        }
    }
}
