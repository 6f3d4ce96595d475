// SPDX-License-Identifier: MIT OR Apache-2.0
//! The line that is shown while it runs.

use tautline_bridge_ros::{Direction, Stats};
use tautline_relay::{counted, rate};

/// `3 nodes in ROS | to ROS 4 topics 1.2 MB/s 100/s | from ROS 1 topic 80 kB/s 10/s | lost 0, dropped 0`
pub fn line(stats: &Stats) -> String {
    let way = |direction, name| {
        let of = || stats.topics.iter().filter(move |topic| topic.active && topic.direction == direction);
        // Not `sum`, which begins with -0.
        let bytes = of().map(|topic| topic.numbers.bytes_per_s).fold(0.0, |sum, rate| sum + rate);
        let messages = of().map(|topic| topic.numbers.messages_per_s).fold(0.0, |sum, rate| sum + rate);
        format!("{name} {} {} {messages:.0}/s", counted(of().count(), "topic", "topics"), rate(bytes))
    };
    let lost: u64 = stats.topics.iter().map(|topic| topic.numbers.lost).sum();
    let dropped: u64 = stats.topics.iter().flat_map(|topic| topic.numbers.dropped.values()).sum();
    let mut text = format!(
        "{} in ROS | {} | {} | lost {lost}, dropped {dropped}",
        counted(stats.ros_nodes, "node", "nodes"),
        way(Direction::ToRos, "to ROS"),
        way(Direction::FromRos, "from ROS"),
    );
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

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_bridge_ros::{TopicNumbers, TopicStats};

    #[test]
    fn a_line_says_what_matters() {
        let numbers =
            TopicNumbers { messages_per_s: 10.0, bytes_per_s: 80e3, lost: 2, ..TopicNumbers::default() };
        let topic = TopicStats {
            topic: "/a".into(),
            ros_topic: "/a".into(),
            type_name: "a/msg/A".into(),
            direction: Direction::FromRos,
            active: true,
            numbers,
        };
        let not_bridged = [("/b".to_owned(), "no".to_owned())].into();
        let stats = Stats { ros_nodes: 1, topics: vec![topic], not_bridged, ..Stats::default() };
        assert_eq!(
            line(&stats),
            "1 node in ROS | to ROS 0 topics 0 B/s 0/s | from ROS 1 topic 80.0 kB/s 10/s | lost 2, dropped 0 | 1 not bridged: /b: no"
        );
    }
}
