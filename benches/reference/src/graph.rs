// SPDX-License-Identifier: MIT OR Apache-2.0
//! The graph: 24 nodes and what joins them. A topic has the name of the node that publishes it, but for the second output
//! of the intersection.

use std::time::Duration;

pub const FRONT_LIDAR: &str = "FrontLidarDriver";
pub const REAR_LIDAR: &str = "RearLidarDriver";
pub const ESTIMATOR: &str = "ObjectCollisionEstimator";
/// The node whose punctuality is measured.
pub const PLANNER: &str = "BehaviorPlanner";

/// A callback of a node. All have one, but for the intersection, which has one for each of its ways.
#[derive(Clone, Copy, Debug)]
pub struct Callback {
    /// Its name: that of its output, or of its node if it has none.
    pub name: &'static str,
    pub node: &'static str,
    pub trigger: Trigger,
    pub inputs: &'static [&'static str],
    pub output: Option<&'static str>,
    /// Whether it counts primes: where a path neither begins nor ends.
    pub works: bool,
    /// Whether it works on each message of one topic and passes it on.
    pub is_transform: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trigger {
    Period(Duration),
    /// On each message of any input.
    Any,
    /// As soon as there is a message of each input.
    All,
}

const fn callback(name: &'static str, trigger: Trigger, inputs: &'static [&'static str]) -> Callback {
    Callback { name, node: name, trigger, inputs, output: Some(name), works: true, is_transform: false }
}

const fn every_ms(period: u64) -> Trigger {
    Trigger::Period(Duration::from_millis(period))
}

const fn sensor(name: &'static str, period_ms: u64) -> Callback {
    Callback { works: false, ..callback(name, every_ms(period_ms), &[]) }
}

/// Works on each message and passes it on.
const fn transform(name: &'static str, input: &'static [&'static str; 1]) -> Callback {
    Callback { is_transform: true, ..callback(name, Trigger::Any, input) }
}

/// Keeps the latest message of both topics; with both it works, publishes, and forgets them.
const fn fusion(name: &'static str, inputs: &'static [&'static str; 2]) -> Callback {
    callback(name, Trigger::All, inputs)
}

/// The end of a path.
const fn command(name: &'static str, input: &'static [&'static str; 1]) -> Callback {
    Callback { output: None, works: false, ..callback(name, Trigger::Any, input) }
}

/// The callbacks of all nodes; those of a node are next to each other.
pub static CALLBACKS: [Callback; 25] = [
    // Before its neighbour of the same period, with which it is fused: see `system.toml`.
    sensor(REAR_LIDAR, 100),
    sensor(FRONT_LIDAR, 100),
    sensor("PointCloudMap", 120),
    sensor("Visualizer", 60),
    sensor("Lanelet2Map", 100),
    sensor("EuclideanClusterSettings", 25),
    transform("PointsTransformerFront", &[FRONT_LIDAR]),
    transform("PointsTransformerRear", &[REAR_LIDAR]),
    transform("VoxelGridDownsampler", &["PointCloudFusion"]),
    transform("PointCloudMapLoader", &["PointCloudMap"]),
    transform("RayGroundFilter", &["PointCloudFusion"]),
    transform(ESTIMATOR, &["EuclideanClusterDetector"]),
    transform("MPCController", &[PLANNER]),
    transform("ParkingPlanner", &["Lanelet2MapLoader"]),
    transform("LanePlanner", &["Lanelet2MapLoader"]),
    fusion("PointCloudFusion", &["PointsTransformerFront", "PointsTransformerRear"]),
    fusion("NDTLocalizer", &["VoxelGridDownsampler", "PointCloudMapLoader"]),
    fusion("VehicleInterface", &["MPCController", PLANNER]),
    fusion("Lanelet2GlobalPlanner", &["Visualizer", "NDTLocalizer"]),
    fusion("Lanelet2MapLoader", &["Lanelet2Map", "Lanelet2GlobalPlanner"]),
    // Works periodically on what has come since.
    callback(
        PLANNER,
        every_ms(100),
        &[
            ESTIMATOR,
            "NDTLocalizer",
            "Lanelet2GlobalPlanner",
            "Lanelet2MapLoader",
            "ParkingPlanner",
            "LanePlanner",
        ],
    ),
    // An intersection: two transforms of one node, which the reference system does not count among the transforms.
    callback("EuclideanClusterDetector", Trigger::Any, &["RayGroundFilter"]),
    Callback {
        node: "EuclideanClusterDetector",
        ..callback("EuclideanIntersection", Trigger::Any, &["EuclideanClusterSettings"])
    },
    command("VehicleDBWSystem", &["VehicleInterface"]),
    command("IntersectionOutput", &["EuclideanIntersection"]),
];

/// How often `callback` runs in a second if nothing is lost.
pub fn rate_hz(callback: &Callback) -> f64 {
    let of = |topic: &&str| CALLBACKS.iter().find(|other| other.output == Some(*topic)).map(rate_hz);
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
        assert_eq!(CALLBACKS.chunk_by(|a, b| a.node == b.node).count(), 24, "nodes");
        let names: BTreeSet<_> = CALLBACKS.iter().map(|callback| callback.name).collect();
        assert_eq!(names.len(), CALLBACKS.len(), "no name twice");
        let published: Vec<_> = CALLBACKS.iter().filter_map(|callback| callback.output).collect();
        let heard: BTreeSet<_> = CALLBACKS.iter().flat_map(|callback| callback.inputs).copied().collect();
        assert_eq!(published.iter().copied().collect::<BTreeSet<_>>(), heard);
        assert_eq!(published.len(), heard.len(), "no topic has two publishers");
    }

    /// The callbacks that hear of `name`, directly or not.
    fn reached_from(name: &str) -> BTreeSet<&'static str> {
        let (mut reached, mut next) = (BTreeSet::new(), vec![name]);
        while let Some(topic) = next.pop() {
            for callback in CALLBACKS.iter().filter(|callback| callback.inputs.contains(&topic)) {
                if reached.insert(callback.name) {
                    next.extend(callback.output);
                }
            }
        }
        reached
    }

    #[test]
    fn every_sensor_reaches_a_sink_and_the_lidars_reach_the_estimator() {
        for sensor in CALLBACKS.iter().filter(|callback| callback.inputs.is_empty()) {
            let (sink, other) = match sensor.name {
                "EuclideanClusterSettings" => ("IntersectionOutput", "VehicleDBWSystem"),
                _ => ("VehicleDBWSystem", "IntersectionOutput"),
            };
            let reached = reached_from(sensor.name);
            assert!(reached.contains(sink) && !reached.contains(other), "{}: {reached:?}", sensor.name);
        }
        assert!(reached_from(FRONT_LIDAR).contains(ESTIMATOR));
        assert!(reached_from(REAR_LIDAR).contains(ESTIMATOR));
    }

    #[test]
    fn a_fusion_is_as_fast_as_its_slower_input() {
        let rate = |name| rate_hz(CALLBACKS.iter().find(|callback| callback.name == name).unwrap());
        assert!((rate("PointCloudFusion") - 10.0).abs() < 1e-9);
        assert!((rate("NDTLocalizer") - 1000.0 / 120.0).abs() < 1e-9);
        assert!((rate("LanePlanner") - 1000.0 / 120.0).abs() < 1e-9);
        assert!((rate("IntersectionOutput") - 40.0).abs() < 1e-9);
    }
}
