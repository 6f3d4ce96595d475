// SPDX-License-Identifier: MIT OR Apache-2.0
//! The planner: the next three seconds as a quadratic program, solved by interior points (Clarabel, Goulart and Chen 2024).
//!
//! Along the lane, with the present speed V, distance e from its centre, heading p relative to it, curvature c of the lane and u to drive,
//! speed v, way s, acceleration a, and the vehicle ahead at g with speed w, for each step of length T:
//! ```text
//! e' = e + T V p          p' = p + T V (u - c)        |u| <= most, |u' - u| <= T jerk / V²
//! v' = v + T a            s' = s + T v + T²/2 a       a within limits, |a' - a| <= T jerk
//! s + gap + headway v - slack <= g + w t              slack >= 0
//! minimise  e² + (V p)² + V⁴ (u - c)² + V⁴ (u' - u)² + (v - target)² + a² + (a' - a)² + slack² + slack, each with its weight
//! ```
//! # Real-time
//! The solver allocates, and takes as many iterations as it needs, at most [`ITERATIONS`]: for a thread of low priority.

use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettings, DefaultSolver, IPSolver, NonnegativeConeT, SolverStatus, ZeroConeT};

use crate::signals::{PLAN_POINTS, Trajectory};

/// Steps ahead.
pub const HORIZON: usize = PLAN_POINTS;
/// Between two of them, in s.
pub const PLAN_STEP_S: f64 = 0.05;
pub const ITERATIONS: u32 = 40;
/// Across the lane, in m/s² and m/s³.
const MAX_LATERAL: f64 = 3.0;
const LATERAL_JERK: f64 = 5.0;
/// Along it.
const ACCELERATIONS: [f64; 2] = [-6.0, 1.5];
const JERK: f64 = 8.0;
/// Bumper to bumper at a standstill, in m, and the time to the vehicle ahead, in s.
const GAP_M: f64 = 6.0;
pub(crate) const HEADWAY_S: f64 = 1.5;
/// Weights.
const LATERAL: f64 = 1.0;
const HEADING: f64 = 0.3;
const CURVING: f64 = 0.02;
const STEERING: f64 = 2.0;
const SPEED: f64 = 0.5;
const ACCELERATION: f64 = 1.0;
const JERKING: f64 = 20.0;
const SLACK: f64 = 50.0;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Problem {
    /// To the left of the lane's centre, in m.
    pub lateral_m: f64,
    /// Relative to the lane, in rad.
    pub heading: f64,
    /// Driven at present, in 1/m.
    pub curvature: f64,
    /// Of the lane at each step, in 1/m.
    pub lane: [f64; HORIZON],
    pub speed_mps: f64,
    pub acceleration_mps2: f64,
    pub target_mps: f64,
    /// Of the vehicle ahead: bumper to bumper in m, and its speed in m/s.
    pub ahead: Option<(f64, f64)>,
}

/// The matrix of the constraints and its right side, row by row.
#[derive(Default)]
struct Rows {
    entries: (Vec<usize>, Vec<usize>, Vec<f64>),
    right: Vec<f64>,
}

impl Rows {
    fn add(&mut self, entries: &[(usize, f64)], right: f64) {
        for &(column, value) in entries {
            self.entries.0.push(self.right.len());
            self.entries.1.push(column);
            self.entries.2.push(value);
        }
        self.right.push(right);
    }

    /// least <= the sum <= most.
    fn within(&mut self, entries: &[(usize, f64)], least: f64, most: f64) {
        self.add(entries, most);
        let negative: Vec<_> = entries.iter().map(|&(column, value)| (column, -value)).collect();
        self.add(&negative, -least);
    }
}

/// The variables of step k, by their place; states are those after it.
macro_rules! variables {
    ($($name:ident = $place:literal),*) => {
        $(const fn $name(k: usize) -> usize {
            $place * HORIZON + k
        })*
    };
}
variables!(e = 0, p = 1, u = 2, v = 3, s = 4, a = 5, slack = 6);
const VARIABLES: usize = 7 * HORIZON;

