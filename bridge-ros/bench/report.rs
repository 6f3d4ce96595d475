// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a run measured.

use serde::{Deserialize, Serialize};
use tautline_bridge_ros::Direction;

/// What a subscriber got.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Received {
    pub messages: u64,
    pub p50_us: f64,
    pub p99_us: f64,
    pub p999_us: f64,
    pub max_us: f64,
}

/// One way.
#[derive(Clone, Debug, Serialize)]
pub struct Phase {
    pub direction: Direction,
    pub expected: u64,
    /// The subscriber on the publisher's side.
    pub direct: Received,
    /// The one on the other side.
    pub bridged: Received,
    /// Of one core.
    pub bridge_cpu_percent: f64,
}

impl Phase {
    /// Messages that the bridge lost: what the one behind it has not got.
    pub fn lost(&self) -> u64 {
        self.expected.saturating_sub(self.bridged.messages)
    }
}

pub fn print(phases: &[Phase], topics: usize, rate: u32, seconds: u32) {
    println!(
        "{topics} topics at {rate} Hz for {seconds} s each way; latency from publishing to the subscriber, in µs"
    );
    println!(
        "{:<10} {:<26} {:>9} {:>6} {:>9} {:>9} {:>9} {:>9}",
        "direction", "subscriber", "messages", "lost", "p50", "p99", "p99.9", "max"
    );
    for phase in phases {
        let (way, direct, bridged) = match phase.direction {
            Direction::FromRos => ("from ROS", "r2r, directly", "Tautline, by the bridge"),
            Direction::ToRos => ("to ROS", "Tautline, directly", "r2r, by the bridge"),
        };
        for (name, received) in [(direct, &phase.direct), (bridged, &phase.bridged)] {
            println!(
                "{way:<10} {name:<26} {:>9} {:>6} {:>9.1} {:>9.1} {:>9.1} {:>9.1}",
                received.messages,
                phase.expected.saturating_sub(received.messages),
                received.p50_us,
                received.p99_us,
                received.p999_us,
                received.max_us
            );
        }
        println!(
            "{way:<10} the bridge adds {:.1} µs to the p99, and uses {:.1} % of a core",
            phase.bridged.p99_us - phase.direct.p99_us,
            phase.bridge_cpu_percent
        );
    }
}
