// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the analysis of the system file says of the indicators.

use std::path::Path;
use std::time::Duration;
use tautline_analysis::file::SystemFile;
use tautline_reference::Placement;
use tautline_reference::graph::{CALLBACKS, Callback, PLANNER};

use crate::Result;

/// The name of the chain, in system files.
const HOT_PATH: &str = "hot path";

/// Bounds, with overheads.
#[derive(Clone, Debug)]
pub struct Bounds {
    /// From the release of the FrontLidarDriver to the end of the ObjectCollisionEstimator.
    pub hot_path: Option<Duration>,
    /// A run of the BehaviorPlanner begins and ends between its release and this: two begin at most this much nearer or
    /// farther than a period.
    pub planner: Option<Duration>,
    /// The shortest wcet of a callback that works.
    pub wcet: Duration,
}

impl Bounds {
    pub fn read(system_file: &Path) -> Result<Bounds> {
        let checked = SystemFile::read(system_file)?.check();
        let hot_path =
            checked.chains.iter().find(|chain| chain.name == HOT_PATH).and_then(|it| it.latency_ns);
        let of = |name| checked.callbacks.iter().find(|callback| callback.entry.name == name);
        let planner = of(PLANNER).and_then(|callback| callback.response_overhead_ns);
        let workers = CALLBACKS.iter().filter(|callback| callback.works);
        let wcets_ns = workers.filter_map(|callback| of(callback.name)).map(|callback| callback.wcet_ns);
        let wcet = Duration::from_nanos(wcets_ns.min().unwrap_or(0));
        let (hot_path, planner) = (hot_path.map(Duration::from_nanos), planner.map(Duration::from_nanos));
        Ok(Bounds { hot_path, planner, wcet })
    }
}

/// Where the file puts the callbacks of the graph, in their order.
pub fn placements(system_file: &Path) -> Result<Vec<Placement>> {
    let checked = SystemFile::read(system_file)?.check();
    let placement = |name: &str| {
        let found = checked.callbacks.iter().find(|callback| callback.entry.name == name);
        found.map(|it| Placement { core: it.core, priority: it.entry.priority })
    };
    let of = |callback: &Callback| {
        placement(callback.name)
            .ok_or_else(|| format!("{} lacks {}", system_file.display(), callback.name).into())
    };
    CALLBACKS.iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::own_file;
    use std::collections::BTreeSet;
    use tautline_reference::graph::Trigger;

    #[test]
    fn the_system_files_describe_the_graph() {
        for name in ["system.toml", "flat.toml"] {
            let text = std::fs::read_to_string(own_file(name)).unwrap();
            let checked = SystemFile::parse(&text).unwrap().check();
            assert_eq!(checked.callbacks.len(), CALLBACKS.len(), "{name}");
            for callback in CALLBACKS {
                let found = checked.callbacks.iter().find(|it| it.entry.name == callback.name);
                let found = found.unwrap_or_else(|| panic!("{name} lacks {}", callback.name));
                match callback.trigger {
                    Trigger::Period(period) => {
                        assert_eq!(u128::from(found.period_ns), period.as_nanos(), "{}", callback.name);
                        assert!(found.entry.topics.is_empty());
                    }
                    Trigger::Any => assert_eq!(found.entry.topics, callback.inputs, "{}", callback.name),
                    Trigger::All => {
                        assert_eq!(
                            found.entry.topics.len(),
                            1,
                            "one triggers in the file, the other is read"
                        );
                        assert!(callback.inputs.contains(&&*found.entry.topics[0]), "{}", callback.name);
                    }
                }
            }
        }
    }

    #[test]
    fn an_order_lowers_the_bounds() {
        let check = |name| SystemFile::read(own_file(name)).unwrap().check();
        // Every deadline is met, but the check fails: one process on two cores has one sampler.
        let in_order = check("system.toml");
        assert!(in_order.callbacks.iter().all(|it| it.met) && in_order.chains.iter().all(|it| it.met));
        assert!(
            !in_order.schedulable && in_order.warnings.iter().any(|warning| warning.contains("one sampler"))
        );
        let [system, flat] = ["system.toml", "flat.toml"].map(|name| Bounds::read(&own_file(name)).unwrap());
        assert!(system.hot_path.unwrap() < flat.hot_path.unwrap());
        assert!(system.planner.unwrap() < flat.planner.unwrap() / 2);
    }

    #[test]
    fn seats_are_in_the_order_of_the_callbacks() {
        let placements = placements(&own_file("system.toml")).unwrap();
        let of = |name| placements[CALLBACKS.iter().position(|callback| callback.name == name).unwrap()];
        assert_eq!(placements.len(), 25);
        assert_eq!(of(PLANNER), Placement { core: 1, priority: 60 });
        assert_eq!(of("RearLidarDriver"), Placement { core: 0, priority: 70 });
    }

    #[test]
    fn the_front_lidar_is_what_completes_the_fusion() {
        // What the bound of the hot path relies on: see the head of system.toml.
        let checked = SystemFile::read(own_file("system.toml")).unwrap().check();
        let priority = |name: &str| {
            let callback = checked.callbacks.iter().find(|it| it.entry.name == name).unwrap();
            assert_eq!(callback.core, 0, "{name}");
            callback.entry.priority
        };
        assert!(priority("PointsTransformerRear") > priority("FrontLidarDriver"));
        assert!(priority("RearLidarDriver") > priority("FrontLidarDriver"));
        let hot: BTreeSet<_> = [
            "RearLidarDriver",
            "PointsTransformerRear",
            "FrontLidarDriver",
            "PointsTransformerFront",
            "PointCloudFusion",
            "RayGroundFilter",
            "EuclideanClusterDetector",
            "ObjectCollisionEstimator",
        ]
        .into();
        let lowest = hot.iter().map(|name| priority(name)).min().unwrap();
        let others = checked.callbacks.iter().filter(|it| it.core == 0 && !hot.contains(&*it.entry.name));
        assert!(others.map(|it| it.entry.priority).max().unwrap() < lowest);
    }
}
