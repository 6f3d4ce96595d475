// SPDX-License-Identifier: MIT OR Apache-2.0
//! An automated lane keeping system (UN Regulation 157) with the car, the road and the traffic that it needs, for any middleware:
//! the case study of an ECRTS 2025 paper, whose simulator and controllers are not public, made anew.
//!
//! | module | holds |
//! |---|---|
//! | [`signals`] | what is exchanged: eleven topics of the car, the command to it, what is shown |
//! | [`road`], [`vehicle`], [`traffic`], [`sensors`] | the motorway, a bicycle model, other cars, what the car perceives |
//! | [`simulator`] | all of these, a step of 20 ms at a time, deterministic from a seed |
//! | [`inputs`], [`control`], [`mpc`] | what subscribers keep, the controllers of the 50 Hz timer, the planner of each 15th call |
//! | [`markers`] | what a visualizer draws |
//! | [`drive`], [`picture`] | the closed loop without any middleware, and a picture of it |
//! | [`sharing`] | how subscribers and timer share the inputs |
//! | [`job`] | the three processes: how they begin and end |
//! | [`records`] | latencies and durations, written down without allocation |
//! | [`messages!`] | to and from ROS's messages, of whichever crate has them |
//!
//! Lengths are in metres, times in seconds, angles in radians; x points ahead, y to the left, as REP 103 has it.
#![forbid(unsafe_code)]
#![allow(missing_docs, reason = "many names say it all")]

pub mod control;
pub mod drive;
pub mod inputs;
pub mod job;
pub mod markers;
mod messages;
pub mod mpc;
pub mod picture;
pub mod records;
pub mod road;
pub mod sensors;
pub mod sharing;
pub mod signals;
pub mod simulator;
pub mod traffic;
pub mod vehicle;

/// Time between two steps of the simulation, two calls of the controller and two messages of the fast topics.
pub const STEP_S: f64 = 0.02;
/// The slow topics, vehicles and lines, come every so many steps: 25 Hz.
pub const SLOW_EVERY: u64 = 2;
/// The planner runs in each so many-th call of the controller: every 300 ms.
pub const PLAN_EVERY: u64 = 15;
/// Where every drive begins: what the odometry is relative to.
pub const START: signals::Pose = signals::Pose { x: 50.0, y: 0.0, yaw: 0.0 };
/// The speed that is wanted: 130 km/h.
pub const CRUISE_MPS: f64 = 130.0 / 3.6;

/// `CLOCK_MONOTONIC`, in s: what controllers are called with.
pub fn now_s() -> f64 {
    tautline_rt::clock::monotonic_ns() as f64 / 1e9
}
