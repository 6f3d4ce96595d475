// SPDX-License-Identifier: MIT OR Apache-2.0
//! The 50 Hz controller: it finds the lane and who is ahead, plans in each 15th call, and tracks the plan with two PID controllers.

use crate::inputs::Inputs;
use crate::mpc::{self, HORIZON, PLAN_STEP_S, Problem};
use crate::signals::{Command, Line, State, Trajectory};
use crate::vehicle::{LENGTH_M, MAX_BRAKING, steering_of};
use crate::{PLAN_EVERY, STEP_S};

/// Lines older than this are none, in s.
const STALE_S: f64 = 0.2;
/// How far the ego lane has to be seen, in m.
const SEEN_M: f64 = 40.0;
/// Without lines it slows down, in m/s².
const MINIMUM_RISK: f64 = -3.0;
/// The next ego line's index, right and left.
const EGO_LINES: [usize; 2] = [1, 2];
/// Who is nearer to the lane's centre is in the lane, in m; and who is nearer than this and comes.
const IN_LANE_M: f64 = 1.5;
const COMING_M: f64 = 3.4;
const COMING_MPS: f64 = 0.4;
/// Nearer than this many seconds to a collision the plan is not waited for.
const EMERGENCY_S: f64 = 2.5;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Mode {
    /// Nothing: it may not be on, or has not seen a lane yet.
    #[default]
    Standby = 0,
    Active = 1,
    /// It has lost the lane, and brakes in the curve that it drives: the minimum risk manoeuvre.
    MinimumRisk = 2,
}

/// A PID controller with a clamped integral.
#[derive(Clone, Copy, Debug)]
pub struct Pid {
    gains: [f64; 3],
    most: f64,
    integral: f64,
    last: Option<f64>,
}

impl Pid {
    /// Gains of the error, its integral and its derivative; the integral's part is at most `most`.
    pub const fn new(gains: [f64; 3], most: f64) -> Pid {
        Pid { gains, most, integral: 0.0, last: None }
    }

    /// What is to be done about `error`, one step of 20 ms after the last one.
    pub fn step(&mut self, error: f64) -> f64 {
        let [p, i, d] = self.gains;
        self.integral = (self.integral + i * error * STEP_S).clamp(-self.most, self.most);
        let slope = self.last.map_or(0.0, |last| (error - last) / STEP_S);
        self.last = Some(error);
        p * error + self.integral + d * slope
    }

