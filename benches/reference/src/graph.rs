// SPDX-License-Identifier: MIT OR Apache-2.0
//! The graph: 24 nodes and what joins them. A topic has the name of the node that publishes it, but for the second output
//! of the intersection.

use std::slice;
use std::time::Duration;

/// The beginning of the hot path.
pub const FRONT_LIDAR: &str = "FrontLidarDriver";
/// What is fused with it.
pub const REAR_LIDAR: &str = "RearLidarDriver";
/// The end of the hot path.
pub const ESTIMATOR: &str = "ObjectCollisionEstimator";
/// The node whose punctuality is measured.
pub const PLANNER: &str = "BehaviorPlanner";

#[derive(Debug)]
pub struct Node {
    pub name: &'static str,
    pub kind: Kind,
}

/// What a node does.
#[derive(Debug)]
pub enum Kind {
    /// Publishes periodically.
    Sensor { period_ms: u64 },
    /// Works on each message and passes it on.
    Transform { input: &'static str },
    /// Keeps the latest message of both topics; with both it works, publishes, and forgets them.
    Fusion { inputs: [&'static str; 2] },
    /// Works periodically on what has come since, and publishes.
    Cyclic { period_ms: u64, inputs: &'static [&'static str] },
    /// Several transforms.
    Intersection {
        /// The topic that comes in and the one that goes out, of each.
        ways: &'static [(&'static str, &'static str)],
    },
    /// The end of a path.
    Command { input: &'static str },
}

const fn sensor(name: &'static str, period_ms: u64) -> Node {
    Node { name, kind: Kind::Sensor { period_ms } }
}

const fn transform(name: &'static str, input: &'static str) -> Node {
    Node { name, kind: Kind::Transform { input } }
}

const fn fusion(name: &'static str, inputs: [&'static str; 2]) -> Node {
    Node { name, kind: Kind::Fusion { inputs } }
}

const fn command(name: &'static str, input: &'static str) -> Node {
    Node { name, kind: Kind::Command { input } }
}

pub static NODES: [Node; 24] = [
    // Before its neighbour of the same period, with which it is fused: see `system.toml`.
    sensor(REAR_LIDAR, 100),
    sensor(FRONT_LIDAR, 100),
    sensor("PointCloudMap", 120),
    sensor("Visualizer", 60),
    sensor("Lanelet2Map", 100),
    sensor("EuclideanClusterSettings", 25),
    transform("PointsTransformerFront", FRONT_LIDAR),
    transform("PointsTransformerRear", REAR_LIDAR),
    transform("VoxelGridDownsampler", "PointCloudFusion"),
    transform("PointCloudMapLoader", "PointCloudMap"),
    transform("RayGroundFilter", "PointCloudFusion"),
    transform(ESTIMATOR, "EuclideanClusterDetector"),
    transform("MPCController", PLANNER),
    transform("ParkingPlanner", "Lanelet2MapLoader"),
    transform("LanePlanner", "Lanelet2MapLoader"),
    fusion("PointCloudFusion", ["PointsTransformerFront", "PointsTransformerRear"]),
    fusion("NDTLocalizer", ["VoxelGridDownsampler", "PointCloudMapLoader"]),
    fusion("VehicleInterface", ["MPCController", PLANNER]),
    fusion("Lanelet2GlobalPlanner", ["Visualizer", "NDTLocalizer"]),
    fusion("Lanelet2MapLoader", ["Lanelet2Map", "Lanelet2GlobalPlanner"]),
    Node {
        name: PLANNER,
        kind: Kind::Cyclic {
            period_ms: 100,
            inputs: &[
                ESTIMATOR,
                "NDTLocalizer",
                "Lanelet2GlobalPlanner",
                "Lanelet2MapLoader",
                "ParkingPlanner",
                "LanePlanner",
            ],
        },
    },
    Node {
        name: "EuclideanClusterDetector",
        kind: Kind::Intersection {
            ways: &[
                ("RayGroundFilter", "EuclideanClusterDetector"),
                ("EuclideanClusterSettings", "EuclideanIntersection"),
            ],
        },
    },
    command("VehicleDBWSystem", "VehicleInterface"),
    command("IntersectionOutput", "EuclideanIntersection"),
];

/// A callback of a node. All have one, but for the intersection, which has one for each of its ways.
#[derive(Clone, Copy, Debug)]
pub struct Callback {
    /// Its name: that of its output, or of its node if it has none.
    pub name: &'static str,
    pub node: &'static str,
    pub trigger: Trigger,
    /// The topics that it hears.
    pub inputs: &'static [&'static str],
    /// The topic that it publishes.
    pub output: Option<&'static str>,
    /// Whether it counts primes: where a path neither begins nor ends.
    pub works: bool,
    /// Whether its node is a [`Kind::Transform`].
    pub is_transform: bool,
}

/// When a callback runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trigger {
    /// Periodically.
    Period(Duration),
    /// On each message of any input.
    Any,
    /// As soon as there is a message of each input.
    All,
}

