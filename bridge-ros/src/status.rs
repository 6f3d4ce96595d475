// SPDX-License-Identifier: MIT OR Apache-2.0
//! The status line.

use tautline_bridge_ros::{Direction, Stats};
use tautline_relay::{counted, passing};

/// `3 nodes in ROS | to ROS 4 topics 1.2 MB/s 100/s | from ROS 1 topic 80 kB/s 10/s | lost 0, dropped 0`
pub fn line(stats: &Stats) -> String {
    let ways = [(Direction::ToRos, "to ROS"), (Direction::FromRos, "from ROS")];
    let nodes = counted(stats.ros_nodes, "node", "nodes");
    let mut text = format!("{nodes} in ROS | {}", passing(&stats.topics, ways));
    if let Some((topic, incompatible)) = stats.incompatible_qos.iter().next() {
        text += &format!(" | incompatible QoS: {topic}: {}", incompatible.last_policy);
    }
    let services = stats.services.iter().filter(|service| service.active).count();
    if services > 0 {
        let failed: u64 = stats.services.iter().flat_map(|service| service.failed.values()).sum();
        text += &format!(" | {}, {failed} requests failed", counted(services, "service", "services"));
    }
    let not_bridged = || stats.not_bridged.iter().chain(&stats.services_not_bridged);
    if let Some((name, reason)) = not_bridged().next() {
        text += &format!(" | {} not bridged: {name}: {reason}", not_bridged().count());
    }
    text
}