    pub fn reset(&mut self) {
        (self.integral, self.last) = (0.0, None);
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Output {
    pub command: Command,
    pub state: State,
    pub planned: bool,
}

/// The controller's own state; what it needs to know comes as [`Inputs`].
#[derive(Clone, Debug)]
pub struct Controller {
    calls: u64,
    mode: Mode,
    /// Of the distance from the plan, and what stays of that from the lane's centre.
    steering: Pid,
    offset: Pid,
    speed: Pid,
    plan: Option<Trajectory>,
    plan_age_s: f64,
    unsolved: u32,
    last: Command,
    curvature: f64,
}

impl Default for Controller {
    fn default() -> Controller {
        Controller {
            calls: 0,
            mode: Mode::Standby,
            // Of metres to 1/m.
            steering: Pid::new([6e-4, 0.0, 5e-4], 0.0),
            offset: Pid::new([0.0, 4e-4, 0.0], 4e-4),
            speed: Pid::new([0.6, 0.1, 0.0], 0.5),
            plan: None,
            plan_age_s: 0.0,
            unsolved: 0,
            last: Command::default(),
            curvature: 0.0,
        }
    }
}

impl Controller {
    /// The 50 Hz call, at `now_s` on the clock of [`Inputs::lines_at_s`].
    ///
    /// # Real-time
    /// Bounded and without allocation but for the calls that plan: see [`mpc`].
    pub fn run(&mut self, inputs: &Inputs, now_s: f64) -> Output {
        let plans = self.calls.is_multiple_of(PLAN_EVERY);
        self.calls += 1;
        self.plan_age_s += STEP_S;
        let lane = lane(inputs, now_s);
        self.mode = match (inputs.status & 1 == 1, &lane, self.mode) {
            (true, Some(_), _) => Mode::Active,
            (_, _, Mode::Standby) => Mode::Standby,
            _ => Mode::MinimumRisk,
        };
        let Some(lane) = lane.filter(|_| self.mode == Mode::Active) else { return self.without_lane() };
        let ahead = ahead(inputs, &lane);
        if plans {
            match mpc::plan(&self.problem(inputs, &lane, ahead)) {
                Some(plan) => (self.plan, self.plan_age_s) = (Some(plan), 0.0),
                // The last one goes on for as long as it reaches.
                None => self.unsolved += 1,
            }
        }
        let command = self.track(inputs, &lane, ahead);
        self.last = command;
        Output { command, state: self.state(-lane.coefficients[0], inputs, ahead), planned: plans }
    }

    pub fn trajectory(&self) -> Option<&Trajectory> {
        self.plan.as_ref()
    }

    fn problem(&self, inputs: &Inputs, lane: &Line, ahead: Option<(f64, f64)>) -> Problem {
        let speed_mps = inputs.speed_mps;
        let at = |k: usize| lane.curvature((k as f64 * PLAN_STEP_S * speed_mps).min(lane.range_m));
        Problem {
            lateral_m: -lane.coefficients[0],
            heading: -lane.coefficients[1],
            curvature: self.curvature,
            lane: std::array::from_fn(at),
            speed_mps,
            acceleration_mps2: self.last.acceleration_mps2,
            target_mps: inputs.driver.set_speed_mps,
            ahead,
        }
    }

    fn track(&mut self, inputs: &Inputs, lane: &Line, ahead: Option<(f64, f64)>) -> Command {
        let reach_s = (HORIZON - 1) as f64 * PLAN_STEP_S;
        let Some(plan) = self.plan.as_ref().filter(|_| self.plan_age_s < reach_s) else {
            return self.hold(lane.curvature(0.0));
        };
        let at = |values: &[f64; HORIZON]| {
            let place = self.plan_age_s / PLAN_STEP_S;
            let k = (place as usize).min(HORIZON - 2);
            values[k] + (values[k + 1] - values[k]) * (place - k as f64)
        };
        let (lateral_m, curvature) = (at(&plan.lateral_m), at(&plan.curvature));
        let (speed_mps, planned) = (at(&plan.speed_mps), at(&plan.acceleration_mps2));
        let offset = self.offset.step(lane.coefficients[0]);
        self.curvature = curvature + self.steering.step(lateral_m + lane.coefficients[0]);
        let wanted = planned + self.speed.step(speed_mps - inputs.speed_mps);
        let acceleration_mps2 = match ahead.and_then(|ahead| emergency(ahead, inputs.speed_mps)) {
            Some(braking) => wanted.min(braking),
            None => wanted,
        };
        Command { acceleration_mps2, steering_rad: steering_of(self.curvature + offset, inputs.speed_mps) }
    }

    /// No plan reaches this far: the curve of the lane, and slower.
    fn hold(&mut self, curvature: f64) -> Command {
        self.curvature = curvature;
        Command { acceleration_mps2: MINIMUM_RISK, steering_rad: self.last.steering_rad }
    }

    fn without_lane(&mut self) -> Output {
        self.steering.reset();
        self.offset.reset();
        self.speed.reset();
        self.plan = None;
        let braking = if self.mode == Mode::MinimumRisk { MINIMUM_RISK } else { 0.0 };
        self.last = Command { acceleration_mps2: braking, ..self.last };
        let state = State {
            mode: self.mode as u8,
            gap_m: f64::INFINITY,
            unsolved: self.unsolved,
            ..State::default()
        };
        Output { command: self.last, state, planned: false }
    }

    fn state(&self, lateral_m: f64, inputs: &Inputs, ahead: Option<(f64, f64)>) -> State {
        State {
            mode: self.mode as u8,
            lateral_m,
            target_mps: inputs.driver.set_speed_mps,
            gap_m: ahead.map_or(f64::INFINITY, |(gap_m, _)| gap_m),
            unsolved: self.unsolved,
        }
    }
}

/// The centre of the ego lane, if both its lines are seen and fresh.
fn lane(inputs: &Inputs, now_s: f64) -> Option<Line> {
    let [right, left] = EGO_LINES.map(|index| inputs.lines.of[index]);
    let range_m = right.range_m.min(left.range_m);
    let is_fresh = inputs.lines_at_s > 0.0 && now_s - inputs.lines_at_s <= STALE_S;
    let middle = |k: usize| (right.coefficients[k] + left.coefficients[k]) / 2.0;
    (is_fresh && range_m >= SEEN_M).then(|| Line { coefficients: std::array::from_fn(middle), range_m })
}

/// The nearest vehicle that is in the lane, or comes into it: bumper to bumper, and its speed.
fn ahead(inputs: &Inputs, lane: &Line) -> Option<(f64, f64)> {
    let vehicles = inputs.vehicles.as_slice().iter().filter(|vehicle| {
        let off = vehicle.y - lane.y(vehicle.x.min(lane.range_m));
        let comes = off * vehicle.across_mps < 0.0 && vehicle.across_mps.abs() > COMING_MPS;
        vehicle.x > 0.0 && (off.abs() < IN_LANE_M || (off.abs() < COMING_M && comes))
    });
    let nearest = vehicles.min_by(|a, b| a.x.total_cmp(&b.x))?;
    Some((nearest.x - LENGTH_M, nearest.speed_mps))
}

/// The braking that avoids a collision which is near: to the other's speed within the gap but 3 m.
fn emergency((gap_m, ahead_mps): (f64, f64), speed_mps: f64) -> Option<f64> {
    let closing = speed_mps - ahead_mps;
    let is_near = closing > 0.5 && gap_m / closing < EMERGENCY_S;
    is_near.then(|| (-closing * closing / (2.0 * (gap_m - 3.0).max(0.5))).max(-MAX_BRAKING))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::signals::{Vehicle, Vehicles};

    #[test]
    fn a_pid_is_its_formula_and_its_integral_has_an_end() {
        let mut pid = Pid::new([2.0, 1.0, 0.1], 0.03);
        assert!((pid.step(1.0) - 2.02).abs() < 1e-12, "no slope at first");
        assert!((pid.step(2.0) - (4.0 + 0.03 + 0.1 / STEP_S)).abs() < 1e-12, "the integral is clamped");
        pid.reset();
        assert!((pid.step(1.0) - 2.02).abs() < 1e-12);
    }

    fn inputs() -> Inputs {
        let mut inputs = Inputs { speed_mps: 36.0, status: 1, lines_at_s: 1.0, ..Inputs::default() };
        inputs.driver.set_speed_mps = 36.0;
        for (index, line) in inputs.lines.of.iter_mut().enumerate() {
            *line = Line { coefficients: [(index as f64 - 1.5) * 3.75, 0.0, 0.0, 0.0], range_m: 110.0 };
        }
        inputs
    }

    #[test]
    fn it_plans_in_each_fifteenth_call() {
        let (mut controller, inputs) = (Controller::default(), inputs());
        let planned: Vec<_> = (0..31).filter(|_| controller.run(&inputs, 1.0).planned).collect();
        assert_eq!(planned, [0, 15, 30]);
    }

    #[test]
    fn who_cuts_in_is_seen_before_it_is_in_the_lane() {
        let lane = lane(&inputs(), 1.0).unwrap();
        let with = |y: f64, across_mps: f64| {
            let mut inputs = inputs();
            inputs.vehicles = Vehicles { count: 1, ..Vehicles::default() };
            inputs.vehicles.of[0] = Vehicle { x: 50.0, y, speed_mps: 30.0, across_mps };
            ahead(&inputs, &lane)
        };
        let seen = Some((50.0 - LENGTH_M, 30.0));
        assert_eq!([with(0.5, 0.0), with(3.0, -1.0), with(-3.0, 1.0)], [seen; 3]);
        assert_eq!([with(3.75, 0.0), with(3.0, 1.0), with(3.0, 0.0)], [None; 3]);
    }

    #[test]
    fn without_lines_it_brakes_and_with_lines_it_goes_on() {
        let (mut controller, mut inputs) = (Controller::default(), inputs());
        assert_eq!(controller.run(&Inputs::default(), 1.0).state.mode, Mode::Standby as u8);
        assert_eq!(controller.run(&inputs, 1.0).state.mode, Mode::Active as u8);
        let lost = controller.run(&inputs, 1.0 + 2.0 * STALE_S);
        assert_eq!(
            (lost.state.mode, lost.command.acceleration_mps2),
            (Mode::MinimumRisk as u8, MINIMUM_RISK)
        );
        inputs.lines_at_s = 2.0;
        assert_eq!(controller.run(&inputs, 2.0).state.mode, Mode::Active as u8);
    }

    #[test]
    fn what_the_planner_cannot_solve_leaves_the_last_plan_and_is_counted() {
        let (mut controller, mut inputs) = (Controller::default(), inputs());
        controller.run(&inputs, 1.0);
        inputs.driver.set_speed_mps = f64::NAN;
        let unsolved = (0..15).map(|_| controller.run(&inputs, 1.0)).last().unwrap();
        assert_eq!((unsolved.state.unsolved, unsolved.state.mode), (1, Mode::Active as u8));
        assert!(controller.trajectory().is_some() && unsolved.command.steering_rad.is_finite());
    }

    #[test]
    fn a_collision_that_is_near_is_not_left_to_the_plan() {
        assert_eq!(emergency((80.0, 30.0), 36.0), None);
        assert_eq!(emergency((20.0, 36.0), 36.0), None);
        let braking = emergency((13.0, 26.0), 36.0).unwrap();
        assert!((braking + 5.0).abs() < 1e-9, "{braking}");
        assert_eq!(emergency((1.0, 0.0), 36.0), Some(-MAX_BRAKING));
    }
}