impl Node {
    pub fn callbacks(&'static self) -> Vec<Callback> {
        let callback = |trigger, inputs, output: Option<&'static str>, works| Callback {
            name: output.unwrap_or(self.name),
            node: self.name,
            trigger,
            inputs,
            output,
            works,
            is_transform: matches!(self.kind, Kind::Transform { .. }),
        };
        let every = |period_ms: &u64| Trigger::Period(Duration::from_millis(*period_ms));
        let own = Some(self.name);
        match &self.kind {
            Kind::Sensor { period_ms } => vec![callback(every(period_ms), &[], own, false)],
            Kind::Transform { input } => vec![callback(Trigger::Any, slice::from_ref(input), own, true)],
            Kind::Fusion { inputs } => vec![callback(Trigger::All, inputs, own, true)],
            Kind::Cyclic { period_ms, inputs } => vec![callback(every(period_ms), inputs, own, true)],
            Kind::Intersection { ways } => ways
                .iter()
                .map(|(input, output)| callback(Trigger::Any, slice::from_ref(input), Some(output), true))
                .collect(),
            Kind::Command { input } => vec![callback(Trigger::Any, slice::from_ref(input), None, false)],
        }
    }
}

/// The callbacks of all nodes, in their order.
pub fn callbacks() -> Vec<Callback> {
    NODES.iter().flat_map(Node::callbacks).collect()
}

/// How often `callback` runs in a second if nothing is lost.
pub fn rate_hz(callback: &Callback, all: &[Callback]) -> f64 {
    let of =
        |topic: &&str| all.iter().find(|other| other.output == Some(*topic)).map(|other| rate_hz(other, all));
    let inputs = callback.inputs.iter().filter_map(of);
    match callback.trigger {
        Trigger::Period(period) => 1.0 / period.as_secs_f64(),
        Trigger::Any => inputs.sum(),
        Trigger::All => inputs.fold(f64::INFINITY, f64::min),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn every_topic_has_one_publisher_and_a_listener() {
        let all = callbacks();
        assert_eq!((NODES.len(), all.len()), (24, 25));
        let names: BTreeSet<_> = all.iter().map(|callback| callback.name).collect();
        assert_eq!(names.len(), all.len(), "no name twice");
        let published: Vec<_> = all.iter().filter_map(|callback| callback.output).collect();
        let heard: BTreeSet<_> = all.iter().flat_map(|callback| callback.inputs).copied().collect();
        assert_eq!(published.iter().copied().collect::<BTreeSet<_>>(), heard);
        assert_eq!(published.len(), heard.len(), "no topic has two publishers");
    }

    /// The callbacks that hear of `name`, directly or not.
    fn reached_from(name: &str) -> BTreeSet<&'static str> {
        let all = callbacks();
        let (mut reached, mut next) = (BTreeSet::new(), vec![name]);
        while let Some(topic) = next.pop() {
            for callback in all.iter().filter(|callback| callback.inputs.contains(&topic)) {
                if reached.insert(callback.name) {
                    next.extend(callback.output);
                }
            }
        }
        reached
    }

    #[test]
    fn every_sensor_reaches_a_sink_and_the_lidars_reach_the_estimator() {
        for node in NODES.iter().filter(|node| matches!(node.kind, Kind::Sensor { .. })) {
            let (sink, other) = match node.name {
                "EuclideanClusterSettings" => ("IntersectionOutput", "VehicleDBWSystem"),
                _ => ("VehicleDBWSystem", "IntersectionOutput"),
            };
            let reached = reached_from(node.name);
            assert!(reached.contains(sink) && !reached.contains(other), "{}: {reached:?}", node.name);
        }
        assert!(reached_from(FRONT_LIDAR).contains(ESTIMATOR));
        assert!(reached_from(REAR_LIDAR).contains(ESTIMATOR));
    }

    #[test]
    fn a_fusion_is_as_fast_as_its_slower_input() {
        let all = callbacks();
        let rate = |name| rate_hz(all.iter().find(|callback| callback.name == name).unwrap(), &all);
        assert!((rate("PointCloudFusion") - 10.0).abs() < 1e-9);
        assert!((rate("NDTLocalizer") - 1000.0 / 120.0).abs() < 1e-9);
        assert!((rate("LanePlanner") - 1000.0 / 120.0).abs() < 1e-9);
        assert!((rate("IntersectionOutput") - 40.0).abs() < 1e-9);
    }
}
