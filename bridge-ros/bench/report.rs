// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a run measured.

use serde::{Deserialize, Serialize};
use tautline_bridge_ros::Direction;

/// What a subscriber got.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Received {
    /// In order, none twice.
    pub messages: u64,
    /// That came again, or after a later one of the same topic.
    pub disordered: u64,
    pub p50_us: f64,
    pub p99_us: f64,
    pub p999_us: f64,
    pub max_us: f64,
}

/// One way.
#[derive(Clone, Debug, Serialize)]
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
#[derive(Clone, Debug, Serialize)]
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

    /// What is wrong with what came by the bridge.
    pub fn fault(&self) -> Option<String> {
        let (lost, disordered) =
            (self.expected.saturating_sub(self.bridged.messages), self.bridged.disordered);
        let way = self.way();
        (lost > 0 || disordered > 0).then(|| {
            let Cpu { bridge, machine, .. } = self.cpu;
            format!(
                "{way}: {lost} of {} messages were lost, {disordered} came twice or out of order; the bridge used \
                 {bridge:.0} % of a core, and the machine was {machine:.0} % busy",
                self.expected
            )
        })
    }

    fn way(&self) -> &'static str {
        match self.direction {
            Direction::FromRos => "from ROS",
            Direction::ToRos => "to ROS",
        }
    }
}

pub fn print(phases: &[Phase], topics: usize) {
    let ways: Vec<String> =
        phases.iter().map(|phase| format!("at {} Hz {}", phase.rate, phase.way())).collect();
    println!(
        "{topics} topics {}; latency from publishing to the subscriber, in µs; CPU of its process, in % of a core",
        ways.join(", ")
    );
    println!(
        "{:<10} {:<24} {:>9} {:>6} {:>10} {:>9} {:>9} {:>9} {:>9} {:>6}",
        "direction", "subscriber", "messages", "lost", "disordered", "p50", "p99", "p99.9", "max", "CPU"
    );
    for phase in phases {
        let (beside, behind) = match phase.direction {
            Direction::FromRos => ("r2r, directly", "Tautline, by the bridge"),
            Direction::ToRos => ("Tautline, directly", "r2r, by the bridge"),
        };
        let way = phase.way();
        for (name, received, cpu) in
            [(beside, &phase.direct, phase.cpu.direct), (behind, &phase.bridged, phase.cpu.bridged)]
        {
            println!(
                "{way:<10} {name:<24} {:>9} {:>6} {:>10} {:>9.1} {:>9.1} {:>9.1} {:>9.1} {cpu:>6.1}",
                received.messages,
                phase.expected.saturating_sub(received.messages),
                received.disordered,
                received.p50_us,
                received.p99_us,
                received.p999_us,
                received.max_us
            );
        }
        let Phase { direct, bridged, cpu, .. } = phase;
        println!(
            "{way:<10} the bridge: p50 {:.1} instead of {:.1}, p99 {:.1} instead of {:.1}; it uses {:.1} % of a core, the \
             publisher {:.1} %; the machine is {:.0} % busy; published in {:.1} s",
            bridged.p50_us,
            direct.p50_us,
            bridged.p99_us,
            direct.p99_us,
            cpu.bridge,
            cpu.publisher,
            cpu.machine,
            phase.published_s
        );
        let rate_kept = phase.rate_kept();
        if rate_kept < 0.9 * f64::from(phase.rate) {
            println!("{way:<10} this machine is too slow for it: {rate_kept:.0} Hz");
        }
    }
}