/// The best trajectory; `None` if the solver found none within its iterations.
pub fn plan(problem: &Problem) -> Option<Trajectory> {
    let speed = problem.speed_mps.max(1.0);
    let mut rows = Rows::default();
    dynamics(problem, speed, &mut rows);
    let equalities = rows.right.len();
    limits(problem, speed, &mut rows);
    let inequalities = rows.right.len() - equalities;
    let (quadratic, linear) = cost(problem, speed);
    let (i, j, values) = rows.entries;
    let constraints = CscMatrix::new_from_triplets(rows.right.len(), VARIABLES, i, j, values);
    let cones = [ZeroConeT(equalities), NonnegativeConeT(inequalities)];
    let settings = DefaultSettings { verbose: false, max_iter: ITERATIONS, ..DefaultSettings::default() };
    let solver = DefaultSolver::new(&quadratic, &linear, &constraints, &rows.right, &cones, settings);
    let mut solver = solver.ok()?;
    solver.solve();
    if !matches!(solver.solution.status, SolverStatus::Solved | SolverStatus::AlmostSolved) {
        return None;
    }
    let x = &solver.solution.x;
    let points = |index: fn(usize) -> usize| -> [f64; PLAN_POINTS] { std::array::from_fn(|k| x[index(k)]) };
    let trajectory = Trajectory {
        lateral_m: points(e),
        curvature: points(u),
        speed_mps: points(v),
        acceleration_mps2: points(a),
    };
    x.iter().all(|value| value.is_finite()).then_some(trajectory)
}

fn dynamics(problem: &Problem, speed: f64, rows: &mut Rows) {
    const T: f64 = PLAN_STEP_S;
    for (k, lane) in problem.lane.iter().enumerate() {
        let curve = -T * speed * lane;
        match k.checked_sub(1) {
            None => {
                rows.add(&[(e(0), 1.0)], problem.lateral_m + T * speed * problem.heading);
                rows.add(&[(p(0), 1.0), (u(0), -T * speed)], problem.heading + curve);
                rows.add(&[(v(0), 1.0), (a(0), -T)], problem.speed_mps);
                rows.add(&[(s(0), 1.0), (a(0), -T * T / 2.0)], T * problem.speed_mps);
            }
            Some(last) => {
                rows.add(&[(e(k), 1.0), (e(last), -1.0), (p(last), -T * speed)], 0.0);
                rows.add(&[(p(k), 1.0), (p(last), -1.0), (u(k), -T * speed)], curve);
                rows.add(&[(v(k), 1.0), (v(last), -1.0), (a(k), -T)], 0.0);
                rows.add(&[(s(k), 1.0), (s(last), -1.0), (v(last), -T), (a(k), -T * T / 2.0)], 0.0);
            }
        }
    }
}

fn limits(problem: &Problem, speed: f64, rows: &mut Rows) {
    let most = MAX_LATERAL / (speed * speed).max(25.0);
    let change = PLAN_STEP_S * LATERAL_JERK / (speed * speed).max(25.0);
    // What is driven already may be beyond what is planned.
    let curvature = problem.curvature.clamp(-most, most);
    let acceleration = problem.acceleration_mps2.clamp(ACCELERATIONS[0], ACCELERATIONS[1]);
    for k in 0..HORIZON {
        rows.within(&[(u(k), 1.0)], -most, most);
        rows.within(&[(a(k), 1.0)], ACCELERATIONS[0], ACCELERATIONS[1]);
        let jerk = PLAN_STEP_S * JERK;
        match k.checked_sub(1) {
            None => {
                rows.within(&[(u(0), 1.0)], curvature - change, curvature + change);
                rows.within(&[(a(0), 1.0)], acceleration - jerk, acceleration + jerk);
            }
            Some(last) => {
                rows.within(&[(u(k), 1.0), (u(last), -1.0)], -change, change);
                rows.within(&[(a(k), 1.0), (a(last), -1.0)], -jerk, jerk);
            }
        }
        rows.add(&[(slack(k), -1.0)], 0.0);
        if let Some((gap_m, ahead_mps)) = problem.ahead {
            let time = (k + 1) as f64 * PLAN_STEP_S;
            let there = gap_m - GAP_M + ahead_mps * time;
            rows.add(&[(s(k), 1.0), (v(k), HEADWAY_S), (slack(k), -1.0)], there);
        }
    }
}

