// SPDX-License-Identifier: MIT OR Apache-2.0
//! The closed loop without any middleware: as fast as the processor can.

use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::control::Controller;
use crate::inputs::Inputs;
use crate::signals::Command;
use crate::simulator::{Simulator, Truth};
use crate::{START, STEP_S};

/// Every so many steps are kept for the picture: 10 Hz.
const KEEP_EVERY: usize = 5;
/// What is not counted, in s: the car finds its lane and its speed.
const WARM_UP_S: f64 = 5.0;

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Drive {
    pub seed: u64,
    pub seconds: f64,
    pub kilometres: f64,
    /// Distance from the lane's centre: largest and root mean square, in m.
    pub lateral_max_m: f64,
    pub lateral_rms_m: f64,
    pub mean_kmh: f64,
    /// Share of the time in curves, 0 to 1.
    pub in_curves: f64,
    pub cut_ins: u32,
    /// Smallest distance to the one ahead, bumper to bumper, in m.
    pub gap_min_m: Option<f64>,
    pub collisions: u32,
    /// How often the planner ran, and how often it found nothing.
    pub plans: u32,
    pub unsolved: u32,
    /// Longest and mean time of a call that planned, in ms: by the wall clock of this machine.
    pub plan_max_ms: f64,
    pub plan_mean_ms: f64,
    /// The drive, ten times a second.
    #[serde(default)]
    pub course: Vec<Truth>,
}

/// What adds up while driving: also for a drive over a middleware.
#[derive(Clone, Debug, Default)]
pub struct Logbook {
    drive: Drive,
    steps: usize,
    counted: usize,
    squares: f64,
    metres: f64,
    curves: usize,
}

impl Logbook {
    /// An empty one, with room for `seconds`.
    pub fn new(seed: u64, seconds: f64) -> Logbook {
        let room = (seconds / STEP_S) as usize / KEEP_EVERY + 2;
        let drive = Drive { seed, course: Vec::with_capacity(room), ..Drive::default() };
        Logbook { drive, ..Logbook::default() }
    }

    pub fn note(&mut self, truth: &Truth) {
        if self.steps.is_multiple_of(KEEP_EVERY) && self.drive.course.len() < self.drive.course.capacity() {
            self.drive.course.push(*truth);
        }
        self.steps += 1;
        self.metres += truth.speed_mps * STEP_S;
        (self.drive.cut_ins, self.drive.collisions) = (truth.cut_ins, truth.collisions);
        if truth.time_s < WARM_UP_S {
            return;
        }
        self.counted += 1;
        self.squares += truth.lateral_m * truth.lateral_m;
        self.curves += usize::from(truth.curvature != 0.0);
        self.drive.lateral_max_m = self.drive.lateral_max_m.max(truth.lateral_m.abs());
        self.drive.gap_min_m = self.drive.gap_min_m.into_iter().chain(truth.gap_m).min_by(f64::total_cmp);
    }

    pub fn close(self) -> Drive {
        let seconds = self.steps as f64 * STEP_S;
        let counted = self.counted.max(1) as f64;
        Drive {
            seconds,
            kilometres: self.metres / 1e3,
            lateral_rms_m: (self.squares / counted).sqrt(),
            mean_kmh: self.metres / seconds.max(STEP_S) * 3.6,
            in_curves: self.curves as f64 / counted,
            ..self.drive
        }
    }
}

/// Drives for so many simulated minutes; `progress` hears the share that is done, 0 to 1.
pub fn run(seed: u64, minutes: f64, mut progress: impl FnMut(f64)) -> Drive {
    let steps = (minutes * 60.0 / STEP_S).round() as usize;
    let mut simulator = Simulator::new(seed, minutes);
    let (mut inputs, mut controller) = (Inputs::default(), Controller::default());
    let mut logbook = Logbook::new(seed, steps as f64 * STEP_S);
    let mut command = Command::default();
    let (mut plans, mut unsolved, mut plan_max_ms, mut plan_sum_ms) = (0, 0, 0.0_f64, 0.0);
    for step in 0..steps {
        let fast = simulator.step(&command);
        inputs.take_fast(&fast, START);
        if simulator.is_slow_due() {
            let slow = simulator.slow();
            inputs.take_slow(&slow, simulator.time_s());
        }
        let before = Instant::now();
        let output = controller.run(&inputs, simulator.time_s());
        if output.planned {
            let took_ms = before.elapsed().as_secs_f64() * 1e3;
            (plans, plan_max_ms, plan_sum_ms) = (plans + 1, plan_max_ms.max(took_ms), plan_sum_ms + took_ms);
        }
        (command, unsolved) = (output.command, output.state.unsolved);
        logbook.note(&simulator.truth());
        if step.is_multiple_of(500) {
            progress(step as f64 / steps as f64);
        }
    }
    let plan_mean_ms = plan_sum_ms / f64::from(plans.max(1));
    Drive { plans, unsolved, plan_max_ms, plan_mean_ms, ..logbook.close() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_seed_is_the_same_drive_to_the_bit() {
        let course = |seed| run(seed, 0.5, |_| {}).course;
        assert_eq!(course(11), course(11));
        assert_ne!(course(11), course(12));
    }
}
