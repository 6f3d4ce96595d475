// SPDX-License-Identifier: MIT OR Apache-2.0
//! Other cars: they keep their lanes and distances, and now and then one cuts in.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use crate::STEP_S;
use crate::road::LANE_M;
use crate::signals::MAX_VEHICLES;
use crate::vehicle::LENGTH_M;

/// Cars that are simulated: those that leave the neighbourhood come back on its other side.
const CARS: usize = MAX_VEHICLES;
/// Of the neighbourhood, ahead and behind, in m.
const NEAR_M: f64 = 200.0;
const CHANGE_S: f64 = 4.0;
/// Between two cut-ins, in s.
const CALM_S: std::ops::Range<f64> = 15.0..35.0;
/// How long one who has cut in stays, in s.
const STAY_S: std::ops::Range<f64> = 6.0..14.0;

/// A car in the road's coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Other {
    /// Along the road, in m.
    pub s: f64,
    /// To the left of the middle lane's centre, in m.
    pub across: f64,
    pub speed_mps: f64,
    /// To the left, in m/s.
    pub across_mps: f64,
    desired_mps: f64,
    lane: f64,
    /// Time since the begin of the change, in s, and where it began, in m.
    change: Option<(f64, f64)>,
}

#[derive(Debug)]
pub struct Traffic {
    rng: StdRng,
    cars: Vec<Other>,
    /// Who cuts in, and how long it stays then, in s.
    guest: Option<(usize, f64)>,
    calm_s: f64,
    cut_ins: u32,
}

impl Traffic {
    pub fn new(seed: u64, s: f64, speed_mps: f64) -> Traffic {
        let mut rng = StdRng::seed_from_u64(seed);
        let spacing = 2.0 * NEAR_M / CARS as f64;
        let cars = (0..CARS).map(|i| {
            let lane = if i % 2 == 0 { 1.0 } else { -1.0 };
            let at = s - NEAR_M + spacing * (i as f64 + rng.random_range(0.2..0.8));
            let desired_mps = desired(&mut rng, lane, speed_mps);
            let across = lane * LANE_M;
            Other { s: at, across, speed_mps: desired_mps, across_mps: 0.0, desired_mps, lane, change: None }
        });
        let cars = cars.collect();
        let calm_s = rng.random_range(CALM_S);
        Traffic { rng, cars, guest: None, calm_s, cut_ins: 0 }
    }

    /// What a step makes of them, around the ego car at `s`, which drives in the middle lane.
    pub fn step(&mut self, s: f64, speed_mps: f64) {
        self.cut_in(s, speed_mps);
        let before = self.cars.clone();
        for (index, car) in self.cars.iter_mut().enumerate() {
            // The nearest one ahead in its lane, the ego car among them.
            let in_lane = |other: &Other| (other.across - car.across).abs() < 0.6 * LANE_M;
            let others = before.iter().enumerate().filter(|(i, other)| *i != index && in_lane(other));
            let ego = (car.across.abs() < 0.6 * LANE_M).then_some((s, speed_mps));
            let ahead =
                others.map(|(_, other)| (other.s, other.speed_mps)).chain(ego).filter(|(at, _)| *at > car.s);
            let ahead = ahead.min_by(|a, b| a.0.total_cmp(&b.0));
            car.follow(ahead);
            car.change_lane();
        }
        for car in &mut self.cars {
            if (car.s - s).abs() > NEAR_M + 20.0 {
                let lane = if self.rng.random_bool(0.5) { 1.0 } else { -1.0 };
                car.s = if car.s < s { s + NEAR_M } else { s - NEAR_M };
                car.desired_mps = desired(&mut self.rng, lane, speed_mps);
                (car.lane, car.across, car.speed_mps) = (lane, lane * LANE_M, car.desired_mps);
                (car.across_mps, car.change) = (0.0, None);
            }
        }
    }

    /// Lets one come in front of the ego car, and later leave.
    fn cut_in(&mut self, s: f64, speed_mps: f64) {
        match &mut self.guest {
            Some((index, left_s)) => {
                *left_s -= STEP_S;
                let car = &mut self.cars[*index];
                let is_gone = (car.s - s).abs() > NEAR_M;
                if is_gone || (*left_s <= 0.0 && car.change.is_none() && car.lane == 0.0) {
                    // Leaves to the left, faster.
                    (car.lane, car.change) = (1.0, Some((0.0, car.across)));
                    car.desired_mps = car.desired_mps.max(speed_mps + 6.0);
                    self.guest = None;
                    self.calm_s = self.rng.random_range(CALM_S);
                }
            }
            None => {
                self.calm_s -= STEP_S;
                let distance = 22.0 + 0.4 * speed_mps;
                let fits = |car: &Other| {
                    let gap = car.s - s;
                    car.lane != 0.0 && car.change.is_none() && (distance..distance + 40.0).contains(&gap)
                };
                if self.calm_s > 0.0 || self.cars.iter().any(|car| car.lane == 0.0) {
                    return;
                }
                if let Some(index) = self.cars.iter().position(fits) {
                    let car = &mut self.cars[index];
                    (car.lane, car.change) = (0.0, Some((0.0, car.across)));
                    car.desired_mps = speed_mps - self.rng.random_range(0.0..5.0);
                    car.speed_mps = car.speed_mps.max(speed_mps - 4.0);
                    self.guest = Some((index, CHANGE_S + self.rng.random_range(STAY_S)));
                    self.cut_ins += 1;
                }
            }
        }
    }

    /// The cars, always as many.
    pub fn cars(&self) -> &[Other] {
        &self.cars
    }

    pub fn cut_ins(&self) -> u32 {
        self.cut_ins
    }

    /// Whether one that has cut in is still ahead.
    pub fn has_guest(&self) -> bool {
        self.guest.is_some()
    }
}

/// Faster on the left, slower on the right.
fn desired(rng: &mut StdRng, lane: f64, speed_mps: f64) -> f64 {
    (speed_mps + lane * rng.random_range(0.5..6.0)).max(15.0)
}

impl Other {
    /// A free speed, and a gap of 1.5 s behind who is ahead: at that distance and speed.
    fn follow(&mut self, ahead: Option<(f64, f64)>) {
        let free = 0.4 * (self.desired_mps - self.speed_mps);
        let kept = ahead.map_or(f64::INFINITY, |(at, speed_mps)| {
            let gap = at - self.s - LENGTH_M - 5.0 - 1.5 * self.speed_mps;
            0.15 * gap + 0.8 * (speed_mps - self.speed_mps)
        });
        let acceleration = free.min(kept).clamp(-7.0, 1.5);
        self.speed_mps = (self.speed_mps + acceleration * STEP_S).max(0.0);
        self.s += self.speed_mps * STEP_S;
    }

    /// Along a cosine.
    fn change_lane(&mut self) {
        let Some((since_s, from)) = &mut self.change else { return };
        *since_s += STEP_S;
        let share = (*since_s / CHANGE_S).min(1.0);
        let (target, before) = (self.lane * LANE_M, self.across);
        self.across = *from + (target - *from) * (1.0 - (std::f64::consts::PI * share).cos()) / 2.0;
        self.across_mps = (self.across - before) / STEP_S;
        if share >= 1.0 {
            (self.across, self.across_mps, self.change) = (target, 0.0, None);
        }
    }
}
