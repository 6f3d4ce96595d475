// SPDX-License-Identifier: MIT OR Apache-2.0
//! The simulation that bounds are held against, held against rmw_tautline: an unchanged executor of rclpy begins the callbacks of a group that
//! goes by ranks in the order of the simulation, with the same messages. node/tests/simulation.rs does this for nodes of Tautline.
//! `TAUT_SEED` chooses the systems.

#[path = "../../analysis/tests/runtime/mod.rs"]
mod runtime;
mod support;

use std::fmt::Write;

use rand::SeedableRng;
use rand::rngs::StdRng;
use runtime::machine::Step;
use runtime::made_up::Order;
use runtime::small::{HERE, group, run};
use serde_json::{Value, json};
use support::{Domain, words_of};

const SYSTEMS: usize = 40;

/// Publishes what arrives, spins once if a job begins, and stays in it until it ends.
const FOLLOWER: &str = r#"
import json, sys, rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
rclpy.init()
source, begun = rclpy.create_node("source"), 0
for number, system in enumerate(json.load(open(sys.argv[1]))):
    node, steps, publishers = rclpy.create_node(f"listener{number}"), system["steps"], {}
    steps.reverse()
    def follow():
        what, callback, value = steps.pop()
        if what == "arrived": publishers[callback].publish(String(data=str(value)))
        return what
    def heard(callback):
        def run(message):
            global begun
            if not steps: return
            assert steps[-1] == ["begun", callback, int(message.data)], (number, steps[-1], callback, message.data)
            begun += 1
            while steps and follow() != "ended": pass
        return run
    for callback, depth in system["callbacks"]:
        topic = f"/s{number}/t{callback}"
        publishers[callback] = source.create_publisher(String, topic, 100)
        node.create_subscription(String, topic, heard(callback), depth)
    while any(publisher.get_subscription_count() < 1 for publisher in publishers.values()): pass
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while steps:
        if steps[-1][0] == "begun": executor.spin_once()
        else: follow()
    executor.shutdown()
    node.destroy_node()
print(begun)
rclpy.shutdown()
"#;

#[test]
fn an_executor_of_rclpy_begins_what_the_simulation_begins() {
    let Some(domain) = Domain::new(117) else { return };
    let seed =
        std::env::var("TAUT_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or_else(rand::random);
    println!("TAUT_SEED={seed}");
    let mut rng = StdRng::seed_from_u64(seed);
    let mut file = "[hosts.here]\ncores = 1\n".to_owned();
    let (mut systems, mut begun, mut lost) = (Vec::new(), 0, 0);
    for system in 0..SYSTEMS {
        let (model, seen) = run(&mut rng, |rng| group(rng, Order::Rank));
        writeln!(file, "[nodes.listener{system}]\nclient = \"rclpy\"").unwrap();
        writeln!(file, "[groups.g{system}]\norder = \"priority\"\npriority = {}", system + 1).unwrap();
        let mut callbacks = Vec::new();
        for (i, callback) in model.callbacks.iter().enumerate().filter(|(_, callback)| callback.core == HERE)
        {
            let topic = format!("/s{system}/t{i}");
            let rank = callback.priority;
            writeln!(
                file,
                "[callbacks.s{system}t{i}]\ntopic = \"{topic}\"\npriority = {rank}\nwcet = \"1us\"\nnode = \"listener{system}\""
            )
            .unwrap();
            writeln!(file, "group = \"g{system}\"\n[topics.\"{topic}\"]\nperiod = \"1s\"").unwrap();
            callbacks.push((i, callback.depth));
        }
        let steps: Vec<Value> = seen.steps.iter().map(|(_, step)| of(step)).collect();
        begun += steps.iter().filter(|step| step[0] == "begun").count();
        lost += seen.lost.values().sum::<u64>();
        systems.push(json!({ "callbacks": callbacks, "steps": steps }));
    }
    let folder = tempfile::tempdir().unwrap();
    let [path, steps] = ["system.toml", "steps.json"].map(|name| folder.path().join(name));
    std::fs::write(&path, file).unwrap();
    std::fs::write(&steps, json!(systems).to_string()).unwrap();
    let mut command = domain.python(FOLLOWER);
    let (_, out, errors) = words_of(command.arg(steps).env("TAUT_SYSTEM", path).env("TAUT_REALTIME", "off"));
    assert_eq!(out.trim(), begun.to_string(), "{errors}");
    println!("{SYSTEMS} systems: {begun} jobs begin in one order, {lost} messages overwritten");
}

fn of(step: &Step) -> Value {
    match step {
        Step::Arrived { callback, number, .. } => json!(["arrived", callback, number]),
        Step::Begun { callback, numbers } => json!(["begun", callback, numbers[0]]),
        Step::Ended { callback } => json!(["ended", callback, 0]),
        other => unreachable!("{other:?}"),
    }
}
