// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a run measured, as readings.

use crate::ends::Received;
use tautline_harness::Distribution;
use tautline_harness::readings::Reading;

/// Of messages over the bridge.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// From Tautline to ROS.
    ToRos,
    /// From ROS to Tautline.
    FromRos,
}

/// One way.
pub struct Phase {
    pub direction: Direction,
    /// Messages per second of each topic.
    pub rate: u32,
    /// Of each topic.
    pub messages: u32,
    /// Of all topics.
    pub expected: u64,
    /// The subscriber on the publisher's side.
    pub direct: Received,
    /// The one on the other side.
    pub bridged: Received,
    /// How long publishing took: more than it should if the machine is too slow for it.
    pub published_s: f64,
    pub cpu: Cpu,
}

/// Processor time while messages are published, in percent of one core.
pub struct Cpu {
    pub bridge: f64,
    /// The process of the subscriber on the publisher's side.
    pub direct: f64,
    /// That of the one on the other side.
    pub bridged: f64,
    pub publisher: f64,
    /// All that runs on the machine, in percent of all cores.
    pub machine: f64,
}

impl Phase {
    /// Messages per second of each topic at which the machine would be 50 % busy.
    pub fn rate_that_fits(&self) -> u32 {
        ((self.rate_kept() * 50.0 / self.cpu.machine.max(1.0)) as u32).max(1)
    }

    /// Messages per second of each topic that were published.
    fn rate_kept(&self) -> f64 {
        f64::from(self.messages) / self.published_s
    }

    /// What its readings call it.
    pub fn way(direction: Direction) -> &'static str {
        match direction {
            Direction::FromRos => "from ROS",
            Direction::ToRos => "to ROS",
        }
    }

    pub fn readings(&self) -> Vec<Reading> {
        let of = |what: &str, unit| Reading::of(Self::way(self.direction), 0, what, unit);
        let systems = match self.direction {
            Direction::FromRos => ["r2r", "tautline"],
            Direction::ToRos => ["tautline", "r2r"],
        };
        let mut readings = Vec::new();
        let subscribers =
            [("directly", &self.direct, self.cpu.direct), ("by the bridge", &self.bridged, self.cpu.bridged)];
        for (system, (how, received, cpu)) in systems.into_iter().zip(subscribers) {
            // Of what the bridge does no machine has a part in it.
            let none = (how == "by the bridge").then_some(0.0);
            let mut times = Distribution::new();
            times.add(&received.latencies_ns);
            let [lost, disordered] = [self.expected.saturating_sub(times.len()), received.disordered];
            let of = |what: &str, unit| of(&format!("{what}, {how}"), unit).system(system);
            readings.push(of("from publishing to the subscriber", "µs").times(&times));
            let lost = of("lost", "messages").value(lost as f64).note(format!("of {}", self.expected));
            readings.push(lost.at_most(none).must());
            let disordered = of("twice or out of order", "messages").value(disordered as f64);
            readings.push(disordered.at_most(none).must());
            readings.push(of("CPU of the subscriber", "% of a core").value(cpu));
        }
        readings.push(of("CPU of the bridge", "% of a core").value(self.cpu.bridge));
        readings.push(of("CPU of the publisher", "% of a core").value(self.cpu.publisher));
        readings.push(of("CPU of the machine", "% of all cores").value(self.cpu.machine));
        let kept = of("published", "Hz of each topic").value(self.rate_kept());
        let is_slow = self.rate_kept() < 0.9 * f64::from(self.rate);
        let note = if is_slow { ": this machine is too slow for it" } else { "" };
        readings.push(kept.note(format!("{} were asked for{note}", self.rate)));
        readings
    }
}
