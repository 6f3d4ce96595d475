// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut lifecycle` on managed nodes, silent ones, and others.

mod support;

use serde_json::json;
use support::{Here, said};
use tautline::lifecycle::CallbackReturn;
use tautline::lifecycle_msgs::srv::GetState;
use tautline::{LifecycleCallbacks, LifecycleNode, ManagedNode, Qos};

/// What it has begun cannot be undone.
struct Camera;

impl LifecycleCallbacks for Camera {
    fn on_cleanup(&mut self, _node: &mut ManagedNode) -> CallbackReturn {
        CallbackReturn::Failure
    }
}

#[test]
fn states_are_told_and_changed() {
    let mut here = Here::new(87);
    let camera = LifecycleNode::create(here.context.clone(), "camera", "/robot", Camera).unwrap();
    let lidar = LifecycleNode::create(here.context.clone(), "lidar", "", Camera).unwrap();
    for node in [&camera, &lidar] {
        let [changes, states]: [support::Served; 2] =
            [Box::pin(node.serve_changes().unwrap()), Box::pin(node.serve_states().unwrap())];
        node.with_node(|node| [changes, states].map(|served| here.serve(node, served))).unwrap();
    }
    assert_eq!(here.taut(&["lifecycle", "nodes"]), "/lidar\n/robot/camera\n");
    assert_eq!(here.json(&["lifecycle", "nodes"]), json!(["/lidar", "/robot/camera"]));
    assert_eq!(here.taut(&["lifecycle", "get", "robot/camera"]), "unconfigured [1]\n");
    let listed = "- configure [1]\n\tStart: unconfigured\n\tGoal: configuring\n- shutdown [5]\n\tStart: unconfigured\n\tGoal: shuttingdown\n";
    assert_eq!(here.taut(&["lifecycle", "list", "/robot/camera"]), listed);
    assert_eq!(here.json(&["lifecycle", "list", "--all", "/robot/camera"]).as_array().unwrap().len(), 25);

    let set = ["lifecycle", "set", "/robot/camera"];
    assert_eq!(here.taut(&[&set[..], &["configure"]].concat()), "Transitioning successful\n");
    assert_eq!(here.json(&[&set[..], &["3"]].concat())["transition"]["label"], "activate");
    assert_eq!(here.taut(&["lifecycle", "get"]), "/lidar: unconfigured [1]\n/robot/camera: active [3]\n");
    let state = json!({ "node": "/robot/camera", "state": { "id": 3, "label": "active" } });
    assert_eq!(here.json(&["lifecycle", "get", "/robot/camera"]), state);

    let refused = |args: &[&str]| here.refused(&[&["lifecycle"], args].concat());
    let unknown =
        "there is no transition of /robot/camera as it is now 'deactivat'; did you mean deactivate?";
    said(&refused(&["set", "/robot/camera", "deactivat"]), 1, unknown);
    said(&refused(&["set", "/robot/camera", "configure"]), 1, "`taut lifecycle list /robot/camera` prints");
    here.taut(&[&set[..], &["deactivate"]].concat());
    said(
        &refused(&["set", "/robot/camera", "cleanup"]),
        1,
        "Transitioning failed: 'cleanup' of /robot/camera",
    );
    said(&refused(&["get", "/robot/camra"]), 1, "did you mean /robot/camera?");

    let mut asleep = here.node("asleep", "");
    let qos = Qos::services_default();
    let _silent = asleep.create_service::<GetState::Service>("~/get_state", qos).unwrap();
    let (code, out, words) = refused(&["get", "--timeout", "3s"]);
    assert_eq!((code, &*out), (1, "/lidar: unconfigured [1]\n/robot/camera: inactive [2]\n"), "{words}");
    assert!(words.contains("taut: /asleep: service '/asleep/get_state': no response within 3s"), "{words}");
    said(&refused(&["get", "asleep", "--timeout", "50ms"]), 1, "no response within 50ms");
    said(&refused(&["list", "asleep"]), 1, "node '/asleep' is not managed: there is no service");
}