/// The upper triangle of the quadratic part, and the linear part.
fn cost(problem: &Problem, speed: f64) -> (CscMatrix<f64>, Vec<f64>) {
    let (mut i, mut j, mut values) = (Vec::new(), Vec::new(), Vec::new());
    let mut linear = vec![0.0; VARIABLES];
    let mut add = |row: usize, column: usize, value: f64| {
        i.push(row.min(column));
        j.push(row.max(column));
        values.push(value);
    };
    // To the power of four, and so small that all weights are of one size.
    let scale = speed.powi(4).max(1.0);
    for (k, lane) in problem.lane.iter().enumerate() {
        add(e(k), e(k), 2.0 * LATERAL);
        add(p(k), p(k), 2.0 * HEADING * speed * speed);
        add(u(k), u(k), 2.0 * CURVING * scale);
        linear[u(k)] -= 2.0 * CURVING * scale * lane;
        add(v(k), v(k), 2.0 * SPEED);
        linear[v(k)] -= 2.0 * SPEED * problem.target_mps;
        add(a(k), a(k), 2.0 * ACCELERATION);
        add(slack(k), slack(k), 2.0 * SLACK);
        linear[slack(k)] += SLACK;
        for (input, weight) in [(u as fn(usize) -> usize, STEERING * scale), (a, JERKING)] {
            add(input(k), input(k), 2.0 * weight);
            if k > 0 {
                add(input(k - 1), input(k - 1), 2.0 * weight);
                add(input(k - 1), input(k), -2.0 * weight);
            }
        }
    }
    linear[u(0)] -= 2.0 * STEERING * scale * problem.curvature;
    linear[a(0)] -= 2.0 * JERKING * problem.acceleration_mps2;
    (CscMatrix::new_from_triplets(VARIABLES, VARIABLES, i, j, values), linear)
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEADY: Problem = Problem {
        lateral_m: 0.0,
        heading: 0.0,
        curvature: 0.0,
        lane: [0.0; HORIZON],
        speed_mps: 36.0,
        acceleration_mps2: 0.0,
        target_mps: 36.0,
        ahead: None,
    };

    #[test]
    fn who_is_where_it_should_be_stays_there() {
        let plan = plan(&STEADY).unwrap();
        assert!(plan.lateral_m.iter().chain(&plan.acceleration_mps2).all(|value| value.abs() < 1e-4));
        assert!(plan.curvature.iter().all(|value| value.abs() < 1e-6), "{:?}", plan.curvature);
    }

    #[test]
    fn a_plan_leads_to_the_centre_within_the_limits() {
        let lane = [1.0 / 900.0; HORIZON];
        let problem = Problem { lateral_m: 0.4, curvature: 1.0 / 900.0, lane, ..STEADY };
        let plan = plan(&problem).unwrap();
        assert!(plan.lateral_m[HORIZON - 1].abs() < 0.1, "{:?}", plan.lateral_m);
        let change = PLAN_STEP_S * LATERAL_JERK / (36.0 * 36.0) * 1.001;
        let mut last = problem.curvature;
        for curvature in plan.curvature {
            assert!((curvature - last).abs() <= change && curvature.abs() <= MAX_LATERAL / 1296.0 * 1.001);
            last = curvature;
        }
        // Its own dynamics, step by step.
        let (mut lateral, mut heading) = (problem.lateral_m, problem.heading);
        for (k, curvature) in plan.curvature.iter().enumerate() {
            lateral += PLAN_STEP_S * 36.0 * heading;
            heading += PLAN_STEP_S * 36.0 * (curvature - lane[k]);
            assert!((lateral - plan.lateral_m[k]).abs() < 1e-3);
        }
    }

    #[test]
    fn it_brakes_for_who_is_ahead_as_softly_as_it_may() {
        let slower = Problem { ahead: Some((60.0, 25.0)), ..STEADY };
        let plan = plan(&slower).unwrap();
        let mut last = 0.0;
        for acceleration in plan.acceleration_mps2 {
            assert!((ACCELERATIONS[0] - 1e-3..=ACCELERATIONS[1] + 1e-3).contains(&acceleration));
            assert!((acceleration - last).abs() <= PLAN_STEP_S * JERK * 1.001);
            last = acceleration;
        }
        assert!(plan.speed_mps[HORIZON - 1] < 31.0, "{:?}", plan.speed_mps);
    }

    #[test]
    fn what_cannot_be_solved_is_none() {
        assert_eq!(plan(&Problem { lateral_m: f64::NAN, ..STEADY }), None);
        assert_eq!(plan(&Problem { target_mps: f64::INFINITY, ..STEADY }), None);
    }
}
